"""A plan in its cell, and its 3-D view: a bead per reading, and what moves at every step."""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from hilcal.cell import Cell
from hilcal.config import CellConfig, Obstacle
from hilcal.design.next import PairPower
from hilcal.design.summary import PlanSummary
from hilcal.design.timing import pace, timeline
from hilcal.errors import InputError
from hilcal.measuring.clearance import Clearance, LineOfSight, clearance_of, sight_of
from hilcal.measuring.route import route
from hilcal.present.plan import load_name
from hilcal.present.viewer import arm_shapes, style
from hilcal.robot import body
from hilcal.robot import chain as chains
from hilcal.robot.body import body_poses
from hilcal.store.plan import UNLOADED, Plan
from hilcal.types import Bools, Floats, Ints

SEEN, TURNED, HIDDEN, UNKNOWN = range(4)
"""Does the tracker see the target: yes; it is turned too far away; something is between; not
known, as the tracker's place is not."""
_WAY_STEP_RAD = 0.08  # distance of the drawn points of a motion, of the leading joint


@dataclass(frozen=True, eq=False)
class PlanView:
    """A plan in its cell: where everything is at each of its S steps, base axes, SI.

    Attributes:
        cell: the cell.
        config: its loads, obstacles, limits and sight.
        plan: poses and steps.
        summary: cost, predicted precision and efficiency.
        powers: of the suspects that the plan separates, pair by pair; else empty.

    Raises:
        InputError: the plan's poses do not have as many joints as the arm.
    """

    cell: Cell
    config: CellConfig
    plan: Plan
    summary: PlanSummary
    powers: tuple[PairPower, ...] = ()

    def __post_init__(self) -> None:
        """Refuse a plan of another arm."""
        joints, arm = self.plan.q.shape[1], self.cell.arm
        if joints != arm.n:
            raise InputError(
                f"the plan has {joints} joint angles per pose; {arm.name} has {arm.n} joints"
            )

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.plan.steps)

    @cached_property
    def shapes(self) -> Clearance:
        """Shapes of arm, tool, obstacles and loads, as collisions are checked."""
        return clearance_of(self.cell, self.config)

    @cached_property
    def _view(self) -> LineOfSight | None:
        return sight_of(self.shapes)

    @property
    def tracker(self) -> Floats | None:
        """(3,) where the tracker stands; None where that is not known."""
        return None if self._view is None else self._view.tracker

    @cached_property
    def loads(self) -> tuple[str, ...]:
        """Names of the loads, in the order in which they are hung."""
        return self.plan.loads

    @cached_property
    def load(self) -> Ints:
        """(S,) index into `loads`."""
        return np.array([self.loads.index(s.load) for s in self.plan.steps], dtype=np.int64)

    @cached_property
    def pose(self) -> Ints:
        """(S,) index of the step's pose."""
        row = {name: k for k, name in enumerate(self.plan.pose_names)}
        return np.array([row[s.pose] for s in self.plan.steps], dtype=np.int64)

    @property
    def q(self) -> Floats:
        """(S, n) joint angles, rad."""
        return self.plan.q[self.pose]

    @cached_property
    def bodies(self) -> Floats:
        """(S, n + 2, 4, 4) poses of base, bodies and flange."""
        return body_poses(self.cell.arm, self.q)

    @cached_property
    def target(self) -> Floats:
        """(S, 3) the target, or the flange where its place is not known."""
        return chains.evaluate(self.cell.arm, self.q).point(self.cell.target[:3, 3])

    @cached_property
    def hook(self) -> Floats:
        """(S, 3) the load point."""
        return chains.evaluate(self.cell.arm, self.q).point(self.cell.load_point)

    @cached_property
    def incidence(self) -> Floats | None:
        """(S,) angle between the target's normal and the beam; None where not given."""
        return None if self._view is None else self._view.incidence(self.q)

    @cached_property
    def sight(self) -> Ints:
        """(S,) `SEEN` and so on."""
        if self._view is None:
            return np.full(len(self), UNKNOWN)
        free = np.zeros(len(self), dtype=np.bool_)
        for k, name in enumerate(self.loads):
            free[self.load == k] = self._view.free(self.q[self.load == k], name)
        angle, most = self.incidence, self.config.sight.incidence_max_rad
        turned = np.zeros(len(self), dtype=np.bool_) if angle is None else angle > most
        return np.where(~free, HIDDEN, np.where(turned, TURNED, SEEN)).astype(np.int64)

    def why(self, step: int) -> str:
        """Return why the target is not seen at a step; empty where it is."""
        if self._view is None or self.sight[step] == SEEN:
            return ""
        q, load = self.q[step : step + 1], self.loads[self.load[step]]
        told = self._view.problems(q, load, "")
        if words := "; ".join(line.removeprefix(": ") for line in told):
            return words
        hidden = self._view.hidden(q, load)  # some of several targets
        return f"hidden: {', '.join(self.cell.target_names[k] for k in hidden)}"

    @cached_property
    def rank(self) -> Ints:
        """(S,) how many other loads are measured before in the same pose: its bead's place."""
        order: dict[int, list[int]] = {}
        pairs = list(zip(self.pose.tolist(), self.load.tolist(), strict=True))
        for p, k in dict.fromkeys(pairs):
            order.setdefault(p, []).append(k)
        return np.array([order[p].index(k) for p, k in pairs], dtype=np.int64)

    @cached_property
    def ways(self) -> tuple[Floats, ...]:
        """Of each step, (K, 3) the target's way there from the step before, straight in joints."""
        stops = route(self.plan, self.cell.arm, self.config.limits.joint_margin_rad)
        legs: list[list[Floats]] = [[]]
        for a, b in pairwise(stops):
            count = max(1, int(np.ceil(np.abs(b.q - a.q).max(initial=0.0) / _WAY_STEP_RAD)))
            share = np.linspace(0.0, 1.0, count + 1)[:, None]
            legs[-1].append(a.q + share * (b.q - a.q))
            if b.step is not None:
                legs.append([])
        joined = [np.vstack(leg) for leg in legs if leg]
        chain = chains.evaluate(self.cell.arm, np.vstack(joined))
        ends = np.cumsum([len(leg) for leg in joined])[:-1]
        return tuple(np.split(chain.point(self.cell.target[:3, 3]), ends))

    @cached_property
    def time(self) -> Floats:
        """(S,) middle of each reading since the start, s."""
        margin = self.config.limits.joint_margin_rad
        return timeline(self.plan, self.cell.arm, margin, pace(self.config))[1]

    @property
    def reach(self) -> float:
        """The arm's reach, m: sizes are drawn by it."""
        return max(self.cell.arm.reach, 0.1)

    @property
    def numbers(self) -> Ints:
        """(S,) numbers of the steps on the timeline, from 1."""
        return np.arange(1, len(self) + 1)

    @property
    def unseen(self) -> Bools:
        """(S,) steps whose target the tracker does not see."""
        return np.asarray((self.sight == TURNED) | (self.sight == HIDDEN))

    @property
    def beads(self) -> Ints:
        """Return the first step of every pose and load, one for each bead."""
        pairs = np.stack([self.pose, self.load], 1)
        return np.sort(np.unique(pairs, axis=0, return_index=True)[1]).astype(np.int64)

    @property
    def stints(self) -> tuple[tuple[int, int], ...]:
        """Return first step and end of every stretch under one load."""
        starts = [0, *(np.flatnonzero(np.diff(self.load)) + 1).tolist(), len(self)]
        return tuple(pairwise(starts))


