"""The verdict on a fitted model: the one place where it is decided.

The rules, in this order:

1. A suspect passes all tests (see `effect_ranking.Suspect.passes`), and all effects of the
   catalogue together leave more than noise (see `catalogue_sufficiency`): `unknown_effect`.
2. A suspect passes, and the readings separate it from every other: `missing_effect`; else
   `ambiguous`.
3. None passes. Repeated readings, or their absence, decide whether the noise is misjudged (see
   `noise_verdict`): `noise_misjudged`.
4. The residual is larger than the noise: `unknown_effect`.
5. The residual is noise: `adequate`; or `ambiguous` where another effect could replace one that
   an earlier diagnosis chose.
"""

from collections.abc import Callable

from hilcal.diagnose.diagnosis import Diagnosis, History, Reason
from hilcal.diagnose.effect_ranking import FALSE_ALARM, LEAST_SHARE, ranked
from hilcal.diagnose.evidence import Evidence
from hilcal.diagnose.misfit_breakdown import MisfitShare
from hilcal.diagnose.noise_verdict import PREDICTABLE, judge_noise
from hilcal.diagnose.residual_regression import ResidualRegression
from hilcal.diagnose.separability import Separability, separability
from hilcal.identify.fit import Fit

NOTHING = History()
MOST_NAMED = 2
"""Variables that a sentence names."""


def diagnose(
    fit: Fit, history: History = NOTHING, say: Callable[[str], None] = lambda text: None
) -> Diagnosis:
    """Judge a fit.

    >>> with hc.Campaign.open(RUN) as run:
    ...     found = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> d = hc.diagnose(found)
    >>> d.verdict, d.suspects[0].effect
    ('missing_effect', 'joint_tilt_compliance')

    Args:
        fit: the fit.
        history: how its model was reached.
        say: takes progress, one line each.

    Raises:
        InputError: for a fit whose residual is not whitened.
    """
    return judge(Evidence(fit, say=say), history)


def judge(e: Evidence, history: History) -> Diagnosis:
    """Combine the evidence of a fit with what is known of the way to its model."""
    suspects = ranked(e.suspects, history.rejected)
    alternatives = tuple(e.alternative(name, history.removed) for name in history.added)
    lead = suspects[0] if suspects and suspects[0].passes else None
    insufficiency, noise = None, None
    rivals: tuple[Separability, ...] = ()
    reason: Reason
    if lead is not None:
        regression = ResidualRegression(e.tree_share if e.misfit else 0.0, ())
        insufficiency = e.insufficiency
        if insufficiency is not None:
            reason = "insufficient_catalogue"
            regression = ResidualRegression(regression.share, insufficiency.dependences)
        else:
            rivals = separability(e.linearisation, lead, e.effects) if lead.same_as else ()
            reason = "inseparable_suspects" if rivals else "one_suspect"
        follows = _carrying(regression)
    else:
        regression = e.regression if e.misfit else ResidualRegression(0.0, ())
        significant = _significant(e.misfit_breakdown)
        follows = _carrying(regression) or tuple(
            v.variable for v in significant if v.share >= LEAST_SHARE
        )
        unsure = any(s.explains for s in suspects)
        predictable = regression.share > PREDICTABLE or bool(significant) or unsure
        noise = judge_noise(e.fit, e.pure_error, predictable)
        if noise.misjudged:
            reason = "misjudged_noise"
        elif noise.off:
            reason = "no_suspect"
        else:
            in_doubt = any(a.inseparable for a in alternatives)
            reason = "inseparable_addition" if in_doubt else "residual_is_noise"
    return Diagnosis(
        fit=e.fit,
        history=history,
        reason=reason,
        suspects=suspects,
        misfit_breakdown=e.misfit_breakdown,
        predictable_share=regression.share,
        dependences=regression.dependences,
        follows=follows[:MOST_NAMED],
        pure_error=e.pure_error,
        noise=noise,
        redundant=e.redundant,
        separability=rivals,
        insufficiency=insufficiency,
        alternatives=alternatives,
    )


def _carrying(of: ResidualRegression) -> tuple[str, ...]:
    """Variables that carry a share worth naming, largest first."""
    return tuple(v.variable for v in of.dependences if v.share >= LEAST_SHARE)


def _significant(found: tuple[MisfitShare, ...]) -> tuple[MisfitShare, ...]:
    """Variables that the misfit follows beyond chance, all of them counted."""
    kinds = [v for v in found if v.variable.split()[0] not in ("pose", "direction")]
    return tuple(v for v in kinds if v.p_value * len(kinds) < FALSE_ALARM)
