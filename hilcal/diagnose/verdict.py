"""A diagnosis: the verdict on a fitted model, in a word and in a sentence."""

from dataclasses import dataclass
from typing import Literal

from scipy.stats import chi2

from hilcal.diagnose.learner import predictable_share
from hilcal.diagnose.noise import PureError, pure_error
from hilcal.diagnose.projection import Projection, projection
from hilcal.diagnose.suspects import Suspect, candidates, rank_suspects
from hilcal.diagnose.where import Where, where
from hilcal.errors import InputError
from hilcal.identify.fit import Fit

Verdict = Literal["adequate", "missing_effect", "ambiguous", "unknown_effect", "noise_misjudged"]
FALSE_ALARM = 0.001
"""Chance of naming any effect where none is missing, over the whole catalogue."""
MISFIT_ALARM = 0.0005
"""Chance of calling the variance factor wrong where it is right, each side."""
LEAST_SHARE = 0.01
"""An effect that explains less of the misfit on poses left out is not worth adding."""
PREDICTABLE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """What is wrong with a fitted model.

    Attributes:
        fit: the fit.
        verdict: in a word.
        message: in a sentence.
        predictable_share: share of the misfit that a generic learner predicts.
        where: variables that the misfit follows, largest share first.
        suspects: effects that could be missing, best first.
        significant: names of the suspects that pass the test over the whole catalogue.
        pure_error: what repeats say of the noise, or None without repeats.
    """

    fit: Fit
    verdict: Verdict
    message: str
    predictable_share: float
    where: tuple[Where, ...]
    suspects: tuple[Suspect, ...]
    significant: tuple[str, ...]
    pure_error: PureError | None


def diagnose(fit: Fit) -> Diagnosis:
    """Judge a fit.

    Raises:
        InputError: for a fit whose residual is not whitened.
    """
    if fit.scaling != "gc":
        raise InputError(f"diagnosis needs scaling gc, this fit has {fit.scaling}")
    p = projection(fit)
    suspects = rank_suspects(p, candidates(p))
    places = where(p)
    share = predictable_share(p)
    repeats = pure_error(fit)
    tested = max(sum(s.score.rank > 0 for s in suspects), 1)
    significant = tuple(
        s
        for s in suspects
        if s.score.p_value * tested < FALSE_ALARM
        and s.score.log_evidence > 0
        and s.holdout_share >= LEAST_SHARE
    )
    verdict, message = _judge(p, significant, places, share, repeats)
    return Diagnosis(
        fit,
        verdict,
        message,
        share,
        places,
        suspects,
        tuple(s.effect for s in significant),
        repeats,
    )


def _judge(
    p: Projection,
    significant: tuple[Suspect, ...],
    places: tuple[Where, ...],
    share: float,
    repeats: PureError | None,
) -> tuple[Verdict, str]:
    fit = p.fit
    factor = fit.variance_factor
    spread = f"{factor**0.5:.2g} times the stated noise"
    if significant:
        lead = significant[0]
        explains = (
            f"explains {lead.share:.0%} of the misfit, {max(lead.holdout_share, 0):.0%} on poses "
            f"left out (p = {lead.score.p_value:.1g})"
        )
        if lead.same_as:
            others = ", ".join(lead.same_as)
            return "ambiguous", (
                f"{lead.effect} {explains}, but these data do not tell it from {others}; "
                "measure what separates them, or add one and judge on new poses"
            )
        return "missing_effect", f"{lead.effect} is missing: it {explains}"
    high = float(chi2.sf(fit.chi2, fit.dof)) < MISFIT_ALARM
    low = float(chi2.cdf(fit.chi2, fit.dof)) < MISFIT_ALARM
    if not high and not low:
        return "adequate", (
            f"Residuals are what the noise explains: variance factor {factor:.2f}; no effect of "
            "the catalogue is missing"
        )
    if (
        repeats is not None
        and not repeats.interval[0] <= 1 <= repeats.interval[1]
        and (low or repeats.lack_of_fit_p > MISFIT_ALARM)
    ):
        return "noise_misjudged", (
            f"Repeated readings scatter {repeats.factor**0.5:.2g} times as much as stated, and the "
            f"residuals no more than the repeats: scale the covariance by {repeats.factor:.2g}; no "
            "effect is missing"
        )
    if low:
        return "noise_misjudged", (
            f"Residuals are only {spread}: the stated covariance is too large"
        )
    kinds = [v for v in places if v.variable.split()[0] not in ("pose", "direction")]
    follow = [v for v in kinds if v.p_value * len(kinds) < FALSE_ALARM]
    if share > PREDICTABLE or repeats is not None or follow:
        named = [v.variable for v in follow if v.share >= LEAST_SHARE][:2]
        follows = f"; it follows {' and '.join(named)}" if named else ""
        return "unknown_effect", (
            f"Residuals are {spread}, a generic learner predicts {share:.0%} of the misfit, and no "
            f"effect of the catalogue explains {LEAST_SHARE:.0%} of it or more{follows}"
        )
    return "noise_misjudged", (
        f"Residuals are {spread} and nothing predicts them; without repeated readings the program "
        "cannot know whether the noise is larger than stated: repeat some readings"
    )
