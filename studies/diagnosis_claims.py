"""What the diagnosis must reach, and whether it does."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from studies.diagnosis import Kind, Outcome
from studies.diagnosis_rates import (
    HELD_OUT,
    Rate,
    afterwards,
    both_added,
    both_found,
    followed,
    found,
    named,
    rate,
    unknown,
    unknown_at_once,
)

FOUND = {2.0: 0.97, 1.0: 0.93, 0.5: 0.75}
"""Share of hidden effects that must be found, by strength."""


@dataclass(frozen=True, slots=True)
class Claim:
    """One figure.

    Attributes:
        kind: of its cases.
        words: what is counted.
        rate: what was counted.
        least: share that is asked for; None where a figure is only of interest.
        most: share that it must not exceed.
    """

    kind: Kind
    words: str
    rate: Rate
    least: float | None = None
    most: float = 1.0

    @property
    def met(self) -> bool | None:
        """Whether it is reached; None where nothing is asked, or no case was run."""
        if self.least is None or not self.rate.cases:
            return None
        return self.least <= self.rate.share <= self.most


def claims(outcomes: Sequence[Outcome]) -> tuple[Claim, ...]:
    """All figures that these cases allow."""
    makers: dict[Kind, Callable[[Sequence[Outcome]], Iterable[Claim]]] = {
        "hidden": _hidden,
        "nothing": _nothing,
        "noise": _noise,
        "pairs": _pairs,
        "outside": _outside,
    }
    out: list[Claim] = []
    for kind, make in makers.items():
        mine = [o for o in outcomes if o.asked.kind == kind]
        if mine:
            out += make(mine)
    return tuple(out)


def _hidden(cases: Sequence[Outcome]) -> Iterable[Claim]:
    strengths = list(dict.fromkeys(o.asked.strength for o in cases))
    for s in strengths:
        mine = [o for o in cases if o.asked.strength == s]
        yield Claim("hidden", f"found at {s:g} σ", rate(mine, found), FOUND.get(s))
        yield Claim("hidden", f"found and named at {s:g} σ", rate(mine, named))
    again = [o for o in cases if o.asked.again]
    if again:
        hit = rate(
            again, lambda o: o.again is not None and all(o.again.finds(e) for e in o.asked.hidden)
        )
        yield Claim("hidden", "found after a further round at 0.5 σ", hit, 0.9)
    for a in afterwards(cases):
        at = f"at {a.strength:g} σ, of those found and named"
        yield Claim("hidden", f"only what is hidden is added {at}", a.right)
        yield Claim("hidden", f"held-out error ≤ {HELD_OUT} × stated noise floor {at}", a.holdout)
        words = f"held-out error ≤ {HELD_OUT} × the noise that was {at}"
        yield Claim("hidden", words, a.holdout_real, 0.95)
        yield Claim("hidden", f"true parameters in 95 % intervals {at}", a.intervals, 0.93, 0.97)


def _nothing(cases: Sequence[Outcome]) -> Iterable[Claim]:
    hit = rate(cases, lambda o: o.first is not None and o.first.verdict == "adequate")
    yield Claim("nothing", "nothing hidden: adequate", hit, 0.99)


def _noise(cases: Sequence[Outcome]) -> Iterable[Claim]:
    for stated in dict.fromkeys(o.asked.stated for o in cases):
        mine = [o for o in cases if o.asked.stated == stated]
        what = f"σ stated {stated:g} × the true one"
        silent = rate(mine, lambda o: o.first is not None and not o.first.named)
        yield Claim("noise", f"{what}: no effect named", silent, 0.98)
        told = rate(mine, lambda o: o.first is not None and o.first.verdict == "noise_misjudged")
        yield Claim("noise", f"{what}: noise_misjudged", told)


def _pairs(cases: Sequence[Outcome]) -> Iterable[Claim]:
    words = "two hidden effects: both in the refined model"
    yield Claim("pairs", f"{words}, or not told from what is", rate(cases, both_found), 0.9)
    yield Claim("pairs", words, rate(cases, both_added))


def _outside(cases: Sequence[Outcome]) -> Iterable[Claim]:
    what = "an effect outside of the catalogue"
    yield Claim("outside", f"{what}: unknown_effect, in the end", rate(cases, unknown), 0.9)
    yield Claim("outside", f"{what}: unknown_effect, at once", rate(cases, unknown_at_once), 0.9)
    words = "its variable among the first two"
    yield Claim("outside", words, rate(cases, followed), 0.9)
