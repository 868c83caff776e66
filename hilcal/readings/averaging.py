"""The mean of several samples of one target at rest, and its covariance.

The mean has the covariance of `covariance.covariance_of_mean`. Its factor τ is 1 unless the stated
noise cannot explain the scatter (chi² test, p < `UNEXPLAINED`); then τ is the ratio of scatter and
stated noise.

Gross outliers are omitted: samples whose squared distance from the median, whitened by the mean
stated covariance Σ̄ and relative to the median distance of the samples (at least that of the stated
noise), is less probable than `GROSS_SIGMA`.

Rows of one state that follow one another within `LONGEST_PAUSE_S` are samples: no arm leaves a
pose, comes back and settles within that time. As readings, they would share the arm's scatter of
that arrival, and count it as many times as there are samples. Without a time of each, samples
cannot be distinguished from repeated arrivals that the table lists one after the other.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from hilcal.readings.covariance import covariance_of_mean
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening_matrix
from hilcal.robot import se3
from hilcal.types import Bools, Floats

UNEXPLAINED = 1e-3
"""Level of the test of the scatter against the stated noise; a choice, no study set it."""
GROSS_SIGMA = 6.0
"""Distance of a gross outlier, as the equivalent number of sigmas of a scalar; a guess."""
_LOG_GROSS = float(np.log(2) + scipy.special.log_ndtr(-GROSS_SIGMA))
_MEAN_STEPS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Average:
    """The mean of K samples."""

    value: Floats  # (m,) position in m and, for m = 6, rotation vector in rad, sensor axes
    covariance: Floats  # (m, m) of `value`; rotations as small rotations about the sensor's axes
    scatter: float  # mean square of the scatter over the stated noise; 1 is expected
    scatter_p: float  # p-value of the scatter under the stated noise
    left_out: tuple[int, ...]  # indices of the gross outliers
    warnings: tuple[str, ...] = ()  # for people, one line each

    @property
    def explained(self) -> bool:
        """Whether the stated noise explains the scatter."""
        return self.scatter_p >= UNEXPLAINED


def mean_of_samples(values: Floats, stated: Floats, systematic_share: float = 0.0) -> Average:
    """Average K >= 2 samples (K, m) with stated covariances (K, m, m).

    At least half of them are no outliers: their distances are relative to the median.
    """
    retained = _inliers(values, stated.mean(axis=0))
    prior = stated[retained].mean(axis=0)
    mean, residuals = deviations(values[retained])
    total = float(np.sum((residuals @ whitening_matrix(prior).T) ** 2))  # Σ_k r_kᵀ Σ̄⁻¹ r_k
    dof = residuals.shape[1] * (len(residuals) - 1)
    ratio, p = total / dof, float(scipy.stats.chi2.sf(total, dof))
    factor = 1.0 if p >= UNEXPLAINED else ratio
    covariance = covariance_of_mean(prior, residuals, systematic_share, factor)
    left_out = tuple(int(k) for k in np.flatnonzero(~retained))
    return Average(mean, covariance, ratio, p, left_out)


def deviations(values: Floats) -> tuple[Floats, Floats]:
    """Return the mean (m,) of values (K, m), and the deviations from it (K, m).

    Rotations are averaged in the tangent space: the rotation vectors of R_k R̄ᵀ have the mean zero
    (Fréchet mean; Barfoot, *State Estimation for Robotics*, section 7.3).
    """
    mean = values.mean(axis=0)
    residuals = values - mean
    if values.shape[1] == 6:
        rotations = se3.rotation(values[:, 3:])
        mean_rotation = rotations[0]
        for _ in range(_MEAN_STEPS):
            residuals[:, 3:] = se3.rotation_vector(rotations @ mean_rotation.T)
            step = residuals[:, 3:].mean(axis=0)
            if np.linalg.norm(step) < 1e-14:
                break
            mean_rotation = se3.rotation(step) @ mean_rotation
        mean[3:] = se3.rotation_vector(mean_rotation)
    return mean, residuals


def _inliers(values: Floats, stated: Floats) -> Bools:
    """Return which samples (K,) are no gross outliers."""
    m = values.shape[1]
    white = deviations(values)[1] @ whitening_matrix(stated).T
    square = np.sum((white - np.median(white, axis=0)) ** 2, axis=1)
    usual = max(1.0, float(np.median(square) / scipy.stats.chi2.median(m)))
    return np.asarray(scipy.stats.chi2.logsf(square / usual, m) > _LOG_GROSS)


LONGEST_PAUSE_S = 1.0
"""Longest time from one sample to the next. A choice: trackers read 10 to 1000 times a second."""
AVERAGED = (
    *("wrench", "time", "load_time", "air_temperature", "joint_temperature", "q_actual", "torque"),
)
"""Columns of `States` of which a standstill has the mean."""
MANY_ROWS = 8
"""Mean number of rows of a state from which a note asks whether they are samples; a choice."""


def averaged_samples(
    readings: Readings, systematic_share: float
) -> tuple[Readings, tuple[str, ...]]:
    """Average the samples of each standstill, with a note; readings without samples are returned.

    The covariance is that of the mean, of which `systematic_share` is the same in
    all samples; force, time, temperatures, torques and reported joint values are means, too.
    """
    again = _same_as_last(readings)
    count, visits = len(readings), len(readings) - int(again.sum())
    time = readings.states.time
    again[1:] &= False if time is None else _within_pause(time, again[1:])
    first = np.flatnonzero(~again)
    if len(first) == count:
        return readings, _probably_samples(count, visits)
    value, covariance = readings.value[first].copy(), readings.covariance[first].copy()
    left_out = 0
    ends = np.append(first[1:], count)
    for k, (start, end) in enumerate(zip(first, ends, strict=True)):
        if end - start > 1:
            rows = slice(start, end)
            values, stated = readings.value[rows], readings.covariance[rows]
            mean = mean_of_samples(values, stated, systematic_share)
            value[k], covariance[k] = mean.value, mean.covariance
            left_out += len(mean.left_out)
    out = replace(readings[first], value=value, covariance=covariance)
    means: dict[str, Any] = {
        name: np.add.reduceat(column, first, axis=0)
        / np.diff(np.append(first, count)).reshape(-1, *[1] * (column.ndim - 1))
        for name in AVERAGED
        if (column := getattr(readings.states, name)) is not None
    }
    outliers = f"; {left_out} of them are gross outliers, left out" * bool(left_out)
    note = (
        f"{count} rows are samples of {len(first)} standstills (one state, at most "
        f"{LONGEST_PAUSE_S:g} s apart): averaged{outliers}"
    )
    return replace(out, states=replace(out.states, **means)), (note,)


def _probably_samples(rows: int, visits: int) -> tuple[str, ...]:
    """Return a note where many rows of each state follow one another and no clock tells more."""
    if rows < MANY_ROWS * visits:
        return ()
    return (
        f"{rows} rows are of {visits} states, each of rows that follow one another, and count "
        "as that many arrivals of the arm: if they are samples of one standstill, give the time "
        "of each, or average them",
    )


def _same_as_last(readings: Readings) -> Bools:
    """(N,) whether a row is of the same state as the row before it."""
    s = readings.states
    keys = [readings.pose, readings.load, readings.cycle, readings.line, *s.q.T]
    if s.approach is not None:
        keys += list(s.approach.T)
    same = np.zeros(len(readings), dtype=np.bool_)
    same[1:] = np.all([key[1:] == key[:-1] for key in keys], axis=0) & ~readings.scalar[1:]
    return same


def _within_pause(time: Floats, again: Bools) -> Bools:
    """(N − 1,) whether rows follow within a pause, or at the same time, of those `again` (N − 1,).

    A clock that counts rows does not tell, nor does one whose least step is longer than a pause,
    such as a date, unless each standstill has a time of its own, that of all its rows.
    """
    step = np.diff(time)
    forward = step[step > 0]
    counts_rows = not len(forward) or bool(np.all(step == step[0]))
    time_of_each = not np.any(step[again]) and bool(np.all(step[~again]))
    if counts_rows or (forward.min() > LONGEST_PAUSE_S and not time_of_each):
        return np.zeros(len(step), dtype=np.bool_)
    return np.asarray((step >= 0) & (step <= LONGEST_PAUSE_S))
