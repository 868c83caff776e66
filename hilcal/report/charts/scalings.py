"""The same model fitted with scaling none, gu and gc, side by side."""

from collections.abc import Mapping

import plotly.graph_objects as go

from hilcal.data.whitening import Scaling
from hilcal.identify.fit import Fit
from hilcal.report.charts import style


def scalings(fits: Mapping[Scaling, Fit]) -> go.Figure:
    """Draw the rms error on fitted and held-out poses of each scaling."""
    names = list(fits)
    fitted = [1e6 * f.error.rms_m for f in fits.values()]
    left_out = [1e6 * f.holdout.rms_m for f in fits.values()]
    traces = [
        go.Bar(
            x=names,
            y=rms,
            name=name,
            marker={"color": color},
            text=[f"{v:.3g}" for v in rms],
            textposition="auto",
            hovertemplate="%{x}: %{y:.3g} µm rms, " + name + "<extra></extra>",
        )
        for name, color, rms in (
            ("fitted poses", style.MEASURED, fitted),
            ("poses left out", style.HOLDOUT, left_out),
        )
    ]
    best = min(fits, key=lambda k: fits[k].holdout.rms_m)
    left = ", ".join(f"{k} {1e6 * f.holdout.rms_m:.3g} µm" for k, f in fits.items())
    says = f"rms error on poses left out: {left}; the smallest is that of {best}."
    return style.figure(says, x="scaling", y="3-D error, rms [µm]", traces=traces, height=300)
