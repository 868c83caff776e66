"""Rows of a campaign file: readings and texts in and out, each under a checksum."""

import sqlite3
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_name, check_names
from hilcal.readings.covariance import is_covariance
from hilcal.readings.readings import SAME_POSE, ObserverName, Readings
from hilcal.store.records import Layout, lacking, pack, unpack
from hilcal.toml import parse_json
from hilcal.types import Ints

LARGEST = 1e12
"""No quantity of a reading is as large, in SI units: times in s are below 1e11."""
_NAMES = {
    "poses": "SELECT name FROM poses ORDER BY id",
    "loads": "SELECT name FROM loads ORDER BY id",
}


def text_crc(key: str, text: str) -> int:
    """Checksum of a text under a key."""
    return zlib.crc32(text.encode(), zlib.crc32(key.encode()))


def _reading_crc(number: int, where: Sequence[int], record: bytes) -> int:
    return zlib.crc32(record, zlib.crc32(np.array([number, *where], dtype="<i8").tobytes()))


def insert(connection: sqlite3.Connection, table: str, rows: Sequence[Sequence[object]]) -> None:
    """Append rows to a table.

    Raises:
        sqlite3.DatabaseError: not all of them are in it.
    """
    if not rows:
        return
    marks = ", ".join("?" * len(rows[0]))
    done = connection.executemany(f"INSERT INTO {table} VALUES ({marks})", rows)  # noqa: S608
    if done.rowcount != len(rows):
        raise sqlite3.DatabaseError(f"{len(rows) - done.rowcount} rows of {table} were not stored")


def insert_meta(connection: sqlite3.Connection, key: str, value: str) -> None:
    """Store a text about the campaign; it cannot be changed later."""
    insert(connection, "meta", [(key, value, text_crc(key, value))])


def fetch_meta(connection: sqlite3.Connection, path: Path) -> dict[str, str]:
    """All texts about the campaign."""
    with limits.memory(str(path)):
        rows = connection.execute("SELECT key, value, crc FROM meta").fetchall()
    meta = {str(key): str(value) for key, value, _ in rows}
    if any(text_crc(str(key), str(value)) != crc for key, value, crc in rows):
        raise InputError(f"{path}: the campaign file is damaged (its description)")
    return meta


def fetch_names(connection: sqlite3.Connection, table: str) -> tuple[str, ...]:
    """Names of the poses or loads by number."""
    return tuple(str(name) for (name,) in connection.execute(_NAMES[table]))


def insert_names(connection: sqlite3.Connection, table: str, names: Sequence[str]) -> Ints:
    """Numbers of names; new ones are appended in order."""
    if len(set(names)) != len(names):
        raise InputError(f"readings: two {table} have the same name")
    known = {name: k for k, name in enumerate(fetch_names(connection, table))}
    for name in names:
        if name not in known:
            check_name(name, table)
            insert(connection, table, [(len(known), name)])
            known[name] = len(known)
    return np.array([known[name] for name in names], dtype=np.int64)


def insert_readings(connection: sqlite3.Connection, readings: Readings) -> int:
    """Append readings after those that are there; returns how many there are then."""
    records = pack(readings)
    pose = insert_names(connection, "poses", readings.pose_names)[readings.pose]
    load = insert_names(connection, "loads", readings.load_names)[readings.load]
    (last,) = connection.execute("SELECT ifnull(max(id), 0) FROM readings").fetchone()
    index = np.stack([pose, load, readings.cycle], axis=1).tolist()
    stored = [
        (number, *where, record, _reading_crc(number, where, record))
        for number, (where, record) in enumerate(
            zip(index, map(bytes, records), strict=True), start=int(last) + 1
        )
    ]
    insert(connection, "readings", stored)
    return int(last) + len(readings)


