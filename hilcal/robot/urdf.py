"""Arms from URDF files: serial chains of revolute and prismatic joints with any axes.

Joints may follow another one: `<mimic joint="i" multiplier="k" offset="o"/>`.
"""

import math
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO
from xml.parsers import expat

import numpy as np
import pinocchio as pin

from hilcal import limits
from hilcal.config import STANDARD_GRAVITY_M_S2
from hilcal.errors import InputError
from hilcal.names import check_name
from hilcal.robot import se3
from hilcal.robot.arm import Arm, description_gaps
from hilcal.toml import suggest
from hilcal.types import Bools, Floats

_WHOLE_TURN = 2.0 * math.pi
MOST_LEVEL = 0.9999  # cosine of the tilt from which a base is not level, 0.8°; a choice


def arm_from_urdf(path: Path, base_link: str | None = None, tip_link: str | None = None) -> Arm:
    """Read the arm between two links of a URDF; by default the root and the only leaf.

    With M_k the placement of joint k in its predecessor and R_k a rotation that takes z to the
    joint's axis, the constant transforms are L_0 = T_base_root M_1 R_1, L_k = R_kᵀ M_{k+1} R_{k+1}
    and L_n = R_nᵀ M_tip. Masses fixed to a moving link are merged into it; joints outside of the
    chain are held at zero. Continuous joints, and joints whose limits are both 0, get the range
    ±2π; an effort of 0 means unknown (infinite). `Arm.notes` lists what is missing. A joint of the
    chain that mimics another turns by multiplier · q_i + offset: this is a coupling of the arm, and
    the joint has no independent value (`Arm.mimic`).
    """
    model, mimics = _read(path)
    names = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    base, tip = base_link or names[0], tip_link or _only_leaf(model, path)
    for key, name in (("base_link", base), ("tip_link", tip)):
        if name not in names:
            raise InputError(
                f'{path.name}: {key} = "{name}" is no link{suggest(name, names)}; '
                f"valid: {', '.join(names)}"
            )
    chain = _chain(model, base, tip, path)
    outside = [joint for joint in range(1, model.njoints) if joint not in chain]
    reduced = pin.buildReducedModel(model, outside, pin.neutral(model))
    arm = _arm(reduced, _link(reduced, base).placement, _link(reduced, tip).placement, path)
    arm = replace(arm, notes=(*arm.notes, *_tilt(model, base, names[0], path.name)))
    return with_mimics(arm, mimics, path.name)


def _tilt(model: pin.Model, base: str, root: str, where: str) -> Iterator[str]:
    """Say what gravity is in the base link's axes, where fixed joints tilt it."""
    frame = _link(model, base)
    up = frame.placement.rotation.T @ np.array([0.0, 0.0, 1.0])
    if frame.parentJoint == 0 and up[2] < MOST_LEVEL:
        gravity = ", ".join(f"{x + 0.0:.4f}" for x in -STANDARD_GRAVITY_M_S2 * up)
        angle = math.degrees(math.acos(max(float(up[2]), -1.0)))
        yield (
            f'{where} tilts link "{base}" by {angle:.3g}°: where z of its link "{root}" is up, '
            f"[robot] gravity_m_s2 = [{gravity}]"
        )


def _arm(model: pin.Model, base: pin.SE3, tip: pin.SE3, path: Path) -> Arm:
    """Return the arm of a model of the chain's joints, with z of the frames along the axes."""
    joints = range(1, model.njoints)
    axes = _axes(model)
    slides = np.array([bool(np.any(axis[:3])) for axis in axes])
    turns = np.tile(np.eye(4), (len(axes), 1, 1))  # the smallest rotations that take z to the axes
    for turn, axis, slide in zip(turns, axes, slides, strict=True):
        direction = axis[:3] if slide else axis[3:]
        turn[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction).matrix()
    coms = [
        turn[:3, :3].T @ model.inertias[joint].lever
        for turn, joint in zip(turns, joints, strict=True)
    ]
    leading = [base.inverse().homogeneous, *(turn.T for turn in turns)]
    placements = [*(model.jointPlacements[joint].homogeneous for joint in joints), tip.homogeneous]
    trailing = [*turns, np.eye(4)]
    lower, upper, effort = zip(*(_limits(model, joint) for joint in joints), strict=True)
    masses = np.array([model.inertias[joint].mass for joint in joints])
    names = tuple(check_name(model.names[joint], f"{path.name}: a joint") for joint in joints)
    return Arm(
        name=path.stem,
        links=np.array([b @ m @ a for b, m, a in zip(leading, placements, trailing, strict=True)]),
        masses=masses, coms=np.array(coms), q_min=np.array(lower), q_max=np.array(upper),
        torque_max=np.array(effort), payload=math.inf, joint_names=names,
        source=f"URDF {path.name}", notes=_missing(model, masses, slides),
        prismatic=slides if slides.any() else None,
    )  # fmt: skip


