"""Columns of the exchange table: names, joints that mimic others, checks of header and values.

A row has one reading: a position (x_m, y_m, z_m, measured by its `station`), a distance
(`distance_m` from the point `from`), or a height (`gauge_m` of the `gauge`); the other two are
empty.
"""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches

import numpy as np

from hilcal.config import STANDARD_GRAVITY_M_S2
from hilcal.errors import InputError
from hilcal.readings.covariance import SINGULAR, smallest_correlation
from hilcal.readings.readings import SAME_POSE, ObserverKind, ObserverName, Readings
from hilcal.robot.arm import Arm
from hilcal.tables.grid import ColumnTable, first_true
from hilcal.tables.uncertainty import MIN_STD
from hilcal.types import Bools, Floats, Ints

POSITION = ("x_m", "y_m", "z_m")
ROTATION = ("rx_rad", "ry_rad", "rz_rad")
WRENCH = ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm")
TEXT = ("pose", "load")
TARGET, COVERS, STATION = "target", "covers", "station"
PREVIEW = "hilcal import TABLE --preview proposes a mapping for --format"
SCALAR = {"point": ("distance_m", "from", "cov_d_d"), "gauge": ("gauge_m", "gauge", "cov_g_g")}
"""Columns of a reading that is one number, by kind of observer: value, observer, variance."""
USER_PREFIX = "x_"
JOINT_TOLERANCE = 2e-3  # rad; of the arm's description: tables round to 0.1°. A choice
_AXES = ("x", "y", "z", "rx", "ry", "rz")

Units = int | Sequence[str]
"""Units of the joints' values, "rad" or "m" (`Arm.units`); or how many joints there are, in rad."""


def _numbered(units: Units) -> list[tuple[int, str]]:
    return list(enumerate(("rad",) * units if isinstance(units, int) else units, start=1))


def joint_columns(units: Units) -> tuple[str, ...]:
    """Columns of the commanded joints, rad; of sliding joints m."""
    return tuple(f"q{i}_{unit}" for i, unit in _numbered(units))


def actual_columns(units: Units) -> tuple[str, ...]:
    """Columns of the joints that the encoders reported, rad; of sliding joints m."""
    return tuple(f"qa{i}_{unit}" for i, unit in _numbered(units))


def torque_columns(units: Units) -> tuple[str, ...]:
    """Columns of the measured static torques of the drives, N·m; of sliding joints forces, N."""
    return tuple(f"tau{i}_{'N' if unit == 'm' else 'Nm'}" for i, unit in _numbered(units))


def temperature_columns(n: int) -> tuple[str, ...]:
    """Columns of the joints' temperatures, °C."""
    return tuple(f"joint{i}_degC" for i in range(1, n + 1))


def approach_columns(n: int) -> tuple[str, ...]:
    """Columns of the side from which each joint arrived, -1 or +1."""
    return tuple(f"approach{i}" for i in range(1, n + 1))


def covariance_columns(m: int) -> tuple[str, ...]:
    """Columns of the upper triangle of an (m, m) covariance, row by row."""
    return tuple(f"cov_{_AXES[i]}_{_AXES[j]}" for i in range(m) for j in range(i, m))


def required_columns(units: Units) -> tuple[str, ...]:
    """Columns that every table of an arm has."""
    return (*TEXT, *joint_columns(units), *POSITION)


def sparse_columns(header: Collection[str]) -> tuple[str, ...]:
    """Number columns that may have empty cells.

    Torques; temperatures; readings, where some are one number.
    """
    lost = tuple(c for c in header if re.fullmatch(r"tau[0-9]+_Nm?|(air|joint[0-9]+)_degC", c))
    if not any(value in header for value, _, _ in SCALAR.values()):
        return lost
    scalar = [c for value, _, variance in SCALAR.values() for c in (value, variance)]
    return (*POSITION, *ROTATION, *covariance_columns(6), *scalar, *lost)


def groups(units: Units) -> tuple[tuple[str, ...], ...]:
    """Optional columns of which a table has all or none."""
    n = len(_numbered(units))
    of_joints = temperature_columns(n), approach_columns(n)
    return ROTATION, *of_joints, actual_columns(units), torque_columns(units)


def known_columns(units: Units) -> tuple[str, ...]:
    """All columns that have a meaning for an arm."""
    return (
        *(*required_columns(units), TARGET, COVERS, STATION),
        *(name for kind in SCALAR.values() for name in kind),
        *(*covariance_columns(6), *WRENCH, "cycle", "time_s", "load_time_s", "air_degC"),
        *(name for group in groups(units) for name in group),
    )


