"""The story in words: markdown that the viewer shows beside the pictures."""

import math

import numpy as np
from scipy import stats

from hilcal import numbers
from hilcal.present.story import StoryLimit, StoryParameter, StoryRevision, StoryRival
from hilcal.present.viewer import style
from hilcal.present.viewer.digest import Digest
from hilcal.present.viewer.style import escaped, micrometres, number

_MARKS = {"adequate": "✓ ", "missing_effect": "✗ ", "unknown_effect": "✗ "}
_SUSPECTS = 3
_BAR = 5
_POSE_LOADS = 12
_LEVEL_WORDS = ("inside the noise", "doubtful", "outside the noise")
_CARRIERS = 4
_RIVALS = 2
_HIDDEN = 4
_MODEL = 4


def verdict(d: Digest, r: StoryRevision) -> str:
    """Return the verdict of a revision with its suspects; short, since a small window cuts it."""
    mark = _MARKS.get(r.verdict, "")
    lines = [
        f"### {place(d, r)}: {mark}{escaped(r.verdict.replace('_', ' '))}{_which(r)}",
        escaped(numbers.sentence(r.message, [s.effect for s in r.suspects])),
        "",
        suspects(r),
        f"Model: {model(r, _MODEL)}.",
    ]
    return "\n".join(lines)


def place(d: Digest, r: StoryRevision) -> str:
    """Return where in the story a revision stands, e.g. "Revision 2 of 2, the last"."""
    if d.story.growing:
        return f"Revision {r.revision}"
    told = [o.revision for o in d.story.revisions]
    k, count = told.index(r.revision) + 1, len(told)
    if told == list(range(1, count + 1)):
        where = f"Revision {k} of {count}"
    else:
        where = f"Revision {r.revision} ({k} of {count})"
    return f"{where}, the last" if k == count > 1 else where


def details(d: Digest, r: StoryRevision) -> str:
    """Return what the verdict rests on: rivals, what carries the misfit, the worst, the model."""
    outside = float(np.mean(r.whitened_norm2 > stats.chi2.ppf(style.INSIDE_P, 3)))
    lines = [
        f"### {title(r)}",
        f"Model: {model(r)}.",
        "",
        _errors(d, r),
        "",
        *_doubt(r),
        f"**{style.percent(outside)}** of readings outside their 99 % noise ball "
        f"(noise alone: 1 %); variance factor **{number(r.variance_factor)}** "
        f"(noise alone: 1). Worst: {_worst(d, r)}.",
    ]
    if r.tested:
        lines += ["", escaped(numbers.many_tests(r.tested, r.level))]
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
        f"pose {escaped(d.story.pose_name(i))}, load {escaped(d.story.load_names[i])}, "
        f"{micrometres(length)} ({np.sqrt(r.whitened_norm2[i]):.1f} σ)"
    )


def _which(r: StoryRevision) -> str:
    """Return the suspects between which the data do not decide."""
    if not (r.suspects and r.rivals):
        return ""
    named = [r.suspects[0].effect, *(o.effect for o in r.rivals[:_RIVALS])]
    more = f" (or {len(r.rivals) - _RIVALS} more)" if len(r.rivals) > _RIVALS else ""
    return f": {numbers.names([escaped(e) for e in named], 'or')}{more}?"


def _doubt(r: StoryRevision) -> list[str]:
    """Return a paragraph each on rivals of the leading suspect and on what carries a misfit."""
    out = [rivals(r.suspects[0].effect, r.rivals)] if r.suspects and r.rivals else []
    out += [carriers(r)] if r.curves else []
    return [line for paragraph in out for line in (paragraph, "")]


def rivals(lead: str, others: tuple[StoryRival, ...]) -> str:
    """Return what would separate the leading suspect from each of its rivals."""
    return " ".join(_rival(escaped(lead), r) for r in others[:_RIVALS])


def _rival(lead: str, r: StoryRival) -> str:
    alike = style.percent(max(1.0 - r.unlike, 0.0))
    head = f"**{escaped(r.effect)}** can imitate {alike} of what **{lead}** does"
    if not math.isfinite(r.times):
        return f"{head}: no number of readings like these separates them."
    if r.times <= 1.0:
        return (
            f"{head}; if {lead} were the whole cause, these readings would separate them: perhaps "
            "it is neither."
        )
    return f"{head}; {number(r.times, 2)} times as many readings like these would separate them."


def carriers(r: StoryRevision) -> str:
    """Return the variables that carry the misfit, with their shares of it."""
    named = ", ".join(
        f"**{escaped(c.variable)} {style.percent(c.share)}**" for c in r.curves[:_CARRIERS]
    )
    which = "the picture shows the first" if len(r.curves) > 1 else "see the picture"
    return f"What carries the misfit on poses left out: {named}; {which}."


