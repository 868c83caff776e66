"""Progress of what takes over a second, and of a campaign that is measured: bars, plain lines."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import isfinite
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment
from rich.text import Text

from hilcal import numbers
from hilcal.design.goal import parse_goal
from hilcal.measuring.progress import (
    Answered,
    GoalMet,
    GoalStatus,
    Phase,
    Question,
    ReadingStored,
    Remark,
    Watcher,
)
from hilcal.names import escaped

Say = Callable[[str], None]
Advance = Callable[[int], None]


class SafeConsole(Console):
    """A console on which no text moves the cursor, changes colours or turns its direction."""

    def render_str(self, text: str, **how: Any) -> Text:
        """Return a text as it is printed, so that tables have room for it."""
        return super().render_str("\n".join(map(escaped, text.split("\n"))), **how)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """Yield what is printed; ends of lines stay."""
        for part in super().render(renderable, options):
            lines = part.text.split("\n")
            text = part.text if part.control else "\n".join(map(escaped, lines))
            yield Segment(text, part.style, part.control)


def _line(console: Console, since: float, text: str, width: int = 5) -> None:
    """Print a line with the seconds since a time."""
    seconds = f"[{time.monotonic() - since:{width}.1f} s]"
    console.print(f"{seconds} {text}", markup=False, highlight=False, soft_wrap=True)


@contextmanager
def working(console: Console) -> Iterator[Say]:
    """Yield what shows what is being done: a spinner on a terminal, else a line each."""
    begun = time.monotonic()
    if console.is_terminal:
        with console.status("") as status:
            yield lambda text: status.update(Text(f"{text} ..."), spinner="dots")
    else:
        yield lambda text: _line(console, begun, text)


@contextmanager
def counting(console: Console, what: str, total: int) -> Iterator[Advance]:
    """Yield a function that advances a bar; a line at the start elsewhere than on a terminal."""
    if not console.is_terminal:
        console.print(f"{what}: {total}", markup=False, highlight=False)
        yield lambda step: None
        return
    name = TextColumn("{task.description}", markup=False)
    times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    columns = (name, BarColumn(), MofNCompleteColumn(), *times)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda step: bar.advance(task, step)


def spoken(seconds: float) -> str:
    """Return a duration for people: "45 s", "12 min", "3 h 05 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def status_words(status: GoalStatus) -> str:
    """Return the present value, e.g. "joint std 4.1 % (j6)"; empty while it is not known."""
    if status.worst is None or status.std is None or status.unit is None:
        return ""
    goal, known = parse_goal(status.text), isfinite(status.std)
    if goal.of_position:
        kind = "deflection" if "predicted deflection" in status.quantity else "position"
        return f"predicted {kind} {f'± {_value(status)}' if known else 'not determined yet'}"
    match = re.match(r"[\w.]+", status.text.strip())
    what = "" if match is None else match[0]
    which = "" if status.worst in (what, goal.what) else f" ({status.worst.split('.')[-1]})"
    return f"{what} std {_value(status) if known else 'not determined yet'}{which}"


def full_words(status: GoalStatus) -> str:
    """Return in full what is judged and its value, e.g. "standard uncertainty of X: 4.1 µm"."""
    if not status.quantity:
        return status_words(status)
    if status.std is None or not isfinite(status.std):
        return f"{status.quantity}: not determined by these readings"
    return f"{status.quantity}: {_value(status)}{' of its value' * (status.unit == '%')}"


def _value(status: GoalStatus) -> str:
    if status.std is None or status.unit is None:
        return ""
    if status.unit == "%":
        return f"{numbers.digits(status.std, 2)} %"
    unit, factor = numbers.unit_for(status.unit, (status.std,))
    return f"{numbers.digits(factor * status.std, 2)} {unit}"


def met_words(event: GoalMet) -> str:
    """Return in one line that the goal is met."""
    count = f"after {event.readings} of {event.planned} readings"
    return f"goal met {count}: {full_words(event.status)}"


def missed_words(status: GoalStatus, count: int) -> str:
    """Return in one line by how much the goal was missed after so many readings."""
    head = f'goal "{status.text}" is not met after all {count} readings'
    if not status.quantity:
        return f"{head}: the model cannot be fitted to them"
    words = f"{head}: {full_words(status)}"
    if status.ratio is None or not isfinite(status.ratio):
        return words
    if status.ratio <= 1.0:
        return f"{words}, but the fit did not converge"
    return f"{words}, {status.ratio:.2g} times what is asked for"


