"""The exchange table: readings as CSV or Parquet, one row per reading."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal.config import CellConfig
from hilcal.errors import InputError
from hilcal.names import check_name, check_names
from hilcal.readings.covariance import (
    INSTRUMENT,
    INSTRUMENT_AND_ARM,
    ROUNDING,
    SINGULAR,
    TrackerNoise,
    smallest_correlation,
    tracker_covariance,
)
from hilcal.readings.readings import TEMPERATURES, ObserverName, Readings, States, numbered
from hilcal.robot.arm import Arm
from hilcal.store.plan import UNLOADED
from hilcal.tables import columns
from hilcal.tables.files import open_grid
from hilcal.tables.grid import ColumnTable, first_true
from hilcal.tables.mapping import FileFormat
from hilcal.tables.uncertainty import MIN_STD, floored, rounding_variance, with_rounding
from hilcal.tables.write import Column, write_columns
from hilcal.toml import suggest
from hilcal.types import Bools, Floats, Ints

FROM_TABLE = "covariance: from the table"
FROM_TRACKER = "covariance: from the tracker's noise in [tracker]"
MAX_TIME_S = 1e12  # s; longer than a campaign: seconds since 1970 are 1e9, nanoseconds 1e18
OTHER_LOAD = 0.02  # share by which a table's force may differ from the cell's unsaid; a choice
LARGEST_NM = 1e5  # N·m; more than any joint of an arm carries


@dataclass(frozen=True, slots=True, eq=False)
class ImportResult:
    """Imported readings, and the decisions of the import."""

    readings: Readings  # the readings that can be used
    notes: tuple[str, ...]  # one sentence per decision
    covers: str = INSTRUMENT  # what the covariances cover, see `readings.covariance`
    noise_stated: bool = True  # by the table or [tracker], not by the defaults of [tracker] alone
    from_tracker: bool = False  # whether the covariances are those of the noise in [tracker]


def import_table(
    path: str | Path,
    arm: Arm,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None = None,
    targets: Sequence[str] = (),
    std: Mapping[ObserverName, float] | None = None,
) -> ImportResult:
    """Read an exchange table: SI units; `station` (3,), m, is where the tracker's beam starts."""
    form = FileFormat(encoding="utf-8")
    grid = open_grid(path, form, lambda header: _check_header(str(path), header, arm))
    observers = [name for _, name, _ in columns.SCALAR.values()]
    texts = {*columns.TEXT, columns.TARGET, columns.COVERS, columns.STATION, *observers}
    numbers = set(columns.known_columns(arm.units)) - texts
    text, number = ([n for n in grid.names if n in names] for names in (texts, numbers))
    table = ColumnTable.of(grid, text, number, columns.sparse_columns(grid.names))
    return readings_of(table, arm, noise, station, targets=targets, std=std)


def readings_of(
    table: ColumnTable,
    arm: Arm,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None = None,
    covariance: Floats | None = None,
    targets: Sequence[str] = (),
    rounding: Floats | None = None,
    std: Mapping[ObserverName, float] | None = None,
) -> ImportResult:
    """Check a table with the exchange table's columns, in SI units, and make readings of it.

    `covariance` (K, m, m) of the K rows with a position replaces the table's columns; `rounding`
    (3,), m², is the variance of the positions' rounding, which follows from them where it is None;
    `std` is that of distances and heights, m, for a table that states none.
    """
    columns.check_names(table)
    pose, pose_names = _index(table.text["pose"])
    load, load_names = _index(table.text["load"])
    target = _targets(table, targets)
    loaded = np.array([name != UNLOADED for name in table.text["load"]], dtype=np.bool_)
    columns.check_differences(table, loaded, pose)
    observed = columns.observer_rows(table)
    positioned = np.ones(len(table.rows), dtype=np.bool_) if observed is None else ~observed.scalar
    states, value = measured_of(table, arm, positioned)
    states = replace(
        states, target=target, observer=None if observed is None else observed.observer
    )
    columns.check_same_pose(table, pose, pose_names, states.q, arm)
    columns.check_wrenches(table, states.wrench, load, load_names, arm)
    m = value.shape[1]
    cov, notes, covers = np.zeros((len(value), m, m)), tuple[str, ...](), _covers(table)[0]
    if positioned.any():
        cov[positioned], notes, covers = covariances_of(
            table.select(positioned), value[positioned], noise, station, covariance, rounding
        )
    if observed is not None:
        value, cov = observed.fill(table, value, cov, std or {})
    readings = Readings(
        states=states,
        pose=pose,
        load=load,
        cycle=_cycles(table),
        value=value,
        covariance=cov,
        load_names=tuple(load_names),
        pose_names=tuple(pose_names),
        target_names=() if target is None else tuple(targets),
        observers=() if observed is None else observed.names,
    )
    return ImportResult(readings, (*notes, *_lost_temperatures(table, states)), covers)


