"""What `next` says: which suspects the planned measurements will tell apart, and how well."""

from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.text import Text

from hilcal import numbers
from hilcal.design.next import SURE, Next, PairPower
from hilcal.design.summary import PlanSummary
from hilcal.present import text
from hilcal.present.text_plan import certified, load_name
from hilcal.present.text_run import spoken
from hilcal.store.plan import UNLOADED

_STRETCHED = 1.15
_MOST_LOADS = 2
_LEAST_SHARE = 0.1

POWER_COLUMNS = ("if this is there", "this is ruled out", "now", "then")


def next_report(
    found: Next, poses: int, readings: int, details: bool = True
) -> Iterator[RenderableType]:
    """Yield the powers of the pairs, now and then, and what makes the difference.

    Args:
        found: the plan and what it tells.
        poses: of the plan, beside the reference.
        readings: of the plan.
        details: all pairs, not the one of each suspect that is separated least.
    """
    yield text.heading("Telling the suspects apart")
    out = text.table(*POWER_COLUMNS, left=(0, 1))
    for row in power_rows(found.powers if details else weakest(found.powers)):
        out.add_row(*row)
    yield out
    yield Text(
        "now, then: where the first effect is there, the chance that the readings so far, and with "
        "those planned as well, reject a fit with the second in its place (test at 1 %).\n",
        style="dim",
    )
    yield f"{summary(found.powers, poses, readings)} {_difference(found)}\n"
    for note in found.notes:
        yield f"note: {note}"


def weakest(powers: Sequence[PairPower]) -> tuple[PairPower, ...]:
    """Return of each effect that may be there the pair that is separated least."""
    least: dict[str, PairPower] = {}
    for t in powers:
        if t.effect not in least or t.then < least[t.effect].then:
            least[t.effect] = t
    return tuple(least.values())


def brief_plan(s: PlanSummary) -> str:
    """Say in two sentences what a plan costs and how good it is."""
    loads = numbers.names([load_name(name) for name in s.loads])
    certain = "" if s.efficiency is None else f" Efficiency {certified(s.efficiency)}."
    return (
        f"Plan: {s.readings} readings at {s.poses} poses and the reference, {loads}; takes about "
        f"{spoken(s.duration.total)}.{certain} --details shows the rest.\n"
    )


def poses_report(
    found: Next, poses: int, readings: int, details: bool = True
) -> Iterator[RenderableType]:
    """Yield what further poses tell of a misfit that depends on the pose alone.

    Args:
        found: the plan and the powers.
        poses: of the plan, beside the reference.
        readings: of the plan.
        details: all pairs, not the one of each suspect that is told least.
    """
    yield text.heading("Poses where nothing was read yet")
    yield (
        f"The misfit is the same under every load of a pose, so that loads tell nothing of it: "
        f"{readings} unloaded readings at {poses} poses, spread over the joints' range.\n"
    )
    if found.powers:
        out = text.table("if this is there", "and this is fitted", "now", "then", left=(0, 1))
        for row in power_rows(found.powers if details else weakest(found.powers)):
            out.add_row(*row)
        yield out
        yield Text(
            "now, then: chance that it passes every test of a missing effect, poses left out "
            "included, with the readings so far and with those planned as well.\n",
            style="dim",
        )


def power_rows(powers: Sequence[PairPower]) -> Iterator[tuple[str, str, str, str]]:
    """Yield the rows of `POWER_COLUMNS`."""
    for t in powers:
        then = "not in this cell" if t.not_separable else chance(t.then)
        yield t.effect, t.rival, chance(t.now), then


def chance(power: float) -> str:
    """Write a chance; no test is certain."""
    return "> 99 %" if power > 0.995 else numbers.percent(power)


def _at_least(power: float) -> str:
    """Write a lower bound of a chance, rounded down."""
    return f"{min(int(100 * power + 1e-9), 99)} %"


def summary(powers: Sequence[PairPower], poses: int, readings: int) -> str:
    """Say in a sentence what the plan will settle."""
    able = [t for t in powers if not t.not_separable]
    head = f"{readings} readings at {poses} poses"
    if not able:
        return f"{head} rule out none of the suspects."
    least = min(able, key=lambda t: t.then)
    if least.then < SURE:
        return (
            f"{head}: the weakest pair is {least.effect}, where it is there, and {least.rival}, "
            f"which they rule out with a chance of {chance(least.then)} ({chance(least.now)} now); "
            "more poses raise it."
        )
    if len(able) == len(powers):
        return (
            f"{head} separate the suspects: whichever is there, each of the others is ruled out "
            f"with a chance of at least {_at_least(least.then)}."
        )
    return (
        f"{head} separate what can be separated in this cell: each of these pairs with a chance of "
        f"at least {_at_least(least.then)}."
    )


def _difference(found: Next) -> str:
    """Say which loads and poses make the difference."""
    by = sorted(found.shares.items(), key=lambda pair: -pair[1])
    named = [
        f"{'the unloaded readings' if load == UNLOADED else load} ({numbers.percent(share)})"
        for load, share in by[:_MOST_LOADS]
        if share >= _LEAST_SHARE
    ]
    words = f"What separates the weakest pair comes from {numbers.names(named)}"
    if found.stretched > _STRETCHED:
        words += ", most of it with the arm stretched out"
    elif found.stretched < 1 / _STRETCHED:
        words += ", most of it with the arm drawn in"
    return f"{words}."
