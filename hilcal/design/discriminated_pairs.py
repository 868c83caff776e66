"""Pairs of effects that a campaign is to discriminate, and the power of doing so.

An effect e with the parameters β is there; the model and a rival f are fitted. The test of e beyond
both follows a noncentral χ² of non-centrality

    λ = βᵀ S β,   S = M_ee − M_en M_nn⁻ M_ne,   n: the model and f

with as many degrees of freedom as S has visible directions (`regression.evidence`). S at the
readings so far is the one that a diagnosis tests e with, with f in its model.

β of an effect that the readings so far support is drawn from its posterior beside the fitted
model, at the prior strength of most evidence: what adding the effect would estimate, to first
order. Evidence, mean and scale are those that a diagnosis scores the effect with.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from hilcal.design.approximate_design import relax
from hilcal.design.criteria import Pair, Separate
from hilcal.design.information import DesignProblem
from hilcal.effects.protocol import Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.effect_columns import computable, effect_columns
from hilcal.identification.linearisation import Linearisation, linearise
from hilcal.regression.evidence import family_power
from hilcal.regression.schur import schur_complement
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

LEVEL = 0.01  # Chance of a false alarm of the test
DRAWS = 3
MANY = 100  # Readings by which a pair counts as not separable ...
LEAST_POWER = 0.2  # ... where the best plan of so many has less power than this. Guesses, both.
_LOOSE = 0.05
_SEED = 20240609
SUPPORTED = 3.0  # Log evidence from which the readings support an effect: odds of 20 : 1, e³


@dataclass(frozen=True, slots=True, eq=False)
class DiscriminatedPairs:
    """Pairs of effects to discriminate."""

    pairs: tuple[Pair, ...]  # as the criterion takes them
    names: tuple[tuple[str, str], ...]  # (effect that is there, rival that is fitted) of each pair
    # (P, P) information before, without the priors of potential terms: neither must an effect be
    # found by what was supposed of it, nor a rival be held small
    prior: Floats
    not_separable: tuple[tuple[str, str], ...] = ()  # names of pairs that are left out


def discriminated_pairs(problem: DesignProblem) -> DiscriminatedPairs:
    """Return the pairs of potential terms, both ways round, that some measurement separates.

    None does where the best plan of `MANY` readings, with the prior information, has a power below
    `LEAST_POWER` at the first parameters of the effect. Parameters are those that the readings so
    far support; of other effects a few directions are drawn, the same every time, each of an RMS
    strength of 1 σ of a measured element over all units.
    """
    names = tuple(e.name for e in problem.families)
    if len(names) < 2:
        raise InputError(f"{len(names)} effects to tell apart; valid: two or more")
    given = supported_parameters(problem, DRAWS)
    pairs, both = [], []
    for e in names:
        where = problem.of_effect(e)
        betas = _directions(problem, e)
        if e in given:
            betas = [x / problem.scale[where] for x in given[e]]
        for f in names:
            if f != e:
                pairs += [pair_of(problem, (e, f), beta) for beta in betas]
                both += [(e, f)] * len(betas)
    prior, size = problem.measured.copy(), problem.model_size
    prior[:size, :size] = problem.prior[:size, :size]
    return _separable(problem, DiscriminatedPairs(tuple(pairs), tuple(both), prior))


def pair_of(problem: DesignProblem, names: tuple[str, str], beta: Floats) -> Pair:
    """Return a pair of an effect with the parameters β, in the problem's units, and a rival."""
    effect, rival = names
    nuisance = np.concatenate([np.arange(problem.model_size), problem.of_effect(rival)])
    return Pair(problem.of_effect(effect), beta, nuisance, f"{effect} from {rival}")


def supported_parameters(problem: DesignProblem, count: int) -> dict[str, Floats]:
    """Return (count, E) draws, SI, of the families that the readings so far support."""
    fit, out = problem.nominal.fit, {}
    if fit is None:
        return {}
    linear = linearise(fit)
    for family in problem.families:
        found = estimate(linear, family)
        if found is not None and found.supported:
            out[family.name] = found.draws(count, np.random.default_rng(_SEED))
    return out


