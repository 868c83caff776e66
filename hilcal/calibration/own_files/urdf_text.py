"""A URDF or xacro of the user: `<origin xyz rpy>` of its joints.

Of a xacro, places that are written as numbers change; an expression `${…}` of numbers and `pi` is
read, and refused by its line where it would have to change.
"""

import ast
import math
import operator
import re
from collections.abc import Callable

import numpy as np

from hilcal.calibration.handover import origin_of
from hilcal.calibration.own_files.chain_text import (
    ChainPlace,
    Document,
    Edits,
    Node,
    not_between,
    numbers,
    z_to,
)
from hilcal.calibration.programs.program import Span
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.types import Floats

_EXPRESSION = re.compile(r"\$\{([^{}]*)\}")
_ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    **{ast.Add: operator.add, ast.Sub: operator.sub},
    **{ast.Mult: operator.mul, ast.Div: operator.truediv},
}
_TURNING, _FIXED = ("revolute", "continuous"), "fixed"


def urdf_steps(document: Document, base: str | None, tip: str | None) -> list[ChainPlace]:
    """Return the steps from a base link to a tip link."""
    parents: dict[str, tuple[str, Node]] = {}
    for joint in document.root.every("joint"):
        ends = [joint.first(tag) for tag in ("parent", "child")]
        names = [e.attributes.get("link") for e in ends if e is not None]
        if len(names) != 2 or None in names:
            continue
        parent, child = (str(n) for n in names)
        if child in parents:
            what = f"a second joint leads to link '{escaped(child)}'; valid: a tree"
            raise document.refused(joint, what)
        parents[child] = (parent, joint)
    links = {*parents, *(p for p, _ in parents.values())}
    if not links:
        raise InputError(f"{document.name}: no joints; valid: a URDF or a xacro with them")
    end = _link(document, links, tip) if tip is not None else _leaf(document, parents, links)
    up, back = _path(end, parents, document), []
    if base is not None:
        start = _link(document, links, base)
        down = _path(start, parents, document)
        common = next((name for name, _ in down if name in {n for n, _ in up}), None)
        if common is None:
            raise InputError(f"{document.name}: no chain from '{base}' to '{tip}'")
        up = up[: [n for n, _ in up].index(common)]
        back = down[: [n for n, _ in down].index(common)]
    inverse = [_step(document, j, turned=True) for _, j in back if j is not None]
    return [*inverse, *(_step(document, j) for _, j in reversed(up) if j is not None)]


def _path(
    link: str, parents: dict[str, tuple[str, Node]], document: Document
) -> list[tuple[str, Node | None]]:
    """Links from one up to the root, each with the joint that leads to it."""
    out: list[tuple[str, Node | None]] = []
    while link in parents:
        parent, joint = parents[link]
        out.append((link, joint))
        link = parent
        if len(out) > len(parents):
            raise InputError(f"{document.name}: its joints go round in a circle; valid: a tree")
    return [*out, (link, None)]


def _plain(name: str) -> str:
    """A name without the expressions of a xacro."""
    return _EXPRESSION.sub("", name)


def _link(document: Document, links: set[str], name: str) -> str:
    found = [link for link in links if name in (link, _plain(link))]
    if len(found) != 1:
        raise InputError(
            f"{document.name}: link '{escaped(name)}' is there {len(found)} times; valid: "
            f"{', '.join(sorted(escaped(_plain(link)) for link in links))}"
        )
    return found[0]


def _leaf(document: Document, parents: dict[str, tuple[str, Node]], links: set[str]) -> str:
    """Return the only link behind the moving joints that nothing is attached to."""
    used = {p for p, _ in parents.values()}

    def moves(link: str) -> bool:
        return any(
            j is not None and j.attributes.get("type") in _TURNING
            for _, j in _path(link, parents, document)
        )

    leaves = sorted(link for link in links if link not in used and moves(link))
    if len(leaves) != 1:
        names = ", ".join(escaped(_plain(link)) for link in leaves)
        raise InputError(f"{document.name}: give --tip-link, the flange; its last links: {names}")
    return leaves[0]


def _step(document: Document, joint: Node, *, turned: bool = False) -> ChainPlace:
    """Return the step of a joint; `turned`: from its child to its parent."""
    kind, name = joint.attributes.get("type", ""), joint.attributes.get("name", "")
    axis = joint.first("axis")
    if kind not in (*_TURNING, _FIXED) or (turned and kind != _FIXED):
        raise document.refused(joint, not_between(name, kind))
    along = "1 0 0" if axis is None else axis.attributes.get("xyz", "1 0 0")
    origin = joint.first("origin")
    given = {} if origin is None else origin.attributes
    xyz, rpy = (_values(document, origin or joint, given.get(k, "0 0 0")) for k in ("xyz", "rpy"))
    place = se3.matrix(se3.of_rpy(rpy), xyz)
    turn = None
    if kind != _FIXED:
        node = axis or joint
        turn = z_to(document.direction(node, _values(document, node, along)))

    def write(new: Floats) -> Edits:
        if turned:
            new = se3.inverse(new)
        values = dict(zip(("xyz", "rpy"), origin_of(new), strict=True))
        if origin is None:
            text = " ".join(f'{k}="{numbers(v)}"' for k, v in values.items())
            return [(Span(0, joint.end, joint.end), f"<origin {text}/>")]
        out: Edits = []
        for key, old in (("xyz", xyz), ("rpy", rpy)):
            if np.abs(old - values[key]).max() < 1e-12:
                continue
            if "$" in given.get(key, ""):
                raise document.refused(
                    origin,
                    f"the place of joint '{escaped(name)}' is '{escaped(given[key][:60])}', and "
                    f"becomes '{numbers(values[key])}'; write numbers there, or correct what "
                    "xacro makes of it: xacro F.xacro > F.urdf",
                )
            out.append(document.put(origin, key, numbers(values[key])))
        return out

    return ChainPlace(name, joint.line, se3.inverse(place) if turned else place, turn, write)


def _values(document: Document, node: Node, text: str) -> Floats:
    """Return three numbers, of which a xacro may compute some."""

    def computed(m: re.Match[str]) -> str:
        try:
            return repr(_constant(ast.parse(m[1].strip(), mode="eval").body))
        except (ValueError, SyntaxError, ZeroDivisionError, OverflowError, RecursionError):
            raise document.refused(
                node,
                f"'{escaped(m[0][:60])}' is not of numbers; correct what xacro makes of the file: "
                "xacro F.xacro > F.urdf",
            ) from None

    return document.numbers(node, _EXPRESSION.sub(computed, text), 3)


def _constant(node: ast.expr) -> float:
    """Value of an expression of numbers, pi and radians()."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value)
        case ast.Name("pi"):
            return math.pi
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return -_constant(inner)
        case ast.BinOp(left=a, op=op, right=b) if type(op) in _ARITHMETIC:
            return _ARITHMETIC[type(op)](_constant(a), _constant(b))
        case ast.Call(func=ast.Name("radians"), args=[inner], keywords=[]):
            return math.radians(_constant(inner))
    raise ValueError
