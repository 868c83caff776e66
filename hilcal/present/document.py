"""What a result says: words, tables and charts, made once; terminal, page and viewer render them.

A builder yields blocks from the values of the library (`fit_report(fit)`); rich prints them,
`html.page` and `viewer.style.markdown` write them down. A plain string is a paragraph, and its ends
of lines are for the terminal.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, Self

from hilcal.store.plan import UNLOADED

if TYPE_CHECKING:
    import plotly.graph_objects as go
    from rich.console import RenderableType

Tone = Literal["text", "heading", "note", "strong", "code", "good", "doubt"]


class Printable:
    """What rich prints as it is."""

    def __rich__(self) -> "RenderableType":
        """Return it as rich prints it."""
        from hilcal.present.terminal import rendered

        return rendered(self)


@dataclass(frozen=True, slots=True)
class Words(Printable):
    """A paragraph.

    Attributes:
        text: it.
        tone: "note" is small or dim; "good" and "doubt" are verdicts.
        stressed: the part of the text that has the tone; all of it where empty.
        indent: blanks in front of each of its lines.
    """

    text: str
    tone: Tone = "text"
    stressed: str = ""
    indent: int = 0

    def __str__(self) -> str:
        """Return the text."""
        return self.text


@dataclass(frozen=True, slots=True)
class Items(Printable):
    """A list."""

    rows: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Table(Printable):
    """A table that is filled row by row; the first cell of each row is its header.

    Attributes:
        heads: of the columns; all empty for pairs of a name and what is said of it.
        rows: cells as text.
        left: columns of words, which stand to the left; numbers stand to the right.
        caption: what it shows, where no heading above says it.
        narrow: whether it stands beside another one where the page is wide.
        tones: of rows that are not plain, by index.
        ruled: indices of rows with a rule above.
    """

    heads: tuple[str, ...]
    rows: list[tuple[str, ...]] = field(default_factory=list)
    left: tuple[int, ...] = (0,)
    caption: str = ""
    narrow: bool = False
    tones: dict[int, Tone] = field(default_factory=dict)
    ruled: set[int] = field(default_factory=set)

    def add(self, *cells: str, tone: Tone = "text") -> None:
        """Append a row."""
        if tone != "text":
            self.tones[len(self.rows)] = tone
        self.rows.append(cells)

    def rule(self) -> None:
        """Draw a rule below the rows so far."""
        self.ruled.add(len(self.rows))

    def filled(self, rows: Iterable[Sequence[str]]) -> Self:
        """Append rows, and return the table."""
        self.rows.extend(tuple(row) for row in rows)
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Chart(Printable):
    """A figure of plotly with its title; `wide`: it takes the whole width of a page.

    `height` is in CSS pixels, 0 for the figure's own: three rows of 230 are a printed page.
    """

    title: str
    figure: "go.Figure"
    wide: bool = False
    height: int = 230


Block = str | Words | Items | Table | Chart


@dataclass(frozen=True, slots=True)
class PageSection:
    """A section of a page; `id` is what links lead to."""

    id: str
    title: str
    blocks: tuple[Block, ...]


def load_name(name: str, under: str = "") -> str:
    """Return a load's name for people, e.g. after "under "."""
    return "unloaded" if name == UNLOADED else under + name


def heading(text: str) -> Words:
    """Return a heading."""
    return Words(text, "heading")


def note(text: str) -> Words:
    """Return small print."""
    return Words(text, "note")


def table(
    *heads: str,
    rows: Iterable[Sequence[str]] = (),
    left: Sequence[int] = (0,),
    caption: str = "",
) -> Table:
    """Return a table with some rows."""
    return Table(heads, left=tuple(left), caption=caption).filled(rows)


def pairs(rows: Iterable[Sequence[str]]) -> Table:
    """Return a table of names and what is said of each."""
    return table("", "", rows=rows, left=(0, 1))


def captioned(blocks: Iterable[Block], caption: str = "") -> tuple[Block, ...]:
    """Return blocks for a page: a paragraph for each line, and a caption for every table.

    It is the table's own, else the heading right above, unless that is a sentence, else `caption`;
    where two tables would have the same, the second says what its rows are.
    """
    out: list[Block] = []
    used: set[str] = set()
    for block in blocks:
        if isinstance(block, str | Words):
            of = block if isinstance(block, Words) else Words(block)
            lines = (line.strip() for line in of.text.split("\n"))
            out += [replace(of, text=line) for line in lines if line]
            continue
        if isinstance(block, Table):
            above, found = out[-1] if out else None, block.caption
            titled = isinstance(above, Words) and above.tone == "heading"
            if not found and isinstance(above, Words) and titled and not above.text.endswith("."):
                out.pop()
                found = above.text
            found = found or caption or block.heads[0]
            if found in used:
                found = f"{found}: {block.heads[0]}"
            used.add(found)
            heads = tuple(" ".join(head.split()) for head in block.heads)
            block = replace(block, caption=found, heads=heads)
        out.append(block)
    return tuple(out)
