"""The verdict on a fitted model: the one place where it is decided.

The rules, in this order:

0. A wrong figure of the cell explains the misfit (see `wrong_figures`): `ambiguous`, until the
   figure is corrected or confirmed; no effect is searched.
1. A suspect passes all tests (see `effect_ranking.Suspect.passes`), and all effects of the
   catalogue together leave more than noise (see `evidence`): `unknown_effect`.
2. A suspect passes, and the readings separate it from every other: `missing_effect`; else
   `ambiguous`.
3. No suspect passes, and χ² is not too large: `adequate`; or `ambiguous` where another effect could
   replace an addition to the model, or the fit has used more than half of the degrees of freedom.
4. χ² is too large, and something recorded surely predicts a share of the misfit on poses left out,
   or repeats of a pose have it in common: `unknown_effect`, with that share. If no variable
   predicts it beyond chance, and it is the same under every load of a pose, more poses would
   identify it (see `pose_alone`): `ambiguous`.
5. χ² is too large, the arm's own scatter is not in the stated covariance, and nothing predicts the
   residual (no suspect, no regression, no variable), or repeated readings scatter as much. The
   arm's scatter is then estimated (see `arm_scatter`), before rule 4:
   a. the readings prefer a noisier instrument at more than 20 : 1: `noise_misjudged`;
   b. the scatter is larger than the repeatability of any arm (see `noise`): `noise_misjudged`,
      whether the cause is the instrument, a loose arm or a loose target;
   c. else `adequate`: the fit assumed an arm without scatter, which no arm is. If the readings do
      not distinguish it from a noisier instrument, the message says so.
   If a share of the misfit is predicted that is negligible in an uncertainty budget
   (`noise.PREDICTABLE`), c holds as well, with that share; rule 4 applies instead of a and b.
6. Otherwise the stated noise is too small, or too large: `noise_misjudged` (see `noise`). Where the
   arm's repeatability is stated, too, the noise is complete, and wrong. Estimated noise is never
   too large: it contains what the fit explains.

Noise that was estimated from the readings (`Readings.noise_stated`) is too large where an effect
outside the catalogue is missing, and a background takes up a part of it, so that χ² does not show
the effect: rule 4 holds as well where laws surely predict the residual on poses left out.

If several targets are read in one arrival, the arm's scatter is not stated and χ² is too large, the
rules are applied to the fit with the estimated scatter in its covariance (see
`Evidence.with_arm_scatter`), and 3 becomes 5b or 5c.

Where a step in the order of the readings explains what all effects leave (see `order_step`), as of
a tracker that was moved, and the recorded state does not predict more of it, the verdict is
`unknown_effect` with that step, whatever else the rules say.

Readings that disagree (`Fit.disagreement`) are called wrong only where no suspect passes and the
misfit does not for the most part follow the recorded state.

The covariance of a judged fit includes a correlation of the noise along the order of the readings
(see `serial_noise`). If it is not proved, since effects explain the readings as well, 3 and 5c
become `ambiguous`.

If the model has a background, 3, 5 and 6 become `ambiguous` where the residual is noise of any size
or the arm's scatter: its effects predict poses left out, but none is proved by itself. They are the
suspects, and the size of the noise is stated.

A fit whose covariance includes the estimated scatter (`Readings.arm_scatter`) is judged by the same
rules, 3 as 5b where the scatter is larger than any arm's. Its residual may be smaller than its
noise: the scatter is never negative, so instrument noise that is stated too large, in some
elements, shows only then. The message says so.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.diagnosis.background_evidence import BackgroundEffect, as_suspects
from hilcal.diagnosis.diagnosis import Diagnosis, History, Reason
from hilcal.diagnosis.effect_ranking import FALSE_ALARM, LEAST_SHARE, Suspect, ranked
from hilcal.diagnosis.evidence import (
    LEAST_REMAINDER,
    Evidence,
    Insufficiency,
    Separability,
    separability,
    would_leave_noise,
)
from hilcal.diagnosis.misfit_breakdown import MisfitShare
from hilcal.diagnosis.noise import (
    PREDICTABLE,
    NoiseVerdict,
    exceeds_repeatability,
    judge_noise,
    prefers_instrument,
    within_repeatability,
)
from hilcal.diagnosis.order_step import step_in_order
from hilcal.diagnosis.recorded import ROW_ORDER
from hilcal.diagnosis.residual_regression import ResidualRegression
from hilcal.identification.fit import Fit
from hilcal.identification.mixed_fit import MOST_NOISE_ROWS
from hilcal.readings.readings import ArmScatter

NO_HISTORY = History()
NOTHING_PREDICTED = ResidualRegression(0.0, ())
IN_SAMPLE = ("pose", "direction")  # first words of variables whose share is of the fitted poses
IN_ORDER = (ROW_ORDER, "time")  # variables of the order of the readings
MOST_NAMED = 2  # variables that a sentence names
BACKGROUND_OVERRIDES = (
    "residual_is_noise", "inseparable_addition", "arm_scatter", "misjudged_noise",
)  # fmt: skip
"""Reasons that "background" overrides: its effects predict, but none is proved by itself."""
IMITATION, NEARLY_ALL = 0.5, 0.85
"""Share of the misfit on poses left out up to which a suspect only imitates an effect of which
smooth laws predict more than the second share; choices. Of two hidden effects laws predict less."""
OVERSTATED = 0.25
"""Variance factor below which the stated noise is wrong, whatever a background explains: it is
stated twice too large. A choice."""
MOST_POSE_SHARE = 0.5
"""Share of the misfit that all readings of a pose have in common, above which it is not the scatter
of single arrivals; a choice."""
MOST_OF_MISFIT = 0.5
"""Share of the misfit that the recorded state predicts above which it is a law, and not wrong
readings; a choice: many large errors predict some of each other by chance."""


def diagnose(
    fit: Fit,
    history: History = NO_HISTORY,
    say: Callable[[str], None] = lambda text: None,
    whole_catalogue: bool = True,
) -> Diagnosis:
    """Judge a fit, reached by the changes of `history`; `say` takes progress, one line each.

    For `whole_catalogue` see `judge`.

    Raises:
        InputError: a fit whose residual is not whitened.
    """
    return with_doubts(judge(Evidence(fit, say=say), history, whole_catalogue))


def with_doubts(d: Diagnosis) -> Diagnosis:
    """Return a diagnosis with what is in doubt: a step in the order, a suspect, a saturated fit.

    A saturated fit (`Fit.is_saturated`) leaves a small residual even if the model is wrong.
    """
    d = with_unconfirmed_suspect(with_order_step(d))
    few = d.reason == "residual_is_noise" and d.fit.is_saturated
    return replace(d, reason="few_readings") if few else d


def with_unconfirmed_suspect(d: Diagnosis) -> Diagnosis:
    """Return `unconfirmed_suspect` for `no_suspect` where a suspect may be all that is missing.

    It would leave noise, and nothing recorded predicts more of the misfit on poses left out; but
    these are so few that the error on them does not surely fall. Then nothing shows that the
    catalogue lacks the effect.
    """
    if d.reason != "no_suspect" or d.fit.model.background:
        return d
    unconfirmed = d.unconfirmed
    if not unconfirmed or d.predictable_share > max(s.holdout_share for s in unconfirmed):
        return d
    first = unconfirmed[0].effect
    others = [s for s in d.suspects if s.effect != first]
    return replace(d, reason="unconfirmed_suspect", suspects=(unconfirmed[0], *others))


def with_order_step(d: Diagnosis) -> Diagnosis:
    """Return a diagnosis with the step in the order of the readings, where there is one.

    None is sought where stated noise explains the residual of named effects, as a background, the
    arm's scatter, serial or estimated noise may have taken up a step; nor where a suspect passes,
    unless the misfit follows the order, as a step resembles a drift. Where the recorded state
    predicts more of the misfit than a step explains, the step resembles the law.
    """
    readings = d.fit.readings
    hides = d.fit.model.background or readings.serial is not None or not readings.noise_stated
    explained = d.residual_is_noise and not hides and readings.arm_scatter is None
    first = next((v.variable for v in _predictors(d.misfit_breakdown)), "")
    if explained or d.wrong_figures or (d.significant and first not in IN_ORDER):
        return d
    step = step_in_order(d.fit)
    if step is None or (step.share < d.predictable_share and not _follows_order(d)):
        return d
    return replace(d, step=step, reason="readings_disagree")


def with_insufficiency(d: Diagnosis, last: Diagnosis) -> Diagnosis:
    """Return the diagnosis of an earlier step where the last one leaves an unknown effect.

    The effects added since then are the catalogue's best, so what they leave, and all further
    effects if the last step tested these, the whole catalogue left at the earlier step; unless it
    is noise, or negligible beside the misfit then.
    """
    if d.lead is None or d.insufficiency is not None:
        return d
    added = tuple(n for n in last.fit.model.named if n not in d.fit.model.named)
    misfit, remainder = d.fit.chi2 - d.fit.dof, last.fit.chi2 - last.fit.dof
    rest = last.insufficiency
    if rest is None and last.reason == "no_suspect" and last.noise is not None:
        factor = last.fit.variance_factor
        rest = Insufficiency((), 0, 1.0, factor, last.dependences, last.noise)
    if rest is None or not 0.0 < LEAST_REMAINDER * misfit <= rest.share * remainder:
        return d
    insufficiency = replace(
        rest,
        effects=(*added, *rest.effects),
        refitted=len(added) + rest.refitted,
        share=rest.share * remainder / misfit,
    )
    return replace(
        d,
        reason="insufficient_catalogue",
        insufficiency=insufficiency,
        separability=(),
        dependences=last.dependences,
        follows=last.follows,
    )


def judge_naming(
    fits: Sequence[Fit],  # of models that differ only in the effects they name
    tested: Sequence[BackgroundEffect],  # of the first background, see `background_evidence`
    history: Callable[[Fit], History],  # of a fit
    evidence: Callable[[tuple[BackgroundEffect, ...]], Evidence],  # of the last fit
) -> tuple[tuple[Diagnosis, ...], Evidence]:
    """Judge a fit with a background, and the same fit with more and more of its effects named.

    All predict the same, so the last fit is judged, and the diagnoses of the others are derived
    from it. Returns the diagnoses, and the evidence of the last fit.
    """
    unnamed = [tuple(b for b in tested if b.effect in f.model.background) for f in fits]
    e = evidence(unnamed[-1])
    last = judge(e, history(fits[-1]))
    background = {b.effect for b in last.background}
    suspects = [s for s in last.suspects if s.effect not in background]
    unknown = last.reason == "no_suspect"
    derived = (
        replace(
            last,
            fit=f,
            history=history(f),
            reason=last.reason if unknown else "background",
            suspects=(*(() if unknown else as_suspects(effects)), *suspects),
            background=effects,
        )
        for f, effects in zip(fits[:-1], unnamed, strict=False)
    )
    return (*derived, last), e


def judge(e: Evidence, history: History, whole_catalogue: bool = True) -> Diagnosis:
    """Judge a fit by its evidence and the history of its model.

    `whole_catalogue` tells whether to test that the whole catalogue is sufficient, by refits, where
    a suspect passes. A refinement adds the suspects anyway: see `with_insufficiency`.
    """
    if e.wrong_figures:
        return Diagnosis(
            fit=e.fit,
            history=history,
            reason="wrong_figure",
            suspects=(),
            misfit_breakdown=e.misfit_breakdown,
            pure_error=e.pure_error,
            wrong_figures=e.wrong_figures,
        )
    d = _with_arrivals(e, history, whole_catalogue)
    if e.fit.disagreement is None or any(s.passes for s in d.suspects):
        return d
    law = d.reason == "no_suspect" and _follows_state(d)
    return d if law else replace(d, reason="readings_disagree")


def _with_arrivals(e: Evidence, history: History, whole_catalogue: bool) -> Diagnosis:
    """Judge; with the arm's scatter in the covariance where readings of one arrival share it."""
    if e.with_arm_scatter is None or e.arm_scatter is None:
        return _judged(e, history, whole_catalogue)
    d = _judged(e.with_arm_scatter, history, whole_catalogue)
    scatter = replace(e.arm_scatter, predicted_share=d.predictable_share, predicted_by=d.follows)
    d = replace(d, fit=e.fit, scatter=scatter)
    if d.reason != "residual_is_noise":
        return d
    plausible = within_repeatability(scatter, e.fit.model.cell.arm)
    noise = judge_noise(e.fit, e.pure_error, False)
    return replace(d, reason="arm_scatter" if plausible else "misjudged_noise", noise=noise)


