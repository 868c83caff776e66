"""A campaign while it is measured: who answers, each reading, the goal."""

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from math import isfinite
from typing import TYPE_CHECKING, Any

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
)
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
)
from hilcal.present.document import Block, table

if TYPE_CHECKING:
    from hilcal.measuring.connect import ConnectionResult
    from hilcal.measuring.route import DryRun
    from hilcal.transfer.factory import FactoryCheck


def spoken(seconds: float) -> str:
    """Return a duration for people: "45 s", "12 min", "3 h 05 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def check_report(answers: "tuple[ConnectionResult, ...]", dry: "DryRun | None") -> Iterator[Block]:
    """Yield who answered, in which state, and every problem."""
    out = table("device", "driver", "", "who answers, and what it says", left=(0, 1, 2, 3))
    for a in answers:
        name, facts = ("no answer", ()) if a.report is None else (a.report.name, a.report.facts)
        out.add(a.device, a.driver, "✗" if a.problems else "✓", name)
        for what, value in facts:
            out.add("", "", "", f"{what}: {value}")
        for problem in a.problems:
            out.add("", "", "!", problem)
    if answers:
        yield from ("", out, "")
    count = sum(len(a.problems) for a in answers)
    if not answers:
        yield "The cell does not name all its devices: none was asked. Nothing was moved."
    elif count:
        yield f"{count} problem{'s' if count > 1 else ''}. Nothing was moved."
    else:
        yield "All devices are ready. Nothing was moved."
    if dry is not None:
        yield from _dry_report(dry)


def factory_words(found: "FactoryCheck") -> Iterator[Block]:
    """Yield whether an arm is still what its factory measured, and how well that is known."""
    moved, std = numbers.length(found.moved_m), numbers.length(found.moved_std_m)
    yield ""
    if found.changed:
        yield (
            "The arm is no longer what its factory measured: its geometry has changed "
            f"(p = {found.p_value:.1g}), which moves the target by {moved} (rms, ± {std})."
        )
    else:
        yield (
            "The arm is what its factory measured, as far as these readings tell "
            f"(p = {found.p_value:.2g}): what they leave of its geometry moves the target by "
            f"{moved} (rms, ± {std})."
        )
    yield (
        f"From the factory's kinematics {found.readings} readings are "
        f"{numbers.length(found.factory_m)} off (rms, the arm's own weight in it), from the "
        f"maker's nominal ones {numbers.length(found.nominal_m)}; "
        f"their noise is {numbers.length(found.noise_m)}."
    )


def _dry_report(dry: "DryRun") -> Iterator[Block]:
    if dry.problems:
        yield f"The plan cannot be run ({len(dry.problems)}):"
        for problem in dry.problems:
            yield f"  {problem}"
    else:
        yield (
            f"The plan keeps every limit: {dry.motions} motions, {dry.load_changes} load changes, "
            f"about {spoken(dry.duration)}."
        )
    for remark in dry.remarks:
        yield f"note: {remark}"


def status_words(status: GoalStatus) -> str:
    """Return the present value, e.g. "joint std 4.1 % (j6)"; empty while it is not known."""
    if status.worst is None or status.std is None or status.unit is None:
        return ""
    goal = parse_goal(status.text)
    if goal.of_position:
        what = f"predicted {_kind(status)}"
        return f"{what} not determined yet" if _open(status) else f"{what} ± {_value(status)}"
    match = re.match(r"[\w.]+", status.text.strip())
    what = "" if match is None else match[0]
    same = status.worst in (what, goal.what)
    which = "" if same else f" ({status.worst.split('.')[-1]})"
    if _open(status):
        return f"{what} std not determined yet{which}"
    return f"{what} std {_value(status)}{which}"


def full_words(status: GoalStatus) -> str:
    """Return in full what is judged and its value, e.g. "standard uncertainty of X: 4.1 µm"."""
    if not status.quantity:
        return status_words(status)
    if _open(status):
        return f"{status.quantity}: not determined by these readings"
    return f"{status.quantity}: {_value(status)}{' of its value' * (status.unit == '%')}"


def _open(status: GoalStatus) -> bool:
    """Whether the readings do not determine the quantity."""
    return status.std is None or not isfinite(status.std)


def _kind(status: GoalStatus) -> str:
    """Return whether deflections or positions are predicted."""
    return "deflection" if "predicted deflection" in status.quantity else "position"


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


class _Watcher:
    """Tells a campaign line by line, with the seconds since the start; see `_Bar`."""

    def __init__(self, console: Console) -> None:
        """Begin to count the seconds."""
        self.console, self.begun = console, time.monotonic()

    def notify(self, event: object) -> None:
        """Take note."""
        if isinstance(event, Phase):
            self.tell(phase=event.text)
        elif isinstance(event, Remark | GoalMet):
            self.tell(note=f"note: {event.text if isinstance(event, Remark) else met_words(event)}")
        elif isinstance(event, ReadingStored):
            left = f"{spoken(event.left_real)} left" if event.left_real > 0 else ""
            reading = f"{event.step}{figures(event)}"
            self.tell(left=left, last=reading, done=event.done, total=event.total)

    def tell(self, **what: Any) -> None:
        """Print what goes on, what is to be noted, or the last reading."""
        words = what.get("phase") or what.get("note") or "{done}/{total} {last}".format(**what)
        left = f", {what['left']}" if what.get("left") else ""
        seconds = f"[{time.monotonic() - self.begun:6.1f} s]"
        line = f"{seconds} {words}{left}"
        self.console.print(line, markup=False, highlight=False, soft_wrap=True)


class _Bar(_Watcher):
    """Keeps two lines up to date on a terminal; notes scroll by above them.

    While somebody is asked a question they are gone, for their refresh would wipe it away.
    """

    def __init__(self, console: Console, total: int) -> None:
        """Show nothing before `begin`."""
        super().__init__(console)
        self._now: dict[str, Any] = {"left": "", "last": "", "phase": "", "done": 0, "total": total}
        self._shown: tuple[_TwoLines, TaskID] | None = None

    def begin(self) -> None:
        """Show the lines."""
        columns = (
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TextColumn("{task.fields[left]}", style="bold", markup=False),
            TextColumn("{task.fields[phase]}", style="dim", markup=False),
        )
        progress = _TwoLines(*columns, console=self.console, transient=True)
        task = progress.add_task("", completed=self._now["done"], **self._now)
        progress.start()
        self._shown = (progress, task)

    def end(self) -> None:
        """Take the lines away."""
        if self._shown is not None:
            self._shown[0].stop()
            self._shown = None

    def notify(self, event: object) -> None:
        """Take note."""
        if isinstance(event, Question):
            self.end()
            if self._now["done"]:
                left = f", {self._now['left']}" if self._now["left"] else ""
                words = f"\n{self._now['done']} of {self._now['total']} readings are stored{left}."
                self.console.print(words, style="dim", markup=False)
        elif isinstance(event, Answered):
            self.begin()
        else:
            super().notify(event)

    def tell(self, **what: Any) -> None:
        """Show what goes on and the last reading; print what is to be noted."""
        if "note" in what:
            self.console.print(what["note"], markup=False, highlight=False)
            return
        self._now |= what
        if self._shown is not None:
            progress, task = self._shown
            progress.update(task, completed=self._now["done"], **self._now)


class _TwoLines(Progress):
    """The bar with what goes on, and below it the last reading: both fit 80 columns."""

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the lines."""
        yield self.make_tasks_table(self.tasks)
        for task in self.tasks:
            yield Text(task.fields["last"], no_wrap=True, overflow="ellipsis")


@contextmanager
def watching(console: Console, total: int) -> Iterator[_Watcher]:
    """Yield a watcher that shows a campaign of so many readings."""
    if not console.is_terminal:
        yield _Watcher(console)
        return
    bar = _Bar(console, total)
    bar.begin()
    try:
        yield bar
    finally:
        bar.end()


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
