"""A campaign while it is measured: a bar on a terminal, one line per reading elsewhere."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
)
from rich.text import Text

from hilcal import numbers
from hilcal.measuring.progress import Answered, GoalMet, Phase, Question, ReadingStored, Remark
from hilcal.present.goal_words import met_words, status_words
from hilcal.present.text_run import spoken


@dataclass(slots=True)
class _Lines:
    """Tells everything line by line, with the seconds since the start."""

    console: Console
    begun: float = field(default_factory=time.monotonic)

    def notify(self, event: object) -> None:
        """Take note."""
        if isinstance(event, Phase):
            self._print(event.text)
        elif isinstance(event, Remark):
            self._print(f"note: {event.text}")
        elif isinstance(event, GoalMet):
            self._print(f"note: {met_words(event)}")
        elif isinstance(event, ReadingStored):
            left = f", {spoken(event.left_real)} left" if event.left_real > 0 else ""
            self._print(f"{event.done}/{event.total} {event.step}{figures(event)}{left}")

    def _print(self, words: str) -> None:
        seconds = f"[{time.monotonic() - self.begun:6.1f} s]"
        self.console.print(f"{seconds} {words}", markup=False, highlight=False, soft_wrap=True)


class _Bar:
    """Keeps two lines up to date; remarks scroll by above them.

    While somebody is asked a question they are gone, for their refresh would wipe it away.
    """

    def __init__(self, console: Console, total: int) -> None:
        """Show nothing before `begin`."""
        self._console = console
        self._total, self._done = total, 0
        self._fields: dict[str, Any] = {"left": "", "last": "", "phase": ""}
        self._shown: tuple[_TwoLines, TaskID] | None = None

    def begin(self) -> None:
        """Show the lines."""
        progress = _TwoLines(*_columns(), console=self._console, transient=True)
        task = progress.add_task("", total=self._total, completed=self._done, **self._fields)
        progress.start()
        self._shown = (progress, task)

    def end(self) -> None:
        """Take the lines away."""
        if self._shown is not None:
            self._shown[0].stop()
            self._shown = None

    def notify(self, event: object) -> None:
        """Take note."""
        if isinstance(event, Phase):
            self._update(phase=event.text)
        elif isinstance(event, Question):
            self.end()
            if self._done:
                words = f"{self._done} of {self._total} readings are stored"
                left = f", {self._fields['left']}" if self._fields["left"] else ""
                self._console.print(f"\n{words}{left}.", style="dim", markup=False)
        elif isinstance(event, Answered):
            self.begin()
        elif isinstance(event, Remark | GoalMet):
            text = event.text if isinstance(event, Remark) else met_words(event)
            self._console.print(f"note: {text}", markup=False, highlight=False)
        elif isinstance(event, ReadingStored):
            self._done = event.done
            left = f"{spoken(event.left_real)} left" if event.left_real > 0 else ""
            self._update(left=left, last=f"{event.step}{figures(event)}")

    def _update(self, **fields: str) -> None:
        self._fields |= fields
        if self._shown is not None:
            progress, task = self._shown
            progress.update(task, completed=self._done, **self._fields)


class _TwoLines(Progress):
    """The bar with what goes on, and below it the last reading: both fit 80 columns."""

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the lines."""
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            yield Text(task.fields["last"], no_wrap=True, overflow="ellipsis")


@contextmanager
def watching(console: Console, total: int) -> Iterator[_Lines | _Bar]:
    """Yield a watcher that shows a campaign of so many readings."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    bar = _Bar(console, total)
    bar.begin()
    try:
        yield bar
    finally:
        bar.end()


def _columns() -> tuple[ProgressColumn, ...]:
    return (
        BarColumn(bar_width=20),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}", style="bold", markup=False),
        TextColumn("{task.fields[phase]}", style="dim", markup=False),
    )


def figures(event: ReadingStored) -> str:
    """Return deflection and residual of a reading for people.

    A deflection from a predicted unloaded position is marked by ≈.
    """
    parts = []
    live = event.live
    if event.deflection is not None:
        parts.append(f"deflection {numbers.length(event.deflection)}")
    elif live.deflection is not None:
        value, std, unit = numbers.measured("m", live.deflection, live.deflection_std)
        parts.append(f"deflection ≈ {value} ± {std} {unit}")
    if live.residual is not None:
        sigma = "" if live.sigma is None else f"{live.sigma:.1f} σ"
        words = ", ".join(w for w in (sigma, "few readings yet" if live.uncertain else "") if w)
        parts.append(f"residual {numbers.length(live.residual)}" + (f" ({words})" * bool(words)))
    if event.goal is not None and (words := status_words(event.goal)):
        parts.append(words)
    return f": {', '.join(parts)}" if parts else ""
