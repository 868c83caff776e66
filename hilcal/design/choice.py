"""The objective of a plan by the name of its criterion, and the choice of units and of loads.

A plan for the model and the potential terms together is less efficient for the model alone. The
compound criteria D and A are means over both: D of the logarithms of the two determinants, A of the
two mean variances, each over its least value,

    φ = det(M)^(1/2P) · det(M_ss)^(1/2s)          1/φ = ½ q(M)/q* + ½ q(M_ss)/q_s*

with q(M) = tr(C M⁻¹), the first s of P parameters those of the model, and q* and q_s* the minima
of both. Source: Atkinson, Donev and Tobias, *Optimum Experimental Designs, with SAS* (2007),
chapter 21.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from hilcal.config import CellConfig
from hilcal.design.approximate_design import KINKED_TOLERANCE, ApproximateDesign, relax
from hilcal.design.criteria import D, E, K, MeanVariance, Separate, condensed
from hilcal.design.criterion import (
    CandidateSet,
    DiscriminatedPairs,
    Objective,
    Pair,
    inverse_factor,
)
from hilcal.design.information import DesignProblem, information_of, reading_derivatives, unit_rows
from hilcal.design.nominal_model import NominalModel, build_effect, expected_std, potential_names
from hilcal.design.optimum import Design, best_design
from hilcal.design.predicted import PredictionPoses, position_derivative
from hilcal.effects.protocol import Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.linearisation import Linearisation, computable, effect_columns, linearise
from hilcal.identification.mixed_fit import HARMONICS, SCATTER_RAD
from hilcal.regression.evidence import family_power
from hilcal.regression.schur import schur_complement
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

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


DIRECTIONS = 150  # in Q at most; a choice: of a real UR10 (920) the others move 0.5 σ (rms)
DIRECTION_SAMPLE = 300  # candidate poses that determine Q; a choice
LEAST = 1e-3  # least motion of the units by a direction of Q, RMS, over the noise


def mixed_design(problem: DesignProblem, config: CellConfig, work: PredictionPoses) -> Objective:
    """Return the objective of the mean variance of predictions with all effects: I-optimality.

        y = A b + Z u + e,    (b, u) with prior information M = [F G; Gᵀ H],    e ~ N(0, 1)

    A, Z are the whitened rows of a unit. b are the parameters without a prior; u are those with a
    prior, of the model and of every other effect of the catalogue. The size of a family is the one
    usual for arms (`Effect.log_std_prior`) or the estimate of the readings so far. With

        A' = A − Z H⁻¹ Gᵀ,    v = H^½ (u + H⁻¹ Gᵀ b) ~ N(0, 1),    b with information F − G H⁻¹ Gᵀ

    b and v are independent. The directions Q of v that move the units most are retained; the others
    act as noise, independent between units:

        rows [A', Z H^−½ Q] whitened by 1 + T Tᵀ,    T = Z H^−½ (1 − Q Qᵀ)

    The criterion is 1 / tr(C M⁻¹), C the mean of VᵀV, V the derivative of predicted positions by
    the coordinates (b, Qᵀ v). Its `rest` is the mean variance of predictions by the other
    directions, of which nothing is learnt. Source: Chaloner and Verdinelli, *Bayesian experimental
    design: a review*, Statistical Science 10 (1995) 273-304.
    """
    nominal = problem.nominal
    if not np.any(config.repeatability.per_joint(nominal.cell.arm.n)):  # not stated
        config = _with_scatter(nominal, config)
    effects, std = other_effects(nominal, config)
    prior_std = nominal.prior_std[nominal.live]
    flat = np.concatenate([np.isinf(prior_std), np.zeros(len(std), dtype=bool)])
    model_scale = np.where(np.isinf(prior_std), problem.scale[: len(prior_std)], prior_std)
    scale = np.concatenate([model_scale, std])
    information = information_of(nominal, effects, scale) + np.diag(~flat)

    def all_rows(step: int = 1) -> Iterator[tuple[Ints, Floats]]:
        """Yield rows of the units of every `step`-th pose, with the columns of all effects."""
        poses = problem.candidates[slice(None, None, step)]
        parts = reading_derivatives(nominal, config, poses, effects, scale)
        return unit_rows(parts, problem.candidates.loads, problem.contents, problem.mode, step)

    sample = all_rows(max(1, len(problem.candidates) // DIRECTION_SAMPLE))
    coordinates = _coordinates(information, flat, sample)
    count = int(flat.sum()) + coordinates.random.shape[1]
    rows = np.zeros((*problem.units.rows.shape[:2], count))
    for members, part in all_rows():
        rows[members, : part.shape[1]] = coordinates.whitened(part)
    moved = position_derivative(nominal, work, effects, scale)
    v = coordinates.columns(moved).reshape(-1, count)
    prior = np.eye(count)
    prior[: coordinates.flat.shape[1], : coordinates.flat.shape[1]] = coordinates.prior
    names = [t.name for t, free in zip(problem.terms, flat, strict=False) if free]
    names += [f"direction {k}" for k in range(1, coordinates.random.shape[1] + 1)]
    c = v.T @ v / len(work.q)
    every, retained = (np.sum((moved @ r) ** 2) for r in (coordinates.root, coordinates.random))
    rest = float(max(every - retained, 0.0)) / len(work.q)
    units = CandidateSet(rows, problem.units.cost)
    return Objective(units, MeanVariance(c, rest=rest), prior, tuple(names))


def balanced(design: Objective) -> Objective:
    """Return an objective in coordinates in which the information of all units is the identity.

    tr(C M⁻¹) does not depend on coordinates. After a fit, some directions are known 10⁶ times as
    well as others, and rounding would decide. An objective that leaves a coordinate undetermined is
    returned unchanged, with its names.
    """
    units, criterion = design.units, design.criterion
    assert isinstance(criterion, MeanVariance)  # noqa: S101  (of `mixed_design`)
    total = design.information(np.full(len(units), 1.0 / len(units)))
    size = np.sqrt(np.diag(total))
    if not np.all(size > 0):
        return design
    inverted = inverse_factor(total / np.outer(size, size))
    if inverted is None:
        return design
    turn = np.linalg.cholesky(inverted[0] @ inverted[0].T) / size[:, None]
    turned = CandidateSet(units.rows @ turn, units.cost)
    names = tuple(f"direction {k}" for k in range(1, len(size) + 1))
    prior, c = (turn.T @ m @ turn for m in (design.prior, criterion.c))
    turned_c = replace(criterion, c=0.5 * (c + c.T))
    return Objective(turned, turned_c, 0.5 * (prior + prior.T), names)


def other_effects(nominal: NominalModel, config: CellConfig) -> tuple[tuple[Effect, ...], Floats]:
    """Return the effects of `[planning] against`, and standard deviations of their parameters, SI.

    No effects if the fit has a background, which includes them.
    """
    model, catalogue = nominal.model, nominal.model.catalogue
    names = () if model.background else potential_names(config, model)
    periodic = [name for name in names if "harmonics" in catalogue[name].option_help]
    finest = {name: {"harmonics": HARMONICS} for name in periodic}
    cell, m = nominal.cell, nominal.m
    effects = tuple(build_effect(catalogue, name, cell, m, finest.get(name, {})) for name in names)
    return effects, expected_std(model, effects)


def _with_scatter(nominal: NominalModel, config: CellConfig) -> CellConfig:
    """Return the configuration with the arm's repeatability: estimated or ordinary."""
    std: tuple[float, ...] = (SCATTER_RAD,)
    scatter = None if nominal.fit is None else nominal.fit.readings.arm_scatter
    if scatter is not None and scatter.kind != "isotropic":
        std = scatter.std
    per_joint = std if len(std) > 1 else std[0]
    return config.with_keys("repeatability", joint_std_rad=per_joint)


@dataclass(frozen=True, slots=True, eq=False)
class _Coordinates:
    """The change of coordinates."""

    flat: Floats  # (P, b) columns of A' in terms of all columns
    random: Floats  # (P, r) columns Z H^−½ Q
    root: Floats  # (P, u) columns Z H^−½
    prior: Floats  # (b, b) F − G H⁻¹ Gᵀ

    def columns(self, rows: Floats) -> Floats:
        return np.concatenate([rows @ self.flat, rows @ self.random], axis=-1)

    def whitened(self, rows: Floats) -> Floats:
        """Return (k, R, b + r) of units (k, R, P), with the directions outside of Q as noise."""
        full, retained = rows @ self.root, rows @ self.random
        noise = full @ np.swapaxes(full, 1, 2) - retained @ np.swapaxes(retained, 1, 2)
        noise += np.eye(rows.shape[1])
        both = np.concatenate([rows @ self.flat, retained], axis=-1)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(noise), both))