def _missing(model: pin.Model, masses: Floats, slides: Bools) -> tuple[str, ...]:
    joints = [(str(model.names[j]), j) for j in range(1, model.njoints)]
    open_ended = [name for name, j in joints if _no_limits(model, j)]
    weak = [(n, j) for n, j in joints if not model.upperEffortLimit[model.joints[j].idx_v]]
    turning, sliding = ([n for n, j in weak if slides[j - 1] == s] for s in (False, True))
    return description_gaps("the URDF", bool(np.any(masses)), open_ended, turning, sliding)


def _no_limits(model: pin.Model, joint: int) -> bool:
    kind = model.joints[joint]
    if kind.nq != 1:
        return False
    return not model.lowerPositionLimit[kind.idx_q] and not model.upperPositionLimit[kind.idx_q]


def _limits(model: pin.Model, joint: int) -> tuple[float, float, float]:
    kind = model.joints[joint]
    effort = float(model.upperEffortLimit[kind.idx_v]) or math.inf
    if kind.nq != 1 or _no_limits(model, joint):  # continuous: Pinocchio keeps cosine and sine
        return -_WHOLE_TURN, _WHOLE_TURN, effort
    lower, upper = model.lowerPositionLimit[kind.idx_q], model.upperPositionLimit[kind.idx_q]
    return float(lower), float(upper), effort


