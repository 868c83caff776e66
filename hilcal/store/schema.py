"""Schema of a campaign file: tables that only grow.

The journal is SQLite's rollback journal, not a write-ahead log: what is committed is in the
one file and nowhere else, whatever kills the process; a `-journal` beside it holds only the
undoing of an unfinished transaction and is gone after the next opening. Source: SQLite
documentation, "Atomic Commit In SQLite" and "PRAGMA synchronous".
"""

import os
import sqlite3
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import cache
from pathlib import Path

from hilcal import limits
from hilcal.errors import DeviceError, HilcalError, InputError

APPLICATION_ID = 0x68696C63  # "hilc"
ONE_TARGET, SEVERAL_TARGETS, CHOSEN_REVISION = 2, 3, 4
CARRIED_PRIOR, CHANGED_CELL, MORE_COLUMNS = 5, 6, 7
"""Versions of a file: readings of one target, or of several; an accepted revision, or one made from
another than the one before; a revision fitted with a prior of another campaign, or in a cell that
was changed since its readings were taken; readings with joint torques, or of several observers.
Programs that do not know one would take the file for damaged, or for another."""
VERSION = MORE_COLUMNS
HEADER = b"SQLite format 3\x00"
_JOURNAL = bytes.fromhex("d9d505f920a163d7")  # begins a journal, and ends one that ends in a name

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
_SAID: dict[str, tuple[type[HilcalError], str]] = {
    "malformed|not a database": (InputError, "the campaign file is damaged or truncated ({})"),
    "full|I/O error": (
        DeviceError,
        "cannot be written ({}); nothing that was stored is lost: make room on the disk",
    ),
    "too big": (
        InputError,
        f"a record is larger than {limits.DOCUMENT / 1e6:.0f} MB, which no campaign has",
    ),
    "locked|busy": (InputError, "another program is writing to the campaign"),
    "readonly|unable to open": (
        InputError,
        "cannot be written ({}): the file or its folder is read-only; valid: a copy in a folder "
        "that can be written",
    ),
}
"""What is said of an error of SQLite, by the words that its message has."""
_LONGEST_S = 60.0
"""No check of a file that is opened takes as long; a choice."""


def statements() -> list[str]:
    """All statements that make an empty campaign, triggers against change included."""
    made = [s for s in _TABLES.split(";") if s.strip()]
    for table, key in _KEYS.items():
        refuse = f"BEGIN SELECT RAISE(ABORT, '{table} are immutable: append only'); END"
        there = f"WHEN EXISTS (SELECT 1 FROM {table} WHERE {key} = NEW.{key}) "  # noqa: S608
        made += [
            f"CREATE TRIGGER {table}_no_{what} BEFORE {event} ON {table} {when}{refuse}"
            for what, event, when in (
                ("update", "UPDATE", ""),
                ("delete", "DELETE", ""),
                ("replace", "INSERT", there),
            )
        ]
    versions = f"PRAGMA application_id = {APPLICATION_ID}", f"PRAGMA user_version = {ONE_TARGET}"
    return [*made, *versions]


def is_campaign(path: Path) -> bool:
    """Whether a file's header is that of a campaign (whatever the state of the rest)."""
    with path.open("rb") as stream:
        head = stream.read(72)
    return head.startswith(HEADER) and head[68:72] == APPLICATION_ID.to_bytes(4, "big")


@contextmanager
def sqlite_errors(path: Path) -> Iterator[None]:
    """Turn SQLite's errors into one line."""
    try:
        yield
    except UnicodeEncodeError as e:
        raise InputError(f"{path}: a text is not valid Unicode ({e.object!r})") from e
    except UnicodeDecodeError as e:  # SQLite's own message quotes a damaged name
        raise InputError(f"{path}: the campaign file is damaged") from e
    except sqlite3.DatabaseError as e:
        text = str(e)
        kinds = (kind for words, kind in _SAID.items() if any(w in text for w in words.split("|")))
        error, what = next(kinds, (InputError, "the campaign file cannot be used ({})"))
        raise error(f"{path}: {what.format(text)}") from e


def connect(path: Path, read_only: bool = False) -> sqlite3.Connection:
    """Open an existing file, every commit durable before it returns.

    Args:
        read_only: write nothing, neither to the file nor beside it. A journal beside the file is
            what a killed program left unfinished; SQLite has to undo that before anybody can read,
            and then the file is opened for writing all the same.
    """
    _refuse_log(path)
    unfinished = _journal(path)
    mode = "ro" if read_only and not unfinished else "rw"
    connection = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}", uri=True, isolation_level=None, timeout=5.0
    )
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.DOCUMENT)
        for pragma in ("synchronous = EXTRA", "foreign_keys = ON", "trusted_schema = OFF"):
            connection.execute(f"PRAGMA {pragma}")
        connection.execute("PRAGMA cell_size_check = ON")
        connection.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        if sys.version_info >= (3, 12):
            connection.setconfig(sqlite3.SQLITE_DBCONFIG_DEFENSIVE, True)
    except BaseException:
        connection.close()
        raise
    return connection


