"""Where in the workspace the model fails: targets from above and from the side, with residuals."""

from typing import Literal

import numpy as np
import plotly.graph_objects as go

from hilcal import numbers
from hilcal.present.charts import style
from hilcal.present.charts.readings_drawn import drawn
from hilcal.present.story import LEVEL_NAMES, Story, StoryRevision, levels

LONGEST = 0.25
"""Length of the largest residual as drawn, m; a choice."""
MOST_ARROWS = 300
_NICE = (1.0, 2.0, 5.0)


def workspace(
    story: Story, revision: StoryRevision, plane: Literal["xy", "xz"] = "xy"
) -> go.Figure:
    """Draw the target of each reading in base axes, marked by its level, with its residual.

    Args:
        story: N readings.
        revision: of the model.
        plane: of the base's axes; "xy" is seen from above.
    """
    d = drawn(story, revision, most=1000)
    axes = ["xyz".index(a) for a in plane]
    at, residual = story.anchor[d.index][:, axes], revision.residual[d.index][:, axes]
    times = magnification(float(d.size_m.max(initial=0.0)))
    traces: list[object] = []
    for k, mine in d.by_level():
        worst = np.flatnonzero(mine)[np.argsort(-d.sigma[mine])][:MOST_ARROWS]
        start, end = at[worst], at[worst] + times * residual[worst]
        gap = np.full_like(start, np.nan)  # between one line and the next
        lines = np.stack([start, end, gap], axis=1).reshape(-1, 2)
        traces.append(
            go.Scatter(
                **dict(zip("xy", style.drawn(lines).T.copy(), strict=True)),
                mode="lines",
                line={"color": style.LEVELS[k], "width": 2},
                showlegend=False,
                hoverinfo="skip",
            )
        )
        traces.append(
            go.Scatter(
                **dict(zip("xy", style.drawn(at[mine]).T.copy(), strict=True)),
                mode="markers",
                name=LEVEL_NAMES[k],
                showlegend=False,
                marker={"color": style.LEVELS[k], "size": 5, "symbol": style.SYMBOLS[k]},
                text=d.named(mine),
                hovertemplate="%{text}<extra></extra>",
            )
        )
    outside = int((levels(revision.whitened_norm2) == len(style.LEVELS) - 1).sum())
    says = (
        f"Targets with their errors, {times:g} times enlarged: {outside} of {len(story)} readings "
        f"are outside the noise (crosses, red); the largest error is "
        f"{numbers.length(float(d.size_m.max(initial=0.0)))}.{d.note}"
    )
    if plane == "xz":
        says = "The same from the side."
    x, y = (f"base {a} [m]" for a in plane)
    out = style.figure(says, x=x, y=y, traces=traces, height=280)
    out.update_yaxes(scaleanchor="x", constrain="domain")
    out.update_xaxes(constrain="domain")
    return out


def magnification(largest_m: float) -> float:
    """Return the factor, 1, 2 or 5 times a power of ten, by which residuals are drawn longer."""
    if largest_m <= 0:
        return 1.0
    wanted = LONGEST / largest_m
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(f for f in _NICE if f * power <= wanted * (1 + 1e-9)) * power)
