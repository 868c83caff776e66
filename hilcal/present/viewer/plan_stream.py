"""The recording of a plan: a file that shows it before anything is measured, also in words."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr

from hilcal import numbers
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.next import PairPower
from hilcal.design.summary import PlanSummary
from hilcal.measuring.clearance import TRACKER_UNKNOWN as NO_TRACKER
from hilcal.present import plan
from hilcal.present import plan as plan_blocks
from hilcal.present.document import Block, Words, heading, pairs, table
from hilcal.present.running import spoken
from hilcal.present.viewer import plan_layout, plan_scene, style
from hilcal.present.viewer.markdown import document, markdown
from hilcal.present.viewer.plan_digest import SEEN, PlanDigest, plan_digest
from hilcal.present.viewer.stream import flush, opened, require_folder, write
from hilcal.store.plan import UNLOADED, Plan

_DETECTABLE = 6
"""Effects that are named in the overview."""


def overview(d: PlanDigest) -> str:
    """Return what a plan is for, its cost and efficiency; short, since a small window cuts it."""
    s = d.summary
    title: Block = heading(
        f"Plan: {s.poses} poses, {s.readings} readings, {spoken(s.duration.total)}"
    )
    rows = [row for row in plan.cost_rows(s) if row[0] not in ("", "takes about")]
    asked: list[Block] = []
    if d.powers:
        names = list(dict.fromkeys(t.effect for t in d.powers))
        asked = [heading(f"Which is it: {numbers.names(names, 'or')}?"), plan.power_table(d.powers)]
    return markdown([*asked, title, pairs([*rows, ("tracker", sight(d))])])


def notes(d: PlanDigest) -> str:
    """Return cost, remarks, what more poses would give, detectable effects and order of a plan."""
    return markdown(_notes(d.summary))


def _notes(s: PlanSummary) -> Iterator[Block]:
    yield from (heading("Notes"), pairs(plan.cost_rows(s)))
    yield from map(numbers.sentence, s.remarks)
    if s.curve:
        yield plan.enough(s.curve)
    if found := plan.detectable(s):
        named = [f"{effect} from {least}" for effect, least in found]
        yield f"Detectable outside of the model: {numbers.few(named, _DETECTABLE)}."
    yield from (plan.undetectable(s), plan.order_remark(s))


def sight(d: PlanDigest) -> str:
    """Return how many of the readings the tracker sees."""
    if d.tracker is None:
        return NO_TRACKER
    lost = int(d.unseen.sum())
    if not lost:
        return f"✓ sees the target in all {len(d)} readings"
    return f"✗ does not see the target in {lost} of {len(d)} readings"


def step_card(d: PlanDigest, k: int) -> str:
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
    return markdown([head, when, *before, _sight(d, k), table("joint", "deg", rows=rows), place])


def _change(load: str) -> str:
    return "everything is taken off" if load == UNLOADED else f"{load} is hung"


def _sight(d: PlanDigest, k: int) -> Words:
    if d.tracker is None:
        return Words(numbers.sentence(NO_TRACKER))
    far = float(np.linalg.norm(d.tracker - d.target[k]))
    way = f"at {far:.2f} m"
    if d.incidence is not None:
        way += f", {np.rad2deg(d.incidence[k]):.0f}° off the reflector's normal"
    if d.sight[k] == SEEN:
        return Words(f"✓ The tracker sees the target {way}.")
    return Words(f"✗ The tracker does not see the target {way}: {d.why[k]}.", "strong")


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
    require_folder(path)
    d = plan_digest(cell, config, plan, summary, powers)
    rec = opened(d.config.to_json(), d.plan.to_json(), d.summary, d.powers)
    write(rec, plan_layout.blueprint(d), lambda: _log(rec, d), path)


def _log(rec: rr.RecordingStream, d: PlanDigest) -> None:
    rec.send_recording_name(f"hilcal plan: {style.safe(d.cell.arm.name)}, {len(d)} readings")
    plan_scene.static_scene(rec, d)
    for name, text in (
        ("plan", overview(d)),
        ("notes", notes(d)),
        ("guide", GUIDE),
        ("parameters", markdown(plan_blocks.parameters_table(d.summary))),
        ("criteria", markdown(plan_blocks.criteria_table(d.summary))),
    ):
        rec.log(f"words/{name}", document(text), static=True)
    if d.summary.curve:
        plan_layout.curve(rec, d.summary)
    flush(rec)
    plan_scene.step_scene(rec, d)
    plan_layout.schedule(rec, d)
    cards = [step_card(d, k) for k in range(len(d))]
    rec.send_columns(
        "words/step",
        indexes=[rr.TimeColumn("step", sequence=d.numbers)],
        columns=rr.TextDocument.columns(text=cards, media_type=["text/markdown"] * len(cards)),
    )
    flush(rec)
