"""The words of `doctor`."""

from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from hilcal.doctor.finding import Finding

MARKS = {"ok": ("✓", "green"), "warning": ("!", "yellow"), "problem": ("✗", "red")}


def doctor_report(findings: Sequence[Finding]) -> Iterator[RenderableType]:
    """Yield everything that was looked at, by topic, and how it is mended."""
    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), show_header=False)
    table.add_column("")
    table.add_column("", overflow="fold")
    topic = ""
    for f in findings:
        if f.topic != topic:
            topic = f.topic
            table.add_row("", Text(topic, style="bold"))
        mark, style = MARKS[f.state]
        table.add_row(Text(mark, style=style), Text(f"{f.name}: {f.said}"))
        if f.mend:
            table.add_row("", Padding(Text(f"→ {f.mend}"), (0, 0, 0, 2)))
    yield Padding(table, (1, 0))
    yield summary(findings)


def summary(findings: Sequence[Finding]) -> str:
    """Return the outcome in a line."""
    problems = [f.name for f in findings if f.state == "problem"]
    warnings = sum(f.state == "warning" for f in findings)
    more = f"; {warnings} warning{'s' if warnings != 1 else ''}, marked !" if warnings else ""
    if problems:
        return f"{len(problems)} of {len(findings)} hinder a campaign: {', '.join(problems)}{more}"
    return f"Nothing hinders a campaign{more}."
