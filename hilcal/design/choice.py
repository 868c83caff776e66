"""Criteria by name, and the choice of units and of the loads that are worth a change of load.

A plan for the model and the potential terms together is less efficient for the model alone. The
compound criteria D and A are means over both: D of the logarithms of the two determinants, A of the
two mean variances, each over its least value,

    φ = det(M)^(1/2P) · det(M_ss)^(1/2s)          1/φ = ½ q(M)/q* + ½ q(M_ss)/q_s*

with q(M) = tr(C M⁻¹), the first s of P parameters those of the model, and q* and q_s* the minima
of both. Source: Atkinson, Donev and Tobias, *Optimum Experimental Designs, with SAS* (2007),
chapter 21.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.approximate_design import KINKED_TOLERANCE, ApproximateDesign, relax
from hilcal.design.criteria import D, E, K, MeanVariance, Separate, condensed
from hilcal.design.criterion import CandidateSet, Objective
from hilcal.design.discriminated_pairs import discriminated_pairs
from hilcal.design.information import DesignProblem
from hilcal.design.mixed_design import balanced, mixed_design
from hilcal.design.optimum import Design, best_design
from hilcal.design.predicted import PredictionPoses
from hilcal.errors import CannotAnswerError, InputError
from hilcal.types import Bools, Ints

CRITERIA = ("D", "A", "E", "K", "I", "separate")
COARSE_GAP = 1e-2  # relative duality gap, for a plan's bound and for comparing loads; a choice
EFFORT = 200  # of the exchange search: 98 % of the bound of the demo's plan in a second
SAMPLE = 75  # poses at which sets of loads are compared; a choice


def criterion_name(name: str) -> str:
    """Return the name of a criterion; "test" is an old name of I."""
    return "I" if name == "test" else name


def objective_of(
    problem: DesignProblem, config: CellConfig, name: str, work: PredictionPoses | None
) -> Objective:
    """Return the objective of a design problem by a criterion's name; "I" needs prediction poses.

    D and A judge all parameters, including the potential terms with their priors (nuisance
    parameters in A); I judges predictions with all effects (`mixed_design`); E and K judge the
    model's parameters without a prior.
    """
    name = criterion_name(name)
    names = tuple(t.name for t in problem.terms)
    of_all = Objective(problem.units, D(), problem.prior, names)
    if name == "D":
        return of_all
    if name == "A":
        return replace(of_all, criterion=MeanVariance(problem.mean_variance, "A"))
    if name == "I":
        if work is None:
            raise InputError('criterion "I" needs prediction poses; see [planning] work_q_rad')
        return balanced(mixed_design(problem, config, work))
    if name == "separate":
        discriminated = discriminated_pairs(problem)
        units, pairs, prior = condensed(problem.units, discriminated.pairs, discriminated.prior)
        return Objective(units, Separate(pairs), prior, discriminated_pairs=discriminated)
    if name == "E":
        return replace(of_all, criterion=E(without_prior(problem)))
    if name == "K":  # of the model alone: information on other parameters may lower it
        free = without_prior(problem)
        rows, prior = problem.units.rows[:, :, free], problem.measured[np.ix_(free, free)]
        units = CandidateSet(np.ascontiguousarray(rows), problem.units.cost)
        return Objective(units, K(), prior, tuple(names[k] for k in free))
    raise InputError(f"criterion {name!r}; valid: {', '.join(CRITERIA)}")


def without_prior(problem: DesignProblem) -> Ints:
    """Return the indices of the model's parameters that have no prior."""
    return np.flatnonzero(np.isinf(problem.nominal.prior_std[problem.nominal.live]))


@dataclass(frozen=True, slots=True, eq=False)
class PoseUnits:
    """Candidate poses as units, each with all its readings."""

    units: CandidateSet  # of the poses
    poses: Ints  # (N,) numbers of the poses
    members: tuple[Ints, ...]  # per pose, indices of the problem's units


def pose_units(objective: Objective, problem: DesignProblem) -> PoseUnits:
    """Return the poses of a design problem as units of cost 1."""
    by_pose: dict[int, list[int]] = {}
    for k, (pose, loads) in enumerate(problem.contents):
        members = by_pose.setdefault(pose, [])
        if problem.mode == "deflection" and members:  # the unit with all loads includes the others
            if len(loads) <= len(problem.contents[members[0]][1]):
                continue
            members.clear()
        members.append(k)
    _, height, size = objective.units.rows.shape
    rows = np.zeros((len(by_pose), max(map(len, by_pose.values())) * height, size))
    for out, members in zip(rows, by_pose.values(), strict=True):
        stacked = objective.units.rows[members].reshape(-1, size)
        out[: len(stacked)] = stacked
    units = CandidateSet(rows, np.ones(len(by_pose)))
    return PoseUnits(units, np.array(list(by_pose)), tuple(map(np.array, by_pose.values())))


