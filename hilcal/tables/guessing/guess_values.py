"""What the values of columns tell where their names do not."""

from datetime import datetime
from typing import Any

import numpy as np

from hilcal.tables.grid import Grid
from hilcal.tables.guessing import column_names as words
from hilcal.tables.guessing.proposal import FAR, TURN, Guesser, angle_unit, length_unit
from hilcal.tables.mapped import nines
from hilcal.types import Floats

NORM = 3e-3
"""How far the length of a quaternion may be from 1: three digits."""
FORMATS = (
    "%d.%m.%Y %H:%M:%S",
    "%d.%m.%Y %H:%M:%S.%f",
    "%d.%m.%Y %H:%M",
    "%m/%d/%Y %H:%M:%S",
    "%m/%d/%Y %I:%M:%S %p",
    "%d/%m/%Y %H:%M:%S",
    "%Y/%m/%d %H:%M:%S",
    "%Y-%m-%d-%H-%M-%S",
    "%H:%M:%S",
    "%H:%M:%S.%f",
)
"""Forms of dates that are tried, in this order."""
RIVAL = 0.5
"""Difference of the score within which another choice of columns is as good; a choice."""
BY_VALUES = "found by their values: check the columns"
RIVALS = "as good by their values:"
_EXCEL = (30000.0, 60000.0)


def is_quaternion(values: Floats) -> bool:
    """Whether (N, 4) numbers are quaternions: of length 1, and not one alone."""
    if values.shape[1] != 4:
        return False
    known = values[np.isfinite(values).all(axis=1)]
    return len(known) > 0 and bool(np.all(np.abs(np.linalg.norm(known, axis=1) - 1) < NORM))


def sentinels(position: Floats) -> list[float]:
    """Return numbers that stand for a missing point: all three the same, or made of nines."""
    same = (position[:, 0] == position[:, 1]) & (position[:, 1] == position[:, 2])
    return sorted({float(v) for v in position[same, 0] if v != 0} | set(nines(position)))


def time_unit(
    grid: Grid, name: str, stated: str | None, values: Floats | None
) -> tuple[dict[str, Any], str | None] | None:
    """Return unit (and format) of a column of times, and what is unsure; None where it is none."""
    cells = [c for c in grid.cells(name) if c not in (None, "")]
    if len(cells) < len(grid.rows):
        return None
    if all(isinstance(c, datetime) for c in cells):
        return {"unit": "iso"}, None
    if values is not None:
        if np.nanmax(values) == np.nanmin(values):
            return None
        if stated in ("s", "ms", "min", "h"):
            return {"unit": stated}, None
        if _EXCEL[0] < np.nanmin(values) and np.nanmax(values) < _EXCEL[1]:
            return {"unit": "excel"}, "days of a spreadsheet, by their size"
        if np.nanmin(values) > 1e11:
            return {"unit": "ms"}, "ms since 1970, by their size"
        return {"unit": "s"}, "no unit stated; read as s"
    texts = [str(c).strip() for c in cells]
    if _all_parse(texts, None):
        return {"unit": "iso"}, None
    fitting = [form for form in FORMATS if _all_parse(texts, form)]
    if not fitting:
        return None
    doubt = f"month first, or {fitting[1]}?" if len(fitting) > 1 else None
    return {"unit": "format", "format": fitting[0]}, doubt


def _all_parse(texts: list[str], form: str | None) -> bool:
    try:
        for text in texts:
            if form is None:
                datetime.fromisoformat(text.replace(",", "."))
            else:
                datetime.strptime(text, form)
    except ValueError:
        return False
    return True


def guess_by_values(g: Guesser) -> None:
    """Find positions and joints among columns whose names say nothing.

    Neighbouring columns are tried: positions vary by hundreds (mm) or stay small (m), joint
    angles stay within one turn. Where several choices are as good, that is said.
    """
    told = words.NOMINAL | words.STD | words.TIME | words.TEMPERATURE | words.LOAD | words.MASS
    free = [
        name
        for name, c in g.free.items()
        if g.number(name) and c.axis is None and not c.has(told) and not c.has(words.POSE)
        if not _counts(g.block([name])[:, 0])
    ]
    free = [name for name in free if np.ptp(g.block([name])[np.isfinite(g.block([name]))]) > 0]
    _orientation_by_values(g, free)
    free = [name for name in free if name in g.free]
    index = {name: k for k, name in enumerate(g.grid.names)}
    count = g.joints or 6

    def runs(width: int) -> list[list[str]]:
        parts = [free[k : k + width] for k in range(len(free) - width + 1)]
        return [p for p in parts if index[p[-1]] - index[p[0]] == width - 1]

    has_joints = "joints" in g.proposal.sections
    has_position = bool({"position", "distance", "gauge"} & set(g.proposal.sections))
    ranked: list[tuple[float, list[str], list[str]]] = []
    for joints in [[]] if has_joints else runs(count):
        for position in [[]] if has_position else runs(3):
            if set(joints) & set(position):
                continue
            score = 0.0
            if joints:
                size = float(np.nanmax(np.abs(g.block(joints))))
                if size > 400:
                    continue
                score += 2.0 if size <= TURN else 1.0
            if position:
                block = g.block(position)
                size = float(np.nanmax(np.abs(block)))
                score += 2.0 if size > 400 else (1.0 if size < FAR else 0.5)
            rest = [n for n in free if n not in joints and n not in position]
            score += 0.1 * (len(rest) % 3 == 0)
            ranked.append((score, position, joints))
    if not ranked:
        return
    ranked.sort(key=lambda r: -r[0])
    best, position, joints = ranked[0]
    rivals = [r for r in ranked[1:] if r[0] >= best - RIVAL]
    g.proposal.alternatives = [(p, j) for score, p, j in ranked if score >= best - RIVAL]
    if position:
        unit = length_unit(g, "position", position)
        g.take("position", position, unit, unit=unit)
        g.unsure("position", BY_VALUES)
    if joints:
        unit = angle_unit(g, "joints", joints)
        g.take("joints", joints, unit, unit=unit)
        g.unsure("joints", BY_VALUES)
    if rivals:
        other = rivals[0]
        pair = [", ".join(part) for part in other[1:] if part]
        g.unsure("joints", f"{RIVALS} {' and '.join(pair)}")


def _counts(values: Floats) -> bool:
    """Whether numbers count the rows."""
    return len(values) > 2 and bool(np.all(np.diff(values) == 1))


def _orientation_by_values(g: Guesser, free: list[str]) -> None:
    """Quaternions and rotation matrices are told by their length and orthogonality."""
    if "orientation" in g.proposal.sections:
        return
    for k in range(len(free) - 8):
        names = free[k : k + 9]
        m = g.block(names).reshape(-1, 3, 3)
        m = m[np.isfinite(m).all(axis=(1, 2))]
        if len(m) and np.abs(m @ np.swapaxes(m, 1, 2) - np.eye(3)).max() < NORM:
            g.take("orientation", names, "rotation matrix", convention="matrix")
            g.unsure("orientation", "found by their values; row by row, or column by column?")
            return
    for k in range(len(free) - 3):
        names = free[k : k + 4]
        if is_quaternion(g.block(names)):
            g.take("orientation", names, "quaternion, w first", convention="quaternion-wxyz")
            g.proposal.open_convention = True
            return
