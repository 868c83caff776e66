"""Guesses of positions, orientations, forces and uncertainties, by names, axes and values."""

import itertools
import re
from collections.abc import Sequence
from datetime import datetime
from typing import Any

import numpy as np

from hilcal.tables import proposal as words
from hilcal.tables.grid import Cell
from hilcal.tables.mapped import nines
from hilcal.tables.uncertainty import PLAUSIBLE
from hilcal.tables.units import FORCES, LENGTHS, MOMENTS, TIMES
from hilcal.types import Floats

NORM = 3e-3  # How far the length of a quaternion may be from 1: three digits
FORMATS = (
    "%d.%m.%Y %H:%M:%S",
    "%d.%m.%Y %H:%M:%S.%f",
    "%d.%m.%Y %H:%M",
    "%d-%b-%Y %H:%M:%S",
    "%d-%b-%Y %H:%M:%S.%f",
    "%m/%d/%Y %H:%M:%S",
    "%m/%d/%Y %I:%M:%S %p",
    "%d/%m/%Y %H:%M:%S",
    "%m/%d/%Y %H:%M",
    "%m/%d/%Y %I:%M %p",
    "%d/%m/%Y %H:%M",
    "%Y/%m/%d %H:%M:%S",
    "%Y/%m/%d %H:%M",
    "%Y-%m-%d-%H-%M-%S",
    "%H:%M:%S",
    "%H:%M:%S.%f",
    "%H:%M",
    "%I:%M:%S %p",
)
"""Forms of dates that are tried, in this order."""
LEAST_OF_MEAN = 1e-7  # m; of a mean of 1000 samples, in the unit of the positions
RIVAL = 0.5  # Difference of the score within which another choice of columns is as good; a choice
_WRENCH_DOUBT = 'base axes, or axes = "flange"; of = "load" (exerted on the tool), or "reaction"?'
BY_VALUES = "found by their values: check the columns"
BY_ROWS = "found by their values; row by row, or column by column?"
RIVALS = "these fit as well by their values:"
LONE = "the only other number of a row, taken as a distance from [points.A]; [gauge] for a height"
MOST_DEGREES = 400.0  # largest joint angle of a table, a turn and some margin; a choice
RECENT = 1e8  # s since 1970; later times are of a campaign. A choice
_EXCEL = (30000.0, 60000.0)

SAME_TARGET_M = 2e-3  # m, within which readings side by side are of one target; a choice
REPEATED = "repeats of one target side by side, since they agree within 2 mm"


def is_quaternion(values: Floats) -> bool:
    """Whether (N, 4) numbers are quaternions: some rows are complete, and these have length 1."""
    if values.shape[1] != 4:
        return False
    complete = values[np.isfinite(values).all(axis=1)]
    return len(complete) > 0 and bool(np.all(np.abs(np.linalg.norm(complete, axis=1) - 1) < NORM))


def sentinels(position: Floats) -> list[float]:
    """Return numbers that stand for a missing point: all three the same, or made of nines."""
    same = (position[:, 0] == position[:, 1]) & (position[:, 1] == position[:, 2])
    return sorted({float(v) for v in position[same, 0] if v != 0} | set(nines(position)))


def time_unit(
    cells: Sequence[Cell], stated: str | None, values: Floats | None
) -> tuple[dict[str, Any], str | None] | None:
    """Return unit (and format) of a column of times, and a doubt; None where it holds no times."""
    if any(c in (None, "") for c in cells):
        return None
    if all(isinstance(c, datetime) for c in cells):
        return {"unit": "iso"}, None
    if values is not None:
        if np.nanmax(values) == np.nanmin(values):
            return None
        if stated in TIMES:
            return {"unit": stated}, None
        if _EXCEL[0] < np.nanmin(values) and np.nanmax(values) < _EXCEL[1]:
            return {"unit": "excel"}, "days of a spreadsheet, by their size"
        for unit in ("ns", "us", "ms"):
            if TIMES[unit] * np.nanmin(values) > RECENT:
                return {"unit": unit}, f"{unit} since 1970, by their size"
        return {"unit": "s"}, "no unit stated; read as s"
    import pandas as pd

    def fits(form: str) -> bool:
        texts = pd.Series([str(c).strip() for c in cells])
        texts = texts.str.replace(",", ".") if form == "ISO8601" else texts
        return bool(pd.to_datetime(texts, format=form, errors="coerce", utc=True).notna().all())

    if fits("ISO8601"):
        return {"unit": "iso"}, None
    fitting = list(filter(fits, FORMATS))
    if not fitting:
        return None
    doubt = f"month first, or {fitting[1]}?" if len(fitting) > 1 else None
    return {"unit": "format", "format": fitting[0]}, doubt


