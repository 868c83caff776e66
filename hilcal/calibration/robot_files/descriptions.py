"""A user's robot description, corrected in place: URDF, xacro, SDF, MJCF, UR's calibration.conf.

URDF: `<origin xyz rpy>` of the joints. In a xacro, only numbers are changed. An expression `${…}`
of numbers and `pi` is evaluated, but refused by its line if it would have to change.

SDF (Gazebo): `<pose>` of joints and links. A pose is relative to the frame that `relative_to`
names; without it, that of a link is relative to the model, that of a joint to its child link. Every
link and joint whose pose in its own reference frame changes is edited. Source: *SDFormat
Specification* 1.7 and later, "Pose frame semantics".

MJCF (MuJoCo): `pos` and `quat` of the bodies that its joints move. Orientations may be `quat`,
`axisangle`, `euler`, `xyaxes` or `zaxis`, with the angle settings of `<compiler>`; a changed
orientation is written as `quat`. Axes come from the joint, else from its class in `<default>`.
Source: MuJoCo, *XML Reference*: body, joint, site, compiler, frame orientations, default settings.
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.calibration.dh_table import dh_rows
from hilcal.calibration.handover import CorrectedArm, origin_of
from hilcal.calibration.programs.program import Span, edited
from hilcal.calibration.robot_files.chain_text import (
    EDIT_TOLERANCE,
    FRAME_TOLERANCE,
    ChainStep,
    Document,
    Edits,
    Node,
    edits_of,
    fitted_chain,
    numbers,
    pose_difference,
    read_xml,
    z_to,
)
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.numbers import length
from hilcal.robot import se3
from hilcal.robot.arm import Arm
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


_TURNS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}


def mjcf_steps(document: Document, base: str | None, tip: str | None) -> list[ChainStep]:
    """Return the steps from a base body to a tip, a body or a site."""
    world = document.root.child("worldbody")
    if world is None:
        raise InputError(f"{document.name}: no <worldbody>; valid: an MJCF with the arm in it")
    for node in document.root.descendants("include", "attach", "replicate"):
        raise document.error(node, f"<{node.tag}>; valid: the arm in the file itself")
    hinged = [b for b in world.descendants("body") if b.child("joint") is not None]
    if not hinged:
        raise InputError(f"{document.name}: no body with a joint; valid: an MJCF with the arm")
    if tip is None:
        ends = [b for b in hinged if not any(o is not b and b in _up(o) for o in hinged)]
        if len(ends) != 1:
            names = ", ".join(_name(b) for b in ends)
            raise InputError(f"{document.name}: give --tip-link; its last bodies: {names}")
        (end,) = ends
    else:
        end = _named(document, world, tip, ("body", "site"))
    start = hinged[0].parent if base is None else _named(document, world, base, ("body",))
    above = _up(end)
    if start is None or start not in above:
        raise InputError(f"{document.name}: no chain from '{base}' to '{tip}'")
    return [_step(document, b) for b in reversed(above[: above.index(start)])]


def _up(node: Node) -> list[Node]:
    out = [node]
    while out[-1].parent is not None:
        out.append(out[-1].parent)
    return out


def _name(node: Node) -> str:
    return escaped(node.attributes.get("name", f"<{node.tag}> of line {node.line}"))


def _named(document: Document, world: Node, name: str, tags: tuple[str, ...]) -> Node:
    nodes = [n for n in world.descendants(*tags) if n.attributes.get("name") == name]
    if len(nodes) != 1:
        valid = ", ".join(_name(n) for n in world.descendants(*tags) if "name" in n.attributes)
        raise InputError(
            f"{document.name}: no {' or '.join(tags)} '{escaped(name)}'; valid: {valid}"
        )
    return nodes[0]


def _step(document: Document, node: Node) -> ChainStep:
    joints = [c for c in node.children if c.tag in ("joint", "freejoint")]
    if node.tag == "frame" or len(joints) > 1:
        reason = f"{_name(node)} is a frame or has several joints; valid: one hinge in a body"
        raise document.error(node, reason)
    pos = document.numbers(node, node.attributes.get("pos", "0 0 0"), 3)
    place = se3.matrix(_rotation(document, node), pos)
    turn = None
    if joints:
        (joint,) = joints
        kind = _default(document, joint, "type") or "hinge"
        if joint.tag != "joint" or kind != "hinge":
            reason = f"joint '{_name(joint)}' is no hinge; valid: hinges between base and tip"
            raise document.error(joint, reason)
        axis = document.numbers(joint, _default(document, joint, "axis") or "0 0 1", 3)
        origin = document.numbers(joint, _default(document, joint, "pos") or "0 0 0", 3)
        turn = se3.matrix(np.eye(3), origin) @ z_to(document.direction(joint, axis))

    def write(new: Floats) -> Edits:
        out: Edits = []
        if np.abs(new[:3, 3] - pos).max() > 1e-12:
            out.append(document.attribute_edit(node, "pos", numbers(new[:3, 3])))
        turned = se3.rotation_vector(new[:3, :3] @ place[:3, :3].T)
        if np.linalg.norm(turned) > 1e-12:
            value = numbers(se3.quaternion(new[:3, :3]))
            key = next((k for k in _TURNS if k in node.attributes), "quat")
            old = document.attribute_span(node, key)
            if key == "quat" or old is None:
                return [*out, document.attribute_edit(node, "quat", value)]
            head = document.text.rfind(key, node.start, old.start)
            between = document.text[head + len(key) : old.start]
            out.append((Span(0, head, old.end), f"quat{between}{value}"))
        return out

    return ChainStep(_name(node), node.line, place, turn, write)


def _rotation(document: Document, node: Node) -> Floats:
    keys = [k for k in _TURNS if k in node.attributes]
    if not keys:
        return np.eye(3)
    key = keys[0]
    v = document.numbers(node, node.attributes[key], _TURNS[key])
    compiler = {
        k: v for c in document.root.descendants("compiler") for k, v in c.attributes.items()
    }
    unit = 1.0 if compiler.get("angle") == "radian" else np.pi / 180
    if key == "quat":
        return se3.of_quaternion(document.direction(node, v))
    if key == "axisangle":
        return se3.rotation(unit * v[3] * document.direction(node, v[:3]))
    if key == "zaxis":
        return z_to(document.direction(node, v))[:3, :3]
    if key == "xyaxes":
        x = document.direction(node, v[:3])
        y = document.direction(node, v[3:] - (x @ v[3:]) * x)
        return np.stack([x, y, np.cross(x, y)], axis=1)
    sequence = compiler.get("eulerseq", "xyz")
    if not re.fullmatch(r"[xyzXYZ]{3}", sequence):
        raise InputError(f"{document.name}: eulerseq '{escaped(sequence)}'; valid: such as xyz")
    out = np.eye(3)
    for letter, angle in zip(sequence, v, strict=True):
        turn = se3.rotation(unit * angle * np.eye(3)["xyz".index(letter.lower())])
        out = out @ turn if letter.islower() else turn @ out
    return out


def _default(document: Document, joint: Node, key: str) -> str | None:
    """Attribute of a joint, else of its class, of its bodies' class, or of the main class."""
    if key in joint.attributes:
        return joint.attributes[key]
    name = joint.attributes.get("class") or next(
        (n.attributes["childclass"] for n in _up(joint) if "childclass" in n.attributes), None
    )
    classes = list(document.root.descendants("default"))
    default = next(
        (d for d in classes if d.attributes.get("class") == name),
        next((d for d in classes if d.parent is document.root), None),
    )
    while default is not None and default.tag == "default":
        joint_default = default.child("joint")
        if joint_default is not None and key in joint_default.attributes:
            return joint_default.attributes[key]
        default = default.parent
    return None


