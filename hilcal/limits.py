"""How large a file may be that is read: checked before memory is taken for it.

What a file says of its own size (a zip archive's directory, the metadata of Parquet) is checked
first, what it turns out to hold is counted while it is read, and `memory` ends what is left. All of
them are choices, far beyond the largest measured series; docs/reference/limits.md states them.
"""

import mmap
import resource
import threading
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import Concatenate, ParamSpec, Self, TextIO, TypeVar

from hilcal.errors import InputError

SETTINGS = 1 << 19  # Bytes of a TOML file
DOTS = 100
"""Dots in a line of it: the time that its parser takes grows by the square of a key's parts."""
PROGRAM = 1 << 22  # Bytes of a robot's description, a file of effects
SCRIPT = 1 << 21  # Bytes of a program of the robot
STATEMENTS = 100_000  # Statements of it
STATEMENT = 10_000  # Characters of one
BLOCKS = 100  # Blocks in each other in which one stands
NESTED = 100  # Expressions in each other in one
DOCUMENT = 1 << 25  # Bytes of a JSON document: plan, calibration, prior
VALUES = 2_000_000  # Values of it: Python takes some 100 bytes for the three of an empty list
TABLE = 1 << 27  # Bytes of a table, as text or packed
UNPACKED = 1 << 28  # Bytes that a packed table unpacks to
LINE = 1 << 20  # Characters of a row of a table
ROWS = 1 << 20  # Rows of a table, empty ones included
COLUMNS = 2000  # Columns of a table
CELLS = 5_000_000  # Cells of a table
SHEETS = 100  # Sheets of a workbook
ELEMENTS = 1_000_000  # Elements of a part of a workbook that is no sheet, as its texts and styles
DEEP = 50  # Elements in each other
DESCRIBED = 500  # Joints of a robot's description, fixed ones and those of grippers included
MOVING = 100  # Of them those that are not fixed
JOINTS = 32  # Joints of an arm
PARAMETERS = 4000  # Parameters of a model that a file holds
NUMBERS = 1 << 26  # Numbers of an array that a file makes
SHARED = 1 << 24
"""Numbers of the joint covariances of readings that share an error, (L m)² for L of m elements."""
FITTED = 150_000  # Readings, times elements, of a campaign: that are fitted together
PLANNED = 20_000  # Poses of a plan, and its steps: a week of measuring
MEMORY = 3 << 28  # Bytes that reading one file may take beyond what the process has
_KEPT = 1 << 23  # Bytes that are given back before anything is done about memory that is short
_ONE = threading.RLock()
"""The limit of memory is the whole process's, so that one thread at a time sets it."""
P = ParamSpec("P")
Q = TypeVar("Q", bound=str | Path)
T = TypeVar("T")
STREAM = "a longer series is fitted as a stream (docs/how-to/fit-a-stream.md)"


def check_size(what: str, size: int, most: int) -> None:
    """Refuse so many bytes.

    Raises:
        InputError: names them and the limit.
    """
    if size > most:
        raise InputError(f"{what}: {size / 1e6:.1f} MB; valid: at most {most / 1e6:.1f} MB")


def check_rows(what: str, rows: int) -> None:
    """Refuse so many rows; raises as `check_size` does."""
    if rows > ROWS:
        raise InputError(f"{what}: more than {ROWS} rows; {STREAM}")


def check_cells(what: str, rows: int, columns: int = 1) -> None:
    """Refuse so many columns or cells; raises as `check_size` does."""
    if columns > COLUMNS:
        raise InputError(f"{what}: {columns} columns; valid: at most {COLUMNS}")
    if rows * columns > CELLS:
        raise InputError(f"{what}: more than {CELLS / 1e6:.0f} million cells; {STREAM}")


def check_planned(what: str, of: str, count: int) -> None:
    """Refuse a plan of so many poses or steps; raises as `check_size` does."""
    if count > PLANNED:
        raise InputError(f"{what}: {count} {of}; valid: at most {PLANNED} in a plan")


