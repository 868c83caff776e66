"""The story in words: markdown that the viewer shows beside the pictures."""

import numpy as np

from hilcal import numbers
from hilcal.present.document import Block, heading, table
from hilcal.present.story import LEVEL_NAMES, REVISION_HEADS, StoryRevision, levels
from hilcal.present.viewer import style
from hilcal.present.viewer.digest import Digest
from hilcal.present.viewer.markdown import markdown

_MARKS = {"adequate": "✓ ", "missing_effect": "✗ ", "unknown_effect": "✗ "}
_POSE_LOADS = 12


def verdict(d: Digest, r: StoryRevision) -> str:
    """Return the verdict of a revision with its suspects; short, since a small window cuts it."""
    mark = _MARKS.get(r.verdict, "")
    head = heading(f"{place(d, r)}: {mark}{r.verdict.replace('_', ' ')}")
    return markdown([head, *(r.panels.get("verdict") or [r.message])])


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
    """Return what the verdict rests on, as the terminal has it, and the worst reading."""
    outside = float(np.mean(levels(r.whitened_norm2) > 0))
    i = d.worst(r)
    worst = (
        f"{numbers.percent(outside)} of readings are outside their 99 % noise ball (noise alone: "
        f"1 %). Worst: pose {d.story.pose_name(i)}, load {d.story.load_names[i]}, "
        f"{numbers.length(float(np.linalg.norm(r.residual[i])))} "
        f"({np.sqrt(r.whitened_norm2[i]):.1f} σ)."
    )
    head = heading(f"Revision {r.revision}: {r.name}")
    return markdown([head, worst, *r.panels.get("details", ())])


def pose_cards(d: Digest) -> list[str]:
    """Return each pose of the last revision in words: residual of each load, and joints."""
    r = d.story.revisions[-1]
    length, sigma = np.linalg.norm(r.residual, axis=1).tolist(), np.sqrt(r.whitened_norm2).tolist()
    level, rms = levels(r.whitened_norm2).tolist(), d.pose_rms(r).tolist()
    degrees = np.rad2deg(d.story.q[d.first]).tolist()
    order = np.argsort(d.row, kind="stable")
    ends = np.cumsum(np.bincount(d.row, minlength=len(d.poses)))
    out = []
    for k, rows in enumerate(np.split(order, ends[:-1])):
        cells = (
            (
                d.story.load_names[i],
                numbers.length(length[i]),
                f"{sigma[i]:.1f}",
                LEVEL_NAMES[level[i]],
            )
            for i in rows[:_POSE_LOADS].tolist()
        )
        card: list[Block] = [
            heading(f"Pose {d.story.pose_name(int(rows[0]))}: {numbers.length(rms[k])} rms"),
            f"With the model of revision {r.revision}: {r.name}.",
            table("load", "residual", "in σ", "", rows=cells, left=(0, 3)),
            f"Joints {', '.join(f'{a:.1f}' for a in degrees[k])} deg.",
        ]
        out.append(markdown(card))
    return out


def revisions(d: Digest, upto: int) -> str:
    """Return the table of revisions up to one of them: errors falling, step by step."""
    rows = [r.cells for r in d.story.revisions if r.revision <= upto and r.cells]
    floor = f"Noise alone would leave {numbers.length(d.story.noise_floor_m)} rms."
    return markdown([table(*REVISION_HEADS, rows=rows, left=(0, 1, 7)), floor])


def log_line(d: Digest, r: StoryRevision) -> str:
    """Return a revision in one line."""
    return style.safe(
        f"revision {r.revision} ({r.name}): {numbers.length(r.error_fit['rms_m'])} rms, "
        f"poses left out {numbers.length(r.error_holdout['rms_m'])}, "
        f"noise {numbers.length(d.story.noise_floor_m)}: {r.verdict.replace('_', ' ')}"
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
in µm, against the noise. Left-out error far above the fitted one = too many parameters.

**What the residual follows**: its mean over the leading suspect, or, where that explains little of
it, over the recorded variable that carries most of it; *Details* names both axes.
"""
