"""All readings of a fit, those set aside included: their prediction, and why they were set aside.

Also the error before any fit, and the residuals as columns of a table.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.identification.fit import (
    Fit,
    all_left_out,
    in_base_axes,
    mahalanobis2,
    sensor_axes,
    with_outliers,
)
from hilcal.identification.gauss_newton import solve
from hilcal.identification.outliers.least_trimmed_squares import MOST_WRONG
from hilcal.identification.residual import ErrorBlock, error_block, noise_floor, residual
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, whitening
from hilcal.tables.write import Column
from hilcal.types import Floats, Ints

ALIKE_QUANTILE = 1e-3  # χ² quantile of the distance below which two readings are alike; a choice
STALE_SHARE = 1e-3  # a reading that repeats another to this share of σ is stale; a choice
NAMED_AXIS_SHARE = 0.8  # share of the whitened error that an axis must have to be named; a choice
SWAPPED_SHARE = 0.1
"""Share of an error that another target's place may leave: centimetres; a choice."""
AXES = ("x", "y", "z", "rotation about x", "rotation about y", "rotation about z")
ELEMENTS = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")


@dataclass(frozen=True, slots=True, eq=False)
class FullPrediction:
    """D measurements, fitted or set aside; the same ones for all fits of equal readings."""

    readings: Readings  # all of them
    whitening: Whitening  # their gc-scaling; `whitening.reading` (D,) are rows of `readings`
    raw: Floats  # (D, m) residual, sensor axes
    model: Model
    theta: Floats  # (P,) parameters of the model

    @property
    def prediction(self) -> Prediction:
        """Prediction of all readings."""
        return self.model.predict(self.readings.states, self.theta)

    @property
    def mahalanobis2(self) -> Floats:
        """(D,) squared Mahalanobis distance of each measurement by itself."""
        return mahalanobis2(self.raw, self.whitening.covariance)

    @property
    def noise_factor(self) -> float:
        """Standard deviation of the noise in units of that of the covariance.

        1; beside a background the estimated factor of the instrument's noise (`ArmScatter.unit`).
        """
        scatter = self.readings.arm_scatter
        return 1.0 if scatter is None else scatter.unit

    @property
    def noise_floor(self) -> float:
        """Root mean square of the 3-D position error under noise alone, m."""
        return self.noise_factor * noise_floor(self.whitening.covariance)

    def name(self, measurement: int) -> tuple[str, str]:
        """Pose and load of a measurement."""
        return reading_name(self.readings, int(self.whitening.reading[measurement]))

    def target_name(self, measurement: int) -> str:
        """Target of a measurement; '' where there is one."""
        r = self.readings
        if r.states.target is None:
            return ""
        return str(r.target_names[int(r.target[self.whitening.reading[measurement]])])


def reading_name(readings: Readings, row: int) -> tuple[str, str]:
    """Pose and load of a reading."""
    return readings.pose_names[readings.pose[row]], readings.load_names[readings.load[row]]


def full_prediction(fit: Fit) -> FullPrediction:
    """Predict all readings of a fit."""
    raw, w = with_outliers(fit)
    return FullPrediction(fit.readings, w, raw, fit.model, fit.theta)


@lru_cache(maxsize=1)
def nominal_error(fit: Fit) -> ErrorBlock:
    """Return the error of the rigid nominal arm at the readings of a fit, m.

    Of deflections it is the deflection itself. Of absolute readings it is what remains where the
    unknown frames (registration, target) are fitted to the nominal arm alone: those of a fitted
    model belong to its other parameters.
    """
    used, w = fit.readings[~fit.outlier], fit.whitening
    frames = tuple(x for x in fit.model.effects if x.role in FRAME_ROLES)
    rigid = Model(fit.model.cell, frames if fit.mode == "absolute" else (), fit.model.catalogue)
    theta = np.zeros(0)
    if rigid.effects:
        theta = solve(rigid, used, whitening(used, fit.mode, fit.scaling), None, None).theta
    return error_block(residual(used, rigid.predict(used.states, theta), w), w)


