"""What a page consists of: sections of words, tables, lists and charts; no markup in any of it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import plotly.graph_objects as go
from rich.console import RenderableType
from rich.table import Table as RichTable
from rich.text import Text

from hilcal.names import escaped
from hilcal.present.charts import style

HEIGHT = 230
"""Of a chart, CSS pixels: three rows of them are a printed page."""


@dataclass(frozen=True, slots=True)
class Words:
    """A paragraph; `kind` is "text", "note" (small), "heading", "strong" or "code"."""

    text: str
    kind: str = "text"


@dataclass(frozen=True, slots=True)
class Items:
    """A list."""

    rows: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """A table; the first cell of each row is its header.

    Attributes:
        caption: what it shows.
        heads: of the columns.
        rows: cells as text.
        narrow: whether it stands beside another one where the page is wide.
    """

    caption: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    narrow: bool = False


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart with the sentence that it shows.

    Attributes:
        title: short.
        json: the figure without its template, as plotly.js takes it, safe inside of a script.
        says: its text alternative.
        height: CSS pixels.
        wide: whether it takes the whole width of the page.
    """

    title: str
    json: str
    says: str
    height: int
    wide: bool


Part = Words | Items | Table | Chart


@dataclass(frozen=True, slots=True)
class Section:
    """A section."""

    id: str
    title: str
    parts: tuple[Part, ...]


def chart(title: str, figure: go.Figure, *, wide: bool = False, height: int = HEIGHT) -> Chart:
    """Return a figure as part of a page.

    Args:
        title: short.
        figure: it.
        wide: whether it takes the whole width of the page.
        height: CSS pixels; 0 for the figure's own.
    """
    bare = go.Figure(figure)
    bare.layout.template = None
    bare.layout.height = height or figure.layout.height
    return Chart(
        title,
        in_script(bare.to_json()),
        style.says(figure),
        int(bare.layout.height),
        wide,
    )


def in_script(json: str) -> str:
    """Return JSON that nothing in it can end the script that holds it, or turn its text."""
    return escaped(json).replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def from_terminal(parts: Iterable[RenderableType], caption: str = "") -> tuple[Part, ...]:
    """Return what a command says at the terminal as parts: the words exist once.

    The caption of a table is the heading right above it, unless that is a sentence, else `caption`;
    where two tables would have the same, the second says what its rows are.
    """
    out: list[Part] = []
    used: set[str] = set()
    for part in parts:
        if isinstance(part, RichTable):
            found = _table(part, caption)
            above = out[-1] if out else None
            heading = above.text if isinstance(above, Words) and above.kind == "heading" else ""
            if heading and not heading.endswith("."):
                out.pop()
                found = replace(found, caption=heading)
            elif found.caption in used:
                found = replace(found, caption=f"{found.caption}: {found.heads[0]}")
            used.add(found.caption)
            out.append(found)
            continue
        words = part.plain if isinstance(part, Text) else str(part)
        styled = str(part.style) if isinstance(part, Text) else ""
        kind = {"bold": "heading", "dim": "note"}.get(styled, "text")
        out += [Words(line.strip(), kind) for line in words.split("\n") if line.strip()]
    return tuple(out)


def _table(of: RichTable, caption: str) -> Table:
    heads = tuple(" ".join(_plain(c.header).split()) for c in of.columns)
    columns = [[" ".join(_plain(cell).split()) for cell in c.cells] for c in of.columns]
    return Table(caption or heads[0], heads, tuple(zip(*columns, strict=True)))


def _plain(cell: RenderableType) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)


def table(caption: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table."""
    return Table(caption, tuple(heads), tuple(tuple(r) for r in rows))
