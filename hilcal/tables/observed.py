"""Rows of an exchange table that are not all positions by one tracker: who observed what.

A row has a position (x_m, y_m, z_m; by the `station` that it names), a distance (`distance_m` from
the point `from`), or a height (`gauge_m` of the `gauge`); its other cells of these are empty.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hilcal.errors import InputError
from hilcal.readings.readings import ObserverKind, ObserverName, Readings
from hilcal.tables import columns
from hilcal.tables.checks import MAX_DISTANCE, MAX_STD
from hilcal.tables.grid import ColumnTable
from hilcal.tables.uncertainty import LEAST
from hilcal.types import Bools, Floats, Ints

MAIN = ObserverName("station", "tracker")
"""The station of positions that name none."""
KINDS: tuple[ObserverKind, ...] = ("point", "gauge")


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Who observed what."""

    number: Ints  # (N,) of the observer of each row
    names: tuple[ObserverName, ...]  # of the observers; stations come first
    scalar: Bools  # (N,) rows with one number

    def put(
        self, table: ColumnTable, value: Floats, cov: Floats, std: Mapping[ObserverName, float]
    ) -> tuple[Floats, Floats]:
        """Return values (N, m) and covariances (N, m, m) with distances and heights put in.

        Raises:
            InputError: one that cannot be right, or whose standard deviation nothing states.
        """
        value, cov = value.copy(), cov.copy()
        for kind in KINDS:
            of, _, variance = columns.ONE[kind]
            rows = np.flatnonzero([self.names[k].kind == kind for k in self.number])
            if not len(rows):
                continue
            read = table.number[of][rows]
            low = 0.0 if kind == "point" else -MAX_DISTANCE
            for i in rows[(read < low) | (read > MAX_DISTANCE)][:1]:
                raise InputError(
                    f"{table.at(int(i), of)}: {table.number[of][i]:g} m cannot be right; expected "
                    f"{low:g} to {MAX_DISTANCE:g} m"
                )
            value[rows, 0] = read
            cov[rows, 0, 0] = self._variance(table, rows, variance, kind, std)
        return value, cov

    def _variance(
        self,
        table: ColumnTable,
        rows: Ints,
        column: str,
        kind: ObserverKind,
        std: Mapping[ObserverName, float],
    ) -> Floats:
        nothing = np.full(len(table.rows), np.nan)
        found = table.number.get(column, nothing)[rows].copy()
        for k, i in enumerate(rows.tolist()):
            name = self.names[self.number[i]]
            if np.isnan(found[k]):
                if name not in std:
                    raise InputError(
                        f"{table.at(i)}: nothing states the noise of {name}; give column "
                        f"'{column}', the variance in m², or [{kind}s.{name.name}] std_m"
                    )
                found[k] = std[name] ** 2
            if not LEAST[0] ** 2 <= found[k] <= MAX_STD**2:
                raise InputError(
                    f"{table.at(i, column)}: a variance of {found[k]:g} m² cannot be right; "
                    f"expected standard deviations of {LEAST[0]:g} to {MAX_STD:g} m, squared"
                )
        return np.asarray(found)


def observed_of(table: ColumnTable) -> Observed | None:
    """Return who observed the rows of a table; None where all are positions by one tracker."""
    count, station = len(table.rows), table.text.get(columns.STATION)
    given = {kind: columns.ONE[kind][0] for kind in KINDS}
    read = {kind: ~np.isnan(table.number[c]) for kind, c in given.items() if c in table.number}
    if not read and (station is None or (len(set(station)) == 1 and "" not in station)):
        return None
    axes = [c for c in columns.POSITION if c in table.number]
    filled = ~np.isnan(table.matrix(axes)) if axes else np.zeros((count, 1), dtype=np.bool_)
    whole = filled.any(axis=1)
    number = np.sum([whole, *read.values()], axis=0)
    for i in np.flatnonzero((number != 1) | (whole & ~filled.all(axis=1)))[:1]:
        what = ", ".join(["x_m, y_m, z_m"] * bool(axes) + [given[kind] for kind in read])
        why = "a part of a position" if number[i] == 1 else f"{number[i]} readings"
        raise InputError(f"{table.at(int(i))}: {why}; valid: just one of {what} in each row")
    names = []
    for i in range(count):
        kind = next((kind for kind in read if read[kind][i]), None)
        if kind is not None:
            names.append(ObserverName(kind, _name(table, i, columns.ONE[kind][1])))
        elif station is None:
            names.append(MAIN)
        else:
            names.append(ObserverName("station", _name(table, i, columns.STATION)))
    order = sorted(dict.fromkeys(names), key=lambda n: n.kind != "station")
    at = {name: k for k, name in enumerate(order)}
    return Observed(np.array([at[n] for n in names]), tuple(order), np.asarray(~whole))


def _name(table: ColumnTable, row: int, column: str) -> str:
    name = table.text[column][row]
    if not name:
        raise InputError(f"{table.at(row, column)}: the cell is empty; name what observed the row")
    return name


def observer_columns(readings: Readings) -> dict[str, list[str] | Floats]:
    """Return the columns that name the observers, and those of distances and heights."""
    kind = np.array([o.kind for o in readings.observers])[readings.observer]
    name = [readings.observers[k].name for k in readings.observer.tolist()]
    out: dict[str, list[str] | Floats] = {}
    stations = [o for o in readings.observers if o.kind == "station"]
    if stations and stations != [MAIN]:
        out[columns.STATION] = _of(name, kind == "station")
    for one in KINDS:
        mine = kind == one
        if not mine.any():
            continue
        value, of, variance = columns.ONE[one]
        out[of] = _of(name, mine)
        out[value] = np.where(mine, readings.value[:, 0], np.nan)
        out[variance] = np.where(mine, readings.covariance[:, 0, 0], np.nan)
    return out


def _of(names: list[str], rows: Bools) -> list[str]:
    return [name if mine else "" for name, mine in zip(names, rows.tolist(), strict=True)]