def guess_by_values(g: words.Guesser) -> None:
    """Find positions and joints among columns whose names say nothing.

    Neighbouring columns are tried: positions vary by hundreds (mm) or stay small (m), joint
    angles stay within one turn. Where several choices are as good, a note says so.
    """
    named = words.NOMINAL | words.STD | words.TIME | words.TEMPERATURE | words.LOAD | words.MASS
    free = []
    for name, c in g.free.items():
        of_pose = c.has(words.POSE) and not c.numbers  # "p(1)" is of a matrix
        if g.number(name) and c.axis is None and not c.has(named) and not of_pose:
            values = g.block([name])[:, 0]
            counts = len(values) > 2 and np.all(np.diff(values) == 1)  # row numbers
            if not counts and np.ptp(values[np.isfinite(values)]) > 0:
                free.append(name)
    _orientation_by_values(g, free)
    free = [name for name in free if name in g.free]

    def runs(width: int) -> list[list[str]]:
        index = {name: k for k, name in enumerate(g.grid.names)}
        parts = [free[k : k + width] for k in range(len(free) - width + 1)]
        return [p for p in parts if index[p[-1]] - index[p[0]] == width - 1]

    def size(names: list[str]) -> float:
        return float(np.nanmax(np.abs(g.block(names))))

    has_joints = "joints" in g.proposal.sections
    has_position = bool({"position", "distance", "gauge"} & set(g.proposal.sections))
    ranked: list[tuple[float, list[str], list[str]]] = []
    pairs = itertools.product(
        [[]] if has_joints else runs(g.joints or 6), [[]] if has_position else runs(3)
    )
    for joints, position in pairs:
        if set(joints) & set(position) or (joints and size(joints) > MOST_DEGREES):
            continue
        score = 0.1 * ((len(free) - len(joints) - len(position)) % 3 == 0)
        if joints:
            score += 2.0 if size(joints) <= words.MAX_ANGLE_RAD else 1.0
        if position:
            far = size(position)
            score += 2.0 if far > 400 else (1.0 if far < words.MAX_POSITION_M else 0.5)
        ranked.append((score, position, joints))
    if not ranked:
        if not has_position:
            _lone_distance(g, free, [[]] if has_joints else runs(g.joints or 6))
        return
    ranked.sort(key=lambda r: -r[0])
    best, position, joints = ranked[0]
    near = [(p, j) for score, p, j in ranked if score >= best - RIVAL]
    g.proposal.alternatives = near
    for section, names, unit_of in (
        ("position", position, words.length_unit),
        ("joints", joints, words.angle_unit),
    ):
        if names:
            unit = unit_of(g, section, names)
            g.assign(section, names, unit, unit=unit)
            g.doubt(section, BY_VALUES)
    if len(near) > 1:
        pair = [", ".join(part) for part in near[1] if part]
        g.doubt("joints", f"{RIVALS} {' and '.join(pair)}")


def _lone_distance(g: words.Guesser, free: list[str], runs: list[list[str]]) -> None:
    """Take the only number of a row beside its joint angles as a distance."""
    for joints in runs:
        other = [name for name in free if name not in joints]
        if len(other) != 1 or (joints and np.nanmax(np.abs(g.block(joints))) > MOST_DEGREES):
            continue
        if joints:
            unit = words.angle_unit(g, "joints", joints)
            g.assign("joints", joints, unit, unit=unit)
            g.doubt("joints", BY_VALUES)
        unit = words.length_unit(g, "distance", other)
        g.assign("distance", other, unit, column=other[0], unit=unit, name="A")
        g.doubt("distance", LONE)
        return


