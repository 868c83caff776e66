"""The next measurements: a plan that separates suspects, or many poses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.design.choice import (
    LEAST_POWER,
    LEVEL,
    not_ruled_out,
    pair_of,
    power,
    supported_parameters,
)
from hilcal.design.criterion import DiscriminatedPairs, Pair
from hilcal.design.feasible import FeasibleSpace
from hilcal.design.information import DesignProblem, readings_of
from hilcal.design.planner import Planned, PlanRequest, Say, order_readings, plan_readings
from hilcal.design.predicted import predicted_uncertainty
from hilcal.design.run_order import Ordering
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit
from hilcal.regression.evidence import family_power
from hilcal.regression.schur import schur_complement
from hilcal.robot.chain import evaluate
from hilcal.store.plan import REFERENCE, UNLOADED
from hilcal.types import Floats, Ints

CANDIDATES = 600  # poses to choose from, at most; a choice: more hardly raise the power
DRAWS = 24  # parameter vectors of each suspect over which power is averaged; a choice
SEPARATED_POWER = 0.9  # power from which two suspects count as separated; a choice


@dataclass(frozen=True, slots=True)
class PairPower:
    """The power of separating one suspect from another."""

    effect: str  # present
    rival: str  # fitted in its place
    power_now: float  # probability that the readings so far reject the rival, by a test at 1 %
    power_planned: float  # the same with the planned readings
    not_separable: bool
    """Neither the planned readings nor `MANY_READINGS` others reach `LEAST_POWER`."""


@dataclass(frozen=True, slots=True, eq=False)
class SeparatingPlan:
    """The measurements that separate suspects."""

    planned: Planned
    powers: tuple[PairPower, ...]  # of all ordered pairs
    shares: dict[str, float]  # by load, the share in the non-centrality of the weakest pair
    # horizontal reach of the target, averaged over the planned poses with their shares in that
    # non-centrality as weights, over the mean of all candidate poses
    reach_ratio: float
    notes: tuple[str, ...]  # on omitted effects and pairs, one line each


def plan_separating(
    cell: Cell,
    fit: Fit,  # of the readings so far, with scaling gc and without the suspects
    suspects: Sequence[str],  # two effects or more
    request: PlanRequest,  # readings, or poses under every load
    rng: np.random.Generator,
    say: Say = lambda _: None,
    reference: Floats | None = None,  # (n,) reference pose of the campaign, rad; else a new one
) -> SeparatingPlan:
    """Plan the measurements that separate suspects.

    The criterion is the least non-centrality over all their pairs; see `discriminated_pairs`.
    """
    config = cell.configured()
    names = tuple(dict.fromkeys(suspects))
    if len(names) < 2:
        raise InputError(f"{len(names)} suspects; two or more are needed to separate them")
    count = min(config.planning.candidates, CANDIDATES)
    keys = {"readings": fit.mode, "against": names, "candidates": count}
    cell = cell.with_config(config.with_keys("planning", **keys))
    readings = request.readings or request.poses * (1 + len(config.loads))
    separating_request = replace(request, criterion="separate", readings=readings)
    try:
        planned = plan_readings(cell, separating_request, rng, fit, say)
    except InputError as error:
        if "effects to tell apart" not in str(error):
            raise
        reason = f"at most one of {', '.join(names)} changes what can be measured in this cell"
        raise CannotAnswerError(f"{reason}: no measurement separates them") from None
    if reference is not None and not np.array_equal(reference, planned.ordered.plan.q[0]):
        planned = _from_reference(cell, planned, reference, rng, request)
    say("predicting the powers")
    pairs = planned.objective.discriminated_pairs
    assert pairs is not None  # noqa: S101  (by the criterion)
    information = pairs.prior + planned.problem.units.information(planned.counts)
    powers = tuple(_pair_powers(planned.problem, pairs, names, information))
    observable = {e.name for e in planned.problem.families}
    omitted = [n for n in names if n not in observable]
    notes = tuple(n for n in planned.problem.notes if n.split(":")[0] in omitted)
    never = tuple((p.effect, p.rival) for p in powers if p.not_separable and p.effect in observable)
    notes += (not_ruled_out(never),) if never else ()
    weakest = min(pairs.pairs, key=lambda pair: power(pair, information))
    shares, reach_ratio = _shares_and_reach(planned, weakest, information)
    return SeparatingPlan(planned, powers, shares, reach_ratio, notes)


def expected_power(
    problem: DesignProblem, names: tuple[str, str], betas: Sequence[Floats], information: Floats
) -> float:
    """Return the power of a pair (effect, rival), averaged over parameters β (E,) of the effect."""
    if not len(betas):
        return LEVEL
    pair = pair_of(problem, names, betas[0])
    s = schur_complement(information, pair.effect, pair.nuisance)
    return float(np.mean([family_power(s, beta, LEVEL) for beta in betas]))


def _pair_powers(
    problem: DesignProblem, pairs: DiscriminatedPairs, names: tuple[str, ...], information: Floats
) -> Iterator[PairPower]:
    observable = {e.name for e in problem.families}
    supported = supported_parameters(problem, DRAWS)
    for e in names:
        betas = [p.beta for p in pairs.pairs if p.names[0] == e]
        if e in supported:
            betas = list(supported[e] / problem.scale[problem.of_effect(e)])
        for f in names:
            if e == f:
                continue
            if e not in observable:
                yield PairPower(e, f, LEVEL, LEVEL, True)
                continue
            now = expected_power(problem, (e, f), betas, pairs.prior)
            planned = expected_power(problem, (e, f), betas, information)
            never = (e, f) in pairs.not_separable and planned < LEAST_POWER
            yield PairPower(e, f, now, planned, never)


def _from_reference(
    cell: Cell, planned: Planned, reference: Floats, rng: np.random.Generator,
    request: PlanRequest,
) -> Planned:  # fmt: skip
    """Return the plan ordered from another reference pose, without poses unreachable from it."""
    space, problem = FeasibleSpace(cell), planned.problem
    counts = planned.counts.astype(np.int64)
    for load in problem.candidates.loads:
        units = [
            k
            for k in np.flatnonzero(counts)
            if load in readings_of(problem.contents[k], problem.mode)
        ]
        if units:
            q = problem.candidates.q[[problem.contents[k][0] for k in units]]
            counts[np.array(units)[~space.passable(reference, q, load)]] = 0
    if not counts.any():
        raise CannotAnswerError(
            "none of the poses that separate the suspects is reached from the campaign's "
            "reference pose; start another campaign for them"
        )
    steps = planned.ordered.plan.steps
    repeats = sum(s.load == UNLOADED and s.cycle > 0 and s.pose != REFERENCE for s in steps)
    ordering = Ordering(unloaded=request.unloaded, repeats=repeats)
    return with_reference(space, planned, counts, reference, rng, ordering)


def with_reference(
    space: FeasibleSpace,
    planned: Planned,
    counts: Ints,  # (K,) of units
    reference: Floats,  # (n,) reference pose, from which all units are reachable, rad
    rng: np.random.Generator,
    ordering: Ordering,
) -> Planned:
    """Return a plan with other counts of its units, in a new order."""
    problem, usable, objective = planned.problem, np.flatnonzero(planned.usable), planned.objective
    information = objective.prior + objective.units.information(counts.astype(float))
    value, cost = float(objective.criterion.value(information)), counts @ problem.units.cost
    design = replace(planned.design, counts=counts[usable], value=value, information=information)
    order = order_readings(space, problem, reference, counts, rng, ordering)
    precision = predicted_uncertainty(problem, counts.astype(float), work=planned.work)
    return replace(
        planned, ordered=order, design=replace(design, cost=float(cost)), predicted=precision
    )


def _shares_and_reach(
    planned: Planned, pair: Pair, information: Floats
) -> tuple[dict[str, float], float]:
    """Return the loads' shares in uᵀ M u of a pair, and the reach ratio (see `SeparatingPlan`)."""
    problem, u = planned.problem, pair.residual(information)
    units = np.flatnonzero(planned.counts)
    parts = np.array([float(np.sum((problem.units.rows[k] @ u) ** 2)) for k in units])
    parts *= planned.counts[units]
    total = max(float(parts.sum()), 1e-300)
    shares: dict[str, float] = {}
    m = problem.nominal.elements
    for k, part in zip(units, parts, strict=True):
        loads = problem.contents[k][1]
        rows = problem.units.rows[k][: m * len(loads)] @ u
        squares = np.sum(rows.reshape(len(loads), m) ** 2, axis=1)
        for load, square in zip(loads, squares, strict=True):
            share = float(square / max(float(squares.sum()), 1e-300) * part / total)
            shares[load] = shares.get(load, 0.0) + share
    cell = problem.nominal.cell
    targets = evaluate(cell.arm, problem.candidates.q).point(cell.target[:3, 3])
    reaches = np.linalg.norm(targets[:, :2], axis=1)
    poses = np.array([problem.contents[k][0] for k in units])
    reach = float(reaches[poses] @ parts) / total
    return shares, reach / float(np.mean(reaches))