def covariances_of(
    table: ColumnTable,
    value: Floats,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None,
    covariance: Floats | None,
    rounding: Floats | None,
) -> tuple[Floats, tuple[str, ...], str]:
    """Covariances (N, m, m) of positions or poses, notes on them, and what they cover."""
    stated = _stated_covariance(table, value.shape[1]) if covariance is None else covariance
    notes: tuple[str, ...]
    if stated is None:
        cov = _instrument_covariance(table, value, noise, station)
        notes, covers, included = (FROM_TRACKER,), INSTRUMENT, False
    else:
        columns.check_covariances(table, stated)
        tiny = np.any(np.diagonal(stated, axis1=1, axis2=2) < min(MIN_STD) ** 2)
        singular = np.any(smallest_correlation(stated) <= SINGULAR)
        use_spec = bool(tiny | singular) and noise is not None
        spec = _instrument_covariance(table, value, noise, station) if use_spec else None
        cov, raised = floored(table, stated, spec)
        notes, (covers, included) = (FROM_TABLE, *raised), _covers(table)
    if rounding is None:
        rounding = np.zeros(3) if included else rounding_variance(value[:, :3], 1.0)
    cov, rounded = with_rounding(cov, rounding)
    return cov, (*notes, *rounded), covers


def _check_header(path: str, header: Sequence[str], arm: Arm) -> None:
    if len(header) == 1 and (";" in header[0] or "\t" in header[0]):
        raise InputError(
            f"{path}: columns must be separated by ',' with '.' as decimal mark; for any other "
            f"table: {columns.PREVIEW}"
        )
    check_names(header, f"{path}: row 1, column")
    if set(header).isdisjoint(columns.known_columns(arm.units)):
        raise InputError(
            f"{path}: not an exchange table: row 1 has none of its columns "
            f"({', '.join(columns.required_columns(arm.units))}); for any other table: "
            f"{columns.PREVIEW}"
        )
    columns.check_header(path, header, arm.units, arm.name, columns.mimic_columns(arm))
    columns.check_covariance_columns(path, header)


def _index(names: list[str]) -> tuple[Ints, list[str]]:
    """Index of each name among the distinct ones, in order of appearance, and these."""
    order = {name: k for k, name in enumerate(dict.fromkeys(names))}
    return np.array([order[name] for name in names], dtype=np.int64), list(order)


def _targets(table: ColumnTable, names: Sequence[str]) -> Ints | None:
    """(N,) numbers of the targets by the cell's names; None where there is one target."""
    stated = table.text.get(columns.TARGET)
    if stated is None:
        if len(names) > 1:
            raise InputError(
                f"{table.path}: no column '{columns.TARGET}', but the cell's targets are "
                f"{', '.join(names)} ([[tool.targets]]); name in each row the one that was read"
            )
        return None
    if not names and len(set(stated)) > 1:
        raise InputError(
            f"{table.path}: column '{columns.TARGET}' names "
            f"{', '.join(map(repr, dict.fromkeys(stated)))}, but the cell has one target; "
            "give each a section [[tool.targets]] with its name (and target_m, where its offset is "
            "known)"
        )
    for k, name in enumerate(stated):
        if not name:
            raise InputError(f"{table.at(k, columns.TARGET)}: the cell is empty; name the target")
        if names and name not in names:
            raise InputError(
                f"{table.at(k, columns.TARGET)}: target {name!r} is not in the cell's "
                f"[[tool.targets]]{suggest(name, names)}; valid: {', '.join(names)}"
            )
    if len(names) < 2:
        return None
    return np.array([names.index(name) for name in stated], dtype=np.int64)


