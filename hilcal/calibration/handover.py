"""The constant part of an identified arm, and how others read it: URDF, UR's kinematics, frames.

URDF: fixed-axis roll, pitch, yaw and xyz of every joint's origin; every joint turns about its z.

UR's kinematics file (`ur_description`, `config/*/default_kinematics.yaml`; written for a single arm
by `ur_calibration`) has one origin per joint in the frames of that package: those of this program
moved along the joints' axes. The first one counts from `base_link_inertia`, which is the
controller's base (`base`), half a turn about z from `base_link`. It has no origin for the flange;
what cannot be moved before the last joint is part of the tool, see `frames`.

An effect whose deviation is the same in every state and under every load (an encoder's zero, a link
of another length or angle) goes into the constant transforms, from the declared base to the
declared flange, see `identification.robot_frames`. Everything else (compliances, waves of gears,
temperature) cannot, and is named.

A Denavit-Hartenberg table: between two joints every transform is, with the common normal of their
axes,


    L = Rz(φ) Tz(s) Tx(a) Rx(α) Tz(t) Rz(ψ)

and the parts about z join the joints' offsets and distances, so rows hold the relative places of
all axes exactly. Nearly parallel axes have a far common normal: d of both joints is large there,
and cancels. What rows cannot hold is where the first axis lies in the base, and how the flange sits
on the last one:

    T_base_flange = B Π_i row_i(q_i) E

with B without a part about z at its end, E without one at its beginning. They are stated beside the
rows, as `base_m_rad` and `flange_m_rad`.

Source: Craig, *Introduction to Robotics*, sections 3.3 and 3.4; Hayati, "Robot arm geometric link
parameter estimation", IEEE CDC 1983, for parallel axes.
"""

import csv
import hashlib
import io
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import tomli_w

from hilcal.calibration.calibration import Calibration
from hilcal.errors import CannotAnswerError, InputError
from hilcal.names import csv_text, escaped
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.types import Floats

Convention = Literal["standard", "modified"]
CONVENTIONS: tuple[Convention, ...] = ("standard", "modified")
PARALLEL = 1e-9
"""rad; axes at a smaller angle are taken for parallel, which moves the tool by a nanometre."""
CROSSED = 0.1
"""rad; from this angle on the end of a chain is part of the rows, as a link is; a choice."""
EXACT = 1e-9
"""m; differences below it are not worth a word."""
TRIALS = 200


@dataclass(frozen=True, slots=True, eq=False)
class DhRows:
    """A table of n joints."""

    convention: Convention  # of the rows, see `robot.dh.arm_from_dh`
    a: Floats  # (n,) m
    d: Floats  # (n,) m
    alpha: Floats  # (n,) rad
    offset: Floats  # (n,) rad
    base: Floats  # (4, 4) B
    flange: Floats  # (4, 4) E
    base_moves: float = 0.0  # most that the flange moves where B is left out, m
    flange_moves: float = 0.0  # the same of E, m
    table_moves: float = 0.0  # the same of both together
    disagreement: float = 0.0  # most that the flange is elsewhere with B and E, m: rounding
    slides: tuple[int, ...] = ()  # joints that slide, counted from 0: q adds to d


