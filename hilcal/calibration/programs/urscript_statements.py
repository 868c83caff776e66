"""The statements of a URScript program, one per line, of a supported part of the language.

URScript's expressions have Python's syntax, so that Python's own parser reads them. Every form that
is not in the list of supported ones is refused by its line, not guessed. A statement is one line.
Source: Universal Robots, *The URScript Programming Language*, e-Series, software 5.11, chapter 1.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_name

_WORD = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_MARK = re.compile(r'\$\s*\d+(\s+"[^"\\]*")*\s*(#.*)?')
"""A line that PolyScope writes before each node of its tree."""
_STRING_OR_COMMENT = re.compile(r'"[^"\\]*"|#.*')
_OTHER_SIGN = re.compile(r"""[^\t -~]|["'\\;`]""")
_NUMBER = re.compile(r"\d+\.?\d*([eE][-+]?\d+)?|\.\d+([eE][-+]?\d+)?")
_OPENS = ("def", "thread", "sec", "if", "while")
_ALONE = ("halt", "enter_critical", "exit_critical")
_EXPRESSIONS = (
    ast.Name, ast.Constant, ast.List, ast.Tuple, ast.Subscript, ast.Call, ast.keyword, ast.UnaryOp,
    ast.BinOp, ast.BoolOp, ast.Compare, ast.expr_context, ast.boolop,
    ast.Eq, ast.NotEq, ast.Lt, ast.LtE, ast.Gt, ast.GtE,
    ast.USub, ast.UAdd, ast.Not, ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Mod,
)  # fmt: skip
VALID = "valid: one statement of URScript per line, as chapter 1 of its manual has them"


@dataclass(frozen=True, slots=True, eq=False)
class Statement:
    """One statement."""

    line: int  # of the program, from 1
    block: int  # of the block that it opens, if any
    start: int  # offset of `text` in the program
    text: str  # from which `node` was parsed
    node: ast.stmt  # of `if`, `while` and `def` only the head
    blocks: tuple[int, ...]  # numbers of the blocks around it, the outermost first
    kinds: tuple[str, ...]  # first words of these blocks
    calls: dict[ast.Call, str]  # all calls in it, with the names of their functions

    @property
    def call(self) -> ast.Call | None:
        """The call that the statement consists of; None for other statements."""
        value = self.node.value if isinstance(self.node, ast.Expr) else None
        return value if isinstance(value, ast.Call) else None

    def span(self, node: ast.expr) -> tuple[int, int]:
        """Offsets of the beginning and end of one of its expressions in the program."""
        ends = (node.col_offset, node.end_col_offset or 0)
        first, last = (len(self.text.encode()[:end].decode()) for end in ends)
        return self.start + first, self.start + last

    def text_of(self, node: ast.expr) -> str:
        """Return the text of an expression."""
        first, last = (offset - self.start for offset in self.span(node))
        return self.text[first:last]


def statements(program: str) -> tuple[Statement, ...]:
    """Parse a program."""
    out: list[Statement] = []
    open_blocks: list[tuple[str, int]] = []
    offset = count = 0
    for number, full_line in enumerate(program.split("\n"), start=1):
        line = full_line.removesuffix("\r")
        check_name(line.replace("\t", " "), f"line {number}")
        body = line.strip(" \t")
        begin = offset + len(line) - len(line.lstrip(" \t"))
        offset += len(full_line) + 1
        if not body or body.startswith("#") or _MARK.fullmatch(body):
            continue
        if len(body) > limits.STATEMENT:
            raise _refused(number, f"{len(body)} characters, at most {limits.STATEMENT} are read")
        if len(out) == limits.STATEMENTS:
            raise _refused(number, f"more than {limits.STATEMENTS} statements before it")
        if len(open_blocks) > limits.NESTED_BLOCKS:
            raise _refused(number, f"it stands in more than {limits.NESTED_BLOCKS} blocks")
        match = _WORD.match(body)
        word = match[0] if match else ""
        plain = _STRING_OR_COMMENT.sub("", body).strip()
        if word in ("else", "elif"):
            if not open_blocks or open_blocks[-1][0] not in ("if", "elif"):
                raise _refused(number, f"{word} without if")
            open_blocks.pop()
        elif plain == "end":
            if not open_blocks:
                raise _refused(number, "end without a beginning")
            open_blocks.pop()
            continue
        count += 1
        blocks, kinds = tuple(b for _, b in open_blocks), tuple(kind for kind, _ in open_blocks)
        if word in (*_OPENS, "elif", "else"):
            open_blocks.append((word, count))
        if word == "else":
            if "".join(plain.split()) != "else:":
                raise _refused(number, f"'{body[:40]}' is not understood")
            continue
        text, shift = _as_python(body, word)
        node = _parsed(text, number, word)
        calls = (n for n in ast.walk(node) if isinstance(n, ast.Call))
        called = {n: n.func.id for n in calls if isinstance(n.func, ast.Name)}
        out.append(Statement(number, count, begin + shift, text, node, blocks, kinds, called))
    if open_blocks:
        raise _refused(number, f"the program ends inside of {open_blocks[-1][0]}")
    return tuple(out)