def _covers(table: ColumnTable) -> tuple[str, bool]:
    """What the covariances cover, by column `covers`, and whether rounding is in them."""
    stated = table.text.get(columns.COVERS, [INSTRUMENT])
    for k, word in enumerate(stated):
        check_covers(word, table.at(k, columns.COVERS))
        if word != stated[0]:
            raise InputError(
                f"{table.at(k, columns.COVERS)}: {word}, but {stated[0]} in the first row; all "
                "rows must say the same"
            )
    return stated[0].removesuffix(ROUNDING), stated[0].endswith(ROUNDING)


def check_covers(covers: str, where: str) -> None:
    """Refuse an invalid word for what covariances cover."""
    if covers.removesuffix(ROUNDING) not in (INSTRUMENT, INSTRUMENT_AND_ARM):
        raise InputError(
            f"{where}: {covers!r} is unknown; valid: {INSTRUMENT} (the covariance of the tracker), "
            f"{INSTRUMENT_AND_ARM} (the arm's repeatability is in it), each with {ROUNDING} "
            "where the rounding of the positions is in it"
        )


def measured_of(table: ColumnTable, arm: Arm, rows: Bools | None = None) -> tuple[States, Floats]:
    """Return states and values (N, m), m and rad; values are zero in rows not in `rows` (N,)."""
    states = _states(table, arm)
    if rows is not None and not rows.all():
        value = np.zeros((len(table.rows), 3))
        if rows.any():
            value[rows] = measured_of(table.select(rows), arm)[1]
        return states, value
    value = table.matrix(columns.POSITION)
    station = np.array(table.text.get(columns.STATION, [""] * len(value)))
    for name in dict.fromkeys(station.tolist()):
        group = station == name
        columns.check_positions(table.select(group), value[group], states.q[group], arm)
    if columns.ROTATION[0] in table.number:
        rotation = table.matrix(columns.ROTATION)
        columns.check_rotations(table, rotation)
        value = np.hstack([value, rotation])
    return states, value


def _states(table: ColumnTable, arm: Arm) -> States:
    table = columns.with_mimic_joints(table, arm)
    number, n = table.number, arm.n
    joints, reported = columns.joint_columns(arm.units), columns.actual_columns(arm.units)
    torques, sides = columns.torque_columns(arm.units), columns.approach_columns(n)
    q, zero = table.matrix(joints), np.zeros(len(table.rows))
    columns.check_joints(table, joints, q, arm)
    wrench = np.stack([number.get(name, zero) for name in columns.WRENCH], axis=1)
    temperature = _group(table, columns.temperature_columns(n))
    approach, actual, torque = (_group(table, names) for names in (sides, reported, torques))
    if approach is not None:
        table.refuse(np.abs(approach) != 1, sides, lambda v: f"{v:g} must be -1 or +1")
    if actual is not None:
        columns.check_actual_joints(table, reported, actual, q)
    if temperature is not None:
        temperature[np.isnan(temperature).any(axis=1)] = np.nan  # a row has all or none
        _in_range(table, columns.temperature_columns(n), -50, 150, "°C")
    if torque is not None:
        lost = np.isnan(torque)
        some = lost & ~lost.all(axis=1, keepdims=True)
        table.refuse(some, torques, lambda _: "no value; give all torques of a row, or none")
        _in_range(table, torques, -LARGEST_NM, LARGEST_NM, "N·m or N")
    for name, low, high, unit in (
        ("air_degC", -50.0, 80.0, "°C"),
        ("time_s", -MAX_TIME_S, MAX_TIME_S, "s"),
        ("load_time_s", 0.0, MAX_TIME_S, "s"),
    ):
        if name in number:
            _in_range(table, (name,), low, high, unit)
    return States(
        q=q,
        wrench=wrench,
        time=number.get("time_s"),
        load_time=number.get("load_time_s"),
        air_temperature=number.get("air_degC"),
        joint_temperature=temperature,
        approach=approach,
        q_actual=actual,
        torque=torque,
    )


