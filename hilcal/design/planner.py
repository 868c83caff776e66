"""From a cell to a plan: candidates, loads, the optimum with its certificate, and the order."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal

import numpy as np

from hilcal import limits
from hilcal.cell import Cell
from hilcal.design import choice
from hilcal.design.approximate_design import ApproximateDesign
from hilcal.design.criteria import MeanVariance
from hilcal.design.criterion import CandidateSet, Objective
from hilcal.design.feasible import DrawnPoses, FeasibleSpace, draw_poses
from hilcal.design.information import DesignProblem, problem, reading_covariance, readings_of
from hilcal.design.nominal_model import model_after, nominal_model
from hilcal.design.optimum import Design, best_design
from hilcal.design.predicted import (
    PredictedUncertainty,
    PredictionPoses,
    predicted_uncertainty,
    prediction_poses,
)
from hilcal.design.run_order import Ordered, Ordering, PoseReadings, order_plan
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.per_joint import PerJoint
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.carried.carried_prior import CarriedPrior, check_same_links
from hilcal.identification.fit import Fit
from hilcal.identification.registration.placement import MIN_POSES
from hilcal.measuring.route import seconds_at_rest
from hilcal.regression.normal_equations import INFORMATION
from hilcal.regression.schur import DETERMINED
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

SHARE = 0.1  # parameters with a larger share of a singular direction are confounded; a choice


@dataclass(frozen=True, slots=True)
class UndeterminedParameter:
    """A parameter that a plan omits."""

    name: str  # as identification prints it, e.g. "joint_compliance.j1"
    unit: str  # SI
    value: float  # assumed, SI
    confounded: tuple[str, ...] = ()  # parameters that it is not separated from
    joint: str = ""  # "joint 1" or "joints 1-2" of a joint compliance; else empty

    @property
    def remark(self) -> str:
        """What is not determined, why, and the remedy, in a sentence or two."""
        why, remedy = "no reading in this cell changes with it", ""
        if self.confounded:
            why = f"no reading in this cell separates it from {', '.join(self.confounded)}"
        elif self.joint:
            slides = self.unit == "m/N"
            action = "force along the travel of" if slides else "torque about"
            needs = "need" if self.joint.startswith("joints") else "needs"
            pull, across = ("pull along it", "") if slides else ("side pull", " across the axis")
            why = f"no load of this cell makes a {action} {self.joint}"
            remedy = f": {self.joint} {needs} a {pull}, [[loads]] with force_N{across}, e.g. "
            remedy += "[80.0, 0.0, 0.0]"
        return f"{self.name}: not determined; {why}. The plan omits it{remedy}"


def without_undetermined(
    problem: DesignProblem,
) -> tuple[DesignProblem, tuple[UndeterminedParameter, ...]]:
    """Return the problem of the parameters that the candidates determine, and the other parameters.

    A parameter without a prior is omitted if its ordinary magnitude changes all candidates together
    by less than `INFORMATION`. Of confounded parameters, as many as necessary are omitted.
    """
    size = problem.model_size
    total = problem.prior + problem.units.information(np.ones(len(problem.units)))
    flat = np.isinf(problem.nominal.prior_std[problem.nominal.live])
    omitted = dict(_undetermined(total[:size, :size], flat))
    if not omitted:
        return problem, ()
    undetermined = tuple(_named(problem, k, confounded) for k, confounded in omitted.items())
    if len(omitted) == int(flat.sum()):
        raise CannotAnswerError(undetermined[0].remark)
    retained = np.setdiff1d(np.arange(len(problem.terms)), list(omitted))
    of_model, carried = retained[retained < size], problem.nominal.carried
    carried = None if carried is None else carried[np.ix_(of_model, of_model)]
    nominal = replace(problem.nominal, live=problem.nominal.live[of_model], carried=carried)
    rows = np.ascontiguousarray(problem.units.rows[:, :, retained])
    units, terms = CandidateSet(rows, problem.units.cost), tuple(problem.terms[k] for k in retained)
    prior, measured = (m[np.ix_(retained, retained)] for m in (problem.prior, problem.measured))
    reduced = replace(
        problem, nominal=nominal, units=units, terms=terms, prior=prior, measured=measured
    )
    return reduced, undetermined


def _undetermined(m: Floats, flat: Bools) -> Iterator[tuple[int, Ints]]:
    """Yield the parameters that M (P, P) does not determine, with those confounded with each."""
    blind = np.flatnonzero(flat & (np.diag(m) < INFORMATION**2))
    for k in blind:
        yield int(k), np.zeros(0, dtype=np.int64)
    retained = np.setdiff1d(np.arange(len(m)), blind)
    while flat[retained].any():
        root = np.sqrt(np.diag(m)[retained])
        values, vectors = np.linalg.eigh(m[np.ix_(retained, retained)] / np.outer(root, root))
        share = np.abs(vectors[:, 0]) * flat[retained]
        if values[0] > DETERMINED or not share.any():
            return
        worst = int(np.argmax(share))
        confounded = np.flatnonzero(share > SHARE * share.max())
        yield int(retained[worst]), retained[confounded[confounded != worst]]
        retained = np.delete(retained, worst)


def _named(problem: DesignProblem, k: int, confounded: Ints) -> UndeterminedParameter:
    term, joint = problem.terms[k], ""
    for e in problem.nominal.model.effects:
        if isinstance(e, PerJoint) and e.role == "baseline" and e.name == term.effect:
            names = [f"{e.name}.{p.name}" for p in e.parameters]
            joint = e.shared.words[names.index(term.name)]
    confounded_names = tuple(problem.terms[int(j)].name for j in confounded)
    return UndeterminedParameter(term.name, term.unit, term.value, confounded_names, joint)


HOMES = 4  # central poses, of which one becomes the reference; a choice
PROBES = 60  # poses whose access from the reference is tested; a choice
SAMPLE = 50  # poses over which the noise of a reading is averaged; a choice
ROUNDS = 6  # rounds of replacing poses that are unreachable from the reference; a choice

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """Size and criterion of a plan."""

    poses: int = 20  # each read once unloaded and under every load that it bears
    readings: int | None = None  # instead of poses; without those at the reference and repeats
    criterion: str | None = None  # of `[planning]` by default, else I, or D for deflections
    effort: int = choice.EFFORT  # of the search for integer counts
    unloaded: Literal["around", "first"] = "around"  # see `Ordering`


@dataclass(frozen=True, slots=True, eq=False)
class Planned:
    """A plan with its design problem."""

    ordered: Ordered  # the plan in order, with the cost of the order
    design: Design  # counts of the usable units, with the certificate
    costly: tuple[tuple[str, float], ...]  # loads not worth their change, with the gain
    problem: DesignProblem
    objective: Objective  # the design problem with its criterion
    usable: Bools  # (K,) units to choose from
    work: PredictionPoses
    candidates: DrawnPoses
    budget: float  # readings of the design
    criterion: str
    predicted: PredictedUncertainty  # of a fit to the readings
    undetermined: tuple[UndeterminedParameter, ...]  # by any reading of the cell
    asked_poses: int | None  # requested number of poses; None if readings were requested

    @property
    def counts(self) -> Floats:
        """Counts (K,) of the problem's units."""
        out = np.zeros(len(self.problem.units))
        out[np.flatnonzero(self.usable)] = self.design.counts
        return out

    def all_effects_std(self, information: Floats) -> float | None:
        """Return the RMS standard uncertainty of predictions at an information (P, P), m.

        Every effect of the catalogue is unknown, each as large as arms have it or as the readings
        so far tell it; None where the plan is not made by criterion I.
        """
        criterion = self.objective.criterion
        if self.criterion != "I" or not isinstance(criterion, MeanVariance):
            return None
        return criterion.std(information)


