"""A robot description file with the places of its numbers, and its chain with a corrected arm.

A file has steps from its base link to its tip link: a transform, and after it a joint or none. Its
frames differ from those of the arm (meshes have their own), but its joint axes are the same. With
M_k the links of the nominal arm, C_k of the corrected one, N_k of the file, all with the joint axes
along z,

    N_k = H_{k−1}⁻¹ M_k G_k,   G_k = Rz(·) Tz(·),   H_k = Rz(o_k) G_k,   N'_k = H_{k−1}⁻¹ C_k G_k

o_k is the difference between the joint's zeros in the file and in the controller. H_{−1} is from
the base of the arm to that of the file: the identity, or half a turn about z (as between `base` and
`base_link` of a UR arm). G_n is from the flange to the tip. G and H do not contain the
errors of the file, which may be millimetres, so that N' is exact. For each N'_k one transform is
changed: that of its joint, after the last joint that of the first step.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from pathlib import Path
from xml.parsers import expat

import numpy as np

from hilcal import limits
from hilcal.calibration.programs.program import Span
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.numbers import length
from hilcal.robot import se3
from hilcal.robot.arm import Arm, as_drawn
from hilcal.types import Floats

FRAME_TOLERANCE = 1e-6  # m, rad; nearer frames count as the same: files have six decimals
NEAR_M, NEAR_RAD = 5e-3, 1e-2  # m, rad; a file whose axes are nearer is of this arm; a choice
EDIT_TOLERANCE = 1e-9  # m, rad; a transform that changes less keeps its text
Edits = list[tuple[Span, str]]
LARGEST, SMALLEST = 1e6, 1e-6  # largest number, and least length of a direction; choices
_TAG = re.compile(r"<(?:\"[^\"]*\"|'[^']*'|[^<>\"'])*>")


@dataclass(slots=True, eq=False)
class Node:
    """An element."""

    tag: str
    attributes: dict[str, str]  # by name, as written
    line: int  # from 1
    start: int  # offset of its start tag
    end: int  # offset of the start tag's end
    end_tag: int = 0  # offset of its end tag
    parent: "Node | None" = None  # None for the root
    children: list["Node"] = field(default_factory=list)  # in the order of the text

    def child(self, tag: str) -> "Node | None":
        """Return the first child with a tag."""
        return next((c for c in self.children if c.tag == tag), None)

    def below(self, tag: str, key: str) -> str:
        """Return an attribute of the first child with a tag; empty without it."""
        child = self.child(tag)
        return "" if child is None else child.attributes.get(key, "")

    def descendants(self, *tags: str) -> Iterator["Node"]:
        """Yield descendants with some tags, in the order of the text."""
        for child in self.children:
            if child.tag in tags:
                yield child
            yield from child.descendants(*tags)


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    """A file."""

    name: str
    text: str  # with one character per byte
    root: Node

    def error(self, node: Node, reason: str) -> InputError:
        """Return the error of an element."""
        return InputError(f"{self.name}: line {node.line}: {reason}")

    def attribute_span(self, node: Node, name: str) -> Span | None:
        """Place of the value of an attribute; None if absent."""
        tag = self.text[node.start : node.end]
        m = re.search(rf"\s{re.escape(name)}\s*=\s*(\"([^\"]*)\"|'([^']*)')", tag)
        if m is None:
            return None
        return Span(0, node.start + m.start(1) + 1, node.start + m.end(1) - 1)

    def attribute_edit(self, node: Node, name: str, value: str) -> tuple[Span, str]:
        """Return the edit that sets an attribute, or adds it."""
        place = self.attribute_span(node, name)
        if place is not None:
            return place, value
        begin = node.start + 1 + len(node.tag)
        return Span(0, begin, begin), f' {name}="{value}"'

    def numbers(self, node: Node, text: str, count: int) -> Floats:
        """Return the numbers of an attribute or a text."""
        try:
            values = np.array([float(word) for word in text.split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != count or not (np.abs(values) <= LARGEST).all():
            reason = f"<{escaped(node.tag)}> has '{escaped(text[:40])}'; valid: {count} numbers"
            raise self.error(node, reason)
        return values

    def direction(self, node: Node, values: Floats) -> Floats:
        """Return a vector of length 1."""
        size = float(np.linalg.norm(values))
        if size < SMALLEST:
            raise self.error(node, f"<{escaped(node.tag)}> has a direction of length 0")
        return np.asarray(values / size)


def read_xml(path: Path) -> Document:
    """Read an XML file."""
    raw = limits.read_bytes(path, limits.PROGRAM)
    text = raw.decode("latin-1")
    top = Node("", {}, 0, 0, 0)
    open_ = [top]

    def start(tag: str, attributes: dict[str, str]) -> None:
        begin, parent = parser.CurrentByteIndex, open_[-1]
        m = _TAG.match(text, begin)
        node = Node(tag, attributes, parser.CurrentLineNumber, begin, m.end() if m else begin)
        node.parent = None if parent is top else parent
        parent.children.append(node)
        open_.append(node)
        if len(open_) > limits.NESTED_EXPRESSIONS + 1:
            raise InputError(f"{path}: nested too deeply; valid: a robot's description")

    def end(tag: str) -> None:
        open_.pop().end_tag = parser.CurrentByteIndex

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
    return Document(path.name, text, top.children[0])


@dataclass(frozen=True, slots=True, eq=False)
class ChainStep:
    """One step of a chain: a transform, and after it a joint or none."""

    name: str  # of the element, for people
    line: int  # of it, from 1
    transform: Floats  # (4, 4) in the previous frame
    joint: Floats | None  # (4, 4) joint axis (its z) in the frame of `transform`; None without
    write: Callable[[Floats], Edits]  # edits for a new transform; InputError if impossible


@dataclass(frozen=True, slots=True, eq=False)
class FittedChain:
    """A chain with a corrected arm."""

    transforms: tuple[Floats, ...]  # (4, 4) new transform of each step
    tip: Floats  # (4, 4) from the flange of the arm to the tip of the file
    unrepresented: Floats  # (4, 4) transform after the last joint that the file cannot represent
    axis_distance: float  # largest distance of the file's axes from those of the nominal arm, m


def fitted_chain(steps: Sequence[ChainStep], nominal: Arm, arm: Arm, file: str) -> FittedChain:
    """Return the transforms of a file with a corrected arm."""
    turning = [k for k, s in enumerate(steps) if s.joint is not None]
    if len(turning) != arm.n:
        names = ", ".join(escaped(steps[k].name) for k in turning)
        raise InputError(
            f"{file}: {len(turning)} joints from base to tip ({names}), {nominal.name} has "
            f"{arm.n}; valid: --base-link and --tip-link that are the ends of the arm"
        )
    old, new = as_drawn(nominal).links, as_drawn(arm).links
    drawn, starts, axes = [], [], []
    last, joint = 0, np.eye(4)
    for k in (*turning, len(steps)):
        place, end = np.eye(4), np.eye(4)
        if k < len(steps):
            place, end = steps[k].transform, np.asarray(steps[k].joint)
        fixed = _product(steps[last:k])
        drawn.append(se3.inverse(joint) @ fixed @ place @ end)
        starts.append((joint, fixed))
        axes.append(end)
        last, joint = k + 1, end
    left, right, axis_distance = _frames(steps, turning, old, drawn, file, nominal.name)
    places = [s.transform for s in steps]
    unrepresented = np.eye(4)
    for k, (joint, fixed) in enumerate(starts):
        target = se3.inverse(left[k]) @ new[k] @ right[k]
        if k < len(turning):
            places[turning[k]] = se3.inverse(fixed) @ joint @ target @ se3.inverse(axes[k])
        elif len(steps) > turning[-1] + 1:
            following = _product(steps[turning[-1] + 2 :])
            places[turning[-1] + 1] = joint @ target @ se3.inverse(following)
        else:
            unrepresented = joint @ target
    return FittedChain(tuple(places), right[-1], unrepresented, axis_distance)


def _frames(
    steps: Sequence[ChainStep],
    turning: Sequence[int],
    old: Floats,
    drawn: Sequence[Floats],
    file: str,
    name: str,
) -> tuple[list[Floats], list[Floats], float]:
    """H_{−1} … H_{n−1}, G_0 … G_n, and the axis distance; raises as `fitted_chain` does."""
    half = np.diag([-1.0, -1.0, 1.0, 1.0])
    solutions: list[tuple[int, list[Floats], list[Floats], float]] = []
    misses: list[tuple[int, float, float]] = []
    for base in (np.eye(4), half):
        left, right, zeros, axis_distance = [base], [], 0, 0.0
        for k in range(len(turning)):
            g = se3.inverse(old[k]) @ left[-1] @ drawn[k]
            if k > 0 and not _near(g):
                # another zero: turn H about z until the next axis agrees, or its place if parallel
                column = 3 if np.hypot(*old[k][:2, 2]) <= NEAR_RAD else 2
                of_arm, of_file = old[k][:2, column], (left[-1] @ drawn[k])[:2, column]
                turn = np.arctan2(*of_arm[::-1]) - np.arctan2(*of_file[::-1])
                left[-1], zeros = se3.screw(2, float(turn)) @ left[-1], zeros + 1
                g = se3.inverse(old[k]) @ left[-1] @ drawn[k]
            if not _near(g):
                misses.append((k, *_axis_difference(g)))
                break
            axis_distance = max(axis_distance, _axis_difference(g)[0])
            turn = np.arctan2(g[1, 0] - g[0, 1], g[0, 0] + g[1, 1])
            right.append(se3.screw(2, turn, g[2, 3]))
            left.append(right[-1])
        else:
            tip = se3.inverse(old[-1]) @ left[-1] @ drawn[-1]
            tip = np.eye(4) if pose_difference(tip, np.eye(4)) < NEAR_M else tip
            solutions.append((zeros, left, [*right, tip], axis_distance))
    if not solutions:
        k, away, tilt = max(misses)
        step = steps[turning[k]]
        raise InputError(
            f"{file}: line {step.line}: the axis of {escaped(step.name)} lies {length(away)} and "
            f"{round(float(np.degrees(tilt)), 4):g}° from that of joint {k + 1} of {name}; valid: "
            "a description of the arm that was measured, from the link of its base on (--base-link)"
        )
    return min(solutions, key=lambda f: f[0])[1:]


def _near(g: Floats) -> bool:
    distance, tilt = _axis_difference(g)
    return distance < NEAR_M and tilt < NEAR_RAD


def _axis_difference(g: Floats) -> tuple[float, float]:
    """Distance and angle between the z axes of a frame and its reference, m and rad."""
    return float(np.hypot(*g[:2, 3])), float(np.arctan2(np.hypot(g[0, 2], g[1, 2]), g[2, 2]))


def edits_of(steps: Sequence[ChainStep], transforms: Sequence[Floats]) -> tuple[Edits, list[str]]:
    """Edits of all steps that change, and the names of these steps."""
    pairs = [
        (s, p)
        for s, p in zip(steps, transforms, strict=True)
        if pose_difference(s.transform, p) > EDIT_TOLERANCE
    ]
    return [edit for s, place in pairs for edit in s.write(place)], [s.name for s, _ in pairs]


def pose_difference(a: Floats, b: Floats) -> float:
    """Difference of two poses: distance in m or angle in rad, whichever is larger."""
    turn = se3.rotation_vector(a[:3, :3].T @ b[:3, :3])
    return float(max(np.linalg.norm(a[:3, 3] - b[:3, 3]), np.linalg.norm(turn)))


def z_to(axis: Floats) -> Floats:
    """(4, 4) smallest rotation of z to a unit vector; half a turn about x for −z."""
    about = np.cross([0.0, 0.0, 1.0], axis)
    size = float(np.linalg.norm(about))
    if size < 1e-12:
        return np.eye(4) if axis[2] > 0 else np.diag([1.0, -1.0, -1.0, 1.0])
    return se3.matrix(se3.rotation(np.arctan2(size, axis[2]) * about / size), np.zeros(3))


def numbers(values: Floats) -> str:
    """Numbers in a description's notation, to a nanometre or better."""
    return " ".join(f"{0.0 if abs(v) < 1e-13 else v:.12g}" for v in values.tolist())


def _product(steps: Sequence[ChainStep]) -> Floats:
    return reduce(np.matmul, (s.transform for s in steps), np.eye(4))