def residual_table(fit: Fit) -> dict[str, Column]:
    """Return residuals, measured − predicted, by pose, load and cycle; SI, one row per reading.

    `residual_…` is of the fit, `left_out_…` of predictions without the reading's pose, both in
    axes of the sensor and, with `base_` in the name, of the base. `sigma` is the root of the
    squared Mahalanobis distance of the fit's residual, `set_aside` marks gross errors, which were
    not fitted. A reading that is no measurement of its own (the unloaded one of a deflection) has
    no residual.
    """
    r, (raw, w) = fit.readings, with_outliers(fit)

    def spread(values: Floats) -> list[float | None]:
        """A column of values (D,) at their readings, None elsewhere."""
        by_reading = dict(zip(w.reading.tolist(), values.tolist(), strict=True))
        return [by_reading.get(k) for k in range(len(r))]

    table: dict[str, Column] = {
        "reading": np.arange(1, len(r) + 1),
        "pose": [r.pose_names[k] for k in r.pose.tolist()],
        "load": [r.load_names[k] for k in r.load.tolist()],
        "cycle": r.cycle,
    }
    if r.states.target is not None:
        table["target"] = [r.target_names[k] for k in r.target.tolist()]
    table["set_aside"] = fit.outlier.astype(int)
    table["sigma"] = spread(np.sqrt(mahalanobis2(raw, w.covariance)))
    axes = sensor_axes(fit, full_prediction(fit).prediction.observation)[w.reading]
    for kind, values in (("residual", raw), ("left_out", all_left_out(fit)[0])):
        base = in_base_axes(values, axes)
        for frame, components in (("", values), ("base_", base)):
            for element, column in zip(ELEMENTS, components.T, strict=False):
                table[f"{kind}_{frame}{element}"] = spread(column)
    return table


@dataclass(frozen=True, slots=True)
class GrossError:
    """A reading that was set aside."""

    row: int  # of the readings
    pose: str
    load: str
    sigma: float  # Mahalanobis distance from the prediction of the fit
    reason: str  # likely cause, or the error by axes, in a phrase


def gross_errors(fit: Fit) -> tuple[GrossError, ...]:
    """List the readings set aside, in order.

    Of deflections that share an unloaded reading that was set aside, only that one is listed.
    """
    if not fit.outlier.any():
        return ()
    e = full_prediction(fit)
    errors: dict[int, GrossError] = {}
    first = 0
    for b in e.whitening.buckets:
        size = b.loaded.shape[1]
        for g in range(len(b.loaded)):
            measurements = first + g * size + np.arange(size)
            out = fit.outlier[b.reference[g]]
            for u in np.flatnonzero(out):
                row, affected = int(b.reference[g, u]), b.weights[:, u] > 0
                alone = bool(np.all(b.weights[affected, u] == 1.0))
                errors[row] = _shared(e, row, measurements[affected], alone)
            # Deflections without a remaining unloaded reading are not listed one by one.
            lost = (b.weights @ out > 1.0 - 1e-9) if len(out) else np.zeros(size, dtype=bool)
            for k, r in zip(measurements[~lost], b.loaded[g, ~lost], strict=True):
                if fit.outlier[r]:
                    errors[int(r)] = _gross_error(e, int(r), e.raw[k], e.whitening.covariance[k])
        first += b.loaded.size
    return tuple(errors[row] for row in sorted(errors))


def _shared(e: FullPrediction, row: int, measurements: Ints, alone: bool) -> GrossError:
    """Gross error of an unloaded reading, from the deflections that refer to it."""
    rows, v = e.whitening.reading[measurements], e.readings.covariance
    off, many = -np.median(e.raw[measurements], axis=0), len(rows)
    error = _gross_error(e, row, off, v[row] + v[rows].sum(axis=0) / many**2)
    if not alone:
        return error
    which = f"its {many} deflections" if many > 1 else "its deflection"
    return replace(error, reason=f"{error.reason}; {which} set aside with it")


