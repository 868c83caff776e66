"""Make an empty campaign file: whole or not at all, and never in place of another kind of file."""

import os
from pathlib import Path

from hilcal.data import rows, schema
from hilcal.errors import InputError


def write_new(path: Path, about: dict[str, str], overwrite: bool) -> None:
    """Write an empty campaign file; it appears only when it is complete.

    Args:
        path: the file to make.
        about: texts about the campaign, by name.
        overwrite: replace an existing campaign.

    Raises:
        InputError: as for `may_write`.
        OSError: it cannot be written.
    """
    new = path.with_name(f".{path.name}.new")
    may_write(path, overwrite)
    for leftover in (new, *_sidecars(new)):
        leftover.unlink(missing_ok=True)
    new.touch()
    _fill(new, about)
    for leftover in _sidecars(path):  # a journal of another file would be rolled back in
        leftover.unlink(missing_ok=True)
    os.replace(new, path)


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


def _sidecars(path: Path) -> tuple[Path, ...]:
    return tuple(path.with_name(path.name + end) for end in ("-journal", "-wal", "-shm"))


def _fill(path: Path, about: dict[str, str]) -> None:
    with schema.sqlite_errors(path):
        connection = schema.connect(path)
        try:
            connection.execute("PRAGMA journal_mode = DELETE")
            with schema.transaction(connection):
                for statement in schema.statements():
                    connection.execute(statement)
                for key, value in about.items():
                    rows.insert_meta(connection, key, value)
        finally:
            connection.close()
