"""Readings from a table of any kind, by a mapping that says what its columns hold."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise
from hilcal.readings.readings import SAME_POSE
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.tables import columns, units
from hilcal.tables.clock import seconds
from hilcal.tables.csvfile import CsvTable
from hilcal.tables.following import own_columns
from hilcal.tables.grid import Grid
from hilcal.tables.guessing.guess_values import nines
from hilcal.tables.imported import ImportResult
from hilcal.tables.mapping import Mapping
from hilcal.tables.mapping_sections import Column
from hilcal.tables.orientation import defect, rotations
from hilcal.tables.sheets import open_tables
from hilcal.tables.stated import stated_covariance
from hilcal.tables.stated_noise import check_joint_rounding, rounding_variance
from hilcal.tables.table import readings_of
from hilcal.tables.wide import one_target_per_row
from hilcal.types import Bools, Floats

MOST_LOST = 0.5
"""Share of rows without a value beyond which the mapping is taken for wrong; a choice."""
UNIT_LENGTH = 0.01
"""How far a quaternion's length may be from 1, and a matrix from orthogonal; rounding to three
digits stays below."""
MOST_TURN = 2 * np.pi + 1e-3
"""rad; a larger angle of an orientation is in another unit."""
MOVED = 0.01
"""rad; a joint commanded by more is sent to another pose; a choice."""
_LISTED = 8


def import_mapped(
    path: str | Path,
    mapping: Mapping,
    arm: Arm,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None = None,
    gravity: Sequence[float] = (0.0, 0.0, -9.80665),
    second: Path | None = None,
    targets: Sequence[str] = (),
) -> ImportResult:
    """Read a table, or two tables, by a mapping.

    Args:
        path: text, XLSX, MAT or Parquet.
        mapping: what its columns hold.
        arm: its number of joints, their limits and its reach are checked.
        noise: gives the covariances where the table states none.
        station: (3,) where the tracker's beam starts, m; the origin where None.
        gravity: (3,) base axes, m/s²: the direction in which a hung mass pulls.
        second: the second file, where the mapping does not name it.
        targets: names of the cell's targets.

    Returns:
        The readings in the table's order, and what was decided on the way. Rows without a value
        in a column that is used are left out and counted.

    Raises:
        InputError: anything that cannot be right, by file, row and column.
    """
    grid, lost = open_tables(path, mapping, second)
    result = readings_of_grid(grid, mapping, arm, noise, station, gravity, targets)
    if not lost:
        return result
    note = f"{lost} rows left out: they have no partner in the second file"
    return ImportResult(result.readings, (note, *result.notes))


@dataclass(slots=True, eq=False)
class _Found:
    """Number columns by the exchange table's names, SI units, NaN where a value is missing."""

    number: dict[str, Floats] = field(default_factory=dict)
    alias: dict[str, str] = field(default_factory=dict)

    def add(self, grid: Grid, name: str, column: Column, values: Floats) -> None:
        self.number[name] = values
        self.alias[name] = grid.name(column)


def readings_of_grid(
    grid: Grid,
    mapping: Mapping,
    arm: Arm,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None,
    gravity: Sequence[float],
    targets: Sequence[str] = (),
) -> ImportResult:
    """Make readings of a table that is open; see `import_mapped`.

    Raises:
        InputError: anything that cannot be right.
    """
    grid, mapping = one_target_per_row(grid, mapping)
    raw = _raw(grid, mapping, arm)
    nowhere = _nowhere(grid, mapping, raw)
    keep, notes = _complete(grid, raw)
    notes += nowhere
    grid = grid.rows_with(keep)
    raw = {column: values[keep] for column, values in raw.items()}
    found = _Found()
    angles, q = _motion(grid, mapping, raw, found, arm)
    _surroundings(grid, mapping, raw, found)
    wrench = _wrench(grid, mapping, np.asarray(gravity), found)
    text = {"load": _loads(grid, mapping, wrench)}
    text["pose"] = _poses(grid, mapping, q)
    if mapping.joints.reported:
        _as_commanded(found, text["pose"], q, arm)
    if mapping.target is not None:
        text["target"] = grid.text(mapping.target.column)
    table = CsvTable(grid.path, grid.names, grid.rows, text, found.number, found.alias)
    position = table.matrix(columns.POSITION)
    covariance = stated_covariance(table, grid, mapping, position, angles, noise, station)
    unit = units.LENGTHS[mapping.position.unit]
    rounding = rounding_variance(_block(raw, grid, mapping.position.columns), unit)
    result = readings_of(table, arm, noise, station, covariance.value, targets, rounding)
    joint_unit = units.ANGLES[mapping.joints.unit]
    rounded = check_joint_rounding(
        q / joint_unit, joint_unit, mapping.joints.unit, result.readings.covariance, arm.reach
    )
    notes += _stale(grid, position, q)
    told = covariance.notes or result.notes[:1]
    return ImportResult(result.readings, (*notes, *told, *result.notes[1:], *rounded))


