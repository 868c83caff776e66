"""The preview of an import in words and tables."""

from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.padding import Padding

from hilcal.present.text import heading, table
from hilcal.tables.guessing.proposal import Proposal

WIDEST = 34
"""Characters of a cell before it is shortened."""
LISTED = 12
"""Unused columns that are listed; the rest are counted."""


def preview(proposal: Proposal, rows: int, source: str) -> Iterator[RenderableType]:
    """Yield what was understood, what is unsure and what was not used.

    Args:
        proposal: the mapping in the making.
        rows: of the table.
        source: the file's name.
    """
    yield heading(f"{source}: {rows} rows")
    file = proposal.sections.get("file", {})
    if file:
        yield "  " + ", ".join(f"{key} = {value!r}" for key, value in file.items())
    if proposal.understood:
        out = table("what", "columns", "meaning", "first row", left=(0, 1, 2, 3))
        for u in proposal.understood:
            out.add_row(u.what, _short(u.columns), u.meaning, _short(u.example))
        yield out
    yield from _sentences("missing:", proposal.lacking)
    yield from _sentences("unsure:", [f"{what}: {words}" for what, words in proposal.unsure])
    unused = [f"{name} ({why})" for name, why in proposal.unused]
    if len(unused) > LISTED:
        unused = [*unused[:LISTED], f"and {len(unused) - LISTED} more"]
    if unused:
        yield heading("not used:")
        yield Padding(", ".join(unused), (0, 0, 0, 2))


def _sentences(title: str, sentences: Sequence[str]) -> Iterator[RenderableType]:
    if sentences:
        yield heading(title)
    for sentence in sentences:
        yield Padding(sentence, (0, 0, 0, 2))


def _short(cells: Sequence[str]) -> str:
    """First and last of several names or values, cut to a width."""
    words = ", ".join(cells) if len(cells) <= 3 else f"{cells[0]}, {cells[1]} … {cells[-1]}"
    return words if len(words) <= WIDEST else words[: WIDEST - 1] + "…"
