"""Readings from a table of any form that a mapping explains."""

import math
import re
from collections.abc import Mapping as Mapped
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import compress
from pathlib import Path
from typing import Generic

import numpy as np

from hilcal.config import STANDARD_GRAVITY_M_S2
from hilcal.errors import InputError
from hilcal.readings.covariance import (
    TrackerNoise,
    tracker_covariance,
)
from hilcal.readings.readings import SAME_POSE, ObserverName, Readings
from hilcal.robot import chain, se3
from hilcal.robot.arm import Arm
from hilcal.tables import columns, units
from hilcal.tables import mapping as forms
from hilcal.tables import table as exchange
from hilcal.tables.columns import independent_columns
from hilcal.tables.files import open_tables
from hilcal.tables.grid import ColumnTable, Grid, first_true, text_of
from hilcal.tables.uncertainty import check_joint_rounding, mapped_covariance, rounding_variance
from hilcal.tables.units import defect, rotations
from hilcal.types import Bools, Floats, Ints

MAX_LOST_SHARE = 0.5  # Share of rows without a value beyond which the mapping is wrong; a choice
UNIT_LENGTH = 0.01  # Of a quaternion from 1, of a matrix from orthogonal; three digits stay below
MOST_TURN = 2 * np.pi + 1e-3  # rad; a larger angle of an orientation is in another unit
MOVED_RAD = 0.01  # rad; a joint commanded by more is sent to another pose; a choice
STILL_RAD = 1e-4  # rad; a joint commanded by less does not arrive from another side
SIGMAS = 4.0  # Standard deviations within which two readings are the same; a choice
REPEATED = 2e-4  # rad; rows whose joints differ by less repeat a pose; a choice
REPEATS_TO = 4e-4  # m; ten times an arm's repeatability: of positions further apart some are wrong
TOOL = 0.5  # m; the longest tool: with the arm's reach, the lever of its joints; a choice
GRAVITY = (0.0, 0.0, -STANDARD_GRAVITY_M_S2)  # m/s², base axes, of an arm that stands upright
EPOCH = 1e8  # s; times beyond three years are counted from an epoch, not from the campaign's start
DAY = 86400.0  # s
NO_DATE = -25567  # days from 1970 to 1900-01-01, as which a time of day alone is read
TARGET = "target of [position]"
_EXPECTED = {"iso": "a date and time like 2024-05-31T12:00:00", "excel": "days since 1899-12-30"}
_CELSIUS = {"degC": (1.0, 0.0), "degF": (1 / 1.8, 32.0), "K": (1.0, 273.15)}
"""Size of a unit in °C, and where 0 °C is on its scale."""
_LISTED = 8


@dataclass(frozen=True, slots=True, eq=False)
class MappedTable(Generic[forms.M]):
    """The rows of a table, read by a mapping, without their uncertainties."""

    table: ColumnTable  # columns of the exchange table, SI
    grid: Grid  # the rows as the file has them
    mapping: forms.M  # with one target per row, without optional columns that are absent
    raw: dict[str, Floats]  # (N,) number columns by the file's names, in its units
    angles: Floats | None  # (N, k) numbers of the orientation, in the file's unit; None without
    notes: list[str]  # one sentence for each decision


