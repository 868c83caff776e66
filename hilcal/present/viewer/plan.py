"""A plan in rerun: its recording, which shows it before anything is measured, also in words."""

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilcal import numbers
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.next import PairPower
from hilcal.design.summary import PlanSummary
from hilcal.measuring.clearance import TRACKER_UNKNOWN as NO_TRACKER
from hilcal.present import plan as plan_blocks
from hilcal.present.document import Block, Words, heading, pairs, table
from hilcal.present.plan import load_name
from hilcal.present.running import spoken
from hilcal.present.viewer import layout, plan_scene, recording, style
from hilcal.present.viewer.plan_scene import SEEN, PlanView
from hilcal.present.viewer.recording import along, fixed
from hilcal.store.plan import UNLOADED, Plan
from hilcal.types import Floats


def record_plan(
    cell: Cell,
    config: CellConfig,
    plan: Plan,
    summary: PlanSummary,
    path: Path,
    powers: tuple[PairPower, ...] = (),
) -> None:
    """Write a plan as a recording file, whole or not at all; an existing file is replaced.

    The timeline `step` goes through the readings in order, from 1: the arm in its pose, what
    hangs, and the beam of the tracker, coloured by whether it sees the target. Equal plans give
    equal recordings.

    Args:
        cell: the cell.
        config: its loads, obstacles, limits and sight.
        plan: poses and steps.
        summary: cost, predicted precision and efficiency.
        path: of the recording, ".rrd".
        powers: of the suspects that the plan separates; these are shown first.

    Raises:
        InputError: the folder is missing, or the plan's poses do not fit the arm.
        HilcalError: the file cannot be written.
    """
    path = Path(path)
    recording.require_folder(path)
    d = PlanView(cell, config, plan, summary, powers)
    rec = recording.opened(d.config.to_json(), d.plan.to_json(), d.summary, d.powers)
    recording.write(rec, blueprint(d), lambda: _log(rec, d), path)


def _log(rec: rr.RecordingStream, d: PlanView) -> None:
    rec.send_recording_name(f"hilcal plan: {style.safe(d.cell.arm.name)}, {len(d)} readings")
    plan_scene.static_scene(rec, d)
    details = style.markdown(plan_blocks.plan_report(d.summary))
    for name, text in (("plan", overview(d)), ("guide", GUIDE), ("details", details)):
        fixed(rec, f"words/{name}", style.document(text))
    recording.flush(rec)
    plan_scene.step_scene(rec, d)
    schedule(rec, d)
    along(rec, "words/step", d.steps, style.documents([step_card(d, k) for k in range(len(d))]))
    recording.flush(rec)


def overview(d: PlanView) -> str:
    """Return what a plan is for, its cost and efficiency; short, since a small window cuts it."""
    s = d.summary
    told = f"Plan: {s.poses} poses, {s.readings} readings, {spoken(s.duration.total)}"
    rows = [row for row in plan_blocks.cost_rows(s) if row[0] not in ("", "takes about")]
    asked: list[Block] = []
    if d.powers:
        names = list(dict.fromkeys(t.effect for t in d.powers))
        question = heading(f"Which is it: {numbers.names(names, 'or')}?")
        asked = [question, plan_blocks.power_table(d.powers)]
    return style.markdown([*asked, heading(told), pairs([*rows, ("tracker", sight(d))])])


def sight(d: PlanView) -> str:
    """Return how many of the readings the tracker sees."""
    if d.tracker is None:
        return NO_TRACKER
    lost = int(d.unseen.sum())
    if not lost:
        return f"✓ sees the target in all {len(d)} readings"
    return f"✗ does not see the target in {lost} of {len(d)} readings"


def step_card(d: PlanView, k: int) -> str:
    """Return step k (from 0) in words."""
    step = d.plan.steps[k]
    under = "unloaded" if step.load == UNLOADED else f"under {step.load}"
    head = heading(f"Step {k + 1} of {len(d)}: {step.pose}, {under}")
    when = f"Minute {d.time[k] / 60.0:.0f} of {d.time[-1] / 60.0:.0f}."
    changes = bool(k) and d.load[k] != d.load[k - 1]
    change = "everything is taken off" if step.load == UNLOADED else f"{step.load} is hung"
    before = [Words(f"Before it: {change}, by hand.", "strong")] if changes else []
    angles = np.rad2deg(d.plan.joints(step.pose))
    rows = [(n, f"{a:.1f}") for n, a in zip(d.cell.arm.joint_names, angles, strict=True)]
    x, y, z = d.target[k]
    what = "Target" if d.cell.target_known else "Flange (the target's place is not known)"
    place = f"{what} at {x:.3f}, {y:.3f}, {z:.3f} m, base axes."
    joints = table("joint", "deg", rows=rows)
    return style.markdown([head, when, *before, _sight(d, k), joints, place])


