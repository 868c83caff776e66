"""Criteria by name, the choice of units, and of the loads that are worth their change.

Potential terms make a plan good at more than its model, and so less good at the model alone. A
compound criterion is the mean of both: of the logarithms of the two D-efficiencies, so that
neither optimum is needed, or of the two inefficiencies in the parameters' mean variance,

    φ = det(M)^(1/2P) · det(M_ss)^(1/2s)          1/φ = ½ q(M)/q* + ½ q(M_ss)/q_s*

with q(M) = tr(C M⁻¹), the first s of P parameters those of the model, and q* and q_s* the least
of both. Source: Atkinson, Donev and Tobias, *Optimum Experimental Designs, with SAS* (2007),
chapter 21.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.approximate_design import KINKED_TOLERANCE, ApproximateDesign, relax
from hilcal.design.criteria import D, E, K, MeanVariance, Separate, condensed
from hilcal.design.criterion import CandidateSet, Criterion
from hilcal.design.discriminated_pairs import DiscriminatedPairs, discriminated_pairs
from hilcal.design.information import DesignProblem
from hilcal.design.mixed_design import balanced, mixed_design
from hilcal.design.optimum import Design, best
from hilcal.design.predicted import PredictionPoses
from hilcal.errors import CannotAnswerError, InputError
from hilcal.types import Bools, Floats, Ints

CRITERIA = ("D", "A", "E", "K", "I", "separate")
LOOSE = 1e-2  # relative gap of the bound of a plan, and of the comparison of loads; a choice
EFFORT = 200  # of the exchange search: 98 % of the bound of the demo's plan in a second
SAMPLE = 75  # Poses by which sets of loads are compared. A choice.


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """A design problem with its criterion.

    D and A are of all parameters, the potential terms with their priors among them (nuisance
    parameters in A), I of predictions with all effects (`mixed_design`), E and K of the model's
    parameters without a prior.
    """

    criterion: Criterion  # φ
    units: CandidateSet  # the units by the parameters that φ is of
    prior: Floats  # (P, P) prior information of these
    names: tuple[str, ...]  # of the parameters; none where they are combinations
    apart: DiscriminatedPairs | None = None  # the pairs of "separate"; None of others

    def relaxed(
        self, budget: float, tolerance: float = LOOSE, start: ApproximateDesign | None = None
    ) -> ApproximateDesign:
        """Return the continuous optimum of so many readings; see `approximate_design.relax`."""
        return relax(
            self.units, self.criterion, budget, self.prior, names=self.names,
            tolerance=tolerance, start=start,
        )  # fmt: skip


def canonical(name: str) -> str:
    """Return the name of a criterion: I-optimality was called "test" before."""
    return "I" if name == "test" else name


def objective_of(
    problem: DesignProblem, config: CellConfig, name: str, work: PredictionPoses | None
) -> Objective:
    """Return a design problem with a criterion by its name; "I" needs prediction poses."""
    name = canonical(name)
    names = tuple(t.name for t in problem.terms)
    whole = Objective(D(), problem.units, problem.prior, names)
    if name == "D":
        return whole
    if name == "A":
        return replace(whole, criterion=MeanVariance(problem.mean_variance, "A"))
    if name == "I":
        if work is None:
            raise InputError('criterion "I" needs prediction poses; see [planning] work_q_rad')
        mixed = balanced(mixed_design(problem, config, work))
        return Objective(MeanVariance(mixed.c), mixed.units, mixed.prior, mixed.names)
    if name == "separate":
        apart = discriminated_pairs(problem)
        units, pairs, prior = condensed(problem.units, apart.pairs, apart.prior)
        return Objective(Separate(pairs), units, prior, (), apart)
    if name == "E":
        return replace(whole, criterion=E(unknown(problem)))
    if name == "K":  # of the model alone: more information, also of the others, may make it worse
        free = unknown(problem)
        own = CandidateSet(np.ascontiguousarray(problem.units.rows[:, :, free]), problem.units.cost)
        known = problem.measured[np.ix_(free, free)]
        return Objective(K(), own, known, tuple(names[k] for k in free))
    raise InputError(f"criterion {name!r}; valid: {', '.join(CRITERIA)}")


def unknown(problem: DesignProblem) -> Ints:
    """Return the indices of the model's parameters that have no prior."""
    live = problem.nominal.live
    return np.flatnonzero(np.isinf(problem.nominal.prior_std[live]))


