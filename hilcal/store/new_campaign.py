"""Make an empty campaign file: whole or not at all, and never in place of another kind of file."""

import os
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from hilcal.errors import InputError
from hilcal.store import rows, schema
from hilcal.whole_file import replacing


@contextmanager
def new_campaign(
    path: Path, about: Mapping[str, str], overwrite: bool
) -> Iterator[sqlite3.Connection]:
    """Give an empty campaign to the block; the file appears when the block has filled it.

    Args:
        about: texts about the campaign, by name.

    Raises:
        InputError: as for `may_write`, or it cannot be written.
        DeviceError: the disk is full or failed.
    """
    may_write(path, overwrite)
    with replacing(path) as new:
        try:
            with schema.sqlite_errors(path):
                connection = schema.connect(new)
                try:
                    connection.execute("PRAGMA journal_mode = DELETE")
                    with schema.transaction(connection):
                        for statement in schema.statements():
                            connection.execute(statement)
                        for key, value in about.items():
                            rows.insert_meta(connection, key, value)
                        yield connection
                finally:
                    connection.close()
        except BaseException:
            _without_sidecars(new)
            raise
        _without_sidecars(Path(os.path.realpath(path)))  # another file's journal


def may_write(path: Path, overwrite: bool) -> None:
    """Refuse to replace a file that is no campaign, or any without `overwrite`.

    Raises:
        InputError: names the file and the reason.
    """
    if not path.exists():
        return
    if not overwrite:
        raise InputError(f"{path}: the file exists; choose another name or ask to overwrite it")
    if not path.is_file() or (path.stat().st_size > 0 and not schema.is_campaign(path)):
        raise InputError(f"{path}: exists and is not a campaign; it is not overwritten")


def _without_sidecars(path: Path) -> None:
    """Remove what would be rolled back into a new file of this name."""
    for end in ("-journal", "-wal", "-shm"):
        path.with_name(path.name + end).unlink(missing_ok=True)