Colors = NDArray[np.uint8]

# In the order of SEEN, TURNED, HIDDEN, UNKNOWN.
SIGHT_COLORS = np.array([style.NOISE, style.AMBER, style.RED, style.GREY], dtype=np.uint8)
SIGHT_WORDS = ("seen", "turned too far away", "hidden", "sight not checked")
# Labels stand on a plate in the theme's colour: these have a contrast of about 3 on both.
BARE: style.Color = (225, 226, 230)
"""Of what is unloaded."""
# After Okabe & Ito's set for colour-blind readers, without the green, amber and red of the sight.
_LOADS: tuple[style.Color, ...] = (
    (86, 180, 233),
    (240, 228, 66),
    (204, 121, 167),
    (70, 110, 235),
    (205, 150, 110),
    (120, 220, 215),
    (165, 120, 245),
)
_FADED = 0.62


def load_colors(names: tuple[str, ...]) -> Colors:
    """(L, 3) a colour of each load; beyond seven, the same again and darker."""
    out, k = [], 0
    for name in names:
        if name == UNLOADED:
            out.append(np.array(BARE, dtype=float))
            continue
        out.append(np.array(_LOADS[k % len(_LOADS)]) * _FADED ** (k // len(_LOADS)))
        k += 1
    return np.array(out).round().astype(np.uint8)


def sight_colors(sight: Ints) -> Colors:
    """(S, 3) colour of the beam of each step."""
    return np.asarray(SIGHT_COLORS[sight])


BEAD, BEAD_GAP = 0.0075, 0.016
"""Radius of a bead and distance of two in a stack, shares of the reach."""
_OBSTACLE = (122, 112, 104)
_SOLID = 90  # of 255: what stands behind an obstacle shows through
_BOX = (64, 82, 108)
_TRACKER = (235, 235, 240)
_HEAD = 0.07  # m, of the drawn tracker


def static_scene(rec: rr.RecordingStream, d: PlanView) -> None:
    """Log what never changes: shapes of the arm, what stands around, and a bead per reading."""
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    own = len(body.capsules(d.cell.arm))
    arm_shapes.log_bodies(rec, d.shapes.scene.parts[:own], d.shapes.scene.parts[own:])
    _obstacles(rec, d.config.obstacles)
    _workspace(rec, d)
    _beads(rec, d)
    if d.tracker is not None:
        _tracker(rec, d.tracker)


def bead_places(d: PlanView, steps: Ints) -> Floats:
    """(K, 3) where the beads of some steps are: stacked upwards from the target, m."""
    up = np.zeros((len(steps), 3))
    up[:, 2] = d.rank[steps] * BEAD_GAP * d.reach
    return np.asarray(d.target[steps] + up)


def _obstacles(rec: rr.RecordingStream, things: tuple[Obstacle, ...]) -> None:
    boxes = [x for x in things if x.center_m is not None]
    if boxes:
        for part, mode, alpha in (("body", "solid", _SOLID), ("edge", "majorwireframe", 255)):
            rec.log(
                f"world/obstacles/box/{part}",
                rr.Boxes3D(
                    centers=[x.center_m or () for x in boxes],
                    sizes=[x.size_m or () for x in boxes],
                    colors=[(*_OBSTACLE, alpha)],
                    fill_mode=mode,  # type: ignore[arg-type]
                ),
                static=True,
            )
    stood = [x for x in things if x.bottom_m is not None]
    if stood:
        bottom = np.array([x.bottom_m for x in stood])
        height = np.array([x.height_m for x in stood], dtype=float)
        rec.log(
            "world/obstacles/cylinder",
            rr.Cylinders3D(
                centers=bottom + 0.5 * height[:, None] * [0.0, 0.0, 1.0],
                lengths=height,
                radii=[x.radius_m or 0.0 for x in stood],
                colors=[(*_OBSTACLE, _SOLID)],
                fill_mode="solid",
            ),
            static=True,
        )
    if things:
        rec.log(
            "world/obstacles/names",
            arm_shapes.labels([_named_at(x) for x in things], [x.name for x in things]),
            static=True,
        )


def _named_at(thing: Obstacle) -> Floats:
    """(3,) where an obstacle's name is written: on its top, or on a flat one's front edge."""
    if thing.center_m is not None and thing.size_m is not None:
        center, half = np.array(thing.center_m), 0.5 * np.array(thing.size_m)
        flat = half[2] < 0.5 * min(half[:2])
        return np.asarray(center + half * ([0.7, -0.7, 1.0] if flat else [0.0, 0.0, 1.0]))
    up = np.array([0.0, 0.0, thing.height_m or 0.0])
    return np.asarray(np.array(thing.bottom_m) + up)


def _workspace(rec: rr.RecordingStream, d: PlanView) -> None:
    """Log the outline of every side of the workspace that is given."""
    limits = d.config.limits
    reach = 1.1 * d.reach
    low = np.array(limits.workspace_min_m or (-reach, -reach, 0.0), dtype=float)
    high = np.array(limits.workspace_max_m or (reach, reach, reach), dtype=float)
    low, high = np.minimum(low, high), np.maximum(low, high)
    sides = []
    for given, at in ((limits.workspace_min_m, low), (limits.workspace_max_m, high)):
        for axis in range(3) if given is not None else ():
            a, b = (axis + 1) % 3, (axis + 2) % 3
            corners = np.tile(at, (5, 1))
            corners[:, a] = [low[a], high[a], high[a], low[a], low[a]]
            corners[:, b] = [low[b], low[b], high[b], high[b], low[b]]
            sides.append(corners)
    if sides:
        rec.log(
            "world/workspace",
            rr.LineStrips3D(sides, colors=[_BOX], radii=rr.Radius.ui_points(0.6)),
            static=True,
        )


def _beads(rec: rr.RecordingStream, d: PlanView) -> None:
    """Log a bead per pose and load, and a cage around those that the tracker does not see."""
    steps = d.beads
    rec.log(
        "world/target/beads",
        rr.Points3D(
            bead_places(d, steps),
            colors=load_colors(d.loads)[d.load[steps]],
            radii=BEAD * d.reach,
        ),
        static=True,
    )
    lost = steps[d.unseen[steps]]
    if len(lost):
        rec.log(
            "world/target/unseen",
            rr.Ellipsoids3D(
                centers=bead_places(d, lost),
                half_sizes=np.full((len(lost), 3), 1.9 * BEAD * d.reach),
                colors=sight_colors(d.sight[lost]),
                fill_mode="majorwireframe",
                line_radii=rr.Radius.ui_points(0.5),
            ),
            static=True,
        )


def _tracker(rec: rr.RecordingStream, place: Floats) -> None:
    up = np.array([0.0, 0.0, 1.0])
    rec.log(
        "world/tracker",
        arm_shapes.capsules(
            (place - 1.2 * _HEAD * up)[None],
            (place + 0.2 * _HEAD * up)[None],
            np.array([_HEAD]),
            [_TRACKER],
        ),
        static=True,
    )
    rec.log(
        "world/tracker/name",
        arm_shapes.labels([place + 2.2 * _HEAD * up], ["tracker"]),
        static=True,
    )


_FORCE_LENGTH = 0.35  # the strongest pull is drawn this long, m
_LABEL_ABOVE = 0.24  # m
_DIM = 0.42  # of a colour: lines have no transparency
_PARTS = ("capsules", "arrow")


def step_scene(rec: rr.RecordingStream, d: PlanView) -> None:
    """Send what changes with every step, as columns on `step`."""
    time = [rr.TimeColumn("step", sequence=d.numbers)]
    arm_shapes.send_stands(rec, time[0], d.bodies[:, :-1])
    colors = load_colors(d.loads)[d.load]
    rec.send_columns(
        "world/target/now",
        indexes=time,
        columns=rr.Points3D.columns(
            positions=d.target, colors=colors, radii=np.full(len(d), 1.7 * BEAD * d.reach)
        ),
    )
    _label(rec, d, time)
    if d.tracker is not None:
        _beam(rec, d, time, d.tracker)
    _loads(rec, d)
    _ways(rec, d, time)


def framed(d: PlanView) -> tuple[Floats, float]:
    """Middle of what should be in the picture and its half size, m; a far tracker counts less."""
    reach = d.reach
    points = [np.zeros((1, 3)), d.target]
    if d.tracker is not None:
        far = float(np.linalg.norm(d.tracker))
        points.append((d.tracker * min(1.0, 1.6 * reach / max(far, 1e-9)))[None])
    lo, hi = np.vstack(points).min(0), np.vstack(points).max(0)
    return (lo + hi) / 2, max(float(np.linalg.norm(hi - lo)) / 2, 0.35 * reach)


def pull_arrow(d: PlanView, name: str) -> Floats | None:
    """(3,) the arrow of a load's pull as drawn, m; None where it has none."""
    forces = {x.name: np.array(x.force_N) for x in d.config.loads}
    most = max((float(np.linalg.norm(f)) for f in forces.values()), default=0.0)
    force = forces.get(name)
    if force is None or not force.any():
        return None
    return np.asarray(_FORCE_LENGTH * force / most)


def _beam(rec: rr.RecordingStream, d: PlanView, time: list[rr.TimeColumn], place: Floats) -> None:
    strips = np.stack([np.broadcast_to(place, d.target.shape), d.target], 1)
    colors = sight_colors(d.sight)
    rec.send_columns(
        "world/beam",
        indexes=time,
        columns=rr.LineStrips3D.columns(
            strips=strips, colors=colors, radii=np.full(len(d), 0.004 * d.reach)
        ),
    )


def _label(rec: rr.RecordingStream, d: PlanView, time: list[rr.TimeColumn]) -> None:
    above = d.target + np.array([0.0, 0.0, _LABEL_ABOVE])
    above[:, 2] += d.rank.max(initial=0) * BEAD_GAP * d.reach
    words = [
        f"{k}: {s.pose}, {load_name(s.load)}{_sight_words(d, k - 1)}"
        for k, s in enumerate(d.plan.steps, start=1)
    ]
    rec.send_columns(
        "world/label",
        indexes=time,
        columns=arm_shapes.label_columns(above + np.array([0.0, 0.0, 0.25 * _LABEL_ABOVE]), words),
    )
    rec.send_columns(
        "world/label/leader",
        indexes=time,
        columns=rr.LineStrips3D.columns(
            strips=np.stack([d.target, above], 1),
            colors=sight_colors(d.sight),
            radii=np.full(len(d), 0.0012 * d.reach),
        ),
    )


def _sight_words(d: PlanView, step: int) -> str:
    sight = int(d.sight[step])
    return f": {SIGHT_WORDS[sight]}" if d.unseen[step] or sight == SEEN else ""


def _loads(rec: rr.RecordingStream, d: PlanView) -> None:
    """Log what hangs or pulls, at the steps where there is some; cleared where there is none."""
    colors = load_colors(d.loads)
    for k, name in enumerate(d.loads):
        steps = np.flatnonzero(d.load == k)
        hung = d.shapes.segments(d.plan.q[d.pose[steps]], name)
        arrow = pull_arrow(d, name)
        for i, step in enumerate(steps.tolist()):
            rec.set_time("step", sequence=step + 1)
            if hung:
                start = np.array([x.start[i] for x in hung])
                end = np.array([x.end[i] for x in hung])
                radius = np.array([x.radius for x in hung])
                rec.log(
                    f"world/load/{_PARTS[0]}", arm_shapes.capsules(start, end, radius, [colors[k]])
                )
            if arrow is not None:
                rec.log(
                    f"world/load/{_PARTS[1]}",
                    rr.Arrows3D(
                        origins=[d.hook[step]],
                        vectors=[arrow],
                        colors=[colors[k]],
                        radii=[0.006 * d.reach],
                    ),
                )
            for part, there in zip(_PARTS, (bool(hung), arrow is not None), strict=True):
                if not there:
                    rec.log(f"world/load/{part}", rr.Clear(recursive=False))
    rec.reset_time()


def _ways(rec: rr.RecordingStream, d: PlanView, time: list[rr.TimeColumn]) -> None:
    """Log the target's whole way under the load of the step, and bright the last motion."""
    colors = load_colors(d.loads)
    rec.send_columns(
        "world/way/last",
        indexes=time,
        columns=rr.LineStrips3D.columns(
            strips=list(d.ways),
            colors=colors[d.load],
            radii=np.full(len(d), 0.0022 * d.reach),
        ),
    )
    for start, end in d.stints:
        rec.set_time("step", sequence=start + 1)
        rec.log(
            "world/way/whole",
            rr.LineStrips3D(
                [np.vstack(d.ways[start:end])],
                colors=[(_DIM * colors[d.load[start]]).astype(np.uint8)],
                radii=rr.Radius.ui_points(0.6),
            ),
        )
    rec.reset_time()
