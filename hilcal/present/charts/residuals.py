"""Residuals in units of the noise (Mahalanobis distance, σ) by pose, load, joint angle or time."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go

from hilcal.present.charts import style
from hilcal.present.charts.readings_drawn import Drawn, drawn, escaped
from hilcal.present.story import LEVEL_NAMES, Story, StoryRevision
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

MOST_POSES = 16
"""Poses up to which all their names stand at the axis; a choice, as is the next."""
LONGEST_NAME = 12
"""Characters of a name at the axis; of a longer one the end."""


def residual_by_pose(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw the residual of each reading in σ over its pose, poses in the order of their numbers."""
    d = drawn(story, revision)
    _, first, of = np.unique(story.pose, return_index=True, return_inverse=True)
    out = chart(d, of.reshape(-1)[d.index].astype(float), "", _by(story, revision, "pose"))
    full = [story.pose_name(int(i)) for i in first]
    short = [n if len(n) <= LONGEST_NAME else f"…{n[1 - LONGEST_NAME :]}" for n in full]
    names = [escaped(n) for n in short]
    step = -(-len(names) // MOST_POSES)
    out.update_xaxes(tickvals=list(range(0, len(names), step)), ticktext=names[::step])
    return out


def residual_by_load(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw the residual of each reading in σ over its load."""
    d = drawn(story, revision)
    loads = list(dict.fromkeys(story.load_names))
    of = np.array([loads.index(name) for name in story.load_names], dtype=float)
    # beside each other within a load, so that points do not hide each other
    beside = np.random.default_rng(0).uniform(-0.3, 0.3, len(of))
    out = chart(d, (of + beside)[d.index], "load", _by(story, revision, "load"))
    names = ["unloaded" if name == UNLOADED else escaped(name) for name in loads]
    out.update_xaxes(tickvals=list(range(len(names))), ticktext=names)
    return out


def residual_by_joint(story: Story, revision: StoryRevision, joint: int) -> go.Figure:
    """Draw the residual of each reading in σ over the angle of a joint (from 0)."""
    d = drawn(story, revision)
    name = f"joint {joint + 1} angle"
    angle = np.degrees(story.q[:, joint])
    return chart(d, angle[d.index], f"{name} [°]", over(revision, angle, name, "°"))


def residual_by_time(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw the residual of each reading in σ over the time; over its row where none is known."""
    d = drawn(story, revision)
    if story.time_s is None:
        rows = np.arange(len(story), dtype=float)
        says = over(revision, rows, "row order", "")
        return chart(d, rows[d.index], "row, in the order of the file", says)
    minutes = (story.time_s - story.time_s.min()) / 60
    says = over(revision, minutes, "time", "min")
    return chart(d, minutes[d.index], "time since the first reading [min]", says)


def worst_of(names: Sequence[str], sigma: Floats) -> list[tuple[str, float, int]]:
    """Return (name, rms σ, readings) of each name, the worst first."""
    found = {name: k for k, name in enumerate(dict.fromkeys(names))}
    which = np.array([found[name] for name in names])
    count = np.bincount(which)
    rms = np.sqrt(np.bincount(which, sigma**2) / count)
    rows = zip(found, rms.tolist(), count.tolist(), strict=True)
    return sorted(rows, key=lambda row: -row[1])


def _by(story: Story, revision: StoryRevision, what: str) -> str:
    names = story.load_names
    if what == "pose":
        names = tuple(story.pose_name(i) for i in range(len(story)))
    sigma = np.sqrt(revision.whitened_norm2 / 3)
    (name, rms, _), *rest = worst_of(names, sigma)
    name = "the unloaded readings" if name == UNLOADED else f"{what} {name}"
    if not rest:
        return f"All readings are of {name}: {rms:.2g} times the noise rms."
    return f"Worst is {name} with {rms:.2g} times the noise rms; best, {rest[-1][1]:.2g} times."


def over(revision: StoryRevision, x: Floats, name: str, unit: str) -> str:
    """Say how the residual differs between small and large values (N,) of a variable."""
    sigma = np.sqrt(revision.whitened_norm2 / 3)
    middle = np.median(x)
    low, high = x <= middle, x > middle
    if not high.any():
        return f"{name} is the same for all readings."
    a, b = (float(np.sqrt(np.mean(sigma[mine] ** 2))) for mine in (low, high))
    at = f"{middle:.0f}{unit if unit == '°' else f' {unit}'}".strip()
    return f"Residual over {name}: {a:.2g} times the noise rms up to {at}, {b:.2g} times beyond."


def chart(d: Drawn, x: Floats, title: str, words: str) -> go.Figure:
    """Draw residuals over x (K,); each point carries the number of its reading."""
    traces = [
        go.Scatter(
            x=style.drawn(x[mine]),
            y=style.drawn(d.sigma[mine]),
            mode="markers",
            name=LEVEL_NAMES[k],
            marker={"color": style.LEVELS[k], "symbol": style.SYMBOLS[k], "size": 6},
            text=d.named(mine),
            customdata=d.index[mine],
            hovertemplate="%{text}<extra></extra>",
        )
        for k, mine in d.by_level()
    ]
    out = style.figure(words + d.note, x=title, y="residual [σ]", traces=traces, height=320)
    for limit, color in zip(style.sigma_limits(), (style.AMBER, style.RED), strict=True):
        out.add_hline(limit, line={"color": color, "dash": "dot", "width": 1})
    out.update_yaxes(rangemode="tozero")
    return out
