"""Whether the readings show one step in their order: something was moved between two of them.

From an unknown reading k on, the sensor is displaced by a twist (6), the target on the tool by a
shift (3), or one joint from its zero (1), as where it slipped or lost its reference. With P of the
mixed model of all effects at its variances (`mixed.equations`) and the columns C_k of the
displacement, zero before k,

    gain_k = gᵀ M⁻¹ g,   g = C_kᵀ P y,   M = C_kᵀ P C_k

is χ² distributed without a step, if the variances are known. Variances that are estimated from
readings with a step contain it: the larger it is, the less significant it seems. So the variances
are estimated from the readings less the best step of the sensor, of the target or of a joint,
whichever makes them most likely. As the size of the noise is estimated, too, the gain w with ν
degrees of freedom is the likelihood ratio λ = ν log(1 + w/ν), and without a step of rank r

    (exp(λ/ν) − 1) (ν − r)/r ~ F(r, ν − r)

But a step may also take up what few readings attribute to effects, whose variances are then
estimated too small. So both this λ and twice the gain of the log posterior by the best step, all
variances estimated with it and without it, must be significant. The level is divided by the number
of places; the sensor, the target and all joints together have half of it each.

A drift resembles a step, above all one that settles, as of an arm that warms up: a step has to
explain the readings better than each drift of `SETTLING` by 20 : 1.
A serial correlation of the noise is not assumed, as it would take up the step; where the fit has
one, a step has to explain the readings better than it does.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from hilcal.diagnosis.background_evidence import all_effects_at
from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.errors import CannotAnswerError
from hilcal.identification.background import allows_background
from hilcal.identification.fit import Fit
from hilcal.identification.mixed_fit import (
    MOST_NOISE_ROWS,
    linearised_problem,
    shift_rows,
    sizes_at,
)
from hilcal.identification.outliers.data_snooping import FEWEST_IN_RUN
from hilcal.mixed.equations import Equations, equations
from hilcal.mixed.variances import estimate_variances, log_posterior
from hilcal.model.observe import ReadingDerivative, motion
from hilcal.types import Floats

LEVEL = 1e-3  # chance of a step of sensor or target where there is none; a choice
RANK = 1e-9  # share of the largest eigenvalue below which a direction is not determined

SETTLING = (np.inf, 0.5, 0.2, 0.1)
"""Time constants of the tried drifts 1 − exp(−t/τ), each alone and all together, t from 0 to 1 in
the order of the readings; a choice. The first one is a straight line."""

_Gain = tuple[float, int, Floats]  # gain, rank, displacement (q,)

SENSOR, TARGET, JOINT = "sensor", "target", "joint"


@dataclass(frozen=True, slots=True)
class OrderStep:
    """A step in the order of the readings."""

    moved: tuple[str, ...]  # what may have moved, the better explanation first: the sensor, the
    # target, or a joint with its number, as "joint 2"
    first: int  # row of the first reading after the step
    previous: int  # row of the last reading before it
    p_value: float  # times the number of tested places and kinds
    shift_m: float  # rms displacement of the positions after the step, m
    share: float  # of the squares that all effects leave


def step_in_order(fit: Fit) -> OrderStep | None:
    """Return the step that the readings show beside all effects; None without one.

    Absolute readings of at most `MOST_NOISE_ROWS` elements are tested.
    """
    rows = np.flatnonzero(~fit.outlier)
    readings = fit.readings[rows].with_serial(None).as_stated()
    count = readings.value.size
    if len(readings) < 2 * FEWEST_IN_RUN or count > MOST_NOISE_ROWS:
        return None
    if fit.mode != "absolute" or readings.observers or not allows_background(fit):
        return None
    model, theta = all_effects_at(fit, readings)
    try:
        problem = linearised_problem(model, readings, fit.mode, theta)
        start = sizes_at(problem, model, theta)
        e = estimate_variances(problem, start).equations
        prediction = model.predict(readings.states, theta)
        moves = motion(
            model.cell, prediction.observation, prediction.situation.chain, prediction.deviation,
            readings.m,
        )  # fmt: skip
        units, kinds = shift_rows(model, readings, fit.mode), _displacements(moves)
        steps, _ = _best_steps(e, units, kinds)
        joint = next(f.kind for f in steps if f.kind not in (SENSOR, TARGET))
        freed = [
            estimate_variances(linearised_problem(model, without, fit.mode, theta), start).equations
            for f in steps
            if f.kind in (SENSOR, TARGET, joint)
            for without in [replace(readings, value=readings.value - f.shift(kinds))]
        ]
        with_step = max(freed, key=log_posterior)
        gain = 2.0 * (log_posterior(with_step) - log_posterior(e))
        e = equations(problem, with_step.log_std)
    except (CannotAnswerError, np.linalg.LinAlgError):
        return None
    steps, drift = _best_steps(e, units, kinds)
    best, serial = steps[0], fit.readings.serial
    if serial is not None:
        drift = max(drift, 2 * serial.log_likelihood_ratio)
    p_value = max(best.p_value, best.p_value_of(gain))
    if p_value >= LEVEL or best.score < drift + 2 * SAME_EVIDENCE:
        return None
    size = float(np.sqrt(np.mean(np.sum(best.shift(kinds)[best.first :, :3] ** 2, axis=1))))
    remaining = float(e.target @ e.residual)
    return OrderStep(
        moved=tuple(
            f.kind for f in steps if f.p_value < LEVEL and best.score - f.score < 2 * SAME_EVIDENCE
        ),
        first=int(rows[best.first]),
        previous=int(rows[best.first - 1]),
        p_value=p_value,
        shift_m=size,
        share=best.gain / remaining,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """The best place of a step of one kind."""

    kind: str
    first: int  # row of the first reading after it
    gain: float
    score: float  # likelihood ratio less twice the rank
    rank: int  # r
    freedom: float  # ν
    tests: int  # number of tested places and kinds
    displacement: Floats  # (q,)

    @property
    def p_value(self) -> float:
        """p-value of the step's likelihood ratio; see `p_value_of`."""
        return self.p_value_of(self.score + 2 * self.rank)

    def p_value_of(self, ratio: float) -> float:
        """p-value of a likelihood ratio, times the number of tests, at most 1."""
        rest = self.freedom - self.rank
        if rest <= 0.0 or ratio <= 0.0:
            return 1.0
        f = np.expm1(ratio / self.freedom) * rest / self.rank
        return min(self.tests * float(scipy.stats.f.sf(f, self.rank, rest)), 1.0)

    def shift(self, kinds: dict[str, Floats]) -> Floats:
        """(N, m) shift of each reading."""
        out = kinds[self.kind] @ self.displacement
        out[: self.first] = 0.0
        return np.asarray(out)


