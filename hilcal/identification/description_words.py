"""What is wrong with a description, as the line of an error and as JSON."""

import json
from dataclasses import asdict

import numpy as np

from hilcal.cell import Cell
from hilcal.config.joints import Conventions
from hilcal.errors import InputError
from hilcal.identification.description import Change
from hilcal.identification.gate import Explanation, Finding, examine
from hilcal.identification.registration import Registration
from hilcal.numbers import length
from hilcal.readings.readings import Readings

SIGN, OFFSET, COUPLING = Conventions.model_fields
"""Keys that say how joints are counted, in their order there."""
MOST_NAMED = 8
"""Rows, or explanations, that are named; a choice."""
TRIED = (
    "signs, zeros, couplings and columns of the joints, units, shifted rows, mirrored axes, "
    "inverse poses, other arms, alone and in combination"
)


def refuse_misdescribed(registered: Registration, readings: Readings) -> None:
    """Refuse readings that do not fit the description of the arm, before anything is fitted.

    Raises:
        InputError: says what is wrong with the description, where that was found.
    """
    finding = examine(registered, readings)
    if finding is not None and finding.refused:
        raise InputError(words(finding, registered.cell, readings))


def words(finding: Finding, cell: Cell, readings: Readings) -> str:
    """Return in one line what is wrong, and what to write instead."""
    size = length(finding.rms)
    begin = f"the readings do not fit the description of the arm ({size} rms after registration)"
    rows = _rows(finding, readings)
    if finding.explanations:
        said = [_explained(e, finding, cell) for e in finding.explanations[:MOST_NAMED]]
        line = f"{begin}: {'; or, as well: '.join(said)}"
        return f"{line}; besides, {rows}" if rows else line
    if rows and not finding.refused:
        return f"{rows}; the others fit ({size} rms after registration). They are left out of a fit"
    if rows:
        return f"{begin}: {rows}; the others fit. Correct or remove them"
    return (
        f"{begin}; at most {length(finding.gate)} is fitted. Nothing that was tried explains it "
        f"({finding.tried} descriptions: {TRIED}). Check the robot's model, and that joints and "
        "positions in one row belong together"
    )


def _explained(e: Explanation, finding: Finding, cell: Cell) -> str:
    what = " and ".join(_said(c) for c in e.changes)
    change = f"{length(finding.rms)} → {length(e.rms)} with it"
    return f"{what}: {change}{_remedy(e, cell)}"


def _said(c: Change) -> str:
    degrees = np.degrees(c.offset)
    if c.kind == "joint":
        turned = f"joint {c.joint} turns the other way in these data"
        if c.sign > 0:
            return f"joint {c.joint}'s zero is {degrees:.4g}° elsewhere in these data"
        return turned if not c.offset else f"{turned} and counts from {degrees:.4g}°"
    if c.kind == "coupling":
        way = "with" if c.factor > 0 else "against"
        return f"joint {c.joint} turns {way} joint {c.follows} (a coupling of {c.factor:+g})"
    if c.kind == "shift":
        rows = "row" if abs(c.shift) == 1 else "rows"
        way = "before" if c.shift > 0 else "after"
        return f"each position stands {abs(c.shift)} {rows} {way} the joint values it belongs to"
    if c.kind == "columns":
        moved = [(j, k) for j, k in enumerate(c.order, 1) if j != k]
        if len(moved) == 2:
            return f"the columns of joints {moved[0][0]} and {moved[1][0]} are exchanged"
        told = ", ".join(f"joint {j}'s values are in the column of joint {k}" for j, k in moved)
        return f"the columns of the joints are in another order: {told}"
    if c.kind == "arm":
        return f"the arm is another one, {c.arm}"
    return {
        "joint_degrees": "the joint values are degrees, not radians",
        "joint_radians": "the joint values are radians, and were taken for degrees",
        "millimetres": "the positions are millimetres, not metres",
        "metres": "the positions are metres, and were taken for millimetres",
        "turn_degrees": "the attitudes are degrees, not radians",
        "turn_radians": "the attitudes are radians, and were taken for degrees",
        "mirrored": "the axes of the readings are left-handed: one coordinate has the other sign",
        "mirrored_positions": "one coordinate of the positions has the other sign",
        "inverse": "the poses are the inverse ones, of the tracker in the target's axes",
        "inverse_attitude": "the attitudes are the inverse ones",
        "base_unknown": "the base stands elsewhere than [tracker] says",
        "target_unknown": "the target sits elsewhere than [tool] says",
    }[c.kind]


