"""Rows of a campaign file: readings as records of little-endian doubles, texts, checksums."""

import hashlib
import json
import sqlite3
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_name, check_names
from hilcal.readings.covariance import is_covariance
from hilcal.readings.readings import SAME_POSE, TEMPERATURES, ObserverName, Readings, States
from hilcal.toml import parse_json
from hilcal.types import Floats, Ints

Layout = tuple[tuple[str, int], ...]
"""Fields of a record in order, with their number of doubles; absent quantities are left out."""
LARGEST = 1e12  # upper bound of all quantities of a reading, in SI units: times in s are below 1e11
OPTIONAL_FIELDS = ("torque", *TEMPERATURES)  # NaN in single readings without them
_PER_JOINT = ("q", "joint_temperature", "approach", "q_actual", "torque")
_STATE = (
    *("q", "wrench", "time", "load_time", "air_temperature", "joint_temperature", "approach"),
    *("q_actual", "torque", "target", "observer"),
)


def _widths(n: int, m: int) -> dict[str, int]:
    """Return the number of doubles of each field, in order, for n joints and m elements."""
    state = {name: n if name in _PER_JOINT else 1 for name in _STATE} | {"wrench": 6}
    return state | {"value": m, "covariance": m * m}


def layout_of(readings: Readings) -> Layout:
    """Return the layout of the records of readings."""
    absent = {name for name in _STATE if getattr(readings.states, name) is None}
    widths = _widths(readings.states.q.shape[1], readings.m)
    return tuple((name, width) for name, width in widths.items() if name not in absent)


def read_layout(text: str) -> Layout:
    """Return a layout from its JSON text; a ValueError for a layout that no reading has."""
    try:
        layout = tuple((str(name), int(width)) for name, width in parse_json(text))
    except (TypeError, OverflowError) as error:
        raise ValueError(str(error)) from error
    widths = dict(layout)
    n, m = widths.get("q", 0), widths.get("value", 0)
    expected = tuple((k, w) for k, w in _widths(n, m).items() if k in widths)
    if not {"q", "wrench", "value", "covariance"} <= set(widths) or m not in (3, 6):
        raise ValueError("fields that no reading has")
    if n < 1 or layout != expected:
        raise ValueError("fields in a wrong order or of a wrong width")
    return layout


def pack(readings: Readings) -> Floats:
    """Return records (N, K); refuse arrays of a wrong shape, and numbers that are not finite."""
    count, parts = len(readings), []
    for name, width in layout_of(readings):
        owner = readings.states if name in _STATE else readings
        part = np.asarray(getattr(owner, name), dtype="<f8")
        if part.size != count * width or len(part) != count:
            raise InputError(f"readings: {name} has shape {part.shape} for {count} readings")
        part = part.reshape(count, width)
        valid = np.isfinite(part).all(axis=1)
        if name in OPTIONAL_FIELDS:
            valid |= np.isnan(part).all(axis=1)
        if not valid.all():
            i = int(np.argmin(valid))
            raise InputError(f"readings: {name} of reading {i + 1} is not finite")
        parts.append(part)
    return np.ascontiguousarray(np.hstack(parts), dtype="<f8")


def _columns(layout: Layout) -> dict[str, slice]:
    ends = accumulate(width for _, width in layout)
    return {name: slice(end - width, end) for (name, width), end in zip(layout, ends, strict=True)}


def _unpacked(
    records: Floats,
    layout: Layout,
    index: Ints,
    names: Sequence[Sequence[str]],
    observers: Sequence[ObserverName],
) -> Readings:
    """Return readings of records (N, K), `index` (N, 3); `names` are of poses, loads, targets."""
    fields: dict[str, Any] = {}
    single_widths = _widths(0, 0)
    for name, columns in _columns(layout).items():
        block = np.array(records[:, columns], dtype=np.float64)
        fields[name] = block[:, 0] if single_widths[name] == 1 else block
    for name in ("target", "observer"):
        if name in fields:
            fields[name] = fields[name].astype(np.int64)
    value, covariance = fields.pop("value"), fields.pop("covariance")
    m = value.shape[1]
    pose_names, load_names, target_names = map(tuple, names)
    return Readings(
        states=States(**fields),
        pose=index[:, 0].copy(),
        load=index[:, 1].copy(),
        cycle=index[:, 2].copy(),
        value=value,
        covariance=covariance.reshape(len(records), m, m),
        load_names=load_names,
        pose_names=pose_names,
        target_names=target_names if "target" in fields else (),
        observers=tuple(observers) if "observer" in fields else (),
    )