def _orientation_by_values(g: words.Guesser, free: list[str]) -> None:
    if "orientation" in g.proposal.sections:
        return
    for width, k in itertools.product((3, 4), range(len(free) - 8)):  # 4: a position ends each row
        rows = [free[k + i * width : k + i * width + width] for i in range(3)]
        names = [name for row in rows for name in row[:3]]
        if len(names) < 9:
            continue
        m = g.block(names).reshape(-1, 3, 3)
        m = m[np.isfinite(m).all(axis=(1, 2))]
        if len(m) and np.abs(m @ np.swapaxes(m, 1, 2) - np.eye(3)).max() < NORM:
            _take_matrix(g, names, [name for row in rows for name in row[3:]])
            g.doubt("orientation", BY_ROWS)
            return
    for k in range(len(free) - 3):
        names = free[k : k + 4]
        if is_quaternion(g.block(names)):
            _take_quaternion(g, names)
            return


def _take_matrix(g: words.Guesser, names: list[str], position: list[str]) -> None:
    """Take nine numbers for a rotation matrix, and three more for the position beside it."""
    g.assign("orientation", names, "rotation matrix", convention="matrix")
    if len(position) == 3 and "position" not in g.proposal.sections:
        unit = words.length_unit(g, "position", position)
        g.assign("position", position, unit, unit=unit)


def _take_quaternion(g: words.Guesser, names: list[str]) -> None:
    g.assign("orientation", names, "quaternion, w first", convention="quaternion-wxyz")
    g.proposal.convention_guessed = True


def _kind(c: words.ColumnName) -> str:
    if c.has(words.STD):
        return "std_angle" if c.has(words.ROTATION) else "std"
    for kind, vocabulary in (
        ("quaternion", words.QUATERNION),
        ("angle", words.ROTATION),
        ("force", words.FORCE),
        ("moment", words.MOMENT),
    ):
        if c.has(vocabulary):
            return kind
    return "position"


Group = dict[str, dict[tuple[object, ...], dict[str, str]]]
"""Names of columns by kind, by the stem of the name (its words and numbers), by axis."""
SQUARES = tuple(f"{unit}²" for unit in LENGTHS)
_KINDS = words.STD | words.ROTATION | words.QUATERNION | words.FORCE | words.MOMENT


def guess_axes(g: words.Guesser) -> None:
    """Find positions, orientations, forces and standard deviations by the axes in their names."""
    sets: Group = {}
    _covariance(g)
    for c in g.columns:
        if c.axis and c.name in g.free and g.number(c.name) and not c.has({"cov", "kov"}):
            stem = (*(w for w in c.words if w not in _KINDS | {"pos", "position", "p"}), *c.numbers)
            sets.setdefault(_kind(c), {}).setdefault(stem, {})[c.axis] = c.name
    if "force" not in sets and "moment" in sets:  # tx, ty, tz are then translations
        for stem, axes in sets.pop("moment").items():
            same = stem in sets.setdefault("position", {})
            sets["position"][("t", *stem) if same else stem] = axes
    complete = {
        kind: {stem: axes for stem, axes in stems.items() if set("xyz") <= set(axes)}
        for kind, stems in sets.items()
    }
    positions = complete.get("position", {})
    if not positions:
        _matrix(g)
        return
    still = [
        s for s, axes in positions.items() if not np.ptp(g.block(axes[k] for k in "xyz"), 0).any()
    ]
    ranked = sorted(positions, key=lambda s: (s in still, *_rank(s)))
    stem = ranked[0]
    used = _targets_side_by_side(positions, stem) or [stem]
    names = [positions[s][axis] for s in used for axis in "xyz"]
    unit = words.length_unit(g, "position", names)
    if len(used) > 1:
        targets = [str(s[-1]) for s in used]
        apart = LENGTHS[unit] * np.ptp(g.block(names).reshape(-1, len(used), 3), axis=1)
        one = float(np.nanmax(apart)) < SAME_TARGET_M
        targets = [""] * len(used) if one else targets
        meaning = f"{unit}, {len(targets)} {'repeats' if one else 'targets'}"
        g.assign("position", names, meaning, unit=unit, targets=targets)
        g.doubt("position", REPEATED if one else words.SIDE_BY_SIDE)
    else:
        g.assign("position", names, unit, unit=unit)
    others = [s for s in ranked if s not in used and words.NOMINAL.isdisjoint(map(str, s))]
    if unused := [positions[s]["x"] for s in others]:
        listed = ", ".join(f"'{name}' ..." for name in unused[: words.N_EXAMPLES])
        g.doubt("position", f"'{names[0]}' ... are used, not {listed}")
    marks = sentinels(g.block(names))
    if marks:
        g.proposal.sections["file"] = {"missing": marks}
        g.doubt("file", f"{', '.join(map('{:g}'.format, marks))} stands for a missing point")
    _orientation(g, complete, stem)
    _forces(g, complete)
    _std(g, complete, stem, unit)