def _remedy(e: Explanation, cell: Cell) -> str:
    """What to write into CELL.toml, or to change in the table."""
    lines, table = [], False
    arm = next((c.arm for c in e.changes if c.kind == "arm"), None)
    if arm is not None:
        lines.append(f'[robot] model = "{arm}"')
    lines += [f"[robot] {key} = {value}" for key, value in keys(e.changes, cell).items()]
    for c in e.changes:
        if c.kind == "base_unknown":
            lines.append("leave out [tracker] base_xyz_m and base_rotvec_rad")
        elif c.kind == "target_unknown":
            lines.append("leave out [tool] target_m")
        elif c.kind not in ("joint", "coupling", "arm"):
            table = True
    said = f"; in CELL.toml: {', '.join(lines)}" if lines else ""
    return said + ("; correct it in the table" if table else "")


def keys(changes: tuple[Change, ...], cell: Cell) -> dict[str, str]:
    """Return the keys of [robot] that describe the joints with some changes, as TOML."""
    n, robot = cell.arm.n, None if cell.config is None else cell.config.robot
    sign = np.array((robot and robot.joint_sign) or (1,) * n)
    zero = np.array((robot and robot.joint_offset_deg) or (0.0,) * n)
    given = robot.joint_coupling if robot else ()
    coupled = [c.model_dump(exclude_defaults=True) | {"factor": c.factor} for c in given]
    said = set()
    for c in changes:
        j = c.joint - 1
        if c.kind == "joint":
            if c.offset:
                zero[j] += sign[j] * np.degrees(c.offset)
                said.add(OFFSET)
            if c.sign < 0:
                sign[j] *= -1
                said.add(SIGN)
        elif c.kind == "coupling":
            factor = float(sign[j] * c.factor)
            coupled.append({"joint": c.joint, "follows": c.follows, "factor": factor})
            said.add(COUPLING)
    entries = ", ".join(
        "{ " + ", ".join(f"{k} = {json.dumps(v)}" for k, v in entry.items()) + " }"
        for entry in coupled
    )
    out = {
        SIGN: json.dumps([int(s) for s in sign]),
        OFFSET: json.dumps([round(float(z), 4) + 0.0 for z in zero]),
        COUPLING: f"[{entries}]",
    }
    return {key: value for key, value in out.items() if key in said}


def _rows(finding: Finding, readings: Readings) -> str:
    """Name the rows that do not fit while most do."""
    which = np.flatnonzero(finding.rows)
    if not len(which):
        return ""

    def name(k: int) -> str:
        at = f"{readings.pose_names[readings.pose[k]]}/{readings.load_names[readings.load[k]]}"
        several = readings.states.target is not None
        return f"{at} {readings.target_names[readings.target[k]]}" if several else at

    if finding.swapped:
        pairs = [f"{name(i)} with {name(j)}" for i, j in finding.swapped[:MOST_NAMED]]
        return f"rows are swapped ({', '.join(pairs)})"
    named = ", ".join(name(int(k)) for k in which[:MOST_NAMED])
    more = f" and {len(which) - MOST_NAMED} more" if len(which) > MOST_NAMED else ""
    return f"{len(which)} of {len(readings)} rows do not fit: {named}{more}"


def document(finding: Finding, cell: Cell, readings: Readings) -> dict[str, object]:
    """Return the JSON of a finding."""
    return {
        "message": words(finding, cell, readings),
        "rms_m": finding.rms,
        "gate_m": finding.gate,
        "explanations": [
            {
                "rms_m": e.rms,
                "changes": [asdict(c) for c in e.changes],
                "robot": keys(e.changes, cell),
            }
            for e in finding.explanations
        ],
        "rows": np.flatnonzero(finding.rows).tolist(),
        "swapped": [list(pair) for pair in finding.swapped],
        "tried": finding.tried,
    }