def _displacements(moves: ReadingDerivative) -> dict[str, Floats]:
    """(N, m, q) derivatives of the readings by each kind of displacement."""
    joints = {
        f"{JOINT} {j + 1}": d[:, :, None] for j, d in enumerate(moves.drives.transpose(2, 0, 1))
    }
    return {SENSOR: moves.by_station(), TARGET: moves.by_target()[:, :, :3], **joints}


def _best_steps(e: Equations, units: Floats, kinds: dict[str, Floats]) -> tuple[list[_Step], float]:
    """Return the best step of each kind, best first, and the score of the best drift."""
    best, drift = list[_Step](), 0.0
    freedom = np.count_nonzero(units.any(axis=(1, 2))) - float(e.spent.sum()) - e.problem.flat
    for kind, columns in kinds.items():
        drifts, steps = _gains(e, np.einsum("rnm,nmq->rnq", units, columns))
        drift = max(drift, *(_likelihood_ratio(g, freedom) - 2 * r for g, r, _ in drifts))
        k = max(range(len(steps)), key=lambda k: steps[k][0])
        gain, rank, displacement = steps[k]
        ratio = _likelihood_ratio(gain, freedom)
        alike = 1 if kind in (SENSOR, TARGET) else len(kinds) - 2
        tests, score = 2 * alike * len(steps), ratio - 2 * rank
        step = _Step(kind, FEWEST_IN_RUN + k, gain, score, rank, freedom, tests, displacement)
        best.append(step)
    return sorted(best, key=lambda f: -f.score), drift


def _likelihood_ratio(gain: float, freedom: float) -> float:
    """Twice the gain of the log likelihood where the size of the noise is estimated, too."""
    return freedom * float(np.log1p(gain / freedom))


def _gains(e: Equations, columns: Floats) -> tuple[list[_Gain], list[_Gain]]:
    """Return the gains of the drifts, and those of a step at each row from `FEWEST_IN_RUN` on.

    `columns` (R, N, q) are the rows by the displacement of each reading alone.
    """
    _, count, q = columns.shape
    square, score = e.score(columns.reshape(len(columns), count * q))
    by_pair, by_reading = square.reshape(count, q, count, q), score.reshape(count, q)
    time = np.linspace(0.0, 1.0, count)[:, None]
    each = [time if np.isinf(tau) else 1.0 - np.exp(-time / tau) for tau in SETTLING]
    drifts = []
    for x in (*each, np.hstack(each)):
        x = x - x.mean(axis=0)
        size = x.shape[1] * q
        square = np.einsum("is,iajb,jt->satb", x, by_pair, x, optimize=True).reshape(size, size)
        drifts.append(_gain(square, (x.T @ by_reading).reshape(size)))
    later = np.cumsum(np.cumsum(by_pair[::-1, :, ::-1], axis=0), axis=2)[::-1, :, ::-1]
    scores = np.cumsum(by_reading[::-1], axis=0)[::-1]
    places = range(FEWEST_IN_RUN, count - FEWEST_IN_RUN + 1)
    return drifts, [_gain(later[k, :, k], scores[k]) for k in places]


def _gain(square: Floats, score: Floats) -> _Gain:
    """Return gᵀ M⁻¹ g, the rank of M (q, q), and M⁻¹ g (q,)."""
    scale = np.sqrt(np.maximum(np.diagonal(square), 1e-300))
    values, vectors = np.linalg.eigh(square / scale / scale[:, None])
    determined = values > RANK * values[-1]
    values, vectors = values[determined], vectors[:, determined]
    part = vectors.T @ (score / scale)
    return float(np.sum(part**2 / values)), len(values), (vectors @ (part / values)) / scale
