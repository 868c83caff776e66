"""Diagnose and change the model, until it is adequate or something must be measured."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache

from hilcal import limits
from hilcal.diagnosis.background_evidence import (
    TOGETHER,
    BackgroundEffect,
    background_evidence,
    background_is_better,
    p_value_of_others,
    proved,
)
from hilcal.diagnosis.diagnosis import Diagnosis, History, Verdict, effect_probabilities
from hilcal.diagnosis.effect_ranking import LEAST_KEPT, LEAST_SHARE, kept_by_refit
from hilcal.diagnosis.evidence import Alternative, Evidence
from hilcal.diagnosis.residual_regression import Regressions
from hilcal.diagnosis.serial_noise import serial_noise, with_serial_noise
from hilcal.diagnosis.stepwise import add, exchange, predicts_better, remove, trial
from hilcal.diagnosis.verdict import NOTHING, judge, judge_naming
from hilcal.discovery.discovery import LawSearch
from hilcal.errors import CannotAnswerError
from hilcal.identification.arm_scatter import with_arm_scatter, with_prior_scatter
from hilcal.identification.background import (
    allows_background,
    with_background,
    with_pooled_lines,
)
from hilcal.identification.drift import carried_effects
from hilcal.identification.fit import Fit, fit
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.shown import Brief, Shown
from hilcal.store.revision import change

__all__ = ["Refinement", "RefinementStep", "add", "predicts_better", "refine", "remove"]

MOST_REVISIONS = 15
MOST_SCATTERS = 2
"""Estimates of the arm's scatter at most: the first, and one more with what was added after it."""
BACKGROUND = "background"  # what a step with a background has as its addition
FAR = 0.1
"""Share of an effect's evidence by which others must be better while the model is not adequate;
a guess."""

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class RefinementStep(Brief):
    """One revision: a fit, its diagnosis, and what was changed to get there."""

    fit: Fit
    diagnosis: Diagnosis  # with all that the refinement learnt of the fit
    added: str | None  # the effect that was added to the revision before, or `BACKGROUND`
    removed: str | None = None

    def __repr__(self) -> str:
        """Return the step in a line."""
        what = change(self.added, self.removed) or " + ".join(self.fit.model.names)
        error = f"{1e6 * self.fit.holdout.rms_m:.1f} µm rms on poses left out"
        return f"RefinementStep({what}: {error}, {self.diagnosis.verdict})"


