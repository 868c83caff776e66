"""A fleet in rerun: arms that differ from their type, by joint and date."""

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilcal import numbers
from hilcal.present.comparison import FAR, type_report, unlike_words
from hilcal.present.document import heading
from hilcal.present.viewer import recording, style
from hilcal.robot.arm import Arm
from hilcal.robot.scene import body_poses, capsules
from hilcal.store.revision import seconds_of
from hilcal.types import Bools, Floats

if TYPE_CHECKING:  # above this layer
    from hilcal.transfer.fleet import Fleet, PooledType
    from hilcal.transfer.members import Member

_JOINT = re.compile(r"\.j(\d+)\b")
_STANDS = (0.0, -1.4, 1.0, -1.2, -1.57, 0.0)  # joint values of the drawn arms, rad: upright
_APART = (0.62, 0.95)  # distances of arms and of their rows, shares of the reach; a choice
_NAMED, _ROWS = 40, 12  # most arms that are all labelled; most parameters that are drawn; choices
_LEAST_RANGE_S = 86400.0
GUIDE = """### How to read this
- **Arms**: one of each, side by side. A red joint is unlike the others of the type; its arm stands
  in a red frame. Amber: beyond 3 σ, which chance does to one parameter in some hundred.
- **By date**: each campaign in σ of the type: the spread from arm to arm together with the
  uncertainty of the campaign. A line that leaves the others has changed; lines that go
  the same way are wear.
"""


class DrawnType:
    """Data of the views of a type: A arms, K pooled parameters, C campaigns of `members`."""

    def __init__(self, pooled: "PooledType", members: "tuple[Member, ...]") -> None:
        arms, links = list(pooled.arms), pooled.prior.links
        self.pooled, self.names = pooled, tuple(p.parameter for p in pooled.parameters)  # (K,)
        # (K,) joint of each parameter, from 1; 0 for none
        matches = [_JOINT.search(name) for name in self.names]
        self.joints = tuple(0 if m is None else int(m[1]) for m in matches)
        n = len(links) - 1  # joints of an arm with the links of the type, without limits
        none, wide, joints = np.zeros(n), np.full(n, np.inf), tuple(f"j{k + 1}" for k in range(n))
        self.arm = Arm(
            pooled.type, links, none, np.zeros((n, 3)), -wide, wide, wide, 0.0, joints, ""
        )
        self.reach = max(self.arm.reach, 0.1)  # m, scale of drawn sizes
        # (A, K) whether a parameter of an arm is unlike the type
        self.odd: Bools = np.zeros((len(arms), len(self.names)), dtype=np.bool_)
        for o in pooled.unlike:
            self.odd[arms.index(o.arm), self.names.index(o.parameter)] = True
        of_type = [m for m in members if m.type == pooled.type and m.name in pooled.campaigns]
        of_type.sort(key=lambda m: (arms.index(m.arm), seconds_of(m.date)))
        # (C,) arm and date of each campaign, s since 1970
        self.owner = np.array([arms.index(m.arm) for m in of_type], dtype=np.int64)
        self.seconds = np.array([seconds_of(m.date) for m in of_type])
        # (C, K) distance of each campaign from the mean of the type, in σ, the root sum of squares
        # of the spread between arms and of the campaign's uncertainty; NaN: not determined
        self.campaigns = np.full((len(of_type), len(self.names)), np.nan)
        for row, m in zip(self.campaigns, of_type, strict=True):
            p = m.posterior
            for name, value, std in zip(p.names, p.mean, p.std, strict=True):
                if name in self.names and np.isfinite(std):
                    mean = pooled.parameters[k := self.names.index(name)]
                    row[k] = (value - mean.mean) / np.hypot(mean.between, std)