def _closest(name: str, valid: Iterable[str]) -> str | None:
    by_lower = {v.lower(): v for v in valid}
    close = get_close_matches(name.lower(), list(by_lower), n=1, cutoff=0.5)
    return by_lower.get(name.lower()) or (by_lower[close[0]] if close else None)


def check_header(
    path: str, header: Sequence[str], units: Units, arm: str, optional: Collection[str] = ()
) -> None:
    """Refuse a header that does not fit an arm; `optional` columns may be missing."""
    for k, name in enumerate(header, start=1):
        if not 0 < len(name) <= 80:
            index = "; an index? pandas leaves it out by to_csv(..., index=False)" * (not name)
            raise InputError(f"{path}: column {k} has no name, or a long one, in row 1{index}")
        if (count := header.count(name)) > 1:
            raise InputError(f"{path}: column '{name}' appears {count} times; keep one")
    valid, needed = known_columns(units), required_columns(units)
    if any(name in header for kind in SCALAR.values() for name in kind):
        _check_scalar(path, header)
    if POSITION[0] in sparse_columns(header) and POSITION[0] not in header:
        needed = needed[:-3]
    missing = [c for c in needed if c not in header and c not in optional]
    for name in header:
        if name not in valid and not name.startswith(USER_PREFIX):
            form = f"; for a table of another form: {PREVIEW}" if missing else ""
            advice = _advice(name, valid, header, len(_numbered(units)))
            raise InputError(f"{path}: unknown column '{name}'{advice}{form}")
    if missing:
        hint = _hint(missing, header, units, arm)
        raise InputError(f"{path}: column '{missing[0]}' is missing{hint}")
    for group in groups(units):
        lacking = [c for c in group if c not in header and c not in optional]
        if lacking and any(c in header for c in group):
            raise InputError(
                f"{path}: column '{lacking[0]}' is missing; give all of {', '.join(group)} or none "
                "of them"
            )


def _check_scalar(path: str, header: Sequence[str]) -> None:
    """Refuse distances and heights without the name of their observer, or beside orientations."""
    for value, observer, variance in SCALAR.values():
        for name, needed in ((observer, value), (variance, value), (value, observer)):
            if name in header and needed not in header:
                raise InputError(f"{path}: column '{name}' without column '{needed}'; give both")
    if ROTATION[0] in header:
        raise InputError(
            f"{path}: column '{ROTATION[0]}': a table of distances or heights has positions beside "
            "them, no orientations; give those in a table of their own"
        )


def _advice(name: str, valid: Sequence[str], header: Sequence[str], n: int) -> str:
    first, _, last = name.partition("_")
    i, _, j = last.partition("_")
    if first == "cov" and f"cov_{j}_{i}" in valid:
        return f"; give the upper triangle only: 'cov_{j}_{i}'"
    column = next((c for c in valid if c.startswith(f"{first}_")), None)
    if column is not None and re.fullmatch(r"qa?[0-9]+_(rad|m)", name):
        return f"; this joint {'slides' if column.endswith('_m') else 'turns'}: '{column}'"
    close = _closest(name, (c for c in valid if c not in header)) or _closest(name, valid)
    prefix = f"columns of your own start with '{USER_PREFIX}'"
    joints = f" (the arm has {n} joints)" if any(ch.isdigit() for ch in close or "") else ""
    return f"; did you mean '{close}'{joints}? Else: {prefix}" if close else f"; {prefix}"


def _hint(missing: Sequence[str], header: Sequence[str], units: Units, arm: str) -> str:
    user_columns = [c for c in header if c.startswith(USER_PREFIX)]
    close = _closest(missing[0], user_columns) if missing[0] not in TEXT else None
    if close:
        return f"; '{close}' is taken as a column of your own: positions must be '{missing[0]}'"
    number = f", and so are {len(missing) - 1} more" if len(missing) > 1 else ""
    return f"{number}; a table for {arm} needs {', '.join(required_columns(units))}"