class Lines:
    """The lines of a table's text, no row of which is longer than `LINE`."""

    def __init__(self, what: str, stream: TextIO) -> None:
        """Read from a stream; `what` names it in messages."""
        self._what, self._stream, self._taken, self._rows = what, stream, 0, 0

    def __iter__(self) -> Self:
        """Return the lines."""
        return self

    def __next__(self) -> str:
        """Return the next line; a row in quotes may have several."""
        line = self._stream.readline(LINE + 1)
        self._taken += len(line)
        if self._taken > LINE:
            raise InputError(
                f"{self._what}: row {self._rows + 1} is longer than {LINE} characters; valid: "
                "a line for each reading"
            )
        if not line:
            raise StopIteration
        return line

    def row(self, columns: int) -> None:
        """Take note that a row is complete; raises as `check_rows` and `check_cells` do."""
        self._taken = 0
        self._rows += 1
        check_rows(self._what, self._rows)
        check_cells(self._what, self._rows, columns)


def check_parameters(count: int) -> None:
    """Refuse so many parameters; raises as `check_size` does."""
    if count > PARAMETERS:
        raise InputError(f"{count} parameters; valid: at most {PARAMETERS}")


def check_numbers(what: str, count: int) -> None:
    """Refuse an array of so many numbers; raises as `check_size` does."""
    if count > NUMBERS:
        raise InputError(f"{what}: {count:.2g} numbers; valid: at most {NUMBERS:.2g}")


def check_fitted(readings: int, elements: int, where: str = "") -> None:
    """Refuse to fit so many readings together; raises as `check_size` does."""
    if readings * elements > FITTED:
        raise InputError(
            f"{where}{readings} readings of {elements} elements; valid: at most "
            f"{FITTED // elements} in a campaign: fewer, or means of repeats; {STREAM}"
        )


def check_shared(shared: int, elements: int, groups: int) -> None:
    """Refuse so many readings that share an error, in each group; raises as `check_size` does."""
    if groups * (shared * elements) ** 2 > SHARED:
        raise InputError(
            f"{shared} loaded readings share one unloaded reading or arrival"
            f"{f', {groups} times' if groups > 1 else ''}; valid: at most "
            f"{int((SHARED / groups) ** 0.5) // elements} of {elements} elements: measure unloaded "
            "again between them (another cycle), or fit absolute readings (--readings absolute)"
        )


def read_bytes(path: Path, most: int) -> bytes:
    """Read a file; InputError where it has more than so many bytes."""
    with path.open("rb") as stream:
        data = stream.read(most + 1)
        if len(data) > most:
            check_size(str(path), max(path.stat().st_size, len(data)), most)
        return data


def read_text(path: Path, most: int) -> str:
    """Read a UTF-8 text of at most so many bytes; raises as `read_bytes`, or UnicodeDecodeError."""
    return read_bytes(path, most).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")


class _Memory:
    """What `memory` returns.

    Where memory is short, hardly anything can be done but what takes none: a small object may need
    a new block, and none is to be had. So a block is kept that is given back first.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._before: tuple[int, int] | None = None
        self._kept: mmap.mmap | None = None

    def __enter__(self) -> None:
        _ONE.acquire()
        self._before = soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        try:
            self._kept = mmap.mmap(-1, _KEPT)
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        except OSError:  # no Linux
            return
        most = pages * resource.getpagesize() + MEMORY
        least = [limit for limit in (soft, hard, most) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(least), hard))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._kept is not None:
            self._kept.close()
        if self._before is not None:
            resource.setrlimit(resource.RLIMIT_AS, self._before)
        _ONE.release()
        if kind is not None and issubclass(kind, MemoryError):
            raise InputError(
                f"{self._what}: reading it takes more than {MEMORY / 1e6:.0f} MB of memory; valid: "
                "a smaller file"
            ) from None


def memory(what: str) -> _Memory:
    """End what takes more than `MEMORY` beyond what the process has; used by `with`.

    Raises:
        InputError: it did.
    """
    return _Memory(what)


def bounded(read: Callable[Concatenate[Q, P], T]) -> Callable[Concatenate[Q, P], T]:
    """Let a function that reads the file it is given first take no more than `memory` allows."""

    @wraps(read)
    def within(path: Q, /, *args: P.args, **kwargs: P.kwargs) -> T:
        with memory(str(path)):
            return read(path, *args, **kwargs)

    return within
