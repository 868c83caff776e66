"""Noise check: the whitened residuals against the normal distribution of the stated noise."""

import numpy as np
import plotly.graph_objects as go
from scipy.stats import norm

from hilcal.identification.fit import Fit
from hilcal.present.charts import style

RANGE, MOST = 5.0, 50.0
"""Least and largest range of the histogram, σ; what lies beyond is counted in its last bins."""
BINS = 40


def noise_check(fit: Fit) -> go.Figure:
    """Draw the histogram of the whitened residual with the standard normal density.

    With n elements and p effective parameters the rms of the residual is sqrt(1 − p/n) where model
    and noise are right; the density is that of this standard deviation.
    """
    white = fit.white[np.isfinite(fit.white)]
    reach = float(np.clip(np.ceil(np.quantile(np.abs(white), 0.995)), RANGE, MOST))
    edges, width = np.linspace(-reach, reach, BINS + 1, retstep=True)
    counts, _ = np.histogram(np.clip(white, -reach + 1e-9, reach - 1e-9), edges)
    centres = 0.5 * (edges[1:] + edges[:-1])
    expected = np.sqrt(min(fit.dof / max(len(white), 1), 1.0))
    fine = np.linspace(-reach, reach, 401)
    traces = [
        go.Bar(
            x=centres,
            y=counts,
            width=0.9 * width,
            name="measured",
            marker={"color": style.MEASURED},
            hovertemplate="%{x:.2f} σ: %{y} elements<extra></extra>",
        ),
        go.Scatter(
            x=fine,
            y=len(white) * width * norm.pdf(fine, scale=max(expected, 1e-9)),
            mode="lines",
            name="the stated noise",
            line={"color": style.NOISE, "width": 2},
            hoverinfo="skip",
        ),
    ]
    low, high = fit.variance_factor_interval
    factor = fit.variance_factor
    fits = "the stated noise explains the residual" if low <= 1 <= high else (
        "the residual is larger than the stated noise" if factor > 1 else
        "the residual is smaller than the stated noise"
    )  # fmt: skip
    beyond = int(np.sum(np.abs(white) > RANGE))
    says = (
        f"Variance factor {factor:.2f}, 95 % interval {low:.2f} to {high:.2f}: {fits}. "
        f"{beyond} of {len(white)} elements are beyond {RANGE:.0f} σ."
    )
    return style.figure(
        says, x="whitened residual [σ]", y="number of elements", traces=traces, height=320
    )