def _sight(d: PlanView, k: int) -> Words:
    if d.tracker is None:
        return Words(numbers.sentence(NO_TRACKER))
    far = float(np.linalg.norm(d.tracker - d.target[k]))
    way = f"at {far:.2f} m"
    if d.incidence is not None:
        way += f", {np.rad2deg(d.incidence[k]):.0f}° off the reflector's normal"
    if d.sight[k] == SEEN:
        return Words(f"✓ The tracker sees the target {way}.")
    return Words(f"✗ The tracker does not see the target {way}: {d.why(k)}.", "strong")


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


_DOT = 3.5


def schedule(rec: rr.RecordingStream, d: PlanView) -> None:
    """Send the minute of each reading along `step`, one series per load; load changes are jumps."""
    colors = plan_scene.load_colors(d.loads)
    series = [
        (f"load{k}", load_name(name), d.load == k, tuple(colors[k]), "circle", _DOT)
        for k, name in enumerate(d.loads)
    ]
    if d.unseen.any():
        told = "not seen by the tracker"
        series.append(("unseen", told, d.unseen, style.RED, "cross", 2 * _DOT))
    for entity, name, of, color, marker, size in series:
        points = rr.SeriesPoints(
            names=[f"{style.safe(name)}: {int(of.sum())}"],
            colors=[color],
            markers=[marker],  # type: ignore[list-item]
            marker_sizes=[size],
        )
        fixed(rec, f"schedule/{entity}", points)
        time = rr.TimeColumn("step", sequence=np.flatnonzero(of) + 1)
        minutes = rr.Scalars.columns(scalars=d.time[of] / 60.0)
        along(rec, f"schedule/{entity}", time, minutes)


_FPS = 2.0
_LOOKED_AT = 20
"""Steps whose arm is to be seen from the eye."""
STEPS = "Plan step by step: a bead per pose and load, beam green = seen"
TRACKER = "From the tracker"
SCHEDULE = "Schedule: minute of each reading by step, colour by load"


def blueprint(d: PlanView) -> rrb.Blueprint:
    """Left: 3-D over the schedule. Right: the plan in words over its tables."""
    middle, size = plan_scene.framed(d)
    scenes = [layout.view3d("world", STEPS, middle + size * _eye(d, middle, size), middle)]
    if d.tracker is not None:
        scenes.append(_from_tracker(d, d.tracker))
    legend = rrb.PlotLegend(rrb.Corner2D.RightBottom)
    times = rrb.TimeSeriesView(origin="schedule", name=SCHEDULE, plot_legend=legend)
    words = (("plan", "Plan"), ("step", "This step"), ("guide", "How to read this"))
    left = rrb.Vertical(rrb.Tabs(*scenes), times, row_shares=[7, 2])
    right = rrb.Vertical(
        rrb.Tabs(*(layout.text(*w) for w in words)),
        layout.text("details", "Details"),
        row_shares=[5, 4],
    )
    return layout.whole(rrb.Horizontal(left, right, column_shares=[3, 2]), "step", fps=_FPS)


def _from_tracker(d: PlanView, place: Floats) -> rrb.Spatial3DView:
    contents = ["+ $origin/**"]
    contents += [f"- $origin/{x}/**" for x in ("tracker", "beam", "workspace", "way")]
    at = d.target.mean(axis=0)
    far = float(np.linalg.norm(place - at))
    return layout.view3d("world", f"{TRACKER}, {numbers.length(far)} away", place, at, contents)


def _eye(d: PlanView, middle: Floats, size: float) -> Floats:
    """Direction to the eye: across the beam where there is one, and where no obstacle hides."""
    turn = float(np.deg2rad(-52.0))
    if d.tracker is not None:
        beam = d.tracker - middle
        turn = float(np.arctan2(beam[1], beam[0]) - np.deg2rad(62.0))
    some = np.unique(np.linspace(0, len(d) - 1, _LOOKED_AT).round().astype(np.int64))
    points = np.vstack([d.bodies[some, 1:, :3, 3].reshape(-1, 3), d.target[some]])
    return layout.direction(turn, middle, size, points, d.config.obstacles)
