"""A user's MJCF (MuJoCo): `pos` and `quat` of the bodies that its joints move.

Orientations may be `quat`, `axisangle`, `euler`, `xyaxes` or `zaxis`, with the angle settings of
`<compiler>`; a changed orientation is written as `quat`. Axes come from the joint, else from its
class in `<default>`.

Source: MuJoCo, *XML Reference*: body, joint, site, compiler, frame orientations, default settings.
"""

import re

import numpy as np

from hilcal.calibration.programs.program import Span
from hilcal.calibration.robot_files.chain_text import (
    ChainStep,
    Document,
    Edits,
    Node,
    numbers,
    z_to,
)
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.types import Floats

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
