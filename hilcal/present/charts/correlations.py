"""The correlations of a fit's parameters."""

import numpy as np
import plotly.graph_objects as go

from hilcal.identification.fit import Fit
from hilcal.present.charts import style
from hilcal.present.charts.readings_drawn import escaped
from hilcal.types import Floats, Ints

MOST_CORRELATED = 30


def parameter_correlations(fit: Fit) -> tuple[list[str], Floats]:
    """Return names and correlations (K, K) of the identifiable parameters, formal ones.

    Cov(θ) = T H⁻¹ Tᵀ, as in `identification.uncertainty`.
    """
    s = fit.solution
    covariance = s.transform @ s.equations.inverse(s.beta) @ s.transform.T
    names = [f"{e.name}.{p.name}" for e in fit.model.effects for p in e.parameters]
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    keep = np.flatnonzero(fit.uncertainty.identifiable & s.estimated & (std > 0))
    of = covariance[np.ix_(keep, keep)] / np.outer(std[keep], std[keep])
    return [names[k] for k in keep], np.clip(of, -1.0, 1.0)


def correlations(fit: Fit) -> go.Figure:
    """Draw the correlations of the identifiable parameters; of many, those of the strongest."""
    names, of = parameter_correlations(fit)
    if len(names) < 2:
        return style.empty("Fewer than two parameters are identifiable: nothing is correlated.")
    away = np.abs(of - np.diag(np.diag(of)))
    i, j = np.unravel_index(int(np.argmax(away)), away.shape)
    says = (
        f"The strongest correlation is {of[i, j]:+.2f}, of {names[i]} and {names[j]}; columns are "
        "in the order of the rows."
    )
    some: Ints = np.sort(np.argsort(-away.max(axis=1), kind="stable")[:MOST_CORRELATED])
    if len(some) < len(names):
        says += f" The {len(some)} most correlated of {len(names)} parameters are drawn."
    shown = [escaped(names[k]) for k in some]
    trace = go.Heatmap(
        z=style.drawn(of[np.ix_(some, some)]),
        y=shown,
        hovertext=[[f"{a}<br>{b}" for a in shown] for b in shown],
        zmin=-1,
        zmax=1,
        colorscale=[[0, style.RED], [0.5, "rgba(136,139,148,0.08)"], [1, style.MEASURED]],
        hovertemplate="%{hovertext}<br>%{z:+.2f}<extra></extra>",
        colorbar={"title": {"text": "correlation"}, "thickness": 12},
    )
    out = style.figure(says, traces=[trace], height=100 + 16 * len(some))
    out.update_yaxes(autorange="reversed", tickfont={"size": 10})
    out.update_xaxes(showticklabels=False)
    return out
