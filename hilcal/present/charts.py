"""Charts of fits, diagnoses and stories, as pure functions of these values.

The colours are those of the viewer (Okabe and Ito's, safe for colour-blind readers), darkened or
lightened to a contrast of 3 : 1 on both backgrounds (WCAG 2.2, 1.4.11). No chart conveys anything
by colour alone.
"""

import html
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go
import scipy
from scipy.special import chdtri

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import LEAST_SHARE
from hilcal.identification.background import FamilySize
from hilcal.identification.carried.carried_prior import names_of
from hilcal.identification.fit import Fit
from hilcal.names import escaped
from hilcal.present.document import load_name
from hilcal.present.fit import beyond_chance, dependence_sentence
from hilcal.present.story import (
    LEVEL_NAMES,
    LIMITS,
    DependenceCurve,
    Story,
    StoryRevision,
    round_factor,
    worst_and_even,
)
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats, Ints

MEASURED = "#3a96d0"
NOISE = "#009e73"
HOLDOUT = "#cc79a7"
GREY = "#888b94"
AMBER = "#c07f00"
RED = "#e0325c"
LIGHT, DARK = "#ffffff", "#15171c"  # backgrounds
LEVELS = (GREY, AMBER, RED)
SYMBOLS = ("circle", "diamond", "x")  # of the levels, distinct without colours
CONFIG: dict[str, object] = {"displayModeBar": False, "responsive": True, "scrollZoom": False}
"""Options for plotly.js: no toolbar, and the wheel scrolls the page."""
_INK = {False: ("#24272e", "#d9dbe0"), True: ("#e4e5e9", "#3b3f48")}
MAX_POINTS = 1500  # points of a chart; a choice that limits a page to 8 MB
MOST_POSES, LONGEST_NAME = 16, 12  # poses that are all named at the axis; characters of a name
LONGEST, MOST_ARROWS = 0.25, 300  # drawn length of the largest residual, m; arrows of a level
MOST_VARIABLES, MOST_CORRELATED, MOST_FAMILIES = 12, 30, 16
RANGE, WIDEST, BINS = 5.0, 50.0, 40
"""Least and largest range of the histogram, σ; its outermost bins include all values beyond."""
_NICE = (1.0, 2.0, 5.0)


def template(dark: bool) -> go.layout.Template:
    """Return the style of charts on a light or dark page, with a transparent background."""
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
    description: str,
    x: str = "",
    y: str = "",
    height: int = 360,
    traces: Sequence[object] = (),
    **layout: object,
) -> go.Figure:
    """Return a figure in the light scheme, `height` CSS pixels high and as wide as the page.

    `description` is the sentence below the chart; `x` and `y` are titles of the axes, with units.
    """
    out = go.Figure(data=list(traces))
    out.update_layout(template=template(False), height=height, meta={"says": escaped(description)})
    out.update_layout(xaxis={"title": {"text": x}}, yaxis={"title": {"text": y}})
    out.update_layout(**layout)
    return out


def line(
    x: Floats, y: Floats, name: str = "", color: str = NOISE, dash: str = "solid"
) -> go.Scatter:
    """Return a line without hover text."""
    look = {"color": color, "width": 2, "dash": dash}
    options = {"name": name, "showlegend": bool(name), "hoverinfo": "skip"}
    return go.Scatter(
        x=single_precision(x), y=single_precision(y), mode="lines", line=look, **options
    )


def marks(
    x: object, y: object, color: str = MEASURED, symbol: str = "circle", size: int = 6, **more: Any
) -> go.Scatter:
    """Return points at numbers or names; `more` has further options of plotly, e.g. hover text."""
    x, y = (single_precision(v) if isinstance(v, np.ndarray) else v for v in (x, y))
    marker = {"color": color, "symbol": symbol, "size": size}
    return go.Scatter(**{"x": x, "y": y, "mode": "markers", "marker": marker, **more})


