"""The keys of CELL.toml for people: in the terminal, and as a page of the reference."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict

from rich.console import RenderableType
from rich.padding import Padding
from rich.table import Table as Grid
from rich.text import Text

from hilcal.config.reference import NOT_SET, REQUIRED, Key, Table
from hilcal.present import text

_HEAD = """\
# Keys of CELL.toml

Written by the program (`hilcal config SECTION` shows the same in the terminal); a test holds this
page to the code. Every key that is not "required" may be left out. `hilcal init` writes a file to
begin with.
"""


def overview(tables: Sequence[Table]) -> Iterator[RenderableType]:
    """Yield the list of sections."""
    out = Grid.grid(padding=(0, 2), pad_edge=False)
    out.add_column(no_wrap=True)
    out.add_column()
    for t in tables:
        out.add_row(Text(f"  {t.header}"), Text(t.about))
    yield text.heading("Sections of CELL.toml")
    yield out
    yield ""
    yield "hilcal config SECTION explains the keys of one; hilcal init writes a file."


def section(t: Table) -> Iterator[RenderableType]:
    """Yield all keys of a section."""
    yield text.heading(t.header)
    yield t.about
    for key in t.keys:
        yield ""
        yield Text(f"  {key.name}", style="bold")
        yield Padding(Text(key.valid), (0, 0, 0, 6))
        yield Padding(Text(_facts(key)), (0, 0, 0, 6))
        yield Padding(Text(f"example: {key.example}"), (0, 0, 0, 6))


def _facts(key: Key) -> str:
    unit = f"unit: {key.unit}; " if key.unit else ""
    return unit + (REQUIRED if key.default == REQUIRED else f"default: {key.default}")


def page(tables: Sequence[Table]) -> str:
    """Return the page of the reference, in Markdown."""
    lines = [_HEAD]
    for t in tables:
        lines += [f"## `{t.header}`", "", t.about, ""]
        lines += ["| key | unit | default | what it must be | example |", "|---|---|---|---|---|"]
        for key in t.keys:
            default = key.default if key.default in (REQUIRED, NOT_SET) else f"`{key.default}`"
            cells = (f"`{key.name}`", key.unit or "–", default, key.valid, f"`{key.example}`")
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


def to_json(tables: Sequence[Table]) -> dict[str, object]:
    """Return the document of `config --json`."""
    return {"sections": [asdict(t) for t in tables]}
