"""A plan in rerun: its recording, which shows it before anything is measured, also in words."""

from collections.abc import Iterator
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
from hilcal.store.plan import UNLOADED, Plan
from hilcal.types import Floats, Ints


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
    for name, text in (
        ("plan", overview(d)),
        ("notes", notes(d)),
        ("guide", GUIDE),
        ("parameters", style.markdown(plan_blocks.parameters_table(d.summary))),
        ("criteria", style.markdown(plan_blocks.criteria_table(d.summary))),
    ):
        rec.log(f"words/{name}", style.document(text), static=True)
    if d.summary.curve:
        curve(rec, d.summary)
    recording.flush(rec)
    plan_scene.step_scene(rec, d)
    schedule(rec, d)
    cards = [step_card(d, k) for k in range(len(d))]
    rec.send_columns(
        "words/step",
        indexes=[rr.TimeColumn("step", sequence=d.numbers)],
        columns=rr.TextDocument.columns(text=cards, media_type=["text/markdown"] * len(cards)),
    )
    recording.flush(rec)


_DETECTABLE = 6
"""Effects that are named in the overview."""


def overview(d: PlanView) -> str:
    """Return what a plan is for, its cost and efficiency; short, since a small window cuts it."""
    s = d.summary
    title: Block = heading(
        f"Plan: {s.poses} poses, {s.readings} readings, {spoken(s.duration.total)}"
    )
    rows = [row for row in plan_blocks.cost_rows(s) if row[0] not in ("", "takes about")]
    asked: list[Block] = []
    if d.powers:
        names = list(dict.fromkeys(t.effect for t in d.powers))
        question = heading(f"Which is it: {numbers.names(names, 'or')}?")
        asked = [question, plan_blocks.power_table(d.powers)]
    return style.markdown([*asked, title, pairs([*rows, ("tracker", sight(d))])])


def notes(d: PlanView) -> str:
    """Return cost, remarks, what more poses would give, detectable effects and order of a plan."""
    return style.markdown(_notes(d.summary))


def _notes(s: PlanSummary) -> Iterator[Block]:
    yield from (heading("Notes"), pairs(plan_blocks.cost_rows(s)))
    yield from map(numbers.sentence, s.remarks)
    if s.curve:
        yield plan_blocks.enough(s.curve)
    if found := plan_blocks.detectable(s):
        named = [f"{effect} from {least}" for effect, least in found]
        yield f"Detectable outside of the model: {numbers.few(named, _DETECTABLE)}."
    yield from (plan_blocks.undetectable(s), plan_blocks.order_remark(s))


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
    before = [Words(f"Before it: {_change(step.load)}, by hand.", "strong")] if changes else []
    angles = np.rad2deg(d.plan.joints(step.pose))
    rows = [(n, f"{a:.1f}") for n, a in zip(d.cell.arm.joint_names, angles, strict=True)]
    x, y, z = d.target[k]
    what = "Target" if d.cell.target_known else "Flange (the target's place is not known)"
    place = f"{what} at {x:.3f}, {y:.3f}, {z:.3f} m, base axes."
    joints = table("joint", "deg", rows=rows)
    return style.markdown([head, when, *before, _sight(d, k), joints, place])


def _change(load: str) -> str:
    return "everything is taken off" if load == UNLOADED else f"{load} is hung"


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
    for k, name in enumerate(d.loads):
        _dots(rec, d, f"load{k}", load_name(name), np.flatnonzero(d.load == k), tuple(colors[k]))
    if d.unseen.any():
        lost = np.flatnonzero(d.unseen)
        _dots(rec, d, "unseen", "not seen by the tracker", lost, style.RED, "cross")


