"""Readings that were set aside as gross errors, why, and what is said of far ones that were not."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from hilcal.identification.fit import Fit
from hilcal.identification.full_prediction import FullPrediction, full_prediction, names
from hilcal.identification.least_trimmed_squares import MOST
from hilcal.readings.readings import Readings
from hilcal.types import Floats

ALIKE = 1e-3
"""Two readings are alike where their distance is below the χ² quantile of this chance; a choice."""
SAME = 1e-3
"""A reading that repeats another to this share of σ was not taken anew; a choice."""
MOSTLY = 0.8
"""Share of the whitened error that an axis must have to be named; a choice."""
SWAPPED = 0.1
"""Share of a reading's error that another target's place must leave at most; a choice: targets are
centimetres apart."""
AXES = ("x", "y", "z", "rotation about x", "rotation about y", "rotation about z")


@dataclass(frozen=True, slots=True)
class GrossError:
    """A reading that was set aside.

    Attributes:
        row: of the readings.
        pose: its name.
        load: its name.
        sigma: Mahalanobis distance from the prediction of the fit.
        reason: likely cause, or the error by axes, in a phrase.
    """

    row: int
    pose: str
    load: str
    sigma: float
    reason: str


def gross_errors(fit: Fit) -> tuple[GrossError, ...]:
    """List the readings set aside, in order.

    Of deflections that share an unloaded reading that was set aside, only that one is listed.
    """
    if not fit.outlier.any():
        return ()
    e = full_prediction(fit)
    found: dict[int, GrossError] = {}
    first = 0
    for b in e.whitening.buckets:
        size = b.loaded.shape[1]
        for g in range(len(b.loaded)):
            at = first + g * size + np.arange(size)
            out = fit.outlier[b.reference[g]]
            for u in np.flatnonzero(out):
                row, mine = int(b.reference[g, u]), b.weights[:, u] > 0
                found[row] = _shared(e, row, at[mine], bool(np.all(b.weights[mine, u] == 1.0)))
            # Deflections of which no unloaded reading is left are not listed one by one.
            lost = (b.weights @ out > 1.0 - 1e-9) if len(out) else np.zeros(size, dtype=bool)
            for k, r in zip(at[~lost], b.loaded[g, ~lost], strict=True):
                if fit.outlier[r]:
                    found[int(r)] = _one(e, int(r), e.raw[k], e.whitening.covariance[k])
        first += b.loaded.size
    return tuple(found[row] for row in sorted(found))


def _shared(e: FullPrediction, row: int, measurements: Floats, alone: bool) -> GrossError:
    """Gross error of an unloaded reading, from the deflections that are taken from it."""
    rows = e.whitening.reading[measurements]
    v = e.readings.covariance
    off = -np.median(e.raw[measurements], axis=0)
    spread = v[row] + v[rows].sum(axis=0) / len(rows) ** 2
    one = _one(e, row, off, spread)
    if not alone:
        return one
    many = len(rows)
    reason = (
        f"{one.reason}; its {many} deflections" if many > 1 else f"{one.reason}; its deflection"
    )
    return GrossError(row, one.pose, one.load, one.sigma, f"{reason} set aside with it")


def _one(e: FullPrediction, row: int, off: Floats, covariance: Floats) -> GrossError:
    sigma = _distance(off, covariance)
    reason = (
        _stale(e.readings, row)
        or _another_target(e, row, off)
        or _like_another(e.readings, row)
        or _off(off, covariance)
    )
    pose, load = names(e.readings, row)
    if e.readings.states.target is not None:
        reason = f"target {e.readings.target_names[e.readings.target[row]]}: {reason}"
    return GrossError(row, pose, load, sigma, reason)


def _another_target(e: FullPrediction, row: int, off: Floats) -> str:
    """Phrase for a reading that lies where the prediction has another target, or ''."""
    r = e.readings
    if r.states.target is None:
        return ""
    states, own = r.states[row : row + 1], e.prediction.observation.position[row]
    best, found = SWAPPED * float(np.linalg.norm(off[:3])), -1
    for other in range(len(r.target_names)):
        there = e.model.predict(replace(states, target=np.array([other])), e.theta)
        away = float(np.linalg.norm(off[:3] - (there.observation.position[0] - own)))
        if other != r.target[row] and away < best:
            best, found = away, other
    return "" if found < 0 else f"lies where {r.target_names[found]} is: were they swapped?"


def _stale(r: Readings, row: int) -> str:
    if row == 0:
        return ""
    std = np.sqrt(np.maximum(np.diagonal(r.covariance[row]), 1e-300))
    if np.all(np.abs(r.value[row] - r.value[row - 1]) <= SAME * std):
        return "equal to the reading before: not taken anew (stale)?"
    return ""


def _like_another(r: Readings, row: int) -> str:
    """Phrase for a reading that agrees with one under another load at the same pose, or ''."""
    best, found = float(chi2.isf(ALIKE, r.m)), -1
    beside = (r.pose == r.pose[row]) & (r.load != r.load[row]) & (r.target == r.target[row])
    for other in np.flatnonzero(beside):
        away = _distance(r.value[row] - r.value[other], r.covariance[row] + r.covariance[other])
        if away**2 < best:
            best, found = away**2, int(other)
    if found < 0:
        return ""
    load = r.load_names[r.load[found]]
    if load == "none":
        return "like the unloaded reading: was the load hung?"
    if r.unloaded[row]:
        return f'like the reading under "{load}": was the load still hung?'
    return f'like the reading under "{load}": was that load hung?'


def _off(off: Floats, covariance: Floats) -> str:
    std = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    white = np.abs(off) / std
    axis = int(np.argmax(white))
    sigma = _distance(off, covariance)
    if white[axis] < MOSTLY * float(np.linalg.norm(white)):
        return f"{sigma:.0f} σ off"
    return f"{sigma:.0f} σ off in {AXES[axis]}"


def _distance(off: Floats, covariance: Floats) -> float:
    """Mahalanobis distance in the range of a covariance, which may be singular."""
    square = float(off @ np.linalg.pinv(covariance, hermitian=True) @ off)
    return float(np.sqrt(max(square, 0.0)))


def disagreement_words(fit: Fit) -> str:
    """Return the disagreement of a fit's readings in a sentence; empty where there is none."""
    found, readings = fit.disagreement, fit.readings
    if found is None:
        return ""
    count = f"{len(found.rows)} of {len(readings)}"
    if found.kind == "many":
        return (
            f"more than {100 * MOST:.0f} % of the readings disagree with what the others agree on, "
            f"too many to tell wrong ones from right ones ({count} are beyond the noise): none was "
            "set aside, and nothing that is fitted to them holds; find out what went wrong in "
            "measuring"
        )
    first, last = ("/".join(names(readings, int(found.rows[k]))) for k in (0, -1))
    return (
        f"{count} readings, between {first} and {last}, are off by the same shift, so that they "
        "have one cause: another reflector, a target moved on the tool, a tracker that was bumped. "
        "They were not set aside; give them a target of their own, or leave them out"
    )
