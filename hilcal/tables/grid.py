"""The table of a file: a `Grid` of cells, and a `ColumnTable` of columns with a meaning.

`hilcal.tables.files` reads a file into a `Grid`. The names of its columns (exchange table) or a
mapping give them a meaning, which makes a `ColumnTable` of numbers and texts.
"""

import itertools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_name, check_names, from_csv
from hilcal.tables.mapping import FileFormat
from hilcal.toml import suggest
from hilcal.types import Bools, Floats, Ints

Cell = str | float | datetime | None
Check = Callable[[Sequence[str]], object]  # Refuses a wrong header, before any other check

BLANK = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--", "---")
"""Marks of a missing number, in small letters."""

_PLAIN = str.maketrans({"\u2212": "-", "\u00a0": " ", "\u202f": " ", "\u2019": "'"})
"""Signs that programs write in place of minus, blank and apostrophe."""

_SHOWN = 12  # Columns that a message lists; the rest are counted


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A table of cells."""

    path: str  # the file's name, for messages
    names: tuple[str, ...]  # of the columns; "1", "2", ... where the file has no header
    rows: Ints  # (N,) row of each record as an editor or a spreadsheet counts, from 1
    columns: tuple[Sequence[Cell], ...]  # N cells of each column
    formats: tuple[FileFormat, ...]  # how the cells of each column are written
    units: dict[str, str] = field(default_factory=dict)  # cells of the row of units, by column

    def __post_init__(self) -> None:
        limits.check_cells(self.path, len(self.rows), len(self.names))
        check_names(self.names, f"{self.path}: column")

    def at(self, index: int, column: str | int) -> str:
        """Where a cell is, for messages."""
        return f"{self.path}: row {self.rows[index]}, column '{self.name(column)}'"

    def name(self, column: str | int) -> str:
        """Return the name of a column that a mapping gives by name or by number, from 1."""
        if isinstance(column, int):
            if column > len(self.names):
                raise InputError(
                    f"{self.path}: the mapping asks for column {column}, there are "
                    f"{len(self.names)}"
                )
            return self.names[column - 1]
        if column not in self.names:
            hidden = len(self.names) - _SHOWN
            suffix = f" and {hidden} more" if hidden > 0 else ""
            raise InputError(
                f"{self.path}: no column '{column}'{suggest(column, self.names)}; it has "
                f"{', '.join(self.names[:_SHOWN])}{suffix}"
            )
        return column

    def cells(self, column: str | int) -> Sequence[Cell]:
        """Return the cells of a column."""
        return self.columns[self.names.index(self.name(column))]

    def text(self, column: str | int) -> list[str]:
        """Cells as text; whole numbers without a decimal point, nothing for empty cells."""
        cells = (text_of(c) for c in self.cells(column))
        return [from_csv(check_name(c, self.at(k, column))) for k, c in enumerate(cells)]

    def times(self, column: str | int, date: str | int | None = None) -> list[Cell]:
        """Cells of a column of times; with a column of dates, "date time" in one."""
        cells = list(self.cells(column))
        if date is None:
            return cells
        days = self.cells(date)
        return [
            f"{_part(d, '%Y-%m-%d')} {_part(c, '%H:%M:%S.%f')}"
            for d, c in zip(days, cells, strict=True)
        ]

    def numbers(self, column: str | int, *, complete: bool = False) -> Floats:
        """(N,) numbers of a column, NaN where a value is missing, which `complete` refuses."""
        cells, how = self.cells(column), self._format(column)
        values = np.fromiter((number(c, how) for c in cells), dtype=float, count=len(cells))
        for (k,) in first_true(~np.isfinite(values) if complete else np.isinf(values)):
            raise InputError(f"{self.at(k, column)}: {_complaint(cells[k], how, complete)}")
        for mark in how.missing:
            if isinstance(mark, float | int):
                values[values == mark] = np.nan
        return values

    def rows_with(self, keep: Bools | Ints) -> "Grid":
        """Return rows, chosen by a mask or by their numbers from 0, which may repeat."""
        chosen = np.arange(len(self.rows))[keep].tolist()
        columns = tuple([c[k] for k in chosen] for c in self.columns)
        return replace(self, rows=self.rows[chosen], columns=columns)

    def with_column(self, name: str, cells: Sequence[Cell], like_column: str | int) -> "Grid":
        """Return the table with a further column, in the format of the column `like_column`."""
        names, columns = (*self.names, name), (*self.columns, cells)
        formats = (*self.formats, self._format(like_column))
        return replace(self, names=names, columns=columns, formats=formats)

    def _format(self, column: str | int) -> FileFormat:
        return self.formats[self.names.index(self.name(column))]


@dataclass(frozen=True, slots=True, eq=False)
class ColumnTable:
    """Columns with a meaning, numbers in SI units."""

    path: str  # the file's name, for messages
    rows: Ints  # (N,) row of each record as an editor or a spreadsheet counts
    text: dict[str, list[str]]  # text columns by name, N cells each, without blanks around
    number: dict[str, Floats]  # (N,) number columns by name
    alias: dict[str, str] = field(default_factory=dict)  # the file's name of a column

    @classmethod
    def of(
        cls, grid: Grid, text: Sequence[str], number: Sequence[str], sparse: Collection[str] = ()
    ) -> "ColumnTable":
        """Read columns by name; only cells of `sparse` ones may be empty."""
        numbers = {name: grid.numbers(name, complete=name not in sparse) for name in number}
        return cls(grid.path, grid.rows, {name: grid.text(name) for name in text}, numbers)

    def select(self, rows: Bools) -> "ColumnTable":
        """Return the chosen rows."""
        chosen = np.flatnonzero(rows).tolist()
        return replace(
            self,
            rows=self.rows[rows],
            text={name: [cells[k] for k in chosen] for name, cells in self.text.items()},
            number={name: values[rows] for name, values in self.number.items()},
        )

    def at(self, index: int, column: str | None = None) -> str:
        """Where a record (and a cell) is, for messages."""
        where = f"{self.path}: row {self.rows[index]}"
        return where if column is None else f"{where}, column '{self.alias.get(column, column)}'"

    def matrix(self, names: Sequence[str]) -> Floats:
        """(N, k) number columns side by side."""
        return np.stack([self.number[name] for name in names], axis=1)

    def refuse(self, bad: Bools, names: Sequence[str], message: Callable[[float], str]) -> None:
        """Raise for the first true cell of an (N, k) mask over number columns."""
        for i, j in first_true(bad):
            value = float(self.number[names[j]][i])
            raise InputError(f"{self.at(i, names[j])}: {message(value)}")


def first_true(bad: Bools) -> list[list[int]]:
    """Place of the first true element of a mask, as a list of one; empty if all are false."""
    places: list[list[int]] = np.argwhere(bad)[:1].tolist()
    return places


def _part(cell: Cell, form: str) -> str:
    return cell.strftime(form) if isinstance(cell, datetime) else str(cell or "").strip()


def text_of(cell: Cell) -> str:
    """Return a cell as text; whole numbers without a decimal point, nothing for an empty one."""
    if cell is None:
        return ""
    if isinstance(cell, float | np.floating | np.integer):
        return str(int(cell)) if float(cell).is_integer() else repr(float(cell))
    return str(cell).strip()


def number(cell: Cell, file_format: FileFormat) -> float:
    """Return a cell's number; NaN where it is missing, infinite where it is no finite number."""
    if isinstance(cell, bool | datetime):
        return float("inf")
    if cell is None or not isinstance(cell, str):
        return float("nan") if cell is None else float(cell)
    plain = cell.translate(_PLAIN).strip()
    if plain.lower() in BLANK or plain in file_format.missing:
        return float("nan")
    if file_format.thousands and file_format.thousands in plain:
        groups = plain.split(file_format.decimal)[0].lstrip("+-").split(file_format.thousands)
        if not 0 < len(groups[0]) <= 3 or any(len(part) != 3 for part in groups[1:]):
            return float("inf")
        plain = plain.replace(file_format.thousands, "")
    if "_" in plain or (file_format.decimal == "," and "." in plain):
        return float("inf")
    try:
        value = float(plain.replace(file_format.decimal, "."))
    except ValueError:
        return float("inf")
    return value if np.isfinite(value) else float("inf")