def dh_rows(arm: Arm, convention: Convention = "standard") -> DhRows:
    """Return the table of an arm.

    Args:
        convention: "standard" (classic) or "modified" (Craig) rows.
    """
    if arm.coupling is not None or arm.drive is not None:
        raise InputError(f"{arm.name}: joints are coupled, which a DH table cannot hold")
    n = arm.n
    before, after = np.zeros((n + 1, 2)), np.zeros((n + 1, 2))  # angle, distance along z
    across = np.zeros((n + 1, 2))  # a, α
    for k in range(1, n):
        before[k], across[k], after[k] = _common_normal(arm.links[k])
    base, flange = np.eye(4), np.eye(4)
    first, last = arm.links[0], arm.links[n]
    if convention == "modified" and _tilt(first) > CROSSED:
        start, across[0], after[0] = _common_normal(first)
        base = se3.screw(2, *start)
    else:
        after[0] = _twist_last(first)
        base = first @ se3.screw(2, *-after[0])
    if convention == "standard" and _tilt(last) > CROSSED:
        before[n], across[n], end = _common_normal(last)
        flange = se3.screw(2, *end)
    else:
        before[n] = twist_first(last)
        flange = se3.screw(2, *-before[n]) @ last
    along = after[:n] + before[1:]
    shift = 1 if convention == "standard" else 0
    a, alpha = across[shift : n + shift].T
    slides = tuple(np.flatnonzero(arm.slides).tolist())
    rows = DhRows(
        convention, a, along[:, 1], alpha, _wrapped(along[:, 0]), base, flange, slides=slides
    )
    return _judged(rows, arm)


def row_transforms(rows: DhRows, q: Floats) -> Floats:
    """(N, n, 4, 4) transforms of the rows at joint values (N, n), rad; m where joints slide."""
    out = np.empty((*q.shape, 4, 4))
    for k in range(q.shape[1]):
        across = se3.screw(0, rows.alpha[k], rows.a[k])
        for i, value in enumerate(q[:, k]):
            angle, travel = (0.0, value) if k in rows.slides else (value, 0.0)
            turn = se3.screw(2, angle + rows.offset[k], rows.d[k] + travel)
            out[i, k] = turn @ across if rows.convention == "standard" else across @ turn
    return out


def flange_poses(rows: DhRows, q: Floats, *, whole: bool = True) -> Floats:
    """(N, 4, 4) poses of the flange by the rows, with B and E unless `whole` is False."""
    place = np.broadcast_to(rows.base if whole else np.eye(4), (len(q), 4, 4))
    for part in np.moveaxis(row_transforms(rows, q), 1, 0):
        place = place @ part
    return np.asarray(place @ rows.flange if whole else place)


def to_csv(rows: DhRows, arm: Arm) -> str:
    """Return the rows alone, in m and rad."""
    stream = io.StringIO()
    out = csv.writer(stream, lineterminator="\n")
    out.writerow(("joint", "a_m", "d_m", "alpha_rad", "offset_rad"))
    numbers = zip(*(x.tolist() for x in (rows.a, rows.d, rows.alpha, rows.offset)), strict=True)
    for name, row in zip(arm.joint_names, numbers, strict=True):
        out.writerow((csv_text(name), *map(repr, row)))
    return stream.getvalue()


def to_toml(rows: DhRows, arm: Arm, title: str) -> str:
    """Return a file of the robot catalogue, which `[robot] model = "F.toml"` of a cell reads.

    Args:
        arm: gives masses, limits and payload; what its description lacks is left out.
    """
    com = _centres(rows, arm)
    content: dict[str, object] = {
        "title": escaped(title),
        **({"payload_kg": float(arm.payload)} if np.isfinite(arm.payload) else {}),
        "source": escaped(f"{arm.source}; corrected by calibration"),
        "convention": rows.convention,
        "base_m_rad": se3.six(rows.base),
        "flange_m_rad": se3.six(rows.flange),
    }
    if arm.repeatability is not None:
        content["repeatability_m"] = arm.repeatability
    content["joints"] = [
        {
            "name": escaped(arm.joint_names[k]),
            "a_m": float(rows.a[k]),
            "d_m": float(rows.d[k]),
            "alpha_deg": float(np.degrees(rows.alpha[k])),
            "offset_deg": float(np.degrees(rows.offset[k])),
            "mass_kg": float(arm.masses[k]),
            "com_m": com[k].tolist(),
            **_ranges(arm, k),
        }
        for k in range(arm.n)
    ]
    law = {
        "standard": "B * product of Rz(q + offset) Tz(d) Tx(a) Rx(alpha) * E",
        "modified": "B * product of Rx(alpha) Tx(a) Rz(q + offset) Tz(d) * E",
    }[rows.convention]
    head = (
        f"# T_base_flange = {law},\n"
        "# B = base_m_rad and E = flange_m_rad: x, y, z and rotation vector, m and rad. Programs\n"
        "# that read the rows alone put the flange up to "
        f"{1e3 * rows.table_moves:.4f} mm elsewhere.\n"
    )
    return head + tomli_w.dumps(content)


