"""XML with the places of its elements in the text, so that a few numbers of it can be replaced."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from hilcal import limits
from hilcal.calibration.programs.program import Span
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.types import Floats

LARGEST, SMALLEST = 1e6, 1e-6
"""Of numbers, and of the length of a direction; choices."""
_TAG = re.compile(r"<(?:\"[^\"]*\"|'[^']*'|[^<>\"'])*>")


@dataclass(slots=True, eq=False)
class Node:
    """An element."""

    tag: str
    attributes: dict[str, str]  # by name, as written
    line: int  # from 1
    begin: int  # where its start tag begins
    end: int  # where its start tag ends
    close: int = 0  # where its end tag begins
    parent: "Node | None" = None  # None for the root
    children: list["Node"] = field(default_factory=list)  # in the order of the text

    def first(self, tag: str) -> "Node | None":
        """Return the first child of a name."""
        return next((c for c in self.children if c.tag == tag), None)

    def every(self, *tags: str) -> Iterator["Node"]:
        """Yield elements of some names below it, in the order of the text."""
        for child in self.children:
            if child.tag in tags:
                yield child
            yield from child.every(*tags)


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    """A file."""

    name: str
    text: str  # with one character per byte
    root: Node

    def attribute(self, node: Node, name: str) -> Span | None:
        """Where the value of an attribute stands."""
        tag = self.text[node.begin : node.end]
        m = re.search(rf"\s{re.escape(name)}\s*=\s*(\"([^\"]*)\"|'([^']*)')", tag)
        if m is None:
            return None
        return Span(0, node.begin + m.start(1) + 1, node.begin + m.end(1) - 1)

    def put(self, node: Node, name: str, value: str) -> tuple[Span, str]:
        """Return the edit that gives an attribute a value, where there is none a new one."""
        at = self.attribute(node, name)
        if at is not None:
            return at, value
        begin = node.begin + 1 + len(node.tag)
        return Span(0, begin, begin), f' {name}="{value}"'

    def numbers(self, node: Node, text: str, count: int) -> Floats:
        """Return the numbers of an attribute or a text."""
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != count or not (np.abs(values) <= LARGEST).all():
            raise InputError(
                f"{self.name}: line {node.line}: <{escaped(node.tag)}> has '{escaped(text[:40])}'; "
                f"valid: {count} numbers"
            )
        return values

    def direction(self, node: Node, values: Floats) -> Floats:
        """Return a vector of length 1."""
        size = float(np.linalg.norm(values))
        if size < SMALLEST:
            raise InputError(
                f"{self.name}: line {node.line}: <{escaped(node.tag)}> has a direction of length 0"
            )
        return np.asarray(values / size)


def read_xml(path: Path) -> Document:
    """Read a file."""
    try:
        raw = limits.read_bytes(path, limits.PROGRAM)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    text = raw.decode("latin-1")
    open_: list[Node] = []
    roots: list[Node] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        begin = parser.CurrentByteIndex
        m = _TAG.match(text, begin)
        node = Node(tag, attributes, parser.CurrentLineNumber, begin, m.end() if m else begin)
        if open_:
            node.parent = open_[-1]
            open_[-1].children.append(node)
        else:
            roots.append(node)
        open_.append(node)
        if len(open_) > limits.NESTED:
            raise InputError(f"{path}: nested too deeply; valid: a robot's description")

    def end(tag: str) -> None:
        open_.pop().close = parser.CurrentByteIndex

    def entity(*_: object) -> None:
        raise InputError(f"{path}: it has entities of its own; valid: XML without <!ENTITY>")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.EntityDeclHandler = entity
    try:
        parser.Parse(raw, True)
    except expat.ExpatError as error:
        raise InputError(f"{path}: line {error.lineno}: no XML: {error}") from None
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{path}: UTF-16; valid: UTF-8")
    return Document(path.name, text, roots[0])
