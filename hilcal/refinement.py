"""Diagnose and change the model, until it is adequate or something must be measured."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from hilcal.diagnosis.background_evidence import (
    JOINT_LEVEL,
    BackgroundEffect,
    background_evidence,
    background_is_better,
    explained_share,
    left_out_squares,
    p_value_of_others,
    proved,
)
from hilcal.diagnosis.diagnosis import Diagnosis, History, Verdict, effect_probabilities
from hilcal.diagnosis.effect_ranking import LEAST_KEPT, LEAST_SHARE, kept_by_refit
from hilcal.diagnosis.evidence import Alternative, Evidence
from hilcal.diagnosis.residual_regression import Regressions
from hilcal.diagnosis.serial_noise import serial_noise, with_serial_noise
from hilcal.diagnosis.stepwise import add, exchange, predicts_better, remove, trial
from hilcal.diagnosis.unknown_law import (
    REMAINDER,
    has_remainder,
    with_remainder,
    with_same_remainder,
    without_remainder,
)
from hilcal.diagnosis.verdict import (
    NO_HISTORY,
    judge,
    judge_naming,
    with_doubts,
    with_insufficiency,
)
from hilcal.discovery.discovery import LawSearch
from hilcal.effects.protocol import EffectSpec
from hilcal.effects.written import chosen_options
from hilcal.errors import CannotAnswerError
from hilcal.identification.background import (
    allows_background,
    with_background,
    with_shrunk_effects,
)
from hilcal.identification.baseline import baseline
from hilcal.identification.carried.drift import carried_effects
from hilcal.identification.fit import Fit, fit, fit_again
from hilcal.identification.linearisation import linearise
from hilcal.identification.mixed_fit import MOST_NOISE_ROWS
from hilcal.identification.noise.arm_scatter import with_arm_scatter, with_prior_scatter
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.regression.leave_out import improves
from hilcal.shown import Brief
from hilcal.store.revision import BACKGROUND, change

MOST_REVISIONS = 15
MOST_SCATTERS = 2
"""Estimates of the arm's scatter at most: the first, and another after further effects."""
PRIOR = "prior"  # `RefinementStep.removed` of a step that leaves the carried prior out
UNEXPLAINED_VERDICTS = ("unknown_effect", "noise_misjudged")
"""Verdicts with which all effects are tried together where readings are many; a choice: they prove
single effects far below the noise, and all together take minutes."""
TAKEN_FOR_NOISE = ("arm_scatter", "background")
"""Reasons of a diagnosis that attributes the misfit to noise that the readings do not state."""
MANY_EFFECTS = 6
"""Number of added effects from which on all are tried together where readings are many, with any
verdict; a choice: such an arm has the others, too, and each single trial takes long."""
EXCHANGE_MARGIN = 0.1
"""Share of an effect's evidence by which the evidence of its replacements must exceed it while the
model is not adequate; a guess."""

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class RefinementStep(Brief):
    """One revision: a fit, its diagnosis, and the change that led to it."""

    fit: Fit
    diagnosis: Diagnosis
    added: str | None  # effect added to the previous revision, or `BACKGROUND`
    removed: str | None = None

    def __repr__(self) -> str:
        """Return the step in a line."""
        title = change(self.added, self.removed) or self.fit.model.title
        error = f"{1e6 * self.fit.holdout.rms_m:.1f} µm rms on poses left out"
        return f"RefinementStep({title}: {error}, {self.diagnosis.verdict})"


@dataclass(frozen=True, slots=True, eq=False)
class Refinement(Brief):
    """The steps of a refinement, from the starting model to the last one."""

    steps: tuple[RefinementStep, ...]

    def _brief(self) -> dict[str, str]:
        last = self.steps[-8:]
        first = len(self.steps) - len(last)
        return {
            "model": self.fit.model.title,
            "verdict": self.verdict,
            **{f"steps[{k}]": repr(s) for k, s in enumerate(last, start=first)},
        }

    @property
    def fit(self) -> Fit:
        """The last fit."""
        return self.steps[-1].fit

    @property
    def diagnosis(self) -> Diagnosis:
        """The diagnosis of the last fit: the verdict of the refinement."""
        return self.steps[-1].diagnosis

    @property
    def verdict(self) -> Verdict:
        """The verdict of the last diagnosis."""
        return self.diagnosis.verdict

    @property
    def names(self) -> tuple[str, ...]:
        """Effects named in the model of any step, without duplicates."""
        return tuple(dict.fromkeys(n for s in self.steps for n in s.fit.model.named))

    @property
    def rejected(self) -> tuple[str, ...]:
        """Effects whose addition was tried and did not lower the error on poses left out."""
        return self.diagnosis.history.rejected

    def probabilities(self, effects: Iterable[str]) -> dict[str, float]:
        """Return the probability that the arm has each effect, by name.

        See `effect_probabilities`. An effect that no step tested has the probability 0.04.
        """
        return effect_probabilities([s.diagnosis for s in self.steps], effects)