def _coordinates(
    information: Floats, flat: Bools, sample: Iterable[tuple[Ints, Floats]]
) -> _Coordinates:
    """Complete the square, and find the directions Q that move the units most."""
    size, free = len(information), np.flatnonzero(flat)
    random = np.flatnonzero(~flat)
    g = information[np.ix_(free, random)]
    factor = cho_factor(information[np.ix_(random, random)], lower=True)
    lifted = cho_solve(factor, g.T)
    columns = np.zeros((size, len(free)))
    columns[free, np.arange(len(free))] = 1.0
    columns[random] = -lifted
    root = np.zeros((size, len(random)))
    root[random] = solve_triangular(factor[0], np.eye(len(random)), lower=True).T
    gram, elements = np.zeros((len(random), len(random))), 0
    for _, rows in sample:
        moved = rows @ root
        gram += np.einsum("kri,krj->ij", moved, moved, optimize=True)
        elements += moved.shape[0] * moved.shape[1]
    values, vectors = np.linalg.eigh(gram / max(elements, 1))
    retained = np.flatnonzero(values > LEAST**2)[-DIRECTIONS:]
    prior = information[np.ix_(free, free)] - g @ lifted
    return _Coordinates(columns, root @ vectors[:, retained], root, (prior + prior.T) / 2)


