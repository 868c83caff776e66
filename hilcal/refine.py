"""Diagnose and change the model, until it is adequate or something must be measured."""

from collections.abc import Callable
from dataclasses import dataclass

from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode
from hilcal.diagnose.projection import projection
from hilcal.diagnose.revise import (
    MOST_TOGETHER,
    Alternative,
    add,
    alternative,
    predicts_better,
    remove,
)
from hilcal.diagnose.rivals import Rivals
from hilcal.diagnose.verdict import Diagnosis, Verdict, diagnose
from hilcal.identify.fit import Fit, fit
from hilcal.model import Model

__all__ = ["Refinement", "Step", "add", "predicts_better", "refine", "remove"]

MOST_REVISIONS = 15

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
        rivals = Rivals(projection(last.fit))
        for name in names:
            idle = name in last.diagnosis.needless
            if not idle and not rivals.near(name, MOST_TOGETHER, self._out):
                continue
            self._tell(f"refitting without {name}")
            without = remove(last.fit, name)
            if idle and not predicts_better(without, last.fit):
                self._change(without, None, name)
                return True
            other = alternative(without, name, self._out)
            if other.better and not predicts_better(other.fits[-1], last.fit):
                self._exchange(name, other)
                return True
            doubt = " or ".join(n for n in other.own.same_as if n not in self._out)
            if other.as_good and len(other.effects) > 1:
                doubt = f"{doubt} or {' and '.join(other.effects)}".removeprefix(" or ")
            if doubt:
                doubts.append(f"{name} could as well be {doubt}")
        return False

    def _exchange(self, name: str, other: Alternative) -> None:
        """Put others in the place of an effect."""
        first, *rest = zip(other.effects, other.fits, strict=True)
        self._change(first[1], first[0], name)
        for effect, trial in rest:
            self._tell(f"added {effect}; diagnosing")
            self.steps.append(Step(trial, diagnose(trial), effect))

    def _change(self, trial: Fit, added: str | None, removed: str) -> None:
        self._out.add(removed)
        what = f"removed {removed}" if added is None else f"{added} in place of {removed}"
        self._tell(f"{what}; diagnosing")
        self.steps.append(Step(trial, diagnose(trial), added, removed))


def _names(model: Model) -> str:
    return " + ".join(model.names) or "the bare arm"