def refine(
    model: Model,
    readings: Readings,
    mode: Mode,
    say: Say = lambda text: None,
    history: History = NO_HISTORY,
    laws: LawSearch | None = None,
    on_step: Callable[[RefinementStep], None] = lambda step: None,
    background: bool = True,
) -> Refinement:
    """Fit, diagnose, add the first suspect, and repeat.

    An effect stays only if the error on poses left out falls and the refit lowers χ² about as much
    as the linearisation predicts (see `diagnosis.effect_ranking`). If the readings do not separate
    the first suspect from others, the first is added: any of them lowers the error. When no suspect
    remains, every addition is reconsidered: a redundant effect is removed, and one that others
    replace better is exchanged for them. If the residual is then more than noise, all effects of
    the catalogue are fitted together (`Path.add_background`). If the rest of the misfit is the
    arm's scatter, the last step is a fit with the scatter in the covariance, so weights,
    uncertainties and p-values include it. In the last fit the added effects are shrunk to
    estimated sizes, which predicts better (`with_shrunk_effects`). All fits include a correlation
    of the noise along the order of the readings (`diagnosis.serial_noise`), which would otherwise
    be taken for effects. Where the readings contradict a carried prior, or it leaves more than
    noise, they are refined without it, too; if that predicts poses left out better, these steps
    follow.

    Args:
        model: the starting model. Its effects stay, except those of a carried prior that the
            readings contradict (`contradicted_effects`). The prior is in every fit, with the arm's
            scatter if the previous campaign estimated it.
        readings: all readings.
        mode: "deflection" or "absolute".
        say: takes progress, one line each.
        history: the steps that led to the starting model.
        laws: searches a law where the verdict is `unknown_effect`, before effects that only
            resemble the missing one are added, and where the misfit is taken for noise or the arm's
            scatter; the law is then added and judged like any effect.
        on_step: takes each step as soon as it is judged; its verdict can still change.
        background: whether a background of all effects is allowed.

    Raises:
        InputError: too many readings.
    """
    refinement = _refine(model, readings, mode, say, history, laws, on_step, background)
    agrees = refinement.diagnosis.residual_is_noise and not refinement.fit.contradictions
    if refinement.fit.model.prior is None or agrees:
        return refinement
    say("refining without the prior, which does not explain the readings")
    try:
        start = _without_prior(refinement.steps[0].fit, readings)
        alone = _refine(start, readings, mode, say, NO_HISTORY, laws, lambda step: None, background)
    except CannotAnswerError:  # the readings alone are too few
        return refinement
    if not improves(*left_out_squares(refinement.fit, alone.fit)):
        return refinement
    say("without the prior poses left out are predicted better")
    steps = (replace(alone.steps[0], removed=PRIOR), *alone.steps[1:])
    for step in steps:
        on_step(step)
    return Refinement((*refinement.steps, *steps))


def _without_prior(fitted: Fit, readings: Readings) -> Model:
    """The starting model of the readings alone, and the effects that are not from the prior."""
    model, prior = fitted.model, fitted.model.prior
    carried = set() if prior is None else {e.name for e in prior.posterior.effects}
    start = baseline(model.cell, readings, fitted.mode, model.catalogue)
    for e in model.effects:
        if e.name not in carried and e.name not in start.names:
            start = start + EffectSpec(e.name, chosen_options(e, readings.states, readings.m))
    return start


