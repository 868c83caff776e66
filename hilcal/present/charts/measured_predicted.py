"""Measured against predicted deviation of every reading."""

import numpy as np
import plotly.graph_objects as go

from hilcal.present.charts import style
from hilcal.present.charts.readings_drawn import drawn
from hilcal.present.story import Story, StoryRevision

AXES = ("x", "y", "z")


def measured_predicted(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw what was measured over what is predicted, along the three base axes.

    Deflections are drawn as they are; of absolute readings the deviation from the nominal arm.
    Points on the diagonal are predicted exactly.
    """
    d = drawn(story, revision, most=500)  # three points each
    offset = story.anchor if story.mode == "absolute" else np.zeros_like(story.anchor)
    y = 1e6 * (story.measured - offset)
    x = 1e6 * (revision.predicted - offset)
    ends = np.array([min(x.min(), y.min()), max(x.max(), y.max())])
    traces: list[object] = [
        go.Scatter(
            x=ends,
            y=ends,
            mode="lines",
            name="exact",
            line={"color": style.NOISE, "dash": "dash"},
            hoverinfo="skip",
        )
    ]
    at = d.index
    for k, axis in enumerate(AXES):
        traces.append(
            go.Scatter(
                x=style.drawn(x[at, k]),
                y=style.drawn(y[at, k]),
                mode="markers",
                name=f"base {axis}",
                marker={"color": (style.MEASURED, style.HOLDOUT, style.AMBER)[k], "size": 6,
                        "symbol": style.SYMBOLS[k]},
                text=list(d.names),
                hovertemplate=f"%{{text}}<br>{axis}: measured %{{y:.1f}} µm, predicted %{{x:.1f}} "
                "µm<extra></extra>",
            )
        )  # fmt: skip
    what = "deflection" if story.mode == "deflection" else "deviation from the nominal arm"
    total = np.sum((y - y.mean(axis=0)) ** 2)
    left = np.sum((y - x) ** 2)
    share = 100 * (1 - left / total) if total > 0 else 0.0
    says = (
        f"Measured against predicted {what}: the model accounts for {share:.1f} % of what was "
        f"measured.{d.note}"
    )
    short = what.split(" ")[0]
    titles = {"x": f"predicted {short} [µm]", "y": f"measured {short} [µm]"}
    return style.figure(says, **titles, traces=traces, height=420)