def content_hash(readings: Readings) -> str:
    """Return the SHA-256 (hex) of readings in order.

    The hash depends on every number and on the names of poses, loads and targets. It does not
    depend on the numbering of names, on names without readings, on how the readings were appended,
    or on a scatter of the arm that was estimated from them.
    """
    readings = readings.as_stated()
    sha = hashlib.sha256()
    columns = []
    named = [(readings.pose, readings.pose_names), (readings.load, readings.load_names)]
    if readings.states.target is not None:
        named.append((readings.target, readings.target_names))
    if readings.states.observer is not None:
        named.append((readings.observer, tuple(map(str, readings.observers))))
    readings = replace(readings, states=replace(readings.states, target=None, observer=None))
    for index, names in named:
        used = list(dict.fromkeys(index.tolist()))
        order = {k: i for i, k in enumerate(dict.fromkeys(names[k] for k in used))}
        sha.update(json.dumps(list(order)).encode() + b"\n")
        columns.append([order[names[k]] for k in index.tolist()])
    columns.append(readings.cycle.tolist())
    sha.update(json.dumps([len(readings), layout_of(readings)]).encode() + b"\n")
    sha.update(np.array(columns, dtype="<i8").T.tobytes())
    sha.update((pack(readings) + 0.0).astype("<f8").tobytes())
    return sha.hexdigest()


def text_crc(key: str, text: str) -> int:
    """Return the checksum of a text under a key."""
    return zlib.crc32(text.encode(), zlib.crc32(key.encode()))


def _reading_crc(number: int, where: Sequence[int], record: bytes) -> int:
    return zlib.crc32(record, zlib.crc32(np.array([number, *where], dtype="<i8").tobytes()))


def insert(connection: sqlite3.Connection, table: str, rows: Sequence[Sequence[object]]) -> None:
    """Append rows to a table; a DatabaseError where not all of them were stored."""
    if not rows:
        return
    marks = ", ".join("?" * len(rows[0]))
    done = connection.executemany(f"INSERT INTO {table} VALUES ({marks})", rows)  # noqa: S608
    if done.rowcount != len(rows):
        raise sqlite3.DatabaseError(f"{len(rows) - done.rowcount} rows of {table} were not stored")


def last_id(connection: sqlite3.Connection, table: str) -> int:
    """Return the number of the last row of a table; 0 where it is empty."""
    (last,) = connection.execute(f"SELECT ifnull(max(id), 0) FROM {table}").fetchone()  # noqa: S608
    return int(last)


def append_text(connection: sqlite3.Connection, table: str, text: str) -> int:
    """Append a text to the revisions or events; return its number."""
    number = last_id(connection, table) + 1
    insert(connection, table, [(number, text, text_crc(str(number), text))])
    return number


def insert_meta(connection: sqlite3.Connection, key: str, value: str) -> None:
    """Store a text about the campaign; it cannot be changed later."""
    insert(connection, "meta", [(key, value, text_crc(key, value))])


def fetch_meta(connection: sqlite3.Connection, path: Path) -> dict[str, str]:
    """Return all texts about the campaign by key; refuse damaged ones."""
    with limits.memory(str(path)):
        rows = connection.execute("SELECT key, value, crc FROM meta").fetchall()
    meta = {str(key): str(value) for key, value, _ in rows}
    if any(text_crc(str(key), str(value)) != crc for key, value, crc in rows):
        raise InputError(f"{path}: the campaign file is damaged (its description)")
    return meta


def _fetch_names(connection: sqlite3.Connection, table: str) -> tuple[str, ...]:
    rows = connection.execute(f"SELECT name FROM {table} ORDER BY id")  # noqa: S608
    return tuple(str(name) for (name,) in rows)


def _insert_names(connection: sqlite3.Connection, table: str, names: Sequence[str]) -> Ints:
    if len(set(names)) != len(names):
        raise InputError(f"readings: two {table} have the same name")
    numbers = {name: k for k, name in enumerate(_fetch_names(connection, table))}
    for name in names:
        if name not in numbers:
            check_name(name, table)
            insert(connection, table, [(len(numbers), name)])
            numbers[name] = len(numbers)
    return np.array([numbers[name] for name in names], dtype=np.int64)