def _as_python(body: str, word: str) -> tuple[str, int]:
    """Return a line as Python, and the number of characters removed at its beginning."""
    if word in ("thread", "sec"):  # nothing in this line is ever replaced
        return "def" + body.removeprefix(word), 0
    if word == "elif":
        return body[2:], 2
    if word in ("global", "local", "run", "join", "kill"):
        statement = body.removeprefix(word).lstrip(" \t")
        return statement, len(body) - len(statement)
    return re.sub(r"=(\s*)run\s", lambda m: m[0].replace("run", "   "), body, count=1), 0


def _parsed(text: str, number: int, word: str) -> ast.stmt:
    for sign in _OTHER_SIGN.findall(_STRING_OR_COMMENT.sub("", text)):
        raise _refused(number, f"the sign {sign!a} outside of a comment")
    reason, header = f"'{text[:40]}' is not understood", word in (*_OPENS, "elif")
    try:
        (node,) = ast.parse(text + "\n pass" * header).body
        level: list[ast.AST] = [node]  # the depth that Python itself reads varies
        for _ in range(limits.NESTED_EXPRESSIONS):
            level = [part for parent in level for part in ast.iter_child_nodes(parent)]
        supported = not level and all(_means_the_same(n, text) for n in _parts(node))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise _refused(number, reason) from None
    bare_name = isinstance(node, ast.Expr) and isinstance(node.value, ast.Name)
    supported &= not bare_name or word in ("join", "kill", *_ALONE)
    if not supported or isinstance(node, ast.If | ast.While | ast.FunctionDef) != header:
        raise _refused(number, reason)
    return node


def _parts(node: ast.stmt) -> Iterator[ast.AST]:
    """Yield all nodes of a statement except the `pass` that `_parsed` added."""
    match node:
        case ast.If(test=test) | ast.While(test=test):
            yield from ast.walk(test)
        case ast.FunctionDef(args=head) if (
            not (head.kwonlyargs or head.posonlyargs or head.vararg or head.kwarg)
            and all(a.annotation is None for a in head.args)
            and node.returns is None
        ):
            for value in head.defaults:
                yield from ast.walk(value)
        case (
            ast.Assign(targets=[ast.Name()])
            | ast.Assign(targets=[ast.Subscript(value=ast.Name())])
            | ast.Expr(value=ast.Call())
            | ast.Return()
            | ast.Break()
            | ast.Continue()
        ):
            yield from (n for n in ast.walk(node) if n is not node)
        case ast.Expr(value=ast.Name()):
            yield node.value
        case _:
            raise ValueError


def _means_the_same(node: ast.AST, text: str) -> bool:
    """Whether a part of an expression means the same in URScript and Python."""
    match node:
        case ast.Constant(value=bool() | str()):
            return True
        case ast.Constant(value=int() | float()):
            written = text.encode()[node.col_offset : node.end_col_offset].decode()
            return _NUMBER.fullmatch(written) is not None
        case ast.Constant():
            return False
        case ast.Subscript(value=ast.Name("p"), slice=ast.Tuple()):
            end = node.value.end_col_offset or 0
            return text.encode()[end : end + 1] == b"["
        case ast.Subscript():
            return not isinstance(node.slice, ast.Tuple)
        case ast.Call():
            return isinstance(node.func, ast.Name)
        case ast.keyword():
            return node.arg is not None
    return isinstance(node, _EXPRESSIONS)


def _refused(line: int, reason: str) -> InputError:
    return InputError(f"line {line}: {reason}; {VALID}")
