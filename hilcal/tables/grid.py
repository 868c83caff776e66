"""A table as a file holds it: named columns of cells, and how cells become numbers.

Delimited text of any dialect is read here, spreadsheets, MAT and Parquet files in
`hilcal.tables.sheets`; what the columns mean is said by a mapping (`hilcal.tables.mapping`).
"""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_name, check_names, from_csv
from hilcal.tables.mapping_sections import FileFormat
from hilcal.types import Bools, Floats, Ints

Cell = str | float | datetime | None

BLANK = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---")
"""What stands for a missing number, in small letters."""

SEPARATORS = {"tab": "\t", "blanks": " "}
"""Separators that have a name in a mapping file."""

_PLAIN = str.maketrans({"\u2212": "-", "\u00a0": " ", "\u202f": " ", "\u2019": "'"})
"""Signs that programs write in place of minus, blank and apostrophe."""

BYTE_ORDER_MARKS = (
    (b"\xef\xbb\xbf", "utf-8-sig"),
    (b"\xff\xfe", "utf-16"),
    (b"\xfe\xff", "utf-16"),
)

_SHOWN = 12
"""Columns that a message lists; the rest are counted."""


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A table of cells.

    Attributes:
        path: the file's name, for messages.
        names: of the columns; "1", "2", ... where the file has no header.
        rows: (N,) row of each record as an editor or a spreadsheet counts, from 1.
        columns: N cells of each column.
        formats: how the cells of each column are written.
        units: cells of the row of units by column, where there is one.
    """

    path: str
    names: tuple[str, ...]
    rows: Ints
    columns: tuple[Sequence[Cell], ...]
    formats: tuple[FileFormat, ...]
    units: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse too many columns, and names of columns that no name may be."""
        limits.check_cells(self.path, len(self.rows), len(self.names))
        check_names(self.names, f"{self.path}: column")

    def at(self, index: int, column: str) -> str:
        """Where a cell is, for messages."""
        return f"{self.path}: row {self.rows[index]}, column '{column}'"

    def name(self, column: str | int) -> str:
        """Return the name of a column that a mapping gives by name or by number, from 1.

        Raises:
            InputError: no such column; lists those that there are.
        """
        if isinstance(column, int):
            if column > len(self.names):
                raise InputError(
                    f"{self.path}: the mapping asks for column {column}, there are "
                    f"{len(self.names)}"
                )
            return self.names[column - 1]
        if column not in self.names:
            from hilcal.toml import suggest

            more = len(self.names) - _SHOWN
            rest = f" and {more} more" if more > 0 else ""
            raise InputError(
                f"{self.path}: no column '{column}'{suggest(column, self.names)}; it has "
                f"{', '.join(self.names[:_SHOWN])}{rest}"
            )
        return column

    def cells(self, column: str | int) -> Sequence[Cell]:
        """Return the cells of a column.

        Raises:
            InputError: no such column.
        """
        return self.columns[self.names.index(self.name(column))]

    def text(self, column: str | int) -> list[str]:
        """Cells as text; whole numbers without a decimal point, nothing for empty cells.

        Raises:
            InputError: no such column, or a text that no name may be.
        """
        name = self.name(column)
        cells = (_text(c) for c in self.cells(column))
        return [from_csv(check_name(c, self.at(k, name))) for k, c in enumerate(cells)]

    def numbers(self, column: str | int) -> Floats:
        """(N,) numbers of a column, NaN where a value is missing.

        Raises:
            InputError: no such column, or a cell that is neither a number nor missing.
        """
        cells, how = self.cells(column), self.formats[self.names.index(self.name(column))]
        values = np.fromiter((number(c, how) for c in cells), dtype=float, count=len(cells))
        bad = np.isinf(values)
        if bad.any():
            k = int(np.argmax(bad))
            raise InputError(f"{self.at(k, self.name(column))}: {_complaint(cells[k], how)}")
        for mark in how.missing:
            if isinstance(mark, float | int):
                values[values == mark] = np.nan
        return values

    def rows_with(self, keep: Bools) -> "Grid":
        """Return the chosen rows."""
        at = np.flatnonzero(keep)
        return Grid(
            self.path,
            self.names,
            self.rows[keep],
            tuple([c[int(k)] for k in at] for c in self.columns),
            self.formats,
            self.units,
        )