def _judged(e: Evidence, history: History, whole_catalogue: bool) -> Diagnosis:
    """Judge by rules 1 to 6, with the covariance of the fit."""
    added = () if e.fit.model.background else history.added
    suspects = e.suspects(history.rejected)
    lead = suspects[0] if suspects and suspects[0].passes else None
    if lead is not None and _imitates(e, lead):
        passing = [s.effect for s in suspects if s.passes]
        suspects, lead = ranked(suspects, {*history.rejected, *passing}), None
    if lead is None:
        finding = _without_suspect(e, suspects, added)
    else:
        finding = _with_suspect(e, suspects, lead, whole_catalogue)
    alone, reason = None, finding.reason
    unexplained = reason in ("misjudged_noise", "no_suspect") and e.misfit
    if unexplained and not _predicted(e, finding.regression):
        alone = e.pose_alone
        reason = reason if alone is None else "pose_alone"
    return Diagnosis(
        fit=e.fit,
        history=history,
        reason=reason,
        suspects=finding.suspects,
        misfit_breakdown=e.misfit_breakdown,
        predictable_share=finding.predicted,
        dependences=finding.regression.dependences,
        follows=finding.follows[:MOST_NAMED],
        pure_error=e.pure_error,
        noise=finding.noise,
        redundant=e.redundant,
        separability=finding.rivals,
        insufficiency=finding.insufficiency,
        alternatives=e.alternatives(added),
        scatter=finding.scatter,
        pose_alone=alone,
        background=e.background,
        confounded=e.confounded(None if lead is None else lead.effect),
    )


