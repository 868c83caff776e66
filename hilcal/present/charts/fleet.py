"""Arms of a type: how far each is from the mean of its type, in standard deviations of the type."""

from typing import TYPE_CHECKING

import numpy as np
import plotly.graph_objects as go

from hilcal.present.charts import style
from hilcal.present.charts.readings_drawn import escaped

if TYPE_CHECKING:  # above this layer
    from hilcal.transfer.pooled import Pooled

FAR = 3.0
"""Standard deviations between which most arms lie; a choice."""


def arms_chart(t: "Pooled") -> go.Figure:
    """Draw each arm's parameters, over what an arm of the type is let expect.

    The distance is divided by the root of the spread from arm to arm and the arm's own uncertainty.
    """
    between = np.array([p.between for p in t.parameters])
    names = [p.parameter for p in t.parameters]
    seen = np.isfinite(t.off_std)
    off = t.off / np.sqrt(between**2 + np.where(seen, t.off_std, 1.0) ** 2)
    odd = {(o.arm, o.parameter) for o in t.odd if not o.campaign}
    traces = []
    for unlike, name, color, symbol in (
        (False, "like its type", style.MEASURED, "circle"),
        (True, "unlike its type", style.RED, "x"),
    ):
        chosen = [
            (k, a)
            for k, parameter in enumerate(names)
            for a, arm in enumerate(t.arms)
            if seen[a, k] and ((arm, parameter) in odd) == unlike
        ]
        if not chosen:
            continue
        traces.append(
            go.Scatter(
                x=style.drawn(np.array([off[a, k] for k, a in chosen])),
                y=[escaped(names[k]) for k, _ in chosen],
                mode="markers",
                name=name,
                marker={"color": color, "symbol": symbol, "size": 9, "opacity": 0.8},
                hovertext=[
                    escaped(f"{t.arms[a]}, {names[k]}: {off[a, k]:+.1f} σ") for k, a in chosen
                ],
                hoverinfo="text",
            )
        )
    arms = sorted({arm for arm, _ in odd})
    says = (
        f"{', '.join(arms)} {'is' if len(arms) == 1 else 'are'} unlike the others of the type."
        if arms
        else f"The {len(t.arms)} arms of the type are alike within what they scatter by."
    )
    return style.figure(
        says,
        x="distance from the mean of the type [σ]",
        height=140 + 24 * len(names),
        traces=traces,
        yaxis={"autorange": "reversed", "title": {"text": ""}},
        shapes=[
            {
                "type": "rect", "x0": -FAR, "x1": FAR, "y0": 0, "y1": 1, "yref": "paper",
                "fillcolor": style.NOISE, "opacity": 0.12, "line": {"width": 0}, "layer": "below",
            }
        ],
    )  # fmt: skip