def _lost_temperatures(table: ColumnTable, states: States) -> list[str]:
    """Return a note on each kind of temperature that some readings lack."""
    out = []
    for field in TEMPERATURES:
        column = getattr(states, field)
        lost = np.isnan(column.reshape(len(states), -1)).any(axis=1) if column is not None else []
        if np.any(lost):
            name = {"air_temperature": "air_degC"}.get(field, "joint1_degC, ...")
            out.append(
                f"{name}: no temperature in {int(np.sum(lost))} of {len(lost)} readings (the first "
                f"is row {table.rows[int(np.argmax(lost))]}): fits do without this temperature, as "
                "an effect that depends on it needs it in all"
            )
    return out


def _group(table: ColumnTable, names: Sequence[str]) -> Floats | None:
    return table.matrix(names) if names[0] in table.number else None


def _in_range(table: ColumnTable, names: Sequence[str], low: float, high: float, unit: str) -> None:
    value = table.matrix(names)
    complaint = f"{unit} cannot be right; expected {low:g} to {high:g} {unit}"
    table.refuse((value < low) | (value > high), names, lambda v: f"{v:g} {complaint}")


def _cycles(table: ColumnTable) -> Ints:
    if "cycle" not in table.number:
        return np.zeros(len(table.rows), dtype=np.int64)
    cycle = table.matrix(("cycle",))
    wrong = (cycle != np.rint(cycle)) | (np.abs(cycle) > 2**53)
    table.refuse(wrong, ("cycle",), lambda v: f"{v:g} must be a whole number")
    return cycle[:, 0].astype(np.int64)


def _stated_covariance(table: ColumnTable, m: int) -> Floats | None:
    names = columns.covariance_columns(m)
    if names[0] not in table.number:
        return None
    i, j = np.triu_indices(m)
    cov = np.zeros((len(table.rows), m, m))
    cov[:, i, j] = cov[:, j, i] = table.matrix(names)
    return cov


def _instrument_covariance(
    table: ColumnTable,
    value: Floats,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None,
) -> Floats:
    m = value.shape[1]
    if noise is None:
        names = columns.covariance_columns(m)
        raise InputError(
            f"{table.path}: no covariance columns ({names[0]} ... {names[-1]}) and no noise in "
            f"the section [tracker] of the configuration; give one of them"
        )
    origin = np.zeros(3) if station is None else np.asarray(station, dtype=float)
    for (k,) in first_true(np.linalg.norm(value[:, :3] - origin, axis=1) < 1e-3):
        lost = "a lost reflector, as 0, 0, 0 often is? Leave the row out, or " * (
            not value[k].any()
        )
        raise InputError(
            f"{table.at(k)}: position lies at the tracker's station; {lost}set station_m in the "
            f"section [tracker] of the configuration"
        )
    return tracker_covariance(value[:, :3], noise, origin, m)


