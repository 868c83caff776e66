"""Importing a table of any form: its readings with the noise, targets and loads of the cell."""

from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.config import CellConfig
from hilcal.errors import InputError
from hilcal.readings.averaging import averaged_samples
from hilcal.readings.covariance import INSTRUMENT, INSTRUMENT_AND_ARM, tracker_noise
from hilcal.readings.readings import ObserverName, Readings
from hilcal.robot import chain, se3
from hilcal.robot.arm import Arm
from hilcal.tables import mapping as forms
from hilcal.tables import table as exchange
from hilcal.tables.mapped import import_mapped

ONE_DIRECTION, MANY_DIRECTIONS = 0.99, 0.9  # length of the mean of unit vectors; a choice
SAME_WEIGHT = 0.1  # share by which a measured weight may be off that of the tool; a choice


def import_readings(
    path: Path,
    form: str | Path | forms.Mapping,
    config: CellConfig,
    arm: Arm,
    second: Path | None = None,
) -> exchange.ImportResult:
    """Read a table in the `form` "table" (exchange table), or by a mapping, its name or its file.

    The cell states what a table lacks: noise, frames, targets, and the forces of loads.
    """
    mapping = form if isinstance(form, forms.Mapping) else None
    if mapping is None and str(form) != forms.TABLE:
        mapping = forms.find_mapping(str(form), forms.Mapping)
    tracker, gravity = config.tracker, config.robot.gravity_m_s2
    noise, station = tracker_noise(tracker), tracker.station_m
    targets, std = [target.name for target in config.tool.targets], _std(config)
    if mapping is not None:
        result = import_mapped(path, mapping, arm, noise, station, gravity, second, targets, std)
    elif second is None:
        result = exchange.import_table(path, arm, noise, station, targets, std)
    else:
        raise InputError(f"--second {second}: only for a --format with a section [second_file]")
    where = "" if tracker.frame == "tracker" or station else ", as if it stood at the arm's base"
    notes = tuple(note + where * (note == exchange.FROM_TRACKER) for note in result.notes)
    stated = exchange.FROM_TRACKER not in result.notes
    covers = INSTRUMENT_AND_ARM if stated and config.repeatability.in_tables else result.covers
    readings, copies = exchange.without_copies(result.readings)
    means = exchange.means_noted(readings)
    # an arm's scatter in the covariances is the same in all samples of a standstill
    share = config.acquire.systematic_share if covers == INSTRUMENT else 1.0
    readings, averaged = averaged_samples(readings, share)
    limits.check_fitted(len(readings), readings.m, f"{path}: ")
    readings, named = exchange.named_loads(readings, config)
    weight = config.tool.mass_kg * float(np.linalg.norm(gravity))
    named = (*named, *_forces_of_flange(readings, arm), *_weight_of_tool(readings, weight))
    return exchange.ImportResult(
        readings,
        (*notes, *copies, *means, *averaged, *named),
        covers,
        stated or tracker.states_noise,
        not stated,
    )


def _std(config: CellConfig) -> dict[ObserverName, float]:
    points = {ObserverName("point", k): p.std_m for k, p in config.points.items()}
    gauges = {ObserverName("gauge", k): g.std_m for k, g in config.gauges.items()}
    return {name: std for name, std in (points | gauges).items() if std is not None}


def _forces_of_flange(readings: Readings, arm: Arm) -> list[str]:
    """Note forces that all have one direction if, and only if, they are read in flange axes."""
    s = readings.states
    size = np.linalg.norm(s.wrench[:, :3], axis=1)
    loaded = size > 0
    if not loaded.any():
        return []
    stated = s.wrench[loaded, :3] / size[loaded, None]
    turned = se3.apply(chain.evaluate(arm, s.q[loaded]).rotation[-1], stated)
    in_base, in_flange = (np.linalg.norm(d.mean(axis=0)) for d in (stated, turned))
    if in_flange < ONE_DIRECTION or in_base > MANY_DIRECTIONS:
        return []
    return [
        "taken in base axes the forces have many directions; taken in flange axes they all have "
        'one, as a weight that a sensor at the flange measures: [wrench] axes = "flange" of a '
        "mapping reads them so"
    ]


def _weight_of_tool(readings: Readings, weight: float) -> list[str]:
    """Note forces that are never less than the tool's weight, N, as of a sensor not zeroed."""
    least = float(np.linalg.norm(readings.states.wrench[:, :3], axis=1).min())
    if weight == 0 or abs(least - weight) > SAME_WEIGHT * weight:
        return []
    return [
        f"the least force of all rows, {least:.3g} N, is the weight of the tool by [tool] mass_kg: "
        "was the sensor not zeroed? The tool's weight then counts twice: subtract it in the table, "
        "or set [tool] mass_kg = 0"
    ]