def check_covariance_columns(path: str, header: Sequence[str]) -> None:
    """Refuse a part of a covariance, or one of an orientation that the table lacks."""
    stated = [c for c in header if c in covariance_columns(6)]
    if not stated:
        return
    m = 6 if ROTATION[0] in header else 3
    needed = covariance_columns(m)
    for name in needed:
        if name not in stated:
            raise InputError(
                f"{path}: column '{name}' is missing; a covariance of {m} elements needs its "
                f"whole upper triangle: {needed[0]} ... {needed[-1]} ({len(needed)} columns)"
            )
    if extra := [c for c in stated if c not in needed]:
        raise InputError(
            f"{path}: column '{extra[0]}' needs the rotation vector {', '.join(ROTATION)}"
        )


def mimic_columns(arm: Arm) -> tuple[str, ...]:
    """Columns of mimic joints, which a table may leave out."""
    names = (joint_columns(arm.units), actual_columns(arm.units))
    return tuple(
        n for group in names for n, free in zip(group, arm.independent, strict=True) if not free
    )


def independent_columns(names: tuple[str, ...], count: int, arm: Arm) -> tuple[str, ...]:
    """Return the columns of all joints, or of those that mimic no other, by their `count`."""
    if count == len(names):
        return names
    return tuple(name for name, free in zip(names, arm.independent, strict=True) if free)


def with_mimic_joints(table: ColumnTable, arm: Arm) -> ColumnTable:
    """Return the table with the values of mimic joints filled in; stated ones must agree."""
    number = dict(table.number)
    for names in (joint_columns(arm.units), actual_columns(arm.units)):
        stated = independent_columns(names, int(arm.independent.sum()), arm)
        if arm.independent.all() or not set(stated) <= number.keys():
            continue
        nothing = np.full(len(number[stated[0]]), np.nan)
        q = np.stack([number.get(name, nothing) for name in names], axis=1)
        full = arm.complete(q)
        # False where there is no value
        off = (np.abs(q - full) > JOINT_TOLERANCE) & ~arm.independent
        for i, k in first_true(off):
            raise InputError(
                f"{table.at(i, names[k])}: {q[i, k]:g} {arm.unit(k)}, but by the arm's "
                f"description {arm.joint_names[k]} follows to {full[i, k]:g}; leave the "
                "column out, or correct <mimic> in the URDF"
            )
        number |= {names[k]: full[:, k] for k in np.flatnonzero(~arm.independent).tolist()}
    return replace(table, number=number)


MAX_DISTANCE = 100.0  # m; no instrument measures an arm from further away
MAX_STD = 3e-3  # m; cameras are below it, micrometres read as millimetres above it
MAX_ANGLE_STD = 0.05  # rad, 3°; the same for an orientation, a choice
_LIMIT_MARGIN = 1e-4  # rad; rounding of a limit written with few digits
_TRACKING = 0.1  # rad; actual and commanded joints of an arm at rest are closer


def check_joints(table: ColumnTable, names: tuple[str, ...], q: Floats, arm: Arm) -> None:
    """Refuse commanded joints beyond the arm's limits; (N, n), rad."""
    most = np.maximum(np.abs(arm.q_min), np.abs(arm.q_max))
    large, turns = np.abs(q[:, ~arm.slides]).max(initial=0.0), most[~arm.slides].max(initial=0.0)
    counted = (
        "; where the controller counts from another zero, the other way, or a joint with the one "
        "before it, [robot] joint_offset_deg, joint_sign and joint_coupling of CELL.toml say so"
    )
    seems = " (looks like degrees)" if large > max(turns + 1, 2 * np.pi) else counted
    for i, j in first_true((q < arm.q_min - _LIMIT_MARGIN) | (q > arm.q_max + _LIMIT_MARGIN)):
        if arm.slides[j]:
            seems = " (looks like millimetres)" if abs(q[i, j]) > 10 * most[j] else counted
        elif q[:, j].min() >= 0 and arm.q_min[j] <= q[i, j] - 2 * np.pi <= min(arm.q_max[j], 0):
            seems = (
                "; it is within them a whole turn on: were the angles counted from 0 to 360°? "
                "[joints] from_zero = true of a mapping reads such angles"
            )
        unit, limits = arm.unit(j), f"{arm.q_min[j]:g} to {arm.q_max[j]:g}"
        raise InputError(
            f"{table.at(i, names[j])}: {q[i, j]:g} {unit} is beyond the limits of "
            f"{arm.joint_names[j]} of {arm.name}, {limits} {unit}{seems}"
        )


