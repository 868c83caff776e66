"""Predicted precision of a plan: standard uncertainties of parameters and positions."""

from dataclasses import dataclass

import numpy as np

from hilcal.design.information import DesignProblem
from hilcal.design.prediction_poses import PredictionPoses
from hilcal.identification.uncertainty import LEARNT, MEANINGLESS
from hilcal.regression.normal_equations import INFORMATION, NULL_SHARE, ROUNDING
from hilcal.regression.schur import inverse_root
from hilcal.types import Bools, Floats


@dataclass(frozen=True, slots=True, eq=False)
class PredictedUncertainty:
    """Standard uncertainties that a fit to the planned readings will have.

    Twice: with the model complete, as identification will state them, and with the potential
    terms, as they are where any of those effects is there and has to be estimated as well.
    """

    names: tuple[str, ...]  # of the model's live parameters, as identification prints them
    units: tuple[str, ...]
    values: Floats  # at which they are assumed, SI
    std: Floats  # with the model complete, SI; infinite where not identifiable
    std_open: Floats  # with the potential terms, SI
    # with the model complete, RMS where the robot will work, m; None without any
    position: float | None
    position_open: float | None  # the same with the potential terms
    positions: Floats  # (T,) per such pose, with the model complete

    def by_name(self) -> dict[str, float]:
        """Standard uncertainties with the model complete, SI."""
        return dict(zip(self.names, (float(s) for s in self.std), strict=True))


def predicted(
    problem: DesignProblem,
    counts: Floats | None = None,  # (K,) how often each unit is taken
    *,
    # (P, P) instead, prior included; of the prior alone where neither is given
    information: Floats | None = None,
    work: PredictionPoses | None = None,
) -> PredictedUncertainty:
    """Predict the standard uncertainties that a plan reaches."""
    if information is None:
        information = problem.prior if counts is None else problem.information(counts)
    size = problem.model_size
    own = information[:size, :size]
    flat = np.isinf(problem.nominal.prior_std[problem.nominal.live])
    scale = problem.scale
    closed, null = covariance(own, flat)
    whole = np.append(flat, np.zeros(len(scale) - size, dtype=bool))
    opened, null_open = covariance(information, whole)
    opened, null_open = opened[:size, :size], null_open[:size]
    prior = problem.nominal.prior_std[problem.nominal.live] / scale[:size]
    terms = problem.terms[:size]
    positions = np.zeros(0) if work is None else positions_of(work, closed, null)
    return PredictedUncertainty(
        names=tuple(t.name for t in terms),
        units=tuple(t.unit for t in terms),
        values=np.array([t.value for t in terms]),
        std=_stated(closed, null, prior) * scale[:size],
        std_open=_stated(opened, null_open, prior) * scale[:size],
        position=None if work is None else rms(positions),
        position_open=None if work is None else rms(positions_of(work, opened, null_open)),
        positions=positions,
    )


def covariance(information: Floats, flat: Bools) -> tuple[Floats, Floats]:
    """Invert an information matrix, as identification does: what cannot be seen is held at zero.

    Directions of the flat parameters that move all data together by less than 0.2 σ at an
    ordinary magnitude (see `regression.normal_equations`) are left out.

    information: (P, P) by parameters in ordinary magnitudes, prior included; flat: (P,) which of
    them have no prior.

    Returns:
        (P, P) covariance, and (P, U) unit directions that were left out.
    """
    size = len(information)
    columns, held = np.flatnonzero(flat), np.flatnonzero(~flat)
    values, vectors = np.linalg.eigh(information[np.ix_(columns, columns)])
    # Squares of singular values; products have lost what lies below rounding.
    floor = max(INFORMATION**2, ROUNDING * float(values.max(initial=0.0)) * 1e-3)
    seen = values > floor
    transform = np.zeros((size, int(seen.sum()) + len(held)))
    transform[columns, : int(seen.sum())] = vectors[:, seen] / np.sqrt(values[seen])
    transform[held, int(seen.sum()) + np.arange(len(held))] = 1.0 / np.sqrt(
        np.maximum(np.diag(information)[held], 1e-300)
    )
    root = transform @ inverse_root(transform.T @ information @ transform).T
    null = np.zeros((size, int((~seen).sum())))
    null[columns] = vectors[:, ~seen]
    return np.asarray(root @ root.T), null


def positions_of(work: PredictionPoses, covariance: Floats, null: Floats) -> Floats:
    """Return (T,) standard deviations of positions, m; infinite where not determined.

    covariance: (L, L) of the model's live parameters; null: (L, U) directions that were left out: a
    position that one of them moves at an ordinary magnitude by a tenth of its standard deviation is
    not determined.
    """
    std = work.std(covariance)
    unseen = np.linalg.norm(work.derivative @ null, axis=(1, 2))
    return np.where(unseen <= NULL_SHARE * std, std, np.inf)


def _stated(covariance: Floats, null: Floats, prior: Floats) -> Floats:
    """Standard uncertainties in ordinary magnitudes; infinite where identification refuses."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    flat, unseen = np.isinf(prior), np.linalg.norm(null, axis=1)
    good = np.where(flat, (unseen <= NULL_SHARE * std) & (std < MEANINGLESS), std < LEARNT * prior)
    return np.where(good, std, np.inf)


def rms(std: Floats) -> float:
    """Root mean square of standard deviations."""
    return float(np.sqrt(np.mean(std**2)))
