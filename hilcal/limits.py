"""Limits of the size of files, checked before memory is allocated for them.

The size that a file states (a zip archive's directory, the metadata of Parquet) is checked first,
its content is counted while it is read, and `memory` bounds the rest. All limits are choices, far
beyond the largest measured series; docs/reference/limits.md states them.
"""

import mmap
import resource
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, Self, TextIO, TypeVar

from hilcal.errors import InputError

SETTINGS = 1 << 19  # Bytes of a TOML file
TOML_DOTS = 100  # Dots in a line of TOML: the parser's time grows with the square of a key's parts
PROGRAM = 1 << 22  # Bytes of a robot's description, a file of effects
SCRIPT = 1 << 21  # Bytes of a robot program
STATEMENTS = 100_000  # Statements of a robot program
STATEMENT = 10_000  # Characters of a statement
NESTED_BLOCKS = 100  # Nested blocks around a statement
NESTED_EXPRESSIONS = 100  # Nested expressions in a statement
DOCUMENT = 1 << 25  # Bytes of a JSON document: plan, calibration, prior
VALUES = 2_000_000  # Values of a JSON document: Python takes some 100 bytes for an empty list
TABLE = 1 << 27  # Bytes of a table, as text or compressed
UNPACKED = 1 << 28  # Bytes of a decompressed table
LINE = 1 << 20  # Characters of a row of a table
ROWS = 1 << 20  # Rows of a table, empty ones included
COLUMNS = 2000  # Columns of a table
CELLS = 5_000_000  # Cells of a table
SHEETS = 100  # Sheets of a workbook
ELEMENTS = 1_000_000  # XML elements of a workbook's part other than a sheet, such as its styles
XML_DEPTH = 50  # Nested XML elements
DESCRIBED_JOINTS = 500
"""Joints of a robot's description, including fixed ones and those of grippers."""
MOVING_JOINTS = 100  # Joints of a robot's description that are not fixed
JOINTS = 32  # Joints of an arm
PARAMETERS = 4000  # Parameters of a model in a file
NUMBERS = 1 << 26  # Numbers of an array from a file
SHARED_COVARIANCE = 1 << 24
"""Numbers of joint covariances of readings with a common error: (L m)² of L."""
FITTED_ELEMENTS = 150_000  # Readings times elements that are fitted together
PLANNED_POSES = 20_000  # Poses of a plan, and steps of a plan: a week of measuring
MEMORY = 3 << 28  # Bytes that reading a file may take in addition to those of the process
_RESERVE_BYTES = 1 << 23  # Bytes that are freed first when memory runs out
_LOCK = threading.RLock()  # The memory limit is the process's: one thread at a time may set it
P = ParamSpec("P")
Q = TypeVar("Q", bound=str | Path)
T = TypeVar("T")
STREAM_HINT = "a longer series is fitted as a stream (docs/how-to/fit-a-stream.md)"


def check_size(name: str, size: int, most: int) -> None:
    """Refuse more than `most` bytes by an InputError that states them."""
    if size > most:
        raise InputError(f"{name}: {size / 1e6:.1f} MB; valid: at most {most / 1e6:.1f} MB")


def check_rows(name: str, rows: int) -> None:
    """Refuse too many rows; raises as `check_size` does."""
    if rows > ROWS:
        raise InputError(f"{name}: more than {ROWS} rows; {STREAM_HINT}")


def check_cells(name: str, rows: int, columns: int = 1) -> None:
    """Refuse too many columns or cells; raises as `check_size` does."""
    if columns > COLUMNS:
        raise InputError(f"{name}: {columns} columns; valid: at most {COLUMNS}")
    if rows * columns > CELLS:
        raise InputError(f"{name}: more than {CELLS / 1e6:.0f} million cells; {STREAM_HINT}")


def check_planned(name: str, items: str, count: int) -> None:
    """Refuse a plan of too many poses or steps; raises as `check_size` does."""
    if count > PLANNED_POSES:
        raise InputError(f"{name}: {count} {items}; valid: at most {PLANNED_POSES} in a plan")


