"""The pictures of a fleet: arms of a type side by side, and their campaigns by date."""

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import rerun as rr

from hilcal.present.fleet import unlike_words
from hilcal.present.viewer import arm_shapes, style
from hilcal.robot.arm import Arm
from hilcal.robot.body import body_poses, capsules
from hilcal.store.revision import seconds_of
from hilcal.types import Bools, Floats

if TYPE_CHECKING:
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


_STANDS = (0.0, -1.4, 1.0, -1.2, -1.57, 0.0)
"""Joint values of the drawn arms, rad: upright, so that many stand side by side; a choice."""
_APART = (0.62, 0.95)
"""Distances of arms and of their rows, shares of the reach; a choice."""
_NAMED = 40
"""Arms up to which each has its name beside it; a choice."""
_ROWS = 12
"""Parameters that are drawn at most; a choice."""


def places(d: TypeDigest) -> Floats:
    """(A, 3) where the arms stand, m: in rows, the first in front."""
    count, reach = len(d.pooled.arms), max(d.arm.reach, 0.1)
    wide = max(math.ceil(math.sqrt(2.0 * count)), 1)
    index = np.arange(count)
    at = np.zeros((count, 3))
    at[:, 0] = -_APART[1] * reach * (index // wide)
    at[:, 1] = _APART[0] * reach * (index % wide - (min(wide, count) - 1) / 2)
    return at


def arms(rec: rr.RecordingStream, path: str, d: TypeDigest) -> None:
    """Log the arms; a joint that is unlike the type is red, one beyond `FAR` σ amber."""
    rec.log(path, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    n, shapes = d.arm.n, capsules(d.arm)
    q = np.resize(np.array(_STANDS), n)[None]
    poses = body_poses(d.arm, q)[0]
    body = np.array([s.body for s in shapes])
    start, end = (
        np.einsum("kij,kj->ki", poses[body, :3, :3], x) + poses[body, :3, 3]
        for x in (np.array([s.start for s in shapes]), np.array([s.end for s in shapes]))
    )
    radius = np.array([s.radius for s in shapes])
    top = np.array([0.0, 0.0, 1.06 * float((np.maximum(start, end)[:, 2] + radius).max())])
    at = places(d)
    marked = np.asarray(d.odd.any(axis=1))
    colors = np.concatenate([_colors(d, a)[body] for a in range(len(at))])
    rec.log(
        f"{path}/arms",
        arm_shapes.capsules(
            np.concatenate([start + p for p in at]),
            np.concatenate([end + p for p in at]),
            np.tile(radius, len(at)),
            colors,
        ),
        static=True,
    )
    named = np.flatnonzero(marked | (len(at) <= _NAMED))
    # Long words stand above the names of the neighbours, each arm's on a line of its own.
    step = np.cumsum(marked)[named] * marked[named]
    above = np.outer(np.where(step > 0, 0.25 + 0.12 * step, 0.0) * max(d.arm.reach, 0.1), [0, 0, 1])
    rec.log(
        f"{path}/names/leader",
        rr.LineStrips3D(
            [np.stack([p, p + a]) for p, a in zip(at[named] + top, above, strict=True)],
            colors=[style.RED],
            radii=rr.Radius.ui_points(1.0),
        ),
        static=True,
    )
    rec.log(
        f"{path}/names",
        arm_shapes.labels(at[named] + top + above, [_label(d, int(a)) for a in named]),
        static=True,
    )
    if marked.any():
        half = np.array([0.27, 0.27, 0.5 * top[2] / max(d.arm.reach, 0.1)])
        half *= max(d.arm.reach, 0.1)
        rec.log(
            f"{path}/unlike",
            rr.Boxes3D(
                centers=at[marked] + 0.5 * top,
                half_sizes=[half] * int(marked.sum()),
                colors=[style.RED],
                radii=rr.Radius.ui_points(2.0),
                fill_mode="majorwireframe",
            ),
            static=True,
        )


def _colors(d: TypeDigest, a: int) -> npt.NDArray[np.uint8]:
    """(n + 1, 3) colours of the bodies of an arm."""
    shades = [arm_shapes.METAL if i % 2 else arm_shapes.LIGHT for i in range(d.arm.n + 1)]
    out = np.array(shades, dtype=np.uint8)
    far = np.abs(np.nan_to_num(d.units[a])) > FAR
    for chosen, color in ((far, style.AMBER), (d.odd[a], style.RED)):
        for k in np.flatnonzero(chosen):
            out[d.joints[k]] = color
    return out


def _label(d: TypeDigest, a: int) -> str:
    lines = [unlike_words(o) for o in d.told(a)]
    return "\n".join(lines[:3]) or d.pooled.arms[a]


def rows(d: TypeDigest) -> list[int]:
    """Return the parameters that are drawn: those with the farthest arms, in their order."""
    far = np.nanmax(np.abs(np.where(np.isfinite(d.units), d.units, 0.0)), axis=0)
    return sorted(np.argsort(-far, kind="stable")[:_ROWS].tolist())


def drift(rec: rr.RecordingStream, path: str, d: TypeDigest) -> None:
    """Send each arm's campaigns along `date`, a view per parameter."""
    for k in rows(d):
        for a, arm in enumerate(d.pooled.arms):
            mine = [c for c in range(len(d.owner)) if d.owner[c] == a]
            mine = [c for c in mine if np.isfinite(d.campaigns[c, k])]
            if not mine:
                continue
            odd = bool(d.odd[a, k])
            entity = f"{path}/{k}/{'zunlike' if odd else 'like'}/{a}"
            color, width = (style.RED, 3.0) if odd else (style.GREY, 1.2)
            name = style.safe(arm)
            rec.log(
                entity,
                rr.SeriesLines(names=[name], colors=[color], widths=[width]),
                rr.SeriesPoints(
                    names=[name], colors=[color], markers=["circle"], marker_sizes=[2 * width]
                ),
                static=True,
            )
            rec.send_columns(
                entity,
                indexes=[rr.TimeColumn("date", timestamp=d.seconds[mine])],
                columns=rr.Scalars.columns(scalars=d.campaigns[mine, k]),
            )
