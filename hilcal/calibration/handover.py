"""The constant part of an identified arm as URDF, MATLAB, UR's kinematics file, and frames.

URDF: fixed-axis roll, pitch, yaw and xyz of every joint's origin; every joint turns about its z.

UR's kinematics file (`ur_description`, `config/*/default_kinematics.yaml`; written for a single arm
by `ur_calibration`) has one origin per joint in the frames of that package, which are those of this
program moved along the joints' axes. The first origin is relative to `base_link_inertia`, which is
the controller's base (`base`), half a turn about z from `base_link`. The file has no origin for the
flange; the part of the last transform that cannot move before the last joint belongs to the tool,
see `frames`.

An effect whose deviation is the same in every state and under every load (an encoder's zero, a link
of another length or angle) goes into the constant transforms, from the declared base to the
declared flange, see `identification.registration.robot_frames`. All other effects (compliances,
gear waves, temperature) are listed as not included.
"""

import hashlib
import json
import re
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.dh_table import twist_first
from hilcal.errors import CannotAnswerError, InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Floats

UR_JOINTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
FULL_TURN = 2 * np.pi


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedArm:
    """An arm with the constant effects of a calibration."""

    arm: Arm
    included: tuple[str, ...]  # effects that it contains
    not_included: tuple[str, ...]  # effects that it does not contain


def corrected_arm(calibration: Calibration) -> CorrectedArm:
    """Return the arm with the constant effects of a calibration in its transforms.

    Raises:
        CannotAnswerError: the calibration is of deflections, which do not show constant errors.
        InputError: joints are coupled.
    """
    if calibration.mode == "deflection":
        raise CannotAnswerError(
            "a calibration of deflections knows nothing of the unloaded arm's geometry; fit "
            "absolute readings: hilcal identify RUN --readings absolute"
        )
    arm = calibration.model.cell.arm
    if arm.coupling is not None or arm.drive is not None:
        raise InputError(f"{arm.name}: joints are coupled, which constant transforms cannot hold")
    robot = calibration.frames
    return CorrectedArm(
        replace(arm, links=robot.links), robot.constant_effects, robot.other_effects
    )


def urdf(arm: Arm, note: str = "") -> str:
    """Return an arm as URDF with links base_link, link_1 …, tool0."""
    root = Element("robot", name=escaped(arm.name))
    SubElement(root, "link", name="base_link")
    links = ["base_link", *(f"link_{k}" for k in range(1, arm.n + 1)), "tool0"]
    for k in range(arm.n):
        link = SubElement(root, "link", name=links[k + 1])
        if arm.masses[k] > 0:  # moments of inertia are those of a ball of 10 cm
            inertial, ball = SubElement(link, "inertial"), f"{0.4 * arm.masses[k] * 0.1**2:.6g}"
            SubElement(inertial, "origin", xyz=_numbers(arm.coms[k]), rpy="0 0 0")
            SubElement(inertial, "mass", value=f"{arm.masses[k]:.17g}")
            moments = dict.fromkeys(("ixx", "iyy", "izz"), ball)
            SubElement(inertial, "inertia", moments | dict.fromkeys(("ixy", "ixz", "iyz"), "0"))
    SubElement(root, "link", name="tool0")
    for k, transform in enumerate(arm.links):
        fixed = k == arm.n
        name = "flange" if fixed else escaped(arm.joint_names[k])
        kind = "fixed" if fixed else "prismatic" if arm.slides[k] else "revolute"
        joint = SubElement(root, "joint", name=name, type=kind)
        xyz, rpy = origin_of(transform)
        SubElement(joint, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy))
        SubElement(joint, "parent", link=links[k])
        SubElement(joint, "child", link=links[k + 1])
        if not fixed:
            SubElement(joint, "axis", xyz="0 0 1")
            values = float(arm.q_min[k]), float(arm.q_max[k]), float(arm.torque_max[k])
            # `arm_from_urdf` reads 0 as an unknown torque
            low, high, torque = (
                f"{v if np.isfinite(v) else unknown:.17g}"
                for v, unknown in zip(values, (-FULL_TURN, FULL_TURN, 0.0), strict=True)
            )
            SubElement(joint, "limit", lower=low, upper=high, effort=torque, velocity="3.14")
    indent(root)
    comment = f"<!-- {re.sub('-(?=-)', '- ', escaped(note))} -->\n" if note else ""
    return f'<?xml version="1.0"?>\n{comment}{tostring(root, encoding="unicode")}\n'


