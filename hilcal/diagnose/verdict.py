"""A diagnosis: the verdict on a fitted model, in a word and in a sentence."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from scipy.stats import chi2

from hilcal.diagnose.backward_elimination import needless
from hilcal.diagnose.effect_ranking import Suspect, candidates, rank_suspects
from hilcal.diagnose.misfit_breakdown import Where, where
from hilcal.diagnose.noise import PureError, pure_error
from hilcal.diagnose.noise_verdict import MISFIT_ALARM, PREDICTABLE, judge_noise
from hilcal.diagnose.projection import Projection, projection
from hilcal.diagnose.residual_curves import Dependence, Predicted
from hilcal.diagnose.residual_regression import predictable, predictable_share
from hilcal.diagnose.separability import Apart, apart
from hilcal.errors import InputError
from hilcal.identify.fit import Fit

Verdict = Literal["adequate", "missing_effect", "ambiguous", "unknown_effect", "noise_misjudged"]
FALSE_ALARM = 0.001
"""Chance of naming any effect where none is missing, over the whole catalogue."""
LEAST_SHARE = 0.01
"""An effect that explains less of the misfit on poses left out is not worth adding."""


@dataclass(frozen=True, slots=True)
class Beyond:
    """What is left of a misfit with all effects of the catalogue that the readings ask for.

    Attributes:
        effects: these effects, the best first.
        refitted: how many of them were added by a refit; the carriers are of what these leave.
        share: of the misfit, that they leave.
        variance_factor: of the residual with them.
    """

    effects: tuple[str, ...]
    refitted: int
    share: float
    variance_factor: float


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """What is wrong with a fitted model.

    Attributes:
        fit: the fit.
        verdict: in a word.
        message: in a sentence.
        predictable_share: share of the misfit that a generic learner predicts; 0 where there
            is no misfit.
        where: variables that the misfit follows, largest share first.
        suspects: effects that could be missing, best first.
        significant: names of the suspects that pass the test over the whole catalogue.
        pure_error: what repeats say of the noise, or None without repeats.
        needless: effects of the model that these readings do not ask for.
        carriers: variables that carry what is predictable, with the dependence on each.
        apart: how the leading suspect differs from those that it is not told from.
        beyond: what the whole catalogue leaves; None where it leaves noise, or nobody asked
            (see `look_ahead`). Where it is given, the carriers are those of what the refit leaves.
    """

    fit: Fit
    verdict: Verdict
    message: str
    predictable_share: float
    where: tuple[Where, ...]
    suspects: tuple[Suspect, ...]
    significant: tuple[str, ...]
    pure_error: PureError | None
    needless: tuple[str, ...] = ()
    carriers: tuple[Dependence, ...] = ()
    apart: tuple[Apart, ...] = ()
    beyond: Beyond | None = None


def diagnose(fit: Fit) -> Diagnosis:
    """Judge a fit.

    Raises:
        InputError: for a fit whose residual is not whitened.
    """
    if fit.scaling != "gc":
        raise InputError(f"diagnosis needs scaling gc, this fit has {fit.scaling}")
    p = projection(fit)
    effects = candidates(p.fit)
    suspects = rank_suspects(p, effects, FALSE_ALARM)
    places = where(p)
    repeats = pure_error(fit)
    tested = max(sum(s.score.rank > 0 for s in suspects), 1)
    explaining = [
        s
        for s in suspects
        if s.score.p_value * tested < FALSE_ALARM
        and s.score.log_evidence > 0
        and s.holdout_share >= LEAST_SHARE
    ]
    significant = tuple(s for s in explaining if s.sure)
    lead = significant[0] if significant else None
    told = Predicted(0.0, ())
    if float(chi2.sf(fit.chi2, fit.dof)) < MISFIT_ALARM:
        told = predictable(p) if lead is None else Predicted(predictable_share(p), ())
    rivals = apart(p, lead, effects) if lead is not None and lead.same_as else ()
    if lead is not None:
        verdict, message = _named(lead, rivals)
    else:
        verdict, message = _judge(p, places, told, repeats, explaining)
    return Diagnosis(
        fit,
        verdict,
        message,
        told.share,
        places,
        suspects,
        tuple(s.effect for s in significant),
        repeats,
        tuple(n.effect for n in needless(fit)),
        told.carriers,
        rivals,
    )


def _named(lead: Suspect, rivals: tuple[Apart, ...]) -> tuple[Verdict, str]:
    """Return the verdict where an effect of the catalogue is missing."""
    explains = (
        f"explains {100 * lead.share:.0f} % of the misfit, "
        f"{100 * max(lead.holdout_share, 0):.0f} % on poses left out (p = {lead.score.p_value:.1g})"
    )
    if not rivals:
        return "missing_effect", f"{lead.effect} is missing: it {explains}"
    others = ", ".join(r.words for r in rivals)
    advice = "hilcal next plans what separates them, or add one and judge on new poses"
    if not any(r.possible for r in rivals):
        advice = "add one; for what these readings are used for it does not matter which"
    return "ambiguous", (
        f"{lead.effect} {explains}, but these data do not tell it from {others}; {advice}"
    )


def _judge(
    p: Projection,
    places: tuple[Where, ...],
    told: Predicted,
    repeats: PureError | None,
    unsure: Sequence[Suspect],
) -> tuple[Verdict, str]:
    """Return the verdict where no effect of the catalogue is missing."""
    fit = p.fit
    factor = fit.variance_factor
    spread = f"{factor**0.5:.2g} times the stated noise"
    kinds = [v for v in places if v.variable.split()[0] not in ("pose", "direction")]
    follow = [v for v in kinds if v.p_value * len(kinds) < FALSE_ALARM]
    noise = judge_noise(fit, repeats, told.share > PREDICTABLE or bool(follow) or bool(unsure))
    if noise.misjudged:
        return "noise_misjudged", noise.message
    if not noise.off:
        return "adequate", (
            f"Residuals are what the noise explains: variance factor {factor:.2f}; no effect of "
            f"the catalogue is missing{noise.message}"
        )
    carry = [v.variable for v in told.carriers if v.share >= LEAST_SHARE]
    named = (carry or [v.variable for v in follow if v.share >= LEAST_SHARE])[:2]
    follows = f"; it follows {' and '.join(named)}" if named else ""
    none = f"no effect of the catalogue explains {100 * LEAST_SHARE:.0f} % of it or more"
    if unsure:
        best = unsure[0]
        none = (
            f"the best effect of the catalogue, {best.effect}, explains {100 * best.share:.0f} % "
            "of it, but does not surely lower the error on poses left out"
        )
    return "unknown_effect", (
        f"Residuals are {spread}, a generic learner predicts {100 * told.share:.0f} % of the "
        f"misfit, and {none}{follows}{noise.message}"
    )
