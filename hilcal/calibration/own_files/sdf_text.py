"""A user's SDF (Gazebo): `<pose>` of its joints and links.

A pose is relative to the frame that `relative_to` names; without it, that of a link is relative to
the model, that of a joint to its child link, as the specification says. Every link and joint whose
pose in its own reference frame changes is edited.

Source: *SDFormat Specification* 1.7 and later, "Pose frame semantics".
"""

import numpy as np

from hilcal.calibration.handover import origin_of
from hilcal.calibration.own_files.chain_text import (
    LEFT,
    TURNING,
    ChainStep,
    Document,
    Edits,
    LinkTree,
    Node,
    moved,
    not_between,
    numbers,
    z_to,
)
from hilcal.calibration.programs.program import Span
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.types import Floats

MODEL = "__model__"
"""The model's own frame."""


class SdfModel:
    """Links, joints and frames of a model, and its chain from a base link to a tip link."""

    def __init__(self, document: Document, node: Node):
        self.document = document
        self.steps: list[ChainStep] = []
        self.chain: list[Node] = []
        self.nodes: dict[str, Node] = {}
        for child in node.children:
            if child.tag in ("model", "include"):
                raise document.refused(child, "a model in a model; valid: one with the arm")
            if child.tag in ("link", "joint", "frame"):
                name = child.attributes.get("name", "")
                if name in self.nodes:
                    raise document.refused(
                        child, f"a second '{escaped(name)}'; valid: names of one"
                    )
                self.nodes[name] = child
        self.joints = [n for n in self.nodes.values() if n.tag == "joint"]

    def text(self, node: Node | None) -> str:
        """Text of an element; empty for None."""
        if node is None:
            return ""
        return self.document.text[node.end : node.close].strip()

    def ends(self, joint: Node) -> tuple[str, str]:
        """Names of the parent and the child link."""
        return self.text(joint.first("parent")), self.text(joint.first("child"))

    def written_pose(self, name: str) -> Floats:
        """(4, 4) pose in its reference frame, as written."""
        pose = self.nodes[name].first("pose")
        if pose is None or not self.text(pose):
            return np.eye(4)
        if pose.attributes.get("degrees") == "true" or "rotation_format" in pose.attributes:
            reason = "a <pose> in degrees or quaternions; valid: x y z r p y, rad"
            raise self.document.refused(pose, reason)
        v = self.document.numbers(pose, self.text(pose), 6)
        return se3.matrix(se3.of_rpy(v[3:]), v[:3])

    def axis(self, joint: Node) -> tuple[Node | None, str]:
        """`<xyz>` of a joint, and its frame where that is not the joint's."""
        axis = joint.first("axis")
        xyz = None if axis is None else axis.first("xyz")
        return xyz, "" if xyz is None else xyz.attributes.get("expressed_in", "")

    def reference(self, name: str) -> str:
        """Name of the frame that a pose is relative to."""
        node = self.nodes[name]
        pose = node.first("pose")
        relative_to = "" if pose is None else pose.attributes.get("relative_to", "")
        if relative_to:
            return relative_to
        if node.tag == "joint":
            return self.ends(node)[1]
        return node.attributes.get("attached_to", "") or MODEL

    def place(self, name: str, new: dict[str, Floats] | None = None, depth: int = 0) -> Floats:
        """(4, 4) pose of a frame in the model; `new` overrides poses of frames."""
        if new is not None and name in new:
            return new[name]
        if name in (MODEL, "world"):
            return np.eye(4)
        if name not in self.nodes or depth > len(self.nodes):
            raise InputError(
                f"{self.document.name}: frame '{escaped(name)}' is not there, or counts from "
                "itself; valid: links, joints, frames of the model"
            )
        return self.place(self.reference(name), new, depth + 1) @ self.written_pose(name)

    def ordered(self) -> list[Node]:
        """Joints in order from parent to child."""
        out: list[Node] = []
        remaining = list(self.joints)
        while remaining:
            children = {self.ends(j)[1] for j in remaining}
            ready = [j for j in remaining if self.ends(j)[0] not in children]
            if not ready:
                raise InputError(f"{self.document.name}: joints go round in a circle")
            out += ready
            remaining = [j for j in remaining if j not in ready]
        return out

    def edits(self, places: list[Floats]) -> tuple[Edits, list[str]]:
        """Edits that give the steps other places, and the names of changed links and joints."""
        new: dict[str, Floats] = {}
        new_places = dict(zip(self.chain, places, strict=True))
        for joint in self.ordered():
            parent, child = self.ends(joint)
            place = new_places.get(joint)
            if place is None:
                if parent not in new:
                    continue
                place = se3.inverse(self.place(parent)) @ self.place(child)
            name = joint.attributes.get("name", "")
            from_child = se3.inverse(self.place(child)) @ self.place(name)
            new[child] = (new[parent] if parent in new else self.place(parent)) @ place
            new[name] = new[child] @ from_child
        out: Edits = []
        names = []
        for name, frame in new.items():
            node = self.nodes[name]
            pose = se3.inverse(self.place(self.reference(name), new)) @ frame
            if moved(self.written_pose(name), pose) > LEFT:
                element, text = node.first("pose"), " ".join(map(numbers, origin_of(pose)))
                if element is None:
                    out.append((Span(0, node.end, node.end), f"<pose>{text}</pose>"))
                elif element.close < element.end:  # <pose/>
                    out.append((Span(0, element.begin, element.end), f"<pose>{text}</pose>"))
                else:
                    out.append((Span(0, element.end, element.close), text))
                names.append(name)
            along, axis_frame = self.axis(node)
            if along is not None and axis_frame:  # an axis in another frame turns with its joint
                old_axis = self.document.numbers(along, self.text(along), 3)
                local = self.place(name)[:3, :3].T @ self.place(axis_frame)[:3, :3] @ old_axis
                new_axis = self.place(axis_frame, new)[:3, :3].T @ frame[:3, :3] @ local
                if np.abs(new_axis - old_axis).max() > LEFT:
                    out.append((Span(0, along.end, along.close), numbers(new_axis)))
        return out, names


