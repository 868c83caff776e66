"""A corrected arm as others read it: URDF, the kinematics file of UR's ROS driver, frames.

URDF: fixed-axis roll, pitch, yaw and xyz of every joint's origin; every joint turns about its z.

UR's kinematics file (`ur_description`, `config/*/default_kinematics.yaml`; written for a single arm
by `ur_calibration`) has one origin per joint in the frames of that package: those of this program
moved along the joints' axes. It has none for the flange; what is left there is part of the tool,
see `frames`. Its hash is not that of the controller's own calibration, which the driver warns of.
"""

import hashlib
import json
from collections.abc import Iterator
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from scipy.spatial.transform import Rotation

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.corrected import Corrected
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Floats

UR_JOINTS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
FULL_TURN = 2 * np.pi


def urdf(arm: Arm, note: str = "") -> str:
    """Return an arm as URDF: links base_link, link_1 ..., tool0.

    Args:
        arm: without couplings.
        note: stands in a comment at the top.
    """
    root = Element("robot", name=arm.name)
    SubElement(root, "link", name="base_link")
    links = ["base_link", *(f"link_{k}" for k in range(1, arm.n + 1)), "tool0"]
    for k in range(arm.n):
        link = SubElement(root, "link", name=links[k + 1])
        if arm.masses[k] > 0:
            _inertial(link, float(arm.masses[k]), arm.coms[k])
    SubElement(root, "link", name="tool0")
    for k, place in enumerate(arm.links):
        fixed = k == arm.n
        name = "flange" if fixed else arm.joint_names[k]
        joint = SubElement(root, "joint", name=name, type="fixed" if fixed else "revolute")
        xyz, rpy = _origin(place)
        SubElement(joint, "origin", xyz=_numbers(xyz), rpy=_numbers(rpy))
        SubElement(joint, "parent", link=links[k])
        SubElement(joint, "child", link=links[k + 1])
        if not fixed:
            SubElement(joint, "axis", xyz="0 0 1")
            _limit(joint, arm, k)
    indent(root)
    comment = f"<!-- {note.replace('--', '- -')} -->\n" if note else ""
    return f'<?xml version="1.0"?>\n{comment}{tostring(root, encoding="unicode")}\n'


def ur_kinematics(nominal: Arm, arm: Arm) -> tuple[str, Floats]:
    """Return UR's kinematics file, and (4, 4) from its last frame to the flange.

    Args:
        nominal: the arm of the catalogue.
        arm: the corrected one.

    Raises:
        InputError: it is no UR arm.
    """
    if not nominal.name.startswith("ur") or arm.n != len(UR_JOINTS):
        raise InputError(f"{nominal.name}: UR's kinematics file is for UR arms")
    shift = np.zeros(arm.n)
    for k in (0, 3, 4, 5):  # the frames of the package lie that far along the axes
        shift[k] = nominal.links[k + 1][2, 3]
    lines = ["kinematics:"]
    for k, name in enumerate(UR_JOINTS):
        before = np.eye(4) if k == 0 else _along(-shift[k - 1])
        xyz, rpy = _origin(before @ arm.links[k] @ _along(shift[k]))
        lines.append(f"  {name}:")
        keys = ("x", "y", "z", "roll", "pitch", "yaw")
        lines += [f"    {key}: {v:.17g}" for key, v in zip(keys, (*xyz, *rpy), strict=True)]
    digest = int.from_bytes(hashlib.sha256("\n".join(lines).encode()).digest()[:8])
    lines.append(f"  hash: calib_{digest}")
    return "\n".join(lines) + "\n", _along(-shift[-1]) @ arm.links[-1]


def frames(calibration: Calibration, found: Corrected, beyond_flange: Floats | None) -> str:
    """Return the frames that a controller asks for, as JSON: x, y, z, rx, ry, rz in m and rad.

    Args:
        calibration: the calibration.
        found: its corrected arm.
        beyond_flange: (4, 4) from the last frame of UR's kinematics file to the flange; None where
            that file is not written.
    """
    tool = calibration.tool_pose()
    document = {
        "arm": calibration.model.cell.arm.name,
        "tool_on_flange": _six(tool),
        "base_in_tracker": _six(calibration.base_in_tracker()),
        "in_transforms": list(found.within),
        "not_in_transforms": list(found.beyond),
    }
    if beyond_flange is not None:
        document["tcp_for_ur_kinematics"] = _six(beyond_flange @ tool)
    return json.dumps(document, indent=1) + "\n"


def _six(pose: Floats) -> list[float]:
    return [*pose[:3, 3].tolist(), *se3.rotation_vector(pose[:3, :3]).tolist()]


def _along(z: float) -> Floats:
    out = np.eye(4)
    out[2, 3] = z
    return out


def _origin(place: Floats) -> tuple[Floats, Floats]:
    """Position and fixed-axis roll, pitch, yaw of a pose (4, 4)."""
    return place[:3, 3], Rotation.from_matrix(place[:3, :3]).as_euler("xyz")


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
