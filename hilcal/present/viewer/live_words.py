"""A campaign while it is measured, in words: is the model good so far, and where is it wrong?"""

from hilcal import numbers
from hilcal.present.running import spoken, status_words
from hilcal.present.viewer.live_digest import Judged, LiveDigest
from hilcal.present.viewer.style import escaped

_REMARKS = 3

GUIDE = """### How to read this
Each reading is compared with a simple model, that of frames and joint compliance, fitted to the
readings **before** it.

**Residuals** (3-D): a small grey dot is a pose of the plan. A green ball is where noise and what
the model does not know yet would leave 99 % of the readings; an arrow that leaves its ball = the
model is wrong there. All arrows are in units of that noise. Grey: noise. Amber: beyond 99 %.
Red: beyond 99.99 %. Blue dots were measured before there was a model, or in an earlier session.
After 300 readings only arrows that leave their balls are drawn; below stand all.

A campaign of more than 1000 readings is divided into 150 groups, one after the other. The last
reading is always drawn; of the earlier ones only those stay that were the worst of their group so
far, here and below. The words count all readings, and the log lists them.

**Residual of each reading** (below): the same along the time of day, in σ as on the
terminal (rms of the three axes): 1 is noise, the green line 99 %.

What is missing in the model is not asked while measuring: `hilcal refine` does, afterwards.
"""


def status(d: LiveDigest) -> str:
    """Return how far the campaign is, and what the readings say so far."""
    lines = [f"### {_heading(d)}", _sentence(d), ""]
    left = f", {spoken(d.left)} left" if d.left > 0 else ""
    lines += [f"**{d.done} of {d.total}** readings{left}. {escaped(d.phase)}", ""]
    goal = None if d.last is None else d.last.goal
    if goal is not None and (told := status_words(goal)):
        lines += [f"Goal: {escaped(told)}.", ""]
    if len(d.loads) > 1 and d.outside:
        lines += _loads(d)
    if d.worst and d.worst[0].level > 0:
        lines += _worst(d)
    lines += [f"- note: {escaped(text)}" for text in d.remarks[-_REMARKS:]]
    return "\n".join(lines) + "\n"


def residual(found: Judged) -> str:
    """Return a residual for people, with its size in σ."""
    return f"{numbers.length(found.length)} ({found.sigma:.1f} σ)"


def _heading(d: LiveDigest) -> str:
    if d.judged == 0:
        return "Measuring: no judgement yet"
    if d.wrong:
        return "✗ The simple model fails: look at the red arrows"
    return "✓ So far noise explains the readings"


def _sentence(d: LiveDigest) -> str:
    if d.judged == 0:
        return "The first readings tell where tracker and target are; then each one is compared."
    share = numbers.percent(d.outside / d.judged)
    told = (
        f"**{d.outside} of {d.judged}** ({share}) compared readings are outside their 99 % noise "
        "ball (noise alone: 1 %)."
    )
    if d.wrong:
        told += " Something is missing in it: `hilcal refine` says what, after measuring."
    return told


def _worst(d: LiveDigest) -> list[str]:
    lines = ["| worst so far | load | residual | in σ |", "|---|---|---|---|"]
    lines += [
        f"| {escaped(f'{j.step.pose} {j.target}'.rstrip())} | {escaped(j.step.load)} "
        f"| {numbers.length(j.length)} | {j.sigma:.1f} |"
        for j in d.worst
        if j.level > 0
    ]
    return [*lines, ""]


def _loads(d: LiveDigest) -> list[str]:
    lines = ["| load | compared | outside | |", "|---|---|---|---|"]
    lines += [
        f"| {escaped(name)} | {count} | {outside} | {numbers.percent(outside / count)} |"
        for name, (count, outside) in d.loads.items()
    ]
    return [*lines, ""]
