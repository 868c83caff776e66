"""Columns to a file, CSV or Parquet by the name's ending, and columns of a Parquet file.

Numbers keep every bit: CSV has the shortest decimals that are read back exactly, Parquet the
doubles themselves. A unit is the end of its column's name; in Parquet it is also in the field's
metadata, and what the table is about is in the schema's, as JSON under the key `hilcal`.
"""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_name, check_names, csv_text, escaped
from hilcal.tables.csvfile import CsvTable
from hilcal.types import Floats
from hilcal.whole_file import replacing

UNITS = ("m2", "rad2", "m", "rad", "N", "Nm", "s", "degC")
"""Ends of names that are units."""
KEY = b"hilcal"
SUFFIXES = (".csv", ".parquet")
MAGIC = b"PAR1"

Column = Sequence[object] | np.ndarray
"""Numbers, or words; None for a cell without a value."""


def check_suffix(path: Path) -> None:
    """Refuse names of other kinds of files.

    Raises:
        InputError: names the valid ones.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: unknown kind of table; valid: {' or '.join(SUFFIXES)}")


def write_columns(path: Path, columns: Mapping[str, Column], about: Mapping[str, object]) -> None:
    """Write columns of equal length; a file of that name is replaced when the new one is complete.

    Args:
        path: ends in .csv or .parquet.
        columns: by name.
        about: what the table is about, for the metadata of Parquet; CSV has no place for it.

    Raises:
        InputError: another ending, no pyarrow for Parquet, or the file cannot be written.
    """
    check_suffix(path)
    plain = {
        escaped(k): v.tolist() if isinstance(v, np.ndarray) else list(v) for k, v in columns.items()
    }
    if path.suffix.lower() == ".parquet":
        table = _arrow(path, plain, about)
        parquet = pyarrow_module(path, "pyarrow.parquet")
        with replacing(path) as new:
            parquet.write_table(table, new)
        return
    with replacing(path) as new, new.open("w", encoding="utf-8", newline="") as stream:
        out = csv.writer(stream, lineterminator="\n")
        out.writerow(map(csv_text, plain))
        cells = [[_cell(v) for v in values] for values in plain.values()]
        out.writerows(zip(*cells, strict=True))


def read_parquet(
    path: Path, choose: Callable[[list[str]], tuple[Sequence[str], Sequence[str]]]
) -> CsvTable:
    """Read columns of a Parquet file; rows count from 1.

    Args:
        path: the file.
        choose: checks the names and returns those of text and of number columns to keep.

    Raises:
        InputError: no pyarrow, a damaged file, a cell without a value or of another kind.
    """
    parquet = pyarrow_module(path, "pyarrow.parquet")
    chosen: list[Sequence[str]] = []

    def choose_columns(schema: Any) -> list[str]:
        chosen.extend(choose(list(schema.names)))
        return [*chosen[0], *chosen[1]]

    try:
        header, found = limited_parquet(
            path, lambda **kw: parquet.ParquetFile(path, **kw), choose_columns
        )
    except InputError:
        raise
    except Exception as e:  # what a reader makes of a damaged file is not documented
        words = " ".join(str(e).split())[:80]
        raise InputError(f"{path}: damaged, or not a Parquet file ({words})") from e
    check_names(header, f"{path}: column")
    text, number = chosen
    rows = np.arange(1, found.num_rows + 1)
    if not found.num_rows:
        raise InputError(f"{path}: columns but no readings")
    texts = {name: _texts(path, name, found[name].to_pylist()) for name in text}
    numbers = {name: _numbers(path, name, found[name]) for name in number}
    return CsvTable(str(path), tuple(header), rows, texts, numbers)


def limited_parquet(
    path: str | Path, opened: Callable[..., Any], choose: Callable[[Any], list[str]]
) -> tuple[list[str], Any]:
    """Return the names of all columns of a Parquet file, and the chosen ones as pyarrow's table.

    The metadata tell how large they become. Texts stay as numbers of a dictionary until it is known
    how long all of them are together: a file of 0.3 MB may hold one of 1 MB in each of 5,000 rows.

    Args:
        path: for messages.
        opened: opens the file, with pyarrow's options.
        choose: names of the columns to read, by the schema.

    Raises:
        InputError: too large, or a chosen column is neither of numbers nor of texts.
    """
    from pyarrow import compute, types

    what = str(path)
    with limits.memory(what):
        schema = opened().schema_arrow
        names = choose(schema)
        for name in names:
            if not is_plain(schema.field(name).type):
                raise InputError(f"{what}: column '{name}' holds neither numbers nor texts")
        texts = [
            name
            for name in names
            if types.is_large_string(t := schema.field(name).type) or types.is_string(t)
        ]
        file = opened(read_dictionary=texts)
        meta = file.metadata
        limits.check_cells(what, meta.num_rows, max(len(names), 1))
        # By row groups: pyarrow ends the process where the statistics of a column are damaged.
        sizes = (meta.row_group(k).total_byte_size for k in range(meta.num_row_groups))
        limits.check_size(f"{what}: unpacked", sum(sizes), limits.UNPACKED)
        found = file.read(columns=names)
        for name in texts:
            for part in found[name].chunks:
                each = compute.binary_length(part.dictionary).take(part.indices)
                size = compute.sum(each).as_py() or 0
                limits.check_size(f"{what}: column '{name}'", size, limits.UNPACKED // 4)
    return list(schema.names), found


def is_plain(kind: Any) -> bool:
    """Whether a column of this type of pyarrow holds a number, a text or a time in each row."""
    from pyarrow import types

    texts = types.is_string(kind) or types.is_large_string(kind)
    numbers = types.is_primitive(kind) or types.is_decimal(kind) or types.is_null(kind)
    return bool(texts or numbers)


def is_parquet(path: Path) -> bool:
    """Whether a file begins as Parquet does."""
    try:
        with path.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def unit_of(name: str) -> str | None:
    """Return the unit that a column's name ends in."""
    if name.startswith("cov_"):
        parts = ["rad" if part.startswith("r") else "m" for part in name.split("_")[1:3]]
        return f"{parts[0]}2" if parts[0] == parts[1] else "m rad"
    end = name.rpartition("_")[2]
    return end if end in UNITS else None


