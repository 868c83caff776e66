"""Which effects a campaign is to tell apart, and with what power it would.

An effect e with the parameters β is there; the model and a rival f are fitted. What they cannot
explain adds

    λ = βᵀ S β,   S = M_ee − M_en M_nn⁻¹ M_ne,   n: the model and f

to the whitened sum of squares: the test of e beyond them follows a noncentral χ² of
non-centrality λ, with as many degrees of freedom as e has directions that can be seen.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from hilcal.data.plan import UNLOADED
from hilcal.errors import CannotAnswerError, InputError
from hilcal.plan.approximate_design import relax
from hilcal.plan.information import Problem
from hilcal.plan.suspects import estimate
from hilcal.plan.t_optimality import Pair, Separate
from hilcal.types import Floats

LEVEL = 0.01
"""Chance of a false alarm of the test."""
VISIBLE = 1e-4
"""Eigenvalue of S, in the scales of the problem, from which a direction counts as seen."""
DRAWS = 3
MANY = 100
"""Readings by which a pair is called hopeless ..."""
LEAST_POWER = 0.2
"""... where the best of so many do not tell it with this power."""
_LOOSE = 0.05
_SEED = 20240609


@dataclass(frozen=True, slots=True, eq=False)
class Rivals:
    """What is to be told apart.

    Attributes:
        pairs: as the criterion takes them.
        names: (effect that is there, rival that is fitted) of each pair.
        prior: (P, P) what is known before, without the priors of potential terms: neither must
            an effect be found by what was supposed of it, nor a rival be held small.
        hopeless: names of the pairs that no measurement separates; they are left out.
    """

    pairs: tuple[Pair, ...]
    names: tuple[tuple[str, str], ...]
    prior: Floats
    hopeless: tuple[tuple[str, str], ...] = ()


def rivals(
    problem: Problem,
    suspects: Sequence[str] | None = None,
    fitted: Mapping[str, Floats] | None = None,
) -> Rivals:
    """Return the pairs of suspects, both ways round, that some measurement separates.

    None does where the best of all plans of `MANY` readings, with what is known already, has a
    power below `LEAST_POWER`: for the first of the parameters of the effect that is there.

    Args:
        problem: with all suspects among its potential terms.
        suspects: at least two effects; all families of the problem by default.
        fitted: parameters (D, E) of suspects, SI: D that could be; one vector (E,) will do. By
            default those that the readings so far speak for, see `estimated`. Of the others a
            few directions are drawn (always the same), each of an RMS strength of 1 σ of a
            measured element over all units.

    Raises:
        InputError: fewer than two suspects, or one that is not among the potential terms.
        CannotAnswerError: no pair can be separated.
    """
    known = tuple(e.name for e in problem.families)
    names = known if suspects is None else tuple(dict.fromkeys(suspects))
    for name in names:
        if name not in known:
            valid = ", ".join(known) or "none"
            raise InputError(f"{name} is not among the potential terms; valid: {valid}")
    if len(names) < 2:
        raise InputError(f"{len(names)} effects to tell apart; valid: two or more")
    given = dict(estimated(problem, DRAWS) if fitted is None else fitted)
    model = np.arange(problem.model_size)
    pairs, both = [], []
    for e in names:
        where = problem.of_effect(e)
        strengths = _strengths(problem, e)
        if e in given:
            strengths = [x / problem.scale[where] for x in np.atleast_2d(given[e])]
        for f in names:
            if f != e:
                nuisance = np.concatenate([model, problem.of_effect(f)])
                pairs += [Pair(where, beta, nuisance, f"{e} from {f}") for beta in strengths]
                both += [(e, f)] * len(strengths)
    prior, size = problem.measured.copy(), problem.model_size
    prior[:size, :size] = problem.prior[:size, :size]
    return _feasible(problem, Rivals(tuple(pairs), tuple(both), prior))


def estimated(problem: Problem, count: int) -> dict[str, Floats]:
    """Return (count, E) parameters of the families that the readings so far speak for, SI.

    Draws from what is known of them, the estimate first; see `suspects`.
    """
    fit, out = problem.assumed.fit, {}
    if fit is None:
        return {}
    for family in problem.families:
        found = estimate(fit, family)
        if found is not None and found.told:
            out[family.name] = found.draws(count, np.random.default_rng(_SEED))
    return out


def _feasible(problem: Problem, of: Rivals) -> Rivals:
    """Leave out the pairs that no measurement separates."""
    spread = of.prior + problem.units.information(
        np.full(len(problem.units), MANY / float(problem.units.cost.sum()))
    )
    hopeless = []
    for names in dict.fromkeys(of.names):
        pair = of.pairs[of.names.index(names)]
        if power(pair, spread) < LEAST_POWER and _best_power(problem, of, pair) < LEAST_POWER:
            hopeless.append(names)
    keep = [k for k, names in enumerate(of.names) if names not in hopeless]
    if not keep:
        raise CannotAnswerError(never(hopeless))
    pairs, both = tuple(of.pairs[k] for k in keep), tuple(of.names[k] for k in keep)
    return Rivals(pairs, both, of.prior, tuple(hopeless))


def never(hopeless: Sequence[tuple[str, str]]) -> str:
    """Say in words which pairs no measurement separates."""
    told: dict[str, list[str]] = {}
    for e, f in hopeless:
        if e not in told.get(f, ()):
            told.setdefault(e, []).append(f)
    said = [f"{e} from {' or '.join(fs)}" for e, fs in told.items()]
    return f"no measurement in this cell separates {', nor '.join(said)}"


def _best_power(problem: Problem, of: Rivals, pair: Pair) -> float:
    """Power of the best plan of `MANY` readings for one pair."""
    try:
        found = relax(problem.units, Separate((pair,)), MANY, of.prior, tolerance=_LOOSE)
    except CannotAnswerError:
        return LEVEL
    return power(pair, found.information)


def power(pair: Pair, information: Floats) -> float:
    """Return the chance that the test at 1 % finds the effect beyond model and rival.

    Args:
        pair: the effect, and what is fitted.
        information: (P, P) of a plan, with `Rivals.prior`.
    """
    e, n = pair.effect, pair.nuisance
    solver = pair.best(information)[1][np.ix_(n, n)]
    cross = information[np.ix_(n, e)]
    left = information[np.ix_(e, e)] - cross.T @ solver @ cross
    values, vectors = np.linalg.eigh((left + left.T) / 2)
    seen = values > max(VISIBLE, 1e-10 * float(values.max(initial=0.0)))
    dof = int(seen.sum())
    if dof == 0:
        return LEVEL
    noncentrality = float(np.sum(values[seen] * (vectors[:, seen].T @ pair.beta) ** 2))
    return float(stats.ncx2.sf(stats.chi2.isf(LEVEL, dof), dof, noncentrality))


def powers(of: Rivals, information: Floats) -> dict[tuple[str, str], float]:
    """Return the least power over the directions of each pair of effects."""
    out: dict[tuple[str, str], float] = {}
    for names, pair in zip(of.names, of.pairs, strict=True):
        out[names] = min(out.get(names, 1.0), power(pair, information))
    return out


def _strengths(problem: Problem, effect: str) -> list[Floats]:
    """Directions (E,) of an effect whose RMS over all measured elements is 1 σ."""
    where = problem.of_effect(effect)
    rows = problem.units.rows[:, :, where]
    elements = problem.assumed.m * sum(
        len([name for name in loads if name != UNLOADED or problem.mode == "absolute"])
        for _, loads in problem.what
    )
    flat = rows.reshape(-1, len(where))
    gram = flat.T @ flat / elements
    rng = np.random.default_rng(_SEED)
    drawn = rng.standard_normal((DRAWS, len(where)))
    return [d / np.sqrt(float(d @ gram @ d)) for d in drawn]