def mapped_table(
    path: str | Path,
    mapping: forms.M,
    arm: Arm,
    gravity: Sequence[float] = GRAVITY,
    second: Path | None = None,
) -> MappedTable[forms.M]:
    """Read the states of one table or two by a mapping; arguments are those of `import_mapped`."""
    grid, lost = open_tables(path, mapping, second)
    notes = [f"{lost} rows left out: they have no partner in the second file"] * bool(lost)
    grid, mapping = one_target_per_row(grid, mapping)
    if mapping.air is not None and mapping.air.optional and mapping.air.column not in grid.names:
        notes.append(f"no air temperature: the file has no column {mapping.air.column}")
        mapping = mapping.model_copy(update={"air": None})
    raw, joints, side = _raw(grid, mapping, arm), mapping.joints, None
    if mapping.approach is not None and mapping.approach.by_order and joints is not None:
        side = approach_by_order(_joint_units(joints, arm) * _block(raw, grid, joints.columns))
        notes.append(
            f"approach: side of the move from the row before; moves below {STILL_RAD:g} rad keep "
            "the last side, the first row counts as +1"
        )
    missing_notes = _missing_positions(grid, mapping.position, raw)
    sparse: list[str] = []  # columns of readings; a row has one kind of reading
    if mapping.scalars:
        position = () if mapping.position is None else mapping.position.columns
        sparse = [grid.name(c) for c in (*position, *(s.column for s in mapping.scalars.values()))]
    optional = _optional(grid, mapping)
    needed = {column: values for column, values in raw.items() if column not in optional}
    keep, left_out = _complete(grid, needed, sparse)
    notes += left_out + missing_notes
    grid = grid.rows_with(keep)
    raw = {column: values[keep] for column, values in raw.items()}
    table = ColumnTable(grid.path, grid.rows, {}, {})
    _quantities(table, grid, mapping, raw, arm)
    _observers(table, grid, mapping, raw)
    if side is not None:
        table.number.update(zip(columns.approach_columns(arm.n), side[keep].T, strict=True))
    angles = _rotations(grid, mapping.orientation, raw, table)
    for name, time in (("time_s", mapping.time), ("load_time_s", mapping.load_time)):
        if time is not None:
            values, days = seconds(grid, time)
            _put(table, grid, name, time.column, values)
            if days:
                notes.append(
                    f"times of '{grid.name(time.column)}' go back {days} times by over half a day: "
                    "taken for midnight; a mapping names a column of dates by [time] date_column"
                )
    q = None if joints is None else _joint_units(joints, arm) * _block(raw, grid, joints.columns)
    wrench = _wrench(grid, mapping, np.asarray(gravity), table)
    if mapping.wrench is not None and mapping.wrench.axes == "flange" and q is not None:
        # about the load point, by the nominal arm
        turn = chain.evaluate(arm, arm.complete(q)).rotation[-1][:, None]
        wrench = se3.apply(turn, wrench.reshape(-1, 2, 3)).reshape(-1, 6)
    if wrench.any():
        table.number.update(zip(columns.WRENCH, wrench.T, strict=True))
    table.text["load"] = _loads(grid, mapping, wrench)
    table.text["pose"] = _poses(grid, mapping.pose, q)
    if joints is not None and q is not None and joints.reported:
        _as_commanded(table, q, arm)
    if mapping.target is not None:
        table.text["target"] = grid.text(mapping.target.column)
    return MappedTable(table, grid, mapping, raw, angles, notes)


def import_mapped(
    path: str | Path,
    mapping: forms.Mapping,
    arm: Arm,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None = None,
    gravity: Sequence[float] = GRAVITY,
    second: Path | None = None,
    targets: Sequence[str] = (),
    std: Mapped[ObserverName, float] | None = None,
) -> exchange.ImportResult:
    """Read one or two tables by a mapping; a hung mass pulls along `gravity` (3,), base, m/s²."""
    source = mapped_table(path, mapping, arm, gravity, second)
    mapping, grid, table, notes = source.mapping, source.grid, source.table, source.notes
    q = _joint_units(mapping.joints, arm) * _block(source.raw, grid, mapping.joints.columns)
    noise = noise if mapping.instrument is None else mapping.instrument.noise()
    covariance, rounding, stated, position = None, None, tuple[str, ...](), np.zeros((len(q), 0))
    if mapping.position is not None:
        position = table.matrix(columns.POSITION)
        positioned = np.asarray(np.isfinite(position).all(axis=1))
        covariance, stated = mapped_covariance(
            table.select(positioned),
            grid.rows_with(positioned),
            mapping,
            position[positioned],
            source.angles,
            noise,
            station,
        )
        figures = _block(source.raw, grid, mapping.position.columns)[positioned]
        rounding = rounding_variance(figures, units.LENGTHS[mapping.position.unit])
    result = exchange.readings_of(table, arm, noise, station, covariance, targets, rounding, std)
    readings = result.readings
    if mapping.rows is not None and mapping.rows.plausible_only:
        scatter = readings.covariance
        if noise is not None and mapping.std is not None and mapping.std.add_instrument:
            scatter = scatter - tracker_covariance(position, noise, station, readings.m)
        readings, left_out = _plausible(readings, scatter, grid.rows, arm.reach + TOOL)
        notes += left_out
    else:
        notes += _stale(grid, position, q)
    notes += [*(stated or result.notes[:1]), *result.notes[1:]]
    unit, name = units.ANGLES[mapping.joints.unit], mapping.joints.unit
    angles = q[:, _turn(mapping.joints, arm)] / unit
    notes += check_joint_rounding(angles, unit, name, result.readings.covariance, arm.reach)
    return exchange.ImportResult(readings, tuple(notes))


