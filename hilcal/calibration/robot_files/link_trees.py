"""A user's URDF, xacro or SDF: links and the joints that lead to them, corrected in place.

URDF: `<origin xyz rpy>` of the joints. In a xacro, only numbers are changed. An expression `${…}`
of numbers and `pi` is evaluated, but refused by its line if it would have to change.

SDF (Gazebo): `<pose>` of joints and links. A pose is relative to the frame that `relative_to`
names; without it, that of a link is relative to the model, that of a joint to its child link. Every
link and joint whose pose in its own reference frame changes is edited. Source: *SDFormat
Specification* 1.7 and later, "Pose frame semantics".
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from hilcal.calibration.handover import origin_of
from hilcal.calibration.programs.program import Span
from hilcal.calibration.robot_files.chain_text import (
    EDIT_TOLERANCE,
    ChainStep,
    Document,
    Edits,
    Node,
    numbers,
    pose_difference,
    z_to,
)
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.types import Floats

TURNING = ("revolute", "continuous")  # types of a joint that turns
EXPRESSION = re.compile(r"\$\{([^{}]*)\}")  # an expression of a xacro
_ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    **{ast.Add: operator.add, ast.Sub: operator.sub},
    **{ast.Mult: operator.mul, ast.Div: operator.truediv},
}


@dataclass(frozen=True, slots=True, eq=False)
class LinkTree:
    """The links of a description, and the joints that lead to them."""

    document: Document
    parents: Mapping[str, tuple[str, Node]]  # by child link: its parent link, and the joint

    def chain(self, base: str | None, tip: str | None) -> tuple[list[Node], list[Node]]:
        """Return the joints from a base up to its common ancestor with a tip, and down to the tip.

        By default the base is the root, the tip the last link after the moving joints.
        """
        to_tip = self._up(self._last() if tip is None else self._link(tip))
        to_base = to_tip[-1:] if base is None else self._up(self._link(base))
        common = next((name for name in to_base if name in to_tip), None)
        if common is None:
            raise InputError(f"{self.document.name}: no chain from '{base}' to '{to_tip[0]}'")
        up, down = (links[: links.index(common)] for links in (to_base, to_tip))
        return [self.parents[k][1] for k in up], [self.parents[k][1] for k in reversed(down)]

    def _up(self, link: str) -> list[str]:
        out = [link]
        while out[-1] in self.parents:
            out.append(self.parents[out[-1]][0])
            if len(out) > len(self.parents) + 1:
                raise InputError(f"{self.document.name}: its joints form a loop")
        return out

    def _link(self, name: str) -> str:
        """Return the link of a name, which may omit the expressions of a xacro."""
        links = {*self.parents, *(parent for parent, _ in self.parents.values())}
        matching = [link for link in links if name in (link, EXPRESSION.sub("", link))]
        if len(matching) != 1:
            valid = ", ".join(sorted(escaped(EXPRESSION.sub("", link)) for link in links))
            reason = f"link '{escaped(name)}' is there {len(matching)} times; valid: {valid}"
            raise InputError(f"{self.document.name}: {reason}")
        return matching[0]

    def _last(self) -> str:
        parents = {parent for parent, _ in self.parents.values()}

        def moves(link: str) -> bool:
            kinds = (self.parents[k][1].attributes.get("type") for k in self._up(link)[:-1])
            return any(kind in TURNING for kind in kinds)

        last = sorted(link for link in self.parents if link not in parents and moves(link))
        if not last:
            raise InputError(f"{self.document.name}: no revolute joint; valid: one with the arm")
        if len(last) > 1:
            names = ", ".join(escaped(EXPRESSION.sub("", link)) for link in last)
            raise InputError(
                f"{self.document.name}: give --tip-link, the flange; its last links: {names}"
            )
        return last[0]


def not_between(name: str, kind: str) -> str:
    """Return why a joint is not allowed between base and tip."""
    joint = f"joint '{escaped(name)}' is {escaped(kind) or 'nothing'}"
    return f"{joint}; valid between base and tip: revolute, continuous, fixed"


def urdf_steps(document: Document, base: str | None, tip: str | None) -> list[ChainStep]:
    """Return the steps from a base link to a tip link."""
    parents: dict[str, tuple[str, Node]] = {}
    for joint in document.root.descendants("joint"):
        parent, child = (joint.below(tag, "link") for tag in ("parent", "child"))
        if not parent or not child:
            continue
        if child in parents:
            reason = f"a second joint leads to link '{escaped(child)}'; valid: a tree"
            raise document.error(joint, reason)
        parents[child] = (parent, joint)
    up, down = LinkTree(document, parents).chain(base, tip)
    inverted = [_urdf_step(document, joint, inverted=True) for joint in up]
    return [*inverted, *(_urdf_step(document, joint) for joint in down)]


def _urdf_step(document: Document, joint: Node, *, inverted: bool = False) -> ChainStep:
    """Return the step of a joint; if `inverted`, from its child to its parent."""
    kind, name = joint.attributes.get("type", ""), joint.attributes.get("name", "")
    axis = joint.child("axis")
    if kind not in (*TURNING, "fixed") or (inverted and kind != "fixed"):
        raise document.error(joint, not_between(name, kind))
    along = "1 0 0" if axis is None else axis.attributes.get("xyz", "1 0 0")
    origin = joint.child("origin")
    written = {} if origin is None else origin.attributes
    xyz, rpy = (_values(document, origin or joint, written.get(k, "0 0 0")) for k in ("xyz", "rpy"))
    place = se3.matrix(se3.of_rpy(rpy), xyz)
    turn = None
    if kind != "fixed":
        node = axis or joint
        turn = z_to(document.direction(node, _values(document, node, along)))

    def write(new: Floats) -> Edits:
        if inverted:
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
                raise document.error(
                    origin,
                    f"the place of joint '{escaped(name)}' is '{escaped(written[key][:60])}', and "
                    f"becomes '{numbers(values[key])}'; write numbers there, or correct what "
                    "xacro makes of it: xacro F.xacro > F.urdf",
                )
            out.append(document.attribute_edit(origin, key, numbers(values[key])))
        return out

    return ChainStep(name, joint.line, se3.inverse(place) if inverted else place, turn, write)


def _values(document: Document, node: Node, text: str) -> Floats:

    def computed(m: re.Match[str]) -> str:
        try:
            return repr(_constant(ast.parse(m[1].strip(), mode="eval").body))
        except (ValueError, SyntaxError, ZeroDivisionError, OverflowError, RecursionError):
            raise document.error(
                node,
                f"'{escaped(m[0][:60])}' is not of numbers; correct what xacro makes of the file: "
                "xacro F.xacro > F.urdf",
            ) from None

    return document.numbers(node, EXPRESSION.sub(computed, text), 3)


def _constant(node: ast.expr) -> float:
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


MODEL = "__model__"  # the model's own frame


class SdfModel:
    """Links, joints and frames of a model, and its chain from a base link to a tip link."""

    def __init__(self, document: Document, node: Node):
        self.document = document
        self.steps: list[ChainStep] = []
        self.chain: list[Node] = []
        self.nodes: dict[str, Node] = {}
        for child in node.children:
            if child.tag in ("model", "include"):
                raise document.error(child, "a model in a model; valid: one with the arm")
            if child.tag in ("link", "joint", "frame"):
                name = child.attributes.get("name", "")
                if name in self.nodes:
                    raise document.error(child, f"a second '{escaped(name)}'; valid: unique names")
                self.nodes[name] = child
        self.joints = [n for n in self.nodes.values() if n.tag == "joint"]

    def text(self, node: Node | None) -> str:
        """Text of an element; empty for None."""
        if node is None:
            return ""
        return self.document.text[node.end : node.end_tag].strip()

    def parent_and_child(self, joint: Node) -> tuple[str, str]:
        """Names of the parent and the child link."""
        return self.text(joint.child("parent")), self.text(joint.child("child"))

    def written_pose(self, name: str) -> Floats:
        """(4, 4) pose in its reference frame, as written."""
        pose = self.nodes[name].child("pose")
        if pose is None or not self.text(pose):
            return np.eye(4)
        if pose.attributes.get("degrees") == "true" or "rotation_format" in pose.attributes:
            reason = "a <pose> in degrees or quaternions; valid: x y z r p y, rad"
            raise self.document.error(pose, reason)
        v = self.document.numbers(pose, self.text(pose), 6)
        return se3.matrix(se3.of_rpy(v[3:]), v[:3])

    def axis(self, joint: Node) -> tuple[Node | None, str]:
        """`<xyz>` of a joint, and its frame where that is not the joint's."""
        axis = joint.child("axis")
        xyz = None if axis is None else axis.child("xyz")
        return xyz, "" if xyz is None else xyz.attributes.get("expressed_in", "")

    def reference(self, name: str) -> str:
        """Name of the frame that a pose is relative to."""
        node = self.nodes[name]
        if relative_to := node.below("pose", "relative_to"):
            return relative_to
        if node.tag == "joint":
            return self.parent_and_child(node)[1]
        return node.attributes.get("attached_to", "") or MODEL

    def pose(self, name: str, new: dict[str, Floats] | None = None, depth: int = 0) -> Floats:
        """(4, 4) pose of a frame in the model; `new` overrides poses of frames."""
        if new is not None and name in new:
            return new[name]
        if name in (MODEL, "world"):
            return np.eye(4)
        if name not in self.nodes or depth > len(self.nodes):
            raise InputError(
                f"{self.document.name}: frame '{escaped(name)}' is missing, or relative to "
                "itself; valid: links, joints, frames of the model"
            )
        return self.pose(self.reference(name), new, depth + 1) @ self.written_pose(name)

    def ordered(self) -> list[Node]:
        """Joints in order from parent to child."""
        out: list[Node] = []
        remaining = list(self.joints)
        while remaining:
            children = {self.parent_and_child(j)[1] for j in remaining}
            ready = [j for j in remaining if self.parent_and_child(j)[0] not in children]
            if not ready:
                raise InputError(f"{self.document.name}: joints form a loop")
            out += ready
            remaining = [j for j in remaining if j not in ready]
        return out

    def edits(self, transforms: list[Floats]) -> tuple[Edits, list[str]]:
        """Edits for new transforms of the steps, and the names of changed links and joints."""
        new: dict[str, Floats] = {}
        new_places = dict(zip(self.chain, transforms, strict=True))
        for joint in self.ordered():
            parent, child = self.parent_and_child(joint)
            place = new_places.get(joint)
            if place is None:
                if parent not in new:
                    continue
                place = se3.inverse(self.pose(parent)) @ self.pose(child)
            name = joint.attributes.get("name", "")
            from_child = se3.inverse(self.pose(child)) @ self.pose(name)
            new[child] = (new[parent] if parent in new else self.pose(parent)) @ place
            new[name] = new[child] @ from_child
        out: Edits = []
        names = []
        for name, frame in new.items():
            node = self.nodes[name]
            pose = se3.inverse(self.pose(self.reference(name), new)) @ frame
            if pose_difference(self.written_pose(name), pose) > EDIT_TOLERANCE:
                element, text = node.child("pose"), " ".join(map(numbers, origin_of(pose)))
                if element is None:
                    out.append((Span(0, node.end, node.end), f"<pose>{text}</pose>"))
                elif element.end_tag < element.end:  # <pose/>
                    out.append((Span(0, element.start, element.end), f"<pose>{text}</pose>"))
                else:
                    out.append((Span(0, element.end, element.end_tag), text))
                names.append(name)
            along, axis_frame = self.axis(node)
            if along is not None and axis_frame:  # an axis that is stated in another frame
                old_axis = self.document.numbers(along, self.text(along), 3)
                local = self.pose(name)[:3, :3].T @ self.pose(axis_frame)[:3, :3] @ old_axis
                new_axis = self.pose(axis_frame, new)[:3, :3].T @ frame[:3, :3] @ local
                if np.abs(new_axis - old_axis).max() > EDIT_TOLERANCE:
                    out.append((Span(0, along.end, along.end_tag), numbers(new_axis)))
        return out, names


