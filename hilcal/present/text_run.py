"""The words that `check` and `run` print."""

from collections.abc import Iterator

from rich.console import RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from hilcal.measuring.connect import ConnectionResult
from hilcal.measuring.dry_run import DryRun


def spoken(seconds: float) -> str:
    """Return a duration for people: "45 s", "12 min", "3 h 05 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def check_report(
    answers: tuple[ConnectionResult, ...], dry: DryRun | None
) -> Iterator[RenderableType]:
    """Yield who answered, in which state, and every problem."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for head in ("device", "driver", "", "who answers, and what it says"):
        table.add_column(head, overflow="fold")
    for a in answers:
        bad = bool(a.problems)
        mark = Text("✗", style="red") if bad else Text("✓", style="green")
        name = "no answer" if a.report is None else a.report.name
        table.add_row(a.device, a.driver, mark, Text(name))
        if a.report is not None:
            for what, value in a.report.facts:
                table.add_row("", "", "", _hanging(f"{what}: {value}"))
        for problem in a.problems:
            table.add_row("", "", Text("!", style="red"), _hanging(problem))
    yield Padding(table, (1, 0))
    count = sum(len(a.problems) for a in answers)
    if count:
        yield f"{count} problem{'s' if count > 1 else ''}. Nothing was moved."
    else:
        yield "All devices are ready. Nothing was moved."
    if dry is not None:
        yield from _dry_report(dry)


def _hanging(words: str) -> RenderableType:
    """Return words whose further lines stand below the first, both moved in."""
    return Padding(Text(words), (0, 0, 0, 2))


def _dry_report(dry: DryRun) -> Iterator[RenderableType]:
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
