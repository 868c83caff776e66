"""Import of a table in any format, with the description of its cell."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.config import CellConfig
from hilcal.errors import InputError
from hilcal.readings.covariance import WHOLE, tracker_noise
from hilcal.readings.readings import ObserverName, Readings
from hilcal.robot.arm import Arm
from hilcal.store.plan import UNLOADED
from hilcal.tables.mapped import import_mapped
from hilcal.tables.mapping import TABLE, Mapping, find_mapping
from hilcal.tables.table import FROM_TRACKER, ImportResult, import_table
from hilcal.tables.uncertainty import rounding_variance


def import_readings(
    path: Path, form: str | Path | Mapping, config: CellConfig, arm: Arm, second: Path | None = None
) -> ImportResult:
    """Read a table; the cell states the tracker's noise and place, gravity, and loads.

    `form` is "table" (the exchange table), a mapping, its name or its file; `second` is the second
    file of a mapping of two.
    """
    mapping: Mapping | None = None
    if str(form) != TABLE:
        mapping = form if isinstance(form, Mapping) else find_mapping(form, Mapping)
    tracker, gravity = config.tracker, config.robot.gravity_m_s2
    noise, station = tracker_noise(tracker), tracker.station_m
    targets, std = [target.name for target in config.tool.targets], _std(config)
    if mapping is not None:
        result = import_mapped(path, mapping, arm, noise, station, gravity, second, targets, std)
    elif second is None:
        result = import_table(path, arm, noise, station, targets, std)
    else:
        raise InputError(f"--second {second}: only for a --format with a section [second_file]")
    limits.check_fitted(len(result.readings), result.readings.m, f"{path}: ")
    where = "" if tracker.frame == "tracker" or station else ", as if it stood at the arm's base"
    notes = tuple(note + where * (note == FROM_TRACKER) for note in result.notes)
    stated = FROM_TRACKER not in result.notes
    covers = WHOLE if stated and config.repeatability.in_tables else result.covers
    readings, copies = _without_copies(result.readings)
    readings, named = _named_loads(readings, config)
    return ImportResult(
        readings, (*notes, *copies, *named), covers, stated or tracker.states_noise, not stated
    )


def _std(config: CellConfig) -> dict[ObserverName, float]:
    """Return the standard deviations of distances and heights that the cell states."""
    points = {ObserverName("point", k): p.std_m for k, p in config.points.items()}
    gauges = {ObserverName("gauge", k): g.std_m for k, g in config.gauges.items()}
    return {name: std for name, std in (points | gauges).items() if std is not None}


def _named_loads(readings: Readings, config: CellConfig) -> tuple[Readings, tuple[str, ...]]:
    """Give the loads of a table without forces the wrench of the cell's `[[loads]]`, by name."""

    def plain(name: str) -> str:
        return "".join(name.split()).casefold()

    s, gravity = readings.states, np.asarray(config.robot.gravity_m_s2)
    if s.wrench.any():
        return readings, ()
    wrenches = {plain(load.name): load.wrench(gravity) for load in config.loads}
    wrench, notes = s.wrench.copy(), []
    for k in np.unique(readings.load):
        name = readings.load_names[k]
        if name == UNLOADED:
            continue
        where = "is not stated by the table, nor by [[loads]] of the cell: it is taken as none"
        if plain(name) in wrenches:
            wrench[readings.load == k] = wrenches[plain(name)]
            where = "is that of [[loads]] of the cell, since the table states none"
        notes.append(f"load {name}: its force {where}")
    return replace(readings, states=replace(s, wrench=wrench)), tuple(notes)


def _without_copies(readings: Readings) -> tuple[Readings, tuple[str, ...]]:
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
    keys = np.concatenate([*columns, names], axis=1)
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