def choose(
    asked: Objective, budget: float, rng: np.random.Generator, effort: int = EFFORT,
    relaxed: ApproximateDesign | None = None,
) -> Design:  # fmt: skip
    """Return the exact design; see `optimum.best`."""
    return best(
        asked.units, asked.criterion, budget, asked.prior, rng, names=asked.names, effort=effort,
        relaxed=relaxed,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class PoseUnits:
    """Candidate poses as units, each with all readings that it bears."""

    units: CandidateSet  # of the poses
    poses: Ints  # (N,) their numbers
    members: tuple[Ints, ...]  # of each, the units of the problem


def pose_units(asked: Objective, problem: DesignProblem) -> PoseUnits:
    """Return the poses of a design problem as units of cost 1."""
    of: dict[int, list[int]] = {}
    for k, (pose, loads) in enumerate(problem.what):
        mine = of.setdefault(pose, [])
        if problem.mode == "deflection" and mine:  # a unit with all loads holds the others
            if len(loads) <= len(problem.what[mine[0]][1]):
                continue
            mine.clear()
        mine.append(k)
    _, height, size = asked.units.rows.shape
    rows = np.zeros((len(of), max(map(len, of.values())) * height, size))
    for out, mine in zip(rows, of.values(), strict=True):
        stacked = asked.units.rows[mine].reshape(-1, size)
        out[: len(stacked)] = stacked
    members = tuple(np.array(mine) for mine in of.values())
    return PoseUnits(CandidateSet(rows, np.ones(len(of))), np.array(list(of)), members)


def choose_poses(
    asked: Objective,
    of: PoseUnits,
    usable: Bools,  # (N,) which poses there are to choose from
    poses: int,
    rng: np.random.Generator,
    effort: int = EFFORT,
    start: ApproximateDesign | None = None,  # the optimum over poses (N,) at an earlier choice
) -> tuple[Ints, ApproximateDesign]:
    """Return how often each unit (K,) is taken, and the optimum over poses (N,).

    So many poses are each read once under all that they bear; where the cell leaves fewer, some are
    read again.
    """
    units = CandidateSet(of.units.rows[usable], of.units.cost[usable])
    found = best(
        units, asked.criterion, float(poses), asked.prior, rng,
        most=-(-poses // max(len(units), 1)), names=asked.names, effort=effort,
        relaxed=None if start is None else start.among(usable),
    )  # fmt: skip
    counts = np.zeros(len(asked.units), dtype=np.int64)
    index = np.flatnonzero(usable)
    for k, count in zip(index, found.counts.tolist(), strict=True):
        counts[of.members[k]] = count
    price = np.zeros(len(usable))
    price[usable] = found.relaxed.price
    return counts, replace(found.relaxed, index=index[found.relaxed.index], price=price)


def certified(
    asked: Objective, counts: Ints, usable: Bools, start: ApproximateDesign | None = None
) -> Design:
    """Return the design of (K,) counts among usable units, with a bound of as many readings.

    The bound holds for any number of poses, under any loads.
    """
    free, taken = only(asked, usable), counts[usable]
    cost = float(taken @ free.units.cost)
    information = asked.prior + free.units.information(taken.astype(float))
    value = float(asked.criterion.value(information))
    relaxed = free.relaxed(cost, start=None if start is None else start.among(usable))
    return Design(taken, value, max(relaxed.bound, value), information, cost, relaxed)


def promising(asked: Objective, budget: float) -> tuple[Ints, ApproximateDesign]:
    """Return the units that a plan is likely to be made of, those of the best prices, and why."""
    tolerance = min(KINKED_TOLERANCE, LOOSE) if asked.criterion.kinked else LOOSE
    found = asked.relaxed(budget, tolerance)
    count = min(2 * len(found.index), len(asked.units))
    best_first = np.argsort(-found.price / asked.units.cost, kind="stable")
    return np.union1d(found.index, best_first[:count]), found


def costly_loads(
    asked: Objective, problem: DesignProblem, budget: float, change: float, rng: np.random.Generator
) -> tuple[tuple[str, float], ...]:
    """Return loads without which the same time buys more, with the gain as a share of φ.

    Hanging a load costs as much time as `change` readings; a plan without it takes these instead.
    Compared are the continuous optima over some of the poses, one load after the other.
    """
    poses = np.array([pose for pose, _ in problem.what])
    few = rng.permutation(len(problem.candidates))[:SAMPLE]
    sample = np.isin(poses, few)
    used = {name for _, names in problem.what for name in names}
    keep = tuple(name for name in problem.candidates.loads[1:] if name in used)
    costly: list[tuple[str, float]] = []
    if len(keep) < 2 or change <= 0:
        return ()
    now = _value(asked, problem, sample, keep, budget)
    while len(keep) > 1 and now > 0:
        tried = [
            (_value(asked, problem, sample, tuple(k for k in keep if k != name), budget + change),
             name)
            for name in keep
        ]  # fmt: skip
        value, name = max(tried)
        if not value > now * (1.0 + LOOSE):
            break
        costly.append((name, value / now - 1.0))
        keep, now, budget = tuple(k for k in keep if k != name), value, budget + change
    return tuple(costly)


def only(asked: Objective, wanted: Bools) -> Objective:
    """Return the question with some of the units."""
    return replace(asked, units=CandidateSet(asked.units.rows[wanted], asked.units.cost[wanted]))


def _value(
    asked: Objective, problem: DesignProblem, sample: Bools, loads: tuple[str, ...], budget: float
) -> float:
    """φ of the continuous optimum; 0 where these loads do not determine everything."""
    allowed = {*loads, problem.candidates.loads[0]}
    some = only(asked, sample & np.array([set(names) <= allowed for _, names in problem.what]))
    try:
        return some.relaxed(budget).value
    except (CannotAnswerError, InputError):
        return 0.0


def compound_objective(
    problem: DesignProblem,
    config: CellConfig,
    name: str,
    work: PredictionPoses | None,  # the prediction poses, for "I"
    budget: float,  # readings, for which the two optima of A are found
    rng: np.random.Generator,  # generator; they are found among some of the poses
) -> Objective:
    """Return a design problem with a criterion; D and A are compound with potential terms."""
    name = canonical(name)
    asked, size = objective_of(problem, config, name, work), problem.model_size
    if size == len(problem.terms) or name not in ("A", "D"):
        return asked
    if name == "D":
        return replace(asked, criterion=D(size))
    c = problem.mean_variance
    whole, own = MeanVariance(c, name), MeanVariance(c[:size, :size], name)
    poses = np.array([pose for pose, _ in problem.what])
    some = only(asked, np.isin(poses, rng.permutation(len(problem.candidates))[:SAMPLE]))
    units = CandidateSet(some.units.rows[:, :, :size], some.units.cost)
    alone = Objective(own, units, asked.prior[:size, :size], asked.names[:size])
    a, b = (q.relaxed(budget).value / 2.0 for q in (replace(some, criterion=whole), alone))
    return replace(asked, criterion=MeanVariance(a * c, name, b * c[:size, :size]))