def choose_poses(
    objective: Objective,
    candidates: PoseUnits,
    usable: Bools,  # (N,) poses to choose from
    poses: int,
    rng: np.random.Generator,
    effort: int = EFFORT,
    start: ApproximateDesign | None = None,  # optimum over poses (N,) of the previous choice
) -> tuple[Ints, ApproximateDesign]:
    """Return the count of each unit (K,), and the optimum over poses (N,).

    Each of `poses` poses is read once under all its loads; where fewer are usable, some are read
    again.
    """
    among = replace(objective, units=candidates.units[usable])
    most = -(-poses // max(len(among.units), 1))
    relaxed = None if start is None else start.among(usable)
    design = best_design(among, float(poses), rng, max_count=most, effort=effort, relaxed=relaxed)
    counts = np.zeros(len(objective.units), dtype=np.int64)
    index = np.flatnonzero(usable)
    for k, count in zip(index, design.counts.tolist(), strict=True):
        counts[candidates.members[k]] = count
    price = np.zeros(len(usable))
    price[usable] = design.relaxed.price
    return counts, replace(design.relaxed, index=index[design.relaxed.index], price=price)


def certified_design(
    objective: Objective, counts: Ints, usable: Bools, start: ApproximateDesign | None = None
) -> Design:
    """Return the design of (K,) counts among usable units, with the bound for its cost.

    The bound holds for any number of poses and any loads.
    """
    among, chosen = objective.among(usable), counts[usable]
    cost = float(chosen @ among.units.cost)
    information = among.information(chosen.astype(float))
    value = float(objective.criterion.value(information))
    near = None if start is None else start.among(usable)
    relaxed = relax(among, cost, tolerance=COARSE_GAP, start=near)
    return Design(chosen, value, max(relaxed.bound, value), information, cost, relaxed)


def promising_units(objective: Objective, budget: float) -> tuple[Ints, ApproximateDesign]:
    """Return the units of the best prices, of which a plan is likely made, and the optimum."""
    tolerance = KINKED_TOLERANCE if objective.criterion.kinked else COARSE_GAP
    relaxed = relax(objective, budget, tolerance=tolerance)
    count = min(2 * len(relaxed.index), len(objective.units))
    best_first = np.argsort(-relaxed.price / objective.units.cost, kind="stable")
    return np.union1d(relaxed.index, best_first[:count]), relaxed


def costly_loads(
    objective: Objective, problem: DesignProblem, budget: float, change: float,
    rng: np.random.Generator,
) -> tuple[tuple[str, float], ...]:  # fmt: skip
    """Return the loads whose omission raises φ at the same time spent, with the relative gain.

    Hanging a load costs as much time as `change` readings; a plan without the load takes these
    readings instead. The continuous optima over a sample of the poses are compared, one load after
    the other.
    """
    poses = np.array([pose for pose, _ in problem.contents])
    sample = np.isin(poses, rng.permutation(len(problem.candidates))[:SAMPLE])
    used = {name for _, names in problem.contents for name in names}
    loads = tuple(name for name in problem.candidates.loads[1:] if name in used)
    costly: list[tuple[str, float]] = []
    if len(loads) < 2 or change <= 0:
        return ()
    current = _value(objective, problem, sample, loads, budget)
    while len(loads) > 1 and current > 0:
        budget += change
        without = {name: tuple(load for load in loads if load != name) for name in loads}
        values = {n: _value(objective, problem, sample, o, budget) for n, o in without.items()}
        value, name = max((value, name) for name, value in values.items())
        if not value > current * (1.0 + COARSE_GAP):
            break
        costly.append((name, value / current - 1.0))
        loads, current = without[name], value
    return tuple(costly)


def _value(
    objective: Objective, problem: DesignProblem, sample: Bools, loads: tuple[str, ...],
    budget: float,
) -> float:  # fmt: skip
    """Return φ of the continuous optimum; 0 where the loads do not determine all parameters."""
    allowed = {*loads, problem.candidates.loads[0]}
    possible = np.array([set(names) <= allowed for _, names in problem.contents])
    try:
        return relax(objective.among(sample & possible), budget, tolerance=COARSE_GAP).value
    except (CannotAnswerError, InputError):
        return 0.0


def compound_objective(
    problem: DesignProblem,
    config: CellConfig,
    name: str,
    work: PredictionPoses | None,  # the prediction poses, for "I"
    budget: float,  # readings of the two optima of A
    rng: np.random.Generator,  # draws the poses of these optima
) -> Objective:
    """Return a design problem with a criterion; D and A are compound with potential terms."""
    objective, size = objective_of(problem, config, name, work), problem.model_size
    if size == len(problem.terms) or name not in ("A", "D"):
        return objective
    if name == "D":
        return replace(objective, criterion=D(size))
    c = problem.mean_variance
    of_all, of_model = MeanVariance(c, name), MeanVariance(c[:size, :size], name)
    poses = np.array([pose for pose, _ in problem.contents])
    sampled = objective.among(np.isin(poses, rng.permutation(len(problem.candidates))[:SAMPLE]))
    units = CandidateSet(sampled.units.rows[:, :, :size], sampled.units.cost)
    names = tuple(t.name for t in problem.terms[:size])
    model_alone = Objective(units, of_model, objective.prior[:size, :size], names)
    both = replace(sampled, criterion=of_all), model_alone
    total, alone = (relax(q, budget, tolerance=COARSE_GAP).value / 2.0 for q in both)
    return replace(objective, criterion=MeanVariance(total * c, name, alone * c[:size, :size]))