def sdf_chain(document: Document, base: str | None, tip: str | None) -> SdfModel:
    """Return the chain from a base link to a tip link."""
    models = list(document.root.every("model"))
    if not models:
        raise InputError(f"{document.name}: no <model>; valid: an SDF with the arm")
    model = SdfModel(document, models[0])
    ends = {joint: model.ends(joint) for joint in model.joints}
    leads = {child: (parent, j) for j, (parent, child) in ends.items() if parent != "world"}
    up, model.chain = LinkTree(document, leads).chain(base, tip)
    if up:
        raise InputError(f"{document.name}: no chain from '{base}' down to its tip")
    model.steps = [_step(model, j) for j in model.chain]
    return model


def _step(model: SdfModel, joint: Node) -> ChainStep:
    """Return the step of a joint; raises as `sdf_chain` does."""
    kind, name = joint.attributes.get("type", ""), joint.attributes.get("name", "")
    parent, child = model.ends(joint)
    place = se3.inverse(model.place(parent)) @ model.place(child)
    turn = None
    if kind in TURNING:
        xyz, axis_frame = model.axis(joint)
        along = model.document.numbers(xyz or joint, model.text(xyz) or "0 0 1", 3)
        along, frame = model.document.direction(xyz or joint, along), model.place(name)
        if axis_frame:
            along = frame[:3, :3].T @ model.place(axis_frame)[:3, :3] @ along
        turn = se3.inverse(model.place(child)) @ frame @ z_to(along)
    elif kind != "fixed":
        raise model.document.refused(joint, not_between(name, kind))
    return ChainStep(name, joint.line, place, turn, lambda _: [])