def bar(
    values: Sequence[float], names: Sequence[str], color: object, text: Sequence[str], **more: Any
) -> go.Bar:
    """Return horizontal bars, each with a text."""
    look = {"orientation": "h", "textposition": "auto", "marker": {"color": color}}
    return go.Bar(x=list(values), y=list(names), text=list(text), **look, **more)


def bars(
    names: Sequence[str],
    values: Sequence[float],
    hover: Sequence[str],
    description: str,
    x: str,
    colors: Sequence[str] | str = MEASURED,
) -> go.Figure:
    """Draw horizontal bars, the first on top, each with its value in two digits."""
    options = {"hovertext": [label(h) for h in hover], "hoverinfo": "text", "showlegend": False}
    formats = ((v, ".0f" if abs(v) >= 10 else ".2g") for v in values)
    text = ["0" if abs(v) < 0.005 else format(v, spec) for v, spec in formats]
    trace = bar(values, [label(n) for n in names], colors, text, **options)
    out = figure(description, x=x, traces=[trace], height=90 + 28 * len(names))
    out.update_yaxes(autorange="reversed")
    return out


def label(text: str) -> str:
    """Return a text escaped for plotly, which reads labels as HTML."""
    return html.escape(escaped(text), quote=False)


def in_scheme(chart: go.Figure, dark: bool) -> go.Figure:
    """Return a copy of a chart for a light or dark page."""
    return go.Figure(chart).update_layout(template=template(dark))


def empty(why: str) -> go.Figure:
    """Return an empty chart with a sentence that gives the reason."""
    note = {"text": why, "showarrow": False, "xref": "paper", "yref": "paper", "x": 0.5, "y": 0.5}
    hidden = {"visible": False}
    return figure(why, height=160, annotations=[note], xaxis=hidden, yaxis=hidden)


