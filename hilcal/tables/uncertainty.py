"""Covariances of the uncertainties that a table states, and checks of what cannot be true."""

from collections.abc import Sequence

import numpy as np

from hilcal.errors import InputError
from hilcal.readings.covariance import SINGULAR, TrackerNoise, tracker_covariance
from hilcal.tables import units
from hilcal.tables.grid import ColumnTable, Grid, first_true
from hilcal.tables.mapping import Column, CovarianceColumns, Mapping, Std
from hilcal.tables.units import angle_axes
from hilcal.types import Bools, Floats

FAR_RATIO = 5.0  # Of stated and instrument's standard deviation, worth a note; a choice
NEAR_RATIO = 3.0  # Within which the figures, read otherwise, fit the instrument; a choice
MIN_STD = (1e-7, 1e-7)  # m, rad; no instrument in air is better than 0.1 µm and 0.02": a choice
DISTINCT = 10  # Values needed to recognise rounding: ten end in zero by chance once in 10^10
ROUNDING_SHARE = 0.01  # Rounding is added where its variance is more than this share; a choice
_FINEST = 1e-9
PLAUSIBLE = (1e-6, 1e-3)  # m; what trackers and cameras state, to guess what was meant


def mapped_covariance(
    table: ColumnTable,
    grid: Grid,
    mapping: Mapping,
    position: Floats,
    angles: Floats | None,
    noise: TrackerNoise | None,
    station: Floats | Sequence[float] | None,
) -> tuple[Floats | None, tuple[str, ...]]:
    """Return the covariances (N, m, m) that the table states, by a mapping, and notes on them.

        V = E D C D Eᵀ + V_tracker

    with D the standard deviations (of the position's axes and the orientation's angles), C their
    correlation, E the axes about which the angles turn, and the instrument's covariance where the
    mapping adds it. Orientations without a stated uncertainty have the instrument's. None where
    the table states none; m² and rad².
    """
    m = 3 if angles is None else 6
    if mapping.std is not None:
        cov, origin = _of_std(grid, mapping, mapping.std, len(position))
    elif mapping.covariance is not None:
        cov, origin = _of_matrix(grid, mapping.covariance), "covariance: from the table"
    else:
        return None, ()
    instrument = None if noise is None else tracker_covariance(position, noise, station, m)
    size = cov.shape[1]
    source = "[tracker]" if mapping.instrument is None else "[instrument] of the mapping"
    if size < m:
        full = np.zeros((len(position), m, m))
        if instrument is None:
            raise InputError(f"{grid.path}: no uncertainty of the orientation; give six figures")
        full[:, 3:, 3:] = instrument[:, 3:, 3:]
        full[:, :3, :3] = cov
        cov, origin = full, f"{origin}; orientations: the noise in {source}"
    if size == 6 and angles is not None and mapping.orientation is not None:
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
        cov, origin = cov + instrument, f"{origin}, plus the noise in {source}"
    else:
        cov, notes = floored(table, cov, instrument)
    doubt = () if instrument is None else _doubt(mapping, cov, instrument)
    return cov, (origin, *notes, *doubt)


def _block(grid: Grid, columns: Sequence[Column]) -> Floats:
    """(N, k) figures of columns; every row has one."""
    values = np.stack([grid.numbers(column) for column in columns], axis=1)
    for i, j in first_true(np.isnan(values)):
        raise InputError(
            f"{grid.at(i, columns[j])}: no value; every reading needs its uncertainty "
            f"(take the column out of the mapping to use the noise in [tracker])"
        )
    return values


_KINDS = {
    "std": "standard deviations",
    "expanded": "expanded uncertainties",
    "variance": "variances",
}


def _of_std(grid: Grid, mapping: Mapping, std: Std, count: int) -> tuple[Floats, str]:
    missing = [name for name in std.columns if isinstance(name, str) and name not in grid.names]
    absent = std.optional and len(missing) == len(std.columns)
    if absent or not std.columns:
        constants = [0.0] * len(std.columns) if absent else std.values
        figures = np.tile(np.array(constants, dtype=float), (count, 1))
    else:
        figures = _block(grid, std.columns)
        for i, j in first_true(figures < 0):
            quantity = "variance" if std.kind == "variance" else "standard deviation"
            where = grid.at(i, std.columns[j])
            raise InputError(f"{where}: {figures[i, j]:g}: a {quantity} is 0 or more")
    label = _KINDS[std.kind] + (f" (k = {std.k:g})" if std.kind == "expanded" else "")
    sigma = np.sqrt(figures) if std.kind == "variance" else figures
    sigma = sigma / (std.k if std.kind == "expanded" else 1.0)
    if std.at_least is not None:
        sigma = np.maximum(sigma, np.repeat(std.at_least, 3)[: sigma.shape[1]])
        label += f" (at least {std.at_least[0]:g} {std.unit}"
        label += f", {std.at_least[1]:g} {std.angle_unit})" if sigma.shape[1] == 6 else ")"
    if sigma.shape[1] == 1:
        sigma = np.repeat(sigma, 3, axis=1) / (np.sqrt(3) if std.of == "point" else 1.0)
    m = sigma.shape[1]
    sigma = sigma * _scale(std, m)
    correlation = np.broadcast_to(np.eye(m), (count, m, m)).copy()
    if mapping.correlation is not None:
        row, column = np.triu_indices(m, 1)
        if len(mapping.correlation.columns) != len(row):
            raise InputError(
                f"{grid.path}: [correlation] has {len(mapping.correlation.columns)} columns; "
                f"{m} standard deviations need {len(row)}"
            )
        value = _block(grid, mapping.correlation.columns)
        correlation[:, row, column] = correlation[:, column, row] = value
    where = "from the table" if std.columns else "the same for all readings"
    where = f"since the table has no column '{missing[0]}'" if absent else where
    return sigma[:, :, None] * correlation * sigma[:, None, :], f"covariance: {label}, {where}"


