"""What `plan` says of a plan: what it costs, what it promises, and how near it is to the best."""

import math
from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from hilcal.data.plan import UNLOADED
from hilcal.plan.story import Bought, Enough, OrderStory, PlanStory, Promised, Seen
from hilcal.report import numbers, text
from hilcal.report.text_run import spoken

CRITERIA = {
    "D": "all parameters together (the volume of their confidence region)",
    "A": "the mean variance of the parameters",
    "E": "the combination of parameters that is known worst",
    "K": "the condition number of the model alone, without power against what is missing",
    "test": "the position where the robot will work",
    "separate": "telling the leading suspects apart",
}
BAR = 30
LIKE = 1.1
"""A number of poses is enough where the last of the curve is not better by more than this."""


def story_report(story: PlanStory) -> Iterator[RenderableType]:
    """Yield all that people want to know of a plan."""
    yield text.heading("Plan")
    yield Padding(_summary(story), (0, 0, 1, 0))
    if story.order is not None:
        yield f"{order_remark(story.order)}\n"
    if story.predicted:
        yield from _predicted(story.predicted)
    if story.bought:
        yield from _bought(story.bought, story.criterion)
    if story.curve:
        yield from _curve(story.curve, story.poses)
    if story.seen:
        yield from _seen(story.seen)
    for remark in story.remarks:
        yield f"note: {remark}"


def certified(efficiency: float) -> str:
    """Return a certified efficiency in words; rounded down, it is a bound."""
    return f"at least {_floor(efficiency)} of the best possible"


def _floor(efficiency: float) -> str:
    return f"{int(min(max(efficiency, 0.0), 1.0) * 1000 + 1e-6) / 10:.1f} %"


def _summary(story: PlanStory) -> RenderableType:
    rows = Table.grid(padding=(0, 2))
    rows.add_column(no_wrap=True)
    rows.add_column(overflow="fold")
    rows.add_row("poses", f"{story.poses} and the reference")
    loads = ", ".join(
        f"{'unloaded' if name == UNLOADED else name} {count}" for name, count in story.loads.items()
    )
    rows.add_row("readings", f"{story.readings}: {loads}")
    whole = story.motion_s + story.readings_s + story.load_changes_s
    changes = f"{story.load_changes} load change{'s' if story.load_changes != 1 else ''}"
    rows.add_row("takes about", spoken(whole))
    rows.add_row(
        "",
        f"motion {spoken(story.motion_s)}, readings {spoken(story.readings_s)}, "
        f"{changes} by hand {spoken(story.load_changes_s)}",
    )
    meaning = CRITERIA.get(story.criterion)
    rows.add_row("made for", f"{story.criterion}: {meaning}" if meaning else story.criterion)
    if story.efficiency is not None:
        rows.add_row("certified", Text(certified(story.efficiency), style="bold"))
    if story.position_std_m is not None:
        where = f"± {numbers.length(story.position_std_m)}, predicted where the robot will work"
        rows.add_row("position", where)
    return rows


def order_remark(order: OrderStory) -> str:
    """Say in sentences what the order costs and what a drift does."""
    mixed = order.longer >= 5e-4
    said = (
        f"The order is mixed, so that drift does not look like joints or loads, and takes "
        f"{100 * order.longer:.1f} % longer than the shortest one. "
        if mixed
        else "The order is the shortest one. "
    )
    said += (
        "A fit that estimates a drift as well loses up to about "
        f"{_share(order.lost)} of what it knows of a parameter"
    )
    if mixed:
        said += f" ({_share(order.lost_shortest)} in the shortest order)"
    mean = abs(order.bias_m)
    said += (
        f". Left out of the fit, {numbers.digits(3.6e9 * order.drift, 2)} µm/h would shift "
        f"deflections by {numbers.length(order.error_m)} rms and "
        f"{numbers.length(mean) if mean >= 1e-7 else 'less than 0.1 µm'} on average"
    )
    if order.told is not None:
        rate = numbers.digits(3.6e9 * order.told, 2)
        said += f"; the returns to the reference pose tell a drift to ± {rate} µm/h"
    return f"{said}."


