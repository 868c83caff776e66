"""The measurements that settle a doubt: a plan that separates suspects, or many poses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.criteria import Pair
from hilcal.design.discriminated_pairs import (
    LEAST_POWER,
    LEVEL,
    DiscriminatedPairs,
    not_ruled_out,
    pair_of,
    power,
    supported_parameters,
)
from hilcal.design.feasible import Space
from hilcal.design.information import DesignProblem, readings_of
from hilcal.design.planner import Planned, Request, Say, make, ordered
from hilcal.design.predicted import predicted
from hilcal.design.run_order import Ordering
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit
from hilcal.regression.evidence import family_power
from hilcal.regression.schur import schur_complement
from hilcal.robot.chain import evaluate
from hilcal.store.plan import REFERENCE, UNLOADED
from hilcal.types import Floats, Ints

CANDIDATES = 600  # Most poses to choose from. A choice: more cost time and hardly raise the power.
DRAWS = 24  # Parameters of each suspect over which a power is averaged. A choice.
SURE = 0.9  # Power from which on two suspects count as separated. A choice.


@dataclass(frozen=True, slots=True)
class PairPower:
    """The power of separating one suspect from another."""

    effect: str  # the effect that is there
    rival: str  # the one that is fitted in its stead
    now: float  # chance that the readings so far reject the rival, by a test at 1 %
    then: float  # the same with the planned readings
    not_separable: bool  # neither these readings nor `MANY` others reach `LEAST_POWER`


@dataclass(frozen=True, slots=True, eq=False)
class Next:
    """The measurements that separate suspects."""

    planned: Planned
    powers: tuple[PairPower, ...]  # of each pair, both ways round
    shares: dict[str, float]  # by load, the share of what separates the weakest pair
    # horizontal reach of the target, averaged over the planned poses by how much they separate the
    # weakest pair, over its mean in all candidate poses
    reach_ratio: float
    notes: tuple[str, ...]  # what was left out, one line each


def measure_next(
    cell: Cell,
    config: CellConfig,
    fit: Fit,  # what has been measured, in scaling gc, of a model without the suspects
    suspects: Sequence[str],  # two effects or more
    request: Request,  # readings, or as many as so many poses take under every load
    rng: np.random.Generator,
    say: Say = lambda words: None,
    reference: Floats | None = None,  # (n,) the campaign's joints, rad; else a new one
) -> Next:
    """Plan the measurements that separate suspects.

    The criterion is the least non-centrality over all pairs of them; see `discriminated_pairs`.
    """
    names = tuple(dict.fromkeys(suspects))
    if len(names) < 2:
        raise InputError(f"{len(names)} suspects; two or more are needed to separate them")
    asked = {
        "readings": fit.mode,
        "against": names,
        "candidates": min(config.planning.candidates, CANDIDATES),
    }
    planning = config.planning.model_copy(update=asked)
    config = config.model_copy(update={"planning": planning})
    readings = request.readings or request.poses * (1 + len(config.loads))
    wanted = replace(request, criterion="separate", readings=readings)
    try:
        made = make(cell, config, wanted, rng, fit, say)
    except InputError as error:
        if "effects to tell apart" not in str(error):
            raise
        lines = f"at most one of {', '.join(names)} changes what can be measured in this cell"
        raise CannotAnswerError(f"{lines}: no measurement separates them") from None
    if reference is not None and not np.array_equal(reference, made.ordered.plan.q[0]):
        made = _from_reference(cell, config, made, reference, rng, request)
    say("predicting the powers")
    of = made.asked.apart
    assert of is not None  # noqa: S101  (the criterion is of pairs)
    then = of.prior + made.problem.units.information(made.counts)
    powers = tuple(_pair_powers(made.problem, of, names, then))
    seen = {e.name for e in made.problem.families}
    lost = [n for n in names if n not in seen]
    notes = tuple(n for n in made.problem.notes if n.split(":")[0] in lost)
    never = tuple((p.effect, p.rival) for p in powers if p.not_separable and p.effect in seen)
    if never:
        notes = (*notes, not_ruled_out(never))
    weakest = min(of.pairs, key=lambda pair: power(pair, then))
    shares, reach_ratio = _where(made, weakest, then)
    return Next(made, powers, shares, reach_ratio, notes)


def expected(
    problem: DesignProblem, names: tuple[str, str], betas: Sequence[Floats], information: Floats
) -> float:
    """Return the power of a pair (effect, rival), the mean over parameters β (E,) of the effect."""
    if not len(betas):
        return LEVEL
    pair = pair_of(problem, names, betas[0])
    s = schur_complement(information, pair.effect, pair.nuisance)
    return float(np.mean([family_power(s, beta, LEVEL) for beta in betas]))


def _pair_powers(
    problem: DesignProblem, of: DiscriminatedPairs, names: tuple[str, ...], then: Floats
) -> Iterator[PairPower]:
    seen = {e.name for e in problem.families}
    supported = supported_parameters(problem, DRAWS)
    for e in names:
        betas = [p.beta for p, n in zip(of.pairs, of.names, strict=True) if n[0] == e]
        if e in supported:
            betas = list(supported[e] / problem.scale[problem.of_effect(e)])
        for f in names:
            if e == f:
                continue
            if e not in seen:
                yield PairPower(e, f, LEVEL, LEVEL, True)
                continue
            now, later = (expected(problem, (e, f), betas, m) for m in (of.prior, then))
            never = (e, f) in of.not_separable and later < LEAST_POWER
            yield PairPower(e, f, now, later, never)


def _from_reference(
    cell: Cell, config: CellConfig, made: Planned, reference: Floats, rng: np.random.Generator,
    request: Request,
) -> Planned:  # fmt: skip
    """Return the plan in an order from another reference pose, without what that cannot reach."""
    space, of = Space(cell, config), made.problem
    counts = made.counts.astype(np.int64)
    for load in of.candidates.loads:
        taken = [k for k in np.flatnonzero(counts) if load in readings_of(of.what[k], of.mode)]
        if taken:
            q = of.candidates.q[[of.what[k][0] for k in taken]]
            counts[np.array(taken)[~space.passable(reference, q, load)]] = 0
    if not counts.any():
        raise CannotAnswerError(
            "none of the poses that separate the suspects is reached from the campaign's "
            "reference pose; start another campaign for them"
        )
    steps = made.ordered.plan.steps
    repeats = sum(s.load == UNLOADED and s.cycle > 0 and s.pose != REFERENCE for s in steps)
    how = Ordering(unloaded=request.unloaded, repeats=repeats)
    return reordered(space, made, counts, reference, rng, how)


def reordered(
    space: Space,
    made: Planned,
    counts: Ints,  # (K,) how often each unit is taken
    reference: Floats,  # (n,) joints of the reference pose, from which all units are reached, rad
    rng: np.random.Generator,
    how: Ordering,
) -> Planned:
    """Return a plan with other units of its problem, in an order of its own."""
    of, usable, asked = made.problem, np.flatnonzero(made.usable), made.asked
    information = asked.prior + asked.units.information(counts.astype(float))
    design = replace(
        made.design,
        counts=counts[usable],
        value=float(asked.criterion.value(information)),
        information=information,
        cost=float(counts @ of.units.cost),
    )
    knows = predicted(of, counts.astype(float), work=made.work)
    order = ordered(space, of, reference, counts, rng, how)
    return replace(made, ordered=order, design=design, predicted=knows)


def _where(made: Planned, pair: Pair, then: Floats) -> tuple[dict[str, float], float]:
    """Return the loads' shares in uᵀ M u of a pair, and the ratio of the reach (see `Next`)."""
    of, u = made.problem, pair.residual(then)
    taken = np.flatnonzero(made.counts)
    worth = np.array([float(np.sum((of.units.rows[k] @ u) ** 2)) for k in taken])
    worth *= made.counts[taken]
    total = max(float(worth.sum()), 1e-300)
    shares: dict[str, float] = {}
    for k, value in zip(taken, worth, strict=True):
        loads = of.what[k][1]
        m = of.nominal.elements
        rows = of.units.rows[k][: m * len(loads)] @ u
        by = np.sum(rows.reshape(len(loads), m) ** 2, axis=1)
        for load, part in zip(loads, by, strict=True):
            share = float(part / max(float(by.sum()), 1e-300) * value / total)
            shares[load] = shares.get(load, 0.0) + share

    arm, cell = of.nominal.cell.arm, of.nominal.cell
    at = np.linalg.norm(evaluate(arm, of.candidates.q).point(cell.target[:3, 3])[:, :2], axis=1)
    poses = np.array([of.what[k][0] for k in taken])
    reach = float(at[poses] @ worth) / total
    return shares, reach / float(np.mean(at))


