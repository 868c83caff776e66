"""How the error fell from revision to revision, on fitted and held-out poses: a waterfall."""

import itertools

import plotly.graph_objects as go

from hilcal.report import numbers
from hilcal.report.charts import style
from hilcal.report.charts.readings_drawn import escaped
from hilcal.report.story import Story, StoryRevision

SERIES = (
    ("error_fit", "fitted poses", style.MEASURED),
    ("error_holdout", "poses left out", style.HOLDOUT),
)


def error_per_revision(story: Story) -> go.Figure:
    """Draw the rms error of each revision, what it took away, and what noise alone would leave."""
    first, *later = story.revisions
    names = [label(r, k == 0) for k, r in enumerate(story.revisions)]
    traces: list[object] = []
    for key, name, color in SERIES:
        rms = [1e6 * float(getattr(r, key)["rms_m"]) for r in story.revisions]
        steps = [b - a for a, b in itertools.pairwise(rms)]
        x, y, kind = list(names), [rms[0], *steps], ["absolute", *("relative" for _ in steps)]
        hover = [f"{names[0]}: {rms[0]:.3g} µm, {name}"]
        hover += [
            f"{n}: {after - by:.3g} → {after:.3g} µm, {name}"
            for n, by, after in zip(names[1:], steps, rms[1:], strict=True)
        ]
        if steps:
            x, y, kind = [*x, "left now"], [*y, rms[-1]], [*kind, "total"]
            hover.append(f"left now: {rms[-1]:.3g} µm, {name}")
        traces.append(
            go.Waterfall(
                x=x,
                y=y,
                measure=kind,
                name=name,
                hovertext=hover,
                hoverinfo="text",
                text=[f"{v:.3g}" for v in (*rms, *(rms[-1:] if steps else ()))],
                textposition="outside",
                cliponaxis=False,
                connector={"line": {"color": style.GREY, "width": 1}},
                totals={"marker": {"color": color}},
                decreasing={"marker": {"color": color}},
                increasing={"marker": {"color": color}},
                offsetgroup=key,
            )
        )
    floor = 1e6 * story.noise_floor_m
    out = style.figure(
        _words(story, first, later),
        y="3-D error, rms [µm]",
        traces=traces,
        waterfallgroupgap=0.15,
    )
    line = {"color": style.NOISE, "dash": "dash", "width": 2}
    out.add_hline(floor, line=line, layer="below")
    # for the legend alone: a shape has no entry there
    named = {"name": f"noise alone, {floor:.3g} µm", "mode": "lines", "line": line}
    out.add_trace(go.Scatter(x=[names[0]], y=[None], hoverinfo="skip", **named))
    out.update_yaxes(rangemode="tozero")
    return out


def label(revision: StoryRevision, first: bool) -> str:
    """Return the name of a revision on the axis: what it changed."""
    change = "" if first else revision.change
    return escaped(f"{revision.revision}: {change or 'start'}")


def _words(story: Story, first: StoryRevision, later: list[StoryRevision]) -> str:
    floor = f"noise alone would leave {numbers.length(story.noise_floor_m)}."
    before = numbers.length(first.error_holdout["rms_m"])
    if not later:
        return f"One revision: {before} rms error on poses left out; {floor}"
    after = numbers.length(later[-1].error_holdout["rms_m"])
    fitted = (
        numbers.length(first.error_fit["rms_m"]),
        numbers.length(later[-1].error_fit["rms_m"]),
    )
    went = "fell" if later[-1].error_holdout["rms_m"] < first.error_holdout["rms_m"] else "went"
    return (
        f"The rms error {went} from {before} to {after} on poses left out, and from {fitted[0]} to "
        f"{fitted[1]} on the fitted ones, over {len(story.revisions)} revisions; {floor}"
    )
