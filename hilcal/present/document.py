"""Blocks of a report: paragraphs, lists, tables and charts, for terminal, page and viewer.

A builder yields blocks from values of the library (`fit_report(fit)`); rich prints them,
`html.fragment` and `viewer.style.markdown` convert them. A plain string is a paragraph; only the
terminal keeps its line breaks.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from hilcal.store.plan import UNLOADED

if TYPE_CHECKING:
    import plotly.graph_objects as go

Tone = Literal["text", "heading", "note", "strong", "code", "good", "doubt"]
STYLES: dict[Tone, str] = {
    "text": "",
    "heading": "bold",
    "note": "dim",
    "strong": "bold",
    "code": "",
    "good": "bold green",
    "doubt": "bold yellow",
}
GAPS = (3, 2)  # blanks between two columns on a terminal: wide, or narrow if there is no room


@dataclass(frozen=True, slots=True)
class Words:
    """A paragraph; its tone applies to the part `stressed`, or to the whole text without one."""

    text: str
    tone: Tone = "text"
    stressed: str = ""
    indent: int = 0  # blanks in front of each line

    def __str__(self) -> str:
        return self.text

    def __rich__(self) -> RenderableType:
        text, start = Text(self.text), self.text.find(self.stressed)
        text.stylize(STYLES[self.tone], start, start + len(self.stressed or self.text))
        return Padding(text, (0, 0, 0, self.indent)) if self.indent else text


@dataclass(frozen=True, slots=True)
class Items:
    """A list."""

    rows: tuple[str, ...]

    def __rich__(self) -> RenderableType:
        return "\n".join(f"- {row}" for row in self.rows)


@dataclass(frozen=True, slots=True)
class Table:
    """A table that is filled row by row; the first cell of each row is its header."""

    heads: tuple[str, ...]  # all empty for pairs of a name and a description
    rows: list[tuple[str, ...]] = field(default_factory=list)
    left: tuple[int, ...] = (0,)  # left-aligned columns of text; the others are right-aligned
    caption: str = ""  # empty: the heading above the table
    narrow: bool = False  # whether a wide page shows it side by side with another table
    tones: dict[int, Tone] = field(default_factory=dict)  # by row, other than "text"
    ruled: set[int] = field(default_factory=set)  # rows with a rule above

    def add(self, *cells: str, tone: Tone = "text") -> None:
        """Append a row."""
        if tone != "text":
            self.tones[len(self.rows)] = tone
        self.rows.append(cells)

    def rule(self) -> None:
        """Draw a rule below the rows so far."""
        self.ruled.add(len(self.rows))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render columns at their full width, or narrower with lines broken between words.

        The least width is the longest word of a column of text, the longest cell of a column of
        numbers. If the least widths do not fit, each row becomes a list headed by its first cell.
        """
        if not any(self.heads):
            named = RichTable.grid(padding=(0, 2), pad_edge=False)
            named.add_column(no_wrap=True)
            named.add_column(overflow="fold")
            for name, description in self.rows:
                named.add_row(Text(f"  {name}"), Text(description))
            yield named
            return
        least, natural = [], []
        for k, (head, *cells) in enumerate(zip(self.heads, *self.rows, strict=True)):
            unbroken = (
                [word for cell in cells for word in cell.split()] if k in self.left else cells
            )
            least.append(_longest(*head.split(), *unbroken))
            natural.append(max(least[-1], _longest(head, *cells)))
        for gap in GAPS:
            room = options.max_width - gap * (len(natural) - 1)
            if sum(natural) <= room or (gap == GAPS[-1] and sum(least) <= room):
                yield self._columns(gap, shared_widths(least, natural, room))
                return
        heads = [" ".join(head.split()) for head in self.heads]
        for row in self.rows:
            cells = [" ".join(cell.split()) for cell in row]
            first = next((k for k, cell in enumerate(cells) if cell), 0)
            yield Text(f"{heads[first]} {cells[first]}".strip(), style="bold")
            for head, cell in list(zip(heads, cells, strict=True))[first + 1 :]:
                if cell:
                    yield Padding(Text(f"{head}: {cell}" if head else cell), (0, 0, 0, 2))

    def _columns(self, gap: int, widths: Sequence[int]) -> RichTable:
        # one more blank than the padding is the column's edge
        out = RichTable(
            box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, gap - 2)
        )
        for k, (name, width) in enumerate(zip(self.heads, widths, strict=True)):
            side: Literal["left", "right"] = "left" if k in self.left else "right"
            out.add_column(name, justify=side, overflow="fold", width=width)
        for k, row in enumerate(self.rows):
            if k in self.ruled and k:
                out.add_section()
            out.add_row(*row, style=STYLES[self.tones.get(k, "text")])
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A figure of plotly; `wide`: as wide as the page; `height` in CSS pixels, 0: the figure's."""

    title: str
    figure: "go.Figure"
    wide: bool = False
    height: int = 230

    def __rich__(self) -> RenderableType:
        return description_of(self.figure)


