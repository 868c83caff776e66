"""Stated uncertainties that cannot be right: zero, far too small, below the values' rounding."""

import numpy as np

from hilcal.errors import InputError
from hilcal.tables.csvfile import CsvTable
from hilcal.types import Bools, Floats

LEAST = (1e-7, 1e-7)
"""m, rad; no instrument in air measures an arm to better than 0.1 µm and 0.02": a choice, about
the resolution of the best."""
DISTINCT = 10
"""Different values that are needed to tell rounding: ten that end in zero by chance are one case
in 10^10."""
COUNTS = 0.01
"""Rounding is added where its variance is more than this share of the stated one; a choice."""
_FINEST = 1e-9
_PLAUSIBLE = (1e-6, 1e-3)
"""m; standard deviations that a tracker or a camera states, to guess what was meant."""


def floored(
    table: CsvTable, covariance: Floats, instrument: Floats | None
) -> tuple[Floats, tuple[str, ...]]:
    """Raise variances that are zero, or far below the others, to those of the instrument.

    An instrument that writes 0.000 has a scatter below its last digit, not none; such a reading
    would outweigh all others. Adding to a diagonal element keeps a covariance positive.

    Args:
        table: for messages.
        covariance: (N, m, m), m² and rad².
        instrument: covariances (N, m, m) of the noise in [tracker]; None where it is not known.

    Returns:
        The covariances, and a note that counts the rows.

    Raises:
        InputError: the usual standard deviation is below 0.1 µm or 1e-7 rad; or a zero where the
            instrument's noise is not known.
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    m = variance.shape[1]
    tiny = np.zeros(variance.shape, dtype=bool)
    for block, least, unit in ((slice(0, 3), LEAST[0], "m"), (slice(3, m), LEAST[1], "rad")):
        v = variance[:, block]
        if not v.size:
            continue
        positive = v[v > 0]
        usual = float(np.sqrt(np.median(positive))) if len(positive) else 0.0
        if 0 < usual < least:
            i = int(np.argmax((v > 0).any(axis=1)))
            raise InputError(
                f"{table.at(i)}: the stated standard deviations are {usual:.2g} {unit} as a rule; "
                f"no instrument reaches {least:g} {unit}{_meant(usual) if unit == 'm' else ''}"
            )
        tiny[:, block] = (v >= 0) & (v < least**2)
    rows: Bools = np.asarray(tiny.any(axis=1))
    if not rows.any():
        return covariance, ()
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
    return out, (note,)


def _meant(usual: float) -> str:
    low, high = _PLAUSIBLE
    looks = []
    if low <= np.sqrt(usual) <= high:
        looks.append("variances given as standard deviations")
    if low <= 1e3 * usual <= high:
        looks.append("a unit that is 1000 times too small")
    if looks:
        return f"; looks like {' or '.join(looks)}"
    return "; expected the standard deviations, or the covariance in m², of each reading"


def step(values: Floats) -> float:
    """Return the power of ten of which all values are whole multiples; 0 where there is none.

    Fewer than `DISTINCT` different values do not tell.
    """
    if len(np.unique(values)) < DISTINCT:
        return 0.0
    for power in range(3, -10, -1):
        size = 10.0**power
        count = values / size
        if np.all(np.abs(count - np.rint(count)) < 1e-6 + 1e-15 * np.abs(count)):
            return size
    return 0.0


def rounding_variance(position: Floats, unit: float) -> Floats:
    """(3,) variance Δ²/12 of each axis, m², of positions (N, 3) that are multiples of Δ.

    Args:
        position: in the file's unit.
        unit: metres in that unit.
    """
    delta = unit * np.array([step(position[:, k]) for k in range(3)])
    return np.asarray(np.where(delta > _FINEST, delta, 0.0) ** 2 / 12)


def with_rounding(covariance: Floats, extra: Floats) -> tuple[Floats, tuple[str, ...]]:
    """Add what rounding does to the positions, where it counts beside the stated covariance.

    Args:
        covariance: (N, m, m), m².
        extra: (3,) variances of the rounding, m².
    """
    counts: Bools = extra > COUNTS * np.median(covariance[:, range(3), range(3)], axis=0)
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
    """Return a note where rounded joint angles move the target more than the noise does.

    A rounding of Δ displaces the target by up to Δ/√12 times the reach, one standard deviation.

    Args:
        q: (N, n) in the file's unit.
        unit: radians in that unit.
        name: of the unit.
        covariance: (N, m, m), m².
        reach: of the arm, m.
    """
    size = max(step(q[:, k]) for k in range(q.shape[1]))
    std = unit * size / np.sqrt(12)
    noise = float(np.sqrt(np.median(covariance[:, range(3), range(3)])))
    if std * reach <= noise:
        return ()
    return (
        f"joint angles are rounded to {size:g} {name}, up to {1e3 * std * reach:.2g} mm at the "
        f"target, more than the noise; write more digits, or count it: [repeatability] "
        f"joint_std_rad = {std:.2g}",
    )