def _journal(path: Path) -> bool:
    """Whether a journal lies beside a file; SQLite obeys it, whoever wrote it.

    One that ends in a name belongs to a transaction over several files, and SQLite deletes the file
    of that name: any file. Through a link it would write elsewhere. Source: SQLite documentation,
    "Database File Format", section 3, "The Rollback Journal", and pager.c, `pager_delsuper`.
    """
    journal = Path(f"{os.path.realpath(path)}-journal")  # beside a link's file
    try:
        ours = stat.S_ISREG(journal.lstat().st_mode)
        if ours:
            with journal.open("rb") as stream:
                stream.seek(-min(len(_JOURNAL), journal.stat().st_size), os.SEEK_END)
                ours = stream.read() != _JOURNAL
    except FileNotFoundError:
        return False
    if not ours:
        raise InputError(
            f"{journal}: a journal that no hilcal made, by which opening {path} would change other "
            "files; delete it, or take the campaign without it"
        )
    return True


def _refuse_log(path: Path) -> None:
    """Refuse a file with a write-ahead log, before SQLite writes anything beside it."""
    with path.open("rb") as stream:
        if 2 in stream.read(20)[18:]:  # versions of the format, to write and to read
            raise InputError(
                f"{path}: another program has put its changes into a write-ahead log beside it, "
                "which no hilcal does; valid: the file as hilcal wrote it"
            )


@contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """Commit everything or nothing.

    An interrupt between the statement `with` and its block leaves a transaction open: the next one
    rolls it back, or the end of the connection.
    """
    if connection.in_transaction:
        connection.execute("ROLLBACK")
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield connection
        connection.execute("COMMIT")
    except BaseException:
        with suppress(sqlite3.ProgrammingError):  # it is closed, and has rolled back
            if connection.in_transaction:
                connection.execute("ROLLBACK")
        raise


def require(connection: sqlite3.Connection, *versions: int) -> None:
    """Raise the version of the schema where it is lower; older programs refuse the file then."""
    (now,) = connection.execute("PRAGMA user_version").fetchone()
    if now < max(versions):
        connection.execute(f"PRAGMA user_version = {max(versions)}")


def check_file(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse what is not a sound campaign of a known version, and of exactly its schema."""
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
    _refuse_log(path)  # an unfinished journal may have brought it
    _check_schema(connection, path, version)
    (pages,) = connection.execute("PRAGMA page_count").fetchone()
    (page_size,) = connection.execute("PRAGMA page_size").fetchone()
    if path.stat().st_size < pages * page_size:  # SQLite fills a cut page with zeros
        raise InputError(f"{path}: the campaign file is truncated")
    (sound,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    if sound != "ok":
        raise InputError(f"{path}: the campaign file is damaged ({' '.join(sound.split())})")
    connection.set_progress_handler(None, 0)


def _check_schema(connection: sqlite3.Connection, path: Path, version: int) -> None:
    """Refuse tables, views, triggers and indexes that are not exactly those of a campaign.

    A received file could act by them: swallow what is stored, show other readings, never end.
    """
    found, wanted = _schema(connection), _wanted()
    wanted = {entry for entry in wanted if version >= _SINCE.get(entry[2], 1)}
    if extra := sorted(found - wanted):
        kind, name, *_ = extra[0]
        raise InputError(
            f"{path}: has the {kind} {name[:60]!r}, which no hilcal made; a campaign that another "
            "program has changed is not opened; valid: the file as hilcal wrote it"
        )
    if missing := sorted(wanted - found):
        kind, name, *_ = missing[0]
        raise InputError(f"{path}: the campaign file is damaged (no {kind} '{name}')")


def _schema(connection: sqlite3.Connection) -> set[tuple[str, str, str, str]]:
    """Type, name, table and statement of everything in a file."""
    rows = connection.execute(
        "SELECT type, name, tbl_name, ifnull(sql, '') FROM sqlite_master LIMIT 1000"
    )
    return {tuple(map(str, row)) for row in rows}  # type: ignore[misc]


@cache
def _wanted() -> set[tuple[str, str, str, str]]:
    """Do so for a campaign as this program makes it; no version made a table differently."""
    with closing(sqlite3.connect(":memory:")) as empty:
        for statement in statements():
            empty.execute(statement)
        return _schema(empty)
