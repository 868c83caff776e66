"""Delimited text to columns of numbers; every complaint names row and column."""

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_name, check_names, from_csv
from hilcal.types import Bools, Floats, Ints

_BLOCK = 4096
_BLANK = ("", "nan", "na", "n/a", "null", "-")
_NOT_TEXT = {
    b"SQLite format 3\x00": "an SQLite file (a campaign is opened, not imported)",
    b"PK\x03\x04": "a zip archive or spreadsheet; --preview proposes a mapping for it",
    b"\xff\xfe": "UTF-16 text; --preview proposes a mapping for it",
    b"\xfe\xff": "UTF-16 text; --preview proposes a mapping for it",
    b"PAR1": "a Parquet file; --preview proposes a mapping for it",
    b"MATLAB": "a MAT file; --preview proposes a mapping for it",
    b"\x1f\x8b": "a gzip file; unpack it first",
}


@dataclass(frozen=True, slots=True, eq=False)
class Dialect:
    """How a file writes its cells.

    Attributes:
        delimiter: what separates cells.
        decimal: the decimal mark.
        blank: whether an empty cell is a missing value (NaN) and not an error.
    """

    delimiter: str = ","
    decimal: str = "."
    blank: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """A parsed file.

    Attributes:
        path: the file's name, for messages.
        header: names of all columns.
        rows: (N,) row of each record as a spreadsheet counts, the header being row 1.
        text: text columns by name, N cells each, without blanks around.
        number: (N,) number columns by name.
        alias: what the file itself calls a column, where it is another name than here.
    """

    path: str
    header: tuple[str, ...]
    rows: Ints
    text: dict[str, list[str]]
    number: dict[str, Floats]
    alias: dict[str, str] = field(default_factory=dict)

    def at(self, index: int, column: str | None = None) -> str:
        """Where a record (and a cell) is, for messages."""
        where = f"{self.path}: row {self.rows[index]}"
        return where if column is None else f"{where}, column '{self.alias.get(column, column)}'"

    def matrix(self, names: Sequence[str]) -> Floats:
        """(N, k) number columns side by side."""
        return np.stack([self.number[name] for name in names], axis=1)

    def refuse(self, bad: Bools, names: Sequence[str], what: Callable[[float], str]) -> None:
        """Raise for the first true cell of an (N, k) mask over number columns.

        Raises:
            InputError: a cell is marked; `what` makes from its value the reason.
        """
        if bad.any():
            i, j = divmod(int(np.argmax(bad)), bad.shape[1])
            value = float(self.number[names[j]][i])
            raise InputError(f"{self.at(i, names[j])}: {what(value)}")


@limits.bounded
def read_columns(
    path: str | Path,
    choose: Callable[[list[str]], tuple[Sequence[str], Sequence[str]]],
    dialect: Dialect | None = None,
) -> CsvTable:
    """Read a delimited text file in blocks, in time and memory linear in its rows.

    Args:
        path: the file.
        choose: checks the header and returns the names of text and of number columns to keep.
        dialect: how the file writes its cells.

    Returns:
        The chosen columns.

    Raises:
        InputError: no such file, not text, empty, a row of another length, not a number.
    """
    name, dialect = str(path), dialect or Dialect()
    _refuse_binary(name)
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as stream:
            lines = limits.Lines(name, stream)
            reader = csv.reader(lines, delimiter=dialect.delimiter, strict=True)
            header = [cell.strip() for cell in next(reader, [])]
            check_names(header, f"{name}: row 1, column")
            lines.row(len(header))
            text, number = choose(header)
            return _parse(name, _records(reader, lines), header, text, number, dialect)
    except UnicodeDecodeError as e:
        raise InputError(
            f"{name}: not UTF-8 text; expected a CSV file; --preview proposes a mapping for others"
        ) from e
    except csv.Error as e:
        raise InputError(f"{name}: not a CSV file ({e})") from e
    except OSError as e:
        raise InputError(f"{name}: cannot be read ({e.strerror})") from e


