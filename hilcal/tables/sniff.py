"""How a file is written, guessed from its content: separator, decimal mark, header, sheet."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.errors import InputError
from hilcal.tables.files import (
    BYTE_ORDER_MARKS,
    content_of,
    decoded,
    grid_of_rows,
    kind_of,
    open_grid,
    records,
    sheet_names,
    sheet_rows,
)
from hilcal.tables.grid import Cell, Grid, number
from hilcal.tables.mapping import FileFormat

HEAD = 400  # Lines that the dialect is guessed from
COMMENTS = ("//", "#", "%", "!")
_UNIT = re.compile(
    r"[\[(<]?\s*(|-|1|m|mm|[uµμ]m|in(ch)?|\"|deg|degrees?|°|rad|mrad|n|kn|nm|n[*·]m|kg|g|s|sec|ms|"
    r"°c|degc|c|k|string|text|name)\s*[\])>]?",
    re.IGNORECASE,
)

Rows = Sequence[tuple[int, Sequence[Cell]]]


@dataclass(frozen=True, slots=True, eq=False)
class Sniffed:
    """A file, opened as it seems to be written."""

    how: dict[str, Any]  # keys of [file] that differ from a plain CSV file
    grid: Grid
    doubts: tuple[str, ...]  # sentences on what is unsure


def sniff(path: str | Path) -> Sniffed:
    """Guess how a file is written, and open it.

    Raises:
        InputError: no such file, a kind that is not read, or no table of numbers in it.
    """
    content = content_of(path)
    name = str(path)
    kind = kind_of(name, content)
    if kind == "XLSX":
        return _spreadsheet(name, content)
    if kind != "text":
        return Sniffed({}, open_grid(path, FileFormat()), ())
    how: dict[str, Any] = {}
    text = decoded(name, content, None)
    if not content.startswith(tuple(BYTE_ORDER_MARKS)) and not _is_utf8(content):
        how["encoding"] = "latin-1"
    lines = [line for line in text.splitlines() if line.strip()][:HEAD]
    for mark in COMMENTS:
        count = sum(line.lstrip().startswith(mark) for line in lines)
        if 0 < count < 0.5 * len(lines):
            how["comment"] = mark
            break
    how |= _dialect(name, lines, how.get("comment"))
    how["header_row"] = 0
    rows = list(records(name, text, FileFormat(**how)))
    layout, doubts = _layout(rows, FileFormat(**how))
    how |= layout
    if how["header_row"] == 0 and "comment" in how:
        how |= _commented_header(text, how, rows)
    if how["header_row"] == 1:
        del how["header_row"]
    if how.get("separator") == ",":
        del how["separator"]
    return Sniffed(how, open_grid(path, FileFormat(**how)), doubts)


def _is_utf8(content: bytes) -> bool:
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def _dialect(path: str, lines: list[str], comment: str | None) -> dict[str, Any]:
    """Separator, decimal mark and thousands mark that make most cells numbers."""
    best: tuple[float, dict[str, Any]] = (0.0, {})
    body = "\n".join(lines)
    choices = product((None, "'", ".", ",", " "), ("tab", ";", "|", ",", "blanks"), (".", ","))
    for thousands, separator, decimal in choices:
        if decimal == separator or thousands in (decimal, separator):
            continue
        if separator == "blanks" and thousands == " ":
            continue
        given = {"separator": separator}
        given |= {"decimal": decimal} if decimal != "." else {}
        given |= {"thousands": thousands} if thousands else {}
        form = FileFormat(**{**given, "comment": comment, "header_row": 0})
        try:
            found = [cells for _, cells in records(path, body, form)]
        except InputError:
            continue
        score = _numbers_per_row(found, form)
        if score > best[0] + 1e-9:
            best = score, given
    if not best[1]:
        raise InputError(
            f"{path}: no columns of numbers; expected a table, one row per reading, or XLSX, MAT "
            f"or Parquet"
        )
    return best[1]


def _numbers_per_row(rows: Sequence[Sequence[Cell]], how: FileFormat) -> float:
    """Mean count of numbers in the rows of the usual length; 0 where there is one column."""
    if not rows:
        return 0.0
    length, _ = Counter(map(len, rows)).most_common(1)[0]
    if length < 3:
        return 0.0
    usual = [cells for cells in rows if len(cells) == length]
    count = sum(sum(_is_number(c, how) for c in cells) for cells in usual)
    return count / len(rows)


def _is_number(cell: Cell, how: FileFormat) -> bool:
    return bool(np.isfinite(number(cell, how)))


def _layout(rows: Rows, how: FileFormat) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Header row, row of units and rows that are no readings."""
    length, _ = Counter(len(cells) for _, cells in rows).most_common(1)[0]
    share = []
    for _, cells in rows:
        filled = [c for c in cells if c is not None and c != ""]
        share.append(sum(_is_number(c, how) for c in filled) / max(len(filled), 1))
    usual = float(np.median([s for s, (_, c) in zip(share, rows, strict=True) if len(c) == length]))
    first = next(
        (k for k, (_, c) in enumerate(rows) if share[k] >= 0.5 * usual and len(c) >= length - 1), 0
    )
    titled = [k for k in range(first) if len(rows[k][1]) >= length - 1 and _filled(rows[k][1]) > 1]
    above = [k for k in titled if _trim(rows[k][1]) <= length]
    out: dict[str, Any] = {"header_row": 0}
    doubts: list[str] = []
    if titled and not above:
        row, cells = rows[titled[-1]]
        doubts.append(
            f"row {row} names {_trim(cells)} columns, the readings have {length}: the columns are "
            f"numbered"
        )
    header: Sequence[Cell] = ()
    if above:
        at = above[-1]
        if len(above) > 1 and all(_UNIT.fullmatch(str(c or "")) for c in rows[at][1]):
            out["units_row"] = rows[at][0]
            at = above[-2]
        out["header_row"], header = rows[at][0], rows[at][1]
    width = len(header) or length
    trimmed = _trim(header) if header else width
    odd = []
    for k, (row, cells) in enumerate(rows):
        before = k < first and row > out["header_row"] and row != out.get("units_row")
        short = bool(header) and len(cells) < trimmed
        if before or (k >= first and (short or _trim(cells) > width or cells == header)):
            odd.append(row)
    if odd and len(odd) <= 0.1 * len(rows) + 10:
        out["skip_rows"] = odd
        late = [row for row in odd if row > rows[first][0]]
        if late:
            doubts.append(
                f"rows {', '.join(map(str, late[:5]))}{', ...' if len(late) > 5 else ''} are left "
                f"out: they are not of the table's length"
            )
    return out, tuple(doubts)


