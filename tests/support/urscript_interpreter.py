"""A tiny interpreter of URScript: runs a program's text, and keeps what its motions are told.

It shares no code with the reader of programs that it tests: lines are executed one after the
other, with the values that variables have then.
"""

import math
import random
import re
from dataclasses import dataclass
from functools import cache

MOTIONS = ("movej", "movel", "movep", "servoj", "movec", "servoc", "speedj", "speedl")
TOKEN = re.compile(
    r'\s*("[^"]*"|(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|p\[|[A-Za-z_]\w*|[=!<>]=|[-+*/%()\[\],=<>])'
)
POWER = {"or": 1, "and": 2, "==": 4, "!=": 4, "<": 4, ">": 4, "<=": 4, ">=": 4, "+": 5, "-": 5}
POWER |= {"*": 6, "/": 6, "%": 6}


class Stopped(Exception):
    """The program failed, or took too long."""


class Returned(Exception):
    """A function returns."""


class Broken(Exception):
    """A loop ends."""


class Pose(list):
    """p[…]."""


@dataclass
class Told:
    """What a motion was told: its name, line, target, and the tool that was set."""

    kind: str
    line: int
    target: object
    tool: object


class Machine:
    """A controller; digital inputs read the same for the same seed."""

    def __init__(self, seed: int, by_reference: bool) -> None:
        self.inputs = random.Random(seed)
        self.by_reference = by_reference
        self.told: list[Told] = []
        self.tool: object = None
        self.fuel = 400
        self.threads: list[tuple[str, list, int]] = []

    def run(self, program: str) -> list[Told]:
        """Run a program until it ends or fails; returns its motions."""
        lines = []
        for k, line in enumerate(re.split(r"\r?\n", program), start=1):
            text = re.sub(r'("[^"]*")|#.*', lambda m: m[1] or "", line).strip()
            if text and not text.startswith("$"):
                lines.append((k, text))
        body = self._block(lines)
        assert not lines
        try:
            scopes: list[dict[str, object]] = [{}]
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

    def _do(self, body, scopes) -> None:
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

    def _statement(self, text, scopes, line) -> None:
        if text == "break":
            raise Broken
        if text.startswith("return"):
            raise Returned(self._evaluate(text[6:], scopes, line) if text[6:].strip() else None)
        head, runs, thread = text.partition("run ")
        if runs and re.fullmatch(r"(\w+\s*=\s*)?", head):
            self.threads.append((thread, scopes, line))
            text = f"{head}0"
        found = re.fullmatch(
            r"(?:(global|local)\s+)?([A-Za-z_]\w*)\s*(?:\[([^\]]*)\])?\s*=(?!=)(.*)", text
        )
        if not found:
            self._evaluate(text, scopes, line)
            return
        where, name, index, value = found.groups()
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
        return _Expression(self, list(_tokens(text.rstrip())), scopes, line).value(0)

    def called(self, name, given, named, scopes, line):
        if name in MOTIONS:
            target = given[0] if given else named.get("q", named.get("pose"))
            if isinstance(target, list):
                target = type(target)(target)
            self.told.append(Told(name, line, target, self.tool))
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
def _tokens(text):
    out, at = [], 0
    while at < len(text):
        found = TOKEN.match(text, at)
        out.append(found[1])
        at = found.end()
    return out


class _Expression:
    """One expression, by precedence climbing."""

    def __init__(self, machine, tokens, scopes, line) -> None:
        self.machine, self.tokens, self.scopes, self.line = machine, tokens, scopes, line

    def take(self, sign=None):
        if not self.tokens or sign not in (None, self.tokens[0]):
            raise AssertionError(f"line {self.line}: {self.tokens} where {sign} was expected")
        return self.tokens.pop(0)

    def value(self, power):
        left = self.one()
        while self.tokens and POWER.get(self.tokens[0], 0) > power:
            sign = self.take()
            right = self.value(POWER[sign])
            left = self.of_two(sign, left, right)
        return left

    def of_two(self, sign, a, b):
        if sign in ("and", "or"):
            return (a and b) if sign == "and" else (a or b)
        if sign in ("==", "!="):
            return (a == b) == (sign == "==")
        if not (isinstance(a, int | float) and isinstance(b, int | float)) or (
            sign in "/%" and not b
        ):
            raise Stopped
        return {
            "+": lambda: a + b, "-": lambda: a - b, "*": lambda: a * b, "/": lambda: a / b,
            "%": lambda: a % b, "<": lambda: a < b, ">": lambda: a > b, "<=": lambda: a <= b,
            ">=": lambda: a >= b,
        }[sign]()  # fmt: skip

    def one(self):
        token = self.take()
        if token == "-":
            inner = self.value(6)
            if not isinstance(inner, int | float):
                raise Stopped
            return -inner
        if token == "not":
            return not self.value(3)
        if token == "(":
            out = self.value(0)
            self.take(")")
        elif token in ("[", "p["):
            out = (Pose if token == "p[" else list)(self.several("]")[0])
        elif token[0] == '"':
            out = token[1:-1]
        elif token[0].isdigit() or token[0] == ".":
            out = float(token)
        elif token in ("True", "False"):
            out = token == "True"
        elif self.tokens and self.tokens[0] == "(":
            self.take()
            given, named = self.several(")")
            out = self.machine.called(token, given, named, self.scopes, self.line)
        else:
            out = self.machine._read(token, self.scopes)
        while self.tokens and self.tokens[0] == "[":
            self.take()
            at = self.value(0)
            self.take("]")
            if not isinstance(out, list) or not 0 <= at < len(out):
                raise Stopped
            out = out[int(at)]
        return out

    def several(self, end):
        given, named = [], {}
        while self.tokens[0] != end:
            if len(self.tokens) > 1 and self.tokens[1] == "=":
                name = self.take()
                self.take()
                named[name] = self.value(0)
            else:
                given.append(self.value(0))
            if self.tokens[0] == ",":
                self.take()
        self.take(end)
        return given, named
