"""What the views of a fleet have in common: how far each arm and each campaign is from the type."""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hilcal.robot.arm import Arm
from hilcal.store.revision import seconds_of
from hilcal.types import Bools, Floats

if TYPE_CHECKING:  # above this layer
    from hilcal.transfer.members import Member
    from hilcal.transfer.pooled import Odd, Pooled

FAR = 3.0
"""Standard deviations between which most arms lie; a choice."""
_JOINT = re.compile(r"\.j(\d+)\b")


@dataclass(frozen=True, slots=True, eq=False)
class TypeDigest:
    """One type of a fleet; A arms, K pooled parameters, C campaigns.

    Attributes:
        pooled: what is known of the type.
        arm: its links, for drawing.
        units: (A, K) distance of each arm from the mean of the type, in σ: the root of the spread
            from arm to arm and its own uncertainty; NaN where it did not determine the parameter.
        odd: (A, K) what is unlike the type.
        joints: (K,) joint that a parameter is of, from 1; 0 for none.
        owner: (C,) arm of each campaign.
        seconds: (C,) when it was measured, since 1970.
        campaigns: (C, K) the same distance of each campaign.
        changed: (C, K) what has changed with that campaign, unlike other arms.
    """

    pooled: "Pooled"
    arm: Arm
    units: Floats
    odd: Bools
    joints: tuple[int, ...]
    owner: tuple[int, ...]
    seconds: Floats
    campaigns: Floats
    changed: Bools

    @property
    def names(self) -> tuple[str, ...]:
        """(K,) names of the parameters."""
        return tuple(p.parameter for p in self.pooled.parameters)

    def told(self, arm: int) -> "list[Odd]":
        """Return what is unlike in an arm, or has changed."""
        return [o for o in self.pooled.odd if o.arm == self.pooled.arms[arm]]


def type_digest(t: "Pooled", members: "tuple[Member, ...]") -> TypeDigest:
    """Derive what the views of a type need."""
    names, arms = [p.parameter for p in t.parameters], list(t.arms)
    between = np.array([p.between for p in t.parameters])
    mean = np.array([p.mean for p in t.parameters])
    odd, mine = np.zeros((len(arms), len(names)), dtype=np.bool_), []
    for m in members:
        if m.type == t.type and m.name in t.campaigns:
            mine.append(m)
    mine.sort(key=lambda m: (arms.index(m.arm), seconds_of(m.date)))
    values = np.full((len(mine), len(names)), np.nan)
    changed = np.zeros(values.shape, dtype=np.bool_)
    for c, m in enumerate(mine):
        p = m.posterior
        for name, value, std in zip(p.names, p.mean, p.std, strict=True):
            if name in names and np.isfinite(std):
                k = names.index(name)
                values[c, k] = (value - mean[k]) / np.hypot(between[k], std)
    for o in t.odd:
        k = names.index(o.parameter)
        odd[arms.index(o.arm), k] = True
        for c, m in enumerate(mine):
            changed[c, k] |= o.campaign == m.name
    seen = np.isfinite(t.off_std)
    units = np.where(seen, t.off / np.hypot(between, np.where(seen, t.off_std, 1.0)), np.nan)
    joints = tuple(int(found[1]) if (found := _JOINT.search(n)) else 0 for n in names)
    return TypeDigest(
        pooled=t,
        arm=_drawn(t),
        units=units,
        odd=odd,
        joints=joints,
        owner=tuple(arms.index(m.arm) for m in mine),
        seconds=np.array([seconds_of(m.date) for m in mine]),
        campaigns=values,
        changed=changed,
    )


def _drawn(t: "Pooled") -> Arm:
    """Return an arm that has the links of the type, and nothing else."""
    n = len(t.prior.links) - 1
    none, wide = np.zeros(n), np.full(n, np.inf)
    names = tuple(f"j{k + 1}" for k in range(n))
    return Arm(t.type, t.prior.links, none, np.zeros((n, 3)), -wide, wide, wide, 0.0, names, "")