def _std_unit(
    g: words.Guesser, section: str, names: Sequence[str], power: int, usual: Sequence[str]
) -> str:
    """Return the unit of standard deviations (variances: power 2), stated or else by their size.

    It is the first, of the `usual` ones, m, mm and um, in which they are what instruments have.
    """
    squared = "²" * (power - 1)
    stated = g.unit(names, [unit + squared for unit in LENGTHS])
    if stated is not None:
        return stated.removesuffix("²")
    figures = g.block(names)
    figures = figures[figures > 0] ** (1 / power)
    figure = float(np.median(figures)) if len(figures) else 0.0
    tried = dict.fromkeys((*usual, "m", "mm", "um"))
    low, high = PLAUSIBLE
    least = dict.fromkeys(usual, LEAST_OF_MEAN)
    fit = (u for u in tried if least.get(u, low) <= LENGTHS[u] * figure <= high)
    unit = next(fit, next(iter(tried)))
    size = f"a standard deviation is then {1e6 * LENGTHS[unit] * figure:.3g} µm"
    g.doubt(section, f"no unit stated; {unit}{squared}: {size}")
    return unit


def _targets_side_by_side(
    positions: dict[tuple[object, ...], dict[str, str]], stem: tuple[object, ...]
) -> list[tuple[object, ...]]:
    """Return the stems of several targets' positions, which differ by a number only."""
    if not stem or not isinstance(stem[-1], int):
        return []
    alike = [s for s in positions if s[:-1] == stem[:-1] and s and isinstance(s[-1], int)]
    return sorted(alike, key=str) if len(alike) > 1 else []


def _rank(stem: tuple[object, ...]) -> tuple[int, int]:
    names = {str(w) for w in stem}
    order = 2 if names & words.NOMINAL else (0 if names & words.MEASURED else 1)
    order = 3 if names & words.DIFFERENCE else order
    return order, len(stem)


def _covariance(g: words.Guesser) -> None:
    """Covariances "cov_x_y", "Sxy", "C12" ...: the upper triangle or all nine."""
    by_axes: dict[str, str] = {}
    for name in g.free:
        plain = re.sub(r"[^a-z0-9]", "", words.without_unit(name))
        if g.number(name) and (match := _COVARIANCE.fullmatch(plain)):
            by_axes[match["axes"].translate(_AXIS_NUMBERS)] = name
    upper = ["xx", "xy", "xz", "yy", "yz", "zz"]
    if not all(axes in by_axes for axes in upper):
        return
    names = [by_axes[axes] for axes in upper]
    xx, xy, xz, yy, yz, zz = g.block(names).T
    bounded = (xy**2 <= xx * yy) & (xz**2 <= xx * zz) & (yz**2 <= yy * zz) & (xx >= 0)
    if not np.all(bounded[np.isfinite(g.block(names)).all(axis=1)]):
        return
    unit = _std_unit(g, "covariance", [by_axes[axes] for axes in ("xx", "yy", "zz")], 2, ())
    g.assign("covariance", names, f"upper triangle, {unit}²", unit=unit)