def _complaint(cell: Cell, how: FileFormat, complete: bool) -> str:
    shown = "" if cell is None else str(cell).strip()
    shown = shown if len(shown) <= 40 else shown[:37] + "..."
    if complete and not shown:
        return "the cell is empty; expected a number"
    mark = "" if complete and how.decimal == "." else f" with '{how.decimal}' as decimal mark"
    if not complete:
        mark += "; cells without a value are left empty, or listed in [file] missing"
    finite = complete and shown.lower().lstrip("+-") in ("nan", "inf", "infinity")
    return f"'{shown}' is not a{' finite' * finite} number{mark}"


def unique(names: Sequence[str]) -> tuple[str, ...]:
    """Make names unique, as "X", "X (2)"; that of a column without one is its number."""
    out: dict[str, None] = {}
    for k, title in enumerate(names, start=1):
        first = title or str(k)
        numbered = (f"{first} ({count})" for count in itertools.count(2))
        out[next(name for name in itertools.chain((first,), numbered) if name not in out)] = None
    return tuple(out)


def joined(
    first: Grid, second: Grid, match: tuple[str | int, str | int] | None
) -> tuple[Grid, int]:
    """Return the first table with the second one's columns, and the number of rows left out.

    Rows are matched by number, or by a column of each that holds the same text. Rows of the first
    table without a partner are left out. A column name of both gets "(2)" in the second table.
    """
    if match is None:
        if len(first.rows) != len(second.rows):
            raise InputError(
                f"{second.path}: {len(second.rows)} rows, {first.path} has {len(first.rows)}; give "
                f"tables of the same length, or [second_file] match with the column of each "
                f"that names the row"
            )
        partner = np.arange(len(first.rows))
    else:
        where: dict[str, int] = {}
        for k, key in enumerate(second.text(match[1])):
            if where.setdefault(key, k) != k:
                raise InputError(
                    f"{second.at(k, match[1])}: '{key}' is in row {second.rows[where[key]]}, too; "
                    "a column that matches rows must differ in each"
                )
        partner = np.array([where.get(key, -1) for key in first.text(match[0])], dtype=np.int64)
        if np.all(partner < 0):
            raise InputError(
                f"{first.path}: no row of column '{first.name(match[0])}' is in column "
                f"'{second.name(match[1])}' of {second.path}"
            )
    matched, partners = first.rows_with(partner >= 0), second.rows_with(partner[partner >= 0])
    names = unique([*first.names, *second.names])
    renamed = dict(zip(second.names, names[len(first.names) :], strict=True))
    grid = replace(
        matched,
        names=names,
        columns=(*matched.columns, *partners.columns),
        formats=(*first.formats, *second.formats),
        units=first.units | {renamed[name]: unit for name, unit in second.units.items()},
    )
    return grid, int(np.sum(partner < 0))