def _observers(
    table: ColumnTable, grid: Grid, mapping: forms.PointMapping, raw: dict[str, Floats]
) -> None:
    """Add distances and heights in m, their variances, and the observers of the rows."""
    for kind, section in mapping.scalars.items():
        value, observer, variance = columns.SCALAR[kind]
        _put(table, grid, value, section.column, raw[grid.name(section.column)])
        table.number[value] = units.LENGTHS[section.unit] * table.number[value]
        if section.name_column is None:
            table.text[observer] = [str(section.name)] * len(grid.rows)
        else:
            table.text[observer] = grid.text(section.name_column)
            table.alias[observer] = grid.name(section.name_column)
        if section.std_column is not None:
            std = units.LENGTHS[section.std_unit or section.unit] * grid.numbers(section.std_column)
            table.refuse(std[:, None] < 0, (value,), lambda v: "its standard deviation is below 0")
            _put(table, grid, variance, section.std_column, std**2)
    if mapping.station is not None:
        table.text[columns.STATION] = grid.text(mapping.station.column)
        table.alias[columns.STATION] = grid.name(mapping.station.column)


def one_target_per_row(grid: Grid, mapping: forms.M) -> tuple[Grid, forms.M]:
    """Return the table with a row for each target (x1 y1 z1 x2 ... are two), and its mapping."""
    rows = range(len(grid.rows))
    if mapping.position is None or not mapping.position.targets:
        return grid, mapping
    targets = mapping.position.targets
    count = len(targets)
    tall = grid.rows_with(np.repeat(np.arange(len(rows)), count))
    update: dict[str, object] = {}
    if any(targets):  # without names: repeats of the only one
        tall = tall.with_column(TARGET, [*targets] * len(rows), 1)
        update = {"target": forms.Name(column=TARGET)}
    sections: dict[str, forms.Position | forms.Std] = {"position": mapping.position}
    if mapping.std is not None and len(mapping.std.columns) == 3 * count:
        sections |= {"std": mapping.std}
    for key, section in sections.items():
        axes = []
        for axis in range(3):
            sources = [grid.name(section.columns[3 * k + axis]) for k in range(count)]
            cells = [grid.cells(name) for name in sources]
            axes.append("/".join(sources))
            tall = tall.with_column(axes[-1], [c[i] for i in rows for c in cells], sources[0])
        update[key] = section.model_copy(update={"columns": tuple(axes)})
    return tall, mapping.model_copy(update=update)


def _put(table: ColumnTable, grid: Grid, name: str, column: forms.Column, values: Floats) -> None:
    table.number[name] = values
    table.alias[name] = grid.name(column)


