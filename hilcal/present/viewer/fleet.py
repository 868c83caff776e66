"""A fleet in rerun: which arm is unlike its type, in which joint, and since when."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from hilcal import numbers
from hilcal.present.document import heading
from hilcal.present.fleet import FAR, type_report, unlike_words
from hilcal.present.viewer import arm_shapes, layout, recording, style
from hilcal.robot.arm import Arm
from hilcal.robot.body import body_poses, capsules
from hilcal.store.revision import seconds_of
from hilcal.types import Bools, Floats

if TYPE_CHECKING:  # above this layer
    from hilcal.transfer.fleet import Fleet
    from hilcal.transfer.members import Member
    from hilcal.transfer.pooled import Odd, Pooled

_JOINT = re.compile(r"\.j(\d+)\b")


@dataclass(frozen=True, slots=True, eq=False)
class DrawnType:
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


def drawn_type(t: "Pooled", members: "tuple[Member, ...]") -> DrawnType:
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
    joints = tuple(int(found[1]) if (found := _JOINT.search(n)) else 0 for n in names)
    return DrawnType(
        pooled=t,
        arm=_drawn(t),
        units=t.distance,
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


def places(d: DrawnType) -> Floats:
    """(A, 3) where the arms stand, m: in rows, the first in front."""
    count, reach = len(d.pooled.arms), max(d.arm.reach, 0.1)
    wide = max(math.ceil(math.sqrt(2.0 * count)), 1)
    index = np.arange(count)
    at = np.zeros((count, 3))
    at[:, 0] = -_APART[1] * reach * (index // wide)
    at[:, 1] = _APART[0] * reach * (index % wide - (min(wide, count) - 1) / 2)
    return at


def arms(rec: rr.RecordingStream, path: str, d: DrawnType) -> None:
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


def _colors(d: DrawnType, a: int) -> npt.NDArray[np.uint8]:
    """(n + 1, 3) colours of the bodies of an arm."""
    shades = [arm_shapes.METAL if i % 2 else arm_shapes.LIGHT for i in range(d.arm.n + 1)]
    out = np.array(shades, dtype=np.uint8)
    far = np.abs(np.nan_to_num(d.units[a])) > FAR
    for chosen, color in ((far, style.AMBER), (d.odd[a], style.RED)):
        for k in np.flatnonzero(chosen):
            out[d.joints[k]] = color
    return out


def _label(d: DrawnType, a: int) -> str:
    lines = [unlike_words(o) for o in d.told(a)]
    return "\n".join(lines[:3]) or d.pooled.arms[a]


def rows(d: DrawnType) -> list[int]:
    """Return the parameters that are drawn: those with the farthest arms, in their order."""
    far = np.nanmax(np.abs(np.where(np.isfinite(d.units), d.units, 0.0)), axis=0)
    return sorted(np.argsort(-far, kind="stable")[:_ROWS].tolist())


def drift(rec: rr.RecordingStream, path: str, d: DrawnType) -> None:
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


_LEAST_RANGE_S = 86400.0
GUIDE = """### How to read this
- **Arms**: one of each, side by side. A red joint is unlike the others of the type; its arm stands
  in a red frame. Amber: beyond 3 σ, which chance does to one parameter in some hundred.
- **By date**: each campaign in σ of the type: the spread from arm to arm together with the
  uncertainty of the campaign. A line that leaves the others has changed; lines that go
  the same way are wear.
"""


def record_fleet(fleet: "Fleet", path: Path) -> None:
    """Write what is known of a fleet as a recording file; equal fleets give equal recordings.

    Raises:
        InputError: the folder is missing.
        HilcalError: the file cannot be written.
    """
    path = Path(path)
    recording.require_folder(path)
    types = [drawn_type(t, fleet.members) for t in fleet.types]
    told = [(d.pooled.type, d.pooled.arms, d.pooled.odd, d.names) for d in types]
    rec = recording.opened(told, *(a for d in types for a in (d.units, d.seconds, d.campaigns)))
    recording.write(rec, _blueprint(types), lambda: _log(rec, types), path)


def _log(rec: rr.RecordingStream, types: list[DrawnType]) -> None:
    count = sum(len(d.pooled.arms) for d in types)
    rec.send_recording_name(f"hilcal fleet: {count} arms")
    for i, d in enumerate(types):
        arms(rec, f"arms{i}", d)
        drift(rec, f"date{i}", d)
        rec.log(f"words/type{i}", style.document(_told(d)), static=True)
    rec.log("words/guide", style.document(GUIDE), static=True)
    recording.flush(rec)


def _told(d: DrawnType) -> str:
    odd = list(dict.fromkeys(o.arm for o in d.pooled.odd))
    verb = "is" if len(odd) == 1 else "are"
    title = f"{numbers.names(odd)} {verb} unlike the others" if odd else "No arm is unlike"
    name, table, note, *lines = type_report(d.pooled)
    return style.markdown([heading(title), name, *lines, table, note])


def _blueprint(types: list[DrawnType]) -> rrb.Blueprint:
    """Left: the arms over their campaigns by date. Right: the verdict and the parameters."""
    many = len(types) > 1
    of = [f"{d.pooled.type}: " if many else "" for d in types]
    scenes = [_arms(f"arms{i}", of[i], d) for i, d in enumerate(types)]
    dates = [
        rrb.TimeSeriesView(
            origin=f"date{i}/{k}",
            name=f"{of[i]}{d.names[k]} by date [σ]",
            plot_legend=rrb.PlotLegend(visible=False),
            axis_x=_whole(d),
        )
        for i, d in enumerate(types)
        for k in sorted(rows(d), key=lambda k: (not d.odd[:, k].any(), k))
    ]
    words = [
        rrb.TextDocumentView(origin=f"words/type{i}", name=f"{of[i]}Unlike the type")
        for i in range(len(types))
    ]
    words.append(rrb.TextDocumentView(origin="words/guide", name="How to read this"))
    left = rrb.Vertical(rrb.Tabs(*scenes), rrb.Tabs(*dates), row_shares=[3, 2])
    return layout.whole(rrb.Horizontal(left, rrb.Tabs(*words), column_shares=[3, 2]), "date")


def _whole(d: DrawnType) -> rrb.TimeAxis:
    """Return the range of all dates, with a margin."""
    low, high = float(d.seconds.min()), float(d.seconds.max())
    wide = max(0.05 * (high - low), _LEAST_RANGE_S)
    ends = [rrb.TimeRangeBoundary.absolute(seconds=t) for t in (low - wide, high + wide)]
    return rrb.TimeAxis(view_range=rrb.TimeRange(*ends))


def _arms(origin: str, of: str, d: DrawnType) -> rrb.Spatial3DView:
    at, reach = places(d), max(d.arm.reach, 0.1)
    middle = at.mean(axis=0) + np.array([0.0, 0.0, 0.35 * reach])
    size = float(np.ptp(at, axis=0).max()) + reach
    name = f"{of}{len(at)} arms; a red frame: unlike the others, the red joint says where"
    return layout.view3d(origin, name, middle + size * np.array([0.68, 0.0, 0.36]), middle)