CRITERION = "D"  # By which the plan's efficiency is stated; its poses are not chosen by it
SPARE = 2  # Candidates per pose: some are not reached from the reference. A choice.
LEAST = 60  # Candidates at least, so that a reference is found; a choice
REPEATED = 10  # One pose of so many is arrived at twice, for the arm's repeatability. A choice.


def measure_poses(
    cell: Cell,
    config: CellConfig,
    fit: Fit,  # what has been measured, absolute readings
    poses: int,
    rng: np.random.Generator,
    say: Say = lambda words: None,
    reference: Floats | None = None,  # (n,) the campaign's joints, rad; else a new one
) -> Planned:
    """Plan distinct poses spread evenly over the joint space, each read once without a load.

    An optimal design would take few poses many times, which is best for a model that is known. What
    errs from pose to pose, finer than the poses so far resolve, needs poses where nothing was read.
    The candidates' order is that of a Sobol sequence: the first ones that are reached are taken.
    """
    count = max(SPARE * poses, LEAST)
    planning = config.planning.model_copy(update={"readings": fit.mode, "candidates": count})
    config = config.model_copy(update={"loads": [], "planning": planning})
    made = make(
        cell, config, Request(poses, readings=poses, criterion=CRITERION, effort=0), rng, fit, say
    )
    say("spreading the poses")
    of, space = made.problem, Space(cell, config)
    home = made.ordered.plan.q[0] if reference is None else reference
    usable = np.flatnonzero(made.usable)
    q = of.candidates.q[[of.what[k][0] for k in usable]]
    taken = usable[space.passable(home, q, UNLOADED)][:poses]
    if not len(taken):
        raise CannotAnswerError(
            "no pose is reached from the campaign's reference pose; start another campaign"
        )
    counts = np.zeros(len(made.usable), dtype=np.int64)
    counts[taken] = 1
    how = Ordering(repeats=max(2, len(taken) // REPEATED))
    return reordered(space, made, counts, home, rng, how)