def _quantities(
    table: ColumnTable, grid: Grid, m: forms.PointMapping, raw: dict[str, Floats], arm: Arm
) -> None:
    def put(
        names: Sequence[str],
        keys: Sequence[forms.Column],
        size: float | Floats = 1.0,
        zero: float = 0.0,
    ) -> None:
        sizes = np.broadcast_to(size, len(names)).tolist()
        for name, column, factor in zip(names, keys, sizes, strict=True):
            _put(table, grid, name, column, factor * (raw[grid.name(column)] - zero))

    if m.position is not None:
        put(columns.POSITION, m.position.columns, units.LENGTHS[m.position.unit])
    commanded, reported = columns.joint_columns(arm.units), columns.actual_columns(arm.units)
    for s, names in ((m.joints, commanded), (m.actual_joints, reported)):
        if s is not None:
            put(independent_columns(names, len(s.columns), arm), s.columns, _joint_units(s, arm))
    if m.cycle is not None:
        put(("cycle",), (m.cycle.column,))
    if m.approach is not None and m.approach.columns:
        put(columns.approach_columns(arm.n), m.approach.columns)
    if m.air is not None:
        put(("air_degC",), (m.air.column,), *_CELSIUS[m.air.unit])
    if (w := m.joint_temperatures) is not None:
        put(columns.temperature_columns(arm.n), w.columns, *_CELSIUS[w.unit])
    if (t := m.torques) is not None:
        sizes = np.where(arm.slides, units.FORCES[t.slide_unit], units.MOMENTS[t.unit])
        sign = -1.0 if t.of == "load" else 1.0
        put(columns.torque_columns(arm.units), t.columns, sign * sizes)


def _joint_units(section: forms.Joints, arm: Arm) -> Floats:
    """(k,) rad, or m where a joint slides, per unit of each of the section's columns."""
    angle, length = units.ANGLES[section.unit], units.LENGTHS[section.slide_unit]
    return np.where(_turn(section, arm), angle, length)


def _turn(section: forms.Joints, arm: Arm) -> Bools:
    """(k,) which of the section's columns are of joints that turn."""
    turn = ~arm.slides
    return turn if len(section.columns) == arm.n else turn[arm.independent]


def _raw(grid: Grid, mapping: forms.PointMapping, arm: Arm) -> dict[str, Floats]:
    """Number columns that every reading needs, by the file's names, in its units."""
    needed: list[forms.Column] = []
    per_joint = ("joints", "actual_joints", "approach", "joint_temperatures", "torques")
    for name in (*per_joint, "position", "orientation"):
        section = getattr(mapping, name)
        if section is None or not section.columns:
            continue
        count = {arm.n, int(arm.independent.sum())} if name in per_joint[:2] else {arm.n}
        if name in per_joint and len(section.columns) not in count:
            raise InputError(
                f"{grid.path}: the mapping has {len(section.columns)} columns of {name}; "
                f"{arm.name} has {arm.n} joints"
            )
        needed += section.columns
    needed += [s.column for s in (mapping.air, mapping.cycle) if s is not None]
    needed += [s.column for s in mapping.scalars.values()]
    raw = {grid.name(column): grid.numbers(column) for column in needed}
    for section in (mapping.joints, mapping.actual_joints):
        if section is not None and section.from_zero:
            half = math.pi / units.ANGLES[section.unit]
            for column in compress(section.columns, _turn(section, arm)):
                angle = raw[grid.name(column)]
                raw[grid.name(column)] = np.where(angle > half, angle - 2 * half, angle)
    return raw


def _missing_positions(
    grid: Grid, section: forms.Position | None, raw: dict[str, Floats]
) -> list[str]:
    """Set positions to NaN that mean none: exactly 0, 0, 0, or nines (−9999) in all three."""
    names = [] if section is None else [grid.name(column) for column in section.columns]
    position, notes = _block(raw, grid, names) if names else np.zeros((0, 1)), []
    for value in (0.0, *nines(position)):
        bad = np.asarray((position == value).all(axis=1))
        if bad.any():
            for name in names:
                raw[name][bad] = np.nan
            listed = ", ".join([f"{value:g}"] * 3)
            rows = f"{int(bad.sum())} of {len(bad)} rows"
            notes.append(f"positions of exactly {listed} ({rows}) count as missing")
    return notes


def nines(position: Floats) -> list[float]:
    """Return numbers of four nines or more, which stand for a missing value."""
    values = np.unique(position[np.isfinite(position)])
    return [float(v) for v in values if re.fullmatch(r"-?9{4,}(\.0)?", repr(float(v)))]


