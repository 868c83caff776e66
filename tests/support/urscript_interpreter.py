"""A tiny interpreter of URScript: runs a program's text, and keeps what its motions are told.

It shares no code with the reader of programs that it tests: lines are executed one after the
other, with the values that variables have then.
"""

import ast
import math
import operator
import random
import re
from dataclasses import dataclass
from functools import cache

MOTIONS = ("movej", "movel", "movep", "servoj", "movec", "servoc", "speedj", "speedl")
OPERATORS = {
    **{ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul},
    **{ast.Div: operator.truediv, ast.Mod: operator.mod, ast.Eq: operator.eq},
    **{ast.NotEq: operator.ne, ast.Lt: operator.lt, ast.LtE: operator.le},
    **{ast.Gt: operator.gt, ast.GtE: operator.ge},
}


class Stopped(Exception):
    """The program failed, or took too long."""


class Returned(Exception):
    """A function returns."""


class Broken(Exception):
    """A loop ends."""


class Pose(list):
    """p[…]."""


@dataclass
class ExecutedMotion:
    """What a motion was told: its name, line, target, and the tool that was set."""

    kind: str
    line: int
    target: object
    tool: object


class Machine:
    """A controller; digital inputs read the same for the same seed."""

    def __init__(self, seed, by_reference):
        self.inputs = random.Random(seed)
        self.by_reference = by_reference
        self.told = []
        self.tool = None
        self.fuel = 400
        self.threads = []

    def run(self, program):
        """Run a program until it ends or fails; returns its motions."""
        lines = []
        for k, line in enumerate(re.split(r"\r?\n", program), start=1):
            text = re.sub(r'("[^"]*")|#.*', lambda m: m[1] or "", line).strip()
            if text and not text.startswith("$"):
                lines.append((k, text))
        body = self._block(lines)
        assert not lines
        try:
            scopes = [{}]
            self._do(body, scopes)
            if len(body) == 1 and body[0][1] == "def":  # a program of one function is called
                self.called(body[0][2], [], {}, scopes, 0)
        except (Stopped, Returned, Broken):
            pass
        return self.told

    def _block(self, lines):
        """Take the statements up to the end of this block off the lines."""
        out = []
        while lines and re.match(r"\$|\w+", lines[0][1])[0] not in ("end", "else", "elif"):
            number, text = lines.pop(0)
            word = re.match(r"\w+", text)[0]
            if word in ("def", "thread"):
                name, given = re.fullmatch(r"\w+\s+(\w+)\s*\((.*)\)\s*:", text).groups()
                parameters = [x.strip() for x in given.split(",") if x.strip()]
                out.append((number, "def", name, parameters, self._block(lines)))
            elif word == "while":
                out.append((number, "while", text[5:].rstrip(": "), self._block(lines)))
            elif word == "if":
                branches = [(number, text[2:].rstrip(": "), self._block(lines))]
                while lines[0][1].startswith("el"):
                    number, text = lines.pop(0)
                    test = text[4:].rstrip(": ") if text.startswith("elif") else "True"
                    branches.append((number, test, self._block(lines)))
                out.append((number, "if", branches))
            else:
                out.append((number, "do", text))
                continue
            lines.pop(0)
        return out

    def _do(self, body, scopes):
        for number, kind, *rest in body:
            self.fuel -= 1
            if self.fuel < 0:
                raise Stopped
            if self.threads and self.inputs.random() < 0.5:
                self._evaluate(*self.threads.pop(0))
            if kind == "def":
                scopes[-1][rest[0]] = (rest[1], rest[2], scopes)
            elif kind == "if":
                for line, test, inner in rest[0]:
                    if self._evaluate(test, scopes, line):
                        self._do(inner, scopes)
                        break
            elif kind == "while":
                try:
                    while self._evaluate(rest[0], scopes, number):
                        self._do(rest[1], scopes)
                except Broken:
                    pass
            else:
                self._statement(rest[0], scopes, number)

    def _statement(self, text, scopes, line):
        if text == "break":
            raise Broken
        if text.startswith("return"):
            raise Returned(self._evaluate(text[6:], scopes, line) if text[6:].strip() else None)
        head, runs, thread = text.partition("run ")
        if runs and re.fullmatch(r"(\w+\s*=\s*)?", head):
            self.threads.append((thread, scopes, line))
            text = f"{head}0"
        match = re.fullmatch(
            r"(?:(global|local)\s+)?([A-Za-z_]\w*)\s*(?:\[([^\]]*)\])?\s*=(?!=)(.*)", text
        )
        if not match:
            self._evaluate(text, scopes, line)
            return
        where, name, index, value = match.groups()
        new = self._copied(self._evaluate(value, scopes, line))
        if index is not None:
            old = self._read(name, scopes)
            at = int(self._evaluate(index, scopes, line))
            if not isinstance(old, list) or not 0 <= at < len(old):
                raise Stopped
            old[at] = new
            return
        scope = scopes[0] if where == "global" else scopes[-1]
        if where is None:
            scope = next((s for s in reversed(scopes) if name in s), scope)
        scope[name] = new

    def _copied(self, value):
        copies = isinstance(value, list) and not self.by_reference
        return type(value)(value) if copies else value

    def _read(self, name, scopes):
        for scope in reversed(scopes):
            if name in scope:
                return scope[name]
        raise Stopped

    def _evaluate(self, text, scopes, line):
        return self._value(_parsed(text.strip()), scopes, line)

    def _value(self, node, scopes, line):
        """The value of an expression, which Python's grammar reads; p[…] is P[…] there."""

        def of(inner):
            return self._value(inner, scopes, line)

        match node:
            case ast.Constant(value=bool() | str()):
                return node.value
            case ast.Constant():
                return float(node.value)
            case ast.Name():
                return self._read(node.id, scopes)
            case ast.List():
                return [of(part) for part in node.elts]
            case ast.Subscript(value=ast.Name(id="P"), slice=ast.Tuple() as inner):
                return Pose(
                    of(x) for x in (inner.elts if isinstance(inner, ast.Tuple) else [inner])
                )
            case ast.Subscript():
                out, at = of(node.value), of(node.slice)
                if not isinstance(out, list) or not 0 <= at < len(out):
                    raise Stopped
                return out[int(at)]
            case ast.Call(func=ast.Name(id=name)):
                given = [of(x) for x in node.args]
                named = {x.arg: of(x.value) for x in node.keywords}
                return self.called(name, given, named, scopes, line)
            case ast.UnaryOp():
                inner = of(node.operand)
                if isinstance(node.op, ast.Not):
                    return not inner
                if not isinstance(inner, int | float):
                    raise Stopped
                return -inner
            case ast.BoolOp(values=[a, b]):
                a, b = of(a), of(b)
                return (a and b) if isinstance(node.op, ast.And) else (a or b)
            case (
                ast.BinOp(left=a, op=sign, right=b)
                | ast.Compare(left=a, ops=[sign], comparators=[b])
            ):
                a, b = of(a), of(b)
                if not isinstance(sign, ast.Eq | ast.NotEq) and not (
                    isinstance(a, int | float) and isinstance(b, int | float)
                ):
                    raise Stopped
                try:
                    return OPERATORS[type(sign)](a, b)
                except ZeroDivisionError:
                    raise Stopped from None
        raise AssertionError(f"line {line}: {ast.unparse(node)} is not understood")

    def called(self, name, given, named, scopes, line):
        if name in MOTIONS:
            target = given[0] if given else named.get("q", named.get("pose"))
            if isinstance(target, list):
                target = type(target)(target)
            self.told.append(ExecutedMotion(name, line, target, self.tool))
            return None
        match name:
            case "d2r":
                return math.radians(given[0])
            case "get_standard_digital_in":
                return self.inputs.random() < 0.5
            case "set_tcp":
                self.tool = Pose(given[0])
                return None
            case "get_inverse_kin":
                return ("inverse", *given, *named.values())
            case "pose_trans":
                if not all(isinstance(x, list) and _numbers(x) for x in given):
                    raise Stopped
                return Pose([a + b for a, b in zip(*given, strict=True)])
            case "sleep" | "textmsg":
                return None
        if name.startswith("set_"):
            return None
        function = self._read(name, scopes)
        if not isinstance(function, tuple) or len(function[0]) != len(given):
            raise Stopped
        parameters, body, defined = function
        local = {k: self._copied(v) for k, v in zip(parameters, given, strict=True)}
        self.fuel -= 20
        try:
            self._do(body, [*defined, local])
        except Returned as found:
            return found.args[0]
        return None


def _numbers(values):
    return len(values) == 6 and all(isinstance(v, int | float) for v in values)


@cache
def _parsed(text):
    return ast.parse(re.sub(r"\bp\[", "P[", text), mode="eval").body