def single_precision(values: Floats) -> Floats:
    """Return numbers in single precision, which halves the size of pages."""
    return np.asarray(values, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class ChartReadings:
    """The readings of a revision that a chart draws; `index` (K,) in ascending order."""

    story: Story
    revision: StoryRevision
    index: Ints

    @property
    def note(self) -> str:
        """A sentence on the choice of readings; empty if all are drawn."""
        if len(self.index) == len(self.story):
            return ""
        worst = max(1, len(self.index) // 5)
        return (
            f" Of {len(self.story)} readings {len(self.index)} are drawn: the {worst} furthest off "
            "and an even choice of the others."
        )

    def by_level(self) -> Iterator[tuple[int, Ints]]:
        """Yield each occurring level with the positions of its readings in `index`."""
        level = self.revision.level[self.index]
        yield from ((int(k), np.flatnonzero(level == k)) for k in np.unique(level))

    def hover_texts(self, members: Ints | slice = slice(None)) -> list[str]:
        """Return the hover text of readings: pose, load, target if there are several, distance."""
        story, size, sigma = self.story, self.revision.size_m, self.revision.sigma
        out = []
        for i in self.index[members].tolist():
            name = f"{story.pose_name(i)}, {load_name(story.load_names[i])}"
            if story.target is not None and len(story.target_names) > 1:
                name += f", {story.target_names[int(story.target[i])]}"
            out.append(f"{label(name)}: {numbers.length(float(size[i]))}, {sigma[i]:.1f} σ")
        return out

    def marks(self, x: Floats, y: Floats, level: int, members: Ints, **more: Any) -> go.Scatter:
        """Return the members of a level as points at x, y (K,)."""
        points = x[members], y[members], LEVELS[level], SYMBOLS[level]
        more |= {"name": LEVEL_NAMES[level], "text": self.hover_texts(members)}
        return marks(*points, **more, hovertemplate="%{text}<extra></extra>")


def chart_readings(
    story: Story, revision: StoryRevision, max_points: int = MAX_POINTS
) -> ChartReadings:
    """Choose at most `max_points` readings to draw."""
    return ChartReadings(story, revision, worst_and_even(revision.whitened_norm2, max_points))


def sigma_limits(elements: int) -> list[float]:
    """Return the Mahalanobis distances above which a reading is doubtful, and outside."""
    return [float(v) for v in np.sqrt(chdtri(elements, 1.0 - np.array(LIMITS)))]


def residual_by_pose(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw the residual of each reading in σ over its pose, poses by number."""
    d, full = chart_readings(story, revision), [story.pose_name(int(i)) for i in story.first]
    out = _residuals(d, story.row[d.index].astype(float), "", _extremes(story, revision, "pose"))
    names, step = [_tick(n) for n in full], -(-len(full) // MOST_POSES)
    return out.update_xaxes(tickvals=list(range(0, len(names), step)), ticktext=names[::step])


def residual_by_load(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw the residual of each reading in σ over its load."""
    d = chart_readings(story, revision)
    loads = list(dict.fromkeys(story.load_names))
    position = np.array([loads.index(name) for name in story.load_names], dtype=float)
    # scattered within a load, so that points do not hide each other
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(position))
    out = _residuals(d, (position + jitter)[d.index], "load", _extremes(story, revision, "load"))
    names = [_tick(load_name(name)) for name in loads]
    return out.update_xaxes(tickvals=list(range(len(names))), ticktext=names)


def residual_over(
    story: Story, revision: StoryRevision, values: Floats, name: str, unit: str
) -> go.Figure:
    """Draw residuals in σ over values (N,) in a display unit; NaN: unknown."""
    d = chart_readings(story, revision)
    finite = np.isfinite(values)
    x = np.where(finite, values, np.median(values[finite]) if finite.any() else 0.0)
    high = x > np.median(x)
    says = f"{name} is the same for all readings."
    if high.any():
        share = revision.whitened_norm2 / revision.elements
        low, beyond = (np.sqrt(np.mean(share[members])) for members in (~high, high))
        middle = float(np.median(x))
        median = f"{middle:z.{int(abs(middle) < 10)}f}{unit if unit == '°' else f' {unit}'}".strip()
        says = (
            f"Residual over {name}: {numbers.digits(low, 2)} times the noise rms up to {median}, "
            f"{numbers.digits(beyond, 2)} times beyond."
        )
    return _residuals(d, values[d.index], f"{name} [{unit}]" if unit else name, says)


def residual_by_joint(story: Story, revision: StoryRevision, joint: int) -> go.Figure:
    """Draw the residual of each reading in σ over the angle, or travel, of a joint (from 0)."""
    unit, factor = numbers.joint_unit(story.arm.unit(joint))
    name = f"joint {joint + 1} {story.arm.kind(joint)}"
    return residual_over(story, revision, factor * story.q[:, joint], name, unit)


def residual_by_time(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw the residual of each reading in σ over time; over its row if no times are known."""
    if story.time_s is None:
        rows = np.arange(len(story), dtype=float)
        return residual_over(story, revision, rows, "row, in the order of the file", "")
    unit, factor = numbers.time_unit(float(np.ptp(story.time_s)))
    time = factor * (story.time_s - story.time_s.min())
    return residual_over(story, revision, time, "time since the first reading", unit)


def _extremes(story: Story, revision: StoryRevision, group: str) -> str:
    poses = [story.pose_name(i) for i in range(len(story))]
    of = np.array(poses if group == "pose" else story.load_names)[story.fitted]
    names, row = np.unique(of, return_inverse=True)
    share = (revision.whitened_norm2 / revision.elements)[story.fitted]
    rms = np.sqrt(np.bincount(row, share) / np.bincount(row))
    worst = names[int(np.argmax(rms))]
    most, least = numbers.digits(rms.max(), 2), numbers.digits(rms.min(), 2)
    name = "the unloaded readings" if worst == UNLOADED else f"{group} {worst}"
    if len(names) == 1:
        return f"All readings are of {name}: {most} times the noise rms."
    return f"Worst is {name} with {most} times the noise rms; best, {least} times."


def _tick(name: str) -> str:
    """Return a name for an axis; of a long one the end, where names differ most."""
    return label(name if len(name) <= LONGEST_NAME else f"…{name[1 - LONGEST_NAME :]}")


def _residuals(d: ChartReadings, x: Floats, title: str, sentence: str) -> go.Figure:
    """Draw residuals over x (K,); `customdata` of each point is the number of its reading."""
    y = d.revision.sigma[d.index]
    traces = [d.marks(x, y, k, rows, customdata=d.index[rows]) for k, rows in d.by_level()]
    out = figure(sentence + d.note, x=title, y="residual [σ]", traces=traces, height=320)
    limits = sigma_limits(int(np.max(d.revision.elements)))
    for limit, color in zip(limits, (AMBER, RED), strict=True):
        out.add_hline(limit, line={"color": color, "dash": "dot", "width": 1})
    return out.update_yaxes(rangemode="tozero")


def measured_predicted(story: Story, revision: StoryRevision) -> go.Figure:
    """Draw measured over predicted deviations from the nominal arm, along the base axes."""
    d = chart_readings(story, revision, max_points=500)  # three points each
    x, y = (1e6 * story.deviation(v) for v in (revision.predicted, story.measured))
    ends = np.array([min(x.min(), y.min()), max(x.max(), y.max())])
    traces: list[object] = [line(ends, ends, "exact", dash="dash")]
    colors, text = (MEASURED, HOLDOUT, AMBER), d.hover_texts()
    for k, (axis, color) in enumerate(zip("xyz", colors, strict=True)):
        values = "measured %{y:.1f} µm, predicted %{x:.1f} µm<extra></extra>"
        hover = f"%{{text}}<br>{axis}: {values}"
        points = (x[d.index, k], y[d.index, k], color, SYMBOLS[k])
        traces.append(marks(*points, name=f"base {axis}", text=text, hovertemplate=hover))
    measure = "deflection" if story.mode == "deflection" else "deviation from the nominal arm"
    predicted, measured = x[story.fitted], y[story.fitted]
    total = np.sum((measured - measured.mean(axis=0)) ** 2)
    share = 100 * (1 - np.sum((measured - predicted) ** 2) / total) if total > 0 else 0.0
    part = f"{share:.1f} %" if share > 0 else "none"
    says = (
        f"Measured against predicted {measure}: the model accounts for {part} of what was "
        f"measured.{d.note}"
    )
    x_title, y_title = (f"{v} {measure.split()[0]} [µm]" for v in ("predicted", "measured"))
    return figure(says, x=x_title, y=y_title, traces=traces, height=420)


def workspace(
    story: Story, revision: StoryRevision, plane: Literal["xy", "xz"] = "xy"
) -> go.Figure:
    """Draw target and residual of each reading, by level; "xy" is the view from above."""
    d = chart_readings(story, revision, max_points=1000)
    axes = ["xyz".index(a) for a in plane]
    target, residual = story.anchor[d.index][:, axes], revision.residual[d.index][:, axes]
    largest = float(revision.size_m.max(initial=0.0))
    times = round_factor(LONGEST / largest, _NICE) if largest > 0 else 1.0
    traces: list[object] = []
    for k, members in d.by_level():
        worst = members[np.argsort(-revision.sigma[d.index[members]])][:MOST_ARROWS]
        start, end = target[worst], target[worst] + times * residual[worst]
        gap = np.full_like(start, np.nan)  # between one line and the next
        lines = np.stack([start, end, gap], axis=1).reshape(-1, 2)
        traces.append(line(lines[:, 0], lines[:, 1], color=LEVELS[k]))
        traces.append(d.marks(target[:, 0], target[:, 1], k, members, size=5, showlegend=False))
    outside = int((revision.level == len(LEVELS) - 1).sum())
    says = "The same readings from the side."
    if plane == "xy":
        says = (
            f"Targets with their errors, {times:g} times enlarged: {outside} of {len(story)} "
            "readings are outside the noise (crosses, red); the largest error is "
            f"{numbers.length(largest)}.{d.note}"
        )
    x, y = (f"base {a} [m]" for a in plane)
    out = figure(says, x=x, y=y, traces=traces, height=280)
    out.update_yaxes(scaleanchor="x", constrain="domain")
    return out.update_xaxes(constrain="domain")


def added_variable(r: DependenceCurve, effect: str) -> go.Figure:
    """Draw the added-variable plot of an effect; its slope is 1 if the effect is the right one."""
    rows = worst_and_even(np.abs(r.y), MAX_POINTS)
    ends = np.array([r.x.min(), r.x.max()])
    slope = float(r.x @ r.y / max(float(r.x @ r.x), 1e-300))
    hover = "would explain %{x:.1f}, residual %{y:.1f}<extra></extra>"
    traces = [
        marks(r.x[rows], r.y[rows], name="readings", size=5, hovertemplate=hover),
        line(ends, ends, "if the effect is right: slope 1", dash="dash"),
        line(ends, slope * ends, f"found: slope {slope:.2f}", RED),
    ]
    note = "" if len(rows) == len(r.x) else f" Of {len(r.x)} points {len(rows)} are drawn."
    says = (
        f"Residual against what {effect} would explain: slope {slope:.2f}; 1: the effect is right, "
        f"0: it explains nothing.{note}"
    )
    return figure(says, x="it would explain [µm]", y=r.y_label, traces=traces, height=340)


def misfit_shares(d: Diagnosis) -> go.Figure:
    """Draw the share of the misfit that each recorded variable explains, the largest on top."""
    rows = [v for v in d.misfit_breakdown if v.share >= LEAST_SHARE][:MOST_VARIABLES]
    if not rows:
        return empty("The misfit follows no recorded variable.")
    shares, names = [100 * v.share for v in rows], [v.variable for v in rows]
    hover = [f"{v.variable}: {100 * v.share:.0f} %, {numbers.p_equals(v.p_value)}" for v in rows]
    clear = beyond_chance(d.misfit_breakdown)
    colors = [MEASURED if v in clear else GREY for v in rows]
    says = f"{dependence_sentence(d.misfit_breakdown)} Grey bars are within chance."
    return bars(names, shares, hover, says, "share of the misfit [%]", colors)


def curve_chart(c: DependenceCurve) -> go.Figure:
    """Draw means over a variable with their standard uncertainties, and the law if there is one."""
    points = marks(
        [label(n) for n in c.names] if c.names else c.x,
        c.y,
        size=8,
        error_y={"type": "data", "array": c.error, "color": GREY},
        mode="markers" if c.names or c.line is not None else "lines+markers",
        line={"color": MEASURED},
        name="readings, mean ± standard uncertainty",
        hovertemplate="%{x}: %{y:.3g} ± %{error_y.array:.2g}<extra></extra>",
        showlegend=c.line is not None,
    )
    says = f"{c.y_label} over {c.x_label}, from {c.y.min():.3g} to {c.y.max():.3g}; {c.description}"
    traces = [points] if c.line is None else [line(c.line[0], c.line[1], "law"), points]
    x, y = label(c.x_label), label(c.y_label)
    return figure(says, x=x, y=y, traces=traces, height=320)


def parameter_correlations(fit: Fit) -> tuple[list[str], Floats]:
    """Return names and correlations (K, K) of identifiable parameters: Cov(θ) = T H⁻¹ Tᵀ."""
    s = fit.solution
    covariance = s.transform @ s.equations.inverse(s.beta) @ s.transform.T
    names = names_of(fit.model)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    keep = np.flatnonzero(fit.uncertainty.identifiable & s.estimated & (std > 0))
    correlation = covariance[np.ix_(keep, keep)] / np.outer(std[keep], std[keep])
    return [names[k] for k in keep], np.clip(correlation, -1.0, 1.0)


def correlations(fit: Fit) -> go.Figure:
    """Draw the correlations of the identifiable parameters; of many, the most correlated ones."""
    names, rho = parameter_correlations(fit)
    if len(names) < 2:
        return empty("Fewer than two parameters are identifiable: nothing is correlated.")
    off_diagonal = np.abs(rho - np.diag(np.diag(rho)))
    i, j = np.unravel_index(int(np.argmax(off_diagonal)), off_diagonal.shape)
    says = (
        f"The strongest correlation is {rho[i, j]:+.2f}, of {names[i]} and {names[j]}; columns are "
        "in the order of the rows."
    )
    some: Ints = np.sort(np.argsort(-off_diagonal.max(axis=1), kind="stable")[:MOST_CORRELATED])
    if len(some) < len(names):
        says += f" The {len(some)} most correlated of {len(names)} parameters are drawn."
    shown = [label(names[k]) for k in some]
    trace = go.Heatmap(
        z=single_precision(rho[np.ix_(some, some)]),
        y=shown,
        hovertext=[[f"{a}<br>{b}" for a in shown] for b in shown],
        zmin=-1,
        zmax=1,
        colorscale=[[0, RED], [0.5, "rgba(136,139,148,0.08)"], [1, MEASURED]],
        hovertemplate="%{hovertext}<br>%{z:+.2f}<extra></extra>",
        colorbar={"title": {"text": "correlation"}, "thickness": 12},
    )
    out = figure(says, traces=[trace], height=100 + 16 * len(some))
    out.update_yaxes(autorange="reversed", tickfont={"size": 10})
    return out.update_xaxes(showticklabels=False)


def noise_check(fit: Fit) -> go.Figure:
    """Draw the histogram of the whitened residual and its expected density, N(0, 1 − p/n)."""
    white = fit.white.reshape(len(fit.raw), -1)
    read = np.isfinite(white)  # of a distance or height the first element alone
    read[fit.readings[~fit.outlier].scalar[fit.whitening.reading], 1:] = False
    white = white[read]
    reach = float(np.clip(np.ceil(np.quantile(np.abs(white), 0.995)), RANGE, WIDEST))
    edges, width = np.linspace(-reach, reach, BINS + 1, retstep=True)
    counts, _ = np.histogram(np.clip(white, -reach + 1e-9, reach - 1e-9), edges)
    expected = np.sqrt(min(fit.dof / max(len(white), 1), 1.0))
    fine = np.linspace(-reach, reach, 401)
    density = len(white) * width * scipy.stats.norm.pdf(fine, scale=max(expected, 1e-9))
    look = {"width": 0.9 * width, "name": "measured", "marker": {"color": MEASURED}}
    hover = "%{x:.2f} σ: %{y} elements<extra></extra>"
    traces = [
        go.Bar(x=0.5 * (edges[1:] + edges[:-1]), y=counts, hovertemplate=hover, **look),
        line(fine, density, "the stated noise"),
    ]
    factor, (low, high) = fit.variance_factor, fit.variance_factor_interval
    fits = f"the residual is {'larger' if factor > 1 else 'smaller'} than the stated noise"
    fits = "the stated noise explains the residual" if low <= 1 <= high else fits
    beyond = int(np.sum(np.abs(white) > RANGE))
    says = (
        f"Variance factor {factor:.2f}, 95 % interval {low:.2f} to {high:.2f}: {fits}. "
        f"{beyond} of {len(white)} elements are beyond {RANGE:.0f} σ."
    )
    titles = {"x": "whitened residual [σ]", "y": "number of elements"}
    return figure(says, **titles, traces=traces, height=320)


def error_per_revision(story: Story) -> go.Figure:
    """Draw the rms error of each revision, the first on top, and the error by noise alone."""
    steps = story.revisions
    changes = [(r.change if k else "") or "start" for k, r in enumerate(steps)]
    names = [label(f"{r.revision}: {c}") for r, c in zip(steps, changes, strict=True)]
    traces: list[object] = []
    for errors, name, color in (
        ([r.error for r in steps], "fitted poses", MEASURED),
        ([r.holdout for r in steps], "poses left out", HOLDOUT),
    ):
        rms = [1e6 * e.rms_m for e in errors]
        hover = "%{y}: %{text} µm, " + name + "<extra></extra>"
        text = [numbers.digits(v) for v in rms]
        traces.append(bar(rms, names, color, text, name=name, hovertemplate=hover))
    floor, first, last = 1e6 * story.noise_floor_m, steps[0], steps[-1]
    holdout, fitted = (
        [numbers.length(e.rms_m) for e in errors]
        for errors in ((first.holdout, last.holdout), (first.error, last.error))
    )
    says = f"One revision: {holdout[0]} rms error on poses left out"
    if len(steps) > 1:
        says = (
            f"The rms error {'fell' if last.holdout.rms_m < first.holdout.rms_m else 'went'} from "
            f"{' to '.join(holdout)} on poses left out, and from {' to '.join(fitted)} on the "
            f"fitted ones, over {len(steps)} revisions"
        )
    says += f"; noise alone would leave {numbers.length(story.noise_floor_m)}."
    out = figure(says, x="error, rms [µm]", traces=traces, height=150 + 36 * len(names))
    dashed = {"color": NOISE, "dash": "dash", "width": 2}
    out.add_vline(floor, line=dashed, layer="below")
    # for the legend alone: a shape has no entry there
    named = {"name": f"noise alone, {numbers.digits(floor)} µm", "mode": "lines", "line": dashed}
    out.add_trace(go.Scatter(x=[None], y=[names[0]], hoverinfo="skip", **named))
    out.update_yaxes(autorange="reversed")
    return out.update_xaxes(rangemode="tozero")


def family_sizes(sizes: Sequence[FamilySize]) -> go.Figure:
    """Draw the size of each family, relative to an ordinary arm, with its 95 % interval."""
    shown, first = sizes[:MOST_FAMILIES], sizes[0]
    traces = []
    for named, group, color, symbol in (
        (True, "named", MEASURED, "circle"),
        (False, "predicted with, not named", GREY, "diamond"),
    ):
        if not (members := [s for s in shown if s.named == named]):
            continue
        low, std, high = np.array([(s.low, s.std, s.high) for s in members]).T
        low, std, high = (v / [s.ordinary for s in members] for v in (low, std, high))
        error = {"type": "data", "symmetric": False, "array": high - std, "arrayminus": std - low}
        hover = {"hovertext": [label(_size(s)) for s in members], "hoverinfo": "text"}
        names, error_x = [label(s.name) for s in members], {**error, "color": color}
        traces.append(marks(std, names, color, symbol, 9, name=group, error_x=error_x, **hover))
    says = (
        f"{first.name} moves the target most, by {numbers.length(first.moves_m)} rms. Sizes are "
        "standard deviations of the parameters, with 95 % intervals; 1 is an ordinary arm, and "
        "[k] of waves are those from 2^k times a turn on."
    )
    if len(shown) < len(sizes):
        says += f" The {len(shown)} of {len(sizes)} families are drawn that move the target most."
    ordinary = {"type": "line", "x0": 1, "x1": 1, "y0": 0, "y1": 1, "yref": "paper"}
    order = [label(s.name) for s in reversed(shown)]
    return figure(
        says,
        height=130 + 22 * len(shown),
        traces=traces,
        # 1, 2 and 5 of each decade
        xaxis={
            "type": "log",
            "dtick": "D2",
            "title": {"text": "size relative to that of an ordinary arm"},
        },
        yaxis={"categoryorder": "array", "categoryarray": order, "title": {"text": ""}},
        shapes=[{**ordinary, "line": {"color": NOISE, "width": 1, "dash": "dash"}}],
    )


def _size(s: FamilySize) -> str:
    low, std, high = (numbers.sizes([(s.unit, v)]) for v in (s.low, s.std, s.high))
    return f"{s.name}: {std} ({low} to {high}), moves the target by {numbers.length(s.moves_m)} rms"