KINDS = "a URDF, a xacro, an MJCF, an SDF, or UR's calibration.conf"
_STEPS = {"mujoco": mjcf_steps, "robot": urdf_steps}
_DELTA = re.compile(r"^(\s*delta_(theta|a|d|alpha)\s*=\s*\[)([^\]\n]*)(\].*)$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class CorrectedFile:
    """A corrected file."""

    content: bytes
    note: str  # changes, and what the file cannot represent, for people


def correct_file(
    path: Path,
    nominal: Arm,
    corrected: CorrectedArm,
    base: str | None = None,
    tip: str | None = None,
) -> CorrectedFile:
    """Return a file with the corrected geometry in place of its own."""
    if path.suffix == ".conf":
        return _ur_conf(path, nominal, corrected.arm)
    document = read_xml(path)
    kind = document.root.tag
    if kind == "sdf":
        chain = sdf_chain(document, base, tip)
        new = fitted_chain(chain.steps, nominal, corrected.arm, document.name)
        edits, names = chain.edits(list(new.transforms))
    elif kind in _STEPS:
        steps = _STEPS[kind](document, base, tip)
        new = fitted_chain(steps, nominal, corrected.arm, document.name)
        edits, names = edits_of(steps, new.transforms)
    else:
        raise InputError(f"{path}: an XML file of <{kind[:40]}>; valid: {KINDS}")
    changed = f"{len(names)} place{'s' * (len(names) != 1)} changed ({', '.join(names)})"
    note = f"{path}: {changed if names else 'no place changed'}, all else as it was"
    if new.axis_distance > FRAME_TOLERANCE:
        note += f"; its axes were up to {length(new.axis_distance)} from those of the nominal "
        note += nominal.name
    if (shift := pose_difference(new.unrepresented, np.eye(4))) > EDIT_TOLERANCE:
        note += (
            f"; its tip is the last moving link, which cannot represent the shift of the flange "
            f"({length(shift)}): give --tip-link"
        )
    if pose_difference(new.tip, np.eye(4)) > FRAME_TOLERANCE:
        note += (
            f"; its tip is {length(float(np.linalg.norm(new.tip[:3, 3])))} from the flange of "
            f"{nominal.name}, and stays there"
        )
    return CorrectedFile(edited(document.text, edits).encode("latin-1"), note)


def _ur_conf(path: Path, nominal: Arm, arm: Arm) -> CorrectedFile:
    """Return UR's `calibration.conf`: differences between the arm's and nominal classic DH rows."""
    text = limits.read_bytes(path, limits.SETTINGS).decode("latin-1")
    lines = {m[2]: m for m in _DELTA.finditer(text)}
    if set(lines) != {"theta", "a", "d", "alpha"}:
        raise InputError(
            f"{path}: not the four lines delta_theta, delta_a, delta_d, delta_alpha; valid: UR's "
            "calibration.conf"
        )
    if not nominal.name.startswith("ur"):
        raise InputError(f"{path}: is for UR arms, the campaign has {nominal.name}")
    old, new = dh_rows(nominal), dh_rows(arm)
    values = {"a": new.a - old.a, "d": new.d - old.d}
    for key, turn in (("theta", new.offset - old.offset), ("alpha", new.alpha - old.alpha)):
        values[key] = (turn + np.pi) % (2 * np.pi) - np.pi
    edits = [
        (Span(0, m.start(3), m.end(3)), f" {', '.join(f'{v:.17g}' for v in values[key])}")
        for key, m in lines.items()
    ]
    note = (
        f"{path}: the four lines delta_… changed, all else as it was. The rows do not contain "
        f"the pose of joint 1's axis in the base (up to {length(new.base_moves)}) and that of the "
        f"flange on the last axis (up to {length(new.flange_moves)}): the tool centre point on an "
        "arm with these rows is tcp_for_ur_kinematics of --frames with --ur-kinematics"
    )
    return CorrectedFile(edited(text, edits).encode("latin-1"), note)
