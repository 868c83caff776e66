"""Pairs of effects that a campaign is to discriminate, and the power of the test.

An effect e with parameters β is present; the model and a rival f are fitted. The statistic of the
test of e beyond both follows a noncentral χ² of non-centrality

    λ = βᵀ S β,   S = M_ee − M_en M_nn⁻ M_ne,   n: the model and f

whose degrees of freedom are the number of visible directions of S (`regression.evidence`). At the
readings so far, S is that of a diagnosis that tests e with f in the model.

For an effect that the readings so far support, β is drawn from its posterior when it is added to
the fitted model, to first order, at the prior strength of highest evidence. A diagnosis scores the
effect by the same evidence, mean and scale.
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import groupby

import numpy as np

from hilcal.design.approximate_design import relax
from hilcal.design.criteria import Separate
from hilcal.design.criterion import DiscriminatedPairs, Objective, Pair
from hilcal.design.information import DesignProblem
from hilcal.effects.protocol import Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.linearisation import Linearisation, computable, effect_columns, linearise
from hilcal.regression.evidence import family_power
from hilcal.regression.schur import schur_complement
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

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

    The mean of the posterior, then draws from it; None where the readings do not support the effect
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
