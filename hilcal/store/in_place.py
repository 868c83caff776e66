"""Whether an open file still is the one of its name; where not, its content is found or rescued."""

import os
import sqlite3
import tempfile
from contextlib import closing, suppress
from pathlib import Path

from hilcal.whole_file import replacing

Identity = tuple[int, int]
_OPEN = Path("/proc/self/fd")


def identity(path: Path | str) -> Identity | None:
    """Device and number of a file, by which it is the same under every name; None for none."""
    with suppress(OSError):
        found = os.stat(path)
        return found.st_dev, found.st_ino
    return None


def moved_to(known: Identity | None) -> Path | None:
    """Return where a file that this process has open is now; None for a deleted one."""
    with suppress(OSError):
        for descriptor in _OPEN.iterdir():
            if identity(descriptor) == known:
                with suppress(OSError):
                    now = descriptor.readlink()
                    if identity(now) == known:
                        return now
    return None


def rescued(connection: sqlite3.Connection, path: Path) -> Path:
    """Write a copy of an open file that has no name any more, beside where it was.

    Raises:
        InputError: it cannot be written.
    """
    home = path.absolute().parent
    folder = home if home.is_dir() else Path(tempfile.gettempdir())
    place, k = folder / f"{path.stem}.rescued{path.suffix}", 2
    while place.exists():
        place, k = folder / f"{path.stem}.rescued-{k}{path.suffix}", k + 1
    with replacing(place, must_be_new=True) as new, closing(sqlite3.connect(new)) as copy:
        connection.backup(copy)
    return place