class _TwoLines(Progress):
    """The bar with what goes on, and below it the last reading: both fit 80 columns."""

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the lines."""
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            yield Text(task.fields["last"], no_wrap=True, overflow="ellipsis")


class _Watcher:
    """Keeps two lines up to date on a terminal, notes scroll by above them; else a line for each.

    While somebody is asked a question the two are gone, for their refresh would wipe it away.
    `also` is told everything as well.
    """

    def __init__(self, console: Console, total: int, also: Watcher | None) -> None:
        self.console, self.begun, self._also = console, time.monotonic(), also
        self._now: dict[str, Any] = {"left": "", "last": "", "phase": "", "done": 0, "total": total}
        self._shown: _TwoLines | None = None

    def begin(self) -> None:
        """Show the lines, on a terminal."""
        if not self.console.is_terminal:
            return
        columns = (
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TextColumn("{task.fields[left]}", style="bold", markup=False),
            TextColumn("{task.fields[phase]}", style="dim", markup=False),
        )
        self._shown = _TwoLines(*columns, console=self.console, transient=True)
        self._shown.add_task("", completed=self._now["done"], **self._now)
        self._shown.start()

    def end(self) -> None:
        """Take the lines away."""
        if self._shown is not None:
            self._shown.stop()
            self._shown = None

    def notify(self, event: object) -> None:
        """Take note."""
        if self._also is not None:
            self._also.notify(event)
        if isinstance(event, Question):
            self.end()
            if self.console.is_terminal and self._now["done"]:
                left = f", {self._now['left']}" if self._now["left"] else ""
                words = f"\n{self._now['done']} of {self._now['total']} readings are stored{left}."
                self.console.print(words, style="dim", markup=False)
        elif isinstance(event, Answered):
            self.begin()
        elif isinstance(event, Remark | GoalMet):
            text = f"note: {event.text if isinstance(event, Remark) else met_words(event)}"
            if self.console.is_terminal:
                self.console.print(text, markup=False, highlight=False)
            else:
                _line(self.console, self.begun, text, width=6)
        elif isinstance(event, Phase):
            self._tell(event.text, phase=event.text)
        elif isinstance(event, ReadingStored):
            left = f"{spoken(event.left_real)} left" if event.left_real > 0 else ""
            last = f"{event.step}{figures(event)}"
            words = f"{event.done}/{event.total} {last}{', ' * bool(left)}{left}"
            self._tell(words, left=left, last=last, done=event.done, total=event.total)

    def _tell(self, words: str, **what: Any) -> None:
        self._now |= what
        if self._shown is not None:
            task = self._shown.task_ids[0]
            self._shown.update(task, completed=self._now["done"], **self._now)
        elif not self.console.is_terminal:
            _line(self.console, self.begun, words, width=6)


@contextmanager
def watching(console: Console, total: int, also: Watcher | None = None) -> Iterator[_Watcher]:
    """Yield a watcher that shows a campaign of so many readings, and tells another one."""
    watcher = _Watcher(console, total, also)
    watcher.begin()
    try:
        yield watcher
    finally:
        watcher.end()


def figures(event: ReadingStored) -> str:
    """Return deflection (≈: from a predicted unloaded position) and residual of a reading."""
    parts, live = [], event.live
    if event.deflection is not None:
        parts.append(f"deflection {numbers.length(event.deflection)}")
    elif live.deflection is not None:
        value, std, unit = numbers.measured("m", live.deflection, live.deflection_std)
        parts.append(f"deflection ≈ {value} ± {std} {unit}")
    if live.residual is not None:
        sigma = "" if live.sigma is None else f"{live.sigma:.1f} σ"
        words = ", ".join(w for w in (sigma, "few readings yet" * live.uncertain) if w)
        parts.append(f"residual {numbers.length(live.residual)}" + (f" ({words})" * bool(words)))
    if event.goal is not None and (words := status_words(event.goal)):
        parts.append(words)
    return f": {', '.join(parts)}" if parts else ""
