"""Added-variable plot of a suspect: the residual against what the suspect would explain."""

import numpy as np
import plotly.graph_objects as go

from hilcal.present.charts import style
from hilcal.present.story import Curve, worst_and_even

MOST = 1500


def added_variable(r: Curve, effect: str) -> go.Figure:
    """Draw residual over regressor, both freed of what the model can do.

    Where the suspect is right the points lie on the line of slope 1, where it explains nothing
    around zero.
    """
    at = worst_and_even(np.abs(r.y), MOST)
    ends = np.array([r.x.min(), r.x.max()])
    slope = float(r.x @ r.y / max(float(r.x @ r.x), 1e-300))
    traces = [
        go.Scatter(
            x=style.drawn(r.x[at]),
            y=style.drawn(r.y[at]),
            mode="markers",
            marker={"color": style.MEASURED, "size": 5},
            name="readings",
            hovertemplate="would explain %{x:.1f}, residual %{y:.1f}<extra></extra>",
        ),
        go.Scatter(
            x=ends,
            y=ends,
            mode="lines",
            line={"color": style.NOISE, "dash": "dash"},
            name="if it is right: slope 1",
            hoverinfo="skip",
        ),
        go.Scatter(
            x=ends,
            y=slope * ends,
            mode="lines",
            line={"color": style.RED},
            name=f"found: slope {slope:.2f}",
            hoverinfo="skip",
        ),
    ]
    note = "" if len(at) == len(r.x) else f" Of {len(r.x)} points {len(at)} are drawn."
    says = (
        f"Residual against what {effect} would explain: slope {slope:.2f}, where 1 means that it "
        f"is right and 0 that it explains nothing.{note}"
    )
    return style.figure(says, x="it would explain [µm]", y=r.y_label, traces=traces, height=340)