def check_actual_joints(
    table: ColumnTable, names: tuple[str, ...], actual: Floats, q: Floats
) -> None:
    """Refuse encoder readings that are not near the commanded joints; (N, n), rad."""
    for i, j in first_true(np.abs(actual - q) > _TRACKING):
        unit = names[j].rsplit("_", 1)[1]
        quantity = "joint angle" if unit == "rad" else "travel"
        raise InputError(
            f"{table.at(i, names[j])}: {actual[i, j]:g} {unit} is not within {_TRACKING} {unit} of "
            f"the commanded {q[i, j]:g} {unit}; expected the {quantity} that was reached, in {unit}"
        )


def check_positions(table: ColumnTable, position: Floats, q: Floats, arm: Arm) -> None:
    """Refuse positions (N, 3) that cannot be metres.

    No reading is further than 100 m from its instrument; all lie within a few reaches of each
    other; and joints that move by more than 0.1 rad move the target.
    """
    distance = np.linalg.norm(position, axis=1)
    for (i,) in first_true(distance > MAX_DISTANCE):
        j = int(np.argmax(np.abs(position[i])))
        raise InputError(
            f"{table.at(i, POSITION[j])}: {position[i, j]:g} m cannot be right"
            f"{_looks_like(position[i], distance[i])}; positions must be in m, within "
            f"{MAX_DISTANCE:g} m"
        )
    away = np.linalg.norm(position - np.median(position, axis=0), axis=1)
    if np.any(away > 5 * arm.reach):
        i = int(np.argmax(away))
        raise InputError(
            f"{table.at(i)}: position is {away[i]:.3g} m from the others, the reach of {arm.name} "
            f"is {arm.reach:.3g} m{_looks_like(position[i], distance[i])}; positions must be in m"
        )
    spread = float(away.max())
    travel = np.ptp(q, axis=0)
    joint = int(np.argmax(travel))
    if spread < 1e-3 * arm.reach and travel[joint] > 0.1 and len(np.unique(q, axis=0)) >= 5:
        by = f"{travel[joint]:.2g} {arm.unit(joint)}"
        raise InputError(
            f"{table.path}: columns {', '.join(POSITION)}: the joints move by {by} but "
            f"all positions lie within {spread:.2g} m; expected the measured positions in m, also "
            "of deflections, which are made from them"
        )


def _looks_like(position: Floats, distance: float) -> str:
    """Guess why a position (3,) is impossible: millimetres, or -9999 for no value."""
    if any(re.fullmatch("9{4,}", f"{abs(v):.12g}".replace(".", "")) for v in position):
        return " (nines for no value? leave the row out, or name them as missing in a mapping)"
    return " (looks like millimetres)" if 10.0 < distance < 1e3 * MAX_DISTANCE else ""


def check_rotations(table: ColumnTable, rotation: Floats) -> None:
    """Refuse rotation vectors (N, 3) of more than a turn."""
    angle = np.linalg.norm(rotation, axis=1)
    for (i,) in first_true(angle > 2 * np.pi + 1e-6):
        raise InputError(
            f"{table.at(i)}: rotation vector {', '.join(ROTATION)} has a length of {angle[i]:.4g}, "
            f"more than a turn (looks like degrees); expected axis times angle in rad"
        )