def _scale(section: Std | CovarianceColumns, m: int) -> Floats:
    return np.repeat([units.LENGTHS[section.unit], units.ANGLES[section.angle_unit]], 3)[:m]


def _of_matrix(grid: Grid, section: CovarianceColumns) -> Floats:
    figures = _block(grid, section.columns)
    count, k = figures.shape
    m = 3 if k <= 9 else 6
    if k in (9, 36):
        cov = figures.reshape(count, m, m)
        transposed = np.swapaxes(cov, 1, 2)
        bad = np.abs(cov - transposed).max(axis=(1, 2)) > 1e-3 * np.abs(cov).max(axis=(1, 2))
        for (i,) in first_true(bad):
            raise InputError(f"{grid.at(i, section.columns[0])}: the covariance is not symmetric")
        cov = 0.5 * (cov + transposed)
    else:
        row, column = np.triu_indices(m)
        cov = np.zeros((count, m, m))
        cov[:, row, column] = cov[:, column, row] = figures
    scale = _scale(section, m)
    return np.asarray(scale[:, None] * cov * scale)


def _doubt(mapping: Mapping, cov: Floats, instrument: Floats) -> tuple[str, ...]:
    """Return a note where another interpretation of the figures fits the instrument."""
    std = mapping.std
    if std is None or std.kind == "expanded" or std.add_instrument:
        return ()
    unit = units.LENGTHS[std.unit]
    stated = float(np.sqrt(np.median(cov[:, range(3), range(3)])))
    usual = float(np.sqrt(np.median(instrument[:, range(3), range(3)])))
    if 1 / FAR_RATIO < stated / usual < FAR_RATIO:
        return ()
    figure = stated / unit
    guess = unit * (figure**2 if std.kind == "variance" else np.sqrt(figure))
    if not 1 / NEAR_RATIO < guess / usual < NEAR_RATIO:
        return ()
    kind = "standard deviations" if std.kind == "variance" else "variances"
    return (
        f"the stated standard deviations have a median of {1e6 * stated:.3g} µm, the instrument's "
        f"in [tracker] of {1e6 * usual:.3g} µm; read as {kind} the figures would be "
        f"{1e6 * guess:.3g} µm: check [std] kind and unit",
    )