def sdf_chain(document: Document, base: str | None, tip: str | None) -> SdfModel:
    """Return the chain from a base link to a tip link."""
    models = list(document.root.descendants("model"))
    if not models:
        raise InputError(f"{document.name}: no <model>; valid: an SDF with the arm")
    model = SdfModel(document, models[0])
    ends = {joint: model.parent_and_child(joint) for joint in model.joints}
    leads = {child: (parent, j) for j, (parent, child) in ends.items() if parent != "world"}
    up, model.chain = LinkTree(document, leads).chain(base, tip)
    if up:
        raise InputError(f"{document.name}: no chain from '{base}' down to its tip")
    model.steps = [_sdf_step(model, j) for j in model.chain]
    return model


def _sdf_step(model: SdfModel, joint: Node) -> ChainStep:
    kind, name = joint.attributes.get("type", ""), joint.attributes.get("name", "")
    parent, child = model.parent_and_child(joint)
    place = se3.inverse(model.pose(parent)) @ model.pose(child)
    turn = None
    if kind in TURNING:
        xyz, axis_frame = model.axis(joint)
        along = model.document.numbers(xyz or joint, model.text(xyz) or "0 0 1", 3)
        along, frame = model.document.direction(xyz or joint, along), model.pose(name)
        if axis_frame:
            along = frame[:3, :3].T @ model.pose(axis_frame)[:3, :3] @ along
        turn = se3.inverse(model.pose(child)) @ frame @ z_to(along)
    elif kind != "fixed":
        raise model.document.error(joint, not_between(name, kind))
    return ChainStep(name, joint.line, place, turn, lambda _: [])
