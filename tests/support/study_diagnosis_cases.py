"""Cases of the study of the diagnosis, made by hand; and what other processes run in its tests."""

from typing import Any

from studies.diagnosis import Added, Asked, Inside, Judgement, Outcome, Refined


def asked(**given: Any) -> Asked:
    """A question; two effects are a pair."""
    usual: dict[str, Any] = {
        "kind": "hidden", "robot": "ur10e", "mode": "absolute",
        "hidden": ("creep",), "strength": 2.0, "seed": 0,
    }  # fmt: skip
    return Asked(**{**usual, **given})


def said(
    lead: str = "creep",
    *same_as: str,
    verdict: str = "missing_effect",
    variables: tuple[str, ...] = ("time", "load"),
    carriers: tuple[str, ...] = (),
) -> Judgement:
    return Judgement(verdict, lead, same_as, variables, carriers, "a sentence of times", 1.5)


def refined(
    *added: str,
    same_as: tuple[str, ...] = (),
    verdict: str = "adequate",
    holdout: float = 1.0,
    inside: tuple[Inside, ...] = (),
) -> Refined:
    return Refined(
        judgement=said(verdict=verdict),
        added=tuple(Added(a, same_as) for a in added),
        model=("joint_compliance", *added),
        holdout=holdout,
        holdout_real=holdout,
        intervals=inside,
    )


def outcome(lead: str = "creep", *same_as: str, **given: Any) -> Outcome:
    """The answer that `lead` is first, to a question about creep."""
    return Outcome(asked(**given), said(lead, *same_as))


def quick(question: Asked) -> Outcome:
    """An answer without any work; by module and name, so that other processes find it."""
    if question.seed < 0:
        raise RuntimeError("a seed below 0")
    return Outcome(question, said(f"effect {question.seed}"))