LEVEL = 0.01  # of the test
DRAWS = 3
# a pair is not separable if the best plan of MANY readings has a lower power; both are guesses
MANY_READINGS = 100
LEAST_POWER = 0.2
_LOOSE = 0.05
_SEED = 20240609
SUPPORTED = 3.0  # log evidence above which readings support an effect: odds of e³, 20 : 1


def discriminated_pairs(problem: DesignProblem) -> DiscriminatedPairs:
    """Return the ordered pairs of potential terms that some measurement separates.

    An effect e with parameters β is present; the model and a rival f are fitted. The statistic of
    the test of e beyond both follows a noncentral χ² of non-centrality

        λ = βᵀ S β,   S = M_ee − M_en M_nn⁻ M_ne,   n: the model and f

    whose degrees of freedom are the number of visible directions of S (`regression.evidence`). At
    the readings so far, S is that of a diagnosis that tests e with f in the model.

    A pair is not separable where the best plan of `MANY_READINGS` readings, with the prior
    information, has a power below `LEAST_POWER` at the effect's first parameters. Parameters are
    drawn from the posterior of supported effects. For other effects, a few directions are drawn
    with a fixed seed, each with an RMS of 1 σ over the measured elements of all units.
    """
    names = tuple(e.name for e in problem.families)
    if len(names) < 2:
        raise InputError(f"{len(names)} effects to tell apart; valid: two or more")
    supported = supported_parameters(problem, DRAWS)
    pairs: list[Pair] = []
    for e in names:
        betas = _directions(problem, e)
        if e in supported:
            betas = [x / problem.scale[problem.of_effect(e)] for x in supported[e]]
        pairs += [pair_of(problem, (e, f), beta) for f in names if f != e for beta in betas]
    prior, size = problem.measured.copy(), problem.model_size
    prior[:size, :size] = problem.prior[:size, :size]
    spread = prior + problem.units.information(
        np.full(len(problem.units), MANY_READINGS / float(problem.units.cost.sum()))
    )
    not_separable = []
    for of_both, alike in groupby(pairs, key=lambda pair: pair.names):
        first = next(alike)
        best = power(first, spread)
        if best < LEAST_POWER:
            with suppress(CannotAnswerError):
                alone = Objective(problem.units, Separate((first,)), prior)
                best = power(first, relax(alone, MANY_READINGS, tolerance=_LOOSE).information)
        if best < LEAST_POWER:
            not_separable.append(of_both)
    separable = tuple(pair for pair in pairs if pair.names not in not_separable)
    if not separable:
        raise CannotAnswerError(not_separable_message(not_separable))
    return DiscriminatedPairs(separable, prior, tuple(not_separable))