def _ranges(arm: Arm, k: int) -> dict[str, object]:
    """Kind, limits and torque of a joint, as a row has them."""
    low, high, torque = (float(x[k]) for x in (arm.q_min, arm.q_max, arm.torque_max))
    if arm.slides[k]:
        out: dict[str, object] = {"type": "prismatic", "q_min_m": low, "q_max_m": high}
        return out | ({"force_max_N": torque} if np.isfinite(torque) else {})
    out = {"q_min_deg": float(np.degrees(low)), "q_max_deg": float(np.degrees(high))}
    return out | ({"torque_max_Nm": torque} if np.isfinite(torque) else {})


def _judged(rows: DhRows, arm: Arm) -> DhRows:
    """Return the rows with what they cannot hold, at random joint values."""
    q = np.random.default_rng(20250309).uniform(-np.pi, np.pi, (TRIALS, arm.n))
    chain = evaluate(arm, q)
    there = se3.matrix(chain.rotation[-1], chain.position[-1])
    held = flange_poses(rows, q, whole=False)

    def moved(poses: Floats) -> float:
        return float(np.linalg.norm((poses - there)[:, :3, 3], axis=1).max())

    return DhRows(
        rows.convention, rows.a, rows.d, rows.alpha, rows.offset, rows.base, rows.flange,
        base_moves=moved(held @ rows.flange),
        flange_moves=moved(rows.base @ held),
        table_moves=moved(held),
        disagreement=moved(rows.base @ held @ rows.flange),
        slides=rows.slides,
    )  # fmt: skip


def _centres(rows: DhRows, arm: Arm) -> Floats:
    """(n, 3) centres of mass in DH frame i, after row i."""
    parts = row_transforms(rows, np.zeros((1, arm.n)))[0]
    body, frame, out = np.eye(4), rows.base, np.empty((arm.n, 3))
    for k in range(arm.n):
        body, frame = body @ arm.links[k], frame @ parts[k]
        point = body[:3, :3] @ arm.coms[k] + body[:3, 3]
        out[k] = frame[:3, :3].T @ (point - frame[:3, 3])
    return out


def _common_normal(link: Floats) -> tuple[Floats, Floats, Floats]:
    """(φ, s), (a, α) and (ψ, t) of a transform; φ within a quarter turn."""
    x, y, z = link[:3, 2]
    sine = float(np.hypot(x, y))
    p = link[:3, 3]
    if sine > PARALLEL:
        phi, alpha = np.arctan2(x, -y), np.arctan2(sine, z)
    else:
        phi = np.arctan2(p[1], p[0]) if np.hypot(p[0], p[1]) > 0 else 0.0
        alpha = 0.0 if z > 0 else np.pi
    if abs(phi) > np.pi / 2 + 1e-9:
        phi -= np.copysign(np.pi, phi)
        alpha = -alpha
    across = np.array([np.cos(phi), np.sin(phi), 0.0])
    a = float(across @ p)
    t = 0.0
    if sine > PARALLEL:
        t = float(across[1] * p[0] - across[0] * p[1]) / np.sin(alpha)
    s = float(p[2] - t * np.cos(alpha))
    turned = (se3.screw(2, phi) @ se3.screw(0, alpha))[:3, :3].T @ link[:3, :3]
    psi = np.arctan2(turned[1, 0], turned[0, 0])
    return np.array([phi, s]), np.array([a, alpha]), np.array([psi, t])


def twist_first(link: Floats) -> Floats:
    """Angle and distance of Rz Tz at the beginning of a transform, the rest having none."""
    return np.array([_about_z(link), link[2, 3]])


