"""A law that the catalogue does not have, over what it depends on, beside the readings."""

import numpy as np
import plotly.graph_objects as go

from hilcal.present.charts import style
from hilcal.present.charts.readings_drawn import escaped
from hilcal.present.story import Curve


def law(of: Curve) -> go.Figure:
    """Draw a law as a line, and what the readings say by themselves with standard uncertainties."""
    line = np.zeros((2, 0)) if of.line is None else of.line
    traces = [
        go.Scatter(
            **dict(zip("xy", style.drawn(line), strict=True)),
            mode="lines",
            line={"color": style.NOISE, "width": 2},
            name="law",
            hoverinfo="skip",
        ),
        go.Scatter(
            x=of.x,
            y=of.y,
            error_y={"type": "data", "array": of.error, "color": style.GREY},
            mode="markers",
            marker={"color": style.MEASURED, "size": 8},
            name="readings, mean ± standard uncertainty",
            hovertemplate="%{x:.3g}: %{y:.3g} ± %{error_y.array:.2g}<extra></extra>",
        ),
    ]
    says = (
        f"{of.y_label} over {of.x_label}. {of.says} The law is the line, interpolated where there "
        "are no readings (points)."
    )
    x, y = escaped(of.x_label), escaped(of.y_label)
    return style.figure(says, x=x, y=y, traces=traces, height=340)