CRITERION = "D"  # of the stated efficiency; the poses are not chosen by it
SPARE = 2  # candidates per pose: some are unreachable from the reference; a choice
LEAST = 60  # candidates at least, so that a reference pose is found; a choice
REPEATED = 10  # one of this number of poses is visited twice, for the arm's repeatability; a choice


def plan_poses(
    cell: Cell,
    fit: Fit,  # of the absolute readings so far
    poses: int,
    rng: np.random.Generator,
    say: Say = lambda _: None,
    reference: Floats | None = None,  # (n,) reference pose of the campaign, rad; else a new one
) -> Planned:
    """Plan distinct poses spread evenly over the joint space, each read once without a load.

    An optimal design reads few poses many times, which is best for a known model. Errors that vary
    from pose to pose, on a finer scale than the poses so far resolve, need new poses. The
    candidates follow a Sobol sequence; the first reachable ones are taken.
    """
    config = cell.configured()
    count = max(SPARE * poses, LEAST)
    config = config.with_keys("planning", readings=fit.mode, candidates=count)
    cell = cell.with_config(config.model_copy(update={"loads": []}))
    request = PlanRequest(poses, readings=poses, criterion=CRITERION, effort=0)
    planned = plan_readings(cell, request, rng, fit, say)
    say("spreading the poses")
    problem, space = planned.problem, FeasibleSpace(cell)
    home = planned.ordered.plan.q[0] if reference is None else reference
    usable = np.flatnonzero(planned.usable)
    q = problem.candidates.q[[problem.contents[k][0] for k in usable]]
    chosen = usable[space.passable(home, q, UNLOADED)][:poses]
    if not len(chosen):
        raise CannotAnswerError(
            "no pose is reached from the campaign's reference pose; start another campaign"
        )
    counts = np.zeros(len(planned.usable), dtype=np.int64)
    counts[chosen] = 1
    ordering = Ordering(repeats=max(2, len(chosen) // REPEATED))
    return with_reference(space, planned, counts, home, rng, ordering)