def _twist_last(link: Floats) -> Floats:
    """Angle and distance of Rz Tz at the end of a transform, the rest having none."""
    return np.array([_about_z(link), link[:3, 2] @ link[:3, 3]])


def _about_z(link: Floats) -> float:
    """Part of a rotation about z, the other being about a horizontal axis."""
    from scipy.spatial.transform import Rotation  # slow to import

    z, w = Rotation.from_matrix(link[:3, :3]).as_quat()[2:]
    return float(2.0 * np.arctan2(z, w)) if np.hypot(z, w) > 1e-9 else 0.0


def _tilt(link: Floats) -> float:
    return float(np.arctan2(np.hypot(link[0, 2], link[1, 2]), abs(link[2, 2])))


def _wrapped(angle: Floats) -> Floats:
    """Angles within half a turn; those that are nothing but rounding are zero."""
    out = angle - 2 * np.pi * np.rint(angle / (2 * np.pi))
    return np.where(np.abs(out) < 1e-15, 0.0, out)


UR_JOINTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
FULL_TURN = 2 * np.pi


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """An arm with what is constant of a calibration."""

    arm: Arm
    within: tuple[str, ...]  # effects that it contains
    beyond: tuple[str, ...]  # effects that it does not contain


def corrected(calibration: Calibration) -> Corrected:
    """Return the arm with the constant effects of a calibration in its transforms.

    Raises:
        CannotAnswerError: the calibration is of deflections, which do not show constant errors.
        InputError: joints of the arm are coupled.
    """
    if calibration.mode == "deflection":
        raise CannotAnswerError(
            "a calibration of deflections knows nothing of the unloaded arm's geometry; fit "
            "absolute readings: hilcal identify RUN --readings absolute"
        )
    arm = calibration.model.cell.arm
    if arm.coupling is not None or arm.drive is not None:
        raise InputError(f"{arm.name}: joints are coupled, which constant transforms cannot hold")
    found = calibration.frames
    return Corrected(replace(arm, links=found.links), found.within, found.beyond)


def urdf(arm: Arm, note: str = "") -> str:
    """Return an arm as URDF: links base_link, link_1 ..., tool0."""
    root = Element("robot", name=escaped(arm.name))
    SubElement(root, "link", name="base_link")
    links = ["base_link", *(f"link_{k}" for k in range(1, arm.n + 1)), "tool0"]
    for k in range(arm.n):
        link = SubElement(root, "link", name=links[k + 1])
        if arm.masses[k] > 0:
            _inertial(link, float(arm.masses[k]), arm.coms[k])
    SubElement(root, "link", name="tool0")
    for k, place in enumerate(arm.links):
        fixed = k == arm.n
        name = "flange" if fixed else escaped(arm.joint_names[k])
        kind = "fixed" if fixed else "prismatic" if arm.slides[k] else "revolute"
        joint = SubElement(root, "joint", name=name, type=kind)
        xyz, rpy = origin_of(place)
        SubElement(joint, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy))
        SubElement(joint, "parent", link=links[k])
        SubElement(joint, "child", link=links[k + 1])
        if not fixed:
            SubElement(joint, "axis", xyz="0 0 1")
            _limit(joint, arm, k)
    indent(root)
    comment = f"<!-- {re.sub('-(?=-)', '- ', escaped(note))} -->\n" if note else ""
    return f'<?xml version="1.0"?>\n{comment}{tostring(root, encoding="unicode")}\n'


