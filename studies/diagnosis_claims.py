"""Requirements on the diagnosis, and whether they are met."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from studies.diagnosis import DiagnosisOutcome, Kind
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
        words: name of the rate.
        rate: counted cases.
        least: least required share; None without a requirement.
        most: largest share allowed.
    """

    kind: Kind
    words: str
    rate: Rate
    least: float | None = None
    most: float = 1.0

    @property
    def met(self) -> bool | None:
        """Whether the requirement is met; None without a requirement or a case."""
        if self.least is None or not self.rate.cases:
            return None
        return self.least <= self.rate.share <= self.most


def claims(outcomes: Sequence[DiagnosisOutcome]) -> tuple[Claim, ...]:
    """Return all claims about these cases."""
    makers: dict[Kind, Callable[[Sequence[DiagnosisOutcome]], Iterable[Claim]]] = {
        "hidden": _hidden,
        "nothing": _nothing,
        "noise": _noise,
        "pairs": _pairs,
        "outside": _outside,
    }
    out: list[Claim] = []
    for kind, make in makers.items():
        of_kind = [o for o in outcomes if o.case.kind == kind]
        if of_kind:
            out += make(of_kind)
    return tuple(out)


def _hidden(cases: Sequence[DiagnosisOutcome]) -> Iterable[Claim]:
    strengths = list(dict.fromkeys(o.case.strength for o in cases))
    for s in strengths:
        of_strength = [o for o in cases if o.case.strength == s]
        yield Claim("hidden", f"found at {s:g} σ", rate(of_strength, found), FOUND.get(s))
        yield Claim("hidden", f"found and named at {s:g} σ", rate(of_strength, named))
    again = [o for o in cases if o.case.again]
    if again:
        hit = rate(
            again, lambda o: o.again is not None and all(o.again.finds(e) for e in o.case.hidden)
        )
        yield Claim("hidden", "found after a further round at 0.5 σ", hit, 0.9)
    for a in afterwards(cases):
        of = f"at {a.strength:g} σ, of those found and named"
        yield Claim("hidden", f"only what is hidden is added {of}", a.right)
        yield Claim("hidden", f"held-out error ≤ {HELD_OUT} × stated noise floor {of}", a.holdout)
        real = f"held-out error ≤ {HELD_OUT} × the noise that was {of}"
        yield Claim("hidden", real, a.holdout_real, 0.95)
        yield Claim("hidden", f"true parameters in 95 % intervals {of}", a.intervals, 0.93, 0.97)


def _nothing(cases: Sequence[DiagnosisOutcome]) -> Iterable[Claim]:
    hit = rate(cases, lambda o: o.first is not None and o.first.verdict == "adequate")
    yield Claim("nothing", "nothing hidden: adequate", hit, 0.99)


def _noise(cases: Sequence[DiagnosisOutcome]) -> Iterable[Claim]:
    for stated in dict.fromkeys(o.case.stated for o in cases):
        of_stated = [o for o in cases if o.case.stated == stated]
        case = f"σ stated {stated:g} × the true one"
        silent = rate(of_stated, lambda o: o.first is not None and not o.first.named)
        yield Claim("noise", f"{case}: no effect named", silent, 0.98)
        misjudged = rate(
            of_stated, lambda o: o.first is not None and o.first.verdict == "noise_misjudged"
        )
        yield Claim("noise", f"{case}: noise_misjudged", misjudged)


def _pairs(cases: Sequence[DiagnosisOutcome]) -> Iterable[Claim]:
    claim = "two hidden effects: both in the refined model"
    yield Claim("pairs", f"{claim}, or not told from what is", rate(cases, both_found), 0.9)
    yield Claim("pairs", claim, rate(cases, both_added))


def _outside(cases: Sequence[DiagnosisOutcome]) -> Iterable[Claim]:
    law = "an effect outside of the catalogue"
    yield Claim("outside", f"{law}: unknown_effect, in the end", rate(cases, unknown), 0.9)
    yield Claim("outside", f"{law}: unknown_effect, at once", rate(cases, unknown_at_once), 0.9)
    variable = "its variable among the first two"
    yield Claim("outside", variable, rate(cases, followed), 0.9)