def _dots(
    rec: rr.RecordingStream,
    d: PlanView,
    entity: str,
    name: str,
    steps: Ints,
    color: style.Color,
    marker: str = "circle",
) -> None:
    points = rr.SeriesPoints(
        names=[f"{style.safe(name)}: {len(steps)}"],
        colors=[color],
        markers=[marker],  # type: ignore[list-item]
        marker_sizes=[_DOT if marker == "circle" else 2.0 * _DOT],
    )
    rec.log(f"schedule/{entity}", points, static=True)
    rec.send_columns(
        f"schedule/{entity}",
        indexes=[rr.TimeColumn("step", sequence=d.numbers[steps])],
        columns=rr.Scalars.columns(scalars=d.time[steps] / 60.0),
    )


def curve_unit(s: PlanSummary) -> tuple[str, float]:
    """Return the unit of the sample-size curve and its factor."""
    return numbers.unit_for("m", [p.position_std_m for p in s.curve])


def curve(rec: rr.RecordingStream, s: PlanSummary) -> None:
    """Log the sample-size curve as bars; the one nearest to the plan is a series of its own."""
    poses = np.array([p.poses for p in s.curve], dtype=float)
    height = curve_unit(s)[1] * np.array([p.position_std_m for p in s.curve])
    width = 0.6 * float(np.diff(poses).min(initial=poses.max(initial=1.0)))
    own = np.zeros(len(poses), dtype=np.bool_)
    own[np.argmin(np.abs(poses - s.poses))] = True
    for name, bars, color in (("other", ~own, style.GREY), ("plan", own, style.MEASURED)):
        if bars.any():
            chart = rr.BarChart(
                height[bars],
                abscissa=poses[bars],
                widths=np.full(int(bars.sum()), width),
                color=color,
            )
            rec.log(f"curve/{name}", chart, static=True)


_FPS = 2.0
_LOOKED_AT = 20
"""Steps whose arm is to be seen from the eye."""
STEPS = "Plan step by step: a bead per pose and load, beam green = seen"
TRACKER = "From the tracker"
SCHEDULE = "Schedule: minute of each reading by step, colour by load"


def blueprint(d: PlanView) -> rrb.Blueprint:
    """Left: 3-D over the schedule. Right: the plan in words over the curve, with tables."""
    scenes = [_steps(d)]
    if d.tracker is not None:
        scenes.append(_from_tracker(d, d.tracker))
    left = rrb.Vertical(rrb.Tabs(*scenes), _schedule(), row_shares=[7, 2])
    right: list[rrb.View | rrb.Container] = [
        rrb.Tabs(
            rrb.TextDocumentView(origin="words/plan", name="Plan"),
            rrb.TextDocumentView(origin="words/step", name="This step"),
            rrb.TextDocumentView(origin="words/notes", name="Notes"),
            rrb.TextDocumentView(origin="words/guide", name="How to read this"),
        )
    ]
    details = _details(d)
    if details:
        right.append(rrb.Tabs(*details))
    shares = [5, 4][: len(right)]
    return layout.whole(
        rrb.Horizontal(left, rrb.Vertical(*right, row_shares=shares), column_shares=[3, 2]),
        "step",
        fps=_FPS,
    )


def curve_title(d: PlanView) -> str:
    """Return the title of the sample-size curve, with its unit."""
    unit = curve_unit(d.summary)[0]
    return f"Position ± [{unit}] by number of poses; blue: nearest to this plan"


def _details(d: PlanView) -> list[rrb.View]:
    out: list[rrb.View] = []
    if d.summary.curve:
        out.append(
            rrb.BarChartView(
                origin="curve", name=curve_title(d), plot_legend=rrb.PlotLegend(visible=False)
            )
        )
    if d.summary.criteria:
        out.append(rrb.TextDocumentView(origin="words/criteria", name="Criteria"))
    if d.summary.parameters:
        out.append(rrb.TextDocumentView(origin="words/parameters", name="Parameters"))
    return out


def _steps(d: PlanView) -> rrb.Spatial3DView:
    middle, size = plan_scene.framed(d)
    return layout.view3d("world", STEPS, middle + size * _eye(d, middle, size), middle)


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


def _schedule() -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="schedule", name=SCHEDULE, plot_legend=rrb.PlotLegend(rrb.Corner2D.RightBottom)
    )