def insert_readings(connection: sqlite3.Connection, readings: Readings) -> int:
    """Append readings; return the number of all readings."""
    records = pack(readings)
    pose = _insert_names(connection, "poses", readings.pose_names)[readings.pose]
    load = _insert_names(connection, "loads", readings.load_names)[readings.load]
    last = last_id(connection, "readings")
    index = np.stack([pose, load, readings.cycle], axis=1).tolist()
    pairs = zip(index, map(bytes, records), strict=True)
    stored = [
        (number, *where, record, _reading_crc(number, where, record))
        for number, (where, record) in enumerate(pairs, start=last + 1)
    ]
    insert(connection, "readings", stored)
    return last + len(readings)


def fetch_readings(
    connection: sqlite3.Connection,
    path: Path,
    layout: Layout,
    target_names: Sequence[str] = (),
    observers: Sequence[ObserverName] = (),
) -> Readings:
    """Return all readings, in order; refuse missing or damaged ones, and invalid names."""
    (count,) = connection.execute("SELECT count(*) FROM readings").fetchone()

    def damaged(place: str) -> InputError:
        return InputError(f"{path}: the campaign file is damaged{place}")

    if not count:
        raise damaged(" (its readings are missing)")
    limits.check_fitted(count, dict(layout)["value"], f"{path}: ")
    width = sum(width for _, width in layout)
    with limits.memory(str(path)):
        names = [*(_fetch_names(connection, t) for t in ("poses", "loads")), target_names]
        check_names([*names, [o.name for o in observers]], f"{path}: name")
        rows = connection.execute(
            "SELECT id, pose, load, cycle, record, crc FROM readings ORDER BY id LIMIT ?", (count,)
        )
        records, index = np.empty((count, width)), np.empty((count, 3), dtype=np.int64)
        for number, (key, *where, record, crc) in enumerate(rows, start=1):
            try:
                intact = key == number and len(record) == 8 * width
                intact = intact and _reading_crc(key, where, record) == crc
            except (TypeError, ValueError, OverflowError):
                intact = False
            if not intact:
                raise damaged(f" at reading {number}")
            records[number - 1] = np.frombuffer(record, "<f8")
            index[number - 1] = where
        plausible = np.abs(records) < LARGEST
        for lacking in (x for name, x in _columns(layout).items() if name in OPTIONAL_FIELDS):
            plausible[:, lacking] |= np.isnan(records[:, lacking]).all(axis=1, keepdims=True)
        if bad := np.flatnonzero(~plausible.all(axis=1))[:1].tolist():
            raise damaged(f" at reading {bad[0] + 1}")
        counts = [len(names[0]), len(names[1])]
        if index[:, :2].min() < 0 or np.any(index[:, :2].max(axis=0) >= counts):
            raise damaged(" (names are missing)")
        readings = _unpacked(records, layout, index, names, observers)
        if bad := np.flatnonzero(~is_covariance(readings.covariance))[:1].tolist():
            why = "its covariance is not positive semi-definite"
            raise damaged(f" at reading {bad[0] + 1}: {why}")
    for kind, listed in (("target", target_names), ("observer", observers)):
        numbers = getattr(readings.states, kind)
        if numbers is not None and not 0 <= numbers.min() <= numbers.max() < len(listed):
            raise damaged(f" ({kind}s are missing)")
    return readings


def stored_json(path: Path, text: str, check: Callable[[object], None] | None = None) -> Any:
    """Return the content of a stored JSON text; `check` may refuse it by a ValueError."""
    try:
        with limits.memory(str(path)):
            content = parse_json(text)
        if check is not None:
            check(content)
        return content
    except ValueError as error:
        raise InputError(f"{path}: the campaign file is damaged ({error})") from error


def check_poses(connection: sqlite3.Connection, path: Path, readings: Readings) -> None:
    """Refuse a pose whose commanded joints differ from those of its previous readings."""
    if len(readings) == 0:
        return
    q = readings.states.q
    pose, first, pose_index = np.unique(readings.pose, return_index=True, return_inverse=True)
    reference = q[first]
    for k, number in enumerate(pose.tolist()):
        stored = connection.execute(
            "SELECT record FROM readings "
            "WHERE pose = (SELECT id FROM poses WHERE name = ?) LIMIT 1",
            (readings.pose_names[number],),
        ).fetchone()
        if stored is not None:  # q comes first in a record
            reference[k] = np.frombuffer(stored[0], "<f8", q.shape[1])
    bad = np.abs(q - reference[pose_index]).max(axis=1) > SAME_POSE
    if bad.any():
        name = readings.pose_names[readings.pose[np.argmax(bad)]]
        raise InputError(
            f"{path}: pose '{name}' has other commanded joints than in earlier readings; "
            f"give another pose another name"
        )
