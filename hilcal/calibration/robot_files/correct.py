"""Correction of a user's robot description, of any supported kind."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.calibration.dh_table import dh_rows
from hilcal.calibration.handover import CorrectedArm
from hilcal.calibration.programs.program import Span, edited
from hilcal.calibration.robot_files.chain_text import (
    EDIT_TOLERANCE,
    FRAME_TOLERANCE,
    edits_of,
    fitted_chain,
    pose_difference,
    read_xml,
)
from hilcal.calibration.robot_files.link_trees import sdf_chain, urdf_steps
from hilcal.calibration.robot_files.mjcf_text import mjcf_steps
from hilcal.errors import InputError
from hilcal.numbers import length
from hilcal.robot.arm import Arm

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
        f"flange on the last axis (up to {length(new.flange_moves)})"
    )
    return CorrectedFile(edited(text, edits).encode("latin-1"), note)
