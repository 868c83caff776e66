"""Diagnose and change the model, until it is adequate or something must be measured."""

from collections.abc import Callable
from dataclasses import dataclass

from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode
from hilcal.diagnose.rivals import Alternative, Rivals
from hilcal.diagnose.stepwise import add, exchange, predicts_better, remove
from hilcal.diagnose.verdict import Diagnosis, Verdict, diagnose
from hilcal.identify.fit import Fit, fit
from hilcal.model import Model

__all__ = ["Refinement", "Step", "add", "predicts_better", "refine", "remove"]

MOST_REVISIONS = 15
FAR = 0.1
"""Share of an effect's evidence by which others must be better while the model is not adequate."""

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One revision: a fit, its diagnosis, and what was changed to get there.

    Attributes:
        fit: the fit.
        diagnosis: of it.
        added: the effect that was added to the revision before.
        removed: the effect that was removed from it.
    """

    fit: Fit
    diagnosis: Diagnosis
    added: str | None
    removed: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """The steps of a refinement, and why it stopped.

    Attributes:
        steps: from the starting model to the last one.
        verdict: of the last model; `ambiguous` where an added effect could as well have been
            another.
        message: the reason in a sentence.
        rejected: effects that were tried and did not lower the error on poses left out.
    """

    steps: tuple[Step, ...]
    verdict: Verdict
    message: str
    rejected: tuple[str, ...]


def refine(model: Model, readings: Readings, mode: Mode, say: Say | None = None) -> Refinement:
    """Fit, diagnose, add the leading suspect, and repeat.

    An effect stays only if the error on poses left out falls. Where the leading suspect
    cannot be told from others it is added all the same, since any of them lowers the error.
    When nothing more is found, every addition is reconsidered in the light of the later ones:
    one that has become needless is removed, one whose part another effect plays better is
    exchanged, and the final verdict names the doubts that are left.

    Args:
        model: the starting model.
        readings: all readings.
        mode: "deflection" or "absolute".
        say: told what is being done, for people who wait.
    """
    tell = say or (lambda text: None)
    tell(f"fitting {_names(model)}")
    current = fit(model, readings, mode)
    tell("diagnosing")
    work = _Work([Step(current, diagnose(current), None)], model.names, tell)
    doubts: list[str] = []
    changed = True
    while changed:
        work.extend()
        doubts.clear()
        changed = work.reconsider(doubts)
    last = work.steps[-1].diagnosis
    verdict, message = last.verdict, last.message
    if verdict in ("missing_effect", "ambiguous") and work.rejected:
        verdict = "unknown_effect"
        message = (
            f"{', '.join(work.rejected)} would explain part of the misfit, but does not lower the "
            f"error on poses left out; {message}"
        )
    if doubts and verdict == "adequate":
        verdict = "ambiguous"
        message = f"{message}; but {'; '.join(doubts)}: measure what separates them"
    return Refinement(tuple(work.steps), verdict, message, tuple(work.rejected))


class _Work:
    """The revisions so far, and what was tried."""

    def __init__(self, steps: list[Step], given: tuple[str, ...], tell: Say) -> None:
        """Begin with a first step; effects that are `given` are never taken out again."""
        self.steps = steps
        self.rejected: list[str] = []
        self._out: set[str] = set()
        self._given, self._tell = given, tell

    @property
    def _room(self) -> bool:
        return len(self.steps) < MOST_REVISIONS

    def extend(self) -> None:
        """Add suspects while any lowers the error on poses left out."""
        while self._room and self._add_one():
            pass

    def _add_one(self) -> bool:
        last = self.steps[-1]
        for name in last.diagnosis.significant:
            if name in self.rejected or name in self._out:
                continue
            self._tell(f"adding {name}")
            trial = add(last.fit, name)
            if predicts_better(last.fit, trial):
                self._tell(f"added {name}; diagnosing")
                self.steps.append(Step(trial, diagnose(trial), name))
                return True
            self.rejected.append(name)
        return False

    def reconsider(self, doubts: list[str]) -> bool:
        """Judge every addition anew; returns whether one was removed or exchanged.

        Args:
            doubts: takes the additions that could as well be other effects.
        """
        last = self.steps[-1]
        names = [n for n in last.fit.model.names if n not in self._given]
        if not names or not self._room:
            return False
        self._tell(f"reconsidering {', '.join(names)}")
        rivals = Rivals(last.fit)
        for name in names:
            if name in last.diagnosis.needless:
                without = remove(last.fit, name)
                if not predicts_better(without, last.fit):
                    self._change(without, None, name)
                    return True
            other = rivals.of(name, self._out)
            if self._better(last, other) and self._exchange(last, other):
                return True
            doubt = " or ".join(n for n in other.same_as if n not in self._out)
            if other.as_good and len(other.others) > 1:
                doubt = f"{doubt} or {' and '.join(other.others)}".removeprefix(" or ")
            if doubt:
                doubts.append(f"{name} could as well be {doubt}")
        return False

    def _better(self, last: Step, other: Alternative) -> bool:
        """Whether others are worth a trial: while something unknown is left, far better ones."""
        known = last.diagnosis.verdict == "adequate"
        return other.better and (known or other.log_evidence > (1.0 + FAR) * other.own)

    def _exchange(self, last: Step, other: Alternative) -> bool:
        """Put others in the place of an effect, unless the error on poses left out rises.

        While something unknown is left, which the evidence takes for noise, it must surely fall.
        """
        self._tell(f"trying {' + '.join(other.others)} in place of {other.effect}")
        first, *rest = other.others
        trials = [exchange(last.fit, other.effect, first)]
        for name in rest:
            trials.append(add(trials[-1], name))
        found = trials[-1]
        if last.diagnosis.verdict == "adequate":
            if found.holdout.rms_sigma > last.fit.holdout.rms_sigma:
                return False
        elif not predicts_better(last.fit, found):
            return False
        self._change(trials[0], first, other.effect)
        for name, trial in zip(rest, trials[1:], strict=True):
            self._tell(f"added {name}; diagnosing")
            self.steps.append(Step(trial, diagnose(trial), name))
        return True

    def _change(self, trial: Fit, added: str | None, removed: str) -> None:
        self._out.add(removed)
        what = f"removed {removed}" if added is None else f"{added} in place of {removed}"
        self._tell(f"{what}; diagnosing")
        self.steps.append(Step(trial, diagnose(trial), added, removed))


def _names(model: Model) -> str:
    return " + ".join(model.names) or "the bare arm"
