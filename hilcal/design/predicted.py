"""Predicted precision of a plan: standard uncertainties of parameters and positions."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.information import DesignProblem, DesignTerm
from hilcal.design.nominal_model import NominalModel, nominal_states
from hilcal.effects.protocol import Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.uncertainty import IDENTIFIABLE_RATIO, LARGEST_STD
from hilcal.regression.normal_equations import INFORMATION, NULL_SHARE, ROUNDING
from hilcal.regression.schur import inverse_root
from hilcal.robot.chain import evaluate
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats

N_POSES = 500  # poses drawn where none is named; a choice: a plan overfits 100
_DRAWN = 4096
_ROUNDS = 60
_SEED = 20240608
CollisionFree = Callable[[Floats], Bools]  # which of (N, n) states are feasible


@dataclass(frozen=True, slots=True, eq=False)
class PredictionPoses:
    """T states at which the position, or the deflection, is predicted."""

    q: Floats  # (T, n) joint angles, rad
    wrench: Floats  # (T, 6) at the load point, base axes, N and N·m
    deflection: bool  # whether the change from the unloaded position is predicted
    derivative: Floats  # (T, 3, L) V, by the live parameters over their scales, m
    description: str  # in words, e.g. "deflection under 5kg at 100 poses"


def prediction_poses(
    nominal: NominalModel,
    config: CellConfig,  # `[planning] work_*`, loads
    feasible: Floats,  # (N, n) feasible states to draw from, rad
    is_clear: CollisionFree | None = None,  # tests poses drawn in a box
) -> PredictionPoses:
    """Return the prediction poses of `[planning]`: named, within a box, or of the candidates.

    With deflections, the deflection under `work_load` is predicted; with `work_load = "none"`, the
    deflection under each load in turn.
    """
    q, where = _poses(nominal, config, feasible, is_clear)
    cell, planning = nominal.cell, config.planning
    of_loads = {load.name: load.wrench(cell.gravity) for load in config.loads}
    deflection = config.planned_mode == "deflection"
    if planning.work_load == UNLOADED:
        wrenches = of_loads if deflection else {UNLOADED: np.zeros(6)}
        under = "each load" if deflection else ""
    elif planning.work_load in of_loads:
        wrenches, under = {planning.work_load: of_loads[planning.work_load]}, planning.work_load
    else:
        valid = ", ".join((UNLOADED, *of_loads))
        raise InputError(f"[planning] work_load = {planning.work_load!r}; valid: {valid}")
    states = np.tile(q, (len(wrenches), 1))
    wrench = np.repeat(np.array(list(wrenches.values())), len(q), axis=0)
    scale = np.array([p.scale for e in nominal.model.effects for p in e.parameters])[nominal.live]
    quantity = ("deflection" if deflection else "position") + (f" under {under}" if under else "")
    poses = PredictionPoses(states, wrench, deflection, np.zeros(0), f"{quantity} {where}")
    return replace(poses, derivative=position_derivative(nominal, poses, (), scale))


def position_derivative(
    nominal: NominalModel, poses: PredictionPoses, added: tuple[Effect, ...], scale: Floats
) -> Floats:
    """Return the derivative (T, 3, P) of predictions, m, by live parameters and `added` effects."""
    model, count = nominal.model, len(scale) - len(nominal.live)
    live = np.concatenate([nominal.live, model.size + np.arange(count)])

    def of(wrench: Floats) -> Floats:
        p = model.predict(nominal_states(poses.q, wrench), nominal.theta)
        return model.jacobian_of((*model.effects, *added), p, nominal.theta, 3, live) * scale

    loaded = of(poses.wrench)
    return loaded - of(np.zeros_like(poses.wrench)) if poses.deflection else loaded


def _poses(
    nominal: NominalModel, config: CellConfig, feasible: Floats, is_clear: CollisionFree | None
) -> tuple[Floats, str]:
    """Return prediction poses (T, n), and in words where they are."""
    planning, cell = config.planning, nominal.cell
    n = cell.arm.n
    if planning.work_q_rad:
        q = np.array(planning.work_q_rad, dtype=float)
        if q.shape[1] != n:
            raise InputError(
                f"[planning] work_q_rad has joint vectors of {q.shape[1]} values; {cell.arm.name} "
                f"has {n} joints"
            )
        outside = np.argwhere((q < cell.arm.q_min) | (q > cell.arm.q_max))
        for row, j in outside[:1]:
            low, high, unit = cell.arm.q_min[j], cell.arm.q_max[j], cell.arm.units[j]
            raise InputError(
                f"[planning] work_q_rad, vector {row + 1}: joint {j + 1} is at {q[row, j]:g} "
                f"{unit}; its range is {low:.4g} to {high:.4g} {unit}"
            )
        return q, f"at {len(q)} named poses"
    rng = np.random.default_rng(_SEED)
    if planning.work_min_m is None or planning.work_max_m is None:
        if not len(feasible):
            raise CannotAnswerError("no feasible state to test a plan at")
        chosen = rng.permutation(len(feasible))[:N_POSES]
        return feasible[np.sort(chosen)], f"at {len(chosen)} feasible poses"
    box = np.array(planning.work_min_m), np.array(planning.work_max_m)
    inside = _inside(nominal, feasible, *box)
    low, high = cell.arm.usual_range
    margin = config.limits.joint_margin_rad
    low, high = low + margin, high - margin
    for _ in range(_ROUNDS if is_clear is not None else 0):
        if len(inside) >= N_POSES:
            break
        drawn = cell.arm.complete(rng.uniform(low, high, (_DRAWN, n)))
        drawn = _inside(nominal, drawn, *box)
        if is_clear is not None and len(drawn):
            inside = np.concatenate([inside, drawn[is_clear(drawn)]])
    if not len(inside):
        raise CannotAnswerError(
            f"no feasible pose holds the target between work_min_m = {box[0].tolist()} and "
            f"work_max_m = {box[1].tolist()}; widen the box or move it within reach"
        )
    chosen = rng.permutation(len(inside))[:N_POSES]
    return inside[np.sort(chosen)], f"at {len(chosen)} poses in the work box"


def _inside(nominal: NominalModel, q: Floats, low: Floats, high: Floats) -> Floats:
    """Return the states, of (N, n), whose target lies in a box, base axes."""
    cell = nominal.cell
    target = evaluate(cell.arm, q).point(cell.target[:3, 3])
    return np.asarray(q[np.all((target >= low) & (target <= high), axis=1)])


@dataclass(frozen=True, slots=True, eq=False)
class PredictedUncertainty:
    """Standard uncertainties that a fit to the planned readings will have.

    With the model complete, they are those that identification will state; with the potential
    terms, those of a fit that estimates these terms too.
    """

    terms: tuple[DesignTerm, ...]  # the model's live parameters
    std: Floats  # with the model complete, SI; infinite where not identifiable
    position: float | None  # with the model complete, RMS at the prediction poses, m
    position_open: float | None  # the same with the potential terms
    positions: Floats  # (T,) per prediction pose, m, with the model complete

    def by_name(self) -> dict[str, float]:
        """Return standard uncertainties with the model complete, SI."""
        return {t.name: float(s) for t, s in zip(self.terms, self.std, strict=True)}


def predicted_uncertainty(
    problem: DesignProblem,
    counts: Floats | None = None,  # (K,) of units
    *,
    information: Floats | None = None,  # (P, P) instead of counts, with the prior
    work: PredictionPoses | None = None,
) -> PredictedUncertainty:
    """Predict the standard uncertainties that a plan reaches."""
    if information is None:
        information = problem.prior if counts is None else problem.information(counts)
    size = problem.model_size
    of_model = information[:size, :size]
    flat = np.isinf(problem.nominal.prior_std[problem.nominal.live])
    scale = problem.scale
    of_complete, null = covariance(of_model, flat)
    flat_all = np.append(flat, np.zeros(len(scale) - size, dtype=bool))
    opened, null_open = covariance(information, flat_all)
    opened, null_open = opened[:size, :size], null_open[:size]
    prior = problem.nominal.prior_std[problem.nominal.live] / scale[:size]
    terms, std = problem.terms[:size], _stated(of_complete, null, prior) * scale[:size]
    if work is None:
        return PredictedUncertainty(terms, std, None, None, np.zeros(0))
    positions = positions_of(work, of_complete, null)
    position_open = rms(positions_of(work, opened, null_open))
    return PredictedUncertainty(terms, std, rms(positions), position_open, positions)


def covariance(information: Floats, flat: Bools) -> tuple[Floats, Floats]:
    """Invert an information matrix (P, P) as identification does; also return (P, U) null space.

    Directions of the `flat` parameters, which have no prior, are held at zero where they move all
    data together by less than 0.2 σ at an ordinary magnitude (see `regression.normal_equations`).
    """
    size = len(information)
    columns, held = np.flatnonzero(flat), np.flatnonzero(~flat)
    values, vectors = np.linalg.eigh(information[np.ix_(columns, columns)])
    # eigenvalues are squared singular values, and lose digits to rounding in the product
    determined = values > max(INFORMATION**2, ROUNDING * float(values.max(initial=0.0)) * 1e-3)
    count = int(determined.sum())
    transform = np.zeros((size, count + len(held)))
    transform[columns, :count] = vectors[:, determined] / np.sqrt(values[determined])
    scale = np.sqrt(np.maximum(np.diag(information)[held], 1e-300))
    transform[held, count + np.arange(len(held))] = 1.0 / scale
    root = transform @ inverse_root(transform.T @ information @ transform).T
    null = np.zeros((size, len(columns) - count))
    null[columns] = vectors[:, ~determined]
    return np.asarray(root @ root.T), null


def positions_of(work: PredictionPoses, covariance: Floats, null: Floats) -> Floats:
    """Return (T,) standard deviations of positions, sqrt(tr(V Cov Vᵀ)), m; Cov (L, L).

    Infinite where directions of `null` (L, U) move a position by over `NULL_SHARE` of its std.
    """
    variance = np.einsum("tip,pq,tiq->t", work.derivative, covariance, work.derivative)
    std = np.sqrt(np.maximum(variance, 0.0))
    undetermined = np.linalg.norm(work.derivative @ null, axis=(1, 2))
    return np.where(undetermined <= NULL_SHARE * std, std, np.inf)


def _stated(covariance: Floats, null: Floats, prior: Floats) -> Floats:
    """Return standard uncertainties over the scales; infinite where identification refuses."""
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    flat, undetermined = np.isinf(prior), np.linalg.norm(null, axis=1)
    good = np.where(
        flat,
        (undetermined <= NULL_SHARE * std) & (std < LARGEST_STD),
        std < IDENTIFIABLE_RATIO * prior,
    )
    return np.where(good, std, np.inf)


def rms(std: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(std**2)))
