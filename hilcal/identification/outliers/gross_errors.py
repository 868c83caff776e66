"""Gross errors of an arm that has every effect, found in the mixed model of all effects.

Where an arm has every effect, the misfit of its named effects alone is as large as a gross error,
which data snooping (`identification.outliers.data_snooping`) then cannot detect. The mixed model of
all effects predicts each reading from the others much better. A reading k has a gross
error with the probability π: a shift γ_k ~ N(0, G²) in each element. The odds that the readings of
a set O have gross errors and no others, with the variances of all effects estimated anew,

    log odds = ℓ(x̂_O) − ℓ(x̂) − |O| log 1/π

with ℓ the log posterior of `mixed.variances`, increase where readings agree much better without O.
The set grows by the reading that the others predict worst, by Baarda's test of a shift at the
present variances, and that of the largest odds is taken: while several gross errors inflate the
variances, the odds of the first may be low, but the largest test is not small.

Readings that a fit with fewer effects set aside are restored if the others predict them well, or if
the odds that they have gross errors are not above one: where few readings remain, small sizes of
the effects fit these, while larger sizes may explain all readings.

Source: Box and Tiao, *A Bayesian approach to some outlier problems*, Biometrika 55 (1968) 119.
"""

from dataclasses import replace

import numpy as np
import scipy

from hilcal.errors import CannotAnswerError
from hilcal.identification.mixed_fit import MixedFit, linearised_problem, shift_rows
from hilcal.identification.outliers.least_trimmed_squares import FALSE_ALARMS, MOST_WRONG
from hilcal.mixed.equations import equations
from hilcal.mixed.families import KNOWN_SPREAD, Families, Family, LogStdPrior
from hilcal.mixed.problem import MixedProblem
from hilcal.mixed.variances import estimate_variances, log_posterior
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, has_unloaded
from hilcal.types import Bools, Floats, Ints

SHIFT = 1e-2
"""G, m and rad: a reflector that is not seated, a pose that was not reached; a choice. Much larger
errors are gross by any G."""
SUSPECT = 0.05
"""Chance that the worst of good readings is tried; a choice."""
VISIBLE = 1e-9  # share of a reading's information that its other elements must leave


def find_gross_errors(mixed: MixedFit, mode: Mode) -> Bools:
    """Return which of the readings (N,) of a mixed fit have gross errors.

    Deflections of an unloaded reading with a gross error are marked as well.
    """
    readings, m = mixed.readings, mixed.readings.m
    count = len(readings)
    problem = linearised_problem(mixed.model, readings, mode, mixed.theta)
    shifts = shift_rows(mixed.model, readings, mode)
    estimate = estimate_variances(problem, mixed.variances.log_std)
    without, families = log_posterior(estimate.equations), len(problem.families.random)
    log_std = estimate.log_std
    shifted: list[int] = []
    best, number = 0.0, 0
    while len(shifted) < int(MOST_WRONG * count):
        inner, score = estimate.equations.score(shifts.reshape(len(problem.y), count * m))
        p = _p_values(inner, score, m)
        p[shifted] = 1.0
        worst = int(np.argmin(p))
        if p[worst] * count > SUSPECT:
            break
        shifted.append(worst)
        # The families of shifts stand between those of the effects and the noise.
        start = np.insert(log_std, families, np.zeros(len(shifted)))
        estimate = estimate_variances(_with_shifts(problem, shifts, shifted), start, search=True)
        log_std = np.delete(estimate.log_std, families + np.arange(len(shifted)))
        odds = log_posterior(estimate.equations) - without - _price(len(shifted), count)
        if odds > best:
            best, number = odds, len(shifted)
    out = np.zeros(count, dtype=np.bool_)
    out[shifted[:number]] = True
    return _with_deflections(out, readings, mode)