@dataclass(frozen=True, slots=True)
class _Finding:
    """What the rules with, or without, a suspect that passes all tests find."""

    reason: Reason
    suspects: tuple[Suspect, ...]
    predicted: float  # share of the misfit that the first suspect, or anything recorded, predicts
    regression: ResidualRegression  # of what the suspect, or the catalogue, leaves
    follows: tuple[str, ...]
    scatter: ArmScatter | None
    noise: NoiseVerdict | None = None
    rivals: tuple[Separability, ...] = ()
    insufficiency: Insufficiency | None = None


def _with_suspect(
    e: Evidence, suspects: tuple[Suspect, ...], lead: Suspect, whole_catalogue: bool
) -> _Finding:
    """Rules 1 and 2: is the catalogue sufficient, and is the first suspect separable?"""
    insufficiency = e.insufficiency if whole_catalogue else None
    rivals: tuple[Separability, ...] = ()
    regression = NOTHING_PREDICTED
    reason: Reason
    if insufficiency is not None:
        reason = "insufficient_catalogue"
        regression = ResidualRegression(0.0, insufficiency.dependences)
    else:
        rivals = separability(e.linearisation, lead, e.effects) if lead.same_as else ()
        reason = "inseparable_suspects" if rivals else "one_suspect"
    return _Finding(
        reason=reason,
        suspects=suspects,
        predicted=lead.holdout_share if e.misfit else 0.0,
        regression=regression,
        follows=_carrying(regression),
        scatter=e.fit.readings.arm_scatter,
        rivals=rivals,
        insufficiency=insufficiency,
    )


