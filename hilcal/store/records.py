"""Readings as fixed-width records of little-endian doubles, and the hash of their content."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hilcal.errors import InputError
from hilcal.readings.readings import ObserverName, Readings, States
from hilcal.toml import parse_json
from hilcal.types import Bools, Floats, Ints

Layout = tuple[tuple[str, int], ...]

MAY_LACK = "torque"
"""Quantity of a state that single readings may lack, all of its numbers NaN then."""
_STATE = {
    "q": 2,
    "wrench": 2,
    "time": 1,
    "load_time": 1,
    "air_temperature": 1,
    "joint_temperature": 2,
    "approach": 2,
    "q_actual": 2,
    "torque": 2,
    "target": 1,
    "observer": 1,
}


def layout_of(readings: Readings) -> Layout:
    """Fields of a record and how many doubles each takes; absent quantities take none."""
    n, m = readings.states.q.shape[1], readings.m
    width = {name: 1 if rank == 1 else n for name, rank in _STATE.items()} | {"wrench": 6}
    state = [(k, w) for k, w in width.items() if getattr(readings.states, k) is not None]
    return (*state, ("value", m), ("covariance", m * m))


def read_layout(text: str) -> Layout:
    """Return the fields of a record from their JSON text."""
    try:
        found = tuple((str(name), int(width)) for name, width in parse_json(text))
    except (TypeError, OverflowError) as error:
        raise ValueError(str(error)) from error
    width = dict(found)
    n, m = width.get("q", 0), width.get("value", 0)
    expected = {name: 1 if rank == 1 else n for name, rank in _STATE.items()} | {"wrench": 6}
    expected |= {"value": m, "covariance": m * m}
    in_order = [name for name in expected if name in width]
    wanted = {"q", "wrench", "value", "covariance"} <= set(width)
    if not wanted or [name for name, _ in found] != in_order or m not in (3, 6):
        raise ValueError("fields that no reading has")
    if n < 1 or any(width[name] != expected[name] for name in width):
        raise ValueError("fields of a wrong width")
    return found


def pack(readings: Readings) -> Floats:
    """(N, K) records.

    Raises:
        InputError: an array of a wrong shape, or a number that is not finite.
    """
    count, parts = len(readings), []
    for name, width in layout_of(readings):
        owner = readings.states if name in _STATE else readings
        part = np.asarray(getattr(owner, name), dtype="<f8")
        if part.size != count * width or len(part) != count:
            raise InputError(f"readings: {name} has shape {part.shape} for {count} readings")
        part = part.reshape(count, width)
        known = np.isfinite(part).all(axis=1)
        if name == MAY_LACK:
            known |= np.isnan(part).all(axis=1)
        if not known.all():
            i = int(np.argmin(known))
            raise InputError(f"readings: {name} of reading {i + 1} is not finite")
        parts.append(part)
    return np.ascontiguousarray(np.hstack(parts), dtype="<f8")


def lacking(records: Floats, layout: Layout) -> Bools:
    """(N, K) numbers that are NaN since a reading lacks the whole quantity, and may."""
    out, at = np.zeros(records.shape, dtype=np.bool_), 0
    for name, width in layout:
        if name == MAY_LACK:
            none = np.isnan(records[:, at : at + width])
            out[:, at : at + width] = none.all(axis=1, keepdims=True)
        at += width
    return out


def unpack(
    records: Floats,
    layout: Layout,
    index: Ints,
    pose_names: Sequence[str],
    load_names: Sequence[str],
    target_names: Sequence[str] = (),
    observers: Sequence[ObserverName] = (),
) -> Readings:
    """Readings from (N, K) records and (N, 3) indices of pose, load and cycle."""
    count, at = len(records), 0
    fields: dict[str, Floats] = {}
    for name, width in layout:
        block = np.array(records[:, at : at + width], dtype=np.float64)
        fields[name] = block[:, 0] if _STATE.get(name) == 1 else block
        at += width
    value, covariance = fields.pop("value"), fields.pop("covariance")
    m = value.shape[1]
    target = fields.pop("target", None)
    observer = fields.pop("observer", None)
    number = None if target is None else target.astype(np.int64)
    by = None if observer is None else observer.astype(np.int64)
    return Readings(
        states=States(**fields, target=number, observer=by),
        pose=index[:, 0].copy(),
        load=index[:, 1].copy(),
        cycle=index[:, 2].copy(),
        value=value,
        covariance=covariance.reshape(count, m, m),
        load_names=tuple(load_names),
        pose_names=tuple(pose_names),
        target_names=() if target is None else tuple(target_names),
        observers=() if observer is None else tuple(observers),
    )


def content_hash(readings: Readings) -> str:
    """SHA-256 (hex) of what was measured, in order.

    Depends on every number and on the names of poses, loads and targets, but not on how names are
    numbered, on names without readings, or on how the readings were appended; nor on a scatter of
    the arm that was estimated from them.
    """
    readings = readings.as_stated()
    sha = hashlib.sha256()
    columns = []
    named = [(readings.pose, readings.pose_names), (readings.load, readings.load_names)]
    if readings.states.target is not None:
        named.append((readings.target, readings.target_names))
        readings = replace(readings, states=replace(readings.states, target=None))
    if readings.states.observer is not None:
        named.append((readings.observer, tuple(map(str, readings.observers))))
        readings = replace(readings, states=replace(readings.states, observer=None))
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
