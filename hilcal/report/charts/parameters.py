"""The parameters of a fit with their standard uncertainties, correlations and identifiability."""

import numpy as np
import plotly.graph_objects as go

from hilcal.identify.fit import Fit
from hilcal.report import numbers
from hilcal.report.charts import style
from hilcal.report.charts.misfit import bars
from hilcal.report.charts.readings_drawn import escaped
from hilcal.report.story import StoryParameter, StoryRevision
from hilcal.types import Floats, Ints

MOST = 40
"""Parameters that are drawn, the strongest; a choice."""
MOST_CORRELATED = 30
STRONG = 0.9
"""Correlation from which two parameters are named; a choice."""


def parameters(revision: StoryRevision) -> go.Figure:
    """Draw each parameter as value over standard uncertainty with ±2, the strongest on top."""
    known = [p for p in revision.parameters if p.identifiable and p.value is not None and p.std]
    if not known:
        return style.empty("No parameter is identifiable.")
    t = np.array([float(p.value or 0.0) / float(p.std or 1.0) for p in known])
    order = np.argsort(-np.abs(t), kind="stable")[:MOST]
    strong = int(np.sum(np.abs(t) > 2))
    trace = go.Scatter(
        x=t[order],
        y=[escaped(known[i].name) for i in order],
        mode="markers",
        error_x={"type": "constant", "value": 2, "color": style.GREY},
        marker={
            "color": [style.MEASURED if abs(t[i]) > 2 else style.GREY for i in order],
            "size": 8,
        },
        hovertext=[escaped(in_words(known[i])) for i in order],
        hoverinfo="text",
        showlegend=False,
    )
    few = f"; the {len(order)} strongest are drawn" if len(order) < len(known) else ""
    says = (
        f"{strong} of {len(known)} identifiable parameters differ from zero by more than twice "
        f"their standard uncertainty{few}."
    )
    out = style.figure(
        says,
        x="value / its σ" if np.abs(t).max() <= 50 else
        "value / its σ (asinh)",
        traces=[trace],
        height=110 + 22 * len(order),
    )  # fmt: skip
    if np.abs(t).max() > 50:
        _asinh(out, t[order])
    out.update_yaxes(autorange="reversed")
    out.add_vline(0, line={"color": style.GREY, "width": 1})
    return out


def _asinh(out: go.Figure, t: Floats) -> None:
    """Bend the axis, so that 3 and 3000 are both legible."""
    bent = np.arcsinh(t / 2)
    low, high = bent - np.arcsinh((t - 2) / 2), np.arcsinh((t + 2) / 2) - bent
    out.data[0].x = bent
    out.data[0].error_x = {
        "type": "data",
        "symmetric": False,
        "array": high,
        "arrayminus": low,
        "color": style.GREY,
    }
    ticks = [
        s for s in (-1e4, -1e3, -100, -10, -2, 0, 2, 10, 100, 1e3, 1e4)
        if t.min() - 3 <= s <= t.max() + 3
    ]  # fmt: skip
    at = np.arcsinh(np.array(ticks) / 2).tolist()
    out.update_xaxes(tickvals=at, ticktext=[f"{s:g}" for s in ticks])


def in_words(p: StoryParameter) -> str:
    """Return name, value and standard uncertainty in a unit for people."""
    if p.value is None or not p.identifiable:
        return f"{p.name}: these readings do not determine it"
    value, std, unit = numbers.measured(p.unit, p.value, p.std or 0.0)
    return f"{p.name} = {value} {'± ' + std + ' ' if std else ''}{unit}"


def parameter_correlations(fit: Fit) -> tuple[list[str], Floats]:
    """Return names and correlations (K, K) of the identifiable parameters, formal ones.

    Cov(θ) = T H⁻¹ Tᵀ, as in `identify.uncertainty`.
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
    says = f"The strongest correlation is {of[i, j]:+.2f}, of {names[i]} and {names[j]}."
    some: Ints = np.sort(np.argsort(-away.max(axis=1), kind="stable")[:MOST_CORRELATED])
    if len(some) < len(names):
        says += f" The {len(some)} most correlated of {len(names)} parameters are drawn."
    shown = [escaped(names[k]) for k in some]
    trace = go.Heatmap(
        z=style.drawn(of[np.ix_(some, some)]),
        x=shown,
        y=shown,
        zmin=-1,
        zmax=1,
        colorscale=[[0, style.RED], [0.5, "rgba(136,139,148,0.08)"], [1, style.MEASURED]],
        hovertemplate="%{x}<br>%{y}<br>%{z:+.2f}<extra></extra>",
        colorbar={"title": {"text": "correlation"}, "thickness": 12},
    )
    out = style.figure(says, traces=[trace], height=200 + 16 * len(some))
    out.update_yaxes(autorange="reversed", tickfont={"size": 10})
    out.update_xaxes(tickfont={"size": 10}, tickangle=90)
    return out


def identifiability(fit: Fit) -> go.Figure:
    """Draw, for each effect of the model, how many of its parameters the readings determine."""
    names, shares, hover, missing = [], [], [], []
    u = fit.uncertainty
    for effect, rows in zip(fit.model.effects, fit.model.slices(), strict=True):
        known = int((u.identifiable[rows] & fit.solution.estimated[rows]).sum())
        count = rows.stop - rows.start
        if count:
            names.append(f"{effect.name} ({known} of {count})")
            shares.append(100 * known / count)
            hover.append(f"{effect.name}: {known} of {count} parameters are determined")
            missing += [effect.name] if known < count else []
    if not names:
        return style.empty("The model has no parameters.")
    says = "The readings determine all parameters."
    if missing:
        says = f"The readings do not determine all parameters of {numbers.names(missing)}."
    return bars(names, shares, hover, says, "determined [%]")