Block = str | Words | Items | Table | Chart


@dataclass(frozen=True, slots=True)
class PageSection:
    """A section of a page; `id` is the target of links."""

    id: str
    title: str
    blocks: tuple[Block, ...]


def description_of(figure: "go.Figure") -> str:
    """Return the sentence of a chart, for readers who do not see it."""
    return str((figure.layout.meta or {}).get("says", ""))


def load_name(name: str, under: str = "") -> str:
    """Return the display name of a load, with the prefix `under` unless it is unloaded."""
    return "unloaded" if name == UNLOADED else under + name


def heading(text: str) -> Words:
    """Return a heading."""
    return Words(text, "heading")


def note(text: str) -> Words:
    """Return small print."""
    return Words(text, "note")


def table(
    *heads: str, rows: Iterable[Sequence[str]] = (), left: Sequence[int] = (0,), caption: str = ""
) -> Table:
    """Return a table with some rows."""
    return Table(heads, [tuple(row) for row in rows], tuple(left), caption)


def pairs(rows: Iterable[Sequence[str]]) -> Table:
    """Return a table of names and descriptions."""
    return table("", "", rows=rows, left=(0, 1))


def captioned(blocks: Iterable[Block], caption: str = "") -> tuple[Block, ...]:
    """Return blocks for a page: a paragraph for each line but of code, and captions of tables.

    The caption is the table's, else the heading right above unless it is a sentence, else
    `caption`. Of two tables with the same caption the second one adds its first head.
    """
    out: list[Block] = []
    used: set[str] = set()
    for block in blocks:
        if isinstance(block, str | Words):
            paragraph = block if isinstance(block, Words) else Words(block)
            apart = [paragraph.text] if paragraph.tone == "code" else paragraph.text.split("\n")
            lines = (line.strip() for line in apart)
            out += [replace(paragraph, text=line) for line in lines if line]
            continue
        if isinstance(block, Table):
            above, title = out[-1] if out else None, block.caption
            headed = isinstance(above, Words) and above.tone == "heading"
            if not title and headed and not str(above).endswith("."):
                title = str(out.pop())
            title = title or caption or block.heads[0]
            if title in used:
                title = f"{title}: {block.heads[0]}"
            used.add(title)
            heads = tuple(" ".join(head.split()) for head in block.heads)
            block = replace(block, caption=title, heads=heads)
        out.append(block)
    return tuple(out)


def shared_widths(least: Sequence[int], full: Sequence[int], room: int) -> list[int]:
    """Share a width `room` ≥ Σ least: a column gets `full`, or `least` and an equal addition."""
    level = max(t for t in range(room + 1) if sum(map(min, full, (x + t for x in least))) <= room)
    out = [max(x, min(w, x + level)) for x, w in zip(least, full, strict=True)]
    for k, most in enumerate(full):
        if out[k] < most and sum(out) < room:
            out[k] += 1
    return out


def _longest(*cells: str) -> int:
    """Return the width of the longest line; 1 without cells."""
    return max((cell_len(line) for cell in cells for line in cell.split("\n")), default=1)