def suspects(r: StoryRevision) -> str:
    """Return the table of ranked suspects, or the sentence that there are none."""
    if not r.suspects and r.verdict == "adequate" and r.limits:
        return f"{visible(r.limits)}\n"
    if not r.suspects:
        return "No suspect: no effect of the catalogue surely explains the residual.\n"
    shown = r.suspects[:_SUSPECTS]
    alike = any(s.same_as for s in shown)
    head = ["missing effect?", "explains", "left out", "p-value", *["inseparable from"] * alike]
    rows = [head, ["---"] * len(head)]
    for s in shown:
        told = [
            escaped(s.effect),
            f"{style.bars(s.share, _BAR)} {style.percent(s.share)}",
            style.percent(max(s.holdout_share, 0.0)),
            numbers.chance(s.p_value),
        ]
        rows.append([*told, *[escaped(numbers.few(s.same_as, 1)) or " "] * alike])
    if len(r.suspects) > len(shown):
        rows.append([f"{len(r.suspects) - len(shown)} weaker", *[" "] * (len(head) - 1)])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def visible(found: tuple[StoryLimit, ...]) -> str:
    """Return in a sentence how strong an effect must be to be seen."""
    seen = [s for s in found if math.isfinite(s.displacement_m)]
    if not seen:
        return "These readings cannot show any effect that is not in the model."
    least, most = seen[0], seen[-1]
    told = (
        f"Would have been seen: {escaped(least.effect)} from "
        f"**{numbers.length(least.displacement_m)}** rms at the target"
    )
    if len(seen) > 1:
        told += f", ... {escaped(most.effect)} from **{numbers.length(most.displacement_m)}**"
    hidden = [escaped(s.effect) for s in found if not math.isfinite(s.displacement_m)]
    rest = f"; cannot be seen: {numbers.few(hidden, _HIDDEN)}" if hidden else ""
    return f"{told}{rest}."


def limits(r: StoryRevision) -> str:
    """Return the table of effects that were not found, with the strength that would be seen."""
    seen = [s for s in r.limits if math.isfinite(s.displacement_m)]
    hidden = [escaped(s.effect) for s in r.limits if not math.isfinite(s.displacement_m)]
    if not r.limits:
        return "Nothing was looked for: run hilcal diagnose."
    lines = []
    if seen:
        lines = ["| not found | would be seen from | its parameters, rms |", "|---|---|---|"]
        lines += [
            f"| {escaped(s.effect)} | {numbers.length(s.displacement_m)} "
            f"| {escaped(s.parameters)} |"
            for s in seen
        ]
        lines += [
            "",
            "Would be seen from: rms displacement of the target at which nine campaigns like this "
            "one in ten would name the effect.",
            "",
        ]
    if hidden:
        lines.append(f"At no plausible size would these readings show {', '.join(hidden)}.")
    return "\n".join(lines)


def pose_cards(d: Digest) -> list[str]:
    """Return each pose of the last revision in words: residual of each load, and joints."""
    r = d.story.revisions[-1]
    told = f"With the model of {title(r)[0].lower()}{title(r)[1:]}."
    length, sigma = np.linalg.norm(r.residual, axis=1).tolist(), np.sqrt(r.whitened_norm2).tolist()
    level, rms = style.levels(r.whitened_norm2).tolist(), d.pose_rms(r).tolist()
    loads = {name: escaped(name) for name in set(d.story.load_names)}
    degrees = np.rad2deg(d.story.q[d.first]).tolist()
    order = np.argsort(d.row, kind="stable")
    ends = np.cumsum(np.bincount(d.row, minlength=len(d.poses)))
    out = []
    for k, rows in enumerate(np.split(order, ends[:-1])):
        lines = [
            f"### Pose {escaped(d.story.pose_name(int(rows[0])))}: {micrometres(rms[k])} rms",
            told,
            "",
            "| load | residual | in σ | |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {loads[d.story.load_names[i]]} | {micrometres(length[i])} "
            f"| {sigma[i]:.1f} | {_LEVEL_WORDS[level[i]]} |"
            for i in rows[:_POSE_LOADS].tolist()
        ]
        lines += ["", f"Joints {', '.join(f'{a:.1f}' for a in degrees[k])} deg."]
        out.append("\n".join(lines))
    return out


def parameters(r: StoryRevision, limit: int) -> str:
    """Return the table of parameters with their standard uncertainties."""
    if not r.parameters:
        return "This revision has no parameters."
    lines = [
        f"### Parameters of revision {r.revision}",
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
    value, std, unit = style.quantity(p.value, p.std, p.unit)
    return f"| {escaped(p.name)} | {value} | {f'± {std}' if std else ' '} | {escaped(unit)} |"


def revisions(d: Digest, upto: int) -> str:
    """Return the table of revisions up to one of them: errors falling, step by step."""
    lines = [
        "| revision | change | fit rms | held-out rms | largest | σ rms "
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


GUIDE = """### How to read this
**Timelines** (bottom left): *revision* goes through the models, the first one first: drag the
slider, or press Space to play. *pose* moves the arm through all poses, with the last model; the
bright ball is the present pose.

**Residuals** (3-D): each green ball is where noise alone would leave 99 % of the readings.
An arrow that leaves its ball = the model is wrong there. Grey: noise. Amber: beyond 99 %.
Red: beyond 99.99 %. The arm stands in the pose of the worst reading; a dotted line leads from it
to its label and is no residual.

**Deflection** (3-D): blue is measured, white is predicted, both enlarged; one pair per pose, of
its largest deflection. The line between their tips is what the model misses. Where only blue is
seen, the model is right.

**Worst reading of each pose**: the length of its residual in σ of its own noise. The tallest bar
is the worst reading; the order in µm can be another, where some readings are noisier.

**Error of each revision**: rms over fitted poses, over poses left out, and the longest residual
in µm, against the noise. Held-out error far above the fitted one = too many parameters.

**Residual against suspect**: what the residual follows. Where the leading suspect explains
little of it, the mean error in bins of the recorded variable that carries most of it, with ±2 σ.

**Could have been seen**: how strong an effect must be for these readings to show it.
"""