def _text(cell: Cell) -> str:
    if cell is None:
        return ""
    if isinstance(cell, float | np.floating | np.integer):
        return str(int(cell)) if float(cell).is_integer() else repr(float(cell))
    return str(cell).strip()


def number(cell: Cell, how: FileFormat) -> float:
    """Return a cell's number; NaN where it is missing, infinite where it is no finite number."""
    if isinstance(cell, bool | datetime):
        return float("inf")
    if cell is None:
        return float("nan")
    if not isinstance(cell, str):
        return float(cell)
    plain = cell.translate(_PLAIN).strip()
    if plain.lower() in BLANK or plain in how.missing:
        return float("nan")
    if how.thousands and how.thousands in plain:
        whole = plain.split(how.decimal)[0].lstrip("+-").split(how.thousands)
        if not 0 < len(whole[0]) <= 3 or any(len(part) != 3 for part in whole[1:]):
            return float("inf")
        plain = plain.replace(how.thousands, "")
    if how.decimal == ",":
        if "." in plain:
            return float("inf")
        plain = plain.replace(",", ".")
    try:
        return float("inf") if "_" in plain else _finite(float(plain))
    except ValueError:
        return float("inf")


def _finite(value: float) -> float:
    return value if np.isfinite(value) else float("inf")


def _complaint(cell: Cell, how: FileFormat) -> str:
    shown = str(cell).strip()
    shown = shown if len(shown) <= 40 else shown[:37] + "..."
    return (
        f"'{shown}' is not a number with '{how.decimal}' as decimal mark; cells without a value "
        f"are left empty, or listed in [file] missing"
    )


def decoded(path: str, content: bytes, encoding: str | None) -> str:
    """Text of a file: by its byte order mark, else as stated, else UTF-8, else Latin-1.

    Raises:
        InputError: not text in the encoding that is stated.
    """
    for mark, name in (
        (b"\xef\xbb\xbf", "utf-8-sig"),
        (b"\xff\xfe", "utf-16"),
        (b"\xfe\xff", "utf-16"),
    ):
        if content.startswith(mark):
            return _decode(path, content, name)
    if encoding is not None:
        return _decode(path, content, encoding)
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _decode(path: str, content: bytes, encoding: str) -> str:
    try:
        return content.decode(encoding)
    except UnicodeError as e:
        raise InputError(
            f"{path}: not {encoding} text; valid in [file] encoding: utf-8, latin-1, utf-16"
        ) from e


def read_text(path: str, content: bytes, how: FileFormat) -> Grid:
    """Read delimited text.

    Raises:
        InputError: not text, no readings, a row of another length.
    """
    text = decoded(path, content, how.encoding)
    if "\x00" in text:
        raise InputError(f"{path}: binary data; expected text, XLSX, MAT or Parquet")
    return table(path, list(records(path, text, how)), how)


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
        for cells in reader:
            lines.row(len(cells))
            stripped = [c.strip() for c in cells]
            while how.separator == "blanks" and stripped and not stripped[-1]:
                stripped.pop()
            comment = how.comment is not None and bool(stripped)
            if any(stripped) and not (comment and stripped[0].startswith(how.comment or "")):
                yield reader.line_num, stripped
    except csv.Error as e:
        raise InputError(f"{path}: row {reader.line_num}: not delimited text ({e})") from e


def _header_uncommented(text: str, row: int, comment: str) -> str:
    """Take the comment's mark off the header, as numpy.savetxt writes it."""
    lines = text.splitlines(keepends=True)
    if row <= len(lines) and lines[row - 1].lstrip().startswith(comment):
        lines[row - 1] = lines[row - 1].lstrip()[len(comment) :].lstrip()
    return "".join(lines)