def _separable(problem: DesignProblem, of: DiscriminatedPairs) -> DiscriminatedPairs:
    spread = of.prior + problem.units.information(
        np.full(len(problem.units), MANY / float(problem.units.cost.sum()))
    )
    not_separable = []
    for names in dict.fromkeys(of.names):
        pair = of.pairs[of.names.index(names)]
        best = power(pair, spread)
        if best < LEAST_POWER:
            with suppress(CannotAnswerError):
                found = relax(problem.units, Separate((pair,)), MANY, of.prior, tolerance=_LOOSE)
                best = power(pair, found.information)
        if best < LEAST_POWER:
            not_separable.append(names)
    keep = [k for k, names in enumerate(of.names) if names not in not_separable]
    if not keep:
        raise CannotAnswerError(not_separable_message(not_separable))
    pairs, both = tuple(of.pairs[k] for k in keep), tuple(of.names[k] for k in keep)
    return DiscriminatedPairs(pairs, both, of.prior, tuple(not_separable))


def _by_effect(pairs: Sequence[tuple[str, str]]) -> dict[str, str]:
    return {e: " or ".join(f for x, f in pairs if x == e) for e, _ in pairs}


def not_separable_message(pairs: Sequence[tuple[str, str]]) -> str:
    """Name the pairs that no measurement separates."""
    both = [pair for k, pair in enumerate(pairs) if pair[::-1] not in pairs[:k]]
    each = [f"{e} from {fs}" for e, fs in _by_effect(both).items()]
    return f"no measurement in this cell separates {', nor '.join(each)}"


def not_ruled_out(pairs: Sequence[tuple[str, str]]) -> str:
    """Say of pairs (effect that is there, rival) that no measurement rules out the rival."""
    each = [f"{fs} where {e} is there" for e, fs in _by_effect(pairs).items()]
    return (
        f"no measurement in this cell rules out {', nor '.join(each)}: {MANY} of the best readings "
        f"would do so with a chance of less than {100 * LEAST_POWER:.0f} %"
    )


def power(pair: Pair, information: Floats) -> float:
    """Return the power of the test of a pair at the information (P, P) of a plan and the prior."""
    s = schur_complement(information, pair.effect, pair.nuisance)
    return family_power(s, pair.beta, LEVEL)


def _directions(problem: DesignProblem, effect: str) -> list[Floats]:
    """Directions (E,) of an effect whose RMS over all measured elements is 1 σ."""
    where = problem.of_effect(effect)
    rows = problem.units.rows[:, :, where]
    elements = problem.nominal.elements * sum(
        len([name for name in loads if name != UNLOADED or problem.mode == "absolute"])
        for _, loads in problem.what
    )
    flat = rows.reshape(-1, len(where))
    gram = flat.T @ flat / elements
    rng = np.random.default_rng(_SEED)
    drawn = rng.standard_normal((DRAWS, len(where)))
    return [d / np.sqrt(float(d @ gram @ d)) for d in drawn]


@dataclass(frozen=True, slots=True, eq=False)
class EffectEstimate:
    """Posterior of the P parameters of an effect that is not in the model."""

    mean: Floats  # (P,) SI
    root: Floats  # (P, P) root of their scale matrix, SI
    log_evidence: float  # gain in log evidence by adding the effect

    @property
    def supported(self) -> bool:
        """Whether the readings support the effect."""
        return self.log_evidence > SUPPORTED

    def draws(self, count: int, rng: np.random.Generator) -> Floats:
        """Return (count, P) parameters: the mean, then draws from the posterior."""
        drawn = self.mean + rng.standard_normal((count, len(self.mean))) @ self.root.T
        drawn[0] = self.mean
        return np.asarray(drawn)


def estimate(linear: Linearisation, effect: Effect) -> EffectEstimate | None:
    """Estimate an effect beside the model of a gc-scaled fit; None where its readings cannot."""
    if not computable(linear.fit, effect):
        return None
    columns = effect_columns(linear.fit, effect)
    found = linear.score(columns.white, most=effect.most())
    if not found.rank:
        return None
    scale = columns.scale
    return EffectEstimate(scale * found.step, scale[:, None] * found.root, found.log_evidence)