def named_loads(readings: Readings, config: CellConfig) -> tuple[Readings, tuple[str, ...]]:
    """Give loads without force in a table the wrench of the cell's `[[loads]]`, by name.

    A note tells of forces in the table whose mean is another one than the cell states.
    """

    def plain(name: str) -> str:
        return "".join(name.split()).casefold()

    s, gravity = readings.states, np.asarray(config.robot.gravity_m_s2)
    wrenches = {plain(load.name): load.wrench(gravity) for load in config.loads}
    wrench, notes, others = s.wrench.copy(), [], []
    for k in np.unique(readings.load):
        name = readings.load_names[k]
        if name == UNLOADED:
            continue
        stated = wrenches.get(plain(name), np.zeros(6))[:3]
        if s.wrench[readings.load == k].any():
            off = np.linalg.norm(s.wrench[readings.load == k, :3].mean(axis=0) - stated)
            if 0 < OTHER_LOAD * np.linalg.norm(stated) < off:
                others.append(f"{name} (by {off / np.linalg.norm(stated):.1%})")
            continue
        origin = "is not stated by the table, nor by [[loads]] of the cell: it is taken as 0"
        if plain(name) in wrenches:
            wrench[readings.load == k] = wrenches[plain(name)]
            origin = "is that of [[loads]] of the cell, since the table states none"
        notes.append(f"load {name}: its force {origin}")
    if others:
        notes.append(
            "the mean force in the table is another one than by [[loads]] of the cell under "
            f"{', '.join(others)}: the fit takes the table's, so that errors of the sensor are in "
            "its compliances; predictions under the names of these loads take the cell's"
        )
    return replace(readings, states=replace(s, wrench=wrench)), tuple(notes)


MEANT_APART, FEWEST_MEANS = 10.0, 3  # last digits that repeats are apart; rows; choices


def without_copies(readings: Readings) -> tuple[Readings, tuple[str, ...]]:
    """Leave out rows that are copies of another row to the last digit, with a note.

    A repeated measurement scatters, a copy does not. Equal rows may be measurements, and stay, in
    different cycles, or where rows have no times and positions are rounded to more than their
    noise. Copies of another pose's row stay where their pose has rows that are no copies.
    """
    s, value = readings.states, readings.value
    rounding = np.sqrt(12.0 * rounding_variance(value[:, :3], 1.0))
    noise = np.sqrt(np.median(readings.covariance[:, range(3), range(3)], axis=0))
    if s.time is None and np.any(rounding > noise):
        return readings, ()
    scalars = [s.time, s.load_time, s.air_temperature]
    columns = [s.q, s.wrench, value, *(x[:, None] for x in scalars if x is not None)]
    names = np.stack([readings.load, readings.cycle, readings.line], axis=1)
    keys = np.nan_to_num(np.concatenate([*columns, names], axis=1), nan=np.inf)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    original = first[inverse.reshape(-1)]
    copied = original != np.arange(len(readings))
    same = readings.pose == readings.pose[original]
    only_copies = ~np.isin(readings.pose, readings.pose[~copied])
    copied &= same | only_copies
    if not copied.any():
        return readings, ()
    k = int(np.argmax(copied))
    name = f"{readings.pose_names[readings.pose[k]]}/{readings.load_names[readings.load[k]]}"
    note = (
        f"{int(copied.sum())} of {len(copied)} rows are copies of others to the last digit (the "
        f"first is of {name}): each is counted once, since a reading that is made again scatters; "
        "take them out of the table"
    )
    return readings[~copied], (note,)


def means_noted(readings: Readings) -> tuple[str, ...]:
    """Note rows that are the mean of the other rows of their state: they count twice."""
    value = readings.value[:, :3]
    state = numbered(readings.pose, readings.load, readings.cycle, readings.line)
    size = np.bincount(state)[state][:, None]
    total = np.stack([np.bincount(state, x)[state] for x in value.T], axis=1)
    last_digit = np.sqrt(12.0 * rounding_variance(value, 1.0)) + 1e-9
    off = np.abs(value - total / size) / last_digit  # from the mean of all
    scattered = np.zeros(state.max() + 1)
    np.maximum.at(scattered, state, off.max(axis=1))
    mean = (size[:, 0] > 2) & np.all(off <= 1.0, axis=1) & (scattered[state] > MEANT_APART)
    states = len(np.unique(state[size[:, 0] > 2]))
    if mean.sum() < FEWEST_MEANS or 2 * len(np.unique(state[mean])) < states:
        return ()
    k = int(np.argmax(mean))
    name = f"{readings.pose_names[readings.pose[k]]}/{readings.load_names[readings.load[k]]}"
    return (
        f"{int(mean.sum())} of {len(mean)} rows are the mean of the others of their state (the "
        f"first is of {name}): what was measured counts twice; take them out of the table",
    )