def _raw(grid: Grid, mapping: Mapping, arm: Arm) -> dict[str, Floats]:
    """Number columns that a reading cannot do without, by the file's names, in its units."""
    needed: list[Column] = []
    per_joint = ("joints", "actual_joints", "approach", "joint_temperatures")
    for name in (*per_joint, "position", "orientation"):
        section = getattr(mapping, name)
        if section is None:
            continue
        count = {arm.n, int(arm.own.sum())} if name in per_joint[:2] else {arm.n}
        if name in per_joint and len(section.columns) not in count:
            raise InputError(
                f"{grid.path}: the mapping has {len(section.columns)} columns of {name}; "
                f"{arm.name} has {arm.n} joints"
            )
        needed += section.columns
    needed += [s.column for s in (mapping.air, mapping.cycle) if s is not None]
    return {grid.name(column): grid.numbers(column) for column in needed}


def _nowhere(grid: Grid, mapping: Mapping, raw: dict[str, Floats]) -> list[str]:
    """Take positions that instruments write for no measurement for missing.

    Exactly 0, 0, 0, and numbers of nines that are a position three times over, as −9999.
    """
    names = [grid.name(column) for column in mapping.position.columns]
    position, notes = _block(raw, grid, names), []
    for value in (0.0, *nines(position)):
        bad = np.asarray((position == value).all(axis=1))
        if not bad.any():
            continue
        for name in names:
            raw[name][bad] = np.nan
        listed = ", ".join([f"{value:g}"] * 3)
        notes.append(
            f"positions of exactly {listed} ({int(bad.sum())} of {len(bad)} rows) count as missing"
        )
    return notes


def _complete(grid: Grid, raw: dict[str, Floats]) -> tuple[Bools, list[str]]:
    """Rows that have a value in every column that is used, and a note on the others."""
    missing = np.stack([np.isnan(values) for values in raw.values()], axis=1)
    bad: Bools = np.asarray(missing.any(axis=1))
    count = int(bad.sum())
    if not count:
        return ~bad, []
    first = int(np.argmax(bad))
    column = list(raw)[int(np.argmax(missing[first]))]
    if count > MOST_LOST * len(bad):
        raise InputError(
            f"{grid.at(first, column)}: no value, and {count} of {len(bad)} rows lack one in some "
            f"column that the mapping uses; choose other columns"
        )
    listed = ", ".join(map(str, grid.rows[bad][:_LISTED].tolist()))
    more = ", ..." if count > _LISTED else ""
    lacking = [c for c, lost in zip(raw, np.any(missing, axis=0), strict=True) if lost]
    named = ", ".join(lacking[:4]) + (", ..." if len(lacking) > 4 else "")
    return ~bad, [f"{count} of {len(bad)} rows left out ({listed}{more}): no value in {named}"]


def _stale(grid: Grid, position: Floats, q: Floats) -> list[str]:
    """Note rows that read the same position as the row before, though the joints moved on."""
    same = (np.diff(position, axis=0) == 0).all(axis=1)
    moved = np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0) > MOVED
    rows = grid.rows[1:][same & moved]
    if not len(rows):
        return []
    listed = ", ".join(map(str, rows[:_LISTED].tolist())) + (", ..." if len(rows) > _LISTED else "")
    return [
        f"rows {listed} read exactly the position of the row before though the joints moved: was "
        f"it measured again? [file] skip_rows leaves rows out"
    ]


def _block(raw: dict[str, Floats], grid: Grid, names: Sequence[Column]) -> Floats:
    return np.stack([raw[grid.name(name)] for name in names], axis=1)


def _motion(
    grid: Grid, mapping: Mapping, raw: dict[str, Floats], found: _Found, arm: Arm
) -> tuple[Floats | None, Floats]:
    """Position, orientation and joints; returns the orientation's numbers and the joints, rad."""
    for name, column in zip(columns.POSITION, mapping.position.columns, strict=True):
        values = units.LENGTHS[mapping.position.unit] * raw[grid.name(column)]
        found.add(grid, name, column, values)
    angles = None
    if (o := mapping.orientation) is not None:
        angles = _block(raw, grid, o.columns)
        far = defect(o.convention, angles) > UNIT_LENGTH
        if far.any():
            i = int(np.argmax(far))
            what = "a quaternion of length 1" if angles.shape[1] == 4 else "a rotation matrix"
            raise InputError(f"{grid.at(i, grid.name(o.columns[0]))}: not {what}")
        unit = units.ANGLES[o.unit]
        turn = np.abs(unit * angles) > MOST_TURN
        if angles.shape[1] == 3 and turn.any():
            i, k = divmod(int(np.argmax(turn)), 3)
            seems = " (looks like degrees)" if o.unit == "rad" else ""
            raise InputError(
                f"{grid.at(i, grid.name(o.columns[k]))}: {angles[i, k]:g} {o.unit} is more than a "
                f"turn{seems}; see [orientation] unit"
            )
        vector = se3.rotation_vector(rotations(o.convention, angles, unit))
        for k, name in enumerate(columns.ROTATION):
            found.add(grid, name, o.columns[k], vector[:, k])
    joints = mapping.joints
    q = units.ANGLES[joints.unit] * _block(raw, grid, joints.columns)
    names = own_columns(columns.joint_columns(arm.n), len(joints.columns), arm)
    for k, name in enumerate(names):
        found.add(grid, name, joints.columns[k], q[:, k])
    if (actual := mapping.actual_joints) is not None:
        names = own_columns(columns.actual_columns(arm.n), len(actual.columns), arm)
        for name, column in zip(names, actual.columns, strict=True):
            found.add(grid, name, column, units.ANGLES[actual.unit] * raw[grid.name(column)])
    return angles, q


