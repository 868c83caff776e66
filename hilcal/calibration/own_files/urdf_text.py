"""A user's URDF or xacro: `<origin xyz rpy>` of its joints.

In a xacro, only numbers are changed. An expression `${…}` of numbers and `pi` is evaluated, but
refused by its line if it would have to change.
"""

import ast
import math
import operator
import re
from collections.abc import Callable

import numpy as np

from hilcal.calibration.handover import origin_of
from hilcal.calibration.own_files.chain_text import (
    EXPRESSION,
    TURNING,
    ChainStep,
    Document,
    Edits,
    LinkTree,
    Node,
    not_between,
    numbers,
    z_to,
)
from hilcal.calibration.programs.program import Span
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.types import Floats

_ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    **{ast.Add: operator.add, ast.Sub: operator.sub},
    **{ast.Mult: operator.mul, ast.Div: operator.truediv},
}
_FIXED = "fixed"


def urdf_steps(document: Document, base: str | None, tip: str | None) -> list[ChainStep]:
    """Return the steps from a base link to a tip link."""
    parents: dict[str, tuple[str, Node]] = {}
    for joint in document.root.every("joint"):
        ends = [joint.first(tag) for tag in ("parent", "child")]
        names = [e.attributes.get("link") for e in ends if e is not None]
        if len(names) != 2 or None in names:
            continue
        parent, child = (str(n) for n in names)
        if child in parents:
            reason = f"a second joint leads to link '{escaped(child)}'; valid: a tree"
            raise document.refused(joint, reason)
        parents[child] = (parent, joint)
    up, down = LinkTree(document, parents).chain(base, tip)
    turned = [_step(document, joint, turned=True) for joint in up]
    return [*turned, *(_step(document, joint) for joint in down)]


def _step(document: Document, joint: Node, *, turned: bool = False) -> ChainStep:
    """Return the step of a joint; if `turned`, from its child to its parent."""
    kind, name = joint.attributes.get("type", ""), joint.attributes.get("name", "")
    axis = joint.first("axis")
    if kind not in (*TURNING, _FIXED) or (turned and kind != _FIXED):
        raise document.refused(joint, not_between(name, kind))
    along = "1 0 0" if axis is None else axis.attributes.get("xyz", "1 0 0")
    origin = joint.first("origin")
    written = {} if origin is None else origin.attributes
    xyz, rpy = (_values(document, origin or joint, written.get(k, "0 0 0")) for k in ("xyz", "rpy"))
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
            if "$" in written.get(key, ""):
                raise document.refused(
                    origin,
                    f"the place of joint '{escaped(name)}' is '{escaped(written[key][:60])}', and "
                    f"becomes '{numbers(values[key])}'; write numbers there, or correct what "
                    "xacro makes of it: xacro F.xacro > F.urdf",
                )
            out.append(document.put(origin, key, numbers(values[key])))
        return out

    return ChainStep(name, joint.line, se3.inverse(place) if turned else place, turn, write)


def _values(document: Document, node: Node, text: str) -> Floats:
    """Return three numbers, which may be expressions of a xacro."""

    def computed(m: re.Match[str]) -> str:
        try:
            return repr(_constant(ast.parse(m[1].strip(), mode="eval").body))
        except (ValueError, SyntaxError, ZeroDivisionError, OverflowError, RecursionError):
            raise document.refused(
                node,
                f"'{escaped(m[0][:60])}' is not of numbers; correct what xacro makes of the file: "
                "xacro F.xacro > F.urdf",
            ) from None

    return document.numbers(node, EXPRESSION.sub(computed, text), 3)


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