def table(path: str, found: Sequence[tuple[int, Sequence[Cell]]], how: FileFormat) -> Grid:
    """Make a grid of rows of cells: header, units, and rows of one length.

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
    header = [" ".join(_text(c).split()) for c in titles]
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
                f"{'the header' if header else 'others'} {width}; rows that are no readings are "
                f"listed in [file] skip_rows, or begin with [file] comment"
            )
    limits.check_cells(path, len(body), width)
    names = unique(header or [str(k + 1) for k in range(width)])
    padded = [[*cells[:width], *[None] * (width - len(cells))] for _, cells in body]
    columns = tuple(list(column) for column in zip(*padded, strict=True))
    units = {}
    if how.units_row is not None and how.units_row in by_row:
        units = {n: _text(c) for n, c in zip(names, by_row[how.units_row], strict=False)}
    rows = np.array([row for row, _ in body], dtype=np.int64)
    return Grid(path, names, rows, columns, (how,) * len(names), units)


def _length(cells: Sequence[Cell]) -> int:
    """Cells up to the last one that is not empty."""
    filled = [k for k, c in enumerate(cells, start=1) if c is not None and c != ""]
    return filled[-1] if filled else 0


def unique(names: Sequence[str]) -> tuple[str, ...]:
    """Names with a number in brackets from the second of a name on: "X", "X (2)".

    A column without a name is called by its number.
    """
    out: dict[str, None] = {}
    counts: dict[str, int] = {}
    for k, given in enumerate(names, start=1):
        first = name = given or str(k)
        count = counts.get(first, 1)
        while name in out:
            count += 1
            name = f"{first} ({count})"
        counts[first] = count
        out[name] = None
    return tuple(out)


def joined(
    first: Grid, second: Grid, match: tuple[str | int, str | int] | None
) -> tuple[Grid, int]:
    """Return the first table with the second one's columns, and how many rows found no partner.

    Rows belong together by number, or where a column of both holds the same text. Rows of the
    first table without a partner are left out; columns of a name that the first one has get
    "(2)" behind it.

    Raises:
        InputError: tables of different length, a name twice in the second table, no row with a
            partner.
    """
    if match is None:
        if len(first.rows) != len(second.rows):
            raise InputError(
                f"{second.path}: {len(second.rows)} rows, {first.path} has {len(first.rows)}; give "
                f"tables of the same length, or [second_file] match with the column of each "
                f"that names the row"
            )
        at = np.arange(len(first.rows))
    else:
        keys = second.text(match[1])
        where: dict[str, int] = {}
        for k, key in enumerate(keys):
            if key in where:
                raise InputError(
                    f"{second.at(k, second.name(match[1]))}: '{key}' is in row "
                    f"{second.rows[where[key]]}, too; rows to match by must differ"
                )
            where[key] = k
        at = np.array([where.get(key, -1) for key in first.text(match[0])], dtype=np.int64)
        if np.all(at < 0):
            raise InputError(
                f"{first.path}: no row of column '{first.name(match[0])}' is in column "
                f"'{second.name(match[1])}' of {second.path}"
            )
    kept = first.rows_with(at >= 0)
    taken = at[at >= 0]
    names = unique([*first.names, *second.names])
    columns = [[c[int(k)] for k in taken] for c in second.columns]
    renamed = dict(zip(second.names, names[len(first.names) :], strict=True))
    grid = Grid(
        first.path,
        names,
        kept.rows,
        (*kept.columns, *columns),
        (*first.formats, *second.formats),
        first.units | {renamed[name]: unit for name, unit in second.units.items()},
    )
    return grid, int(np.sum(at < 0))


def content_of(path: str | Path) -> bytes:
    """Read a file.

    Raises:
        InputError: no such file, or it cannot be read.
    """
    try:
        return limits.read_bytes(Path(path), limits.TABLE)
    except FileNotFoundError as e:
        raise InputError(f"{path}: no such file") from e
    except OSError as e:
        raise InputError(f"{path}: cannot be read ({e.strerror})") from e
