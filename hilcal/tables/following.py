"""Columns of joints that have no value of their own, since they mimic another joint of the arm."""

from dataclasses import replace

import numpy as np

from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from hilcal.tables import columns
from hilcal.tables.csvfile import CsvTable

AGREES = 2e-3
"""How far a stated value may be from what the arm's description says, rad: a tenth of a degree, to
which tables round. A choice."""


def following_columns(arm: Arm) -> tuple[str, ...]:
    """Columns of joints that a table may leave out."""
    names = (columns.joint_columns(arm.n), columns.actual_columns(arm.n))
    return tuple(n for group in names for n, own in zip(group, arm.own, strict=True) if not own)


def own_columns(names: tuple[str, ...], count: int, arm: Arm) -> tuple[str, ...]:
    """Return the names of all joints' columns, or of those with a value of their own."""
    if count == len(names):
        return names
    return tuple(name for name, own in zip(names, arm.own, strict=True) if own)


def with_following(table: CsvTable, arm: Arm) -> CsvTable:
    """Return the table with the values of mimic joints as they follow from the others.

    Raises:
        InputError: a value is given and is another one.
    """
    if arm.own.all():
        return table
    number = dict(table.number)
    for names in (columns.joint_columns(arm.n), columns.actual_columns(arm.n)):
        own = [name for name, is_own in zip(names, arm.own, strict=True) if is_own]
        if not set(own) <= number.keys():
            continue
        nothing = np.full(len(number[own[0]]), np.nan)
        q = np.stack([number.get(name, nothing) for name in names], axis=1)
        full = arm.complete(q)
        for k in np.flatnonzero(~arm.own):
            off = np.abs(q[:, k] - full[:, k]) > AGREES  # False where there is no value
            if off.any():
                i = int(np.argmax(off))
                raise InputError(
                    f"{table.at(i, names[k])}: {q[i, k]:g} rad, but by the arm's description "
                    f"{arm.joint_names[k]} follows to {full[i, k]:g} rad; leave the column out, or "
                    "correct <mimic> in the URDF"
                )
            number[names[k]] = full[:, k]
    return replace(table, number=number)