def _share(share: float) -> str:
    """Round up to whole percent."""
    return f"{max(1, math.ceil(100 * share - 1e-6))} %"


def _predicted(promised: Sequence[Promised]) -> Iterator[RenderableType]:
    yield text.heading("Predicted standard uncertainty")
    out = text.table("parameter", "±", "of about", "unit", "± in %", left=(0, 3))
    for effect in dict.fromkeys(p.name.split(".")[0] for p in promised):
        mine = [p for p in promised if p.name.split(".")[0] == effect]
        for p in mine:
            alike = [o for o in mine if o.unit == p.unit]
            sizes = [o.std if o.value is None else o.value for o in alike]
            unit, factor = numbers.unit_for(p.unit, sizes)
            about = share = ""
            if p.value is not None:
                about = numbers.digits(factor * p.value)
                share = f"{numbers.digits(100 * p.std / abs(p.value), 2)} %" if p.value else ""
            out.add_row(p.name, numbers.digits(factor * p.std, 2), about, unit, share)
    yield out
    yield Text("of about: what is known so far, else an ordinary magnitude.\n", style="dim")


def _bought(rows: Sequence[Bought], own: str) -> Iterator[RenderableType]:
    yield text.heading("What each criterion buys, for the same number of readings")
    out = text.table(
        "criterion", "position ±", "open ±", "joint ±", "O1 (D)", "O2 (K)", "O3 (E)",
        "certified", left=(0,),
    )  # fmt: skip
    for b in rows:
        mine = b.criterion == own
        out.add_row(
            f"{b.criterion} (this)" if mine else b.criterion,
            "-" if b.position_std_m is None else numbers.length(b.position_std_m),
            "-" if b.position_open_m is None else numbers.length(b.position_open_m),
            "-" if b.joint_share is None else f"{numbers.digits(100 * b.joint_share, 2)} %",
            numbers.digits(b.o1),
            numbers.digits(b.o2, 2),
            numbers.digits(b.o3),
            "-" if b.efficiency is None else f"≥ {_floor(b.efficiency)}",
            style="bold" if mine else "",
        )
    yield out
    yield Text(
        "position: where the robot will work; open: the same where the effects below may be there "
        "and are fitted too. joint: the worst joint's compliance. O1 to O3: observability indices, "
        "larger is better; O1 and O3 with these effects unknown as well. certified: share of the "
        "best possible by its own criterion.\n",
        style="dim",
    )


def _curve(curve: Sequence[Enough], poses: int) -> Iterator[RenderableType]:
    yield text.heading("How many poses are enough")
    out = text.table("poses", "position ±", "", left=(2,))
    top = max(point.position_std_m for point in curve)
    for point in curve:
        size = max(1, round(BAR * point.position_std_m / top)) if top > 0 else 1
        bar = Text("█" * size, style="cyan")
        if point.poses == poses:
            bar.append("  this plan", style="bold")
        out.add_row(str(point.poses), numbers.length(point.position_std_m), bar)
    yield out
    yield f"{enough(curve)}\n"


def enough(curve: Sequence[Enough]) -> str:
    """Say from which number of poses on more of them change little."""
    last = curve[-1]
    first = next(p for p in curve if p.position_std_m <= LIKE * last.position_std_m)
    if first is last:
        return f"More than {last.poses} poses would still help."
    gain = 1.0 - last.position_std_m / first.position_std_m
    return f"From {first.poses} to {last.poses} poses the position gains {100 * gain:.0f} % only."


def _seen(seen: Sequence[Seen]) -> Iterator[RenderableType]:
    yield text.heading("Effects that are not in the model, and would be seen")
    out = text.table("effect", "from")
    told = sorted((s for s in seen if s.least_m is not None), key=lambda s: s.least_m or 0.0)
    for s in told:
        out.add_row(s.effect, numbers.length(s.least_m or 0.0))
    if out.row_count:
        yield out
        yield Text(
            "from: rms displacement of the target that is one sigma of these readings.\n",
            style="dim",
        )
    if hidden := [s.effect for s in seen if s.least_m is None]:
        yield f"These readings cannot show {numbers.names(hidden, 'or')}.\n"