def check_covariances(table: ColumnTable, covariance: Floats) -> None:
    """Refuse covariances (N, m, m) that no error can have.

    A covariance is positive semi-definite; tested on the correlation matrix D V D with
    D = diag(V)^-1/2, so that the answer does not depend on units: eigenvalues >= -SINGULAR.
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    for i, j in first_true(variance < 0):
        raise InputError(
            f"{table.at(i)}: variance {j + 1} of the covariance is {variance[i, j]:g}; "
            f"a variance is >= 0"
        )
    for (i,) in first_true(~np.any(covariance, axis=(1, 2))):
        raise InputError(
            f"{table.at(i)}: the covariance is zero; give the reading's covariance in m², or "
            f"leave out all covariance columns to use the tracker's specification"
        )
    smallest = smallest_correlation(covariance)
    for (i,) in first_true(smallest < -SINGULAR):
        why = f"smallest eigenvalue of the correlation matrix {smallest[i]:.3g}"
        if np.isinf(smallest[i]):
            why = "a covariance is larger than its two variances allow"
        raise InputError(f"{table.at(i)}: the covariance is not positive semi-definite ({why})")
    for elements, most, unit, factor in (
        (variance[:, :3], MAX_STD, "m", "1 mm² = 1e-6 m²"),
        (variance[:, 3:], MAX_ANGLE_STD, "rad", "1 deg² = 3.05e-4 rad²"),
    ):
        std = np.sqrt(elements.max(axis=1, initial=0.0))
        for (i,) in first_true(std > most):
            raise InputError(
                f"{table.at(i)}: a standard deviation of {std[i]:.3g} {unit} cannot calibrate an "
                f"arm; covariances must be in m², m·rad and rad² ({factor})"
            )


def check_wrenches(
    table: ColumnTable, wrench: Floats, load: Ints, names: list[str], arm: Arm
) -> None:
    """Refuse a wrench (N, 6) on an unloaded reading, or one that would break the arm."""
    unloaded = np.array([name == "none" for name in names])[load]
    loaded = unloaded[:, None] & (wrench != 0)
    limit = 20 * arm.payload * STANDARD_GRAVITY_M_S2 * np.repeat([1.0, arm.reach], 3)
    heavy = (np.abs(wrench) > limit) & (arm.payload > 0)
    beyond = f"beyond 20 times the payload of {arm.name}; expected N and N·m"
    zero = "the load is 'none', so the wrench must be 0"
    tool = "what an unzeroed sensor reads of the tool is no load: its weight is [tool] mass_kg"
    table.refuse(loaded, WRENCH, lambda v: f"{v:g}: {zero}; {tool}")
    table.refuse(heavy, WRENCH, lambda v: f"{v:g}: {beyond}")


def check_names(table: ColumnTable) -> None:
    """Refuse empty poses and loads, and other spellings of `none`."""
    for column in ("pose", "load"):
        if "" in table.text[column]:
            i = table.text[column].index("")
            valid = "; write 'none' where there is no load" if column == "load" else ""
            raise InputError(f"{table.at(i, column)}: the cell is empty{valid}")
    odd = sorted(n for n in set(table.text["load"]) if n != "none" and n.lower() == "none")
    if odd:
        i = table.text["load"].index(odd[0])
        raise InputError(f"{table.at(i, 'load')}: '{odd[0]}' must be spelled 'none'")


def check_differences(table: ColumnTable, loaded: Bools, pose: Ints) -> None:
    """Refuse deflections in place of readings: what was read unloaded is zero in every pose.

    `loaded` and `pose` are of the rows (N,). A plane that is touched may read zero in all of them.
    """
    if loaded.all() or not loaded.any() or len(np.unique(pose[~loaded])) < 3:
        return
    for names in (POSITION, *((value,) for value, _, _ in SCALAR.values())):
        if names[0] not in table.number:
            continue
        value = table.matrix(names)
        if not np.nan_to_num(value[~loaded], nan=1.0).any() and np.nansum(value[loaded] ** 2) > 0:
            raise InputError(
                f"{table.path}: {', '.join(names)}: 0 in every unloaded reading, so these "
                "are deflections; readings are expected, from which they are made. Add to all "
                "readings of a pose what the controller states there: the target's position in "
                'base axes ([tracker] frame = "base"), or its height over the gauge\'s plane'
            )


def check_same_pose(table: ColumnTable, pose: Ints, names: list[str], q: Floats, arm: Arm) -> None:
    """Refuse a pose whose commanded joints (N, n) differ between its rows."""
    first_row = np.unique(pose, return_index=True)[1]
    reported = (
        ". Angles that encoders reported need a column that names the pose, and [joints] "
        "reported = true of a mapping"
    )
    for i, j in first_true(np.abs(q - q[first_row][pose]) > SAME_POSE):
        k = int(first_row[pose[i]])
        raise InputError(
            f"{table.at(i)}: pose '{names[pose[i]]}' commands joint {j + 1} to {q[i, j]:.9g} "
            f"{arm.unit(j)}, row {table.rows[k]} to {q[k, j]:.9g}; give another pose another name"
            f"{reported if abs(q[i, j] - q[k, j]) < _TRACKING / 20 else ''}"
        )


MAIN = ObserverName("station", "tracker")  # The station of positions without a named one
KINDS: tuple[ObserverKind, ...] = ("point", "gauge")


@dataclass(frozen=True, slots=True, eq=False)
class ObserverRows:
    """The observer of each row."""

    observer: Ints  # (N,) index of the observer of each row
    names: tuple[ObserverName, ...]  # of the observers; stations come first
    scalar: Bools  # (N,) rows with one number

    def fill(
        self, table: ColumnTable, value: Floats, cov: Floats, std: Mapping[ObserverName, float]
    ) -> tuple[Floats, Floats]:
        """Return values (N, m) and covariances (N, m, m) with distances and heights filled in."""
        value, cov = value.copy(), cov.copy()
        for kind in KINDS:
            column, _, variance_column = SCALAR[kind]
            rows = np.flatnonzero([self.names[k].kind == kind for k in self.observer])
            if not len(rows):
                continue
            value[rows, 0] = measured = table.number[column][rows]
            low = 0.0 if kind == "point" else -MAX_DISTANCE
            for i in rows[(measured < low) | (measured > MAX_DISTANCE)][:1]:
                raise InputError(
                    f"{table.at(i, column)}: {table.number[column][i]:g} m cannot be right; "
                    f"expected {low:g} to {MAX_DISTANCE:g} m"
                )
            stated = table.number.get(variance_column, np.full(len(table.rows), np.nan))
            for i in rows.tolist():
                name = self.names[self.observer[i]]
                variance = std.get(name, np.nan) ** 2 if np.isnan(stated[i]) else stated[i]
                if np.isnan(variance):
                    raise InputError(
                        f"{table.at(i)}: nothing states the noise of {name}; give column "
                        f"'{variance_column}', the variance in m², or [{kind}s.{name.name}] std_m"
                    )
                if not MIN_STD[0] ** 2 <= variance <= MAX_STD**2:
                    raise InputError(
                        f"{table.at(i, variance_column)}: a variance of {variance:g} m² cannot be "
                        f"right; expected standard deviations of {MIN_STD[0]:g} to {MAX_STD:g} m, "
                        "squared"
                    )
                cov[i, 0, 0] = variance
        return value, cov


def observer_rows(table: ColumnTable) -> ObserverRows | None:
    """Return the observers of the rows; None where all are positions measured by one tracker."""
    count, station = len(table.rows), table.text.get(STATION)
    column = {kind: SCALAR[kind][0] for kind in KINDS}
    read = {kind: ~np.isnan(table.number[c]) for kind, c in column.items() if c in table.number}
    if not read and (station is None or (len(set(station)) == 1 and "" not in station)):
        return None
    axes = [c for c in POSITION if c in table.number]
    filled = ~np.isnan(table.matrix(axes)) if axes else np.zeros((count, 1), dtype=np.bool_)
    positioned = filled.any(axis=1)
    readings = np.sum([positioned, *read.values()], axis=0)
    for (i,) in first_true((readings != 1) | (positioned & ~filled.all(axis=1))):
        valid = ", ".join(["x_m, y_m, z_m"] * bool(axes) + [column[kind] for kind in read])
        why = "a part of a position" if readings[i] == 1 else f"{readings[i]} readings"
        raise InputError(f"{table.at(i)}: {why}; valid: just one of {valid} in each row")
    names = []
    for i in range(count):
        kind = next((kind for kind in read if read[kind][i]), None)
        if kind is not None:
            names.append(ObserverName(kind, _name(table, i, SCALAR[kind][1])))
        elif station is None:
            names.append(MAIN)
        else:
            names.append(ObserverName("station", _name(table, i, STATION)))
    order = sorted(dict.fromkeys(names), key=lambda n: n.kind != "station")
    index = {name: k for k, name in enumerate(order)}
    return ObserverRows(np.array([index[n] for n in names]), tuple(order), np.asarray(~positioned))


def _name(table: ColumnTable, row: int, column: str) -> str:
    name = table.text[column][row]
    if not name:
        raise InputError(f"{table.at(row, column)}: the cell is empty; name what observed the row")
    return name


def observer_columns(readings: Readings) -> dict[str, list[str] | Floats]:
    """Return the columns that name the observers, and those of distances and heights."""
    kinds = np.array([o.kind for o in readings.observers])[readings.observer]
    name = np.array([o.name for o in readings.observers])[readings.observer]
    out: dict[str, list[str] | Floats] = {}
    stations = [o for o in readings.observers if o.kind == "station"]
    if stations and stations != [MAIN]:
        out[STATION] = np.where(kinds == "station", name, "").tolist()
    for kind in KINDS:
        of_kind = kinds == kind
        if not of_kind.any():
            continue
        value, observer, variance = SCALAR[kind]
        out[observer] = np.where(of_kind, name, "").tolist()
        out[value] = np.where(of_kind, readings.value[:, 0], np.nan)
        out[variance] = np.where(of_kind, readings.covariance[:, 0, 0], np.nan)
    return out
