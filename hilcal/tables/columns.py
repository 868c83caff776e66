"""Columns of the exchange table: names, checks of the header, joints that mimic others."""

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from difflib import get_close_matches

import numpy as np

from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from hilcal.tables.grid import ColumnTable

POSITION = ("x_m", "y_m", "z_m")
ROTATION = ("rx_rad", "ry_rad", "rz_rad")
WRENCH = ("fx_N", "fy_N", "fz_N", "mx_Nm", "my_Nm", "mz_Nm")
TEXT = ("pose", "load")
TARGET, COVERS, STATION = "target", "covers", "station"
PREVIEW = "hilcal import TABLE --preview proposes a mapping for --format"
SCALAR = {"point": ("distance_m", "from", "cov_d_d"), "gauge": ("gauge_m", "gauge", "cov_g_g")}
"""Columns of a reading that is one number, by kind of observer: value, observer, variance."""
OWN_PREFIX = "x_"
AGREES = 2e-3  # rad; largest difference from the arm's description: tables round to 0.1°. A choice
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
    """Number columns that may have empty cells: torques; readings, where some are one number."""
    torques = tuple(c for c in header if re.fullmatch(r"tau[0-9]+_Nm?", c))
    if not any(value in header for value, _, _ in SCALAR.values()):
        return torques
    scalar = [c for value, _, variance in SCALAR.values() for c in (value, variance)]
    return (*POSITION, *ROTATION, *covariance_columns(6), *scalar, *torques)


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
    path: str, header: Sequence[str], units: Units, arm: str, spare: Collection[str] = ()
) -> None:
    """Refuse a header that does not fit an arm; `spare` columns may be missing."""
    for k, name in enumerate(header, start=1):
        if not 0 < len(name) <= 80:
            raise InputError(f"{path}: column {k} has no name, or a long one, in row 1")
        if header.count(name) > 1:
            raise InputError(
                f"{path}: column '{name}' appears {header.count(name)} times; keep one"
            )
    valid, needed = known_columns(units), required_columns(units)
    if any(name in header for kind in SCALAR.values() for name in kind):
        _check_scalar(path, header)
    if POSITION[0] in sparse_columns(header) and POSITION[0] not in header:
        needed = needed[:-3]
    missing = [c for c in needed if c not in header and c not in spare]
    for name in header:
        if name not in valid and not name.startswith(OWN_PREFIX):
            form = f"; for a table of another form: {PREVIEW}" if missing else ""
            advice = _advice(name, valid, header, len(_numbered(units)))
            raise InputError(f"{path}: unknown column '{name}'{advice}{form}")
    if missing:
        hint = _hint(missing, header, units, arm)
        raise InputError(f"{path}: column '{missing[0]}' is missing{hint}")
    for group in groups(units):
        lacking = [c for c in group if c not in header and c not in spare]
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
    """Return advice on an unknown column."""
    first, _, last = name.partition("_")
    i, _, j = last.partition("_")
    if first == "cov" and f"cov_{j}_{i}" in valid:
        return f"; give the upper triangle only: 'cov_{j}_{i}'"
    column = next((c for c in valid if c.startswith(f"{first}_")), None)
    if column is not None and re.fullmatch(r"qa?[0-9]+_(rad|m)", name):
        return f"; this joint {'slides' if column.endswith('_m') else 'turns'}: '{column}'"
    close = _closest(name, (c for c in valid if c not in header)) or _closest(name, valid)
    prefix = f"columns of your own start with '{OWN_PREFIX}'"
    joints = f" (the arm has {n} joints)" if any(ch.isdigit() for ch in close or "") else ""
    return f"; did you mean '{close}'{joints}? Else: {prefix}" if close else f"; {prefix}"


def _hint(missing: Sequence[str], header: Sequence[str], units: Units, arm: str) -> str:
    """Return a hint on missing columns."""
    user_columns = [c for c in header if c.startswith(OWN_PREFIX)]
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


def following_columns(arm: Arm) -> tuple[str, ...]:
    """Columns of mimic joints, which a table may leave out."""
    names = (joint_columns(arm.units), actual_columns(arm.units))
    return tuple(n for group in names for n, free in zip(group, arm.own, strict=True) if not free)


def independent_columns(names: tuple[str, ...], count: int, arm: Arm) -> tuple[str, ...]:
    """Return the columns of all joints, or of those that mimic no other, by their `count`."""
    if count == len(names):
        return names
    return tuple(name for name, free in zip(names, arm.own, strict=True) if free)


def with_following(table: ColumnTable, arm: Arm) -> ColumnTable:
    """Return the table with the values of mimic joints filled in; stated ones must agree."""
    number = dict(table.number)
    for names in (joint_columns(arm.units), actual_columns(arm.units)):
        stated = independent_columns(names, int(arm.own.sum()), arm)
        if arm.own.all() or not set(stated) <= number.keys():
            continue
        nothing = np.full(len(number[stated[0]]), np.nan)
        q = np.stack([number.get(name, nothing) for name in names], axis=1)
        full = arm.complete(q)
        off = (np.abs(q - full) > AGREES) & ~arm.own  # False where there is no value
        if off.any():
            i, k = divmod(int(np.argmax(off)), len(names))
            raise InputError(
                f"{table.at(i, names[k])}: {q[i, k]:g} {arm.unit(k)}, but by the arm's "
                f"description {arm.joint_names[k]} follows to {full[i, k]:g}; leave the "
                "column out, or correct <mimic> in the URDF"
            )
        number |= {names[k]: full[:, k] for k in np.flatnonzero(~arm.own).tolist()}
    return replace(table, number=number)