def _optional(grid: Grid, m: forms.PointMapping) -> set[str]:
    """Columns without which a row is a reading all the same: temperatures."""
    of_joints = () if m.joint_temperatures is None else m.joint_temperatures.columns
    return {grid.name(column) for column in (*of_joints, *([m.air.column] if m.air else []))}


def _complete(grid: Grid, raw: dict[str, Floats], sparse: Sequence[str]) -> tuple[Bools, list[str]]:
    """(N,) rows with values in all used columns, of `sparse` ones in any; a note on the others."""
    missing = np.stack([np.isnan(values) for values in raw.values()], axis=1)
    of_sparse = np.isin(list(raw), sparse)
    missing[:, of_sparse] = missing[:, of_sparse].all(axis=1, keepdims=True)
    bad: Bools = np.asarray(missing.any(axis=1))
    count, first = int(bad.sum()), int(np.argmax(bad))
    if count > MAX_LOST_SHARE * len(bad):
        column = list(raw)[int(np.argmax(missing[first]))]
        raise InputError(
            f"{grid.at(first, column)}: no value, and {count} of {len(bad)} rows lack one in some "
            f"column that the mapping uses; choose other columns"
        )
    lacking = [c for c, lost in zip(raw, np.any(missing, axis=0), strict=True) if lost]
    named = ", ".join(lacking[:4]) + (", ..." if len(lacking) > 4 else "")
    rows = f"{count} of {len(bad)} rows left out ({_listed(grid.rows[bad])})"
    return ~bad, [f"{rows}: no value in {named}"] * bool(count)


def _stale(grid: Grid, position: Floats, q: Floats) -> list[str]:
    """Note rows that read the same position as the row before, though the joints moved on."""
    same = (np.diff(position, axis=0) == 0).all(axis=1) & (position.shape[1] > 0)
    moved = np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0) > MOVED_RAD
    rows = grid.rows[1:][same & moved]
    if not len(rows):
        return []
    return [
        f"rows {_listed(rows)} read exactly the position of the row before though the joints "
        f"moved: was it measured again? [file] skip_rows leaves rows out"
    ]


def _block(raw: dict[str, Floats], grid: Grid, names: Sequence[forms.Column]) -> Floats:
    return np.stack([raw[grid.name(name)] for name in names], axis=1)


def _rotations(
    grid: Grid, o: forms.Orientation | None, raw: dict[str, Floats], table: ColumnTable
) -> Floats | None:
    """Add rotation vectors; returns the orientation's numbers (N, k) in the file's unit."""
    if o is None:
        return None
    angles = _block(raw, grid, o.columns)
    for (i,) in first_true(defect(o.convention, angles) > UNIT_LENGTH):
        valid = "a quaternion of length 1" if angles.shape[1] == 4 else "a rotation matrix"
        raise InputError(f"{grid.at(i, o.columns[0])}: not {valid}")
    unit = units.ANGLES[o.unit]
    for i, k in first_true((np.abs(unit * angles) > MOST_TURN) & (angles.shape[1] == 3)):
        seems = " (looks like degrees)" if o.unit == "rad" else ""
        raise InputError(
            f"{grid.at(i, o.columns[k])}: {angles[i, k]:g} {o.unit} is more than a turn{seems}; "
            "see [orientation] unit"
        )
    vector = se3.rotation_vector(rotations(o.convention, angles, unit))
    for k, name in enumerate(columns.ROTATION):
        _put(table, grid, name, o.columns[k], vector[:, k])
    return angles


