"""An SDF of the user (Gazebo): `<pose>` of its joints and links.

A pose counts from what `relative_to` names; without it, that of a link from the model, that of a
joint from its child link, as the specification says. A joint that has its place from another frame
than its child has its pose changed, of every other one the pose of the child link.

Source: *SDFormat Specification* 1.7 and later, "Pose frame semantics".
"""

import numpy as np

from hilcal.calibration.handover import origin_of
from hilcal.calibration.own_files.chain_text import (
    LEFT,
    TURNING,
    ChainPlace,
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
    """Frames of a model: links, joints, frames; and its chain from a base link to a tip link."""

    def __init__(self, document: Document, node: Node):
        """Take the frames of a model; the chain is found by `sdf_chain`."""
        self.document = document
        self.steps: list[ChainPlace] = []
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
        """Text of an element; empty where it is none."""
        if node is None:
            return ""
        return self.document.text[node.end : node.close].strip()

    def ends(self, joint: Node) -> tuple[str, str]:
        """Names of the parent and the child link."""
        return self.text(joint.first("parent")), self.text(joint.first("child"))

    def own(self, name: str) -> Floats:
        """(4, 4) pose as written."""
        pose = self.nodes[name].first("pose")
        if pose is None or not self.text(pose):
            return np.eye(4)
        if pose.attributes.get("degrees") == "true" or "rotation_format" in pose.attributes:
            what = "a <pose> in degrees or quaternions; valid: x y z r p y, rad"
            raise self.document.refused(pose, what)
        v = self.document.numbers(pose, self.text(pose), 6)
        return se3.matrix(se3.of_rpy(v[3:]), v[:3])

    def axis(self, joint: Node) -> tuple[Node | None, str]:
        """`<xyz>` of a joint, and the frame that it is written in where that is not the joint's."""
        axis = joint.first("axis")
        xyz = None if axis is None else axis.first("xyz")
        return xyz, "" if xyz is None else xyz.attributes.get("expressed_in", "")

    def reference(self, name: str) -> str:
        """Name of the frame that a pose counts from."""
        node = self.nodes[name]
        pose = node.first("pose")
        given = "" if pose is None else pose.attributes.get("relative_to", "")
        if given:
            return given
        if node.tag == "joint":
            return self.ends(node)[1]
        return node.attributes.get("attached_to", "") or MODEL

    def place(self, name: str, new: dict[str, Floats] | None = None, depth: int = 0) -> Floats:
        """(4, 4) of a frame in the model; those in `new` as they are there."""
        if new is not None and name in new:
            return new[name]
        if name in (MODEL, "world"):
            return np.eye(4)
        if name not in self.nodes or depth > len(self.nodes):
            raise InputError(
                f"{self.document.name}: frame '{escaped(name)}' is not there, or counts from "
                "itself; valid: links, joints, frames of the model"
            )
        return self.place(self.reference(name), new, depth + 1) @ self.own(name)

    def ordered(self) -> list[Node]:
        """Joints, each behind that which leads to its parent."""
        out: list[Node] = []
        left = list(self.joints)
        while left:
            children = {self.ends(j)[1] for j in left}
            ready = [j for j in left if self.ends(j)[0] not in children]
            if not ready:
                raise InputError(f"{self.document.name}: joints go round in a circle")
            out += ready
            left = [j for j in left if j not in ready]
        return out

    def edits(self, places: list[Floats]) -> tuple[Edits, list[str]]:
        """Edits that give the steps other places, and the names of what moves."""
        new: dict[str, Floats] = {}
        given = dict(zip(self.chain, places, strict=True))
        for joint in self.ordered():
            parent, child = self.ends(joint)
            place = given.get(joint)
            if place is None:
                if parent not in new:
                    continue
                place = se3.inverse(self.place(parent)) @ self.place(child)
            name = joint.attributes.get("name", "")
            behind = se3.inverse(self.place(child)) @ self.place(name)
            new[child] = (new[parent] if parent in new else self.place(parent)) @ place
            new[name] = new[child] @ behind
        out: Edits = []
        names = []
        for name, at in new.items():
            node = self.nodes[name]
            pose = se3.inverse(self.place(self.reference(name), new)) @ at
            if moved(self.own(name), pose) > LEFT:
                xyz, rpy = origin_of(pose)
                out.append(_pose_edit(node, f"{numbers(xyz)} {numbers(rpy)}"))
                names.append(name)
            along, other = self.axis(node)
            if along is not None and other:  # an axis in another frame turns with its joint
                was = self.document.numbers(along, self.text(along), 3)
                local = self.place(name)[:3, :3].T @ self.place(other)[:3, :3] @ was
                now = self.place(other, new)[:3, :3].T @ at[:3, :3] @ local
                if np.abs(now - was).max() > LEFT:
                    out.append((Span(0, along.end, along.close), numbers(now)))
        return out, names


def sdf_chain(document: Document, base: str | None, tip: str | None) -> SdfModel:
    """Return the chain from a base link to a tip link."""
    models = list(document.root.every("model"))
    if not models:
        raise InputError(f"{document.name}: no <model>; valid: an SDF with the arm")
    model = SdfModel(document, models[0])
    ends = {joint: model.ends(joint) for joint in model.joints}
    leads = {child: (parent, j) for j, (parent, child) in ends.items() if parent != "world"}
    back, model.chain = LinkTree(document, leads).chain(base, tip)
    if back:
        raise InputError(f"{document.name}: no chain from '{base}' down to its tip")
    model.steps = [_step(model, j) for j in model.chain]
    return model


def _pose_edit(node: Node, text: str) -> tuple[Span, str]:
    """Edit that gives a link or joint a pose, where it has none a new one."""
    pose = node.first("pose")
    if pose is None or pose.close < pose.end:  # <pose/>
        at = node.end if pose is None else pose.begin
        return Span(0, at, at if pose is None else pose.end), f"<pose>{text}</pose>"
    return Span(0, pose.end, pose.close), text


def _step(model: SdfModel, joint: Node) -> ChainPlace:
    """Return the step of a joint; raises as `sdf_chain` does."""
    kind, name = joint.attributes.get("type", ""), joint.attributes.get("name", "")
    parent, child = model.ends(joint)
    place = se3.inverse(model.place(parent)) @ model.place(child)
    turn = None
    if kind in TURNING:
        xyz, other = model.axis(joint)
        along = model.document.numbers(xyz or joint, model.text(xyz) or "0 0 1", 3)
        along, at = model.document.direction(xyz or joint, along), model.place(name)
        if other:
            along = at[:3, :3].T @ model.place(other)[:3, :3] @ along
        turn = se3.inverse(model.place(child)) @ at @ z_to(along)
    elif kind != "fixed":
        raise model.document.refused(joint, not_between(name, kind))
    return ChainPlace(name, joint.line, place, turn, lambda _: [])
