"""What all charts share: colours, templates for a light and a dark page, the sentence of a chart.

The colours are those of the viewer (Okabe and Ito's, which colour-blind people tell apart), darker
or lighter where that is needed for a contrast of 3 : 1 on both papers (WCAG 2.2, 1.4.11). No chart
tells anything by colour alone.
"""

import html
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from scipy import stats

from hilcal.names import escaped
from hilcal.present.story import LIMITS
from hilcal.types import Floats

MEASURED = "#3a96d0"
NOISE = "#009e73"
HOLDOUT = "#cc79a7"
GREY = "#888b94"
AMBER = "#c07f00"
RED = "#e0325c"
LIGHT, DARK = "#ffffff", "#15171c"
"""The papers that charts are drawn on."""
LEVELS = (GREY, AMBER, RED)
SYMBOLS = ("circle", "diamond", "x")
"""Marks of the levels, so that they are told apart without colours."""
CONFIG: dict[str, object] = {"displayModeBar": False, "responsive": True, "scrollZoom": False}
"""Options for plotly.js: no toolbar, and the wheel scrolls the page."""
SIGMA_LIMITS = np.sqrt(stats.chi2.ppf(LIMITS, 3)).tolist()
"""Mahalanobis distances from which a reading is doubtful, and outside."""
_INK = {False: ("#24272e", "#d9dbe0"), True: ("#e4e5e9", "#3b3f48")}


def template(dark: bool) -> go.layout.Template:
    """Return the look of charts on a light or dark page: transparent paper, quiet grid."""
    ink, grid = _INK[dark]
    axis = {
        **dict.fromkeys(("gridcolor", "linecolor", "zerolinecolor"), grid),
        "automargin": True,
        "autotickangles": [0, 90],
        "title": {"standoff": 8, "font": {"size": 12}},
        "ticks": "",
    }
    layout = go.Layout(
        font={"color": ink, "family": "system-ui, sans-serif", "size": 13},
        paper_bgcolor="rgba(0,0,0,0)",
        plot_bgcolor="rgba(0,0,0,0)",
        xaxis={**axis, "ticklabelstandoff": 8},  # off the labels of the other axis
        yaxis=axis,
        hoverlabel={"align": "left", "bgcolor": DARK if dark else LIGHT, "font": {"color": ink}},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0, "font": {"size": 12}},
        hovermode="closest",
        margin={"l": 10, "r": 10, "t": 30, "b": 10},
    )
    return go.layout.Template(layout=layout)


def figure(
    says: str,
    x: str = "",
    y: str = "",
    height: int = 360,
    traces: Sequence[object] = (),
    **layout: object,
) -> go.Figure:
    """Return a figure in the light scheme, `height` CSS pixels high and as wide as the page.

    `says` is the sentence that it shows; `x` and `y` are the titles of the axes, with their units.
    """
    out = go.Figure(data=list(traces))
    out.update_layout(template=template(False), height=height, meta={"says": escaped(says)})
    out.update_layout(xaxis={"title": {"text": x}}, yaxis={"title": {"text": y}})
    out.update_layout(**layout)
    return out


def line(
    x: Floats, y: Floats, name: str = "", color: str = NOISE, dash: str = "solid"
) -> go.Scatter:
    """Return a line that tells nothing when it is pointed at."""
    look = {"color": color, "width": 2, "dash": dash}
    more = {"name": name, "showlegend": bool(name), "hoverinfo": "skip"}
    return go.Scatter(x=drawn(x), y=drawn(y), mode="lines", line=look, **more)


def marks(
    x: object, y: object, color: str = MEASURED, symbol: str = "circle", size: int = 6, **more: Any
) -> go.Scatter:
    """Return points, at numbers or names; `more` is their name and what they tell."""
    x, y = (drawn(v) if isinstance(v, np.ndarray) else v for v in (x, y))
    marker = {"color": color, "symbol": symbol, "size": size}
    return go.Scatter(**{"x": x, "y": y, "mode": "markers", "marker": marker, **more})


def bar(
    values: Sequence[float], names: Sequence[str], color: object, text: Sequence[str], **more: Any
) -> go.Bar:
    """Return horizontal bars with a text each."""
    look = {"orientation": "h", "textposition": "auto", "marker": {"color": color}}
    return go.Bar(x=list(values), y=list(names), text=list(text), **look, **more)


def bars(
    names: Sequence[str],
    values: Sequence[float],
    hover: Sequence[str],
    says: str,
    x: str,
    colors: Sequence[str] | str = MEASURED,
) -> go.Figure:
    """Draw horizontal bars, the first on top, each with its value in two digits."""
    more = {"hovertext": [label(h) for h in hover], "hoverinfo": "text", "showlegend": False}
    formats = ((v, ".0f" if abs(v) >= 10 else ".2g") for v in values)
    text = ["0" if abs(v) < 0.005 else format(v, how) for v, how in formats]
    trace = bar(values, [label(n) for n in names], colors, text, **more)
    out = figure(says, x=x, traces=[trace], height=90 + 28 * len(names))
    out.update_yaxes(autorange="reversed")
    return out


def label(words: str) -> str:
    """Return words without a meaning in the HTML that plotly takes for labels."""
    return html.escape(escaped(words), quote=False)


def in_scheme(chart: go.Figure, dark: bool) -> go.Figure:
    """Return a copy of a chart for a light or dark page."""
    return go.Figure(chart).update_layout(template=template(dark))


def empty(words: str) -> go.Figure:
    """Return a chart of nothing that says why."""
    note = {"text": words, "showarrow": False, "xref": "paper", "yref": "paper", "x": 0.5, "y": 0.5}
    hidden = {"visible": False}
    return figure(words, height=160, annotations=[note], xaxis=hidden, yaxis=hidden)


def drawn(values: Floats) -> Floats:
    """Return numbers as they are drawn: single precision makes pages half as large."""
    return np.asarray(values, dtype=np.float32)
