"""Schema of a campaign file: tables that only grow.

The journal is SQLite's rollback journal, not a write-ahead log: committed data are in the one file
alone, whatever ends the process. A `-journal` next to the file only undoes an unfinished
transaction; the next opening removes it. Source: SQLite documentation, "Atomic Commit In SQLite"
and "PRAGMA synchronous".
"""

import fcntl
import os
import re
import sqlite3
import stat
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import cache
from pathlib import Path

from hilcal import limits
from hilcal.errors import DeviceError, HilcalError, InputError, undone_by
from hilcal.whole_file import SQLITE

APPLICATION_ID = 0x68696C63  # "hilc"
ONE_TARGET, SEVERAL_TARGETS, CHOSEN_REVISION = 2, 3, 4
CARRIED_PRIOR, CHANGED_CELL, MORE_COLUMNS, LOST_TEMPERATURES = 5, 6, 7, 8
"""Versions of a file: readings of one target, or of several; an accepted revision, or one not made
from the previous one; a revision with a prior of another campaign, or in a changed cell; readings
with joint torques, or of several observers; readings of which some lack their temperatures. Older
programs would misread a file of a newer one."""
VERSION = LOST_TEMPERATURES
HEADER = SQLITE
_JOURNAL = bytes.fromhex("d9d505f920a163d7")  # also at the end of a journal that ends in a name

_MEASURING = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, 1 << 40, 1, 0)
"""The lock of a measuring process, see `lock`: a `struct flock` of one byte."""
_TABLES = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, crc INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE poses (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE loads (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE);
CREATE TABLE readings (
    id INTEGER PRIMARY KEY,
    pose INTEGER NOT NULL REFERENCES poses (id),
    load INTEGER NOT NULL REFERENCES loads (id),
    cycle INTEGER NOT NULL,
    record BLOB NOT NULL,
    crc INTEGER NOT NULL
);
CREATE INDEX readings_pose ON readings (pose);
CREATE TABLE revisions (id INTEGER PRIMARY KEY, content TEXT NOT NULL, crc INTEGER NOT NULL);
CREATE TABLE details (
    id INTEGER PRIMARY KEY REFERENCES readings (id),
    step TEXT NOT NULL UNIQUE,
    content TEXT NOT NULL,
    crc INTEGER NOT NULL
);
CREATE TABLE events (id INTEGER PRIMARY KEY, content TEXT NOT NULL, crc INTEGER NOT NULL);
"""
_KEYS = {"meta": "key"} | dict.fromkeys(
    ("poses", "loads", "readings", "revisions", "details", "events"), "id"
)
_SINCE = {"details": 2, "events": 2}
_MESSAGES: dict[str, tuple[type[HilcalError], str]] = {
    "malformed|not a database": (InputError, "the campaign file is damaged or truncated ({})"),
    "full|I/O error": (
        DeviceError,
        "cannot be written ({}); nothing that was stored is lost: make room on the disk",
    ),
    "too big": (
        InputError,
        f"a record is larger than {limits.DOCUMENT / 1e6:.0f} MB, which no campaign has",
    ),
    "locked|busy": (
        InputError,
        "another program has kept the campaign locked for 5 s: end it first",
    ),
    "readonly|unable to open": (
        InputError,
        "cannot be written ({}): the file or its folder is read-only; valid: a copy in a folder "
        "that can be written",
    ),
}
"""Error and message by a pattern in SQLite's message."""
_LONGEST_S = 60.0  # longest time to check a file when it is opened; a choice


def statements() -> list[str]:
    """Return the statements that make an empty campaign, with triggers against changes."""
    created = [s for s in _TABLES.split(";") if s.strip()]
    for table, key in _KEYS.items():
        refuse = f"BEGIN SELECT RAISE(ABORT, '{table} are immutable: append only'); END"
        exists = f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {key} = NEW.{key}) "  # noqa: S608
        created += [
            f"CREATE TRIGGER {table}_no_{suffix} BEFORE {event} ON {table} {condition}{refuse}"
            for suffix, event, condition in (
                ("update", "UPDATE", ""),
                ("delete", "DELETE", ""),
                ("replace", "INSERT", exists),
            )
        ]
    created += [f"PRAGMA application_id = {APPLICATION_ID}", f"PRAGMA user_version = {ONE_TARGET}"]
    return created


def is_campaign(path: Path) -> bool:
    """Whether a file's header is that of a campaign; its content is not checked."""
    with path.open("rb") as stream:
        head = stream.read(72)
    return head.startswith(HEADER) and head[68:72] == APPLICATION_ID.to_bytes(4, "big")


