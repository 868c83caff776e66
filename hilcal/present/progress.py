"""Progress of long computations and of running campaigns, as bars or plain lines."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import isfinite
from typing import Any, Self

from rich import progress as bars
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from hilcal import numbers
from hilcal.design.goal import parse_goal
from hilcal.measuring import progress as events
from hilcal.names import escaped

Say = Callable[[str], None]
Advance = Callable[[int], None]


class SafeConsole(Console):
    """A console that escapes control characters: no text moves the cursor or changes colours."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text with its control characters escaped, for the widths of tables."""
        return super().render_str("\n".join(map(escaped, text.split("\n"))), **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Yield segments with their control characters escaped, except line breaks."""
        for part in super().render(renderable, options):
            lines = part.text.split("\n")
            text = part.text if part.control else "\n".join(map(escaped, lines))
            yield Segment(text, part.style, part.control)


def _line(console: Console, since: float, text: str, width: int = 5) -> None:
    seconds = f"[{time.monotonic() - since:{width}.1f} s]"
    console.print(f"{seconds} {text}", markup=False, highlight=False, soft_wrap=True)


@contextmanager
def working(console: Console) -> Iterator[Say]:
    """Yield a function that shows the current step: by a spinner on a terminal, else by a line."""
    start = time.monotonic()
    if console.is_terminal:
        with console.status("") as status:
            yield lambda text: status.update(Text(f"{text} ..."), spinner="dots")
    else:
        yield lambda text: _line(console, start, text)


@contextmanager
def counting(console: Console, task_name: str, total: int) -> Iterator[Advance]:
    """Yield a function that advances a bar on a terminal; elsewhere print one line at the start."""
    if not console.is_terminal:
        console.print(f"{task_name}: {total}", markup=False, highlight=False)
        yield lambda step: None
        return
    name = bars.TextColumn("{task.description}", markup=False)
    times = (bars.TimeElapsedColumn(), bars.TextColumn("left"), bars.TimeRemainingColumn())
    columns = (name, bars.BarColumn(), bars.MofNCompleteColumn(), *times)
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(task_name, total=total)
        yield lambda step: bar.advance(task, step)


def duration_text(seconds: float) -> str:
    """Return a duration in display units: "45 s", "12 min", "3 h 05 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def status_words(status: events.GoalStatus) -> str:
    """Return the current value of a goal, e.g. "joint std 4.1 % (j6)"; empty while unknown."""
    if status.worst is None or status.std is None or status.unit is None:
        return ""
    goal = parse_goal(status.text)
    value = _value(status) if isfinite(status.std) else ""
    if goal.of_position:
        kind = "deflection" if "predicted deflection" in status.quantity else "position"
        return f"predicted {kind} {f'± {value}' if value else 'not determined yet'}"
    match = re.match(r"[\w.]+", status.text.strip())
    name = "" if match is None else match[0]
    worst = "" if status.worst in (name, goal.quantity) else f" ({status.worst.split('.')[-1]})"
    return f"{name} std {value or 'not determined yet'}{worst}"


def full_words(status: events.GoalStatus) -> str:
    """Return the judged quantity and its value, e.g. "standard uncertainty of X: 4.1 µm"."""
    if not status.quantity:
        return status_words(status)
    if status.std is None or not isfinite(status.std):
        return f"{status.quantity}: not determined by these readings"
    return f"{status.quantity}: {_value(status)}{' of its value' * (status.unit == '%')}"


def _value(status: events.GoalStatus) -> str:
    if status.std is None or status.unit is None:
        return ""
    unit, factor = numbers.unit_for(status.unit, (status.std,))
    return f"{numbers.digits(factor * status.std, 2)} {unit}"


def met_words(event: events.GoalMet) -> str:
    """Return a line that states that the goal is met."""
    count = f"after {event.readings} of {event.planned} readings"
    return f"goal met {count}: {full_words(event.status)}"


def missed_words(status: events.GoalStatus, count: int) -> str:
    """Return a line that states by how much the goal is missed after `count` readings."""
    line = f'goal "{status.text}" is not met after all {count} readings'
    if not status.quantity:
        return f"{line}: the model cannot be fitted to them"
    line += f": {full_words(status)}"
    if status.ratio is None or not isfinite(status.ratio):
        return line
    missed = f"{status.ratio:.2g} times the goal"
    return f"{line}, {missed if status.ratio > 1.0 else 'but the fit did not converge'}"


class _TwoLines(bars.Progress):
    """A bar with the current phase, and below it the last reading; both fit 80 columns."""

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the two lines."""
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            yield Text(task.fields["last"], no_wrap=True, overflow="ellipsis")


class CampaignProgress:
    """Shows two live lines on a terminal, with notes above them; elsewhere prints a line per event.

    The live lines are there as long as the `with` block lasts, but disappear during a question,
    since their refresh would erase it. `also` gets every event, too.
    """

    def __init__(
        self, console: Console, total: int, also: events.Watcher | None = None, stored: int = 0
    ) -> None:
        """Watch a campaign of `total` readings; previous sessions have measured `stored` steps."""
        self.console, self._start, self._also = console, time.monotonic(), also
        self._fields: dict[str, Any] = {"left": "", "last": "", "phase": "", "done": stored}
        self._fields["total"] = total
        self._shown: _TwoLines | None = None

    def __enter__(self) -> Self:
        self._begin()
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def _begin(self) -> None:
        if not self.console.is_terminal:
            return
        columns = (
            bars.BarColumn(bar_width=20),
            bars.MofNCompleteColumn(),
            bars.TextColumn("{task.fields[left]}", style="bold", markup=False),
            bars.TextColumn("{task.fields[phase]}", style="dim", markup=False),
        )
        self._shown = _TwoLines(*columns, console=self.console, transient=True)
        self._shown.add_task("", completed=self._fields["done"], **self._fields)
        self._shown.start()

    def _end(self) -> None:
        if self._shown is not None:
            self._shown.stop()
            self._shown = None

    def notify(self, event: object) -> None:
        """Show an event of `measuring.progress`."""
        if self._also is not None:
            self._also.notify(event)
        if isinstance(event, events.Question):
            self._end()
            if self.console.is_terminal and self._fields["done"]:
                left, done, total = (self._fields[key] for key in ("left", "done", "total"))
                text = f"\n{done} of {total} readings are stored{', ' * bool(left)}{left}."
                self.console.print(text, style="dim", markup=False)
        elif isinstance(event, events.Answered):
            self._begin()
        elif isinstance(event, events.Remark | events.GoalMet):
            text = f"note: {event.text if isinstance(event, events.Remark) else met_words(event)}"
            if self.console.is_terminal:
                self.console.print(text, markup=False, highlight=False)
            else:
                _line(self.console, self._start, text, width=6)
        elif isinstance(event, events.Phase):
            self._update(event.text, phase=event.text)
        elif isinstance(event, events.ReadingStored):
            left = f"{duration_text(event.remaining_s)} left" if event.remaining_s > 0 else ""
            last = f"{event.step}{reading_text(event)}"
            text = f"{event.stored}/{event.total} {last}{', ' * bool(left)}{left}"
            self._update(text, left=left, last=last, done=event.stored, total=event.total)

    def _update(self, text: str, **fields: Any) -> None:
        self._fields |= fields
        if self._shown is not None:
            task = self._shown.task_ids[0]
            self._shown.update(task, completed=self._fields["done"], **self._fields)
        elif not self.console.is_terminal:
            _line(self.console, self._start, text, width=6)


def reading_text(event: events.ReadingStored) -> str:
    """Return deflection (≈: from a predicted unloaded position) and residual of a reading."""
    parts, live = [], event.live
    if event.deflection is not None:
        parts.append(f"deflection {numbers.length(event.deflection)}")
    elif live.deflection is not None:
        value, std, unit = numbers.measured("m", live.deflection, live.deflection_std)
        parts.append(f"deflection ≈ {value} ± {std} {unit}")
    if live.residual is not None:
        sigma = "" if live.sigma is None else f"{live.sigma:.1f} σ"
        remark = ", ".join(filter(None, (sigma, "few readings yet" * live.uncertain)))
        parts.append(f"residual {numbers.length(live.residual)}" + (f" ({remark})" * bool(remark)))
    if event.goal is not None and (goal := status_words(event.goal)):
        parts.append(goal)
    return f": {', '.join(parts)}" if parts else ""
