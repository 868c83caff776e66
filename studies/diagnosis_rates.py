"""What the cases of the study of the diagnosis add up to."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.readings.whitening import Mode
from studies.diagnosis import Judgement, Outcome, Refined

HELD_OUT = 1.05
"""Held-out error over the noise floor that a right model has at most."""


@dataclass(frozen=True, slots=True)
class Rate:
    """A share of so many cases; nothing is said of none."""

    hits: int
    cases: int

    @property
    def share(self) -> float:
        """The share, nan of no cases."""
        return self.hits / self.cases if self.cases else float("nan")

    def to_json(self) -> dict[str, object]:
        """Share and numbers."""
        return {"share": self.share, "hits": self.hits, "cases": self.cases}


def rate(outcomes: Iterable[Outcome], hit: Callable[[Outcome], bool]) -> Rate:
    """Count; a case that failed is no hit, and one that cannot be is no case."""
    asked = tuple(o for o in outcomes if not o.impossible)
    return Rate(sum(not o.failure and hit(o) for o in asked), len(asked))


def found(o: Outcome) -> bool:
    """Whether each hidden effect is first, or in a set of at most three that is."""
    return o.first is not None and all(o.first.finds(e) for e in o.asked.hidden)


def named(o: Outcome) -> bool:
    """Whether it is found, and the verdict names it."""
    return found(o) and o.first is not None and o.first.named


@dataclass(frozen=True, slots=True)
class Found:
    """One effect, hidden in readings of one kind at one strength.

    Attributes:
        effect: what was hidden.
        mode: readings.
        strength: σ.
        found: first, or in a set of at most three that is.
        named: found by a verdict that names an effect.
        size: mean size of the set that is first, where it is found.
        instead: what was first where it was not found, most frequent first.
        again: found after a further round; no cases where there was none.
        size_again: mean size of the set then.
    """

    effect: str
    mode: Mode
    strength: float
    found: Rate
    named: Rate
    size: float
    instead: tuple[tuple[str, int], ...]
    again: Rate
    size_again: float


def by_effect(outcomes: Iterable[Outcome]) -> tuple[Found, ...]:
    """Summarise hidden effects, in order of appearance."""
    groups: dict[tuple[str, Mode, float], list[Outcome]] = {}
    for o in outcomes:
        groups.setdefault((o.asked.hidden[0], o.asked.mode, o.asked.strength), []).append(o)
    return tuple(_found(*key, group) for key, group in groups.items())


def _found(effect: str, mode: Mode, strength: float, group: Sequence[Outcome]) -> Found:
    again = [o for o in group if o.asked.again]
    return Found(
        effect=effect,
        mode=mode,
        strength=strength,
        found=rate(group, found),
        named=rate(group, named),
        size=_size(o.first for o in group if found(o)),
        instead=_instead(group),
        again=rate(again, lambda o: o.again is not None and o.again.finds(effect)),
        size_again=_size(o.again for o in again if o.again is not None and o.again.finds(effect)),
    )


def _size(judgements: Iterable[Judgement | None]) -> float:
    sizes = [1 + len(j.same_as) for j in judgements if j is not None]
    return float(np.mean(sizes)) if sizes else float("nan")


def _instead(group: Iterable[Outcome]) -> tuple[tuple[str, int], ...]:
    """What led where the hidden effect did not; a set that is too large, and failures, too."""
    count: Counter[str] = Counter()
    for o in group:
        if o.impossible:
            continue
        if o.first is None:
            count["failed"] += 1
        elif not found(o):
            inside = o.asked.hidden[0] in o.first.same_as
            count[f"{o.first.lead} (set of {1 + len(o.first.same_as)})" if inside else o.first.lead
                  or "no suspect"] += 1  # fmt: skip
    return tuple(sorted(count.items(), key=lambda item: (-item[1], item[0])))


@dataclass(frozen=True, slots=True)
class Afterwards:
    """Refinements of the cases that were found and named, at one strength.

    Attributes:
        strength: σ.
        right: the model has what is hidden, and nothing else was added.
        holdout: error on poses left out at most 1.05 × the stated noise floor.
        holdout_real: the same against what the noise was in these readings.
        intervals: true parameters in their 95 % intervals.
    """

    strength: float
    right: Rate
    holdout: Rate
    holdout_real: Rate
    intervals: Rate


def afterwards(outcomes: Iterable[Outcome]) -> tuple[Afterwards, ...]:
    """Summarise refinements by strength."""
    groups: dict[float, list[Refined]] = {}
    right: dict[float, int] = {}
    for o in outcomes:
        if named(o) and o.refined is not None:
            key = o.asked.strength
            groups.setdefault(key, []).append(o.refined)
            mine = {a.effect for a in o.refined.added} == set(o.asked.hidden)
            right[key] = right.get(key, 0) + mine
    return tuple(
        Afterwards(
            strength,
            Rate(right[strength], len(group)),
            Rate(sum(r.holdout <= HELD_OUT for r in group), len(group)),
            Rate(sum(r.holdout_real <= HELD_OUT for r in group), len(group)),
            coverage(group),
        )
        for strength, group in groups.items()
    )


def coverage(refined: Iterable[Refined], effect: str | None = None) -> Rate:
    """True parameters in their intervals: of one effect, or of all."""
    mine = [i for r in refined for i in r.intervals if effect in (None, i.effect)]
    return Rate(sum(i.inside for i in mine), sum(i.parameters for i in mine))


def coverage_by_effect(outcomes: Iterable[Outcome]) -> tuple[tuple[str, Rate], ...]:
    """Coverage by effect, of refinements of cases that were found and named."""
    refined = [o.refined for o in outcomes if named(o) and o.refined is not None]
    effects = dict.fromkeys(i.effect for r in refined for i in r.intervals)
    return tuple((e, coverage(refined, e)) for e in effects)


def both_found(o: Outcome) -> bool:
    """Whether a refinement has both hidden effects, or what cannot be told from them."""
    return o.refined is not None and all(o.refined.finds(e) for e in o.asked.hidden)


def both_added(o: Outcome) -> bool:
    """Whether both are in the refined model."""
    return o.refined is not None and set(o.asked.hidden) <= set(o.refined.model)


def unknown(o: Outcome) -> bool:
    """Whether the program says, before or after refining, that no effect of the catalogue does."""
    judged = (o.first, o.refined.judgement if o.refined is not None else None)
    return any(j is not None and j.verdict == "unknown_effect" for j in judged)


def unknown_at_once(o: Outcome) -> bool:
    """Whether the first diagnosis says so."""
    return o.first is not None and o.first.verdict == "unknown_effect"


def followed(o: Outcome) -> bool:
    """Whether a true variable is among the first two of the first diagnosis."""
    return o.first is not None and o.first.follows(o.variables)
