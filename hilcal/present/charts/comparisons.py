"""Charts that compare: revisions, two campaigns of an arm, arms of a type, families of effects."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import plotly.graph_objects as go

from hilcal import numbers
from hilcal.diagnosis.comparison import Comparison
from hilcal.identification.family_sizes import FamilySize
from hilcal.present.charts import style
from hilcal.present.comparison import words_of
from hilcal.present.document import load_name
from hilcal.present.fleet import FAR
from hilcal.present.story import Story

if TYPE_CHECKING:
    from hilcal.transfer.pooled import Pooled

MOST = 16
"""Families that are drawn, those that move the target most."""


def error_per_revision(story: Story) -> go.Figure:
    """Draw the rms error of each revision, the first on top, and what noise alone would leave."""
    told = story.revisions
    names = [
        style.label(f"{r.revision}: {(r.change if k else '') or 'start'}")
        for k, r in enumerate(told)
    ]
    traces: list[object] = []
    for key, name, color in (
        ("error", "fitted poses", style.MEASURED),
        ("holdout", "poses left out", style.HOLDOUT),
    ):
        rms = [1e6 * float(getattr(r, key).rms_m) for r in told]
        template = "%{y}: %{text} µm, " + name + "<extra></extra>"
        text = [numbers.digits(v) for v in rms]
        traces.append(style.bar(rms, names, color, text, name=name, hovertemplate=template))
    floor = 1e6 * story.noise_floor_m
    says = _fell(story)
    out = style.figure(says, x="error, rms [µm]", traces=traces, height=130 + 26 * len(names))
    line = {"color": style.NOISE, "dash": "dash", "width": 2}
    out.add_vline(floor, line=line, layer="below")
    # for the legend alone: a shape has no entry there
    named = {"name": f"noise alone, {numbers.digits(floor)} µm", "mode": "lines", "line": line}
    out.add_trace(go.Scatter(x=[None], y=[names[0]], hoverinfo="skip", **named))
    out.update_yaxes(autorange="reversed")
    out.update_xaxes(rangemode="tozero")
    return out


def _fell(story: Story) -> str:
    first, last = story.revisions[0], story.revisions[-1]
    floor = f"noise alone would leave {numbers.length(story.noise_floor_m)}."
    before, after = (numbers.length(r.holdout.rms_m) for r in (first, last))
    if first is last:
        return f"One revision: {before} rms error on poses left out; {floor}"
    fitted = " to ".join(numbers.length(r.error.rms_m) for r in (first, last))
    went = "fell" if last.holdout.rms_m < first.holdout.rms_m else "went"
    return (
        f"The rms error {went} from {before} to {after} on poses left out, and from {fitted} on "
        f"the fitted ones, over {len(story.revisions)} revisions; {floor}"
    )


def error_by_pose(c: Comparison) -> go.Figure:
    """Draw the error of the earlier calibration at each later reading, and what it states."""
    found = c.today.prediction
    r, rows = found.readings, found.whitening.reading
    error = 1e6 * np.linalg.norm(found.raw[:, :3], axis=1)
    stated = 1e6 * c.today.beyond.stated_m
    names = [r.pose_names[k] for k in r.pose[rows]]
    loads = [load_name(r.load_names[k]) for k in r.load[rows]]
    hover = [
        style.label(f"{n}, {load}: {e:.0f} µm, stated {s:.0f} µm")
        for n, load, e, s in zip(names, loads, error, stated, strict=True)
    ]
    poses, told = [style.label(n) for n in names], {"hovertext": hover, "hoverinfo": "text"}
    states = "standard deviation that the calibration states"
    traces = [
        style.marks(poses, error, style.MEASURED, "circle", 7, name="error today", **told),
        style.marks(poses, stated, style.NOISE, "line-ew-open", 7, name=states, **told),
    ]
    worst = int(np.argmax(error))
    says = (
        f"The error today is {error[worst]:.0f} µm at most, at {names[worst]} ({loads[worst]}); "
        f"{numbers.length(found.error.rms_m)} rms, where the calibration states "
        f"{numbers.length(c.today.stated_m)}."
    )
    kind = "error" if r.scalar.any() else "3-D error"
    return style.figure(says, x="pose", y=f"{kind} [µm]", traces=traces)


def changes_chart(c: Comparison) -> go.Figure:
    """Draw how far each change moves the target in the later readings."""
    found = c.changes.found
    moved = [1e6 * x.moved_m for x in found]
    names = [words_of(x.candidate) for x in found]
    hover = [f"{n}: {m:.0f} µm rms" for n, m in zip(names, moved, strict=True)]
    says = f"{names[0]} moves the target most: {moved[0]:.0f} µm rms." if found else "No change."
    return style.bars(names, moved, hover, says, "moves the target by, rms [µm]")


def arms_chart(t: "Pooled") -> go.Figure:
    """Draw each arm's parameters by their distance from the type, over what most arms have."""
    names, off = [p.parameter for p in t.parameters], t.distance
    odd = {(o.arm, o.parameter) for o in t.odd if not o.campaign}
    of = [
        (off[a, k], style.label(n), style.label(f"{arm}, {n}: {off[a, k]:+.1f} σ"), (arm, n) in odd)
        for k, n in enumerate(names)
        for a, arm in enumerate(t.arms)
        if np.isfinite(off[a, k])
    ]
    traces = []
    for unlike, name, color, symbol in (
        (False, "like its type", style.MEASURED, "circle"),
        (True, "unlike its type", style.RED, "x"),
    ):
        if chosen := [one for one in of if one[-1] == unlike]:
            x, y, hover, _ = zip(*chosen, strict=True)
            more = {"name": name, "opacity": 0.8, "hovertext": hover, "hoverinfo": "text"}
            traces.append(style.marks(np.array(x), list(y), color, symbol, 9, **more))
    arms = sorted({arm for arm, _ in odd})
    says = f"The {len(t.arms)} arms of the type are alike within what they scatter by."
    if arms:
        says = (
            f"{', '.join(arms)} {'is' if len(arms) == 1 else 'are'} unlike the others of the type."
        )
    band = {"type": "rect", "x0": -FAR, "x1": FAR, "y0": 0, "y1": 1, "yref": "paper"}
    look = {"fillcolor": style.NOISE, "opacity": 0.12, "line": {"width": 0}, "layer": "below"}
    return style.figure(
        says,
        x="distance from the mean of the type [σ]",
        height=140 + 24 * len(names),
        traces=traces,
        yaxis={"autorange": "reversed", "title": {"text": ""}},
        shapes=[{**band, **look}],
    )