def _refuse_binary(name: str) -> None:
    try:
        with Path(name).open("rb") as stream:
            head = stream.read(4096)
    except FileNotFoundError as e:
        raise InputError(f"{name}: no such file") from e
    except OSError as e:
        raise InputError(f"{name}: cannot be read ({e.strerror})") from e
    if not head.strip(b"\xef\xbb\xbf \t\r\n"):
        raise InputError(f"{name}: the file is empty; expected a CSV header and readings")
    for magic, what in _NOT_TEXT.items():
        if head.startswith(magic):
            raise InputError(f"{name}: not a CSV file but {what}")
    if b"\x00" in head:
        raise InputError(f"{name}: not a CSV file (binary data)")


def _records(reader: Iterator[list[str]], lines: limits.Lines) -> Iterator[tuple[int, list[str]]]:
    """Records that are not blank lines, with their rows as a spreadsheet counts."""
    for row, cells in enumerate(reader, start=2):
        lines.row(len(cells))
        if cells:
            yield row, cells


def _parse(
    name: str,
    records: Iterator[tuple[int, list[str]]],
    header: list[str],
    text: Sequence[str],
    number: Sequence[str],
    dialect: Dialect,
) -> CsvTable:
    at = {column: header.index(column) for column in (*text, *number)}
    rows: list[int] = []
    texts: dict[str, list[str]] = {column: [] for column in text}
    numbers: dict[str, list[Floats]] = {column: [np.empty(0)] for column in number}
    while block := list(islice(records, _BLOCK)):
        here = [row for row, _ in block]
        for row, cells in block:
            if len(cells) != len(header):
                raise InputError(
                    f"{name}: row {row} has {len(cells)} cells, the header has {len(header)}"
                )
        columns = list(zip(*(cells for _, cells in block), strict=True))
        for column in text:
            for row, cell in zip(here, columns[at[column]], strict=True):
                found = check_name(cell.strip(), f"{name}: row {row}, column '{column}'")
                texts[column].append(from_csv(found))
        for column in number:
            numbers[column].append(_numbers(name, here, column, columns[at[column]], dialect))
        rows += here
    if not rows:
        raise InputError(f"{name}: a header but no readings")
    joined = {column: np.concatenate(parts) for column, parts in numbers.items()}
    return CsvTable(name, tuple(header), np.array(rows, dtype=np.int64), texts, joined)


def _numbers(
    name: str, rows: list[int], column: str, cells: Sequence[str], dialect: Dialect
) -> Floats:
    """Numbers of one column of one block."""
    plain = cells
    if dialect.decimal != ".":
        plain = [c.replace(dialect.decimal, ".") if "." not in c else "?" + c for c in cells]
    if dialect.blank:
        plain = ["nan" if c.strip().lower() in _BLANK else c for c in plain]
    try:
        if any("_" in c for c in plain):
            raise ValueError
        values = np.fromiter(map(float, plain), dtype=float, count=len(plain))
    except ValueError:
        values = np.array([_number(c) for c in plain])
    allowed = np.isfinite(values) | (np.isnan(values) & dialect.blank & _blanks(plain, values))
    if not allowed.all():
        k = int(np.argmin(allowed))
        mark = "" if dialect.decimal == "." else f" with '{dialect.decimal}' as decimal mark"
        where = f"{name}: row {rows[k]}, column '{column}'"
        raise InputError(f"{where}: {_complaint(cells[k])}{mark}")
    return values


def _blanks(plain: Sequence[str], values: Floats) -> Bools:
    """Which cells are missing values, as opposed to text that is no number."""
    blank = np.zeros(len(values), dtype=bool)
    for k in np.flatnonzero(np.isnan(values)):
        blank[k] = plain[int(k)] == "nan"
    return blank


def _number(cell: str) -> float:
    """Return the number in a cell, NaN where there is none."""
    try:
        return float("nan") if "_" in cell else float(cell)
    except ValueError:
        return float("nan")


def _complaint(cell: str) -> str:
    cell = cell.strip()
    if not cell:
        return "the cell is empty; expected a number"
    if cell.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        return f"'{cell}' is not a finite number"
    shown = cell if len(cell) <= 40 else cell[:37] + "..."
    return f"'{shown}' is not a number"