def _without_suspect(
    e: Evidence, suspects: tuple[Suspect, ...], added: tuple[str, ...]
) -> _Finding:
    """Rules 3 to 6: is the residual noise, an effect outside the catalogue, or wrong noise?"""
    readings, arm = e.fit.readings, e.fit.model.cell.arm
    # Noise that was estimated while an effect is missing is too large to show the effect, and a
    # background takes up what it can of the effect.
    hides = e.fit.model.background or not readings.noise_stated
    hidden = hides and e.regression.significant
    regression = e.regression if e.misfit or hidden else NOTHING_PREDICTED
    significant = _significant(e.misfit_breakdown)
    follows = _carrying(regression) or tuple(v.variable for v in significant)
    sizes = [v.share for v in significant]
    sizes += [
        s.holdout_share
        for s in suspects
        if s.explains and (s.sure or would_leave_noise(e.fit, s.share))
    ]
    predicted = max([regression.share, *sizes]) if e.misfit or hidden else 0.0
    # A misfit that an effect of implausible size would explain is no noise either.
    patterns = [
        s.holdout_share
        for s in suspects
        if not s.plausible and s.sure and s.score.p_value * len(suspects) < FALSE_ALARM
    ]
    predictable = regression.share > PREDICTABLE or bool(sizes) or bool(patterns)
    noise = judge_noise(e.fit, e.pure_error, predictable)
    scatter = readings.arm_scatter
    in_fit = scatter is not None
    implausible = scatter is not None and exceeds_repeatability(scatter, arm)
    little = noise.reason == "predictable" and max(predicted, *patterns, 0.0) <= PREDICTABLE
    same_in_pose = any(
        v.variable == "pose" and v.share > MOST_POSE_SHARE and v.p_value < FALSE_ALARM
        for v in e.misfit_breakdown
    )
    may = e.misfit and (noise.misjudged or little) and not in_fit and not same_in_pose
    estimate = e.arm_scatter if may and not readings.scatter_stated else None
    by_arm = (
        estimate is not None
        and not prefers_instrument(estimate)
        and within_repeatability(estimate, arm)
    )
    if estimate is not None and (by_arm or noise.misjudged):
        names = follows[:MOST_NAMED]
        scatter = replace(estimate, predicted_share=predicted, predicted_by=names)
    reason: Reason
    if hidden and predicted > PREDICTABLE:
        reason = "no_suspect"
    elif by_arm:
        reason = "arm_scatter"
    elif implausible or (noise.misjudged and not (in_fit and noise.reason == "too_large")):
        reason = "misjudged_noise"
    elif noise.contradicted and not noise.misjudged:
        reason = "no_suspect"
    else:
        in_doubt = any(a.inseparable for a in e.alternatives(added))
        reason = "inseparable_addition" if in_doubt else "residual_is_noise"
    serial = readings.serial
    if reason in ("residual_is_noise", "arm_scatter") and serial and not serial.proved:
        reason = "serial_or_effect"
    if _is_background(e, reason, noise, implausible):
        reason, suspects = "background", (*as_suspects(e.background), *suspects)
    return _Finding(reason, suspects, predicted, regression, follows, scatter, noise)


