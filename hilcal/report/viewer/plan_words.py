"""A plan in words: markdown that the viewer shows beside the pictures."""

import numpy as np

from hilcal.acquire.sight import UNKNOWN as NO_TRACKER
from hilcal.data.plan import UNLOADED
from hilcal.plan.story import PlanStory
from hilcal.report import numbers
from hilcal.report.text_plan import CRITERIA, certified, enough, order_remark
from hilcal.report.text_run import spoken
from hilcal.report.viewer import plan_style
from hilcal.report.viewer.plan_digest import SEEN, PlanDigest
from hilcal.report.viewer.plan_promises import amount, share
from hilcal.report.viewer.style import escaped

_SEEN = 6


def summary(d: PlanDigest) -> str:
    """Return what the plan costs, what it promises and how near it is to the best."""
    s = d.story
    whole = spoken(s.motion_s + s.readings_s + s.load_changes_s)
    lines = [f"# Plan: {s.poses} poses, {s.readings} readings, {whole}"]
    if s.efficiency is not None:
        lines += [f"## {escaped(certified(s.efficiency).capitalize())}"]
    costs = _costs(d)
    lines += [costs[0], "|---|---|", *costs[1:]]
    lines += [line for remark in s.remarks for line in ("", f"⚠ {escaped(remark)}")]
    if s.curve:
        lines += ["", escaped(enough(s.curve))]
    if s.seen:
        lines += ["", _effects(s)]
    if s.order is not None:
        lines += ["", escaped(order_remark(s.order))]
    return "\n".join(lines)


def _costs(d: PlanDigest) -> list[str]:
    s = d.story
    loads = ", ".join(f"{escaped(plan_style.load_words(k))} {n}" for k, n in s.loads.items())
    changes = f"{s.load_changes} load change{'' if s.load_changes == 1 else 's'}"
    meaning = CRITERIA.get(s.criterion)
    rows = [
        f"| readings | {loads} |",
        f"| takes about | motion {spoken(s.motion_s)}, readings {spoken(s.readings_s)}, "
        f"{changes} by hand {spoken(s.load_changes_s)} |",
        f"| made for | {escaped(s.criterion)}{f': {escaped(meaning)}' if meaning else ''} |",
    ]
    if s.position_std_m is not None:
        std = numbers.length(s.position_std_m)
        rows.append(f"| position | **± {std}** predicted where the robot will work |")
    rows.append(f"| tracker | {sight(d)} |")
    return rows


def sight(d: PlanDigest) -> str:
    """Return how many of the readings the tracker sees."""
    if d.tracker is None:
        return f"⚠ {escaped(NO_TRACKER)}"
    lost = int(d.unseen.sum())
    if not lost:
        return f"✓ sees the target in all {len(d)} readings"
    return f"✗ **does not see the target in {lost} of {len(d)} readings**"


def _effects(s: PlanStory) -> str:
    told = sorted((x for x in s.seen if x.least_m is not None), key=lambda x: x.least_m or 0.0)
    words = [f"{escaped(x.effect)} from {numbers.length(x.least_m or 0.0)}" for x in told[:_SEEN]]
    more = f" and {len(told) - _SEEN} more" if len(told) > _SEEN else ""
    out = f"Not in the model, and would still show: {', '.join(words)}{more}." if words else ""
    hidden = [escaped(x.effect) for x in s.seen if x.least_m is None]
    if hidden:
        out += f" These readings cannot show {numbers.names(hidden, 'or')}."
    return out.strip()


def step_card(d: PlanDigest, k: int) -> str:
    """Return step k (from 0) in words."""
    step = d.plan.steps[k]
    under = "unloaded" if step.load == UNLOADED else f"under {escaped(step.load)}"
    lines = [
        f"# Step {k + 1} of {len(d)}: {escaped(step.pose)}, {under}",
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
        return f"⚠ {escaped(NO_TRACKER)}."
    far = float(np.linalg.norm(d.tracker - d.target[k]))
    way = f"at {far:.2f} m"
    if d.incidence is not None:
        way += f", {np.rad2deg(d.incidence[k]):.0f}° off the reflector's normal"
    if d.sight[k] == SEEN:
        return f"✓ The tracker sees the target {way}."
    return f"✗ **The tracker does not see the target** {way}: {escaped(d.why[k])}."


def parameters(s: PlanStory) -> str:
    """Return the table of all parameters with their predicted standard uncertainties."""
    lines = ["| parameter | predicted ± | of about | ± in % |", "|---|---|---|---|"]
    for p in s.predicted:
        about = share_ = " "
        if p.value is not None:
            unit, factor = numbers.unit_for(p.unit, [p.value])
            about = f"{numbers.digits(factor * p.value)} {escaped(unit)}"
            share_ = f"{numbers.digits(100 * share(p), 2)} %" if p.value else " "
        lines.append(f"| {escaped(p.name)} | {escaped(amount(p))} | {about} | {share_} |")
    lines += ["", "Of about: what is known so far, else an ordinary magnitude."]
    return "\n".join(lines)


def bought(s: PlanStory) -> str:
    """Return the table of what each criterion buys for the same number of readings."""
    lines = [
        "| criterion | position ± | open ± | joint ± | O1 (D) | O2 (K) | O3 (E) | certified |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for b in s.bought:
        name = escaped(b.criterion)
        worst = b.joint_share
        cells = (
            f"**{name}, this plan**" if b.criterion == s.criterion else name,
            "-" if b.position_std_m is None else numbers.length(b.position_std_m),
            "-" if b.position_open_m is None else numbers.length(b.position_open_m),
            "-" if worst is None else f"{numbers.digits(100 * worst, 2)} %",
            numbers.digits(b.o1),
            numbers.digits(b.o2, 2),
            numbers.digits(b.o3),
            "-" if b.efficiency is None else certified(b.efficiency).split(" of ")[0],
        )
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "Position: where the robot will work; open: the same where any effect that the plan is "
        "made against may be there. Joint: the worst known of the joints' parameters, by its "
        "size. O1 to O3: observability indices, larger is better; O1 and O3 with these effects "
        "unknown as well. "
        "Certified: share of the best possible by its own criterion.",
    ]
    return "\n".join(lines)


GUIDE = """# How to read this
**Plan step by step** (3-D): the arm stands in the pose of the step, as the capsules that are kept
clear of everything. *Step* (bottom left) goes through the readings in the order in which they are
taken; the bright line is the target's last motion, the faint one its whole way under this load.

**Beads** stand where the target is read: the lowest of a stack is the target itself, each further
one is the same place under another load. Their colours are those of the schedule below.

**The beam** is green where the tracker sees the target, amber where the reflector is turned too
far away, red where something is between; such readings have a cage about their bead and a frame
in the schedule. *From the tracker*: what the tracker sees, from where it stands.

**What hangs** below the load point is drawn with the room that is kept for it, a pull as an arrow.
Thin blue lines bound the workspace.

**Schedule**: one dot per reading, one row per load; gaps are load changes by hand.
"""