_COVARIANCE = re.compile(
    r"(cov|kov|covariance|kovarianz|sigma|s|c|v)(?P<axes>[xyz]{2}|[123]{2})((u|m)?m2?)?"
)
_AXIS_NUMBERS = str.maketrans("123", "xyz")


def _orientation(g: words.Guesser, complete: Group, stem: tuple[object, ...]) -> None:
    turned = complete.get("angle", {}) | complete.get("quaternion", {})
    quaternions = {s: a for s, a in turned.items() if "w" in a}
    best = _columns_like(quaternions, stem)
    if best is not None:
        names = [best[axis] for axis in "wxyz"]
        g.assign("orientation", names, "quaternion, w first", convention="quaternion-wxyz")
        return
    if _numbered_quaternion(g) or _matrix(g):
        return
    angles = complete.get("angle", {})
    if stem in angles:
        _by_axes(g, [angles[stem][axis] for axis in "xyz"])
        return
    free = [c.name for c in g.columns if c.name in g.free]
    plain = {re.split(r"[\[(]", name.strip().lower())[0].strip(): name for name in free}
    for letters, convention in (("wpr", "fanuc"), ("abc", "kuka"), ("oat", "kawasaki")):
        if all(letter in plain and g.number(plain[letter]) for letter in letters):
            names = [plain[letter] for letter in letters]
            _angles(g, names, convention)
            return
    usable = [c for c in g.columns if c.name in g.free and not c.has(words.NOMINAL)]
    turns = {c.words[-1]: c.name for c in usable if c.words}
    if {"roll", "pitch", "yaw"} <= set(turns):
        _angles(g, [turns[w] for w in ("roll", "pitch", "yaw")], "roll-pitch-yaw")
        return
    axes = _columns_like(angles, stem)
    if axes is not None:
        _by_axes(g, [axes[axis] for axis in "xyz"])


def _by_axes(g: words.Guesser, names: list[str]) -> None:
    """Angles named by axes: a rotation vector where none is longer than π, else fixed angles."""
    length = np.linalg.norm(g.block(names), axis=1)
    vector = np.nanmax(length) <= np.pi + 1e-3
    _angles(g, names, "rotation-vector" if vector else "fixed-xyz")


def _columns_like(
    stems: dict[tuple[object, ...], dict[str, str]], stem: tuple[object, ...]
) -> dict[str, str] | None:
    """Return the columns with the stem of the position, else the best ranked ones."""
    if stem in stems:
        return stems[stem]
    usable = [s for s in stems if not {str(w) for w in s} & words.NOMINAL]
    return stems[min(usable, key=_rank)] if usable else None


def _angles(g: words.Guesser, names: list[str], convention: str) -> None:
    unit = words.angle_unit(g, "orientation", names)
    g.assign("orientation", names, f"{convention}, {unit}", convention=convention, unit=unit)
    g.proposal.convention_guessed = True


def _numbered_quaternion(g: words.Guesser) -> bool:
    """Quaternions q1 ... q4 (ABB) or q0 ... q3, distinguished from joints by their length."""
    groups: dict[tuple[str, ...], dict[int, str]] = {}
    for c in g.columns:
        if c.numbers and not c.axis and c.has(words.QUATERNION | {"e"}) and c.name in g.free:
            groups.setdefault(c.words, {})[c.numbers[-1]] = c.name
    for by_number in groups.values():
        names = [by_number[k] for k in sorted(by_number)]
        if len(names) == 4 and is_quaternion(g.block(names)):
            _take_quaternion(g, names)
            return True
    return False


def _matrix(g: words.Guesser) -> bool:
    """Rotation matrices r11 ... r33, R(1,1) ..., and poses T(1,1) ... T(4,4)."""
    for word in ("r", "rot", "t", "m"):
        by_place: dict[tuple[int, int], str] = {}
        for c in g.columns:
            if c.words[:1] == (word,) and c.axis is None and c.name in g.free:
                place = c.numbers if len(c.numbers) == 2 else tuple(divmod(sum(c.numbers), 10))
                by_place[int(place[0]), int(place[1])] = c.name
        for base in (0, 1):
            places = [(i + base, j + base) for i in range(3) for j in range(3)]
            if all(place in by_place for place in places):
                names = [by_place[place] for place in places]
                last = [(i + base, 3 + base) for i in range(3)]
                _take_matrix(g, names, [by_place[place] for place in last if place in by_place])
                return True
    return False


