"""Charts that compare: revisions of a model, two campaigns of an arm, arms of a type."""

from typing import TYPE_CHECKING

import numpy as np
import plotly.graph_objects as go

from hilcal import numbers
from hilcal.diagnosis.comparison import Comparison
from hilcal.present.charts import style
from hilcal.present.comparison import words_of
from hilcal.present.fleet import FAR
from hilcal.present.story import Story, StoryRevision
from hilcal.store.plan import UNLOADED

if TYPE_CHECKING:
    from hilcal.transfer.pooled import Pooled

SERIES = (
    ("error", "fitted poses", style.MEASURED),
    ("holdout", "poses left out", style.HOLDOUT),
)


def error_per_revision(story: Story) -> go.Figure:
    """Draw the rms error of each revision, the first on top, and what noise alone would leave."""
    first, *later = story.revisions
    names = [label(r, k == 0) for k, r in enumerate(story.revisions)]
    traces: list[object] = []
    for key, name, color in SERIES:
        rms = [1e6 * float(getattr(r, key).rms_m) for r in story.revisions]
        traces.append(
            go.Bar(
                x=rms,
                y=names,
                orientation="h",
                name=name,
                marker={"color": color},
                text=[numbers.digits(v) for v in rms],
                textposition="auto",
                hovertemplate="%{y}: %{text} µm, " + name + "<extra></extra>",
            )
        )
    floor = 1e6 * story.noise_floor_m
    out = style.figure(
        _words(story, first, later),
        x="error, rms [µm]",
        traces=traces,
        height=130 + 26 * len(names),
    )
    line = {"color": style.NOISE, "dash": "dash", "width": 2}
    out.add_vline(floor, line=line, layer="below")
    # for the legend alone: a shape has no entry there
    named = {"name": f"noise alone, {numbers.digits(floor)} µm", "mode": "lines", "line": line}
    out.add_trace(go.Scatter(x=[None], y=[names[0]], hoverinfo="skip", **named))
    out.update_yaxes(autorange="reversed")
    out.update_xaxes(rangemode="tozero")
    return out


def label(revision: StoryRevision, first: bool) -> str:
    """Return the name of a revision on the axis: what it changed."""
    change = "" if first else revision.change
    return style.label(f"{revision.revision}: {change or 'start'}")


def _words(story: Story, first: StoryRevision, later: list[StoryRevision]) -> str:
    floor = f"noise alone would leave {numbers.length(story.noise_floor_m)}."
    before = numbers.length(first.holdout.rms_m)
    if not later:
        return f"One revision: {before} rms error on poses left out; {floor}"
    after = numbers.length(later[-1].holdout.rms_m)
    fitted = (
        numbers.length(first.error.rms_m),
        numbers.length(later[-1].error.rms_m),
    )
    went = "fell" if later[-1].holdout.rms_m < first.holdout.rms_m else "went"
    return (
        f"The rms error {went} from {before} to {after} on poses left out, and from {fitted[0]} to "
        f"{fitted[1]} on the fitted ones, over {len(story.revisions)} revisions; {floor}"
    )


def error_by_pose(c: Comparison) -> go.Figure:
    """Draw the error of the earlier calibration at each later reading, and what it states."""
    found = c.today.prediction
    r, rows = found.readings, found.whitening.reading
    error = 1e6 * np.linalg.norm(found.raw[:, :3], axis=1)
    stated = 1e6 * c.today.beyond.stated_m
    names = [r.pose_names[k] for k in r.pose[rows]]
    loads = ["unloaded" if n == UNLOADED else n for n in (r.load_names[k] for k in r.load[rows])]
    poses = [style.label(n) for n in names]
    hover = [
        style.label(f"{n}, {load}: {e:.0f} µm, stated {s:.0f} µm")
        for n, load, e, s in zip(names, loads, error, stated, strict=True)
    ]
    traces = [
        style.marks(poses, values, color, symbol, 7, name=name, hovertext=hover, hoverinfo="text")
        for values, name, color, symbol in (
            (error, "error today", style.MEASURED, "circle"),
            (stated, "standard deviation that the calibration states", style.NOISE, "line-ew-open"),
        )
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
    told = [
        (off[a, k], n, arm, (arm, n) in odd)
        for k, n in enumerate(names)
        for a, arm in enumerate(t.arms)
        if np.isfinite(off[a, k])
    ]
    traces = []
    for unlike, name, color, symbol in (
        (False, "like its type", style.MEASURED, "circle"),
        (True, "unlike its type", style.RED, "x"),
    ):
        if chosen := [one for one in told if one[-1] == unlike]:
            at, names_of = np.array([x for x, *_ in chosen]), [n for _, n, *_ in chosen]
            hover = [style.label(f"{arm}, {n}: {x:+.1f} σ") for x, n, arm, _ in chosen]
            drawn = (at, [style.label(n) for n in names_of], color, symbol, 9)
            traces.append(
                style.marks(*drawn, name=name, opacity=0.8, hovertext=hover, hoverinfo="text")
            )
    arms = sorted({arm for arm, _ in odd})
    says = (
        f"{', '.join(arms)} {'is' if len(arms) == 1 else 'are'} unlike the others of the type."
        if arms
        else f"The {len(t.arms)} arms of the type are alike within what they scatter by."
    )
    return style.figure(
        says,
        x="distance from the mean of the type [σ]",
        height=140 + 24 * len(names),
        traces=traces,
        yaxis={"autorange": "reversed", "title": {"text": ""}},
        shapes=[
            {
                "type": "rect", "x0": -FAR, "x1": FAR, "y0": 0, "y1": 1, "yref": "paper",
                "fillcolor": style.NOISE, "opacity": 0.12, "line": {"width": 0}, "layer": "below",
            }
        ],
    )  # fmt: skip
