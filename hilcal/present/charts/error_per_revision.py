"""How the error fell from revision to revision, on fitted poses and on poses left out."""

import plotly.graph_objects as go

from hilcal import numbers
from hilcal.present.charts import style
from hilcal.present.charts.readings_drawn import escaped
from hilcal.present.story import Story, StoryRevision

SERIES = (
    ("error_fit", "fitted poses", style.MEASURED),
    ("error_holdout", "poses left out", style.HOLDOUT),
)


def error_per_revision(story: Story) -> go.Figure:
    """Draw the rms error of each revision, the first on top, and what noise alone would leave."""
    first, *later = story.revisions
    names = [label(r, k == 0) for k, r in enumerate(story.revisions)]
    traces: list[object] = []
    for key, name, color in SERIES:
        rms = [1e6 * float(getattr(r, key)["rms_m"]) for r in story.revisions]
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
        x="3-D error, rms [µm]",
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