def made_of(sizes: Sequence[FamilySize]) -> go.Figure:
    """Draw the size of each family by that of an ordinary arm, over its 95 % interval."""
    shown = sizes[:MOST]
    traces = []
    for named, words, color, symbol in (
        (True, "named", style.MEASURED, "circle"),
        (False, "predicted with, not named", style.GREY, "diamond"),
    ):
        own = [s for s in shown if s.named == named]
        if not own:
            continue
        low, at, high = np.array([(s.low, s.std, s.high) for s in own]).T / [
            s.ordinary for s in own
        ]
        error = {"type": "data", "symmetric": False, "array": high - at, "arrayminus": at - low}
        told = {"hovertext": [style.label(_size(s)) for s in own], "hoverinfo": "text"}
        error_x = {**error, "color": color}
        families = [style.label(s.name) for s in own]
        traces.append(
            style.marks(at, families, color, symbol, 9, name=words, error_x=error_x, **told)
        )
    first = shown[0]
    says = (
        f"{first.name} moves the target most, by {numbers.length(first.moves_m)} rms. Sizes are "
        "standard deviations of the parameters, with 95 % intervals; 1 is an ordinary arm, and "
        "[k] of waves are those from 2^k times a turn on."
    )
    if len(shown) < len(sizes):
        says += f" The {len(shown)} of {len(sizes)} families are drawn that move the target most."
    ordinary = {"type": "line", "x0": 1, "x1": 1, "y0": 0, "y1": 1, "yref": "paper"}
    order = [style.label(s.name) for s in reversed(shown)]
    return style.figure(
        says,
        height=130 + 22 * len(shown),
        traces=traces,
        # 1, 2 and 5 of each decade
        xaxis={"type": "log", "dtick": "D2", "title": {"text": "size, by that of an ordinary arm"}},
        yaxis={"categoryorder": "array", "categoryarray": order, "title": {"text": ""}},
        shapes=[{**ordinary, "line": {"color": style.NOISE, "width": 1, "dash": "dash"}}],
    )


def _size(s: FamilySize) -> str:
    low, std, high = (numbers.sizes([(s.unit, v)]) for v in (s.low, s.std, s.high))
    return f"{s.name}: {std} ({low} to {high}), moves the target by {numbers.length(s.moves_m)} rms"