def _forces(g: words.Guesser, complete: Group) -> None:
    force, moment = (next(iter(complete.get(k, {}).values()), None) for k in ("force", "moment"))
    if force is None:
        _vertical_force(g)
        return
    names = [force[axis] for axis in "xyz"]
    section: dict[str, object] = {"unit": g.unit(names, FORCES) or "N"}
    if moment is not None:
        turning = [moment[axis] for axis in "xyz"]
        section["moment_unit"] = g.unit(turning, MOMENTS) or "Nm"
        names += turning
    g.doubt("wrench", _WRENCH_DOUBT)
    g.assign("wrench", names, ", ".join(map(str, section.values())), **section)


def _vertical_force(g: words.Guesser) -> None:
    """A force along z alone, as of a weight that hangs; the others are zero."""
    forces = [c for c in g.columns if c.axis and c.has(words.FORCE) and g.number(c.name)]
    if [c.axis for c in forces] != ["z"] or forces[0].name not in g.free:
        return
    names = [forces[0].name]
    unit = g.unit(names, FORCES) or "N"
    g.doubt("wrench", f"fx and fy are taken as 0; {_WRENCH_DOUBT}")
    g.assign("wrench", names, f"fz, {unit}", unit=unit)


def _std_beside(g: words.Guesser) -> dict[str, str] | None:
    """Return standard deviations without an axis that each follow an axis of the position."""
    position = g.proposal.sections["position"]["columns"]
    after = dict(itertools.pairwise(g.columns))
    beside = [c for c in map(after.get, map(g.column, position)) if c is not None]
    if len(beside) != 3 or not all(c.has(words.STD) and g.number(c.name) for c in beside):
        return None
    return dict(zip("xyz", (c.name for c in beside), strict=True))


def _std(g: words.Guesser, complete: Group, stem: tuple[object, ...], position_unit: str) -> None:
    axes = _columns_like(complete.get("std", {}), stem) or _std_beside(g)
    scalar = words.DISTANCE | words.GAUGE
    columns = [c for c in g.columns if c.name in g.free and c.has(words.STD) and not c.axis]
    # "S" alone is the status of a KUKA's point
    named = [c for c in columns if c.unit or any(len(word) > 1 for word in c.words)]
    single = [c.name for c in named if g.number(c.name) and not (c.numbers or c.has(scalar))]
    if axes is None and not single:
        return
    names = [axes[axis] for axis in "xyz"] if axes is not None else single[:1]
    first = words.parse(names[0])
    squared = first.has(words.VARIANCE) or g.unit(names, SQUARES) is not None
    unit = _std_unit(g, "std", names, 1 + squared, [position_unit])
    section: dict[str, object] = {"unit": unit}
    turned = _columns_like(complete.get("std_angle", {}), stem)
    orientation = g.proposal.sections.get("orientation")
    if axes is not None and turned is not None and orientation is not None:
        names += [turned[axis] for axis in "xyz"]
        section["angle_unit"] = g.unit(names[3:]) or orientation.get("unit", "rad")
    kind = "std"
    if first.has(words.EXPANDED):
        kind, section["k"] = "expanded", 2.0
        g.doubt("std", "expanded uncertainty: is k = 2 right?")
    elif squared:
        kind = "variance"
    elif first.has({"u", "unc", "uncertainty", "unsicherheit", "incertitude"}):
        g.doubt("std", 'a standard deviation, or kind = "expanded" with its k?')
    section["kind"] = kind
    if axes is None:
        g.doubt("std", 'one figure: of = "axis", or "point" (3-D length)?')
    g.doubt("std", "scatter of samples only? Then set add_instrument = true")
    g.assign("std", names, f"{kind}, {', '.join(str(v) for v in section.values() if v != kind)}",
           **section)  # fmt: skip