def _filled(cells: Sequence[Cell]) -> int:
    return sum(c is not None and c != "" for c in cells)


def _trim(cells: Sequence[Cell]) -> int:
    """Cells up to the last one that is not empty."""
    return max((k for k, c in enumerate(cells, start=1) if c is not None and c != ""), default=0)


def _commented_header(text: str, how: dict[str, Any], rows: Rows) -> dict[str, Any]:
    """Header in the last comment line above the readings, as numpy.savetxt writes it."""
    lines = text.splitlines()
    for row in range(min(rows[0][0] - 1, len(lines)), 0, -1):
        if not lines[row - 1].lstrip().startswith(how["comment"]):
            continue
        plain = FileFormat(**{**how, "comment": None, "header_row": 0})
        line = lines[row - 1].lstrip()[len(how["comment"]) :]
        cells = [c for _, c in records("", line, plain)]
        if cells and len(cells[0]) == len(rows[0][1]):
            return {"header_row": row}
        break
    return {}


def _spreadsheet(path: str, content: bytes) -> Sniffed:
    """Choose the sheet with most numbers."""
    best: tuple[int, str, Rows] = (0, "", [])
    names = sheet_names(path, content)
    for sheet in names:
        rows = sheet_rows(path, content, sheet, None)
        count = sum(isinstance(c, float) for _, cells in rows for c in cells)
        if count > best[0]:
            best = count, sheet, rows
    if not best[0]:
        raise InputError(f"{path}: no sheet with numbers; it has {', '.join(names)}")
    how, doubts = _layout(best[2], FileFormat(header_row=0))
    if len(names) > 1:
        how["sheet"] = best[1]
    if how["header_row"] == 1:
        del how["header_row"]
    form = FileFormat(**how)
    return Sniffed(how, grid_of_rows(path, best[2], form), doubts)
