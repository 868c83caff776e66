"""Covariances from what a table states: standard deviations, U95, variances, matrices."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise, tracker_covariance
from hilcal.tables import units
from hilcal.tables.csvfile import CsvTable
from hilcal.tables.grid import Grid
from hilcal.tables.mapping import Mapping
from hilcal.tables.mapping_sections import Column, CovarianceColumns, Std
from hilcal.tables.orientation import angle_axes
from hilcal.tables.stated_noise import floored
from hilcal.types import Floats

FAR = 5.0
"""Ratio of stated and instrument's standard deviation that is worth a word; a choice."""
NEAR = 3.0
"""Ratio within which another reading of the figures fits the instrument; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Stated:
    """(N, m, m) covariances, m² and rad², None where the table states none; and notes."""

    value: Floats | None
    notes: tuple[str, ...]


def stated_covariance(
    table: CsvTable,
    grid: Grid,
    mapping: Mapping,
    position: Floats,
    angles: Floats | None,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None,
) -> Stated:
    """Return the covariances that the table states.

        V = E D C D Eᵀ + V_tracker

    with D the standard deviations (of the position's axes and the orientation's angles), C their
    correlation, E the axes about which the angles turn, and the instrument's covariance where the
    mapping adds it. Orientations without a figure of their own have the instrument's.

    Args:
        table: the columns in SI units, for messages.
        grid: the columns as the file holds them.
        mapping: what they hold.
        position: (N, 3) m.
        angles: (N, k) the orientation's numbers in the file's unit; None for positions.
        noise: of the instrument.
        station: (3,) where its beam starts.

    Raises:
        InputError: a figure that is missing or cannot be right.
    """
    m = 3 if angles is None else 6
    origin = np.zeros(3) if station is None else np.asarray(station, dtype=float)
    if mapping.std is not None:
        cov, words = _of_std(grid, mapping, mapping.std, len(position))
    elif mapping.covariance is not None:
        cov, words = _of_matrix(grid, mapping.covariance), "covariance: from the table"
    else:
        return Stated(None, ())
    instrument = None if noise is None else tracker_covariance(position, noise, origin, m)
    known = cov.shape[1]
    if known < m:
        whole = np.zeros((len(position), m, m))
        if instrument is None:
            raise InputError(f"{grid.path}: no uncertainty of the orientation; give six figures")
        whole[:, 3:, 3:] = instrument[:, 3:, 3:]
        whole[:, :3, :3] = cov
        cov, words = whole, f"{words}; orientations: the noise in [tracker]"
    if known == 6 and angles is not None and mapping.orientation is not None:
        o = mapping.orientation
        axes = angle_axes(o.convention, angles, units.ANGLES[o.unit])
        turn = np.broadcast_to(np.eye(6), cov.shape).copy()
        turn[:, 3:, 3:] = axes
        cov = turn @ cov @ np.swapaxes(turn, 1, 2)
        cov = 0.5 * (cov + np.swapaxes(cov, 1, 2))
    notes: tuple[str, ...] = ()
    if mapping.std is not None and mapping.std.add_instrument:
        if instrument is None:
            raise InputError(f"{grid.path}: [std] add_instrument needs the noise in [tracker]")
        cov, words = cov + instrument, f"{words}, plus the noise in [tracker]"
    else:
        cov, notes = floored(table, cov, instrument)
    doubt = () if instrument is None else _doubt(mapping, cov, instrument)
    return Stated(cov, (words, *notes, *doubt))


def _block(grid: Grid, columns: Sequence[Column]) -> Floats:
    """(N, k) figures of columns; every row has one.

    Raises:
        InputError: a cell without a value.
    """
    values = np.stack([grid.numbers(column) for column in columns], axis=1)
    bad = np.isnan(values)
    if bad.any():
        i, j = divmod(int(np.argmax(bad)), values.shape[1])
        raise InputError(
            f"{grid.at(i, grid.name(columns[j]))}: no value; every reading needs its uncertainty "
            f"(take the column out of the mapping to use the noise in [tracker])"
        )
    return values


def _of_std(grid: Grid, mapping: Mapping, std: Std, count: int) -> tuple[Floats, str]:
    if std.columns:
        figures = _block(grid, std.columns)
        bad = figures < 0
        if bad.any():
            i, j = divmod(int(np.argmax(bad)), figures.shape[1])
            raise InputError(
                f"{grid.at(i, grid.name(std.columns[j]))}: {figures[i, j]:g}: a "
                f"{'variance' if std.kind == 'variance' else 'standard deviation'} is 0 or more"
            )
    else:
        figures = np.tile(np.array(std.values, dtype=float), (count, 1))
    what = {
        "std": "standard deviations",
        "expanded": f"expanded uncertainties (k = {std.k:g})",
        "variance": "variances",
    }[std.kind]
    sigma = np.sqrt(figures) if std.kind == "variance" else figures
    if std.kind == "expanded":
        sigma = sigma / std.k
    if sigma.shape[1] == 1:
        sigma = np.repeat(sigma, 3, axis=1) / (np.sqrt(3) if std.of == "point" else 1.0)
    scale = [units.LENGTHS[std.unit]] * 3 + [units.ANGLES[std.angle_unit]] * 3
    sigma = sigma * np.array(scale[: sigma.shape[1]])
    m = sigma.shape[1]
    correlation = np.broadcast_to(np.eye(m), (count, m, m)).copy()
    if mapping.correlation is not None:
        i, j = np.triu_indices(m, 1)
        if len(mapping.correlation.columns) != len(i):
            raise InputError(
                f"{grid.path}: [correlation] has {len(mapping.correlation.columns)} columns; "
                f"{m} standard deviations need {len(i)}"
            )
        value = _block(grid, mapping.correlation.columns)
        correlation[:, i, j] = correlation[:, j, i] = value
    where = "from the table" if std.columns else "the same for all readings"
    return (
        sigma[:, :, None] * correlation * sigma[:, None, :],
        f"covariance: {what}, {where}",
    )


def _of_matrix(grid: Grid, section: CovarianceColumns) -> Floats:
    figures = _block(grid, section.columns)
    count, k = figures.shape
    m = 3 if k <= 9 else 6
    if k in (9, 36):
        cov = figures.reshape(count, m, m)
        off = np.abs(cov - np.swapaxes(cov, 1, 2)).max(axis=(1, 2))
        bad = off > 1e-3 * np.abs(cov).max(axis=(1, 2))
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(
                f"{grid.at(i, grid.name(section.columns[0]))}: the covariance is not symmetric"
            )
        cov = 0.5 * (cov + np.swapaxes(cov, 1, 2))
    else:
        upper, right = np.triu_indices(m)
        cov = np.zeros((count, m, m))
        cov[:, upper, right] = cov[:, right, upper] = figures
    scale = np.array(
        ([units.LENGTHS[section.unit]] * 3 + [units.ANGLES[section.angle_unit]] * 3)[:m]
    )
    return np.asarray(scale[:, None] * cov * scale)


def _doubt(mapping: Mapping, cov: Floats, instrument: Floats) -> tuple[str, ...]:
    """Return a note where the figures fit the instrument when they are read otherwise."""
    std = mapping.std
    if std is None or std.kind == "expanded" or std.add_instrument:
        return ()
    unit = units.LENGTHS[std.unit]
    stated = float(np.sqrt(np.median(cov[:, range(3), range(3)])))
    usual = float(np.sqrt(np.median(instrument[:, range(3), range(3)])))
    if 1 / FAR < stated / usual < FAR:
        return ()
    figure = stated / unit
    other = unit * (figure**2 if std.kind == "variance" else np.sqrt(figure))
    if not 1 / NEAR < other / usual < NEAR:
        return ()
    kind = "standard deviations" if std.kind == "variance" else "variances"
    return (
        f"the stated standard deviations are {1e6 * stated:.3g} µm as a rule, the instrument's in "
        f"[tracker] {1e6 * usual:.3g} µm; read as {kind} the figures would be {1e6 * other:.3g} "
        f"µm: check [std] kind and unit",
    )
