"""The story in words: markdown that the viewer shows beside the pictures."""

import numpy as np
from scipy import stats

from hilcal.report.story import StoryParameter, StoryRevision
from hilcal.report.viewer import style
from hilcal.report.viewer.digest import Digest
from hilcal.report.viewer.style import escaped, micrometres, number

_MARKS = {"adequate": "✓", "missing_effect": "✗", "unknown_effect": "✗"}
_SUSPECTS = 5
_POSE_LOADS = 12


def verdict(d: Digest, r: StoryRevision) -> str:
    """Return the verdict of a revision, with its numbers and its ranked suspects."""
    outside = float(np.mean(r.whitened_norm2 > stats.chi2.ppf(style.INSIDE_P, 3)))
    mark = _MARKS.get(r.verdict, "⚠")
    lines = [
        f"# {title(r)}",
        f"## {mark} {escaped(r.verdict.replace('_', ' ').capitalize())}",
        escaped(r.message),
        "",
        _errors(d, r),
        "",
        suspects(r),
        f"**{style.percent(outside)}** of readings outside their 99 % noise ball "
        f"(noise alone: 1 %); variance factor **{number(r.variance_factor)}** "
        f"(noise alone: 1). Worst: {_worst(d, r)}.",
        "",
        f"Model: {model(r)}.",
    ]
    return "\n".join(lines)


def title(r: StoryRevision) -> str:
    """Return a revision's number and what it changed."""
    if r.change:
        return f"Revision {r.revision}: {escaped(r.change)}"
    return f"Revision {r.revision}: {model(r, 3)}"


def model(r: StoryRevision, limit: int = 12) -> str:
    """Return the effects of a revision's model."""
    names = [escaped(e) for e in r.model[:limit]]
    more = f" and {len(r.model) - limit} more" if len(r.model) > limit else ""
    return (" + ".join(names) or "the nominal arm") + more


def _errors(d: Digest, r: StoryRevision) -> str:
    return (
        f"Error **{micrometres(r.error_fit['rms_m'])}** rms on fitted poses, "
        f"**{micrometres(r.error_holdout['rms_m'])}** on poses left out; "
        f"noise floor {micrometres(d.story.noise_floor_m)}."
    )


def _worst(d: Digest, r: StoryRevision) -> str:
    i = d.worst(r)
    length = float(np.linalg.norm(r.residual[i]))
    return (
        f"pose {d.story.pose[i]}, load {escaped(d.story.load_names[i])}, {micrometres(length)} "
        f"({np.sqrt(r.whitened_norm2[i]):.1f} σ)"
    )


def suspects(r: StoryRevision) -> str:
    """Return the table of ranked suspects, or the sentence that there are none."""
    if not r.suspects:
        return "No suspect: nothing in the catalogue explains what is left.\n"
    rows = [
        "| missing effect | explains | | held out | p-value | not separable from |",
        "|---|---|---|---|---|---|",
    ]
    for s in r.suspects[:_SUSPECTS]:
        same = ", ".join(escaped(e) for e in s.same_as) or " "
        rows.append(
            f"| {escaped(s.effect)} | {style.bars(s.share)} | {style.percent(s.share)} "
            f"| {style.percent(s.holdout_share)} | {style.p_value(s.p_value)} | {same} |"
        )
    if len(r.suspects) > _SUSPECTS:
        rows.append(f"| and {len(r.suspects) - _SUSPECTS} weaker | | | | | |")
    return "\n".join(rows) + "\n"


def pose_card(d: Digest, k: int) -> str:
    """Return one pose of the last revision in words: residual of each load, and joints."""
    r = d.story.revisions[-1]
    rows = np.flatnonzero(d.row == k)
    rms = float(np.sqrt((r.residual[rows] ** 2).sum(1).mean()))
    lines = [
        f"# Pose {d.poses[k]}: {micrometres(rms)} rms",
        f"With the model of {title(r)[0].lower()}{title(r)[1:]}.",
        "",
        "| load | residual | in σ | |",
        "|---|---|---|---|",
    ]
    words = ("inside the noise", "doubtful", "outside the noise")
    for i in rows[:_POSE_LOADS]:
        level = int(style.levels(r.whitened_norm2[i : i + 1])[0])
        lines.append(
            f"| {escaped(d.story.load_names[i])} "
            f"| {micrometres(float(np.linalg.norm(r.residual[i])))} "
            f"| {np.sqrt(r.whitened_norm2[i]):.1f} | {words[level]} |"
        )
    joints = ", ".join(f"{a:.1f}" for a in np.rad2deg(d.story.q[rows[0]]))
    lines += ["", f"Joints {joints} deg."]
    return "\n".join(lines)


def parameters(r: StoryRevision, limit: int) -> str:
    """Return the table of parameters with their standard uncertainties."""
    if not r.parameters:
        return "This revision has no parameters."
    lines = [
        f"# Parameters of revision {r.revision}",
        "| parameter | value | ± σ | unit |",
        "|---|---|---|---|",
    ]
    lines += [_parameter(p) for p in r.parameters[:limit]]
    if len(r.parameters) > limit:
        lines.append(f"| and {len(r.parameters) - limit} more | | | |")
    return "\n".join(lines)


def _parameter(p: StoryParameter) -> str:
    if not p.identifiable or p.value is None:
        return f"| {escaped(p.name)} | not identifiable | | {escaped(p.unit)} |"
    std = number(p.std, 2) if p.std is not None else " "
    return f"| {escaped(p.name)} | {number(p.value, 4)} | ± {std} | {escaped(p.unit)} |"


def revisions(d: Digest, upto: int) -> str:
    """Return the table of revisions up to one of them: errors falling, step by step."""
    lines = [
        "| revision | change | fit rms | held-out rms | worst | σ rms "
        "| variance factor | verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in d.story.revisions:
        if r.revision > upto:
            break
        lines.append(
            f"| {r.revision} | {escaped(r.change or 'the first model')} "
            f"| {micrometres(r.error_fit['rms_m'])} | {micrometres(r.error_holdout['rms_m'])} "
            f"| {micrometres(r.error_fit['max_m'])} | {number(r.error_fit['rms_sigma'])} "
            f"| {number(r.variance_factor)} | {escaped(r.verdict.replace('_', ' '))} |"
        )
    lines += ["", f"Noise floor: {micrometres(d.story.noise_floor_m)} rms."]
    return "\n".join(lines)


def log_line(d: Digest, r: StoryRevision) -> str:
    """Return a revision in one line."""
    what = r.change or "first model"
    return style.safe(
        f"revision {r.revision} ({what}): {micrometres(r.error_fit['rms_m'])} rms, "
        f"held out {micrometres(r.error_holdout['rms_m'])}, "
        f"noise {micrometres(d.story.noise_floor_m)}: {r.verdict.replace('_', ' ')}"
    )


GUIDE = """# How to read this
**Residuals** (3-D): each green ball is where noise alone would leave 99 % of the readings.
An arrow that leaves its ball = the model is wrong there. Grey: noise. Amber: beyond 99 %.
Red: beyond 99.99 %. The arm stands in the pose with the worst reading.

**Deflection** (3-D): blue is measured, white is predicted, both enlarged; one pair per pose, of
its largest deflection. The line between their tips is what the model misses. Where only blue is
seen, the model is right.

**Error per revision**: rms over fitted poses, over poses left out, and the worst reading,
against the noise floor. Held-out error far above the fitted one = too many parameters.

**Timelines** (bottom left): *revision* steps through the models; *pose* moves the arm through
all poses, with the last model; the bright ball is the present pose.
"""
