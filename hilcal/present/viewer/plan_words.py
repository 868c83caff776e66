"""A plan in words: markdown that the viewer shows beside the pictures."""

from collections.abc import Iterable, Sequence

import numpy as np

from hilcal import numbers
from hilcal.design.summary import PlanSummary
from hilcal.measuring.sight import UNKNOWN as NO_TRACKER
from hilcal.present import text_next, text_plan
from hilcal.present.text_run import spoken
from hilcal.present.viewer.plan_digest import SEEN, PlanDigest
from hilcal.present.viewer.style import escaped
from hilcal.store.plan import UNLOADED

_DETECTABLE = 6
"""Effects that are named in the overview."""


def overview(d: PlanDigest) -> str:
    """Return what a plan is for, its cost and efficiency; short, since a small window cuts it."""
    s = d.summary
    title = f"Plan: {s.poses} poses, {s.readings} readings, {spoken(s.duration.total)}"
    lines = [*_question(d), "", f"**{title}**"] if d.powers else [f"### {title}"]
    rows = [row for row in text_plan.cost_rows(s) if row[0] not in ("", "takes about")]
    lines += [f"- **{name}** {escaped(value)}" for name, value in rows]
    return "\n".join([*lines, f"- **tracker** {sight(d)}"])


def notes(d: PlanDigest) -> str:
    """Return cost, remarks, what more poses would give, detectable effects and order of a plan."""
    s = d.summary
    lines = ["### Notes"]
    for name, value in text_plan.cost_rows(s):
        lines += [f"- **{name}** {escaped(value)}"] if name else [f"  ({escaped(value)})"]
    lines += [line for remark in s.remarks for line in ("", escaped(numbers.sentence(remark)))]
    if s.curve:
        lines += ["", escaped(text_plan.enough(s.curve))]
    if s.detectable:
        lines += ["", _effects(s)]
    if s.confounding is not None:
        lines += ["", escaped(text_plan.order_remark(s))]
    return "\n".join(lines)


def _question(d: PlanDigest) -> list[str]:
    """Return the suspects that the plan separates, and with which power."""
    names = list(dict.fromkeys(t.effect for t in d.powers))
    return [
        f"### Which is it: {escaped(numbers.names(names, 'or'))}?",
        _table(text_next.POWER_COLUMNS, text_next.power_rows(d.powers)),
    ]


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a markdown table."""
    cells = [columns, ["---"] * len(columns), *([escaped(c) for c in row] for row in rows)]
    return "\n".join(f"| {' | '.join(c or ' ' for c in row)} |" for row in cells)


def sight(d: PlanDigest) -> str:
    """Return how many of the readings the tracker sees."""
    if d.tracker is None:
        return escaped(NO_TRACKER)
    lost = int(d.unseen.sum())
    if not lost:
        return f"✓ sees the target in all {len(d)} readings"
    return f"✗ **does not see the target in {lost} of {len(d)} readings**"


def _effects(s: PlanSummary) -> str:
    found = text_plan.detectable(s)
    words = [f"{escaped(effect)} from {least}" for effect, least in found[:_DETECTABLE]]
    more = f" and {len(found) - _DETECTABLE} more" if len(found) > _DETECTABLE else ""
    out = f"Detectable outside of the model: {', '.join(words)}{more}. " if words else ""
    return f"{out}{escaped(text_plan.undetectable(s))}".strip()


def step_card(d: PlanDigest, k: int) -> str:
    """Return step k (from 0) in words."""
    step = d.plan.steps[k]
    under = "unloaded" if step.load == UNLOADED else f"under {escaped(step.load)}"
    lines = [
        f"### Step {k + 1} of {len(d)}: {escaped(step.pose)}, {under}",
        f"Minute {d.time[k] / 60.0:.0f} of {d.time[-1] / 60.0:.0f}.",
        "",
    ]
    if k and d.load[k] != d.load[k - 1]:
        lines += [f"**Before it: {_change(step.load)}, by hand.**", ""]
    lines += [_sight(d, k), "", "| joint | deg |", "|---|---|"]
    angles = np.rad2deg(d.plan.joints(step.pose))
    lines += [
        f"| {escaped(name)} | {angle:.1f} |"
        for name, angle in zip(d.cell.arm.joint_names, angles, strict=True)
    ]
    x, y, z = d.target[k]
    what = "Target" if d.cell.target_known else "Flange (the target's place is not known)"
    lines += ["", f"{what} at {x:.3f}, {y:.3f}, {z:.3f} m, base axes."]
    return "\n".join(lines)


def _change(load: str) -> str:
    return "everything is taken off" if load == UNLOADED else f"{escaped(load)} is hung"


def _sight(d: PlanDigest, k: int) -> str:
    if d.tracker is None:
        return f"{escaped(NO_TRACKER)[0].upper()}{escaped(NO_TRACKER)[1:]}."
    far = float(np.linalg.norm(d.tracker - d.target[k]))
    way = f"at {far:.2f} m"
    if d.incidence is not None:
        way += f", {np.rad2deg(d.incidence[k]):.0f}° off the reflector's normal"
    if d.sight[k] == SEEN:
        return f"✓ The tracker sees the target {way}."
    return f"✗ **The tracker does not see the target** {way}: {escaped(d.why[k])}."


def parameters(s: PlanSummary) -> str:
    """Return the table of predicted standard uncertainties."""
    rows = text_plan.parameter_rows(s.parameters)
    return f"{text_plan.PARAMETER_NOTE}\n\n{_table(text_plan.PARAMETER_COLUMNS, rows)}"


def criteria(s: PlanSummary) -> str:
    """Return the table of the criterion comparison."""
    rows = text_plan.criteria_rows(s)
    return f"{_table(text_plan.CRITERIA_COLUMNS, rows)}\n\n{text_plan.CRITERIA_NOTE}"


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
