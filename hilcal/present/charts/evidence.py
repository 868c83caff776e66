"""Charts of evidence: a suspect, what the misfit follows, a law, correlations, the noise."""

import numpy as np
import plotly.graph_objects as go
from scipy.stats import norm

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import LEAST_SHARE
from hilcal.identification.fit import Fit
from hilcal.present.charts import style
from hilcal.present.fit import CERTAIN, follows
from hilcal.present.story import DependenceCurve, worst_and_even
from hilcal.types import Floats, Ints

MOST_POINTS = 1500


def added_variable(r: DependenceCurve, effect: str) -> go.Figure:
    """Draw residual over regressor, both freed of what the model can do.

    Where the suspect is right the points lie on the line of slope 1, where it explains nothing
    around zero.
    """
    at = worst_and_even(np.abs(r.y), MOST_POINTS)
    ends = np.array([r.x.min(), r.x.max()])
    slope = float(r.x @ r.y / max(float(r.x @ r.x), 1e-300))
    told = "would explain %{x:.1f}, residual %{y:.1f}<extra></extra>"
    traces = [
        style.marks(r.x[at], r.y[at], name="readings", size=5, hovertemplate=told),
        style.line(ends, ends, "if it is right: slope 1", dash="dash"),
        style.line(ends, slope * ends, f"found: slope {slope:.2f}", style.RED),
    ]
    note = "" if len(at) == len(r.x) else f" Of {len(r.x)} points {len(at)} are drawn."
    says = (
        f"Residual against what {effect} would explain: slope {slope:.2f}, where 1 means that it "
        f"is right and 0 that it explains nothing.{note}"
    )
    return style.figure(says, x="it would explain [µm]", y=r.y_label, traces=traces, height=340)


MOST_VARIABLES = 12


def misfit_shares(d: Diagnosis) -> go.Figure:
    """Draw the share of the misfit that follows each recorded variable, the largest on top."""
    rows = [v for v in d.misfit_breakdown if v.share >= LEAST_SHARE][:MOST_VARIABLES]
    if not rows:
        return style.empty("The misfit follows no recorded variable.")
    shares, names = [100 * v.share for v in rows], [v.variable for v in rows]
    hover = [f"{v.variable}: {100 * v.share:.0f} %, {numbers.p_equals(v.p_value)}" for v in rows]
    colors = [style.MEASURED if v.p_value < CERTAIN else style.GREY for v in rows]
    says = f"{follows(d.misfit_breakdown)} Grey bars are within chance."
    return style.bars(names, shares, hover, says, "share of the misfit [%]", colors)


def curve_chart(c: DependenceCurve) -> go.Figure:
    """Draw means over a variable with standard uncertainties, and the law, where there is one."""
    points = style.marks(
        [style.label(n) for n in c.names] if c.names else c.x,
        c.y,
        size=8,
        error_y={"type": "data", "array": c.error, "color": style.GREY},
        mode="markers" if c.names or c.line is not None else "lines+markers",
        line={"color": style.MEASURED},
        name="readings, mean ± standard uncertainty",
        hovertemplate="%{x}: %{y:.3g} ± %{error_y.array:.2g}<extra></extra>",
        showlegend=c.line is not None,
    )
    says = f"{c.y_label} over {c.x_label}, from {c.y.min():.3g} to {c.y.max():.3g}; {c.says}"
    traces = [points] if c.line is None else [style.line(c.line[0], c.line[1], "law"), points]
    x, y = style.label(c.x_label), style.label(c.y_label)
    return style.figure(says, x=x, y=y, traces=traces, height=320)


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
    shown = [style.label(names[k]) for k in some]
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


RANGE, WIDEST = 5.0, 50.0
"""Least and largest range of the histogram, σ; what lies beyond is counted in its last bins."""
BINS = 40


def noise_check(fit: Fit) -> go.Figure:
    """Draw the histogram of the whitened residual with the standard normal density.

    With n elements and p effective parameters the rms of the residual is sqrt(1 − p/n) where model
    and noise are right; the density is that of this standard deviation.
    """
    white = fit.white[np.isfinite(fit.white)]
    reach = float(np.clip(np.ceil(np.quantile(np.abs(white), 0.995)), RANGE, WIDEST))
    edges, width = np.linspace(-reach, reach, BINS + 1, retstep=True)
    counts, _ = np.histogram(np.clip(white, -reach + 1e-9, reach - 1e-9), edges)
    centres = 0.5 * (edges[1:] + edges[:-1])
    expected = np.sqrt(min(fit.dof / max(len(white), 1), 1.0))
    fine = np.linspace(-reach, reach, 401)
    look = {"width": 0.9 * width, "name": "measured", "marker": {"color": style.MEASURED}}
    told = "%{x:.2f} σ: %{y} elements<extra></extra>"
    density = len(white) * width * norm.pdf(fine, scale=max(expected, 1e-9))
    traces = [
        go.Bar(x=centres, y=counts, hovertemplate=told, **look),
        style.line(fine, density, "the stated noise"),
    ]
    low, high = fit.variance_factor_interval
    factor = fit.variance_factor
    fits = f"the residual is {'larger' if factor > 1 else 'smaller'} than the stated noise"
    if low <= 1 <= high:
        fits = "the stated noise explains the residual"
    beyond = int(np.sum(np.abs(white) > RANGE))
    says = (
        f"Variance factor {factor:.2f}, 95 % interval {low:.2f} to {high:.2f}: {fits}. "
        f"{beyond} of {len(white)} elements are beyond {RANGE:.0f} σ."
    )
    titles = {"x": "whitened residual [σ]", "y": "number of elements"}
    return style.figure(says, **titles, traces=traces, height=320)