class Lines:
    """The lines of a table's text; refuses rows longer than `LINE`."""

    def __init__(self, name: str, stream: TextIO) -> None:
        """Read from a stream; `name` is for messages."""
        self._name, self._stream, self._row_length, self._rows = name, stream, 0, 0

    def __iter__(self) -> Self:
        """Return the lines."""
        return self

    def __next__(self) -> str:
        """Return the next line; a row in quotes may have several."""
        line = self._stream.readline(LINE + 1)
        self._row_length += len(line)
        if self._row_length > LINE:
            raise InputError(
                f"{self._name}: row {self._rows + 1} is longer than {LINE} characters; valid: "
                "a line for each reading"
            )
        if not line:
            raise StopIteration
        return line

    def row(self, columns: int) -> None:
        """Count a complete row; raises as `check_rows` and `check_cells` do."""
        self._row_length = 0
        self._rows += 1
        check_rows(self._name, self._rows)
        check_cells(self._name, self._rows, columns)


def check_parameters(count: int) -> None:
    """Refuse too many parameters; raises as `check_size` does."""
    if count > PARAMETERS:
        raise InputError(f"{count} parameters; valid: at most {PARAMETERS}")


def check_numbers(name: str, count: int) -> None:
    """Refuse an array of too many numbers; raises as `check_size` does."""
    if count > NUMBERS:
        raise InputError(f"{name}: {count:.2g} numbers; valid: at most {NUMBERS:.2g}")


def check_fitted(readings: int, elements: int, where: str = "") -> None:
    """Refuse to fit too many readings together; raises as `check_size` does."""
    if readings * elements > FITTED_ELEMENTS:
        raise InputError(
            f"{where}{readings} readings of {elements} elements; valid: at most "
            f"{FITTED_ELEMENTS // elements} in a campaign: fewer, or means of repeats; "
            f"{STREAM_HINT}"
        )


def check_shared(shared: int, elements: int, groups: int) -> None:
    """Refuse too many readings with a common error, per group; raises as `check_size` does."""
    if groups * (shared * elements) ** 2 > SHARED_COVARIANCE:
        raise InputError(
            f"{shared} loaded readings share one unloaded reading or arrival"
            f"{f', {groups} times' if groups > 1 else ''}; valid: at most "
            f"{int((SHARED_COVARIANCE / groups) ** 0.5) // elements} of {elements} elements: "
            "measure unloaded again between them (another cycle), or fit absolute readings "
            "(--readings absolute)"
        )


def read_bytes(path: Path, most: int, missing: str = "no such file") -> bytes:
    """Read a file.

    Raises:
        InputError: a file that does not exist (with the text `missing`), cannot be read, or has
            more than `most` bytes.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(most + 1)
            if len(data) > most:
                check_size(str(path), max(path.stat().st_size, len(data)), most)
            return data
    except FileNotFoundError:
        raise InputError(f"{path}: {missing}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def read_text(path: Path, most: int, missing: str = "no such file") -> str:
    """Read a text in UTF-8 with any line ends; raises as `read_bytes`, or UnicodeDecodeError."""
    text = read_bytes(path, most, missing).decode("utf-8")
    return text.replace("\r\n", "\n").replace("\r", "\n")


@contextmanager
def memory(name: str) -> Iterator[None]:
    """Limit the memory that a block may use to `MEMORY`; an InputError where it needs more.

    A reserve is freed first, since even a small object may need memory when that has run out.
    """
    with _LOCK:
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        try:
            reserve = mmap.mmap(-1, _RESERVE_BYTES)
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        except OSError:  # no Linux
            yield
            return
        most, failed = pages * resource.getpagesize() + MEMORY, False
        least = [limit for limit in (soft, hard, most) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(least), hard))
        try:
            yield
        except MemoryError:
            failed = True
        finally:
            reserve.close()
            resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
    if failed:
        raise InputError(
            f"{name}: reading it takes more than {MEMORY / 1e6:.0f} MB of memory; valid: a smaller "
            "file"
        )


def bounded(read: Callable[Concatenate[Q, P], T]) -> Callable[Concatenate[Q, P], T]:
    """Decorate a function that reads the file of its first argument with the limit of `memory`."""

    @wraps(read)
    def within(path: Q, /, *args: P.args, **kwargs: P.kwargs) -> T:
        with memory(str(path)):
            return read(path, *args, **kwargs)

    return within