def arm_positions(d: DrawnType) -> Floats:
    """Return the positions (A, 3) of the arms, m: in rows, the first in front."""
    count = len(d.pooled.arms)
    wide = max(math.ceil(math.sqrt(2.0 * count)), 1)
    index = np.arange(count)
    across = index % wide - (min(wide, count) - 1) / 2
    return np.stack([-_APART[1] * (index // wide), _APART[0] * across, 0 * index], 1) * d.reach


def _arms(rec: rr.RecordingStream, path: str, d: DrawnType) -> None:
    """Log the arms; joints unlike the type are red, those beyond `FAR` σ amber."""
    rec.log(path, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    parts = [*capsules(d.arm), *style.rails(d.arm)]
    poses = body_poses(d.arm, np.resize(np.array(_STANDS), d.arm.n)[None])[0]
    body, radius = (np.array([getattr(s, k) for s in parts]) for k in ("body", "radius"))
    start, end = (
        np.einsum("kij,kj->ki", poses[body, :3, :3], x) + poses[body, :3, 3]
        for x in (np.array([s.start for s in parts]), np.array([s.end for s in parts]))
    )
    top = np.array([0.0, 0.0, 1.06 * float((np.maximum(start, end)[:, 2] + radius).max())])
    place, marked = arm_positions(d), np.asarray(d.odd.any(axis=1))
    low, high = (np.concatenate([x + p for p in place]) for x in (start, end))
    colors = np.concatenate([_colors(d, a)[body] for a in range(len(place))])
    rec.log(
        f"{path}/arms",
        style.drawn_capsules(low, high, np.tile(radius, len(place)), colors),
        static=True,
    )
    named = np.flatnonzero(marked | (len(place) <= _NAMED))
    # Long labels are placed above the names of the neighbours, at different heights.
    step = np.cumsum(marked)[named] * marked[named]
    above = np.outer(np.where(step > 0, 0.25 + 0.12 * step, 0.0) * d.reach, [0, 0, 1])
    feet = place[named] + top
    thin = rr.Radius.ui_points(1.0)
    leaders = rr.LineStrips3D(np.stack([feet, feet + above], 1), colors=[style.RED], radii=thin)
    rec.log(f"{path}/names/leader", leaders, static=True)
    arms = [d.pooled.arms[a] for a in named]
    unlike = [[unlike_words(o) for o in d.pooled.unlike if o.arm == arm] for arm in arms]
    texts = ["\n".join(lines[:3]) or arm for arm, lines in zip(arms, unlike, strict=True)]
    rec.log(f"{path}/names", style.labels(feet + above, texts), static=True)
    if marked.any():
        frames = rr.Boxes3D(
            centers=place[marked] + 0.5 * top,
            half_sizes=[(0.27 * d.reach, 0.27 * d.reach, 0.5 * top[2])] * int(marked.sum()),
            colors=[style.RED],
            radii=rr.Radius.ui_points(2.0),
            fill_mode="majorwireframe",
        )
        rec.log(f"{path}/unlike", frames, static=True)


def _colors(d: DrawnType, a: int) -> "np.ndarray[tuple[int, ...], np.dtype[np.uint8]]":
    """Return the colours (n + 1, 3) of the bodies of an arm."""
    out = np.array([style.shade(i) for i in range(d.arm.n + 1)], dtype=np.uint8)
    far = np.abs(np.nan_to_num(d.pooled.distance[a])) > FAR
    for chosen, color in ((far, style.AMBER), (d.odd[a], style.RED)):
        for k in np.flatnonzero(chosen):
            out[d.joints[k]] = color
    return out


def _rows(d: DrawnType) -> list[int]:
    """Return the parameters that are drawn: those with the largest distances, in their order."""
    far = np.nan_to_num(np.abs(d.pooled.distance), posinf=0.0).max(axis=0)
    return sorted(np.argsort(-far, kind="stable")[:_ROWS].tolist())


def _drift(rec: rr.RecordingStream, path: str, d: DrawnType) -> None:
    for k in _rows(d):
        for a, arm in enumerate(d.pooled.arms):
            determined = (d.owner == a) & np.isfinite(d.campaigns[:, k])
            if not determined.any():
                continue
            odd = bool(d.odd[a, k])
            entity = f"{path}/{k}/{'zunlike' if odd else 'like'}/{a}"
            color, width = (style.RED, 3.0) if odd else (style.GREY, 1.2)
            rec.log(entity, *style.series(arm, color, width, 2 * width), static=True)
            time = rr.TimeColumn("date", timestamp=d.seconds[determined])
            rec.send_columns(entity, [time], rr.Scalars.columns(scalars=d.campaigns[determined, k]))


def record_fleet(fleet: "Fleet", path: Path) -> None:
    """Write a fleet as a recording file; equal fleets give equal recordings."""
    types = [DrawnType(t, fleet.members) for t in fleet.types]
    names = [(d.pooled.type, d.pooled.arms, d.pooled.unlike, d.names) for d in types]
    content = (a for d in types for a in (d.pooled.distance, d.seconds, d.campaigns))
    rec = recording.content_stream(names, *content)
    recording.write(rec, _blueprint(types), lambda: _log(rec, types), Path(path))


def _log(rec: rr.RecordingStream, types: list[DrawnType]) -> None:
    rec.send_recording_name(f"hilcal fleet: {sum(len(d.pooled.arms) for d in types)} arms")
    for i, d in enumerate(types):
        _arms(rec, f"arms{i}", d)
        _drift(rec, f"date{i}", d)
        odd = list(dict.fromkeys(o.arm for o in d.pooled.unlike))
        verb = "is" if len(odd) == 1 else "are"
        who = f"{numbers.names(odd)} {verb}" if odd else "No arm is"
        name, table, note, *lines = type_report(d.pooled)
        text = style.markdown([heading(f"{who} unlike the others"), name, *lines, table, note])
        rec.log(f"words/type{i}", style.document(text), static=True)
    rec.log("words/guide", style.document(GUIDE), static=True)
    recording.flush(rec)


def _blueprint(types: list[DrawnType]) -> rrb.Blueprint:
    scenes, dates, texts = [], [], []
    for i, d in enumerate(types):
        title = f"{d.pooled.type}: " if len(types) > 1 else ""
        place = arm_positions(d)
        middle = place.mean(axis=0) + np.array([0.0, 0.0, 0.35 * d.reach])
        eye = middle + (np.ptp(place, axis=0).max() + d.reach) * np.array([0.68, 0.0, 0.36])
        name = f"{title}{len(place)} arms; red: unlike the others"
        scenes.append(style.view3d(f"arms{i}", name, eye, middle))
        low, high = float(d.seconds.min()), float(d.seconds.max())
        wide = max(0.05 * (high - low), _LEAST_RANGE_S)
        ends = [rrb.TimeRangeBoundary.absolute(seconds=t) for t in (low - wide, high + wide)]
        axis, quiet = rrb.TimeAxis(view_range=rrb.TimeRange(*ends)), rrb.PlotLegend(visible=False)
        for k in sorted(_rows(d), key=lambda k: (not d.odd[:, k].any(), k)):
            origin, name = f"date{i}/{k}", f"{title}{d.names[k]} by date [σ]"
            view = rrb.TimeSeriesView(origin=origin, name=name, plot_legend=quiet, axis_x=axis)
            dates.append(view)
        texts.append(style.text(f"type{i}", f"{title}Unlike the type"))
    left = rrb.Vertical(rrb.Tabs(*scenes), rrb.Tabs(*dates), row_shares=[3, 2])
    return style.page_blueprint(
        left, rrb.Tabs(*texts, style.text("guide", "How to read this")), "date"
    )