def confirmed_gross_errors(
    mixed: MixedFit, readings: Readings, outlier: Bools, mode: Mode
) -> Bools:
    """Return which of the set-aside readings, `outlier` (N,), are confirmed as gross errors (N,).

    The mixed fit is to all other readings. None is confirmed where the odds of all together are not
    above one, nor one where a good reading would be as far from the prediction by chance.

    Raises:
        CannotAnswerError: the mixed model's equations have no solution.
    """
    rows = np.flatnonzero(outlier)
    if not len(rows):
        return outlier
    problem = linearised_problem(mixed.model, readings, mode, mixed.theta)
    shifts, families = shift_rows(mixed.model, readings, mode), len(problem.families.random)
    log_std = np.insert(mixed.variances.log_std, families, np.zeros(len(rows)))
    shifted = _with_shifts(problem, shifts, rows.tolist())
    with_shifts = log_posterior(estimate_variances(shifted, log_std).equations)
    without = log_posterior(
        estimate_variances(problem, mixed.variances.log_std, search=True).equations
    )
    if with_shifts - without <= _price(len(rows), len(readings)):
        return np.zeros_like(outlier)
    try:
        e = equations(shifted, log_std)
    except np.linalg.LinAlgError as error:
        raise CannotAnswerError("the mixed model's equations have no solution") from error
    count, m = len(rows), readings.m
    size = e.coordinates[-count * m :].reshape(count, m)
    index = np.arange(count)
    spread = e.covariance[-count * m :, -count * m :].reshape(count, m, count, m)
    spread = spread[index, :, index]
    square = np.einsum("ni,nij,nj->n", size, np.linalg.pinv(spread, hermitian=True), size)
    out = outlier.copy()
    out[rows] = scipy.stats.chi2.sf(square, m) * len(readings) <= SUSPECT
    return _with_deflections(out, readings, mode)


def _price(shifted: int, count: int) -> float:
    """Return |O| log 1/π of so many shifted readings of `count`."""
    return shifted * float(np.log(count / FALSE_ALARMS))


def _with_deflections(outlier: Bools, readings: Readings, mode: Mode) -> Bools:
    """Add the loaded readings (N,) whose unloaded ones are all gross errors."""
    if mode == "absolute" or not outlier.any():
        return outlier
    out, good = outlier.copy(), np.flatnonzero(~outlier)
    out[good[~has_unloaded(readings[good])]] = True
    return out


def _p_values(inner: Floats, score: Floats, m: int) -> Floats:
    """P-value (N,) of no shift, from Zᵀ P Z (N m, N m) and Zᵀ P y (N m,) of all shifts."""
    count = len(score) // m
    rows = np.arange(count)
    block = inner.reshape(count, m, count, m)[rows, :, rows]
    values, vectors = np.linalg.eigh((block + np.swapaxes(block, 1, 2)) / 2)
    along = np.einsum("nij,ni->nj", vectors, score.reshape(count, m))
    visible = values > VISIBLE * np.maximum(values.max(axis=1, keepdims=True), 1e-300)
    square = np.sum(np.where(visible, along**2 / np.where(visible, values, 1.0), 0.0), axis=1)
    return np.asarray(scipy.stats.chi2.sf(square, np.maximum(visible.sum(axis=1), 1)))


def _with_shifts(problem: MixedProblem, shifts: Floats, readings: list[int]) -> MixedProblem:
    """Return the problem with shifts (R, N, m) of some readings as families of known size."""
    m, random = shifts.shape[2], problem.families.random
    none: Ints = np.zeros(0, dtype=np.int64)
    size = LogStdPrior(0.0, KNOWN_SPREAD)
    added = tuple(
        Family(f"shift {k}", f"shift {k}", none, np.zeros(0), size, known=True) for k in readings
    )
    columns = SHIFT * shifts[:, readings].reshape(len(problem.y), len(readings) * m)
    number = len(random) + np.repeat(np.arange(len(readings)), m)
    return replace(
        problem,
        x=np.hstack([problem.x, columns]),
        families=Families(problem.families.frames, (*random, *added)),
        family=np.concatenate([problem.family, number]),
    )
