"""How often a hidden effect is found, and how often one is found where there is none.

Each case simulates a campaign with one hidden effect, fits the baseline, diagnoses, and adds
the leading suspect. The campaigns come from outside (`Rehearse`), so that the diagnosis is
tested against mechanics that it does not know.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from hilcal.cell import Cell
from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode
from hilcal.diagnose.verdict import diagnose
from hilcal.identify.baseline import baseline
from hilcal.identify.fit import fit
from hilcal.refine import add

NOTHING = "nothing"

Rehearse = Callable[[str, Mode, int], tuple[Cell, Readings]]
"""Simulate a campaign that hides an effect (or nothing), by name, readings and seed."""


@dataclass(frozen=True, slots=True)
class Case:
    """One simulated campaign.

    Attributes:
        effect: what was hidden.
        mode: readings.
        seed: of the simulation.
        verdict: on the baseline.
        lead: the leading suspect.
        same_as: what the program says it cannot tell from it.
        before: variance factor of the baseline.
        after: variance factor with the leading suspect added; of the baseline where no effect
            was named.
        covered: whether the interval of `after` contains 1.
    """

    effect: str
    mode: Mode
    seed: int
    verdict: str
    lead: str
    same_as: tuple[str, ...]
    before: float
    after: float
    covered: bool

    @property
    def found(self) -> bool:
        """Whether the verdict is right: the hidden effect leads, or nothing is named."""
        if self.effect == NOTHING:
            return self.verdict == "adequate"
        return self.verdict in ("missing_effect", "ambiguous") and (
            self.effect == self.lead or self.effect in self.same_as
        )


def run_case(rehearse: Rehearse, effect: str, mode: Mode, seed: int) -> Case:
    """Simulate, fit, diagnose, add."""
    cell, readings = rehearse(effect, mode, seed)
    first = fit(baseline(cell, readings, mode), readings, mode)
    diagnosis = diagnose(first)
    lead = diagnosis.suspects[0]
    last = first
    if diagnosis.significant:
        lead = next(s for s in diagnosis.suspects if s.effect == diagnosis.significant[0])
        last = add(first, lead.effect)
    low, high = last.variance_factor_interval
    return Case(
        effect=effect,
        mode=mode,
        seed=seed,
        verdict=diagnosis.verdict,
        lead=lead.effect,
        same_as=lead.same_as,
        before=first.variance_factor,
        after=last.variance_factor,
        covered=low <= 1 <= high,
    )


def hidden_study(
    rehearse: Rehearse, cases: Iterable[tuple[str, Mode]], seeds: Iterable[int]
) -> Iterator[Case]:
    """Run all cases for all seeds, one after the other."""
    numbers = tuple(seeds)
    for effect, mode in cases:
        for seed in numbers:
            yield run_case(rehearse, effect, mode, seed)


@dataclass(frozen=True, slots=True)
class Rate:
    """How often the verdict was right for one hidden effect.

    Attributes:
        effect: what was hidden.
        mode: readings.
        seeds: number of campaigns.
        found: share of right verdicts.
        covered: share of campaigns whose variance factor's interval contains 1 afterwards.
        largest_set: most effects that were reported as indistinguishable from the leader.
        before: median variance factor of the baseline.
        after: median variance factor after adding.
    """

    effect: str
    mode: Mode
    seeds: int
    found: float
    covered: float
    largest_set: int
    before: float
    after: float


def rates(cases: Iterable[Case]) -> tuple[Rate, ...]:
    """Summarise cases by effect and readings, in order of appearance."""
    groups: dict[tuple[str, Mode], list[Case]] = {}
    for case in cases:
        groups.setdefault((case.effect, case.mode), []).append(case)
    return tuple(
        Rate(
            effect=effect,
            mode=mode,
            seeds=len(group),
            found=sum(c.found for c in group) / len(group),
            covered=sum(c.covered for c in group) / len(group),
            largest_set=max(len(c.same_as) for c in group),
            before=sorted(c.before for c in group)[len(group) // 2],
            after=sorted(c.after for c in group)[len(group) // 2],
        )
        for (effect, mode), group in groups.items()
    )
