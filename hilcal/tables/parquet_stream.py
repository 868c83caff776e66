"""Readings of a moving arm that do not fit into memory: a Parquet file, chunk by chunk.

The columns are those of the exchange table, without `pose`, `load` and `cycle`: each row is a
reading that stands alone. A worker reads one row group of the file, in chunks of `CHUNK` rows, so
that memory does not grow with the file or its row groups.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.readings.covariance import INSTRUMENT, ROUNDING, TrackerNoise
from hilcal.readings.readings import Readings
from hilcal.robot.arm import Arm
from hilcal.robot.se3 import CHUNK
from hilcal.tables import columns
from hilcal.tables.files import is_plain, package, undamaged
from hilcal.tables.grid import ColumnTable, first_true
from hilcal.tables.table import check_covers, covariances_of, measured_of
from hilcal.tables.uncertainty import rounding_variance
from hilcal.types import Floats

NAMES = ("pose", "load", "cycle")  # Columns that a stream may have, but that mean nothing in it


@dataclass(frozen=True, slots=True, eq=False)
class ReadingStream:
    """A Parquet file of readings, none of which are held in memory."""

    path: Path
    arm: Arm  # its number of joints, their limits and its reach are checked
    noise: TrackerNoise | None  # gives the covariances where the file has none
    station: tuple[float, ...] | None  # (3,) where the tracker's beam starts, m; None: the origin
    columns: tuple[str, ...]
    rows: tuple[int, ...]  # number of rows of each row group
    covers: str = INSTRUMENT  # what its covariances cover, `INSTRUMENT` or `INSTRUMENT_AND_ARM`
    rounding: Floats = field(default_factory=lambda: np.zeros(3))  # (3,) variance that it adds, m²

    def __len__(self) -> int:
        return sum(self.rows)

    def first_row(self, group: int) -> int:
        """Return the number of readings before a row group."""
        return sum(self.rows[:group])

    def chunks(self, group: int) -> Iterator[Readings]:
        """Yield the readings of a row group, at most `CHUNK` at a time."""
        row = 1 + self.first_row(group)
        for table in _tables(self.path, group, self.columns):
            yield self._readings(table, row)
            row += table.num_rows

    def _readings(self, batch: Any, row: int) -> Readings:
        rows = np.arange(row, row + batch.num_rows)
        number = {
            name: _numbers(self.path, name, batch.column(k), row)
            for k, name in enumerate(self.columns)
        }
        table = ColumnTable(str(self.path), rows, {}, number)
        states, value = measured_of(table, self.arm)
        pose, zeros = np.arange(len(rows)), np.zeros(len(rows), dtype=np.int64)
        columns.check_wrenches(table, states.wrench, zeros, ["as recorded"], self.arm)
        covariance, *_ = covariances_of(table, value, self.noise, self.station, None, self.rounding)
        return Readings(states, pose, zeros, zeros, value, covariance, ("as recorded",), ())


def open_stream(
    path: Path, arm: Arm, noise: TrackerNoise | None, station: tuple[float, ...] | None
) -> ReadingStream:
    """Open a Parquet file of readings, of which metadata and the first rows are read."""
    file = _opened(path)
    header = list(file.schema_arrow.names)
    # Without the names of poses and loads the header is that of an exchange table.
    table_header = [*columns.TEXT, *(name for name in header if name not in NAMES)]
    columns.check_header(str(path), table_header, arm.units, arm.name)
    if columns.TARGET in header:
        raise InputError(
            f"{path}: column '{columns.TARGET}': a stream is of one target; import a table of "
            "several with `hilcal import`"
        )
    columns.check_covariance_columns(str(path), header)
    valid = set(columns.known_columns(arm.units)) - {*NAMES, columns.COVERS}
    meta = file.metadata
    rows = tuple(meta.row_group(k).num_rows for k in range(meta.num_row_groups))
    if not sum(rows):
        raise InputError(f"{path}: columns but no readings")
    names = tuple(name for name in header if name in valid)
    for name in names:
        if not is_plain(kind := file.schema_arrow.field(name).type) or "string" in str(kind):
            raise InputError(f"{path}: column '{name}' is no column of numbers")
    stream = ReadingStream(path, arm, noise, station, names, rows)
    first = next(k for k, count in enumerate(rows) if count)
    covers = _covers(path, first) if columns.COVERS in header else INSTRUMENT
    if covers.endswith(ROUNDING):
        return replace(stream, covers=covers.removesuffix(ROUNDING))
    rounding = rounding_variance(next(stream.chunks(first)).value[:, :3], 1.0)
    return replace(stream, covers=covers, rounding=rounding)


def _opened(path: Path) -> Any:
    parquet = package(path, "pyarrow.parquet", "Parquet")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    last = "its last part is written when recording ends: was it interrupted?"
    with undamaged(path, f"not a whole Parquet file; {last}"):
        # pages are read as they are needed: a row group may be larger than the memory
        return parquet.ParquetFile(path, buffer_size=1 << 20, pre_buffer=False)


def _tables(path: Path, group: int, names: tuple[str, ...], count: int = CHUNK) -> Iterator[Any]:
    file = _opened(path)
    remaining = file.metadata.row_group(group).num_rows
    batches = file.iter_batches(count, row_groups=[group], columns=list(names))
    while remaining > 0:
        with undamaged(path, f"damaged in row group {group + 1}"), limits.memory(str(path)):
            batch = next(batches, None)
        if batch is None:
            raise InputError(
                f"{path}: damaged in row group {group + 1} ({remaining} rows are missing)"
            )
        remaining -= batch.num_rows
        yield batch.select(list(names))


def _covers(path: Path, group: int) -> str:
    word = str(next(_tables(path, group, (columns.COVERS,), 1)).column(0)[0].as_py())
    check_covers(word, f"{path}: row 1, column '{columns.COVERS}'")
    return word


def _numbers(path: Path, name: str, column: Any, row: int) -> Floats:
    try:
        values = np.asarray(column.to_numpy(zero_copy_only=False), dtype=float)
    except (TypeError, ValueError) as e:
        raise InputError(f"{path}: column '{name}' is no column of numbers") from e
    for (k,) in first_true(~np.isfinite(values)):
        raise InputError(
            f"{path}: row {row + k}, column '{name}': not a finite number; leave out the rows that "
            "were not read"
        )
    return values
