"""What the misfit follows: shares by recorded variable, and the curve of each that carries it."""

from collections.abc import Sequence

import plotly.graph_objects as go

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import LEAST_SHARE
from hilcal.present.charts import style
from hilcal.present.charts.readings_drawn import escaped
from hilcal.present.fit import CERTAIN, follows
from hilcal.present.story import Curve

MOST = 12


def misfit_shares(d: Diagnosis) -> go.Figure:
    """Draw the share of the misfit that follows each recorded variable, the largest on top."""
    rows = [v for v in d.misfit_breakdown if v.share >= LEAST_SHARE][:MOST]
    if not rows:
        return style.empty("The misfit follows no recorded variable.")
    shares = [100 * v.share for v in rows]
    names = [v.variable for v in rows]
    hover = [
        f"{n}: {s:.0f} %, {numbers.p_equals(v.p_value)}"
        for n, s, v in zip(names, shares, rows, strict=True)
    ]
    colors = [style.MEASURED if v.p_value < CERTAIN else style.GREY for v in rows]
    says = f"{follows(d.misfit_breakdown)} Grey bars are within chance."
    return bars(names, shares, hover, says, "share of the misfit [%]", colors)


def misfit_curve(c: Curve) -> go.Figure:
    """Draw how the error depends on a variable, with standard uncertainties."""
    trace = go.Scatter(
        x=[escaped(n) for n in c.names] if c.names else c.x,
        y=c.y,
        error_y={"type": "data", "array": c.error, "color": style.GREY},
        mode="markers" if c.names else "lines+markers",
        marker={"color": style.MEASURED, "size": 8},
        line={"color": style.MEASURED},
        hovertemplate="%{x}: %{y:.3g} ± %{error_y.array:.2g}<extra></extra>",
        showlegend=False,
    )
    says = f"{c.y_label} over {c.title}, from {c.y.min():.3g} to {c.y.max():.3g}; {c.says}"
    return style.figure(says, x=c.x_label, y=c.y_label, traces=[trace], height=300)


def bars(
    names: Sequence[str],
    values: Sequence[float],
    hover: Sequence[str],
    says: str,
    x: str,
    colors: Sequence[str] | str = style.MEASURED,
) -> go.Figure:
    """Draw horizontal bars, the first on top."""
    trace = go.Bar(
        x=list(values),
        y=[escaped(n) for n in names],
        orientation="h",
        marker={"color": colors},
        text=[_short(v) for v in values],
        textposition="auto",
        hovertext=[escaped(h) for h in hover],
        hoverinfo="text",
        showlegend=False,
    )
    height = 90 + 28 * len(names)
    out = style.figure(says, x=x, traces=[trace], height=height)
    out.update_yaxes(autorange="reversed")
    return out


def _short(value: float) -> str:
    """A value at the end of its bar, with two digits; what rounds to nothing is 0."""
    if abs(value) < 0.005:
        return "0"
    return f"{value:.0f}" if abs(value) >= 10 else f"{value:.2g}"