def fetch_readings(
    connection: sqlite3.Connection,
    path: Path,
    layout: Layout,
    target_names: Sequence[str] = (),
    observers: Sequence[ObserverName] = (),
) -> Readings:
    """All readings, in order."""
    (count,) = connection.execute("SELECT count(*) FROM readings").fetchone()
    if not count:
        raise InputError(f"{path}: the campaign file is damaged (its readings are gone)")
    width = sum(width for _, width in layout)
    limits.check_fitted(count, dict(layout)["value"], f"{path}: ")
    with limits.memory(str(path)):
        return _fetched(connection, path, layout, target_names, observers, count, width)


def _fetched(
    connection: sqlite3.Connection,
    path: Path,
    layout: Layout,
    target_names: Sequence[str],
    observers: Sequence[ObserverName],
    count: int,
    width: int,
) -> Readings:
    """Return the first `count` readings of records of `width` numbers."""
    names = [fetch_names(connection, table) for table in ("poses", "loads")]
    check_names([*names, target_names, [o.name for o in observers]], f"{path}: name")
    rows = connection.execute(
        "SELECT id, pose, load, cycle, record, crc FROM readings ORDER BY id LIMIT ?", (count,)
    )
    records, index = np.empty((count, width)), np.empty((count, 3), dtype=np.int64)
    for number, (key, *where, record, crc) in enumerate(rows, start=1):
        try:
            whole = key == number and len(record) == 8 * width
            whole = whole and _reading_crc(key, where, record) == crc
        except (TypeError, ValueError, OverflowError):
            whole = False
        if not whole:
            raise InputError(f"{path}: the campaign file is damaged at reading {number}")
        records[number - 1] = np.frombuffer(record, "<f8")
        index[number - 1] = where
    sound = (np.abs(records) < LARGEST) | lacking(records, layout)
    if bad := np.flatnonzero(~sound.all(axis=1))[:1].tolist():
        raise InputError(f"{path}: the campaign file is damaged at reading {bad[0] + 1}")
    if index[:, :2].min() < 0 or np.any(index[:, :2].max(axis=0) >= [len(n) for n in names]):
        raise InputError(f"{path}: the campaign file is damaged (names are missing)")
    readings = unpack(records, layout, index, names[0], names[1], target_names, observers)
    if bad := np.flatnonzero(~is_covariance(readings.covariance))[:1].tolist():
        raise InputError(
            f"{path}: the campaign file is damaged at reading {bad[0] + 1}: its covariance is not "
            "positive semi-definite"
        )
    target = readings.states.target
    if target is not None and not 0 <= target.min() <= target.max() < len(target_names):
        raise InputError(f"{path}: the campaign file is damaged (targets are missing)")
    by = readings.states.observer
    if by is not None and not 0 <= by.min() <= by.max() < len(observers):
        raise InputError(f"{path}: the campaign file is damaged (observers are missing)")
    return readings


def stored_json(path: Path, text: str, check: Callable[[object], None] | None = None) -> Any:
    """Return what a stored JSON text holds, which `check` may refuse by a ValueError."""
    try:
        with limits.memory(str(path)):
            content = parse_json(text)
        if check is not None:
            check(content)
        return content
    except ValueError as error:
        raise InputError(f"{path}: the campaign file is damaged ({error})") from error


def check_poses(connection: sqlite3.Connection, path: Path, readings: Readings) -> None:
    """Refuse a pose that is commanded to other joints than in earlier readings."""
    if len(readings) == 0:
        return
    q = readings.states.q
    pose, first, group = np.unique(readings.pose, return_index=True, return_inverse=True)
    reference = q[first]
    for k, number in enumerate(pose.tolist()):
        stored = connection.execute(
            "SELECT record FROM readings "
            "WHERE pose = (SELECT id FROM poses WHERE name = ?) LIMIT 1",
            (readings.pose_names[number],),
        ).fetchone()
        if stored is not None:  # q comes first in a record
            reference[k] = np.frombuffer(stored[0], "<f8", q.shape[1])
    bad = np.abs(q - reference[group]).max(axis=1) > SAME_POSE
    if bad.any():
        name = readings.pose_names[readings.pose[np.argmax(bad)]]
        raise InputError(
            f"{path}: pose '{name}' is commanded to other joints than before; "
            f"give another pose another name"
        )
