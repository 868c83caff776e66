"""Pairs of effects that a campaign is to discriminate, and the power of the test.

An effect e with parameters β is present; the model and a rival f are fitted. The statistic of the
test of e beyond both follows a noncentral χ² of non-centrality

    λ = βᵀ S β,   S = M_ee − M_en M_nn⁻ M_ne,   n: the model and f

whose degrees of freedom are the number of visible directions of S (`regression.evidence`). At the
readings so far, S is that of a diagnosis that tests e with f in the model.

β of an effect that the readings so far support is drawn from its posterior beside the fitted
model, at the prior strength of highest evidence: the estimate after adding the effect, to first
order. A diagnosis scores the effect by the same evidence, mean and scale.
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
from hilcal.identification.linearisation import Linearisation, computable, effect_columns, linearise
from hilcal.regression.evidence import family_power
from hilcal.regression.schur import schur_complement
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

LEVEL = 0.01  # of the test
DRAWS = 3
# a pair is not separable if the best plan of MANY readings has a lower power; both are guesses
MANY = 100
LEAST_POWER = 0.2
_LOOSE = 0.05
_SEED = 20240609
SUPPORTED = 3.0  # log evidence above which readings support an effect: odds of e³, 20 : 1


@dataclass(frozen=True, slots=True, eq=False)
class DiscriminatedPairs:
    """Pairs of effects to discriminate."""

    pairs: tuple[Pair, ...]  # of the criterion
    names: tuple[tuple[str, str], ...]  # (present effect, fitted rival) of each pair
    # (P, P) prior information without that of potential terms, which would favour an assumed effect
    # and shrink a rival
    prior: Floats
    not_separable: tuple[tuple[str, str], ...] = ()  # names of omitted pairs


def discriminated_pairs(problem: DesignProblem) -> DiscriminatedPairs:
    """Return the ordered pairs of potential terms that some measurement separates.

    A pair is not separable where the best plan of `MANY` readings, with the prior information, has
    a power below `LEAST_POWER` at the effect's first parameters. Parameters are drawn from the
    posterior of supported effects. For other effects, a few directions are drawn with a fixed seed,
    each with an RMS of 1 σ over the measured elements of all units.
    """
    names = tuple(e.name for e in problem.families)
    if len(names) < 2:
        raise InputError(f"{len(names)} effects to tell apart; valid: two or more")
    supported = supported_parameters(problem, DRAWS)
    pairs, pair_names = [], []
    for e in names:
        columns = problem.of_effect(e)
        betas = _directions(problem, e)
        if e in supported:
            betas = [x / problem.scale[columns] for x in supported[e]]
        for f in names:
            if f != e:
                pairs += [pair_of(problem, (e, f), beta) for beta in betas]
                pair_names += [(e, f)] * len(betas)
    prior, size = problem.measured.copy(), problem.model_size
    prior[:size, :size] = problem.prior[:size, :size]
    return _separable(problem, DiscriminatedPairs(tuple(pairs), tuple(pair_names), prior))


def pair_of(problem: DesignProblem, names: tuple[str, str], beta: Floats) -> Pair:
    """Return the pair of an effect with parameters β, over the problem's scales, and a rival."""
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
        estimated = estimate(linear, family)
        if estimated is not None and estimated.supported:
            out[family.name] = estimated.draws(count, np.random.default_rng(_SEED))
    return out


def _separable(problem: DesignProblem, pairs: DiscriminatedPairs) -> DiscriminatedPairs:
    spread = pairs.prior + problem.units.information(
        np.full(len(problem.units), MANY / float(problem.units.cost.sum()))
    )
    not_separable = []
    for names in dict.fromkeys(pairs.names):
        pair = pairs.pairs[pairs.names.index(names)]
        best = power(pair, spread)
        if best < LEAST_POWER:
            with suppress(CannotAnswerError):
                relaxed = relax(
                    problem.units, Separate((pair,)), MANY, pairs.prior, tolerance=_LOOSE
                )
                best = power(pair, relaxed.information)
        if best < LEAST_POWER:
            not_separable.append(names)
    separable = [k for k, names in enumerate(pairs.names) if names not in not_separable]
    if not separable:
        raise CannotAnswerError(not_separable_message(not_separable))
    return DiscriminatedPairs(
        tuple(pairs.pairs[k] for k in separable), tuple(pairs.names[k] for k in separable),
        pairs.prior, tuple(not_separable),
    )  # fmt: skip


def _by_effect(pairs: Sequence[tuple[str, str]]) -> dict[str, str]:
    return {e: " or ".join(f for x, f in pairs if x == e) for e, _ in pairs}


def not_separable_message(pairs: Sequence[tuple[str, str]]) -> str:
    """Return a message that names the pairs that no measurement separates."""
    unordered = [pair for k, pair in enumerate(pairs) if pair[::-1] not in pairs[:k]]
    listed = [f"{e} from {fs}" for e, fs in _by_effect(unordered).items()]
    return f"no measurement in this cell separates {', nor '.join(listed)}"


def not_ruled_out(pairs: Sequence[tuple[str, str]]) -> str:
    """Return a message on pairs (present effect, rival) whose rival cannot be ruled out."""
    listed = [f"{fs} where {e} is there" for e, fs in _by_effect(pairs).items()]
    return (
        f"no measurement in this cell rules out {', nor '.join(listed)}: {MANY} of the best "
        f"readings would do so with a chance of less than {100 * LEAST_POWER:.0f} %"
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
        for _, loads in problem.what
    )
    flat = rows.reshape(-1, len(columns))
    gram = flat.T @ flat / elements
    drawn = np.random.default_rng(_SEED).standard_normal((DRAWS, len(columns)))
    return [d / np.sqrt(float(d @ gram @ d)) for d in drawn]


@dataclass(frozen=True, slots=True, eq=False)
class EffectEstimate:
    """Posterior of the P parameters of an effect that is not in the model."""

    mean: Floats  # (P,) SI
    root: Floats  # (P, P) root of the scale matrix, SI
    log_evidence: float  # gain by adding the effect

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
    """Estimate an effect beside the model of a gc-scaled fit; None if its readings cannot."""
    if not computable(linear.fit, effect):
        return None
    columns = effect_columns(linear.fit, effect)
    score = linear.score(columns.white, most=effect.most())
    if not score.rank:
        return None
    scale = columns.scale
    return EffectEstimate(scale * score.step, scale[:, None] * score.root, score.log_evidence)