def matlab(arm: Arm, name: str, note: str) -> str:
    """Return a MATLAB function that builds an arm as a `rigidBodyTree` (Robotics System Toolbox).

    Bodies base, link_1 …, tool0; each joint turns about z of its fixed transform.
    """
    comment = "\n".join(f"% {escaped(line)}" for line in note.split("\n"))
    out = f"""function robot = {name}()
{comment}
robot = rigidBodyTree('DataFormat', 'row', 'MaxNumBodies', {arm.n + 1});
robot.Gravity = [0 0 -9.80665];
"""
    for k, transform in enumerate(arm.links):
        moving = k < arm.n
        body, kind = (f"link_{k + 1}", "revolute") if moving else ("tool0", "fixed")
        joint = escaped(arm.joint_names[k]).replace("'", "''") if moving else "flange"
        out += f"""
body = rigidBody('{body}');
joint = rigidBodyJoint('{joint}', '{kind}');
setFixedTransform(joint, [{"; ".join(map(_numbers, transform))}]);
"""
        if moving:
            low, high = float(arm.q_min[k]), float(arm.q_max[k])
            limited = np.isfinite(low) and np.isfinite(high)
            limits = (low, high) if limited else (-FULL_TURN, FULL_TURN)
            home = min(max(0.0, limits[0]), limits[1])
            out += f"""joint.JointAxis = [0 0 1];
joint.PositionLimits = [{limits[0]:.17g} {limits[1]:.17g}];
joint.HomePosition = {home:.17g};
"""
        mass, com = (arm.masses[k], arm.coms[k]) if moving else (0.0, np.zeros(3))
        square = mass * (com @ com * np.eye(3) - np.outer(com, com)) + 0.4 * mass * 0.01 * np.eye(3)
        inertia = square[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
        out += f"""body.Mass = {mass:.17g};
body.CenterOfMass = [{_numbers(com)}];
body.Inertia = [{_numbers(inertia)}];
body.Joint = joint;
addBody(robot, body, '{"base" if k == 0 else f"link_{k}"}');
"""
    return f"{out}end\n"


def ur_kinematics(
    nominal: Arm, arm: Arm, note: str = "", digest: str | None = None
) -> tuple[str, Floats]:
    """Return UR's kinematics file, and (4, 4) from its last frame to the flange.

    `digest` is the driver's name of the connected arm's calibration, "calib_…"; the driver logs an
    error if the file has another. If None, a hash of the file's content is used.
    """
    if not nominal.name.startswith("ur") or arm.n != len(UR_JOINTS):
        raise InputError(f"{nominal.name}: UR's kinematics file is for UR arms")
    if digest is not None and not re.fullmatch(r"calib_\d+", digest):
        raise InputError(
            f"--ur-hash {digest!r}; valid: calib_ and digits, the last line of the file that "
            "ur_calibration writes, or of the driver's message"
        )
    shift = np.zeros(arm.n)
    for k in (0, 3, 4):  # offsets of the package's frames along the axes
        shift[k] = nominal.links[k + 1][2, 3]
    turn, shift[-1] = twist_first(arm.links[-1])  # a turn about the last axis may precede it
    lines = ["kinematics:"]
    for k, name in enumerate(UR_JOINTS):
        to_frame = np.eye(4) if k == 0 else se3.screw(2, 0.0, -shift[k - 1])
        from_frame = se3.screw(2, turn if k == arm.n - 1 else 0.0, shift[k])
        xyz, rpy = origin_of(to_frame @ arm.links[k] @ from_frame)
        lines.append(f"  {name}:")
        keys = ("x", "y", "z", "roll", "pitch", "yaw")
        lines += [f"    {key}: {_yaml(v)}" for key, v in zip(keys, (*xyz, *rpy), strict=True)]
    content_hash = int.from_bytes(hashlib.sha256("\n".join(lines).encode()).digest()[:8])
    lines.append(f"  hash: {digest or f'calib_{content_hash}'}")
    comment = [f"# {escaped(line)}" for line in note.split("\n")]
    return "\n".join([*comment, *lines]) + "\n", se3.screw(2, -turn, -shift[-1]) @ arm.links[-1]


def frames(
    calibration: Calibration, corrected_arm: CorrectedArm, beyond_flange: Floats | None
) -> str:
    """Return the frames that a controller asks for, as JSON: x, y, z, rx, ry, rz in m and rad.

    `base_in_tracker` is the base of everything that is exported, `base_is` its origin.
    `tool_on_flange` is of the corrected arm. A controller computes with its own arm: under
    "controller", its tool centre point includes the constant part of the last link, in m and, as
    PolyScope shows it, in mm. `beyond_flange` (4, 4) is what `ur_kinematics` returns, or None.
    """
    tool, base = calibration.tool_pose(), calibration.base_in_tracker()
    nominal, arm = calibration.model.cell.arm, corrected_arm.arm
    tcp = se3.inverse(nominal.links[-1]) @ arm.links[-1] @ tool
    tracker = se3.inverse(base)
    document = {
        "arm": nominal.name,
        "tool_on_flange": se3.six(tool),
        "base_in_tracker": se3.six(base),
        "base_is": calibration.frames.base_is,
        "in_transforms": list(corrected_arm.included),
        "not_in_transforms": list(corrected_arm.not_included),
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
    """Position in mm to 0.1 nm and rotation vector in rad, to be typed at a pendant."""
    values = se3.six(pose)
    return [round(1e3 * v, 7) for v in values[:3]] + [round(v, 9) for v in values[3:]]


def origin_of(transform: Floats) -> tuple[Floats, Floats]:
    """Position and fixed-axis roll, pitch, yaw of a pose (4, 4), exact also at pitch ±90°."""
    from scipy.spatial.transform import Rotation  # slow to import

    r = transform[:3, :3]
    pitch = np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))
    roll = np.arctan2(r[2, 1], r[2, 2])
    # the remaining rotation is about z, even where rounding decides the roll
    about_z = r @ Rotation.from_euler("xyz", [roll, pitch, 0.0]).as_matrix().T
    yaw = np.arctan2(about_z[1, 0] - about_z[0, 1], about_z[0, 0] + about_z[1, 1])
    return transform[:3, 3], np.array([roll, pitch, yaw])


def _yaml(value: float) -> str:
    """Return a number with a decimal point: YAML 1.1 reads 1e-05 as text."""
    text = f"{value:.17g}"
    mantissa, e, exponent = text.partition("e")
    return text if "." in mantissa else f"{mantissa}.0{e}{exponent}"


def _numbers(values: Floats) -> str:
    return " ".join(f"{v:.17g}" for v in values)