def _gross_error(e: FullPrediction, row: int, off: Floats, covariance: Floats) -> GrossError:
    r = e.readings
    reason = (
        _stale(r, row)
        or _another_target(e, row, off)
        or _like_another(r, row)
        or _by_axis(off, covariance)
    )
    if r.states.target is not None:
        reason = f"target {r.target_names[r.target[row]]}: {reason}"
    return GrossError(row, *reading_name(r, row), _distance(off, covariance), reason)


def _another_target(e: FullPrediction, row: int, off: Floats) -> str:
    """Phrase for a reading that lies where the prediction has another target, or ''."""
    r = e.readings
    if r.states.target is None:
        return ""
    state, count = r.states[row : row + 1], len(r.target_names)
    places = [
        e.model.predict(replace(state, target=np.array([k])), e.theta).observation.position[0]
        for k in range(count)
    ]
    away = [float(np.linalg.norm(off[:3] - (x - places[r.target[row]]))) for x in places]
    candidates = [k for k in range(count) if k != r.target[row]]
    closest = min(candidates, key=lambda k: away[k], default=-1)
    if closest < 0 or away[closest] >= SWAPPED_SHARE * float(np.linalg.norm(off[:3])):
        return ""
    return f"lies where {r.target_names[closest]} is: were they swapped?"


def _stale(r: Readings, row: int) -> str:
    std = np.sqrt(np.maximum(np.diagonal(r.covariance[row]), 1e-300))
    if row and np.all(np.abs(r.value[row] - r.value[row - 1]) <= STALE_SHARE * std):
        return "equal to the reading before: not taken anew (stale)?"
    return ""


def _like_another(r: Readings, row: int) -> str:
    """Phrase for a reading that agrees with one under another load at the same pose, or ''."""
    candidates = (r.pose == r.pose[row]) & (r.load != r.load[row]) & (r.target == r.target[row])
    away = {
        k: _distance(r.value[row] - r.value[k], r.covariance[row] + r.covariance[k])
        for k in np.flatnonzero(candidates).tolist()
    }
    closest = min(away, key=lambda k: away[k], default=-1)
    if closest < 0 or away[closest] ** 2 >= float(scipy.stats.chi2.isf(ALIKE_QUANTILE, r.m)):
        return ""
    load = r.load_names[r.load[closest]]
    if load == "none":
        return "like the unloaded reading: was the load hung?"
    if r.unloaded[row]:
        return f'like the reading under "{load}": was the load still hung?'
    return f'like the reading under "{load}": was that load hung?'


def _by_axis(off: Floats, covariance: Floats) -> str:
    white = np.abs(off) / np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    axis, sigma = int(np.argmax(white)), _distance(off, covariance)
    mostly = white[axis] >= NAMED_AXIS_SHARE * float(np.linalg.norm(white))
    return f"{sigma:.0f} σ off in {AXES[axis]}" if mostly else f"{sigma:.0f} σ off"


def _distance(off: Floats, covariance: Floats) -> float:
    """Mahalanobis distance in the range of a covariance, which may be singular."""
    square = float(off @ np.linalg.pinv(covariance, hermitian=True) @ off)
    return float(np.sqrt(max(square, 0.0)))


def disagreement_words(fit: Fit) -> str:
    """Return the disagreement of a fit's readings in a sentence; empty where there is none."""
    disagreement, readings = fit.disagreement, fit.readings
    if disagreement is None:
        return ""
    count = f"{len(disagreement.rows)} of {len(readings)}"
    if disagreement.kind == "many":
        return (
            f"more than {100 * MOST_WRONG:.0f} % of the readings disagree with what the others "
            f"agree on, too many to tell wrong ones from right ones ({count} are beyond "
            "the noise): none was set aside, and nothing that is fitted to them holds; an effect "
            "is missing, or something went wrong in measuring"
        )
    first, last = ("/".join(reading_name(readings, int(disagreement.rows[k]))) for k in (0, -1))
    return (
        f"{count} readings, between {first} and {last}, are off by the same shift, so that they "
        "have one cause: another reflector, a target moved on the tool, a tracker that was bumped. "
        "They were not set aside; give them a target of their own, or leave them out"
    )