@dataclass(frozen=True, slots=True, eq=False)
class Refinement(Shown):
    """The steps of a refinement, from the starting model to the last one."""

    steps: tuple[RefinementStep, ...]

    def _brief(self) -> dict[str, str]:
        last = self.steps[-8:]
        first = len(self.steps) - len(last)
        return {
            "model": " + ".join(self.fit.model.names),
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
        """Its verdict."""
        return self.diagnosis.verdict

    @property
    def names(self) -> tuple[str, ...]:
        """Effects of any of its models, each once."""
        return tuple(dict.fromkeys(n for s in self.steps for n in s.fit.model.named))

    @property
    def rejected(self) -> tuple[str, ...]:
        """Effects whose addition was tried and did not lower the error on poses left out."""
        return self.diagnosis.history.rejected

    def probabilities(self, effects: Iterable[str]) -> dict[str, float]:
        """Return the probability that the arm has each effect, by name.

        See `effect_probabilities`. An effect that no step tested has 0.04: prior odds of one to
        nine, less the price of its strength.
        """
        return effect_probabilities([s.diagnosis for s in self.steps], effects)


def refine(
    model: Model,
    readings: Readings,
    mode: Mode,
    say: Say = lambda text: None,
    history: History = NOTHING,
    laws: LawSearch | None = None,
    seen: Callable[[RefinementStep], None] = lambda step: None,
    background: bool = True,
) -> Refinement:
    """Fit, diagnose, add the first suspect, and repeat.

    An effect stays only if the error on poses left out falls, and the refit keeps what the
    linearisation promised (see `diagnosis.effect_ranking`). Where the readings do not separate
    the first suspect from others it is added all the same, since any of them lowers the error.
    When no suspect is left, every addition is reconsidered: a redundant one is removed, one that
    others replace better is exchanged for them. Where more than noise is left then, and
    `background` asks for it, all effects of the catalogue are fitted together, see
    `Path.take_background`. Effects that were tried or taken out enter the history by which
    `verdict.judge` judges each step. Where the arm's scatter is what is left, the last step is a
    fit with it in the covariance, so that weights, uncertainties and p-values have it, too.
    In the last fit the lines of a transmission error are about as large as their pools, since that
    predicts better than if each is by itself (`with_pooled_lines`). A correlation of the noise
    along the order of the readings is in all fits (see `diagnosis.serial_noise`): it would be taken
    for effects.

    Args:
        model: the starting model. Its effects are not taken out, but for those of a carried prior
            that the readings speak against (`carried_evidence`). The prior, with the arm's
            scatter where that was estimated, is in every fit.
        readings: all readings.
        mode: "deflection" or "absolute".
        say: takes progress, one line each.
        history: how the starting model was reached, where it was not given.
        laws: searches a law wherever the verdict is `unknown_effect`, before effects that only
            resemble what is missing are added, and where the misfit is taken for the arm's scatter;
            the law is then added and judged like any effect.
        seen: takes each step as soon as it is judged; of the last one the verdict can still change.
        background: whether all effects may predict together.

    Raises:
        InputError: too many readings.
    """
    limits.check_fitted(len(readings), readings.m)
    say(f"fitting {' + '.join(model.names) or 'the bare arm'}")
    readings = with_prior_scatter(model, readings.with_serial(None))
    first = with_serial_noise(fit(model, readings, mode))
    found = refine_from(first, say, history, laws, seen, background)
    last = found.fit
    if last.model.names == first.model.names:
        return found
    # A misfit may have hidden the correlation of the noise, or have looked like one.
    white = last
    if last.readings.serial is not None:
        white = fit(last.model, last.readings.with_serial(None), mode, start=last.theta)
    noise = serial_noise(white)
    if (noise is None) == (last.readings.serial is None):
        return found
    say("the noise is correlated along the order" if noise else "the noise is white after all")
    first = fit(model, first.readings.with_serial(noise), mode)
    return refine_from(first, say, history, laws, seen, background)


def refine_from(
    first: Fit,
    say: Say = lambda text: None,
    history: History = NOTHING,
    laws: LawSearch | None = None,
    seen: Callable[[RefinementStep], None] = lambda step: None,
    background: bool = True,
) -> Refinement:
    """Refine a fit with its noise correlated as it is in its covariance; see `refine`."""
    path = Path(first, say, history, laws, seen)
    changed = True
    while changed:
        path.extend()
        changed = path.reconsider()
        changed = changed or (background and path.take_background()) or path.take_scatter()
    path.pool_lines()
    return Refinement(tuple(path.steps))


class Path:
    """The revisions so far, and what was tried."""

    def __init__(
        self,
        first: Fit,
        say: Say = lambda text: None,
        before: History = NOTHING,
        laws: LawSearch | None = None,
        seen: Callable[[RefinementStep], None] = lambda step: None,
    ) -> None:
        """Begin with a fit, the effects of which stay; `before` says how its model was reached."""
        self.steps: list[RefinementStep] = []
        self._given, self._before, self._say = first.model.named, before, say
        self._laws, self._seen = laws, seen
        self._rejected, self._removed = [*before.rejected], [*before.removed]
        self._trial, self._regressions = cache(trial), Regressions()
        self._background_tried = False
        taken = first.readings.arm_scatter is not None
        self._scattered = [first.model.names] if taken else []
        self.append(first, None)

    @property
    def _room(self) -> bool:
        return len(self.steps) < MOST_REVISIONS

    def _evidence_of(
        self, found: Fit, background: tuple[BackgroundEffect, ...] | None = None
    ) -> Evidence:
        return Evidence(found, self._trial, self._say, self._regressions, background)

    def _history(self, of: Fit) -> History:
        names = of.model.named
        return History(
            added=tuple(n for n in names if n not in self._given or n in self._before.added),
            removed=tuple(self._removed),
            rejected=tuple(n for n in self._rejected if n not in names),
        )

    def append(
        self, found: Fit, added: str | None, removed: str | None = None, what: str = ""
    ) -> None:
        """Say what was done, judge a fit and append it."""
        self._say(f"{what}; diagnosing" if what else "diagnosing")
        self._evidence = self._evidence_of(found)
        diagnosis = judge(self._evidence, self._history(found))
        self.steps.append(RefinementStep(found, diagnosis, added, removed))
        self._seen(self.steps[-1])

    def extend(self) -> None:
        """Add suspects while any lowers the error on poses left out."""
        # Where suspects are rejected, the step is judged anew: a law may be looked for after all.
        while self._room and (self._add_law() or self._add_one() or self._add_law()):
            pass

    def _add_law(self) -> bool:
        """Add a law where no effect of the catalogue explains the misfit; whether one was added.

        It is looked for as well where the misfit is about to be taken for the arm's scatter, which
        is what nothing else explains.
        """
        last = self.steps[-1]
        d = last.diagnosis
        unexplained = d.verdict == "unknown_effect" or d.reason == "arm_scatter"
        if self._laws is None or not unexplained or last.fit.readings.arm_scatter is not None:
            return False
        proposed = self._laws.propose(last.fit, self._say)
        if proposed is None or not predicts_better(last.fit, proposed[0]):
            return False
        self.append(*proposed, what=f"added {proposed[1]}")
        return True

    def _add_one(self) -> bool:
        """Try the suspects, best first; returns whether one was added.

        The step is judged anew where suspects were rejected.
        """
        last, found = self.steps[-1], None
        before = len(self._rejected)
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
                found = larger, s.effect
                break
            self._rejected.append(s.effect)
        if len(self._rejected) > before:
            diagnosis = judge(self._evidence, self._history(last.fit))
            self.steps[-1] = replace(last, diagnosis=diagnosis)
        if found is None:
            return False
        self.append(*found, what=f"added {found[1]}")
        return True

    def reconsider(self) -> bool:
        """Judge every addition anew; returns whether one was removed or exchanged."""
        last = self.steps[-1]
        # What is named beside a background does not depend on what was added before.
        if last.diagnosis.wrong_figures or last.fit.model.background:
            return False
        added = [n for n in last.fit.model.named if n not in self._given]
        names = [*added, *carried_effects(last.fit.model)]
        if not names or not self._room:
            return False
        self._say(f"reconsidering {', '.join(names)}")
        others = {a.effect: a for a in last.diagnosis.alternatives}
        for name in names:
            if name in last.diagnosis.redundant:
                without = remove(last.fit, name)
                if not predicts_better(without, last.fit):
                    self._change(without, None, name)
                    return True
            better = name in added and self._better(last, others[name])
            if better and self._exchange(last, others[name]):
                return True
        return False

    def take_background(self) -> bool:
        """Fit all other effects of the catalogue together; whether they are in the model now.

        They stay as its background where the error on poses left out falls by a share worth it;
        where the readings do not prove them together, or the verdict is `unknown_effect`, so that
        they may resemble one that the catalogue does not have, also by more than it scatters from
        pose to pose. Where the stated noise explains the residual, and the readings do not
        prove them, they are not tried. Those that the readings prove beside all others are then
        named, in the order of their evidence, whatever was added before.
        """
        last = self.steps[-1]
        tried = self._background_tried or bool(last.fit.model.background)
        d = last.diagnosis
        if tried or not self._room or d.wrong_figures:
            return False
        self._background_tried = True
        if not allows_background(last.fit):
            return False
        proved_together = p_value_of_others(last.fit) <= TOGETHER
        as_stated = d.residual_is_noise and last.fit.readings.arm_scatter is None
        # What noise that is correlated along the order leaves looks like effects.
        if as_stated and (not proved_together or last.fit.readings.serial is not None):
            return False
        self._say("fitting all effects of the catalogue together")
        found = with_background(last.fit, self._given)
        if found is None or not background_is_better(last.fit, found):
            return False
        doubtful = not proved_together or d.verdict == "unknown_effect"
        if doubtful and not predicts_better(last.fit, found):
            return False
        self._say("the background of all effects predicts better; diagnosing")
        tested = background_evidence(found)
        names = proved(tested)[: MOST_REVISIONS - len(self.steps) - 1]
        fits = [found]
        for name in names:  # those that are proved are named
            model = fits[-1].model
            model = replace(model, background=model.background - {name})
            fits.append(replace(fits[-1], model=model))
        judged, self._evidence = judge_naming(
            fits, tested, self._history, lambda left: self._evidence_of(fits[-1], left)
        )
        for one, diagnosis, name in zip(fits, judged, (BACKGROUND, *names), strict=True):
            self.steps.append(RefinementStep(one, diagnosis, name))
            self._seen(self.steps[-1])
        return True

    def take_scatter(self) -> bool:
        """Fit with the arm's scatter in the covariance; returns whether anything was changed.

        It is estimated anew, once, where effects were added since.
        """
        last = self.steps[-1]
        fitted, names = last.fit, last.fit.model.names
        if fitted.model.background:  # the scatter is in its covariance
            return False
        if not self._room or len(self._scattered) == MOST_SCATTERS or names in self._scattered:
            return False
        judged = last.diagnosis
        if fitted.readings.arm_scatter is not None:
            stated = fitted.readings.as_stated()
            try:
                fitted = fit(fitted.model, stated, fitted.mode, start=fitted.theta)
            except CannotAnswerError:  # no more elements than parameters are determined
                return False
            evidence = Evidence(fitted, self._trial, regressions=self._regressions)
            judged = judge(evidence, self._history(fitted))
        if judged.reason != "arm_scatter" or judged.scatter is None:
            return False
        self._scattered.append(names)
        readings = with_arm_scatter(fitted.model.cell, fitted.readings, judged.scatter)
        found = fit(fitted.model, readings, fitted.mode, start=fitted.theta)
        self.append(found, None, what="the arm's scatter enters the covariance")
        return True

    def pool_lines(self) -> None:
        """Fit effects of many lines anew, the size of each line near that of its pool.

        The fit takes the place of the last step's. Not where the error on poses left out rises by
        more than it scatters from pose to pose, nor where nothing was changed.
        """
        last = self.steps[-1]
        if len(self.steps) == 1 or last.fit.model.background or last.diagnosis.wrong_figures:
            return
        found = with_pooled_lines(last.fit)
        if found is None or predicts_better(found, last.fit):
            return
        self._evidence = self._evidence_of(found)
        judged = judge(self._evidence, self._history(found))
        self.steps[-1] = replace(last, fit=found, diagnosis=judged)

    def _better(self, last: RefinementStep, other: Alternative) -> bool:
        """Whether others are worth a trial.

        While the residual is not noise they must be far better. When it is, several in the place of
        one must lower the error by a share worth naming: the log evidence of n residuals grows by
        n δ where their rms falls by a small share δ.
        """
        if not last.diagnosis.residual_is_noise:
            return other.better and other.log_evidence > (1.0 + FAR) * other.own
        worth = LEAST_SHARE * last.fit.dof if len(other.others) > 1 else 0.0
        return other.better and other.log_evidence > other.own + worth

    def _exchange(self, last: RefinementStep, other: Alternative) -> bool:
        """Put another in the place of an effect, unless the error on poses left out rises.

        The error must fall beyond chance where several take the place of one, since a model that is
        no better need not be larger; and while the residual is not noise, although the evidence
        takes it for noise.
        """
        self._say(f"trying {' + '.join(other.others)} in place of {other.effect}")
        first, *rest = other.others
        try:
            trials = [exchange(last.fit, other.effect, first)]
            for name in rest:
                trials.append(add(trials[-1], name))
        except CannotAnswerError:  # too many parameters, or no equilibrium
            return False
        found = trials[-1]
        if last.diagnosis.residual_is_noise and not rest:
            if found.holdout_of_all.rms_sigma > last.fit.holdout_of_all.rms_sigma:
                return False
        elif not predicts_better(last.fit, found):
            return False
        self._change(trials[0], first, other.effect)
        for name, larger in zip(rest, trials[1:], strict=True):
            self.append(larger, name, what=f"added {name}")
        return True

    def _change(self, changed: Fit, added: str | None, removed: str) -> None:
        self._removed.append(removed)
        what = f"removed {removed}" if added is None else f"{added} in place of {removed}"
        self.append(changed, added, removed, what)