def floored(
    table: ColumnTable, covariance: Floats, instrument: Floats | None
) -> tuple[Floats, tuple[str, ...]]:
    """Raise variances that are zero, or far below the others, to the instrument's.

    An instrument that writes 0.000 has some scatter below its last digit; a reading without any
    would outweigh all others. Adding to a diagonal element of a covariance (N, m, m) keeps it
    positive. `instrument` is the covariance of the noise in [tracker]; None if unknown.
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    m = variance.shape[1]
    tiny = np.zeros(variance.shape, dtype=bool)
    for block, least, unit in ((slice(0, 3), MIN_STD[0], "m"), (slice(3, m), MIN_STD[1], "rad")):
        v = variance[:, block]
        if not v.size:
            continue
        positive = v[v > 0]
        usual = float(np.sqrt(np.median(positive))) if len(positive) else 0.0
        if 0 < usual < least:
            i = int(np.argmax((v > 0).any(axis=1)))
            raise InputError(
                f"{table.at(i)}: the stated standard deviations have a median of {usual:.2g} "
                f"{unit}; no instrument reaches {least:g} {unit}"
                f"{_cause(usual) if unit == 'm' else ''}"
            )
        tiny[:, block] = (v >= 0) & (v < least**2)
    rows: Bools = np.asarray(tiny.any(axis=1))
    if not rows.any():
        return _regularised(table, covariance, instrument)
    if instrument is None:
        i = int(np.argmax(rows))
        raise InputError(
            f"{table.at(i)}: a stated variance is {variance[i][tiny[i]][0]:g}; it must be more "
            f"than 0, or [tracker] must state the instrument's noise to take its place"
        )
    floor = np.diagonal(instrument, axis1=1, axis2=2)
    out = covariance.copy()
    k = np.arange(m)
    out[:, k, k] = np.where(tiny, floor, variance)
    note = (
        f"{int(rows.sum())} of {len(rows)} rows state a standard deviation of zero (or below "
        f"0.1 µm, the first is row {table.rows[np.argmax(rows)]}): the noise in [tracker] takes "
        f"its place"
    )
    regular, notes = _regularised(table, out, instrument)
    return regular, (note, *notes)


def _regularised(
    table: ColumnTable, covariance: Floats, instrument: Floats | None
) -> tuple[Floats, tuple[str, ...]]:
    """Raise the variance to the instrument's in the directions in which none is stated.

    These are the eigenvectors of eigenvalue zero of the correlation matrices, as where two errors
    are stated as wholly correlated.
    """
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    products = std[:, :, None] * std[:, None, :]
    values, vectors = np.linalg.eigh(covariance / products)
    none = np.abs(values) <= SINGULAR
    rows: Bools = np.asarray(none.any(axis=1))
    if not rows.any():
        return covariance, ()
    first = int(np.argmax(rows))
    if instrument is None:
        raise InputError(
            f"{table.at(first)}: the covariance is singular, without noise in some direction; give "
            "another one, or state the instrument's noise in [tracker], which takes its place there"
        )
    floor = np.einsum("nji,njk,nki->ni", vectors, instrument / products, vectors)
    spread = vectors * np.where(none, floor, values)[:, None]
    raised = spread @ np.swapaxes(vectors, 1, 2) * products
    note = (
        f"{int(rows.sum())} of {len(rows)} rows state a covariance without noise in some direction "
        f"(it is singular, the first is row {table.rows[first]}): the noise in [tracker] takes its "
        f"place there"
    )
    return np.where(rows[:, None, None], raised, covariance), (note,)


def _cause(usual: float) -> str:
    low, high = PLAUSIBLE
    looks = []
    if low <= np.sqrt(usual) <= high:
        looks.append("variances given as standard deviations")
    if low <= 1e3 * usual <= high:
        looks.append("a unit that is 1000 times too small")
    if looks:
        return f"; looks like {' or '.join(looks)}"
    return "; expected the standard deviations, or the covariance in m², of each reading"


def step(values: Floats) -> float:
    """Return the power of ten of which all values are multiples; 0 for none, or too few values."""
    if len(np.unique(values)) < DISTINCT:
        return 0.0
    for power in range(3, -10, -1):
        size = 10.0**power
        count = values / size
        if np.all(np.abs(count - np.rint(count)) < 1e-6 + 1e-15 * np.abs(count)):
            return size
    return 0.0


def rounding_variance(position: Floats, unit: float) -> Floats:
    """(3,) variance Δ²/12, m², of positions (N, 3) that are multiples of Δ, in a unit."""
    delta = unit * np.array([step(position[:, k]) for k in range(3)])
    return np.asarray(np.where(delta > _FINEST, delta, 0.0) ** 2 / 12)


def with_rounding(covariance: Floats, extra: Floats) -> tuple[Floats, tuple[str, ...]]:
    """Add rounding's variances (3,), m², where they count beside covariances (N, m, m)."""
    counts: Bools = extra > ROUNDING_SHARE * np.median(covariance[:, range(3), range(3)], axis=0)
    if not counts.any():
        return covariance, ()
    out = covariance.copy()
    out[:, range(3), range(3)] += np.where(counts, extra, 0.0)
    std = 1e6 * float(np.sqrt(extra[counts].max()))
    note = (
        f"positions are rounded to {1e3 * np.sqrt(12 * extra[counts].max()):g} mm: the rounding's "
        f"standard deviation, {std:.3g} µm, is added"
    )
    return out, (note,)


def check_joint_rounding(
    q: Floats, unit: float, name: str, covariance: Floats, reach: float
) -> tuple[str, ...]:
    """Return a note where a rounding Δ of the joints, Δ/√12 times the reach, is over the noise."""
    size = max((step(q[:, k]) for k in range(q.shape[1])), default=0.0)
    std = unit * size / np.sqrt(12)
    variance = covariance[:, range(3), range(3)]  # zero where a reading is one number
    noise = float(np.sqrt(np.median(variance[variance > 0.0])))
    if std * reach <= noise:
        return ()
    return (
        f"joint angles are rounded to {size:g} {name}, up to {1e3 * std * reach:.2g} mm at the "
        f"target, more than the noise; write more digits, or add it to the noise: [repeatability] "
        f"joint_std_rad = {std:.2g}",
    )
