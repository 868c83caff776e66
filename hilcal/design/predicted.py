"""Predicted precision of a plan: standard uncertainties of parameters and positions."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.information import DesignProblem
from hilcal.design.nominal_model import NominalModel, nominal_states
from hilcal.effects.protocol import Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.uncertainty import LEARNT, MEANINGLESS
from hilcal.regression.normal_equations import INFORMATION, NULL_SHARE, ROUNDING
from hilcal.regression.schur import inverse_root
from hilcal.robot.chain import evaluate
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats

COUNT = 500  # poses that are drawn where none is named; a choice: 100 are learnt by the plan
_DRAWN = 4096
_ROUNDS = 60
_SEED = 20240608


@dataclass(frozen=True, slots=True, eq=False)
class PredictionPoses:
    """T states at which the position, or the deflection, is predicted."""

    q: Floats  # (T, n) joint angles, rad
    wrench: Floats  # (T, 6) at the load point, base axes, N and N·m
    deflection: bool  # whether it is the change from the unloaded position that is predicted
    derivative: Floats  # (T, 3, L) V, by the model's live parameters in their scales, m
    what: str  # in words, e.g. "deflection under 5kg at 100 poses".


def prediction_poses(
    nominal: NominalModel,
    config: CellConfig,  # `[planning] work_*`, loads
    feasible: Floats,  # (N, n) states that are feasible, rad; test poses are drawn from them
    may: Callable[[Floats], Bools] | None = None,  # which (N, n) are feasible, for a box
) -> PredictionPoses:
    """Return the test poses of `[planning]`: named, within a box, or of the candidates.

    In deflections it is the deflection under `work_load` that is predicted; under "none" that under
    each of the loads in turn.
    """
    q, where = _poses(nominal, config, feasible, may)
    cell, planning = nominal.cell, config.planning
    pulls = {load.name: load.wrench(cell.gravity) for load in config.loads}
    deflection = planning.readings == "deflection"
    if planning.work_load == UNLOADED:
        wanted = pulls if deflection else {UNLOADED: np.zeros(6)}
        under = "each load" if deflection else ""
    elif planning.work_load in pulls:
        wanted, under = {planning.work_load: pulls[planning.work_load]}, planning.work_load
    else:
        valid = ", ".join((UNLOADED, *pulls))
        raise InputError(f"[planning] work_load = {planning.work_load!r}; valid: {valid}")
    if not wanted:
        raise InputError('[planning] readings = "deflection" needs [[loads]]')
    each = np.tile(q, (len(wanted), 1))
    wrench = np.repeat(np.array(list(wanted.values())), len(q), axis=0)
    scale = np.array([p.scale for e in nominal.model.effects for p in e.parameters])[nominal.live]
    what = ("deflection" if deflection else "position") + (f" under {under}" if under else "")
    bare = PredictionPoses(each, wrench, deflection, np.zeros(0), f"{what} {where}")
    return replace(bare, derivative=position_derivative(nominal, bare, (), scale))


def position_derivative(
    nominal: NominalModel, at: PredictionPoses, more: tuple[Effect, ...], scale: Floats
) -> Floats:
    """Return the derivative (T, 3, P) of what is predicted, m, by live parameters and `more`."""
    model, count = nominal.model, len(scale) - len(nominal.live)
    live = np.concatenate([nominal.live, model.size + np.arange(count)])

    def of(wrench: Floats) -> Floats:
        p = model.predict(nominal_states(at.q, wrench), nominal.theta)
        return model.jacobian_of((*model.effects, *more), p, nominal.theta, 3, live) * scale

    loaded = of(at.wrench)
    return loaded - of(np.zeros_like(at.wrench)) if at.deflection else loaded


def _poses(
    nominal: NominalModel,
    config: CellConfig,
    feasible: Floats,
    may: Callable[[Floats], Bools] | None,
) -> tuple[Floats, str]:
    """Test poses (T, n), and where they are in words."""
    planning, cell = config.planning, nominal.cell
    n = cell.arm.n
    if planning.work_q_rad:
        q = np.array(planning.work_q_rad, dtype=float)
        if q.shape[1] != n:
            raise InputError(
                f"[planning] work_q_rad has joint vectors of {q.shape[1]} values; {cell.arm.name} "
                f"has {n} joints"
            )
        return q, f"at {len(q)} named poses"
    rng = np.random.default_rng(_SEED)
    if planning.work_min_m is None or planning.work_max_m is None:
        if not len(feasible):
            raise CannotAnswerError("no feasible state to test a plan at")
        chosen = rng.permutation(len(feasible))[:COUNT]
        return feasible[np.sort(chosen)], f"at {len(chosen)} feasible poses"
    box = np.array(planning.work_min_m), np.array(planning.work_max_m)
    found = _inside(nominal, feasible, *box)
    low, high = cell.arm.usual_range
    margin = config.limits.joint_margin_rad
    low, high = low + margin, high - margin
    for _ in range(_ROUNDS if may is not None else 0):
        if len(found) >= COUNT:
            break
        drawn = cell.arm.complete(rng.uniform(low, high, (_DRAWN, n)))
        drawn = _inside(nominal, drawn, *box)
        if may is not None and len(drawn):
            found = np.concatenate([found, drawn[may(drawn)]])
    if not len(found):
        raise CannotAnswerError(
            f"no feasible pose holds the target between work_min_m = {box[0].tolist()} and "
            f"work_max_m = {box[1].tolist()}; widen the box or move it within reach"
        )
    chosen = rng.permutation(len(found))[:COUNT]
    return found[np.sort(chosen)], f"at {len(chosen)} poses in the work box"


def _inside(nominal: NominalModel, q: Floats, low: Floats, high: Floats) -> Floats:
    """Those of the states (N, n) whose target lies in a box, base axes."""
    cell = nominal.cell
    at = evaluate(cell.arm, q).point(cell.target[:3, 3])
    return np.asarray(q[np.all((at >= low) & (at <= high), axis=1)])


@dataclass(frozen=True, slots=True, eq=False)
class PredictedUncertainty:
    """Standard uncertainties that a fit to the planned readings will have.

    With the model complete, as identification will state them, and with the potential terms, as
    they are where any of those effects is there and has to be estimated as well.
    """

    names: tuple[str, ...]  # of the model's live parameters, as identification prints them
    units: tuple[str, ...]
    values: Floats  # at which they are assumed, SI
    std: Floats  # with the model complete, SI; infinite where not identifiable
    position: float | None  # with the model complete, RMS where the robot works, m
    position_open: float | None  # the same with the potential terms
    positions: Floats  # (T,) per such pose, with the model complete

    def by_name(self) -> dict[str, float]:
        """Standard uncertainties with the model complete, SI."""
        return dict(zip(self.names, (float(s) for s in self.std), strict=True))


def predicted(
    problem: DesignProblem,
    counts: Floats | None = None,  # (K,) how often each unit is taken
    *,
    information: Floats | None = None,  # (P, P) instead, prior included; else the prior
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
        position=None if work is None else rms(positions),
        position_open=None if work is None else rms(positions_of(work, opened, null_open)),
        positions=positions,
    )


def covariance(information: Floats, flat: Bools) -> tuple[Floats, Floats]:
    """Invert an information matrix (P, P) as identification does; also (P, U) directions left out.

    Directions of the `flat` parameters, which have no prior, that move all data together by less
    than 0.2 σ at an ordinary magnitude (see `regression.normal_equations`) are held at zero.
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
    """Return (T,) standard deviations of positions, sqrt(tr(V Cov Vᵀ)), m; Cov (L, L).

    Infinite where a direction of `null` (L, U) moves one by a tenth of it at an ordinary magnitude.
    """
    variance = np.einsum("tip,pq,tiq->t", work.derivative, covariance, work.derivative)
    std = np.sqrt(np.maximum(variance, 0.0))
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