def _cell(value: object) -> object:
    """Return a cell as CSV writes it."""
    if isinstance(value, str):
        return csv_text(value)
    return "" if value is None else repr(value) if isinstance(value, float) else value


def _arrow(path: Path, columns: Mapping[str, list[Any]], about: Mapping[str, object]) -> Any:
    arrow = pyarrow_module(path, "pyarrow")
    texts = ([escaped(v) if isinstance(v, str) else v for v in c] for c in columns.values())
    arrays = [arrow.array(values) for values in texts]
    fields = []
    for name, array in zip(columns, arrays, strict=True):
        unit = unit_of(name)
        fields.append(arrow.field(name, array.type, metadata={"unit": unit} if unit else None))
    schema = arrow.schema(fields, metadata={KEY: json.dumps(dict(about)).encode()})
    return arrow.table(arrays, schema=schema)


def _texts(path: Path, name: str, values: list[object]) -> list[str]:
    for k, value in enumerate(values, start=1):
        if not isinstance(value, str):
            raise InputError(f"{path}: row {k}, column '{name}': {value!r} is no text")
    return [check_name(str(v).strip(), f"{path}: column '{name}'") for v in values]


def _numbers(path: Path, name: str, column: Any) -> Floats:
    """Return a column of numbers; raises where it is none."""
    values = column.to_pylist()
    for k, value in enumerate(values, start=1):
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not np.isfinite(value):
            raise InputError(f"{path}: row {k}, column '{name}': {value!r} is not a finite number")
    return np.array(values, dtype=float)


def pyarrow_module(path: Path, module: str) -> Any:
    """Import a part of pyarrow; raises InputError where it is not installed."""
    from importlib import import_module

    try:
        return import_module(module)
    except ImportError as e:
        raise InputError(
            f"{path}: Parquet needs the package pyarrow: pip install hilcal[tables]"
        ) from e
