"""Whether the readings show one step in their order: something was moved between two of them.

From an unknown reading k on, the sensor is displaced by a twist (6), the target on the tool by a
shift (3), or one joint from its zero (1), as where it slipped or lost its reference. With P of the
mixed model of all effects at its variances (`mixed.equations`) and the columns C_k of the
displacement, zero before k,

    gain_k = gᵀ M⁻¹ g,   g = C_kᵀ P y,   M = C_kᵀ P C_k

is χ² distributed without a step. The variances are estimated without a step, which enlarges them,
so the test is conservative. The largest gain counts, at a level divided by the number of places;
the sensor, the target and all joints together have half of the level each.
A drift in the order resembles a step; a step has to explain the readings better by 20 : 1.
A serial correlation of the noise is not assumed: it would take up the step.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy

from hilcal.diagnosis.background_evidence import all_effects_at
from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.errors import CannotAnswerError
from hilcal.identification.background import allows_background
from hilcal.identification.fit import Fit
from hilcal.identification.mixed_fit import MOST_NOISE_ROWS, mixed_fit_at, shift_rows
from hilcal.identification.outliers.data_snooping import FEWEST_IN_RUN
from hilcal.mixed.equations import Equations
from hilcal.model.observe import motion
from hilcal.types import Floats

LEVEL = 1e-3  # chance of a step of sensor or target where there is none; a choice
RANK = 1e-9  # share of the largest eigenvalue below which a direction is not determined

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
        e = mixed_fit_at(model, readings, fit.mode, theta).equations
        prediction = model.predict(readings.states, theta)
    except (CannotAnswerError, np.linalg.LinAlgError):
        return None
    observed, situation = prediction.observation, prediction.situation
    moves = motion(model.cell, observed, situation.chain, prediction.deviation, readings.m)
    units = shift_rows(model, readings, fit.mode)
    remaining = float(e.target @ e.residual)
    found = []
    drives = moves.drives
    n = drives.shape[2]
    kinds: list[tuple[str, int, Floats]] = [  # with the number of kinds alike
        (SENSOR, 1, moves.by_station()),
        (TARGET, 1, moves.by_target()[:, :, :3]),
        *((f"{JOINT} {j + 1}", n, drives[:, :, [j]]) for j in range(n)),
    ]
    for kind, alike, columns in kinds:
        gains = list(_gains(e, np.einsum("rnm,nmq->rnq", units, columns)))
        k, gain, rank, delta = max(gains[1:], key=lambda g: g[1])
        better = gain - gains[0][1] > 2 * SAME_EVIDENCE
        tests = 2 * alike * (len(gains) - 1)
        p = min(tests * float(scipy.stats.chi2.sf(gain, rank)), 1.0)
        if p < LEVEL and better:
            shift = columns[k:, :3] @ delta
            size = float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))
            found.append((gain - 2 * rank, kind, k, p, size, gain / remaining))
    if not found:
        return None
    found.sort(key=lambda f: -f[0])
    best, _, k, p, size, share = found[0]
    explanations = tuple(kind for score, kind, *_ in found if best - score < 2 * SAME_EVIDENCE)
    return OrderStep(explanations, int(rows[k]), int(rows[k - 1]), p, size, share)


def _gains(e: Equations, columns: Floats) -> Iterator[tuple[int, float, int, Floats]]:
    """Yield gains with the first row, the rank and the displacement (q,): of a drift, of each step.

    `columns` (R, N, q) are the rows by the displacement of each reading alone.
    """
    _, count, q = columns.shape
    square, score = e.score(columns.reshape(len(columns), count * q))
    by_pair, by_reading = square.reshape(count, q, count, q), score.reshape(count, q)
    time = np.linspace(-1.0, 1.0, count)
    drift = np.einsum("i,iajb,j->ab", time, by_pair, time)
    yield 0, *_gain(drift, time @ by_reading)
    later = np.cumsum(np.cumsum(by_pair[::-1, :, ::-1], axis=0), axis=2)[::-1, :, ::-1]
    scores = np.cumsum(by_reading[::-1], axis=0)[::-1]
    for k in range(FEWEST_IN_RUN, count - FEWEST_IN_RUN + 1):
        yield k, *_gain(later[k, :, k], scores[k])


def _gain(square: Floats, score: Floats) -> tuple[float, int, Floats]:
    """Return gᵀ M⁻¹ g, the rank of M (q, q), and M⁻¹ g (q,)."""
    scale = np.sqrt(np.maximum(np.diagonal(square), 1e-300))
    values, vectors = np.linalg.eigh(square / scale / scale[:, None])
    determined = values > RANK * values[-1]
    values, vectors = values[determined], vectors[:, determined]
    part = vectors.T @ (score / scale)
    return float(np.sum(part**2 / values)), len(values), (vectors @ (part / values)) / scale
