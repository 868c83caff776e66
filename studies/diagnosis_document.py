"""The study of the diagnosis as a JSON document."""

from collections.abc import Sequence
from dataclasses import asdict

from studies.diagnosis import DiagnosisOutcome
from studies.diagnosis_claims import claims
from studies.diagnosis_rates import EffectRates, by_effect, coverage_by_effect, found


def document(outcomes: Sequence[DiagnosisOutcome], complete: bool) -> dict[str, object]:
    """Return figures and cases.

    Args:
        outcomes: the cases that were run.
        complete: whether these are all.
    """
    hidden = [o for o in outcomes if o.case.kind == "hidden"]
    return {
        "complete": complete,
        "claims": [
            {
                "kind": c.kind,
                "what": c.words,
                **c.rate.to_json(),
                "asked": c.least,
                "at_most": c.most if c.least is not None else None,
                "met": c.met,
            }
            for c in claims(outcomes)
        ],
        "effects": [_effect(f) for f in by_effect(hidden)],
        "coverage": [{"effect": e, **r.to_json()} for e, r in coverage_by_effect(hidden)],
        "cases": [_case(o) for o in outcomes],
    }


def _effect(f: EffectRates) -> dict[str, object]:
    return {
        "effect": f.effect,
        "readings": f.mode,
        "strength_sigma": f.strength,
        "found": f.found.to_json(),
        "named": f.named.to_json(),
        "set_size": f.size,
        "instead": dict(f.instead),
        "again": f.again.to_json(),
        "set_size_again": f.size_again,
    }


def _case(o: DiagnosisOutcome) -> dict[str, object]:
    return {**asdict(o), "found": found(o) if o.case.kind == "hidden" else None}