def _is_background(e: Evidence, reason: Reason, noise: NoiseVerdict, implausible: bool) -> bool:
    """Whether the background explains the residual, so that its effects are in doubt.

    An `implausible` scatter is too large for an arm: noise if repeats show it, since effects too
    small to be resolved scatter alike.
    """
    overstated = noise.reason == "too_large" and e.fit.variance_factor < OVERSTATED
    if not e.background or (reason == "misjudged_noise" and overstated):
        return False
    repeated = implausible and e.pure_error is not None
    if reason == "misjudged_noise" and not repeated:
        return True
    return reason in BACKGROUND_OVERRIDES


def _imitates(e: Evidence, lead: Suspect) -> bool:
    """Whether smooth laws predict nearly all of the misfit, and the first suspect little of it.

    It then only resembles what is missing. Laws of many readings take long, and are not asked.
    """
    if (
        not e.misfit
        or lead.holdout_share > IMITATION
        or e.fit.readings.value.size > MOST_NOISE_ROWS
    ):
        return False
    return e.regression.significant and e.regression.share > NEARLY_ALL


def _follows_state(d: Diagnosis) -> bool:
    """Whether most of the misfit follows the recorded state, as that of wrong readings does not."""
    return d.predictable_share > MOST_OF_MISFIT and not _follows_order(d)


def _follows_order(d: Diagnosis) -> bool:
    """Whether the misfit follows the order of the readings most, or nothing that is recorded."""
    return not d.follows or d.follows[0] in IN_ORDER


def _predicted(e: Evidence, regression: ResidualRegression) -> bool:
    """Whether something recorded predicts the misfit on poses left out, beyond chance."""
    shares = (v.share for v in _predictors(e.misfit_breakdown))
    chance = 2.0 / np.sqrt(int(e.fit.pose.max()) + 1)
    return regression.share > PREDICTABLE or max(shares, default=0.0) > chance


def _carrying(regression: ResidualRegression) -> tuple[str, ...]:
    """Variables that carry a share worth naming, largest first."""
    return tuple(v.variable for v in regression.dependences if v.share >= LEAST_SHARE)


def _significant(breakdown: tuple[MisfitShare, ...]) -> tuple[MisfitShare, ...]:
    """Variables that predict a share of the misfit worth naming, beyond chance among all."""
    predictors = _predictors(breakdown)
    alarm = FALSE_ALARM / max(len(predictors), 1)
    return tuple(v for v in predictors if v.p_value < alarm and v.sure and v.share >= LEAST_SHARE)


def _predictors(breakdown: tuple[MisfitShare, ...]) -> list[MisfitShare]:
    """Return the variables whose share is of poses left out, largest share first."""
    return [v for v in breakdown if v.variable.split()[0] not in IN_SAMPLE]
