"""What may be wrong in the description of arm and readings, as changes that can be tried.

A `Change` maps arm and readings to what they are under it; changes are applied one after another.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.conventions import may_follow, with_conventions
from hilcal.types import Bools, Floats

Kind = Literal[
    "joint",
    "coupling",
    "joint_degrees",
    "joint_radians",
    "millimetres",
    "metres",
    "turn_degrees",
    "turn_radians",
    "mirrored",
    "mirrored_positions",
    "inverse",
    "inverse_attitude",
    "arm",
    "base_unknown",
    "target_unknown",
    "shift",
    "columns",
]
SHIFTS = (1, -1, 2, -2)
"""Rows by which joints and positions are tried against each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """Arm and readings as they are described.

    Attributes:
        arm: the arm.
        q: (N, n) joint values, rad.
        value: (N, 3) positions, m.
        turn: (N, 3) rotation vectors of the attitudes, rad, or None.
        base_unknown: whether the base is estimated.
        target_unknown: whether the targets are.
        shift: by how many rows the joint values come after the positions that they belong to.
    """

    arm: Arm
    q: Floats
    value: Floats
    turn: Floats | None
    base_unknown: bool
    target_unknown: bool
    shift: int = 0

    @property
    def paired(self) -> Bools:
        """(N,) rows that have joint values and a position under the shift."""
        k = np.arange(len(self.q)) + self.shift
        return (k >= 0) & (k < len(self.q))


@dataclass(frozen=True, slots=True)
class Change:
    """One thing that may be otherwise than described.

    Attributes:
        kind: what it is.
        joint: number of the joint from 1, where it is about one.
        sign: −1 where the joint turns the other way.
        offset: what its zero is off by, rad: the chain turns by sign q + offset.
        follows: number of the joint that it follows, from 1; with `factor`.
        factor: of the coupling.
        arm: another arm of the catalogue.
        shift: by how many rows the joint values come after their positions.
        order: column, from 1, that holds the values of each joint.
    """

    kind: Kind
    joint: int = 0
    sign: int = 1
    offset: float = 0.0
    follows: int = 0
    factor: float = 0.0
    arm: str = ""
    shift: int = 0
    order: tuple[int, ...] = ()

    @property
    def is_zero(self) -> bool:
        """Whether it is the zero of a joint alone, by other than quarter turns."""
        quarters = self.offset / (np.pi / 2)
        return self.kind == "joint" and self.sign > 0 and abs(quarters - round(quarters)) > 0.02

    @property
    def cost(self) -> int:
        """How much it changes: a joint that counts from elsewhere and the other way counts two."""
        return 1 + (self.kind == "joint" and self.sign < 0 and self.offset != 0.0)

    def applied(self, d: Described) -> Described:
        """Return arm and readings under this change."""
        n = d.arm.n
        if self.kind in ("joint", "coupling"):
            sign, offset, coupling = np.ones(n), np.zeros(n), np.zeros((n, n))
            if self.kind == "joint":
                sign[self.joint - 1], offset[self.joint - 1] = self.sign, self.offset
            else:
                coupling[self.joint - 1, self.follows - 1] = self.factor
            return replace(d, arm=with_conventions(d.arm, sign, offset, coupling))
        if self.kind == "arm":
            return replace(d, arm=load_arm(self.arm))
        if self.kind in ("joint_degrees", "joint_radians"):
            return replace(
                d, q=np.radians(d.q) if self.kind == "joint_degrees" else np.degrees(d.q)
            )
        if self.kind in ("millimetres", "metres"):
            return replace(d, value=d.value * (1e-3 if self.kind == "millimetres" else 1e3))
        if self.kind == "shift":
            return replace(d, q=np.roll(d.q, -self.shift, axis=0), shift=d.shift + self.shift)
        if self.kind == "columns":
            return replace(d, q=d.q[:, np.array(self.order) - 1])
        if self.kind == "base_unknown":
            return replace(d, base_unknown=True)
        if self.kind == "target_unknown":
            return replace(d, target_unknown=True)
        return self._of_pose(d)

    def _of_pose(self, d: Described) -> Described:
        mirror = np.array([1.0, -1.0, 1.0])
        if self.kind == "mirrored_positions" or d.turn is None:
            return replace(d, value=d.value * mirror)
        if self.kind == "mirrored":  # D exp(w) D = exp(−D w) for a reflection D
            return replace(d, value=d.value * mirror, turn=-d.turn * mirror)
        if self.kind == "turn_degrees":
            return replace(d, turn=np.radians(d.turn))
        if self.kind == "turn_radians":
            return replace(d, turn=np.degrees(d.turn))
        if self.kind == "inverse_attitude":
            return replace(d, turn=-d.turn)
        return replace(d, value=_back(d.value, d.turn), turn=-d.turn)


def _back(value: Floats, turn: Floats) -> Floats:
    """Positions (N, 3) of the inverse poses: −Rᵀ p."""
    return np.asarray(-np.einsum("nji,nj->ni", se3.rotation(turn), value))


def changes(d: Described) -> Iterator[Change]:
    """Yield the single changes that are tried."""
    n = d.arm.n
    if not d.base_unknown:
        yield Change("base_unknown")
    if not d.target_unknown:
        yield Change("target_unknown")
    for j in range(1, n + 1):
        for sign in (-1, 1):
            for quarter in (0, 2, 1, -1):
                if sign < 0 or quarter:
                    yield Change("joint", j, sign, quarter * np.pi / 2)
    for joint, follows in may_follow(n):
        for factor in (1.0, -1.0):
            yield Change("coupling", joint, follows=follows, factor=factor)
    yield Change("millimetres")
    yield Change("metres")
    yield Change("joint_degrees")
    yield Change("joint_radians")
    yield Change("mirrored")
    if d.turn is not None:
        kinds: tuple[Kind, ...] = ("mirrored_positions", "turn_degrees", "turn_radians")
        yield from (Change(k) for k in (*kinds, "inverse", "inverse_attitude"))
    for name in robot_names():
        if name != d.arm.name and load_arm(name).n == n:
            yield Change("arm", arm=name)
    yield from (Change("shift", shift=k) for k in SHIFTS)
    yield from (Change("columns", order=order) for order in column_orders(n))


def column_orders(n: int) -> Iterator[tuple[int, ...]]:
    """Yield orders of the joints' columns other than their own: two exchanged, or all in a turn."""
    own = list(range(1, n + 1))
    orders = []
    for i, j in combinations(range(n), 2):
        order = own.copy()
        order[i], order[j] = order[j], order[i]
        orders.append(tuple(order))
    orders += [(*own[k:], *own[:k]) for k in range(1, n)]
    yield from dict.fromkeys((*orders, tuple(own[::-1])))


def pairs(n: int) -> Iterator[tuple[Change, ...]]:
    """Yield pairs that hide behind each other: two signs, and the zeros of two neighbours."""
    for i in range(1, n + 1):
        for j in range(i + 1, n + 1):
            yield Change("joint", i, -1), Change("joint", j, -1)
    for j in range(1, n):
        for a in (1, -1, 2):
            for b in (1, -1, 2):
                zeros = (a * np.pi / 2, b * np.pi / 2)
                yield Change("joint", j, 1, zeros[0]), Change("joint", j + 1, 1, zeros[1])
