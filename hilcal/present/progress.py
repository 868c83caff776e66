"""Progress of what takes over a second: a spinner or a bar on a terminal, plain lines elsewhere."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


@contextmanager
def working(console: Console) -> Iterator[Say]:
    """Yield a function that shows what is being done now.

    On a terminal one line with a spinner and the time; otherwise one line each, with the
    seconds since the start.
    """
    begun = time.monotonic()
    if console.is_terminal:
        with console.status("") as status:
            yield lambda text: status.update(Text(f"{text} ..."), spinner="dots")
        return

    def say(text: str) -> None:
        seconds = f"[{time.monotonic() - begun:5.1f} s]"
        console.print(f"{seconds} {text}", markup=False, highlight=False, soft_wrap=True)

    yield say


@contextmanager
def counting(console: Console, what: str, total: int) -> Iterator[Advance]:
    """Yield a function that advances a bar; a line at the start and at the end elsewhere."""
    if not console.is_terminal:
        console.print(f"{what}: {total}", markup=False, highlight=False)
        yield lambda step: None
        return
    what_column = TextColumn("{task.description}", markup=False)
    columns = (what_column, BarColumn(), MofNCompleteColumn())
    times = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
    with Progress(*columns, *times, console=console, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda step: bar.advance(task, step)