def matlab(arm: Arm, name: str, note: str = "") -> str:
    """Return a MATLAB function that builds an arm as a `rigidBodyTree` (Robotics System Toolbox).

    Bodies base, link_1 …, tool0; each joint turns about z of its fixed transform.
    """
    out = [f"function robot = {name}()"]
    out += [f"% {escaped(line)}" for line in note.split("\n")]
    out += [
        f"robot = rigidBodyTree('DataFormat', 'row', 'MaxNumBodies', {arm.n + 1});",
        "robot.Gravity = [0 0 -9.80665];",
    ]
    for k, place in enumerate(arm.links):
        moving = k < arm.n
        body, kind = (f"link_{k + 1}", "revolute") if moving else ("tool0", "fixed")
        joint = escaped(arm.joint_names[k]).replace("'", "''") if moving else "flange"
        out += [
            "",
            f"body = rigidBody('{body}');",
            f"joint = rigidBodyJoint('{joint}', '{kind}');",
            f"setFixedTransform(joint, [{'; '.join(_numbers(row) for row in place)}]);",
        ]
        if moving:
            low, high = float(arm.q_min[k]), float(arm.q_max[k])
            known = np.isfinite(low) and np.isfinite(high)
            limits = (low, high) if known else (-FULL_TURN, FULL_TURN)
            home = min(max(0.0, limits[0]), limits[1])
            out += [
                "joint.JointAxis = [0 0 1];",
                f"joint.PositionLimits = [{limits[0]:.17g} {limits[1]:.17g}];",
                f"joint.HomePosition = {home:.17g};",
            ]
        mass, com = (float(arm.masses[k]), arm.coms[k]) if moving else (0.0, np.zeros(3))
        square = mass * (com @ com * np.eye(3) - np.outer(com, com)) + 0.4 * mass * 0.01 * np.eye(3)
        inertia = square[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
        out += [
            f"body.Mass = {mass:.17g};",
            f"body.CenterOfMass = [{_numbers(com)}];",
            f"body.Inertia = [{_numbers(inertia)}];",
            "body.Joint = joint;",
            f"addBody(robot, body, '{'base' if k == 0 else f'link_{k}'}');",
        ]
    return "\n".join([*out, "end", ""])


def ur_kinematics(
    nominal: Arm, arm: Arm, note: str = "", digest: str | None = None
) -> tuple[str, Floats]:
    """Return UR's kinematics file, and (4, 4) from its last frame to the flange.

    Args:
        digest: the driver's name of the connected arm's own calibration, "calib_…"; the driver logs
            an error where the file has another. One of the file's content where None.
    """
    if not nominal.name.startswith("ur") or arm.n != len(UR_JOINTS):
        raise InputError(f"{nominal.name}: UR's kinematics file is for UR arms")
    if digest is not None and not re.fullmatch(r"calib_\d+", digest):
        raise InputError(
            f"--ur-hash {digest!r}; valid: calib_ and digits, the last line of the file that "
            "ur_calibration writes, or of the driver's message"
        )
    shift = np.zeros(arm.n)
    for k in (0, 3, 4):  # the frames of the package lie that far along the axes
        shift[k] = nominal.links[k + 1][2, 3]
    turn, shift[-1] = twist_first(arm.links[-1])  # a turn about the last axis can be made before it
    lines = ["kinematics:"]
    for k, name in enumerate(UR_JOINTS):
        before = np.eye(4) if k == 0 else se3.screw(2, 0.0, -shift[k - 1])
        after = se3.screw(2, turn if k == arm.n - 1 else 0.0, shift[k])
        xyz, rpy = origin_of(before @ arm.links[k] @ after)
        lines.append(f"  {name}:")
        keys = ("x", "y", "z", "roll", "pitch", "yaw")
        lines += [f"    {key}: {_yaml(v)}" for key, v in zip(keys, (*xyz, *rpy), strict=True)]
    own = int.from_bytes(hashlib.sha256("\n".join(lines).encode()).digest()[:8])
    lines.append(f"  hash: {digest or f'calib_{own}'}")
    comment = [f"# {escaped(line)}" for line in note.split("\n")]
    return "\n".join([*comment, *lines]) + "\n", se3.screw(2, -turn, -shift[-1]) @ arm.links[-1]


def frames(calibration: Calibration, found: Corrected, beyond_flange: Floats | None) -> str:
    """Return the frames that a controller asks for, as JSON: x, y, z, rx, ry, rz in m and rad.

    `base_in_tracker` is the one base of all that is handed out, `base_is` how it is known.
    `tool_on_flange` is that of the corrected arm. A controller computes with its own arm: its tool
    centre point has the constant part of the last link with it, under "controller", in m and, as
    PolyScope shows them, in mm.

    Args:
        beyond_flange: (4, 4) from the last frame of UR's kinematics file to the flange; None where
            that file is not written.
    """
    tool, base = calibration.tool_pose(), calibration.base_in_tracker()
    nominal, arm = calibration.model.cell.arm, found.arm
    tcp = se3.inverse(nominal.links[-1]) @ arm.links[-1] @ tool
    tracker = se3.inverse(base)
    document = {
        "arm": nominal.name,
        "tool_on_flange": se3.six(tool),
        "base_in_tracker": se3.six(base),
        "base_is": calibration.frames.base_is,
        "in_transforms": list(found.within),
        "not_in_transforms": list(found.beyond),
        "controller": {
            "tcp_m_rad": se3.six(tcp),
            "tcp_mm_rad": _millimetres(tcp),
            "urscript": f"set_tcp(p[{', '.join(f'{v:.9f}' for v in se3.six(tcp))}])",
            "base_in_tracker_m_rad": se3.six(base),
            "tracker_in_base_m_rad": se3.six(tracker),
            "tracker_in_base_mm_rad": _millimetres(tracker),
        },
    }
    if beyond_flange is not None:
        document["tcp_for_ur_kinematics"] = se3.six(beyond_flange @ tool)
    return json.dumps(document, indent=1) + "\n"


def _millimetres(pose: Floats) -> list[float]:
    """Position in mm to 0.1 nm and rotation vector in rad, as a person types them."""
    values = se3.six(pose)
    return [round(1e3 * v, 7) for v in values[:3]] + [round(v, 9) for v in values[3:]]


def origin_of(place: Floats) -> tuple[Floats, Floats]:
    """Position and fixed-axis roll, pitch, yaw of a pose (4, 4), exact also at pitch ±90°."""
    from scipy.spatial.transform import Rotation  # slow to import

    r = place[:3, :3]
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    roll = np.arctan2(r[2, 1], r[2, 2])
    # The rest turns about z, whatever roll rounding chose.
    rest = r @ Rotation.from_euler("xyz", [roll, pitch, 0.0]).as_matrix().T
    yaw = np.arctan2(rest[1, 0] - rest[0, 1], rest[0, 0] + rest[1, 1])
    return place[:3, 3], np.array([roll, pitch, yaw])


def _yaml(value: float) -> str:
    """Return a number with a point: readers of YAML 1.1 take 1e-05 for text."""
    text = f"{value:.17g}"
    mantissa, e, exponent = text.partition("e")
    return text if "." in mantissa else f"{mantissa}.0{e}{exponent}"


def _numbers(values: Floats) -> str:
    return " ".join(f"{v:.17g}" for v in values)


def _inertial(link: Element, mass: float, com: Floats) -> None:
    """Add mass and centre of mass; moments of inertia are not known: those of a ball of 10 cm."""
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=_numbers(com), rpy="0 0 0")
    SubElement(inertial, "mass", value=f"{mass:.17g}")
    ball = f"{0.4 * mass * 0.1**2:.6g}"
    zeros = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    SubElement(inertial, "inertia", {"ixx": ball, "iyy": ball, "izz": ball, **zeros})


def _limit(joint: Element, arm: Arm, k: int) -> None:
    """Add limits; an unknown torque is 0, as `arm_from_urdf` reads it."""
    known: Iterator[float] = (float(x[k]) for x in (arm.q_min, arm.q_max, arm.torque_max))
    low, high, torque = known
    SubElement(
        joint,
        "limit",
        lower=f"{low if np.isfinite(low) else -FULL_TURN:.17g}",
        upper=f"{high if np.isfinite(high) else FULL_TURN:.17g}",
        effort=f"{torque if np.isfinite(torque) else 0.0:.17g}",
        velocity="3.14",
    )
