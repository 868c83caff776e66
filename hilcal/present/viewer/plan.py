"""A plan in rerun: the cell at each step, and a description of the plan."""

from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilcal import numbers
from hilcal.cell import Cell
from hilcal.config import Obstacle
from hilcal.design.next import PairPower
from hilcal.design.run_order import pace, timeline
from hilcal.design.summary import PlanSummary
from hilcal.errors import InputError
from hilcal.measuring.clearance import TRACKER_UNKNOWN as NO_TRACKER
from hilcal.measuring.clearance import Clearance
from hilcal.measuring.route import route
from hilcal.present import plan as plan_blocks
from hilcal.present.document import Block, Words, heading, load_name, pairs, table
from hilcal.present.progress import duration_text
from hilcal.present.viewer import recording, style
from hilcal.robot import chain as chains
from hilcal.robot.scene import body_poses, capsules
from hilcal.store.plan import UNLOADED, Plan
from hilcal.types import Floats, Ints

SEEN, TURNED, HIDDEN, UNKNOWN = range(4)  # sight of the target; unknown without a tracker's place
SIGHT_COLORS = np.array([style.NOISE, style.AMBER, style.RED, style.GREY], dtype=np.uint8)
SIGHT_WORDS = ("seen", "turned too far away", "hidden", "sight not checked")
NOT_FIRST = ("", "takes about")  # rows of the cost of a plan that belong to the details
STEPS = "Plan step by step: a bead per pose and load, beam green = seen"
TRACKER = "From the tracker"
SCHEDULE = "Schedule: minute of each reading by step, colour by load"
BEAD, BEAD_GAP = 0.0075, 0.016  # radius of a bead, distance of two in a stack, shares of the reach
# Colours with a contrast of about 3 to the labels' background in both themes.
_UNLOADED: style.Color = (225, 226, 230)
# After Okabe & Ito's palette for colour-blind readers, without the colours of the sight.
_LOADS = (
    *((86, 180, 233), (240, 228, 66), (204, 121, 167), (70, 110, 235)),
    *((205, 150, 110), (120, 220, 215), (165, 120, 245)),
)
_FADED = 0.62
_OBSTACLE, _BOX, _TRACKER = (122, 112, 104), (64, 82, 108), (235, 235, 240)
_SOLID = 90  # opacity of an obstacle, of 255
_HEAD = 0.07  # m, size of the drawn tracker
_FORCE_LENGTH = 0.35  # drawn length of the strongest pull, m
_LABEL_ABOVE = 0.24  # m
_DIM = 0.42  # factor on the colour of faint lines, since lines have no transparency
_UP = np.array([0.0, 0.0, 1.0])
_WAY_STEP_RAD = 0.08  # step of the leading joint between drawn points of a motion
_DOT, _FPS = 3.5, 2.0
_LOOKED_AT = 20  # steps whose arm the eye should see
GUIDE = """### How to read this
**Plan step by step** (3-D): the arm stands in the pose of the step, as the capsules that are kept
clear of everything. *Step* (bottom left) goes through the readings in the order in which they are
taken; the bright line is the target's last motion, the faint one its whole way under this load.

**Beads** stand where the target is read: the lowest of a stack is the target itself, each further
one is the same place under another load. Their colours are those of the schedule below.

**The beam** is green where the tracker sees the target, amber where the reflector is turned too
far away, red where something is between; such readings have a cage about their bead and a cross
in the schedule. *From the tracker*: what the tracker sees, from where it stands.

**What hangs** below the load point is drawn with the room that is kept for it, a pull as an arrow.
Thin blue lines bound the workspace.

**Schedule**: one dot per reading, its minute over its step, in the colour of its load; jumps are
load changes by hand.
"""