def _refine(
    model: Model,
    readings: Readings,
    mode: Mode,
    say: Say,
    history: History,
    laws: LawSearch | None,
    on_step: Callable[[RefinementStep], None],
    background: bool,
) -> Refinement:
    say(f"fitting {' + '.join(model.names) or 'the bare arm'}")
    readings = with_prior_scatter(model, readings.with_serial(None))
    first = with_serial_noise(fit(model, readings, mode))
    refinement = refine_from(first, say, history, laws, on_step, background)
    last = refinement.fit
    if last.model.names == first.model.names:
        return refinement
    # the misfit of the first model may have hidden or imitated a correlation of the noise
    white = last
    if last.readings.serial is not None:
        plain = last.readings.with_serial(None)
        white = fit_again(last, readings=plain)
    noise = serial_noise(white)
    if (noise is None) == (last.readings.serial is None):
        return refinement
    say(
        "the noise is correlated along the order"
        if noise
        else "the noise is not correlated along the order"
    )
    first = fit(model, first.readings.with_serial(noise), mode)
    return refine_from(first, say, history, laws, on_step, background)


def refine_from(
    first: Fit,
    say: Say = lambda text: None,
    history: History = NO_HISTORY,
    laws: LawSearch | None = None,
    on_step: Callable[[RefinementStep], None] = lambda step: None,
    background: bool = True,
) -> Refinement:
    """Refine a fit with the correlation of its noise as it is; see `refine`."""
    path = Path(first, say, history, laws, on_step, background)
    path.complete()
    if path.shrink():
        path.complete()
    path.judge_sufficiency()
    path.find_doubts()
    return Refinement(tuple(path.steps))


