"""Charts of readings: residuals in σ over any variable, measured against predicted, in space."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import plotly.graph_objects as go

from hilcal import numbers
from hilcal.present.charts import style
from hilcal.present.document import load_name
from hilcal.present.story import LEVEL_NAMES, Story, StoryRevision, worst_and_even
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

MOST = 1500
"""Readings that a chart draws; a choice by the size of the page, 8 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class ChartReadings:
    """The readings that a chart draws of a revision of a story: `index` (K,), growing."""

    story: Story
    revision: StoryRevision
    index: Ints

    @property
    def sigma(self) -> Floats:
        """(K,) Mahalanobis distance, σ."""
        return self.revision.sigma[self.index]

    @property
    def note(self) -> str:
        """What is said where not all readings are drawn; else empty."""
        if len(self.index) == len(self.story):
            return ""
        worst = max(1, len(self.index) // 5)
        return (
            f" Of {len(self.story)} readings {len(self.index)} are drawn: the {worst} furthest off "
            "and an even choice of the others."
        )

    def by_level(self) -> Iterator[tuple[int, Bools]]:
        """Yield each level that occurs with its members (K,)."""
        level = self.revision.level[self.index]
        for k in range(len(style.LEVELS)):
            mine = level == k
            if mine.any():
                yield k, mine

    def named(self, mine: Bools | None = None) -> list[str]:
        """Return some, or all, in words: pose, load, size and distance."""
        size, sigma = self.revision.size_m, self.revision.sigma
        return [
            f"{place(self.story, i)}: {numbers.length(float(size[i]))}, {sigma[i]:.1f} σ"
            for i in (self.index if mine is None else self.index[mine]).tolist()
        ]


def drawn(story: Story, revision: StoryRevision, most: int = MOST) -> ChartReadings:
    """Choose at most `most` readings."""
    return ChartReadings(story, revision, worst_and_even(revision.whitened_norm2, most))


def place(story: Story, i: int) -> str:
    """Return pose and load of a reading, and its target where there are several."""
    words = f"{story.pose_name(i)}, {load_name(story.load_names[i])}"
    if story.target is not None and len(story.target_names) > 1:
        words += f", {story.target_names[int(story.target[i])]}"
    return style.label(words)


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
    names = [style.label(n) for n in short]
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
    names = [style.label(load_name(name)) for name in loads]
    out.update_xaxes(tickvals=list(range(len(names))), ticktext=names)
    return out


def residual_over(
    story: Story, revision: StoryRevision, values: Floats, name: str, unit: str
) -> go.Figure:
    """Draw the residual of each reading in σ over a variable.

    `values` (N,) are in units for people, NaN where not known; `unit` is "" for a pure number.
    """
    d = drawn(story, revision)
    known = np.isfinite(values)
    middle = np.where(known, values, np.median(values[known]) if known.any() else 0.0)
    says = over(revision, middle, name, unit)
    return chart(d, values[d.index], f"{name} [{unit}]" if unit else name, says)


def residual_by_joint(story: Story, revision: StoryRevision, joint: int) -> go.Figure:
    """Draw the residual of each reading in σ over the angle, or travel, of a joint (from 0)."""
    unit, factor = numbers.of_joint(story.arm.unit(joint))
    name = f"joint {joint + 1} {story.arm.kind(joint)}"
    return residual_over(story, revision, factor * story.q[:, joint], name, unit)


def residual_by_time(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw the residual of each reading in σ over the time; over its row where none is known."""
    if story.time_s is None:
        rows = np.arange(len(story), dtype=float)
        return residual_over(story, revision, rows, "row, in the order of the file", "")
    minutes = (story.time_s - story.time_s.min()) / 60
    return residual_over(story, revision, minutes, "time since the first reading", "min")


def worst_of(names: Sequence[str], sigma: Floats) -> list[tuple[str, float]]:
    """Return (name, rms σ) of each name, the worst first."""
    found, which = np.unique(names, return_inverse=True)
    rms = np.sqrt(np.bincount(which, sigma**2) / np.bincount(which))
    return sorted(zip(found.tolist(), rms.tolist(), strict=True), key=lambda row: -row[1])


def _by(story: Story, revision: StoryRevision, what: str) -> str:
    names: Sequence[str] = story.load_names
    if what == "pose":
        names = [story.pose_name(i) for i in range(len(story))]
    (name, rms), *rest = worst_of(names, revision.sigma / 3**0.5)
    name = "the unloaded readings" if name == UNLOADED else f"{what} {name}"
    if not rest:
        return f"All readings are of {name}: {rms:.2g} times the noise rms."
    return f"Worst is {name} with {rms:.2g} times the noise rms; best, {rest[-1][1]:.2g} times."


def over(revision: StoryRevision, x: Floats, name: str, unit: str) -> str:
    """Say how the residual differs between small and large values (N,) of a variable."""
    sigma = revision.sigma / 3**0.5
    middle = np.median(x)
    low, high = x <= middle, x > middle
    if not high.any():
        return f"{name} is the same for all readings."
    a, b = (float(np.sqrt(np.mean(sigma[mine] ** 2))) for mine in (low, high))
    at = f"{middle:.0f}{unit if unit == '°' else f' {unit}'}".strip()
    return f"Residual over {name}: {a:.2g} times the noise rms up to {at}, {b:.2g} times beyond."


def chart(d: ChartReadings, x: Floats, title: str, words: str) -> go.Figure:
    """Draw residuals over x (K,); each point carries the number of its reading."""
    traces = [
        style.marks(
            x[mine],
            d.sigma[mine],
            *(style.LEVELS[k], style.SYMBOLS[k]),
            name=LEVEL_NAMES[k],
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


def measured_predicted(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw what was measured over what is predicted, along the three base axes.

    Deflections are drawn as they are; of absolute readings the deviation from the nominal arm.
    Points on the diagonal are predicted exactly.
    """
    d = drawn(story, revision, most=500)  # three points each
    offset = story.anchor if story.mode == "absolute" else np.zeros_like(story.anchor)
    y = 1e6 * (story.measured - offset)
    x = 1e6 * (revision.predicted - offset)
    ends = np.array([min(x.min(), y.min()), max(x.max(), y.max())])
    traces: list[object] = [style.line(ends, ends, "exact", dash="dash")]
    colors = (style.MEASURED, style.HOLDOUT, style.AMBER)
    for k, (axis, color) in enumerate(zip("xyz", colors, strict=True)):
        told = (
            f"%{{text}}<br>{axis}: measured %{{y:.1f}} µm, predicted %{{x:.1f}} µm<extra></extra>"
        )
        at, text = (x[d.index, k], y[d.index, k], color, style.SYMBOLS[k]), d.named()
        traces.append(style.marks(*at, name=f"base {axis}", text=text, hovertemplate=told))
    what = "deflection" if story.mode == "deflection" else "deviation from the nominal arm"
    total = np.sum((y - y.mean(axis=0)) ** 2)
    left = np.sum((y - x) ** 2)
    share = 100 * (1 - left / total) if total > 0 else 0.0
    says = (
        f"Measured against predicted {what}: the model accounts for {share:.1f} % of what was "
        f"measured.{d.note}"
    )
    short = what.split(" ")[0]
    titles = {"x": f"predicted {short} [µm]", "y": f"measured {short} [µm]"}
    return style.figure(says, **titles, traces=traces, height=420)


LONGEST = 0.25
"""Length of the largest residual as drawn, m; a choice."""
MOST_ARROWS = 300
_NICE = (1.0, 2.0, 5.0)


def workspace(
    story: Story, revision: StoryRevision, plane: Literal["xy", "xz"] = "xy"
) -> go.Figure:
    """Draw the target of each reading in base axes, marked by its level, with its residual.

    `plane` is of the base's axes; "xy" is seen from above.
    """
    d = drawn(story, revision, most=1000)
    axes = ["xyz".index(a) for a in plane]
    at, residual = story.anchor[d.index][:, axes], revision.residual[d.index][:, axes]
    largest = float(revision.size_m.max(initial=0.0))
    times = magnification(largest)
    traces: list[object] = []
    for k, mine in d.by_level():
        worst = np.flatnonzero(mine)[np.argsort(-d.sigma[mine])][:MOST_ARROWS]
        start, end = at[worst], at[worst] + times * residual[worst]
        gap = np.full_like(start, np.nan)  # between one line and the next
        lines = np.stack([start, end, gap], axis=1).reshape(-1, 2)
        traces.append(style.line(lines[:, 0], lines[:, 1], color=style.LEVELS[k]))
        traces.append(
            style.marks(
                *(at[mine, 0], at[mine, 1], style.LEVELS[k], style.SYMBOLS[k], 5),
                name=LEVEL_NAMES[k],
                showlegend=False,
                text=d.named(mine),
                hovertemplate="%{text}<extra></extra>",
            )
        )
    outside = int((revision.level == len(style.LEVELS) - 1).sum())
    says = (
        f"Targets with their errors, {times:g} times enlarged: {outside} of {len(story)} readings "
        f"are outside the noise (crosses, red); the largest error is "
        f"{numbers.length(largest)}.{d.note}"
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
