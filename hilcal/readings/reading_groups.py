"""Which readings share an error: those of one arrival, and deflections from the same unloaded ones.

Groups of equal shape are stacked. Where noise is correlated along the order of the readings, a
group is a run of them.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from hilcal import limits
from hilcal.errors import InputError
from hilcal.readings.readings import Readings
from hilcal.types import Bools, Floats, Ints

Group = tuple[Ints, Ints, Floats]
"""Rows (G, L) of the measured and (G, U) of the unloaded readings, and weights (L, U)."""


def arrival_groups(readings: Readings) -> list[Group]:
    """Group the readings that share the scatter of an arrival; else each is alone."""
    count = len(readings)
    arrival = np.arange(count) if readings.common is None else readings.arrivals
    order = np.argsort(arrival, kind="stable")
    starts = np.flatnonzero(np.diff(arrival[order], prepend=-1))
    sizes = np.diff(np.append(starts, count))
    if len(starts) == count:
        order = np.arange(count)
    found = []
    for size in np.unique(sizes):
        rows = order[starts[sizes == size][:, None] + np.arange(size)]
        limits.check_shared(int(size), readings.m, len(rows))
        none = np.empty((len(rows), 0), dtype=np.int64)
        found.append((rows, none, np.zeros((size, 0))))
    return found


def deflection_groups(readings: Readings) -> list[Group]:
    """Group loaded readings with the unloaded ones of their pose, cycle, target and observer.

    Targets that share the scatter of an arrival are in one group. A loaded reading whose target,
    of several, was not read unloaded in its pose and cycle makes no deflection.
    """
    if len(readings) and readings.unloaded.all():
        raise InputError("readings = deflection: there is no loaded reading; use absolute")
    _refuse_without_unloaded(readings)
    keys = [readings.pose, readings.cycle]
    rows = np.flatnonzero(_has_unloaded(readings, [*keys, readings.line]))
    unloaded, target = readings.unloaded[rows], readings.line[rows]
    if readings.common is None:
        keys.append(readings.line)
    group = _numbered([k[rows] for k in keys])
    order = np.lexsort((target, ~unloaded, group))
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    sizes = np.diff(np.append(starts, len(rows)))
    count = np.add.reduceat(unloaded[order].astype(np.int64), starts)
    alike = np.zeros_like(starts)
    if readings.common is not None:
        kinds: dict[bytes, int] = {}
        for k, mine in enumerate(np.split(target[order], starts[1:])):
            alike[k] = kinds.setdefault(mine.tobytes(), len(kinds))
    shapes = np.stack([sizes, count, alike], axis=1)
    found = []
    for shape in np.unique(shapes, axis=0):
        size, u = int(shape[0]), int(shape[1])
        if size == u:
            continue
        at = order[starts[np.all(shapes == shape, axis=1)][:, None] + np.arange(size)]
        limits.check_shared(size - u, readings.m, len(at))
        limits.check_numbers(f"{size - u} loaded times {u} unloaded readings", (size - u) * u)
        same = target[at[0, u:], None] == target[at[0, :u]]
        found.append((rows[at[:, u:]], rows[at[:, :u]], same / same.sum(axis=1, keepdims=True)))
    if not found:
        raise InputError(
            "readings = deflection: no target was read both loaded and unloaded in one pose and "
            "cycle; use absolute"
        )
    return found


def runs(readings: Readings, groups: Sequence[Group], most: int) -> list[Group]:
    """Join groups to runs along `Readings.along`, each in its order.

    groups: those that share another error; none is divided; most: measurements in a run, but for
    its last group.
    """
    each = [
        (loaded, reference, weights)
        for of_shape, references, weights in groups
        for loaded, reference in zip(of_shape, references, strict=True)
    ]
    t = np.arange(len(readings)) if readings.along is None else readings.along
    first = np.argsort([t[loaded].min() for loaded, _, _ in each], kind="stable")
    sizes = np.cumsum([len(each[k][0]) for k in first])
    count = -(-int(sizes[-1]) // most)
    of = (sizes - 1) * count // int(sizes[-1])
    found = []
    for run in range(count):
        parts = [each[k] for k in first[of == run]]
        if not parts:
            continue
        loaded = np.concatenate([p[0] for p in parts])
        order = np.argsort(t[loaded], kind="stable")
        weights = block_diag(*(p[2] for p in parts))[order]
        reference = np.concatenate([p[1] for p in parts])
        found.append((loaded[order][None], reference[None], weights))
    return found


def _numbered(keys: Sequence[Ints]) -> Ints:
    """(N,) number of the combination of keys (N,)."""
    return np.unique(np.stack(keys, axis=1), axis=0, return_inverse=True)[1].reshape(-1)


def has_unloaded(readings: Readings) -> Bools:
    """Return (N,) which readings have an unloaded one, or are one, in their pose and cycle."""
    return _has_unloaded(readings, [readings.pose, readings.cycle])


def _has_unloaded(readings: Readings, keys: Sequence[Ints]) -> Bools:
    """(N,) whether an unloaded reading has the same keys."""
    group = _numbered(keys)
    has = np.zeros(int(group.max()) + 1, dtype=bool)
    has[group[readings.unloaded]] = True
    return np.asarray(has[group])


def _refuse_without_unloaded(readings: Readings) -> None:
    """Refuse a pose and cycle without any unloaded reading."""
    has = has_unloaded(readings)
    if not has.all():
        row = int(np.argmin(has))
        name = readings.pose_names[readings.pose[row]]
        raise InputError(
            f"pose {name}, cycle {readings.cycle[row]}: no unloaded reading (load = none), which "
            "a deflection needs; measure it, or use --readings absolute"
        )
