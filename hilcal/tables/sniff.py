"""How a table of unknown form is written: dialect, header, sheet, lines that are no readings."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.tables import files
from hilcal.tables.grid import Cell, Grid, number
from hilcal.tables.mapping import FileFormat

_POINT = re.compile(r"\[\[\s*[-+.\d]|\{\s*(A1|X)\s+[-+.\d]")
HEAD = 400  # Lines that the dialect is guessed from
MANY_NUMBERS = 0.5  # of those of the sheet that is read: other readings; a choice
COMMENTS = ("//", "#", "%", "!")
_UNIT = re.compile(
    r"[\[(<]?\s*(|-|1|m|mm|[uµμ]m|in(ch)?|\"|deg|degrees?|°|rad|mrad|n|kn|nm|n[*·]m|kg|g|s|sec|ms|"
    r"°c|degc|c|k|string|text|name)\s*[\])>]?",
    re.IGNORECASE,
)

Rows = Sequence[tuple[int, Sequence[Cell]]]


@dataclass(frozen=True, slots=True, eq=False)
class SniffedFile:
    """A file, opened as it seems to be written."""

    file_keys: dict[str, Any]  # keys of [file] that differ from a plain CSV file
    grid: Grid
    doubts: tuple[str, ...]  # sentences on what is unsure


def sniff(path: str | Path) -> SniffedFile:
    """Guess how a file is written, and open it."""
    content = limits.read_bytes(Path(path), limits.TABLE)
    name = str(path)
    kind = files.kind_of(name, content)
    if kind == "XLSX":
        return _spreadsheet(name, content)
    if kind != "text":
        return SniffedFile({}, files.open_grid(path, FileFormat()), ())
    how: dict[str, Any] = {}
    text = files.decoded(name, content, None)
    if not content.startswith(tuple(files.BYTE_ORDER_MARKS)):
        guessed = files.guessed_encoding(content)
        how |= {"encoding": guessed} if guessed != "utf-8" else {}
    lines = [line for line in text.splitlines() if line.strip()][:HEAD]
    for mark in COMMENTS:
        count = sum(line.lstrip().startswith(mark) for line in lines)
        if 0 < count < 0.5 * len(lines):
            how["comment"] = mark
            break
    if sum(map(bool, map(_POINT.search, lines))) > 0.5 * len(lines):
        raise InputError(
            f"{name}: its rows hold points of a robot's program, [[...], ...] or {{A1 ..., A2 "
            "...}; write each number in a column of its own: joint angles, then x, y, z as measured"
        )
    how |= _dialect(name, lines, how.get("comment"))
    how["header_row"] = 0
    rows = list(files.records(name, text, FileFormat(**how)))
    layout, doubts = _layout(rows, FileFormat(**how))
    how |= layout
    if how["header_row"] == 0 and "comment" in how:
        how |= _commented_header(text, how, rows)
    if how["separator"] == ",":
        del how["separator"]
    file_format = FileFormat(**how)
    return SniffedFile(_stated(file_format), files.open_grid(path, file_format), doubts)


def _stated(file_format: FileFormat) -> dict[str, Any]:
    """Return the keys of [file] that are not as in a plain CSV file."""
    return file_format.model_dump(mode="json", exclude_defaults=True)


def _dialect(path: str, lines: list[str], comment: str | None) -> dict[str, Any]:
    best, score = dict[str, Any](), 0.0
    body = "\n".join(lines)
    choices = product((None, "'", ".", ",", " "), ("tab", ";", "|", ",", "blanks"), (".", ","))
    for thousands, separator, decimal in choices:
        blank = separator == "blanks" and thousands == " "
        if decimal == separator or thousands in (decimal, separator) or blank:
            continue
        keys = {"separator": separator, "decimal": decimal, "thousands": thousands}
        form = FileFormat(**keys, comment=comment, header_row=0)
        try:
            rows = [cells for _, cells in files.records(path, body, form)]
        except InputError:
            continue
        length, _ = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        usual = [cells for cells in rows if len(cells) == length >= 3]
        mean = sum(_is_number(c, form) for cells in usual for c in cells) / max(len(rows), 1)
        if mean > score + 1e-9:
            best, score = keys, mean
    if not best:
        raise InputError(
            f"{path}: no columns of numbers; expected a table, one row per reading, or XLSX, MAT "
            f"or Parquet"
        )
    return best


def _is_number(cell: Cell, how: FileFormat) -> bool:
    return bool(np.isfinite(number(cell, how)))


def _layout(rows: Rows, how: FileFormat) -> tuple[dict[str, Any], tuple[str, ...]]:
    length, _ = Counter(len(cells) for _, cells in rows).most_common(1)[0]
    share = []
    for _, cells in rows:
        some = list(filter(files.filled, cells))
        share.append(sum(_is_number(c, how) for c in some) / max(len(some), 1))
    usual = float(np.median([s for s, (_, c) in zip(share, rows, strict=True) if len(c) == length]))
    complete = [len(cells) >= length - 1 for _, cells in rows]
    first = next((k for k in range(len(rows)) if share[k] >= 0.5 * usual and complete[k]), 0)
    titled = [k for k in range(first) if complete[k] and sum(map(files.filled, rows[k][1])) > 1]
    above = [k for k in titled if files.length_of(rows[k][1]) <= length]
    out: dict[str, Any] = {"header_row": 0}
    doubts: list[str] = []
    if titled and not above:
        row, cells = rows[titled[-1]]
        named = f"row {row} names {files.length_of(cells)} columns, the readings have {length}"
        doubts.append(f"{named}: the columns are numbered")
    header: Sequence[Cell] = ()
    if above:
        title = above[-1]
        if len(above) > 1 and all(_UNIT.fullmatch(str(c or "")) for c in rows[title][1]):
            out["units_row"] = rows[title][0]
            title = above[-2]
        out["header_row"], header = rows[title]
        names = [cell for cell in header if files.filled(cell)]
        over = rows[title - 1] if title > 0 else (0, ())
        groups = {cell for cell in over[1] if files.filled(cell)}
        texts = not any(_is_number(cell, how) for cell in groups)
        if len(set(names)) < len(names) and len(groups) > 1 and texts:
            out["group_row"] = over[0]
    width = len(header) or length
    trimmed = files.length_of(header) if header else width
    odd = []
    for k, (row, cells) in enumerate(rows):
        preamble = k < first and row > out["header_row"] and row != out.get("units_row")
        short = bool(header) and len(cells) < trimmed
        if preamble or (
            k >= first and (short or files.length_of(cells) > width or cells == header)
        ):
            odd.append(row)
    if odd and len(odd) <= 0.1 * len(rows) + 10:
        out["skip_rows"] = odd
        late = [row for row in odd if row > rows[first][0]]
        if late:
            listed = ", ".join(map(str, late[:5])) + ", ..." * (len(late) > 5)
            why = "they repeat the header or are not of the table's length"
            doubts.append(f"rows {listed} are left out: {why}")
    return out, tuple(doubts)


def _commented_header(text: str, how: dict[str, Any], rows: Rows) -> dict[str, Any]:
    """Header in the last comment line above the readings, as numpy.savetxt writes it."""
    lines = [line.lstrip() for line in text.splitlines()[: rows[0][0] - 1]]
    marked = [row for row, line in enumerate(lines, start=1) if line.startswith(how["comment"])]
    if not marked:
        return {}
    plain = FileFormat(**{**how, "comment": None, "header_row": 0})
    line = lines[marked[-1] - 1][len(how["comment"]) :]
    cells = [c for _, c in files.records("", line, plain)]
    same = bool(cells) and len(cells[0]) == len(rows[0][1])
    return {"header_row": marked[-1]} if same else {}


def _decimal(rows: Rows) -> str:
    """Return the decimal mark of the numbers that a spreadsheet holds as texts."""
    texts = [c for _, cells in rows for c in cells if isinstance(c, str) and ("," in c or "." in c)]
    comma, point = (
        sum(_is_number(c, FileFormat(decimal=mark, separator=";")) for c in texts) for mark in ",."
    )
    return "," if comma > point else "."


def _spreadsheet(path: str, content: bytes) -> SniffedFile:
    best: tuple[int, str, Rows] = (0, "", [])
    counts: dict[str, int] = {}
    book = files.workbook(path, content)
    names = book.sheetnames
    for sheet in names:
        rows = files.sheet_rows(path, book, sheet, None)
        written = FileFormat(decimal=_decimal(rows))
        numbers = (np.isfinite(number(c, written)) for _, cells in rows for c in cells)
        count = counts[sheet] = sum(numbers)
        if count > best[0]:
            best = count, sheet, rows
    if not best[0]:
        raise InputError(f"{path}: no sheet with numbers; it has {', '.join(names)}")
    decimal = {"decimal": _decimal(best[2])}
    how, doubts = _layout(best[2], FileFormat(header_row=0, **decimal))
    how |= decimal
    if len(names) > 1:
        how["sheet"] = best[1]
    if others := [s for s in names if s != best[1] and counts[s] > MANY_NUMBERS * best[0]]:
        doubts = (*doubts, f"only this sheet is read, and not {', '.join(others)}")
    form = FileFormat(**how)
    return SniffedFile(_stated(form), files.grid_of_rows(path, best[2], form), doubts)