class PlanView:
    """A plan in its cell: positions of everything at each of the S steps, base axes, SI.

    `powers` are those of the pairs of suspects that the plan separates. Raises InputError if the
    plan's poses do not have as many joints as the arm.
    """

    def __init__(
        self,
        cell: Cell,
        plan: Plan,
        summary: PlanSummary,
        powers: tuple[PairPower, ...] = (),
    ) -> None:
        config = cell.configured()
        arm, loads, steps = cell.arm, plan.loads, plan.steps
        if (has := plan.q.shape[1]) != arm.n:
            why = f"{has} joint angles per pose; {arm.name} has {arm.n} joints"
            raise InputError(f"the plan has {why}")
        self.cell, self.config, self.plan = cell, config, plan
        self.summary, self.powers = summary, powers
        self.reach = max(arm.reach, 0.1)  # m, scale of drawn sizes
        self.shapes = Clearance(cell)  # the shapes of the collision check
        self.view = self.shapes.sight
        # (3,) position of the tracker; None: unknown
        self.tracker = None if self.view is None else self.view.tracker
        # (S,) indices of load and pose, joint angles (S, n), rad, and number of the step from 1
        self.load: Ints = np.array([loads.index(s.load) for s in steps], dtype=np.int64)
        row = {name: k for k, name in enumerate(plan.pose_names)}
        self.pose: Ints = np.array([row[s.pose] for s in steps], dtype=np.int64)
        self.q = plan.q[self.pose]
        self.steps = rr.TimeColumn("step", sequence=np.arange(1, len(self) + 1))
        # (S, n + 2, 4, 4) base, bodies and flange; (S, 3) target, or flange if it is unknown
        self.bodies = body_poses(arm, self.q)
        self.target = chains.evaluate(arm, self.q).point(cell.target[:3, 3])
        # (S,) angle between the target's normal and the beam; None: unknown
        self.incidence = None if self.view is None else self.view.incidence(self.q)
        self.sight = self._sight()
        self.unseen = np.isin(self.sight, (TURNED, HIDDEN))  # (S,)
        # (S,) number of loads measured before in the same pose: the bead's place in the stack
        order: dict[int, list[int]] = {}
        pairs = list(zip(self.pose.tolist(), self.load.tolist(), strict=True))
        for p, k in dict.fromkeys(pairs):
            order.setdefault(p, []).append(k)
        self.rank: Ints = np.array([order[p].index(k) for p, k in pairs], dtype=np.int64)
        # (S,) time of the middle of each reading, s
        self.time = timeline(plan, arm, config.limits.joint_margin_rad, pace(config))[1]
        # (L, 3) a colour of each load; after seven they repeat, darker
        hung = [name for name in loads if name != UNLOADED]
        rgb = {n: np.array(_LOADS[k % 7]) * _FADED ** (k // 7) for k, n in enumerate(hung)}
        self.colors = np.array([rgb.get(n, _UNLOADED) for n in loads]).round().astype(np.uint8)

    def __len__(self) -> int:
        return len(self.plan.steps)

    def _sight(self) -> Ints:
        if self.view is None:
            return np.full(len(self), UNKNOWN)
        free = np.zeros(len(self), dtype=np.bool_)
        for k, name in enumerate(self.plan.loads):
            free[self.load == k] = self.view.unobstructed(self.q[self.load == k], name)
        angle, most = self.incidence, self.config.sight.incidence_max_rad
        turned = np.zeros(len(self), dtype=np.bool_) if angle is None else angle > most
        return np.where(~free, HIDDEN, np.where(turned, TURNED, SEEN)).astype(np.int64)

    def sight_problem(self, step: int) -> str:
        """Return why the tracker does not see the target at a step; empty if it does."""
        if self.view is None or self.sight[step] == SEEN:
            return ""
        q, load = self.q[step : step + 1], self.plan.loads[self.load[step]]
        problems = self.view.problems(q, load, "")
        if reasons := "; ".join(line.removeprefix(": ") for line in problems):
            return reasons
        hidden = self.view.hidden_targets(q, load)  # some of several targets
        return f"hidden: {', '.join(self.cell.target_names[k] for k in hidden)}"

    @cached_property
    def paths(self) -> tuple[Floats, ...]:
        """Path (K, 3) of the target from the previous step to each step, linear in joint space."""
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


def _static_scene(rec: rr.RecordingStream, d: PlanView) -> None:
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    of_arm, parts = len(capsules(d.cell.arm)), d.shapes.scene.parts
    dark = [*parts[of_arm:], *style.rails(d.cell.arm)]
    style.log_shapes(rec, style.shapes(parts[:of_arm], dark))
    _obstacles(rec, d.config.obstacles)
    _workspace(rec, d)
    _beads(rec, d)
    if d.tracker is not None:
        low, high = ((d.tracker + k * _HEAD * _UP)[None] for k in (-1.2, 0.2))
        rec.log(
            "world/tracker",
            style.drawn_capsules(low, high, np.array([_HEAD]), [_TRACKER]),
            static=True,
        )
        above = d.tracker + 2.2 * _HEAD * _UP
        rec.log("world/tracker/name", style.labels([above], ["tracker"]), static=True)


def _obstacles(rec: rr.RecordingStream, things: tuple[Obstacle, ...]) -> None:
    if boxes := [x for x in things if x.center_m is not None]:
        centers, sizes = [x.center_m or () for x in boxes], [x.size_m or () for x in boxes]
        for part, mode, alpha in (("body", "solid", _SOLID), ("edge", "majorwireframe", 255)):
            look: dict[str, Any] = {"colors": [(*_OBSTACLE, alpha)], "fill_mode": mode}
            drawn = rr.Boxes3D(centers=centers, sizes=sizes, **look)
            rec.log(f"world/obstacles/box/{part}", drawn, static=True)
    if stood := [x for x in things if x.bottom_m is not None]:
        height = np.array([x.height_m for x in stood], dtype=float)
        cylinders = rr.Cylinders3D(
            centers=np.array([x.bottom_m for x in stood]) + 0.5 * height[:, None] * _UP,
            lengths=height,
            radii=[x.radius_m or 0.0 for x in stood],
            colors=[(*_OBSTACLE, _SOLID)],
            fill_mode="solid",
        )
        rec.log("world/obstacles/cylinder", cylinders, static=True)
    if things:
        names = style.labels([_named_at(x) for x in things], [x.name for x in things])
        rec.log("world/obstacles/names", names, static=True)


def _named_at(thing: Obstacle) -> Floats:
    """Return the position (3,) of an obstacle's name: its top, or the front edge of a flat one."""
    if thing.center_m is not None and thing.size_m is not None:
        center, half = np.array(thing.center_m), 0.5 * np.array(thing.size_m)
        flat = half[2] < 0.5 * min(half[:2])
        return np.asarray(center + half * ([0.7, -0.7, 1.0] if flat else _UP))
    return np.asarray(np.array(thing.bottom_m) + (thing.height_m or 0.0) * _UP)


def _workspace(rec: rr.RecordingStream, d: PlanView) -> None:
    """Log the outlines of the sides of the workspace, for stated limits only."""
    limits, reach = d.config.limits, 1.1 * d.reach
    least = limits.workspace_min_m or (-reach, -reach, 0.0)
    ends = np.array([least, limits.workspace_max_m or (reach, reach, reach)], dtype=float)
    low, high = ends.min(0), ends.max(0)
    sides = []
    for stated, corner in ((limits.workspace_min_m, low), (limits.workspace_max_m, high)):
        for axis in range(3) if stated is not None else ():
            a, b = (axis + 1) % 3, (axis + 2) % 3
            corners = np.tile(corner, (5, 1))
            corners[:, a] = [low[a], high[a], high[a], low[a], low[a]]
            corners[:, b] = [low[b], low[b], high[b], high[b], low[b]]
            sides.append(corners)
    if sides:
        lines = rr.LineStrips3D(sides, colors=[_BOX], radii=rr.Radius.ui_points(0.6))
        rec.log("world/workspace", lines, static=True)


def _beads(rec: rr.RecordingStream, d: PlanView) -> None:
    """Log a bead per pose and load, and a cage around each that the tracker does not see."""
    pairs = np.stack([d.pose, d.load], 1)
    steps = np.sort(np.unique(pairs, axis=0, return_index=True)[1])
    center = d.target[steps] + d.rank[steps, None] * BEAD_GAP * d.reach * _UP
    beads = rr.Points3D(center, colors=d.colors[d.load[steps]], radii=BEAD * d.reach)
    rec.log("world/target/beads", beads, static=True)
    lost = d.unseen[steps]
    if lost.any():
        cages = rr.Ellipsoids3D(
            centers=center[lost],
            half_sizes=np.full_like(center[lost], 1.9 * BEAD * d.reach),
            colors=SIGHT_COLORS[d.sight[steps[lost]]],
            fill_mode="majorwireframe",
            line_radii=rr.Radius.ui_points(0.5),
        )
        rec.log("world/target/unseen", cages, static=True)


def _step_scene(rec: rr.RecordingStream, d: PlanView) -> None:
    """Send the entities that change with every step, as columns on `step`."""
    style.send_poses(rec, d.steps, d.bodies[:, :-1])
    colors, beams = d.colors[d.load], SIGHT_COLORS[d.sight]

    def lines(path: str, strips: Any, colors: Any, radius: float) -> None:
        radii = np.full(len(d), radius * d.reach)
        drawn = rr.LineStrips3D.columns(strips=strips, colors=colors, radii=radii)
        rec.send_columns(path, [d.steps], drawn)

    radii = np.full(len(d), 1.7 * BEAD * d.reach)
    points = rr.Points3D.columns(positions=d.target, colors=colors, radii=radii)
    rec.send_columns("world/target/now", [d.steps], points)
    above = d.target + (_LABEL_ABOVE + d.rank.max(initial=0) * BEAD_GAP * d.reach) * _UP
    texts = [
        f"{k + 1}: {s.pose}, {load_name(s.load)}"
        + f": {SIGHT_WORDS[d.sight[k]]}" * bool(d.sight[k] != UNKNOWN)
        for k, s in enumerate(d.plan.steps)
    ]
    labels = style.label_columns(above + 0.25 * _LABEL_ABOVE * _UP, texts)
    rec.send_columns("world/label", [d.steps], labels)
    lines("world/label/leader", np.stack([d.target, above], 1), beams, 0.0012)
    if d.tracker is not None:
        start = np.broadcast_to(d.tracker, d.target.shape)
        lines("world/beam", np.stack([start, d.target], 1), beams, 0.004)
    lines("world/way/last", list(d.paths), colors, 0.0022)
    _loads(rec, d)
    # the target's complete path under the load of the step
    starts = [0, *(np.flatnonzero(np.diff(d.load)) + 1).tolist(), len(d)]
    for begin, end in pairwise(starts):
        rec.set_time("step", sequence=begin + 1)
        way, color = [np.vstack(d.paths[begin:end])], (_DIM * d.colors[d.load[begin]])
        thin = rr.Radius.ui_points(0.6)
        drawn = rr.LineStrips3D(way, colors=[color.astype(np.uint8)], radii=thin)
        rec.log("world/way/whole", drawn)
    rec.reset_time()


def _loads(rec: rr.RecordingStream, d: PlanView) -> None:
    """Log the hanging bodies or the pull of each step; without one the entity is cleared."""
    forces = {x.name: np.array(x.force_N) for x in d.config.loads}
    most = max((float(np.linalg.norm(f)) for f in forces.values()), default=0.0)
    hook = chains.evaluate(d.cell.arm, d.q).point(d.cell.load_point)
    for k, (name, color) in enumerate(zip(d.plan.loads, d.colors, strict=True)):
        steps = np.flatnonzero(d.load == k)
        hung = d.shapes.segments(d.q[steps], name)
        force = forces.get(name, np.zeros(3))
        for i, step in enumerate(steps.tolist()):
            rec.set_time("step", sequence=step + 1)
            load: rr.AsComponents = rr.Clear(recursive=False)
            pull: rr.AsComponents = rr.Clear(recursive=False)
            if hung:
                start, end = (np.array([getattr(x, k)[i] for x in hung]) for k in ("start", "end"))
                load = style.drawn_capsules(start, end, np.array([x.radius for x in hung]), [color])
            if force.any():
                look: dict[str, Any] = {"colors": [color], "radii": [0.006 * d.reach]}
                way = [_FORCE_LENGTH * force / most]
                pull = rr.Arrows3D(origins=[hook[step]], vectors=way, **look)
            rec.log("world/load/capsules", load)
            rec.log("world/load/arrow", pull)
    rec.reset_time()


def record_plan(
    cell: Cell,
    plan: Plan,
    summary: PlanSummary,
    path: Path,
    powers: tuple[PairPower, ...] = (),
) -> None:
    """Write a plan as a recording file, atomically; an existing file is replaced.

    The timeline `step` counts the readings in their order from 1: the arm in its pose, the hanging
    load, and the beam of the tracker, coloured by the sight of the target. Equal plans give equal
    recordings. `powers` of the pairs of suspects that the plan separates are shown first. Raises as
    `PlanView` and `recording.write`.
    """
    d = PlanView(cell, plan, summary, powers)
    rec = recording.content_stream(d.config.to_json(), d.plan.to_json(), d.summary, d.powers)
    recording.write(rec, blueprint(d), lambda: _log(rec, d), Path(path))


def _log(rec: rr.RecordingStream, d: PlanView) -> None:
    rec.send_recording_name(f"hilcal plan: {style.storable(d.cell.arm.name)}, {len(d)} readings")
    _static_scene(rec, d)
    _, _, *tables = plan_blocks.plan_report(d.summary)
    times = pairs(row for row in plan_blocks.cost_rows(d.summary) if row[0] in NOT_FIRST)
    details = style.markdown([times, *tables])
    for name, text in (("plan", overview(d)), ("guide", GUIDE), ("details", details)):
        rec.log(f"words/{name}", style.document(text), static=True)
    recording.flush(rec)
    _step_scene(rec, d)
    _schedule(rec, d)
    rec.send_columns(
        "words/step", [d.steps], style.documents([step_card(d, k) for k in range(len(d))])
    )
    recording.flush(rec)


def overview(d: PlanView) -> str:
    """Return purpose, cost and efficiency of a plan; short, to fit a small window."""
    s, tracker = d.summary, NO_TRACKER
    title = f"Plan: {s.poses} poses, {s.readings} readings, {duration_text(s.duration.total)}"
    if d.tracker is not None:
        lost, tracker = int(d.unseen.sum()), f"✓ sees the target in all {len(d)} readings"
        if lost:
            tracker = f"✗ does not see the target in {lost} of {len(d)} readings"
    rows = [row for row in plan_blocks.cost_rows(s) if row[0] not in NOT_FIRST]
    task: list[Block] = []
    if d.powers:
        names = list(dict.fromkeys(t.effect for t in d.powers))
        question = heading(f"Which is it: {numbers.names(names, 'or')}?")
        task = [question, plan_blocks.power_table(d.powers)]
    return style.markdown([*task, heading(title), pairs([*rows, ("tracker", tracker)])])


def step_card(d: PlanView, k: int) -> str:
    """Return the description of step k (from 0)."""
    step = d.plan.steps[k]
    head = heading(f"Step {k + 1} of {len(d)}: {step.pose}, {load_name(step.load, 'under ')}")
    when = f"Minute {d.time[k] / 60.0:.0f} of {d.time[-1] / 60.0:.0f}."
    changes = bool(k) and d.load[k] != d.load[k - 1]
    change = "everything is taken off" if step.load == UNLOADED else f"{step.load} is hung"
    by_hand = [Words(f"Before it: {change}, by hand.", "strong")] if changes else []
    angles = np.rad2deg(d.plan.joints(step.pose))
    rows = [(n, f"{a:.1f}") for n, a in zip(d.cell.arm.joint_names, angles, strict=True)]
    x, y, z = d.target[k]
    name = "Target" if d.cell.target_known else "Flange (the target's place is not known)"
    place = f"{name} at {x:.3f}, {y:.3f}, {z:.3f} m, base axes."
    sight = Words(numbers.sentence(NO_TRACKER))
    if d.tracker is not None:
        way = f"at {float(np.linalg.norm(d.tracker - d.target[k])):.2f} m"
        if d.incidence is not None:
            way += f", {np.rad2deg(d.incidence[k]):.0f}° off the reflector's normal"
        sight = Words(f"✓ The tracker sees the target {way}.")
        if d.sight[k] != SEEN:
            sight = Words(
                f"✗ The tracker does not see the target {way}: {d.sight_problem(k)}.", "strong"
            )
    return style.markdown([head, when, *by_hand, sight, table("joint", "deg", rows=rows), place])


def _schedule(rec: rr.RecordingStream, d: PlanView) -> None:
    """Send the minute of each reading along `step`, a series per load; load changes are jumps."""
    series = [
        (f"load{k}", load_name(name), d.load == k, tuple(d.colors[k]), "circle", _DOT)
        for k, name in enumerate(d.plan.loads)
    ]
    if d.unseen.any():
        name = "not seen by the tracker"
        series.append(("unseen", name, d.unseen, style.RED, "cross", 2 * _DOT))
    for entity, name, members, color, marker, size in series:
        named = f"{style.storable(name)}: {int(members.sum())}"
        look: dict[str, Any] = {"colors": [color], "markers": [marker], "marker_sizes": [size]}
        rec.log(f"schedule/{entity}", rr.SeriesPoints(names=[named], **look), static=True)
        time = rr.TimeColumn("step", sequence=np.flatnonzero(members) + 1)
        rec.send_columns(
            f"schedule/{entity}", [time], rr.Scalars.columns(scalars=d.time[members] / 60.0)
        )


def blueprint(d: PlanView) -> rrb.Blueprint:
    """Return the blueprint: left 3-D over the schedule, right the overview over the details."""
    points, turn = [d.target], float(np.deg2rad(-52.0))
    if d.tracker is not None:  # a distant tracker is drawn nearer
        far = float(np.linalg.norm(d.tracker))
        points.append((d.tracker * min(1.0, 1.6 * d.reach / max(far, 1e-9)))[None])
    middle, size = style.center(np.vstack(points), 0.35 * d.reach)
    if d.tracker is not None:  # look across the beam
        beam = d.tracker - middle
        turn = float(np.arctan2(beam[1], beam[0]) - np.deg2rad(62.0))
    # and from a side where no obstacle hides the arm
    some = np.unique(np.linspace(0, len(d) - 1, _LOOKED_AT).round().astype(np.int64))
    arm = np.vstack([d.bodies[some, 1:, :3, 3].reshape(-1, 3), d.target[some]])
    eye = style.view_direction(turn, middle, size, arm, d.config.obstacles)
    scenes = [style.view3d("world", STEPS, middle + size * eye, middle)]
    if d.tracker is not None:
        hidden = [f"- $origin/{x}/**" for x in ("tracker", "beam", "workspace", "way")]
        mean = d.target.mean(axis=0)
        name = f"{TRACKER}, {numbers.length(float(np.linalg.norm(d.tracker - mean)))} away"
        scenes.append(style.view3d("world", name, d.tracker, mean, ["+ $origin/**", *hidden]))
    legend = rrb.PlotLegend(rrb.Corner2D.RightBottom)
    times = rrb.TimeSeriesView(origin="schedule", name=SCHEDULE, plot_legend=legend)
    texts = (("plan", "Plan"), ("step", "This step"), ("guide", "How to read this"))
    left = rrb.Vertical(rrb.Tabs(*scenes), times, row_shares=[7, 2])
    tabs = rrb.Tabs(*(style.text(*t) for t in texts))
    right = rrb.Vertical(tabs, style.text("details", "Details"), row_shares=[5, 4])
    return style.page_blueprint(left, right, "step", fps=_FPS)
