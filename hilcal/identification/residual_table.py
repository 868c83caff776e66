"""The residuals of a fit as columns, one row per reading."""

from collections.abc import Sequence

import numpy as np

from hilcal.identification.fit import Fit, all_left_out, mahalanobis2, with_outliers
from hilcal.readings.readings import Readings
from hilcal.tables.write import Column
from hilcal.types import Floats, Ints

ELEMENTS = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")


def residual_table(fit: Fit) -> dict[str, Column]:
    """Return residuals, measured − predicted, with what was measured; SI.

    `residual_…` is of the fit, `left_out_…` of predictions without the reading's pose, both in
    axes of the sensor and, with `base_` in the name, of the base. `sigma` is the root of the
    squared Mahalanobis distance of the fit's residual, `set_aside` marks gross errors, which were
    not fitted. A reading that is no measurement of its own (the unloaded one of a deflection) has
    no residual.

    Args:
        fit: the fit.
    """
    r, (raw, w) = fit.readings, with_outliers(fit)
    left_out = all_left_out(fit)[0]
    table = named(r)
    table["set_aside"] = fit.outlier.astype(int)
    table["sigma"] = _spread(np.sqrt(mahalanobis2(raw, w.covariance))[:, None], w.reading, r)[0]
    for what, values in (("residual", raw), ("left_out", left_out)):
        parts = values.reshape(len(values), -1, 3)
        base = (parts @ fit.frames.base[:3, :3]).reshape(values.shape)
        for frame, of in (("", values), ("base_", base)):
            columns = _spread(of, w.reading, r)
            names = (f"{what}_{frame}{element}" for element in ELEMENTS[: values.shape[1]])
            table |= dict(zip(names, columns, strict=True))
    return table


def named(r: Readings) -> dict[str, Column]:
    """Columns that say which reading each row is of; readings count from 1."""
    table: dict[str, Column] = {
        "reading": np.arange(1, len(r) + 1),
        "pose": [r.pose_names[k] for k in r.pose.tolist()],
        "load": [r.load_names[k] for k in r.load.tolist()],
        "cycle": r.cycle,
    }
    if r.states.target is not None:
        table["target"] = [r.target_names[k] for k in r.target.tolist()]
    return table


def _spread(values: Floats, reading: Ints, r: Readings) -> Sequence[list[float | None]]:
    """Columns of values (D, k) at their readings, None elsewhere."""
    out: list[list[float | None]] = [[None] * len(r) for _ in range(values.shape[1])]
    for column, given in zip(out, values.T, strict=True):
        for k, value in zip(reading.tolist(), given.tolist(), strict=True):
            column[k] = value
    return out
