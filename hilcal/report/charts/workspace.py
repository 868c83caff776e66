"""Where in the workspace the model fails: readings in space, with their residuals as arrows."""

import numpy as np
import plotly.graph_objects as go

from hilcal.report import numbers
from hilcal.report.charts import style
from hilcal.report.charts.readings_drawn import drawn
from hilcal.report.story import Story, StoryRevision

LONGEST = 0.25
"""Length of the largest residual as drawn, m; a choice."""
MOST_ARROWS = 300
_NICE = (1.0, 2.0, 5.0)


def workspace(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw the target of each reading in base axes, coloured by its level, with its residual."""
    d = drawn(story, revision, most=1000)
    at = story.anchor[d.index]
    residual = revision.residual[d.index]
    times = magnification(float(d.size_m.max(initial=0.0)))
    traces: list[object] = []
    for k, mine in d.by_level():
        worst = np.flatnonzero(mine)[np.argsort(-d.sigma[mine])][:MOST_ARROWS]
        start, end = at[worst], at[worst] + times * residual[worst]
        gap = np.full_like(start, np.nan)  # between one line and the next
        lines = np.stack([start, end, gap], axis=1).reshape(-1, 3)
        traces.append(
            go.Scatter3d(
                **dict(zip("xyz", style.drawn(lines).T.copy(), strict=True)),
                mode="lines",
                line={"color": style.LEVELS[k], "width": 4},
                showlegend=False,
                hoverinfo="skip",
            )
        )
        traces.append(
            go.Scatter3d(
                **dict(zip("xyz", style.drawn(at[mine]).T.copy(), strict=True)),
                mode="markers",
                name=style.LEVEL_NAMES[k],
                marker={"color": style.LEVELS[k], "size": 3, "symbol": style.SYMBOLS_3D[k]},
                text=d.named(mine),
                hovertemplate="%{text}<extra></extra>",
            )
        )
    outside = int((style.levels(revision.whitened_norm2) == len(style.LEVELS) - 1).sum())
    says = (
        f"Targets in base axes with their residuals, {times:g} times enlarged: {outside} of "
        f"{len(story)} readings are outside the noise; the largest residual is "
        f"{numbers.length(float(d.size_m.max(initial=0.0)))}.{d.note}"
    )
    axes = {f"{a}axis": {"title": {"text": f"base {a} [m]"}} for a in "xyz"}
    camera = {"eye": {"x": 1.3, "y": 1.3, "z": 0.8}, "center": {"x": 0, "y": 0, "z": -0.22}}
    scene = {**axes, "aspectmode": "data", "camera": camera}
    legend = {"itemsizing": "constant"}
    return style.figure(says, traces=traces, height=480, scene=scene, legend=legend)


def magnification(largest_m: float) -> float:
    """Return the factor, 1, 2 or 5 times a power of ten, by which residuals are drawn longer."""
    if largest_m <= 0:
        return 1.0
    wanted = LONGEST / largest_m
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(max(f for f in _NICE if f * power <= wanted * (1 + 1e-9)) * power)