class Path:
    """The revisions so far, and the effects that were rejected or removed."""

    def __init__(
        self,
        first: Fit,
        say: Say = lambda text: None,
        history: History = NO_HISTORY,
        laws: LawSearch | None = None,
        on_step: Callable[[RefinementStep], None] = lambda step: None,
        background: bool = True,
    ) -> None:
        """Start with a fit whose effects stay; `history` has the steps that led to its model."""
        self._background = background
        self.steps: list[RefinementStep] = []
        self._start, self._start_history, self._say = first.model.named, history, say
        self._laws, self._on_step = laws, on_step
        self._rejected, self._removed = [*history.rejected], [*history.removed]
        self._trial, self._regressions = cache(trial), Regressions()
        self._background_tried = False
        self._searched: list[tuple[str, ...]] = []  # models whose laws were searched again
        scattered = first.readings.arm_scatter is not None
        self._scattered = [first.model.names] if scattered else []
        self.append(first, None)

    @property
    def _room(self) -> bool:
        return len(self.steps) < MOST_REVISIONS

    def _evidence_of(
        self, fitted: Fit, background: tuple[BackgroundEffect, ...] | None = None
    ) -> Evidence:
        return Evidence(fitted, self._trial, self._say, self._regressions, background)

    def _history(self, fitted: Fit) -> History:
        names = fitted.model.named
        return History(
            added=tuple(n for n in names if n not in self._start or n in self._start_history.added),
            removed=tuple(self._removed),
            rejected=tuple(n for n in self._rejected if n not in names),
        )

    def append(
        self, fitted: Fit, added: str | None, removed: str | None = None, message: str = ""
    ) -> None:
        """Report the change, judge the fit and append it."""
        self._say(f"{message}; diagnosing" if message else "diagnosing")
        self._evidence = self._evidence_of(fitted)
        self._append(RefinementStep(fitted, self._judge(fitted), added, removed))

    def _judge(self, fitted: Fit, whole_catalogue: bool = False) -> Diagnosis:
        # only a search of laws needs to know already here whether the catalogue is sufficient
        whole_catalogue = whole_catalogue or self._laws is not None
        return judge(self._evidence, self._history(fitted), whole_catalogue)

    def _append(self, step: RefinementStep) -> None:
        self.steps.append(step)
        self._on_step(step)

    def complete(self) -> None:
        """Add, reconsider and fit again until nothing changes."""
        changed = True
        while changed:
            self.extend()
            changed = self.reconsider() or self._search_again()
            changed = changed or self.add_background() or self.add_remainder() or self.add_scatter()

    def extend(self) -> None:
        """Add suspects while any lowers the error on poses left out."""
        # after suspects are rejected and the step is judged again, a law may be searched
        while self._room and (
            self._add_law()
            or (self._has_many_effects() and self.add_background())
            or self._add_suspect()
            or self._add_law()
        ):
            pass

    def _has_many_effects(self) -> bool:
        """Whether many readings show many effects; see `MANY_EFFECTS`."""
        last = self.steps[-1].fit
        added = sum(name not in self._start for name in last.model.named)
        return last.readings.value.size > MOST_NOISE_ROWS and added >= MANY_EFFECTS

    def _add_law(self) -> bool:
        """Add a law if no effect of the catalogue explains the misfit; whether a law was added.

        A law is searched as well where the misfit would be taken for noise or the arm's scatter:
        it may act where the diagnosis does not look.
        """
        last = self.steps[-1]
        d = last.diagnosis
        unexplained = d.verdict in UNEXPLAINED_VERDICTS or d.reason in TAKEN_FOR_NOISE
        if self._laws is None or not unexplained:
            return False
        if last.fit.readings.arm_scatter is not None and not last.fit.model.background:
            return False
        proposed = self._laws.propose(last.fit, self._say)
        if proposed is None or not predicts_better(without_remainder(last.fit), proposed[0]):
            return False
        larger, law = proposed
        if not larger.model.background:
            self.append(larger, law, message=f"added {law}")
            return True
        # the sizes of the background were estimated without the law, and contain a part of it
        refitted = with_background(larger, [*last.fit.model.named, law])
        return self._append_background(larger if refitted is None else refitted, law)

    def _search_again(self) -> bool:
        """Search a law anew beside the effects added after it; whether another one replaced it.

        A law that was searched without these effects may have terms in their place: one of fewer
        parameters replaces it unless the error on poses left out rises.
        """
        last = self.steps[-1].fit
        names = last.model.names
        laws = () if self._laws is None else self._laws.proposed
        if self._laws is None or names in self._searched or last.model.background:
            return False
        self._searched.append(names)
        for law in laws:
            if law not in names[:-1] or not self._room:
                continue
            bare = remove(last, law)
            # among the effects of the catalogue it would be found again
            catalogue = self.steps[0].fit.model.catalogue
            bare = replace(bare, model=replace(bare.model, catalogue=catalogue))
            proposed = self._laws.propose(bare, self._say)
            if proposed is None:
                continue
            larger, other = proposed
            if larger.model.size < last.model.size and not predicts_better(larger, last):
                self._change(larger, other, law)
                return True
        return False

    def _add_suspect(self) -> bool:
        """Try the suspects, best first; returns whether one was added.

        The step is judged again where suspects were rejected.
        """
        last, better = self.steps[-1], None
        n_rejected = len(self._rejected)
        for s in last.diagnosis.suspects:
            if not s.passes or s.effect in self._removed:
                continue
            self._say(f"adding {s.effect}")
            larger = self._trial(last.fit, s.effect)
            if (
                larger is not None
                and kept_by_refit(last.fit, larger, s.score) >= LEAST_KEPT
                and predicts_better(last.fit, larger)
            ):
                better = larger, s.effect
                break
            self._rejected.append(s.effect)
        if len(self._rejected) > n_rejected:
            self.steps[-1] = replace(last, diagnosis=self._judge(last.fit))
        if better is None:
            return False
        self.append(*better, message=f"added {better[1]}")
        return True

    def reconsider(self) -> bool:
        """Judge every addition again; returns whether one was removed or exchanged."""
        last = self.steps[-1]
        # the effects named beside a background do not depend on previous additions
        if last.diagnosis.wrong_figures or last.fit.model.background:
            return False
        added = [n for n in last.fit.model.named if n not in self._start]
        names = [*added, *carried_effects(last.fit.model)]
        if not names or not self._room:
            return False
        self._say(f"reconsidering {', '.join(names)}")
        alternatives = {a.effect: a for a in last.diagnosis.alternatives}
        for name in names:
            if name in last.diagnosis.redundant:
                without = remove(last.fit, name)
                if not predicts_better(without, last.fit):
                    self._change(without, None, name)
                    return True
            better = name in added and self._better(last, alternatives[name])
            if better and self._exchange(last, alternatives[name]):
                return True
        return False

    def add_background(self) -> bool:
        """Fit all other effects of the catalogue together; whether the model has them now.

        They are not tried if the stated noise explains the residual and the readings do not prove
        them together; nor where readings are many, a few effects are named and the verdict blames
        neither the noise nor an unknown effect. They stay as the model's background if the error on
        poses left out falls by a share (`background_is_better`); also by more than it scatters from
        pose to pose where, by the verdict `unknown_effect`, they may imitate an effect that the
        catalogue lacks. Where the fit is saturated (`Fit.is_saturated`) its small residual proves
        nothing, and neither does what seems unknown beside it: they stay. See `_append_background`
        for their names.
        """
        last = self.steps[-1]
        tried = self._background_tried or bool(last.fit.model.background)
        d = last.diagnosis
        if not self._background or tried or not self._room or d.wrong_figures:
            return False
        many = last.fit.readings.value.size > MOST_NOISE_ROWS
        if many and not (d.verdict in UNEXPLAINED_VERDICTS or self._has_many_effects()):
            return False
        self._background_tried = True
        if not allows_background(last.fit):
            return False
        saturated = last.fit.is_saturated
        if saturated:  # also with the effects shrunk, as they are in the end
            saturated = (with_shrunk_effects(last.fit, self._start) or last.fit).is_saturated
        if d.residual_is_noise and last.fit.readings.arm_scatter is None:
            # The residual of serially correlated noise resembles effects.
            serial = last.fit.readings.serial is not None
            if serial or (not saturated and p_value_of_others(last.fit) > JOINT_LEVEL):
                return False
        self._say("fitting all effects of the catalogue together")
        fitted = with_background(last.fit, self._start)
        if fitted is None:
            return False
        named = last.fit
        if np.any(fitted.outlier != named.outlier):  # compared without the same gross errors
            try:
                named = fit_again(named, outlier=fitted.outlier)
            except CannotAnswerError:  # as many parameters as measured elements
                return False
        # effects of a saturated fit were chosen by an error on poses left out that is too small
        if not saturated and not background_is_better(named, fitted):
            return False
        if d.verdict == "unknown_effect" and not saturated:
            share = explained_share(named, fitted)
            if not predicts_better(named, fitted) or share <= d.predictable_share:
                return False
        self._say("the background of all effects predicts better; diagnosing")
        return self._append_background(fitted, BACKGROUND)

    def add_remainder(self) -> bool:
        """Fit what follows the pose beside the added effects alone; whether the model has it now.

        See `with_remainder`; a background has its own. The added effects may only have resembled
        what is missing: they go unless they predict poses left out better beside it, and can be
        added again.
        """
        last = self.steps[-1]
        tried = has_remainder(last.fit) or last.fit.model.background
        if not self._background or tried or not self._room:
            return False
        if last.diagnosis.reason != "no_suspect":
            return False
        fitted = with_remainder(last.fit, self._regressions, self._start)
        if fitted is None:
            return False
        first = self.steps[0].fit
        if last.fit.model.names != first.model.names:
            bare = fit_again(last.fit, first.model, start=first.theta)
            alone = with_same_remainder(bare, fitted, self._start)
            if alone is not None and not predicts_better(alone, fitted):
                fitted = alone
        self._say("what follows the pose predicts better; diagnosing")
        return self._append_background(fitted, REMAINDER)

    def _append_background(self, fitted: Fit, added: str) -> bool:
        """Append a fit with a background, and the same fit with more and more effects named.

        Where smooth laws predict what the background leaves on poses left out, it has a remainder
        (`with_remainder`). Those effects are named that the readings prove beside all others; none
        where laws predict what the remainder leaves, as any may only resemble what is missing.
        Returns False, and appends nothing, where its effects cannot be tested numerically.
        """
        fitted = with_remainder(fitted, self._regressions) or fitted
        try:
            tested = background_evidence(fitted)
        except CannotAnswerError as error:
            self._say(f"the background is left out: {error}")
            return False
        unknown = self._regressions.of(linearise(fitted)).significant
        names = [] if unknown else [name for name in proved(tested) if name != REMAINDER]
        names = names[: MOST_REVISIONS - len(self.steps) - 1]
        fits = [fitted]
        for name in names:
            model = fits[-1].model
            model = replace(model, background=model.background - {name})
            fits.append(replace(fits[-1], model=model))
            self._regressions.same(fits[-1], fitted)
        diagnoses, self._evidence = judge_naming(
            fits, tested, self._history, lambda unnamed: self._evidence_of(fits[-1], unnamed)
        )
        for step in map(RefinementStep, fits, diagnoses, (added, *names)):
            self._append(step)
        return True

    def add_scatter(self) -> bool:
        """Fit with the arm's scatter in the covariance; returns whether the covariance changed.

        The scatter is estimated once more if effects were added after its first estimate.
        """
        last = self.steps[-1]
        fitted, names = last.fit, last.fit.model.names
        if fitted.model.background:  # its covariance includes the scatter
            return False
        if not self._room or len(self._scattered) == MOST_SCATTERS or names in self._scattered:
            return False
        judged = last.diagnosis
        if fitted.readings.arm_scatter is not None:
            stated = fitted.readings.as_stated()
            try:
                fitted = fit_again(fitted, readings=stated)
            except CannotAnswerError:  # as many parameters as measured elements
                return False
            evidence = Evidence(fitted, self._trial, regressions=self._regressions)
            judged = judge(evidence, self._history(fitted))
        if judged.reason != "arm_scatter" or judged.scatter is None:
            return False
        self._scattered.append(names)
        readings = with_arm_scatter(fitted.model.cell, fitted.readings, judged.scatter)
        fitted = fit_again(fitted, readings=readings)
        self.append(fitted, None, message="the arm's scatter enters the covariance")
        return True

    def shrink(self) -> bool:
        """Fit the added effects again, their parameters shrunk to estimated sizes.

        The fit replaces that of the last step, unless the error on poses left out rises by more
        than it scatters from pose to pose. A path of one step stays as it is. Returns whether a
        suspect passes now that flat parameters had hidden.
        """
        last = self.steps[-1]
        if len(self.steps) == 1 or last.fit.model.background or last.diagnosis.wrong_figures:
            return False
        fitted = with_shrunk_effects(last.fit, self._start)
        if fitted is None or predicts_better(fitted, last.fit):
            return False
        self._evidence = self._evidence_of(fitted)
        self.steps[-1] = replace(last, fit=fitted, diagnosis=self._judge(fitted))
        return any(s.passes for s in self.steps[-1].diagnosis.suspects)

    def judge_sufficiency(self) -> None:
        """Judge whether the whole catalogue is sufficient, in each step where a suspect passes."""
        last = self.steps[-1]
        if last.diagnosis.lead is not None and last.diagnosis.insufficiency is None:
            last = replace(last, diagnosis=self._judge(last.fit, whole_catalogue=True))
        previous = [
            replace(s, diagnosis=with_insufficiency(s.diagnosis, last.diagnosis))
            for s in self.steps[:-1]
        ]
        self.steps = [*previous, last]

    def find_doubts(self) -> None:
        """Look for a step in the order, or a suspect, where the misfit is left unexplained."""
        last = self.steps[-1]
        self.steps[-1] = replace(last, diagnosis=with_doubts(last.diagnosis))

    def _better(self, last: RefinementStep, alternative: Alternative) -> bool:
        """Whether an alternative is worth a trial.

        While the residual is not noise, its evidence must be larger by the share `EXCHANGE_MARGIN`.
        When it is noise, several effects in the place of one must lower the rms by `LEAST_SHARE`:
        the log evidence grows by n δ where the rms of n residuals falls by a small share δ.
        """
        least = alternative.effect_log_evidence
        if not last.diagnosis.residual_is_noise:
            least *= 1.0 + EXCHANGE_MARGIN
        elif len(alternative.replacements) > 1:
            least += LEAST_SHARE * last.fit.dof
        # effects that were removed or replaced are not added again
        if not alternative.better or not set(self._removed).isdisjoint(alternative.replacements):
            return False
        return alternative.log_evidence > least

    def _exchange(self, last: RefinementStep, alternative: Alternative) -> bool:
        """Replace an effect by its alternative, unless the error on poses left out rises.

        The error must fall beyond chance where several effects replace one, since a model that is
        no better need not be larger; and while the residual is not noise, since the evidence
        assumes noise.
        """
        effect, (first, *further) = alternative.effect, alternative.replacements
        self._say(f"trying {' + '.join(alternative.replacements)} in place of {effect}")
        try:
            trials = [exchange(last.fit, effect, first)]
            for name in further:
                trials.append(add(trials[-1], name))
        except CannotAnswerError:  # too many parameters, or no equilibrium
            return False
        if last.diagnosis.residual_is_noise and not further:
            if trials[-1].holdout_of_all.rms_sigma > last.fit.holdout_of_all.rms_sigma:
                return False
        elif not predicts_better(last.fit, trials[-1]):
            return False
        self._change(trials[0], first, effect)
        for name, larger in zip(further, trials[1:], strict=True):
            self.append(larger, name, message=f"added {name}")
        return True

    def _change(self, changed: Fit, added: str | None, removed: str) -> None:
        self._removed.append(removed)
        message = f"removed {removed}" if added is None else f"{added} in place of {removed}"
        self.append(changed, added, removed, message)
