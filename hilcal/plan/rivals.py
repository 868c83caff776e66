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
from hilcal.errors import InputError
from hilcal.plan.information import Problem
from hilcal.plan.separation import Pair
from hilcal.types import Floats

LEVEL = 0.01
"""Chance of a false alarm of the test."""
VISIBLE = 1e-4
"""Eigenvalue of S, in the scales of the problem, from which a direction counts as seen."""
DRAWS = 3
_SEED = 20240609


@dataclass(frozen=True, slots=True, eq=False)
class Rivals:
    """What is to be told apart.

    Attributes:
        pairs: as the criterion takes them.
        names: (effect that is there, rival that is fitted) of each pair.
        prior: (P, P) what is known before, without the priors of potential terms: neither must
            an effect be found by what was supposed of it, nor a rival be held small.
    """

    pairs: tuple[Pair, ...]
    names: tuple[tuple[str, str], ...]
    prior: Floats


def rivals(
    problem: Problem,
    suspects: Sequence[str] | None = None,
    fitted: Mapping[str, Floats] | None = None,
) -> Rivals:
    """Return all pairs of suspects, both ways round.

    Args:
        problem: with all suspects among its potential terms.
        suspects: at least two effects; all families of the problem by default.
        fitted: estimated parameters (E,) of suspects, SI; of the others a few directions are
            drawn (always the same), each of an RMS strength of 1 σ of a measured element over
            all units.

    Raises:
        InputError: fewer than two suspects, or one that is not among the potential terms.
    """
    known = tuple(e.name for e in problem.families)
    names = known if suspects is None else tuple(dict.fromkeys(suspects))
    for name in names:
        if name not in known:
            valid = ", ".join(known) or "none"
            raise InputError(f"{name} is not among the potential terms; valid: {valid}")
    if len(names) < 2:
        raise InputError(f"{len(names)} effects to tell apart; valid: two or more")
    given = dict(fitted or {})
    model = np.arange(problem.model_size)
    pairs, both = [], []
    for e in names:
        where = problem.of_effect(e)
        strengths = [given[e] / problem.scale[where]] if e in given else _strengths(problem, e)
        for f in names:
            if f != e:
                nuisance = np.concatenate([model, problem.of_effect(f)])
                pairs += [Pair(where, beta, nuisance, f"{e} from {f}") for beta in strengths]
                both += [(e, f)] * len(strengths)
    prior, size = problem.measured.copy(), problem.model_size
    prior[:size, :size] = problem.prior[:size, :size]
    return Rivals(tuple(pairs), tuple(both), prior)


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
