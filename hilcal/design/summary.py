"""The summary of a plan: predicted precision, criterion comparison, sample-size curve, cost.

Terminal, JSON and viewer read one summary, computed once; the plan's file holds `about`.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.approximate_design import relax
from hilcal.design.choice import (
    COARSE_GAP,
    certified_design,
    choose_poses,
    compound_objective,
    pose_units,
    without_prior,
)
from hilcal.design.information import DesignProblem, reading_derivatives
from hilcal.design.optimum import best_design
from hilcal.design.planner import Planned, Say
from hilcal.design.predicted import predicted_uncertainty
from hilcal.design.run_order import Confounding, Duration
from hilcal.effects.protocol import FRAME_ROLES, Role
from hilcal.errors import CannotAnswerError, InputError
from hilcal.measuring.route import DryRun, dry_run
from hilcal.regression.evidence import VISIBLE
from hilcal.regression.schur import schur_complement
from hilcal.shown import Brief, Tabular
from hilcal.store.plan import REFERENCE, Plan
from hilcal.types import Floats
from hilcal.whole_file import replace_file

COMPARED = ("D", "A", "E", "K", "I")  # all but T-optimality, which needs suspects
SHARES = (0.5, 1.0, 1.5, 2.0, 3.0)  # budgets of the curve over that of the plan; a choice
NOTABLE_EFFICIENCY = 0.9  # below it, a remark states what a better plan would give; a choice
_LEFT_OUT = {
    "deflection": "geometry, registration, repeatability and effects outside of the model",
    "position": "repeatability and effects outside of the model",
}
RANDOM_PLANS = 9  # random plans, of which the median is given; a choice
DRAWS = 5  # random directions of an effect, over which the strength's median is taken; a choice
_SEED = 20240611


@dataclass(frozen=True, slots=True)
class DetectableEffect:
    """Minimum detectable strength of an effect outside of the model.

    Attributes:
        effect: its name.
        least_m: RMS displacement of the target, m, that leaves a whitened residual of one sigma
            after the model is fitted; None where the model absorbs the effect.
    """

    effect: str
    least_m: float | None


@dataclass(frozen=True, slots=True)
class PredictedParameter:
    """Predicted standard uncertainty of a parameter.

    Attributes:
        name: e.g. "joint_compliance.j2".
        std: in `unit`; infinite where the readings do not determine the parameter.
        value: estimated or ordinary magnitude, in `unit`; None without.
        unit: SI.
    """

    name: str
    std: float
    value: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class CriterionResult:
    """The design that a criterion chooses for the same number of readings.

    The observability indices are those of Sun & Hollerbach (2008), with σ the singular values of
    the whitened Jacobian by the parameters in ordinary magnitudes.

    Attributes:
        criterion: its name.
        position_std_m: standard uncertainty of the position at the prediction poses, m.
        position_open_m: the same with all potential terms estimated, too.
        joint_share: largest relative standard uncertainty of a joint compliance; None without.
        o1: (Π σ)^(1/P) / √N, which D maximises; σ² are the eigenvalues of the Schur complement
            of the model's parameters without a prior.
        o2: σ_min / σ_max, which K maximises; of the model alone.
        o3: σ_min, which E maximises.
        efficiency: certified lower bound of the efficiency by this criterion; None without.
    """

    criterion: str
    position_std_m: float | None
    position_open_m: float | None
    joint_share: float | None
    o1: float
    o2: float
    o3: float
    efficiency: float | None


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """A point of the sample-size curve.

    Attributes:
        poses: number of poses without the reference.
        position_std_m: standard uncertainty of the position at the prediction poses, m.
        efficiency: certified efficiency with this number of poses; None without.
        all_effects_std_m: as of `PlanSummary`.
    """

    poses: int
    position_std_m: float
    efficiency: float | None = None
    all_effects_std_m: float | None = None


@dataclass(frozen=True, slots=True)
class PlanSummary(Brief):
    """Cost, predicted precision and efficiency of a plan."""

    poses: int  # without the reference
    readings: int  # with those at the reference
    loads: dict[str, int]  # readings by load, with "none", in order
    duration: Duration
    criterion: str
    efficiency: float | None  # certified lower bound; None without a certificate
    parameters: tuple[PredictedParameter, ...]  # predicted precision by parameter
    # RMS standard uncertainty of the prediction at the prediction poses, m; None without. Not the
    # accuracy of the robot: see `position_note`.
    position_std_m: float | None
    position: str = ""  # predicted quantity, e.g. "deflection under 5kg at 100 poses"
    criteria: tuple[CriterionResult, ...] = ()  # criterion comparison, with that of the plan
    curve: tuple[CurvePoint, ...] = ()  # sample-size curve, fewest poses first
    detectable: tuple[DetectableEffect, ...] = ()  # minimum detectable effects
    longer: float = 0.0  # share of time beyond the shortest order
    confounding: Confounding | None = None  # of the order with a linear drift
    shortest: Confounding | None = None  # confounding of the shortest order
    remarks: tuple[str, ...] = ()  # assumptions and omissions, one sentence each
    asked_poses: int | None = None  # requested number of poses; None if readings were requested
    # as `position_std_m`, with every effect of the catalogue unknown and as large as arms have it,
    # or as the readings so far tell it; None by other criteria than I
    all_effects_std_m: float | None = None
    random_std_m: float | None = None  # the same of as many poses drawn at random, median

    @property
    def quantity(self) -> str:
        """Quantity predicted at the prediction poses: "deflection" or "position"."""
        return self.position.split(" ")[0] or "position"

    @property
    def position_note(self) -> str:
        """What `position_std_m` is, and what it excludes, in a sentence."""
        return position_note(self.quantity)

    @property
    def load_changes(self) -> int:
        """Number of load changes by hand, with the removal of the last load."""
        return len(self.loads) if len(self.loads) > 1 else 0

    def to_dict(self) -> dict[str, object]:
        """Return the JSON document."""
        fields, of_plan, shortest = asdict(self), self.confounding, self.shortest
        order = None
        if of_plan is not None and shortest is not None:
            order = {
                "longer": self.longer,
                "lost": of_plan.correlation**2,
                "lost_shortest": shortest.correlation**2,
                **{key: getattr(of_plan, key) for key in ("drift", "error_m", "bias_m")},
                "told": of_plan.drift_std,
            }
        keys = ("poses", "readings", "criterion", "efficiency", "position_std_m", "parameters")
        return {
            **{key: fields[key] for key in keys}, "asked_poses": self.asked_poses,
            "position": self.position, "position_note": self.position_note,
            "all_effects_std_m": self.all_effects_std_m, "random_std_m": self.random_std_m,
            "predicted_std": {p.name: p.std for p in self.parameters},
            "readings_by_load": self.loads, "criteria": fields["criteria"],
            "curve": fields["curve"], "detectable": fields["detectable"], "order": order,
            "remarks": list(self.remarks),
        }  # fmt: skip


def summarise(
    planned: Planned,
    config: CellConfig,
    rng: np.random.Generator,
    say: Say = lambda _: None,
    *,
    compare: bool = True,  # whether to compute the criterion comparison
    curve: bool = True,  # whether to compute the sample-size curve
) -> PlanSummary:
    """Return the summary of a plan."""
    plan, precision = planned.ordered.plan, planned.predicted
    if compare or curve:
        say("comparing criteria and numbers of poses" if compare else "comparing numbers of poses")
    return PlanSummary(
        poses=len({s.pose for s in plan.steps} - {REFERENCE}), readings=len(plan.steps),
        loads={name: sum(s.load == name for s in plan.steps) for name in plan.loads},
        duration=planned.ordered.duration, criterion=planned.criterion,
        efficiency=planned.design.efficiency, parameters=_parameters(planned),
        position_std_m=_finite(precision.position), position=planned.work.description,
        criteria=tuple(_criteria(planned, config, rng)) if compare else (),
        curve=tuple(_curve(planned, rng)) if curve else (),
        detectable=tuple(detectable_effects(planned, config)), longer=planned.ordered.longer,
        confounding=planned.ordered.confounding, shortest=planned.ordered.confounding_shortest,
        remarks=remarks(planned), asked_poses=planned.asked_poses,
        all_effects_std_m=_finite(planned.all_effects_std(planned.design.information)),
        random_std_m=_random_std(planned, rng),
    )  # fmt: skip


def position_note(quantity: str) -> str:
    """Return a sentence on what the uncertainty of a "deflection" or "position" excludes."""
    return (
        f"standard uncertainty (rms) of the {quantity} that the fitted model predicts; it is not "
        f"the accuracy of the robot: {_LEFT_OUT[quantity]} are not in it"
    )


def _parameters(planned: Planned) -> tuple[PredictedParameter, ...]:
    precision, frames = planned.predicted, _prefixes(planned.problem, *FRAME_ROLES)
    by_name = {
        t.name: PredictedParameter(t.name, float(std), t.value or None, t.unit)
        for t, std in zip(precision.terms, precision.std, strict=True)
        # deflections do not determine the origin of a frame
        if np.isfinite(std) or not t.name.startswith(frames)
    }
    for u in planned.undetermined:
        by_name[u.name] = PredictedParameter(u.name, np.inf, u.value or None, u.unit)
    effects = planned.problem.nominal.model.effects
    names = (f"{e.name}.{p.name}" for e in effects for p in e.parameters)
    return tuple(by_name[name] for name in names if name in by_name)


def remarks(planned: Planned) -> tuple[str, ...]:
    """Return assumptions and omissions of a plan, one sentence each."""
    omitted = tuple(
        f'load "{name}" is not worth its time: without it the same time would make the plan '
        f"{100 * gain:.0f} % more efficient"
        for name, gain in planned.costly
    )
    readings, efficiency = int(planned.design.cost), planned.design.efficiency
    suboptimal = planned.asked_poses is not None and efficiency < NOTABLE_EFFICIENCY
    if planned.criterion == "I":  # no plan comes near the bound, which splits single readings
        positions = planned.problem.nominal.cell.configured().planning.readings == "absolute"
        several = positions and len(planned.problem.candidates.loads) > 1
        if several and planned.asked_poses is not None:
            omitted += (
                "many poses without a load can tell more than few poses under every load: "
                f"--readings {readings} chooses among both",
            )
    elif suboptimal:
        omitted += (
            f"the same number of readings at the most informative poses and loads (--readings "
            f"{readings}) would be up to {100 / efficiency - 100:.0f} % more efficient",
        )
    undetermined = (u.remark for u in planned.undetermined)
    notes = (*undetermined, *omitted, *planned.candidates.remarks, *planned.problem.notes)
    return tuple(dict.fromkeys(notes))


def about(planned: Planned) -> dict[str, object]:
    """Return the origin of a plan, as its file stores it."""
    precision = planned.predicted
    return {
        **planned.ordered.plan.about,
        "made_by": "optimal design",
        "criterion": planned.criterion,
        "efficiency": round(planned.design.efficiency, 6),
        "predicted_std": {n: _finite(s) for n, s in precision.by_name().items()}
        | {u.name: None for u in planned.undetermined},
        "position_std_m": _finite(precision.position),
        "position": planned.work.description,
        "position_note": position_note(planned.work.description.split(" ")[0]),
        "candidates": len(planned.candidates.q),
    }


def _finite(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None


def _criteria(
    planned: Planned, config: CellConfig, rng: np.random.Generator
) -> Iterator[CriterionResult]:
    problem = planned.problem
    usable_poses = [problem.contents[k][0] for k in np.flatnonzero(planned.usable)]
    for name in dict.fromkeys((*COMPARED, planned.criterion)):
        if name == planned.criterion:
            yield _result(planned, name, planned.counts, planned.design.efficiency)
            continue
        try:
            objective = compound_objective(problem, config, name, planned.work, planned.budget, rng)
            if planned.asked_poses is not None:
                candidates = pose_units(objective, problem)
                among = np.isin(candidates.poses, usable_poses)
                chosen, _ = choose_poses(objective, candidates, among, planned.asked_poses, rng, 1)
                design = certified_design(objective, chosen, planned.usable)
            else:
                design = best_design(objective.among(planned.usable), planned.budget, rng, effort=1)
        except CannotAnswerError:
            continue
        counts = np.zeros(len(problem.units))
        counts[planned.usable] = design.counts
        yield _result(planned, name, counts, design.efficiency)


def _result(planned: Planned, name: str, counts: Floats, efficiency: float) -> CriterionResult:
    problem, free = planned.problem, without_prior(planned.problem)
    precision = predicted_uncertainty(problem, counts, work=planned.work)
    used = np.flatnonzero(counts)
    information = problem.units.information(counts[used], used)
    schur = schur_complement(problem.prior + information, free)
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(schur), 0.0))
    alone = np.sqrt(np.maximum(np.linalg.eigvalsh(information[np.ix_(free, free)]), 0.0))
    readings = float(counts @ problem.units.cost)
    baseline = _prefixes(problem, "baseline")
    shares = [
        std / abs(t.value)
        for t, std in zip(precision.terms, precision.std, strict=True)
        if t.name.startswith(baseline) and t.value
    ]
    share = _finite(max(shares)) if shares else None
    stds = _finite(precision.position), _finite(precision.position_open)
    o1 = float(np.exp(np.mean(np.log(np.maximum(sigma, 1e-300))))) / np.sqrt(readings)
    o2, o3 = float(alone[0] / alone[-1]), float(sigma[0])
    return CriterionResult(name, *stds, share, o1, o2, o3, efficiency)


def _prefixes(problem: DesignProblem, *roles: Role) -> tuple[str, ...]:
    return tuple(f"{e.name}." for e in problem.nominal.model.effects if e.role in roles)


def _random_std(planned: Planned, rng: np.random.Generator) -> float | None:
    """Return the median `all_effects_std` of random plans of as many poses; None without."""
    objective, count = planned.objective, planned.asked_poses
    if count is None or planned.all_effects_std(objective.prior) is None:
        return None
    poses = pose_units(objective, planned.problem)
    usable = {planned.problem.contents[k][0] for k in np.flatnonzero(planned.usable)}
    among = np.flatnonzero(np.isin(poses.poses, [*usable]))
    if len(among) < count:
        return None
    drawn = (rng.permutation(among)[:count] for _ in range(RANDOM_PLANS))
    units, one = poses.units, np.ones(count)
    stds = [planned.all_effects_std(objective.prior + units.information(one, k)) for k in drawn]
    return _finite(float(np.median([std for std in stds if std is not None])))


def _resized(planned: Planned, poses: int, budget: float, rng: np.random.Generator) -> Floats:
    """Return the counts (K,) of a plan by criterion I of another size."""
    problem, objective, usable = planned.problem, planned.objective, planned.usable
    if planned.asked_poses is not None:
        candidates = pose_units(objective, problem)
        among = np.isin(candidates.poses, [problem.contents[k][0] for k in np.flatnonzero(usable)])
        return choose_poses(objective, candidates, among, poses, rng, 1)[0].astype(float)
    counts = np.zeros(len(usable))
    counts[usable] = best_design(objective.among(usable), budget, rng, effort=1).counts
    return counts


def _curve(planned: Planned, rng: np.random.Generator) -> Iterator[CurvePoint]:
    problem = planned.problem
    objective, usable = planned.objective.among(planned.usable), np.flatnonzero(planned.usable)
    n_poses = len({problem.contents[k][0] for k in np.flatnonzero(planned.counts)})
    last, previous = planned.design.relaxed, 0
    for share in SHARES:
        budget, poses = share * planned.budget, max(1, round(share * n_poses))
        if budget < objective.units.cost.max() or poses == previous:
            continue
        previous, std = poses, None
        if planned.criterion == "I":  # the continuous optimum splits single readings
            try:
                counts = planned.counts if share == 1.0 else _resized(planned, poses, budget, rng)
            except CannotAnswerError:
                continue
            std = planned.all_effects_std(planned.objective.information(counts))
            information = problem.prior + problem.units.information(counts)
        else:
            last = relax(objective, budget, tolerance=COARSE_GAP, start=last)
            information = problem.prior + problem.units.information(last.weight, usable[last.index])
        position = _finite(
            predicted_uncertainty(problem, information=information, work=planned.work).position
        )
        if position is not None:
            yield CurvePoint(poses, position, all_effects_std_m=_finite(std))


def detectable_effects(planned: Planned, config: CellConfig) -> Iterator[DetectableEffect]:
    """Yield the minimum detectable strength of each effect outside of the model.

    It is the RMS displacement over the plan's poses and loads, divided by the root of the
    non-centrality beyond the model; the median over random directions of the parameters.
    """
    problem, size = planned.problem, planned.problem.model_size
    used = np.flatnonzero(planned.counts)
    information = problem.measured + problem.units.information(planned.counts[used], used)
    model_prior = problem.prior[:size, :size] - problem.measured[:size, :size]
    information[:size, :size] += model_prior
    chosen = problem.candidates[sorted({problem.contents[k][0] for k in used})]
    parts = reading_derivatives(problem.nominal, config, chosen, problem.families, problem.scale)
    blocks = [part.jacobian[..., :3, :] for part in parts]
    if problem.mode == "deflection":
        blocks = [block[:, 1:] - block[:, :1] for block in blocks]
    displacement = np.concatenate([block.reshape(-1, len(problem.terms)) for block in blocks])
    rng = np.random.default_rng(_SEED)
    for effect in problem.families:
        columns = problem.of_effect(effect.name)
        schur = schur_complement(information, columns, np.arange(size))
        strengths = []
        for _ in range(DRAWS):
            beta = rng.standard_normal(len(columns))
            noncentrality = float(beta @ schur @ beta)
            size_m = float(np.sqrt(3.0 * np.mean((displacement[:, columns] @ beta) ** 2)))
            visible = noncentrality > VISIBLE * len(columns)
            strengths.append(size_m / np.sqrt(noncentrality) if visible else np.inf)
        yield DetectableEffect(effect.name, _finite(float(np.median(strengths))))


@dataclass(frozen=True, slots=True, eq=False)
class CheckedPlan(Tabular):
    """A plan whose dry run passed, and its summary."""

    plan: Plan  # poses, loads and steps
    dry: DryRun
    summary: PlanSummary  # cost, predicted precision and efficiency

    def _brief(self) -> dict[str, str]:
        s, efficiency = self.summary, self.efficiency
        return {
            "poses": f"{s.poses} and the reference",
            "readings": f"{s.readings}, in {self.dry.duration / 60:.0f} min",
            "loads": ", ".join(f"{name} {count}" for name, count in s.loads.items()),
            "criterion": s.criterion,
            "efficiency": "not certified" if efficiency is None else f"at least {efficiency:.3f}",
            "more": "summary, to_frame(), save()",
        }

    @property
    def efficiency(self) -> float | None:
        """Certified lower bound of the efficiency; None without a certificate."""
        return self.summary.efficiency

    def save(self, path: str | Path) -> None:
        """Write the plan file of `hilcal run --plan`."""
        replace_file(path, self.plan.to_json() + "\n")

    def to_dict(self) -> dict[str, object]:
        """Return the JSON document."""
        return {
            **self.summary.to_dict(),
            "loads": list(self.plan.loads),
            "load_changes": self.dry.load_changes,
            "motions": self.dry.motions,
            "duration_s": self.dry.duration,
        }


def checked(cell: Cell, plan: Plan, summary: PlanSummary) -> CheckedPlan:
    """Check a plan in a dry run, whose remarks come first in the summary."""
    dry = dry_run(cell, plan)
    refuse(dry, "the plan")
    remarks = tuple(dict.fromkeys((*dry.remarks, *summary.remarks)))
    return CheckedPlan(plan, dry, replace(summary, remarks=remarks))


def refuse(dry: DryRun, what: str) -> None:
    """Refuse a plan that did not pass its dry run."""
    if (error := refusal(dry, what)) is not None:
        raise error


def refusal(dry: DryRun, what: str) -> InputError | None:
    """Return the error of a plan that did not pass its dry run; None if it passed."""
    return InputError(f"{what} cannot be run: {dry.first_problem}") if dry.problems else None