def _wrench(grid: Grid, mapping: forms.PointMapping, gravity: Floats, table: ColumnTable) -> Floats:
    wrench = np.zeros((len(grid.rows), 6))
    if (w := mapping.wrench) is not None:
        scale = [units.FORCES[w.unit]] * 3 + [units.MOMENTS[w.moment_unit]] * 3
        sign = -1.0 if w.of == "reaction" else 1.0
        for k, column in enumerate(w.columns, start=2 if len(w.columns) == 1 else 0):
            wrench[:, k] = sign * scale[k] * np.nan_to_num(grid.numbers(column))
            table.alias[columns.WRENCH[k]] = grid.name(column)
    if (hung := mapping.hung_mass) is not None:
        mass = _hung_mass(grid, hung)
        for i in np.flatnonzero(mass < 0)[:1]:
            valid = "a mass is 0 or more"
            if hung.unit in units.FORCES:
                valid = "weights have one sign; of forces up and down, [wrench] takes fz"
            raise InputError(f"{grid.at(i, hung.column)}: {valid}")
        wrench[:, :3] = mass[:, None] * gravity
        table.alias.update(dict.fromkeys(columns.WRENCH, grid.name(hung.column)))
    return wrench + 0.0  # no negative zeros


def _hung_mass(grid: Grid, hung: forms.HungMass) -> Floats:
    """(N,) kg; of weights, which some count downwards as negative forces, the size."""
    figures = np.nan_to_num(grid.numbers(hung.column))
    if hung.unit in units.MASSES:
        return units.MASSES[hung.unit] * figures
    downwards = -1.0 if figures.max() <= 0 else 1.0
    return downwards * units.FORCES[hung.unit] / STANDARD_GRAVITY_M_S2 * figures


def _loads(grid: Grid, mapping: forms.PointMapping, wrench: Floats) -> list[str]:
    """Names of the loads: the column's, or by the hung mass, or "load" where a wrench acts."""
    if mapping.load is not None:
        none = {name.lower() for name in (*mapping.load.none, "")}
        text = grid.text(mapping.load.column)
        return ["none" if name.lower() in none else name for name in text]
    if (hung := mapping.hung_mass) is not None:
        figures = np.abs(np.nan_to_num(grid.numbers(hung.column)))
        return ["none" if x == 0 else f"{x:g}{hung.unit}" for x in figures]
    return ["load" if loaded else "none" for loaded in np.asarray(wrench.any(axis=1))]


def _as_commanded(table: ColumnTable, q: Floats, arm: Arm) -> None:
    """Take the angles of a pose's first row as commanded, those of each row as actual."""
    first: dict[str, int] = {}
    rows = [first.setdefault(name, k) for k, name in enumerate(table.text["pose"])]
    names, reported = (
        independent_columns(columns_of(arm.units), q.shape[1], arm)
        for columns_of in (columns.joint_columns, columns.actual_columns)
    )
    for k, (name, actual) in enumerate(zip(names, reported, strict=True)):
        table.number[actual], table.alias[actual] = q[:, k], table.alias[name]
        table.number[name] = q[rows, k]


def _poses(grid: Grid, section: forms.PoseName | None, q: Floats | None) -> list[str]:
    """Names of the poses: the column's, or the row where these joints were first commanded."""
    if section is not None and section.column is not None:
        names = grid.text(section.column)
        if "" in names:
            raise InputError(
                f"{grid.at(names.index(''), section.column)}: the pose has no name; without "
                f"[pose], rows of the same joints are one pose"
            )
        return names
    rows = grid.rows.tolist()
    if section is not None or q is None:
        return [f"row {row}" for row in rows]
    keys = map(tuple, np.rint(q / (10 * SAME_POSE)).astype(np.int64).tolist())
    first: dict[tuple[int, ...], int] = {}
    return [f"row {first.setdefault(key, row)}" for row, key in zip(rows, keys, strict=True)]