def write_table(
    readings: Readings,
    path: str | Path,
    covers: str = INSTRUMENT,
    about: Mapping[str, object] | None = None,
    units: Sequence[str] | None = None,
) -> None:
    """Write an exchange table that `import_table` reads back exactly: CSV, or Parquet by its name.

    `covers` says what the covariances cover, see `covers_with_rounding`; `units` are those of
    the joints' values (`Arm.units`), all rad where None.
    """
    about = {"table": "readings", "covers": covers, **(about or {})}
    write_columns(Path(path), exchange_columns(readings, covers, units), about)


def exchange_columns(
    readings: Readings, covers: str = INSTRUMENT, units: Sequence[str] | None = None
) -> dict[str, Column]:
    """Return the columns of an exchange table; arguments and errors as of `write_table`."""
    out: dict[str, Column] = {
        "pose": _checked_names(readings.pose_names, readings.pose, "pose"),
        "load": _checked_names(readings.load_names, readings.load, "load"),
    }
    if readings.states.target is not None:
        out[columns.TARGET] = _checked_names(readings.target_names, readings.target, columns.TARGET)
    if readings.states.observer is not None:
        out |= columns.observer_columns(readings)
    if covers != INSTRUMENT:
        out[columns.COVERS] = [covers] * len(readings)
    return out | _number_columns(readings, units)


def covers_with_rounding(covers: str, readings: Readings) -> str:
    """Return the word of column `covers` that keeps reading from adding rounding's variance."""
    positioned = ~readings.scalar
    if not positioned.any():
        return covers
    rounding = rounding_variance(readings.value[positioned, :3], 1.0)
    return covers + ROUNDING * bool(with_rounding(readings.covariance[positioned], rounding)[1])


def _checked_names(names: Sequence[str], index: Ints, kind: str) -> list[str]:
    used = [names[k] for k in dict.fromkeys(index.tolist())]
    for name in used:
        if not check_name(name, kind) or name != name.strip():
            raise InputError(f"{kind} {name!r}: a name must be not empty and not padded")
        if kind == "load" and name != "none" and name.lower() == "none":
            raise InputError(f"load '{name}' must be spelled 'none'")
        if used.count(name) > 1:
            raise InputError(f"{kind} '{name}': two of the readings' {kind}s have this name")
    return [names[k] for k in index.tolist()]


def _number_columns(readings: Readings, units: Sequence[str] | None) -> dict[str, Column]:
    s, m, n = readings.states, readings.m, readings.states.q.shape[1]
    i, j = np.triu_indices(m)
    value, cov = readings.value.copy(), readings.covariance[:, i, j]
    scalar, joint_units = readings.scalar, units or n
    value[scalar] = cov[scalar] = np.nan
    loaded = np.any(s.wrench) or np.signbit(s.wrench).any()
    blocks: list[tuple[Sequence[str], Floats | Ints | None]] = [
        (("cycle",), readings.cycle),
        (columns.joint_columns(joint_units), s.q),
        ((columns.POSITION + columns.ROTATION)[:m], None if scalar.all() else value),
        (columns.covariance_columns(m), None if scalar.all() else cov),
        (columns.WRENCH, s.wrench if loaded else None),
        (("time_s",), s.time),
        (("load_time_s",), s.load_time),
        (("air_degC",), s.air_temperature),
        (columns.temperature_columns(n), s.joint_temperature),
        (columns.approach_columns(n), s.approach),
        (columns.actual_columns(joint_units), s.q_actual),
        (columns.torque_columns(joint_units), s.torque),
    ]
    return {
        name: column
        for names, block in blocks
        if block is not None
        for name, column in zip(names, block.reshape(len(readings), len(names)).T, strict=True)
    }