def pair_of(problem: DesignProblem, names: tuple[str, str], beta: Floats) -> Pair:
    """Return the pair of an effect with parameters β, over the problem's scales, and a rival."""
    effect, rival = names
    nuisance = np.concatenate([np.arange(problem.model_size), problem.of_effect(rival)])
    return Pair(problem.of_effect(effect), beta, nuisance, names)


def supported_parameters(problem: DesignProblem, count: int) -> dict[str, Floats]:
    """Return (count, E) parameters, SI, of the families that the readings so far support."""
    fit = problem.nominal.fit
    if fit is None:
        return {}
    linear = linearise(fit)
    drawn = {family.name: posterior_draws(linear, family, count) for family in problem.families}
    return {name: betas for name, betas in drawn.items() if betas is not None}


def posterior_draws(linear: Linearisation, effect: Effect, count: int) -> Floats | None:
    """Return (count, P) parameters, SI, of an effect that is added to a gc-scaled fit.

    The mean of the posterior, then draws from it, to first order, at the prior strength of highest
    evidence, as a diagnosis scores it; None where the readings do not support the effect
    (`SUPPORTED`).
    """
    if not computable(linear.fit, effect):
        return None
    columns = effect_columns(linear.fit, effect)
    score = linear.score(columns.white, largest=effect.most())
    if not score.rank or score.log_evidence <= SUPPORTED:
        return None
    mean, root = columns.scale * score.step, columns.scale[:, None] * score.root
    drawn = np.random.default_rng(_SEED).standard_normal((count, len(mean)))
    drawn[0] = 0.0
    return np.asarray(mean + drawn @ root.T)


def _by_effect(pairs: Sequence[tuple[str, str]]) -> dict[str, str]:
    return {e: " or ".join(f for x, f in pairs if x == e) for e, _ in pairs}


def not_separable_message(pairs: Sequence[tuple[str, str]]) -> str:
    """Return a message that names the pairs that no measurement separates."""
    unordered = [pair for k, pair in enumerate(pairs) if pair[::-1] not in pairs[:k]]
    listed = [f"{e} from {fs}" for e, fs in _by_effect(unordered).items()]
    return f"no measurement in this cell separates {', nor '.join(listed)}"


def not_ruled_out(pairs: Sequence[tuple[str, str]]) -> str:
    """Return a message on pairs (present effect, rival) whose rival cannot be ruled out."""
    listed = [f"{fs} if {e} is present" for e, fs in _by_effect(pairs).items()]
    return (
        f"no measurement in this cell rules out {', nor '.join(listed)}: the best "
        f"{MANY_READINGS} readings would do so with a probability below {100 * LEAST_POWER:.0f} %"
    )


def power(pair: Pair, information: Floats) -> float:
    """Return the power of the test of a pair at the information (P, P) of a plan and the prior."""
    s = schur_complement(information, pair.effect, pair.nuisance)
    return family_power(s, pair.beta, LEVEL)


def _directions(problem: DesignProblem, effect: str) -> list[Floats]:
    """Return directions (E,) of an effect with an RMS of 1 σ over all measured elements."""
    columns = problem.of_effect(effect)
    rows = problem.units.rows[:, :, columns]
    elements = problem.nominal.elements * sum(
        len([name for name in loads if name != UNLOADED or problem.mode == "absolute"])
        for _, loads in problem.contents
    )
    flat = rows.reshape(-1, len(columns))
    gram = flat.T @ flat / elements
    drawn = np.random.default_rng(_SEED).standard_normal((DRAWS, len(columns)))
    return [d / np.sqrt(float(d @ gram @ d)) for d in drawn]