def plan_readings(
    cell: Cell,
    request: PlanRequest,
    rng: np.random.Generator,
    fit: Fit | None = None,  # of the readings so far
    say: Say = lambda _: None,
    catalogue: Catalogue | None = None,  # by default that of `fit`, or the installed effects
    prior: CarriedPrior | None = None,  # of another campaign, without `fit`
    reference: Floats | None = None,  # (n,) reference pose of the campaign, rad; else a new one
) -> Planned:
    """Return a plan of a cell."""
    config = cell.configured()
    if fit is not None:
        fitted = fit.model.cell.arm
        check_same_links("the fit to plan after", fitted.name, fitted.links, cell.arm)
    usual = "I" if config.planning.readings == "absolute" else "D"
    criterion = choice.criterion_name(request.criterion or config.planning.criterion or usual)
    say("drawing candidate poses")
    space, home = FeasibleSpace(cell), reference
    drawn = draw_poses(space, config.planning.candidates, rng, min_poses=2)
    if home is None:
        home, poses = _reference(space, drawn, rng)
        drawn = replace(drawn, q=drawn.q[poses], allowed=drawn.allowed[poses])
    say("computing the information of each pose")
    model = nominal_model(cell, 3, catalogue, prior) if fit is None else model_after(fit, config)
    reduced, undetermined = without_undetermined(problem(model, config, drawn.q, drawn.allowed))
    work = prediction_poses(reduced.nominal, config, drawn.q, space.collision_free)
    by_poses = request.readings is None
    count, unit = (request.poses, "poses") if by_poses else (request.readings or 0, "readings")
    if count < 1:
        raise InputError(f"{count} {unit}; valid: a whole number from 1")
    if not cell.registration_known and fit is None and count + 1 < MIN_POSES:
        raise _too_few_poses(count + 1, unit)
    budget = float(count * (len(reduced.candidates.loads) if by_poses else 1))
    limits.check_planned(f"{count} poses" if by_poses else "the plan", "readings", int(budget))
    objective = choice.compound_objective(reduced, config, criterion, work, budget, rng)
    costly: tuple[tuple[str, float], ...] = ()
    if by_poses:
        say("comparing the gain of each load with its cost")
        change = config.planning.load_change_s / seconds_at_rest(config)
        costly = choice.costly_loads(objective, reduced, budget, change, rng)
    say(f"choosing poses by criterion {criterion}")
    pose_of = np.array([pose for pose, _ in reduced.contents])
    first, relaxed = choice.promising_units(objective, budget)
    usable = ~np.isin(pose_of, _unreachable(space, reduced, home, first))
    candidates = choice.pose_units(objective, reduced) if by_poses else None
    reached: set[int] = set()
    over_poses: ApproximateDesign | None = None
    for remaining in reversed(range(ROUNDS)):
        if not remaining:  # last round: only poses that were reachable in earlier rounds
            usable &= np.isin(pose_of, [*reached])
        if candidates is not None:
            among = np.isin(candidates.poses, pose_of[usable])
            counts, over_poses = choice.choose_poses(
                objective, candidates, among, request.poses, rng, request.effort, over_poses
            )
        else:
            start = relaxed.among(usable)
            usable_objective = objective.among(usable)
            design = best_design(
                usable_objective, budget, rng, effort=request.effort, relaxed=start
            )
            counts = np.zeros(len(usable), dtype=np.int64)
            counts[usable] = design.counts
        units = np.flatnonzero(counts)
        unreachable = _unreachable(space, reduced, home, units)
        if not len(unreachable):
            break
        usable &= ~np.isin(pose_of, unreachable)
        reached |= {reduced.contents[k][0] for k in units} - set(unreachable.tolist())
    else:
        raise CannotAnswerError(
            f"after {ROUNDS} rounds there are still poses that no clear straight motion from the "
            "reference pose reaches; widen the workspace"
        )
    if by_poses:
        design = choice.certified_design(objective, counts, usable, relaxed)
    visited = len({reduced.contents[k][0] for k in units}) + 1
    if not cell.registration_known and fit is None and visited < MIN_POSES:
        raise _too_few_poses(visited, unit)
    say("ordering the readings")
    repeats = max(2, (visited - 1) // 10)
    sampled, nominal = reduced.candidates[slice(0, SAMPLE)].states(), reduced.nominal
    covariance = reading_covariance(nominal, config, nominal.model.predict(sampled, nominal.theta))
    std = float(np.sqrt(np.mean(np.diagonal(covariance[:, :3, :3], axis1=1, axis2=2))))
    ordering = Ordering(unloaded=request.unloaded, repeats=repeats, reading_std=std)
    order = order_readings(space, reduced, home, counts, rng, ordering)
    precision = predicted_uncertainty(reduced, counts.astype(float), work=work)
    return Planned(
        order, design, costly, reduced, objective, usable, work, drawn, budget, criterion,
        precision, undetermined, request.poses if by_poses else None,
    )  # fmt: skip


def _too_few_poses(visited: int, unit: str) -> CannotAnswerError:
    return CannotAnswerError(
        f"the plan has {visited} poses, the reference among them; an unknown registration needs at "
        f"least {MIN_POSES}: ask for more {unit}"
    )


def _reference(
    space: FeasibleSpace, drawn: DrawnPoses, rng: np.random.Generator
) -> tuple[Floats, Ints]:
    """Return a central reference (n,) that bears every load, and the other poses' indices."""
    useful = np.asarray(drawn.allowed.any(axis=0))  # loads that some pose bears
    bears = np.flatnonzero(drawn.allowed[:, useful].all(axis=1))
    if not len(bears):
        raise CannotAnswerError(
            "no pose bears every load, so loads cannot be changed at any; leave out a load "
            "or widen [limits]"
        )
    q = drawn.q[bears]
    nearest = bears[np.argsort(np.linalg.norm(q - np.median(drawn.q, axis=0), axis=1))]
    usable = [name for name, used in zip(drawn.loads, useful, strict=True) if used]
    possible = (k for k in nearest if space.can_start(drawn.q[k], usable))
    central = list(islice(possible, HOMES))
    if not central:
        raise CannotAnswerError(
            "no pose that bears every load can be approached; widen [limits] or the room around"
        )
    probes = drawn.q[rng.permutation(len(drawn.q))[:PROBES]]
    reached = [int(space.passable(drawn.q[k], probes, UNLOADED).sum()) for k in central]
    home = int(central[int(np.argmax(reached))])
    return drawn.q[home], np.delete(np.arange(len(drawn.q)), home)


def _unreachable(space: FeasibleSpace, problem: DesignProblem, home: Floats, units: Ints) -> Ints:
    """Return the poses of the units that no clear straight motion reaches from home."""
    by_load: dict[str, set[int]] = {}
    for unit in (problem.contents[k] for k in units):
        for load in readings_of(unit, problem.mode):
            by_load.setdefault(load, set()).add(unit[0])
    unreachable: set[int] = set()
    for load, poses in by_load.items():
        indices = np.array(sorted(poses))
        reached = space.passable(home, problem.candidates.q[indices], load)
        unreachable |= set(indices[~reached].tolist())
    return np.array(sorted(unreachable), dtype=np.int64)


def order_readings(
    space: FeasibleSpace,
    problem: DesignProblem,
    home: Floats,  # (n,) reference pose, from which all units are reachable, rad
    counts: Ints,  # (K,) of units
    rng: np.random.Generator,
    ordering: Ordering,
) -> Ordered:
    """Name the poses of the chosen units p1, p2, ..., and put their readings in order."""
    units = [(problem.contents[k], int(counts[k])) for k in np.flatnonzero(counts)]
    poses = sorted({pose for (pose, _), _ in units})
    names = {pose: f"p{k}" for k, pose in enumerate(poses, start=1)}
    chosen = [PoseReadings(names[u[0]], readings_of(u, problem.mode), count) for u, count in units]
    q, listed = problem.candidates.q[poses], list(names.values())
    return order_plan(space.cell, listed, q, home, chosen, space.passable, rng, ordering)