def _axes(model: pin.Model) -> list[Floats]:
    """Return the unit twist (6,) of each joint's first degree of freedom, in its frame."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    frame = pin.ReferenceFrame.LOCAL
    return [
        # for a model with one degree of freedom, Pinocchio returns (6,)
        pin.getJointJacobian(model, data, joint, frame).reshape(6, -1)[:, model.joints[joint].idx_v]
        for joint in range(1, model.njoints)
    ]


def _chain(model: pin.Model, base: str, tip: str, path: Path) -> list[int]:
    start, joint = _link(model, base).parentJoint, _link(model, tip).parentJoint
    chain: list[int] = []
    while joint not in (start, 0):
        chain.insert(0, joint)
        joint = model.parents[joint]
    if joint != start or not chain:
        raise InputError(
            f'{path.name}: no moving joint leads from link "{base}" to link "{tip}"; '
            "set base_link and tip_link to the two ends of the arm"
        )
    axes = _axes(model)
    for joint in chain:
        name, slides = model.names[joint], bool(np.any(axes[joint - 1][:3]))
        if model.joints[joint].nv != 1 or (slides and np.any(axes[joint - 1][3:])):
            raise InputError(
                f'{path.name}: joint "{name}" has more than one degree of freedom; every moving '
                "joint of the arm must be revolute, continuous or prismatic"
            )
        if slides and _no_limits(model, joint):
            raise InputError(
                f'{path.name}: prismatic joint "{name}" has no <limit lower="..." upper="...">, '
                "in m; the length of a rail has to be known"
            )
    return chain


def _link(model: pin.Model, name: str) -> pin.Frame:
    return model.frames[model.getFrameId(name, pin.FrameType.BODY)]


def _only_leaf(model: pin.Model, path: Path) -> str:
    parents = {frame.parentFrame for frame in model.frames}
    leaves = [
        str(frame.name)
        for i, frame in enumerate(model.frames)
        if i not in parents and frame.parentJoint != 0
    ]
    if not leaves:
        raise InputError(
            f"{path.name}: no moving joint; expected an arm of joints that turn or slide"
        )
    if len(leaves) > 1:
        raise InputError(
            f"{path.name}: the chain branches; set tip_link to one of its leaf links "
            f"({', '.join(leaves)}) or to a link before them"
        )
    return leaves[0]


Mimic = tuple[str, str, str]  # <mimic>: joint to follow, multiplier, offset (rad or m)


@limits.bounded
def _read(path: Path) -> tuple[pin.Model, dict[str, Mimic]]:
    """Return Pinocchio's model, and the `<mimic>` elements by joint."""
    joints = moving = 0
    within, mimics = [""], dict[str, Mimic]()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal joints, moving
        if tag == "joint":
            within.append(attributes.get("name", ""))
            joints += 1
            moving += attributes.get("type") != "fixed"
        elif tag == "mimic":
            keys = {"joint": "", "multiplier": "1", "offset": "0"}
            leader, factor, offset = (attributes.get(key, usual) for key, usual in keys.items())
            mimics[within[-1]] = leader, factor, offset
        # Pinocchio recurses for each joint; its memory grows with the cube of the moving joints
        if joints > limits.DESCRIBED_JOINTS or moving > limits.MOVING_JOINTS:
            raise InputError(
                f"{path.name}: too many joints; valid: at most {limits.DESCRIBED_JOINTS}, "
                f"{limits.MOVING_JOINTS} of them not fixed"
            )

    def end(tag: str) -> None:
        if tag == "joint":
            within.pop()

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    try:
        missing = "no such file; expected a URDF file"
        parser.Parse(limits.read_bytes(path, limits.PROGRAM, missing), True)
    except expat.ExpatError as error:
        raise InputError(f"{path.name}: not XML: {error}; expected a URDF file") from None
    with _captured_stderr() as log:
        try:
            return pin.buildModelFromUrdf(str(path)), mimics
        except (ValueError, RuntimeError, IndexError) as error:
            log.seek(0)
            reasons = re.findall(r"Error:\s*(.+)", log.read())
            reason = reasons[0].strip() if reasons else " ".join(str(error).split())
    raise InputError(f"{path.name}: not a valid URDF: {reason}")


@contextmanager
def _captured_stderr() -> Iterator[IO[str]]:
    """Capture the output of the C++ parser to file descriptor 2, for a message."""
    sys.stderr.flush()
    saved = os.dup(2)
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as log:
        os.dup2(log.fileno(), 2)
        try:
            yield log
        finally:
            os.dup2(saved, 2)
            os.close(saved)


def with_mimics(arm: Arm, mimics: Mapping[str, Mimic], where: str) -> Arm:
    """Return the arm whose joints follow others, turned by their motors, as in a URDF."""
    names, n = list(arm.joint_names), arm.n
    follows = {names.index(name): mimic for name, mimic in mimics.items() if name in names}
    if not follows:
        return arm
    independent = [name for j, name in enumerate(names) if j not in follows]
    links, turns, values = arm.links.copy(), np.eye(n), np.eye(n, n + 1)
    for j, (leader, factor, shift) in follows.items():
        prefix = f'{where}: joint "{names[j]}" of the arm mimics joint "{leader}"'
        if leader not in independent:
            why = "which follows another one itself" if leader in names else "which is not there"
            raise InputError(
                f"{prefix}, {why}{suggest(leader, independent)}; valid: a joint between "
                f"base_link and tip_link with a value of its own: {', '.join(independent)}"
            )
        i = names.index(leader)
        turns[j], values[j] = 0.0, 0.0
        turns[j, i] = values[j, i] = float(factor)
        values[j, n] = offset = float(shift)
        if arm.slides[i] != arm.slides[j]:
            raise InputError(f"{prefix}, of which one slides and one turns; valid: two of a kind")
        links[j] = links[j] @ se3.screw(2, *((0.0, offset) if arm.slides[j] else (offset,)))
    return replace(arm, links=links, coupling=turns, drive=turns, mimic=values)
