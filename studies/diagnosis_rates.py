"""Rates over the cases of the study of the diagnosis."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.readings.whitening import Mode
from studies.diagnosis import DiagnosisOutcome, Judgement, RefinementResult

HELD_OUT = 1.05
"""Largest ratio of held-out error to noise floor of a right model."""


@dataclass(frozen=True, slots=True)
class Rate:
    """A share of a number of cases."""

    hits: int
    cases: int

    @property
    def share(self) -> float:
        """The share; nan without cases."""
        return self.hits / self.cases if self.cases else float("nan")

    def to_json(self) -> dict[str, object]:
        """Share and numbers."""
        return {"share": self.share, "hits": self.hits, "cases": self.cases}


def rate(outcomes: Iterable[DiagnosisOutcome], hit: Callable[[DiagnosisOutcome], bool]) -> Rate:
    """Return the rate of hits; a failed case is no hit, an impossible case does not count."""
    possible = tuple(o for o in outcomes if not o.impossible)
    return Rate(sum(not o.failure and hit(o) for o in possible), len(possible))


def found(o: DiagnosisOutcome) -> bool:
    """Whether each hidden effect is first, or in a first set of at most three."""
    return o.first is not None and all(o.first.finds(e) for e in o.case.hidden)


def named(o: DiagnosisOutcome) -> bool:
    """Whether the hidden effect is found, and the verdict names it."""
    return found(o) and o.first is not None and o.first.named


@dataclass(frozen=True, slots=True)
class EffectRates:
    """Rates of one effect, hidden in readings of one mode at one strength.

    Attributes:
        effect: the hidden effect.
        mode: of the readings.
        strength: σ.
        found: rate of cases in which the effect is first, or in a first set of at most three.
        named: rate of cases in which it is found and the verdict names an effect.
        size: mean size of the first set where the effect is found.
        instead: first effects where it is not found, most frequent first.
        again: rate of finding it after a further round; no cases without such a round.
        size_again: mean size of the first set after this round.
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


def by_effect(outcomes: Iterable[DiagnosisOutcome]) -> tuple[EffectRates, ...]:
    """Summarise hidden effects, in order of appearance."""
    groups: dict[tuple[str, Mode, float], list[DiagnosisOutcome]] = {}
    for o in outcomes:
        groups.setdefault((o.case.hidden[0], o.case.mode, o.case.strength), []).append(o)
    return tuple(_found(*key, group) for key, group in groups.items())


def _found(
    effect: str, mode: Mode, strength: float, group: Sequence[DiagnosisOutcome]
) -> EffectRates:
    again = [o for o in group if o.case.again]
    return EffectRates(
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


def _instead(group: Iterable[DiagnosisOutcome]) -> tuple[tuple[str, int], ...]:
    """Count the first effects where the hidden one is not found, too large sets, and failures."""
    count: Counter[str] = Counter()
    for o in group:
        if o.impossible:
            continue
        if o.first is None:
            count["failed"] += 1
        elif not found(o):
            inside = o.case.hidden[0] in o.first.same_as
            count[f"{o.first.lead} (set of {1 + len(o.first.same_as)})" if inside else o.first.lead
                  or "no suspect"] += 1  # fmt: skip
    return tuple(sorted(count.items(), key=lambda item: (-item[1], item[0])))


@dataclass(frozen=True, slots=True)
class RefinementRates:
    """Refinements of the cases that were found and named, at one strength.

    Attributes:
        strength: σ.
        right: rate of models to which only the hidden effects were added.
        holdout: rate of errors on poses left out of at most 1.05 × the stated noise floor.
        holdout_real: the same with the true noise of these readings.
        intervals: rate of true parameters in their 95 % intervals.
    """

    strength: float
    right: Rate
    holdout: Rate
    holdout_real: Rate
    intervals: Rate


def afterwards(outcomes: Iterable[DiagnosisOutcome]) -> tuple[RefinementRates, ...]:
    """Summarise refinements by strength."""
    groups: dict[float, list[RefinementResult]] = {}
    right: dict[float, int] = {}
    for o in outcomes:
        if named(o) and o.refined is not None:
            key = o.case.strength
            groups.setdefault(key, []).append(o.refined)
            exact = {a.effect for a in o.refined.added} == set(o.case.hidden)
            right[key] = right.get(key, 0) + exact
    return tuple(
        RefinementRates(
            strength,
            Rate(right[strength], len(group)),
            Rate(sum(r.holdout <= HELD_OUT for r in group), len(group)),
            Rate(sum(r.holdout_real <= HELD_OUT for r in group), len(group)),
            coverage(group),
        )
        for strength, group in groups.items()
    )


def coverage(refined: Iterable[RefinementResult], effect: str | None = None) -> Rate:
    """Return the rate of true parameters in their intervals, of one effect or of all."""
    intervals = [i for r in refined for i in r.intervals if effect in (None, i.effect)]
    return Rate(sum(i.inside for i in intervals), sum(i.parameters for i in intervals))


def coverage_by_effect(outcomes: Iterable[DiagnosisOutcome]) -> tuple[tuple[str, Rate], ...]:
    """Coverage by effect, of refinements of cases that were found and named."""
    refined = [o.refined for o in outcomes if named(o) and o.refined is not None]
    effects = dict.fromkeys(i.effect for r in refined for i in r.intervals)
    return tuple((e, coverage(refined, e)) for e in effects)


def both_found(o: DiagnosisOutcome) -> bool:
    """Whether a refinement finds both hidden effects, or effects inseparable from them."""
    return o.refined is not None and all(o.refined.finds(e) for e in o.case.hidden)


def both_added(o: DiagnosisOutcome) -> bool:
    """Whether both are in the refined model."""
    return o.refined is not None and set(o.case.hidden) <= set(o.refined.model)


def unknown(o: DiagnosisOutcome) -> bool:
    """Whether the verdict is `unknown_effect`, before or after refining."""
    judged = (o.first, o.refined.judgement if o.refined is not None else None)
    return any(j is not None and j.verdict == "unknown_effect" for j in judged)


def unknown_at_once(o: DiagnosisOutcome) -> bool:
    """Whether the first verdict is `unknown_effect`."""
    return o.first is not None and o.first.verdict == "unknown_effect"


def followed(o: DiagnosisOutcome) -> bool:
    """Whether a true variable is among the first two of the first diagnosis."""
    return o.first is not None and o.first.follows(o.variables)
