"""Blocks of a document on a terminal; a table breaks no word, however narrow the terminal is."""

from collections.abc import Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.padding import Padding
from rich.table import Column
from rich.table import Table as RichTable
from rich.text import Text

from hilcal.present.document import Chart, Items, Printable, Table, Words

GAPS = (3, 2)
"""Blanks between two columns: the wider where there is room."""
STYLES = {
    "text": "",
    "heading": "bold",
    "note": "dim",
    "strong": "bold",
    "code": "",
    "good": "bold green",
    "doubt": "bold yellow",
}


def rendered(block: Printable) -> RenderableType:
    """Return what rich prints of a block; of a chart that is the sentence that it shows."""
    if isinstance(block, Words):
        text = Text(block.text)
        text.stylize(STYLES[block.tone], *_stressed(block))
        return Padding(text, (0, 0, 0, block.indent)) if block.indent else text
    if isinstance(block, Table):
        return WordTable(block) if any(block.heads) else _pairs(block)
    if isinstance(block, Items):
        return "\n".join(f"- {row}" for row in block.rows)
    if isinstance(block, Chart):
        return str((block.figure.layout.meta or {}).get("says", ""))
    raise TypeError(type(block))


def _stressed(words: Words) -> tuple[int, int]:
    start = words.text.find(words.stressed)
    return start, start + (len(words.stressed) or len(words.text))


def _pairs(of: Table) -> RichTable:
    out = RichTable.grid(padding=(0, 2), pad_edge=False)
    out.add_column(no_wrap=True)
    out.add_column(overflow="fold")
    for what, said in of.rows:
        out.add_row(Text(f"  {what}"), Text(said))
    return out


class WordTable(RichTable):
    """Columns as wide as they want to be; where there is less room, lines break between words.

    Columns of words (to the left) are narrowed down to their longest word, columns of numbers down
    to their longest cell. Where even that does not fit, each row becomes a short list of its cells,
    headed by the first one.
    """

    def __init__(self, of: Table) -> None:
        """Take a table over."""
        super().__init__(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
        self._left = frozenset(of.left)
        for k, name in enumerate(of.heads):
            self.add_column(name, justify="left" if k in of.left else "right", overflow="fold")
        for k, row in enumerate(of.rows):
            if k in of.ruled and k:
                self.add_section()
            self.add_row(*row, style=STYLES[of.tones.get(k, "text")])

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Choose the widths for the room that there is."""
        columns = self.columns
        least = [self._least(k, column) for k, column in enumerate(columns)]
        wanted = [max(a, _longest(c.header, *c.cells)) for a, c in zip(least, columns, strict=True)]
        for gap in GAPS:
            room = options.max_width - gap * (len(wanted) - 1)
            if sum(wanted) <= room or (gap == GAPS[-1] and sum(least) <= room):
                self.padding = (0, 1, 0, gap - 2)  # one more blank is the column's edge
                for column, width in zip(columns, shared(least, wanted, room), strict=True):
                    column.width = width
                yield from super().__rich_console__(console, options)
                return
        yield from self._lists()

    def _least(self, k: int, column: Column) -> int:
        """Return the width (characters) below which a word, or a number's cell, would break."""
        whole = column.no_wrap or k not in self._left
        cells = column.cells if whole else _words(*column.cells)
        return max(_longest(*_words(column.header)), _longest(*cells))

    def _lists(self) -> RenderResult:
        heads = [" ".join(_plain(column.header).split()) for column in self.columns]
        for row in zip(*(list(column.cells) for column in self.columns), strict=True):
            cells = [" ".join(_plain(cell).split()) for cell in row]
            title = next((cell for cell in cells if cell), "")
            first = cells.index(title)
            yield Text(f"{heads[first]} {title}".strip(), style="bold")
            for head, cell in list(zip(heads, cells, strict=True))[first + 1 :]:
                if cell:
                    yield Padding(Text(f"{head}: {cell}" if head else cell), (0, 0, 0, 2))


def shared(least: Sequence[int], wanted: Sequence[int], room: int) -> list[int]:
    """Share a width among columns: each gets what it wants, or the same above its least.

    Args:
        least: width that a column must have.
        wanted: width that it has use for.
        room: sum of the widths, at least that of `least`.
    """
    level = max(t for t in range(room + 1) if sum(map(min, wanted, (x + t for x in least))) <= room)
    out = [max(x, min(w, x + level)) for x, w in zip(least, wanted, strict=True)]
    for k, most in enumerate(wanted):
        if out[k] < most and sum(out) < room:
            out[k] += 1
    return out


def _longest(*cells: object) -> int:
    """Return the width of the longest line, at least 1."""
    return max((cell_len(line) for cell in cells for line in _plain(cell).split("\n")), default=1)


def _words(*cells: object) -> list[str]:
    return [word for cell in cells for word in _plain(cell).split()]


def _plain(cell: object) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)