def seconds(grid: Grid, time: forms.Time) -> tuple[Floats, int]:
    """(N,) times in s, and how many midnights they pass without saying so.

    Dates, and times since an epoch, are counted from the earliest row. A time of day without a date
    that is more than half a day before that of the row above is of the next day.
    """
    import pandas as pd

    cells, expected = (
        grid.times(time.column, time.date_column),
        time.format or _EXPECTED.get(time.unit, "a date"),
    )
    dated = all(isinstance(c, datetime) for c in cells)
    if time.unit in units.TIMES:
        values, expected = units.TIMES[time.unit] * grid.numbers(time.column), "a time"
    elif time.unit == "excel" and not dated:
        days = pd.Series([str(c).replace(",", ".") for c in cells])
        values = DAY * pd.to_numeric(days, errors="coerce").to_numpy(dtype=float)
    else:
        form = None if dated else time.format
        texts = [str(c).strip() if form else str(c).strip().replace(",", ".") for c in cells]
        when = pd.to_datetime(pd.Series(texts), format=form or "ISO8601", errors="coerce", utc=True)
        values = (when - pd.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy(dtype=float)
    for (k,) in first_true(~np.isfinite(values)):
        raise InputError(
            f"{grid.at(k, time.column)}: '{text_of(cells[k])}' is not "
            f"{expected}; see unit of the times in the mapping"
        )
    if time.unit in units.TIMES:
        return values - values.min() if values.min() > EPOCH else values, 0
    undated = np.all(np.floor(values / DAY) == NO_DATE)
    midnights = undated & (np.diff(values, prepend=values[:1]) < -DAY / 2)
    values = values + DAY * np.cumsum(midnights)
    return np.asarray(np.round(values - values.min(), 6)), int(midnights.sum())


def approach_by_order(q: Floats) -> Floats:
    """(N, n) sides of arrival, sign(q_i − q_{i−1}): the last one at rest, +1 before any move."""
    import pandas as pd

    filled = pd.DataFrame(q).ffill().bfill().to_numpy()
    step = np.diff(filled, axis=0, prepend=filled[:1])
    side = np.where(np.abs(step) > STILL_RAD, np.sign(step), np.nan)
    side[0] = 1.0
    return np.asarray(pd.DataFrame(side).ffill().to_numpy(), dtype=float)


def _plausible(
    readings: Readings, scatter: Floats, rows: Ints, lever: float
) -> tuple[Readings, list[str]]:
    """Leave out implausible readings; a note on each reason.

    A reading is stale where it equals the previous one within the scatter (N, m, m) of both though
    the joints were sent elsewhere. Readings that repeat a pose contradict each other, all of them,
    where their positions differ by more than `REPEATS_TO` + lever · Σ|dq|, the most that the joints
    move it.
    """
    from scipy.spatial import cKDTree

    q, value = readings.states.q, readings.value
    variance = np.diagonal(scatter, axis1=1, axis2=2)
    stale = np.zeros(len(q), dtype=bool)
    sent = np.abs(np.diff(q, axis=0)).max(axis=1) > MOVED_RAD
    limit = SIGMAS * np.sqrt(variance[1:] + variance[:-1])
    stale[1:] = sent & np.all(np.abs(np.diff(value, axis=0)) <= limit, axis=1)
    used = np.flatnonzero(~stale)
    pairs = cKDTree(q[used]).query_pairs(REPEATED, p=np.inf, output_type="ndarray")
    i, j = used[pairs[:, 0]], used[pairs[:, 1]]
    apart = np.linalg.norm(value[i, :3] - value[j, :3], axis=1)
    wrong = apart > REPEATS_TO + lever * np.abs(q[i] - q[j]).sum(axis=1)
    contradictory = np.isin(np.arange(len(q)), [i[wrong], j[wrong]])
    notes = [
        f"{int(bad.sum())} of {len(bad)} rows left out ({_listed(rows[bad])}): {why}"
        for bad, why in (
            (stale, "the same reading as the row before, though the joints were sent on"),
            (contradictory, "they repeat a pose but disagree by more than noise can explain"),
        )
        if bad.any()
    ]
    if (stale | contradictory).all():
        raise InputError("no row can be used; expected one measured pose per row")
    plausible = readings[~(stale | contradictory)]
    used, pose = np.unique(plausible.pose, return_inverse=True)
    names = tuple(plausible.pose_names[k] for k in used)
    return replace(plausible, pose=pose, pose_names=names), notes


def _listed(rows: Ints) -> str:
    return ", ".join(map(str, rows[:_LISTED].tolist())) + ", ..." * (len(rows) > _LISTED)