@contextmanager
def sqlite_errors(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into errors of one line."""
    try:
        yield
    except UnicodeEncodeError as e:
        raise InputError(f"{path}: a text is not valid Unicode ({e.object!r})") from e
    except UnicodeDecodeError as e:  # SQLite's own message quotes a damaged name
        raise InputError(f"{path}: the campaign file is damaged") from e
    except sqlite3.DatabaseError as e:
        text = str(e)
        kinds = (kind for words, kind in _MESSAGES.items() if re.search(words, text))
        error, message = next(kinds, (InputError, "the campaign file cannot be used ({})"))
        raise error(f"{path}: {message.format(text)}") from e


def connect(path: Path, read_only: bool = False) -> sqlite3.Connection:
    """Open an existing file; every commit is durable before it returns.

    With `read_only` neither the file nor files next to it are written, unless it has the journal of
    a killed program: SQLite has to undo the unfinished transaction before it can be read.
    """
    _refuse_write_ahead_log(path)
    unfinished = _journal(path)
    mode = "ro" if read_only and not unfinished else "rw"
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}", uri=True, isolation_level=None, timeout=5.0
    )
    with undone_by(connection.close):
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.DOCUMENT)
        pragmas = "synchronous = EXTRA", "foreign_keys = ON", "trusted_schema = OFF"
        for pragma in (*pragmas, "cell_size_check = ON"):
            connection.execute(f"PRAGMA {pragma}")
        connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        if sys.version_info >= (3, 12):
            connection.setconfig(sqlite3.SQLITE_DBCONFIG_DEFENSIVE, True)
    return connection


def _journal(path: Path) -> bool:
    """Whether a file has a journal; refuse one by which SQLite would change other files.

    Where a journal ends in a name, SQLite deletes that file; through a link it writes elsewhere.
    Source: SQLite documentation, "Database File Format", section 3; pager.c, `pager_delsuper`.
    """
    journal = Path(f"{os.path.realpath(path)}-journal")  # next to the file that a link points to
    try:
        safe = stat.S_ISREG(journal.lstat().st_mode)
        if safe:
            with journal.open("rb") as stream:
                stream.seek(-min(len(_JOURNAL), journal.stat().st_size), os.SEEK_END)
                safe = stream.read() != _JOURNAL
    except FileNotFoundError:
        return False
    if not safe:
        raise InputError(
            f"{journal}: a journal that no hilcal made, through which opening {path} would change "
            "other files; delete it, or copy the campaign without it"
        )
    return True


def _refuse_write_ahead_log(path: Path) -> None:
    """Refuse a file with a write-ahead log, before SQLite writes any file."""
    with path.open("rb") as stream:
        if 2 in stream.read(20)[18:]:  # versions of the format, to write and to read
            raise InputError(
                f"{path}: another program has stored its changes in a write-ahead log next to the "
                "file, which no hilcal does; valid: the file as hilcal wrote it"
            )


def lock(path: Path) -> int | None:
    """Lock a campaign for measuring; return the descriptor, which holds the lock while it is open.

    The lock is on a byte far from those that SQLite locks. None for a file that cannot be written;
    on a file system without locks nothing is locked. Source: fcntl(2), open file description
    locks; over NFS, flock(2) would lock SQLite out.

    Raises:
        InputError: another process measures the campaign.
    """
    with suppress(OSError):
        handle = os.open(path, os.O_RDWR)
        with suppress(OSError):
            try:
                if hasattr(fcntl, "F_OFD_SETLK"):  # Linux alone has it
                    fcntl.fcntl(handle, fcntl.F_OFD_SETLK, _MEASURING)
            except BlockingIOError:
                os.close(handle)
                raise InputError(
                    f"{path}: another hilcal is measuring this campaign; wait until it ends, or "
                    "choose another name"
                ) from None
        return handle
    return None


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """Commit all changes of the block, or none.

    An interrupt between the statement `with` and its block leaves the transaction open; the next
    transaction or the end of the connection rolls it back.
    """
    if connection.in_transaction:  # of an interrupt between `with` and its block
        connection.execute("ROLLBACK")
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield connection
        connection.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.ProgrammingError):  # closed, which has rolled back
            if connection.in_transaction:
                connection.execute("ROLLBACK")
        raise


def require(connection: sqlite3.Connection, *versions: int) -> None:
    """Raise the version of the schema where it is lower, so that older programs refuse the file."""
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version < max(versions):
        connection.execute(f"PRAGMA user_version = {max(versions)}")


def check_file(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse a file that is damaged, of another version, or not exactly of its schema."""
    end = time.monotonic() + _LONGEST_S
    connection.set_progress_handler(lambda: time.monotonic() > end, 100_000)
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    if application != APPLICATION_ID:
        raise InputError(f"{path}: an SQLite file, but not a hilcal campaign")
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    if version > VERSION:
        raise InputError(
            f"{path}: made by a newer hilcal (schema {version}, this one reads up to {VERSION})"
        )
    _refuse_write_ahead_log(path)  # an unfinished journal may have brought it
    _check_schema(connection, path, version)
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    (page_size,) = connection.execute("PRAGMA page_size").fetchone()
    if path.stat().st_size < pages * page_size:  # SQLite fills a cut page with zeros
        raise InputError(f"{path}: the campaign file is truncated")
    (report,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if report != "ok":
        raise InputError(f"{path}: the campaign file is damaged ({' '.join(report.split())})")
    connection.set_progress_handler(None, 0)


def _check_schema(connection: sqlite3.Connection, path: Path, version: int) -> None:
    """Refuse tables, views, triggers and indexes, which could do harm, other than a campaign's."""
    actual, expected = _schema(connection), _expected_schema()
    expected = {entry for entry in expected if version >= _SINCE.get(entry[2], 1)}
    for kind, name, *_ in sorted(actual - expected)[:1]:
        raise InputError(
            f"{path}: has the {kind} {name[:60]!r}, which no hilcal made; a campaign that another "
            "program has changed is not opened; valid: the file as hilcal wrote it"
        )
    for kind, name, *_ in sorted(expected - actual)[:1]:
        raise InputError(f"{path}: the campaign file is damaged (no {kind} '{name}')")


def _schema(connection: sqlite3.Connection) -> set[tuple[str, str, str, str]]:
    """Return type, name, table and statement of every entry of a file's schema."""
    rows = connection.execute(
        "SELECT type, name, tbl_name, ifnull(sql, '') FROM sqlite_master LIMIT 1000"
    )
    return {tuple(map(str, row)) for row in rows}  # type: ignore[misc]


@cache
def _expected_schema() -> set[tuple[str, str, str, str]]:
    """Return the `_schema` of an empty campaign of this program."""
    with closing(sqlite3.connect(":memory:")) as empty:
        for statement in statements():
            empty.execute(statement)
        return _schema(empty)