def _surroundings(grid: Grid, mapping: Mapping, raw: dict[str, Floats], found: _Found) -> None:
    """Cycle, approach, temperatures and times."""
    if mapping.cycle is not None:
        found.add(grid, "cycle", mapping.cycle.column, raw[grid.name(mapping.cycle.column)])
    if (approach := mapping.approach) is not None:
        n = len(approach.columns)
        for name, column in zip(columns.approach_columns(n), approach.columns, strict=True):
            found.add(grid, name, column, raw[grid.name(column)])
    if (air := mapping.air) is not None:
        found.add(grid, "air_degC", air.column, celsius(raw[grid.name(air.column)], air.unit))
    if (warm := mapping.joint_temperatures) is not None:
        n = len(warm.columns)
        for name, column in zip(columns.temperature_columns(n), warm.columns, strict=True):
            found.add(grid, name, column, celsius(raw[grid.name(column)], warm.unit))
    for name, time in (("time_s", mapping.time), ("load_time_s", mapping.load_time)):
        if time is not None:
            found.add(grid, name, time.column, seconds(grid, time))


def celsius(value: Floats, unit: str) -> Floats:
    """Temperatures in °C of those in °C, °F or K."""
    if unit == "K":
        return value - 273.15
    return (value - 32) / 1.8 if unit == "degF" else value


def _wrench(grid: Grid, mapping: Mapping, gravity: Floats, found: _Found) -> Floats:
    """(N, 6) wrench, N and N·m; zero where the table has none."""
    wrench = np.zeros((len(grid.rows), 6))
    if (w := mapping.wrench) is not None:
        scale = [units.FORCES[w.unit]] * 3 + [units.MOMENTS[w.moment_unit]] * 3
        sign = -1.0 if w.of == "reaction" else 1.0
        for k, column in enumerate(w.columns):
            wrench[:, k] = sign * scale[k] * np.nan_to_num(grid.numbers(column))
            found.alias[columns.WRENCH[k]] = grid.name(column)
    if (hung := mapping.hung_mass) is not None:
        mass = units.MASSES[hung.unit] * np.nan_to_num(grid.numbers(hung.column))
        bad = mass < 0
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(f"{grid.at(i, grid.name(hung.column))}: a mass is 0 or more")
        wrench[:, :3] = mass[:, None] * gravity
        found.alias |= dict.fromkeys(columns.WRENCH, grid.name(hung.column))
    wrench += 0.0  # no negative zeros
    if wrench.any():
        found.number |= {name: wrench[:, k] for k, name in enumerate(columns.WRENCH)}
    return wrench


def _loads(grid: Grid, mapping: Mapping, wrench: Floats) -> list[str]:
    """Names of the loads: the column's, or by the hung mass, or "load" where a wrench acts."""
    if mapping.load is not None:
        none = {name.lower() for name in (*mapping.load.none, "")}
        text = grid.text(mapping.load.column)
        return ["none" if name.lower() in none else name for name in text]
    if mapping.hung_mass is not None:
        unit = mapping.hung_mass.unit
        mass = np.nan_to_num(grid.numbers(mapping.hung_mass.column))
        return ["none" if m == 0 else f"{m:g}{unit}" for m in mass]
    return ["load" if loaded else "none" for loaded in np.asarray(wrench.any(axis=1))]


def _as_commanded(found: _Found, poses: Sequence[str], q: Floats, arm: Arm) -> None:
    """Take the angles of a pose's first row as commanded, those of each row as actual."""
    first: dict[str, int] = {}
    rows = [first.setdefault(name, k) for k, name in enumerate(poses)]
    names, reported = (
        own_columns(of(arm.n), q.shape[1], arm)
        for of in (columns.joint_columns, columns.actual_columns)
    )
    for k, (name, actual) in enumerate(zip(names, reported, strict=True)):
        found.number[actual], found.alias[actual] = q[:, k], found.alias[name]
        found.number[name] = q[rows, k]


def _poses(grid: Grid, mapping: Mapping, q: Floats) -> list[str]:
    """Names of the poses: the column's, or the row where these joints were first commanded."""
    if mapping.pose is not None:
        names = grid.text(mapping.pose.column)
        if "" in names:
            i = names.index("")
            raise InputError(
                f"{grid.at(i, grid.name(mapping.pose.column))}: the pose has no name; without "
                f"[pose], rows of the same joints are one pose"
            )
        return names
    keys = np.rint(q / (10 * SAME_POSE)).astype(np.int64)
    first: dict[tuple[int, ...], int] = {}
    out = []
    for row, key in zip(grid.rows.tolist(), map(tuple, keys.tolist()), strict=True):
        out.append(f"row {first.setdefault(key, row)}")
    return out
