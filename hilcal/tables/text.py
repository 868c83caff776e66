"""Delimited text of any dialect as a table of cells."""

import csv
import io
from collections.abc import Iterator, Sequence

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.tables.grid import Cell, Check, Grid, text_of, unique
from hilcal.tables.mapping import FileFormat

SEPARATORS = {"tab": "\t", "blanks": " "}
"""Separators that have a name in a mapping file."""

BYTE_ORDER_MARKS = {
    b"\xef\xbb\xbf": "utf-8-sig",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
}


def decoded(path: str, content: bytes, encoding: str | None) -> str:
    """Text of a file: by its byte order mark, else as stated, else UTF-8, else Latin-1.

    Raises:
        InputError: binary data, or not text in the encoding that is stated.
    """
    marks = (name for mark, name in BYTE_ORDER_MARKS.items() if content.startswith(mark))
    wanted = next(marks, encoding)
    try:
        text = content.decode(wanted or "utf-8")
    except UnicodeError as e:
        if wanted is not None:
            raise InputError(
                f"{path}: not {wanted.upper()} text; a mapping states another in [file] encoding "
                "(--preview proposes one): utf-8, latin-1, utf-16"
            ) from e
        text = content.decode("latin-1")
    if "\x00" in text:
        raise InputError(f"{path}: binary data; expected text, XLSX, MAT or Parquet")
    return text


def read_text(path: str, content: bytes, how: FileFormat, check: Check | None = None) -> Grid:
    """Read delimited text; `check` is given its header.

    Raises:
        InputError: not text, no readings, a row of another length.
    """
    text = decoded(path, content, how.encoding)
    return grid_of_rows(path, list(records(path, text, how)), how, check)


def records(path: str, text: str, how: FileFormat) -> Iterator[tuple[int, list[str]]]:
    """Rows of cells that are neither blank nor comments, with their numbers from 1.

    Raises:
        InputError: quotes that are not closed.
    """
    separator = SEPARATORS.get(how.separator or ",", how.separator or ",")
    if how.separator == "blanks":
        text = text.replace("\t", " ")
    if how.comment is not None and how.header_row:
        text = _header_uncommented(text, how.header_row, how.comment)
    lines = limits.Lines(path, io.StringIO(text, newline=None))
    reader = csv.reader(
        lines, delimiter=separator, skipinitialspace=how.separator == "blanks", strict=True
    )
    try:
        begun = 1
        for cells in reader:
            row, begun = begun, reader.line_num + 1
            lines.row(len(cells))
            stripped = [c.strip() for c in cells]
            while how.separator == "blanks" and stripped and not stripped[-1]:
                stripped.pop()
            comment = how.comment is not None and bool(stripped)
            if any(stripped) and not (comment and stripped[0].startswith(how.comment or "")):
                yield row, stripped
    except csv.Error as e:
        raise InputError(f"{path}: row {reader.line_num}: not delimited text ({e})") from e


def _header_uncommented(text: str, row: int, comment: str) -> str:
    """Take the comment's mark off the header, as numpy.savetxt writes it."""
    lines = text.splitlines(keepends=True)
    if row <= len(lines) and lines[row - 1].lstrip().startswith(comment):
        lines[row - 1] = lines[row - 1].lstrip()[len(comment) :].lstrip()
    return "".join(lines)


def grid_of_rows(
    path: str,
    found: Sequence[tuple[int, Sequence[Cell]]],
    how: FileFormat,
    check: Check | None = None,
) -> Grid:
    """Make a grid of rows of cells: header (which is checked), units, and rows of one length.

    Cells that a row has beyond the header must be empty, as trailing separators leave them.

    Raises:
        InputError: the header's row is not there, no readings, a row of another length.
    """
    by_row = dict(found)
    if how.header_row and how.header_row not in by_row:
        raise InputError(
            f"{path}: row {how.header_row} holds no header; set [file] header_row to its row, 0 "
            f"where there is none"
        )
    titles = by_row[how.header_row] if how.header_row else []
    if check is not None:
        check([text_of(c) for c in titles])
    header = [" ".join(text_of(c).split()) for c in titles]
    skipped = {how.units_row, *how.skip_rows}
    body = [(row, c) for row, c in found if row > how.header_row and row not in skipped]
    if not body:
        raise InputError(f"{path}: no readings below row {how.header_row}")
    width = len(header) or max(_length(c) for _, c in body)
    while header and not header[-1] and all(_length(c) < width for _, c in body):
        header.pop()
        width -= 1
    for row, cells in body:
        if _length(cells) > width or (how.header_row and len(cells) < width):
            raise InputError(
                f"{path}: row {row} has {_length(cells)} cells, "
                f"{'the header' if header else 'others'} {width}; a mapping lists rows that are "
                "no readings in [file] skip_rows, or has them begin with [file] comment"
            )
    limits.check_cells(path, len(body), width)
    names = unique(header or [str(k + 1) for k in range(width)])
    padded = [[*cells[:width], *[None] * (width - len(cells))] for _, cells in body]
    columns = tuple(list(column) for column in zip(*padded, strict=True))
    units = {}
    if how.units_row is not None and how.units_row in by_row:
        units = {n: text_of(c) for n, c in zip(names, by_row[how.units_row], strict=False)}
    rows = np.array([row for row, _ in body], dtype=np.int64)
    return Grid(path, names, rows, columns, (how,) * len(names), units)


def _length(cells: Sequence[Cell]) -> int:
    """Cells up to the last one that is not empty."""
    filled = [k for k, c in enumerate(cells, start=1) if c is not None and c != ""]
    return filled[-1] if filled else 0
