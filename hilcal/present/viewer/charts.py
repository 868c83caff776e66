"""The charts of the viewer: errors of revisions, bars per pose, what the residual follows."""

import numpy as np
import rerun as rr

from hilcal.present.story import Curve, StoryRevision
from hilcal.present.viewer import style
from hilcal.present.viewer.digest import Digest
from hilcal.types import Floats, Ints

SERIES = (
    ("fit", "fitted poses, rms", style.MEASURED),
    ("holdout", "poses left out, rms", style.HOLDOUT),
    ("largest", "largest of all", style.RED),
    ("noise", "noise alone, rms", style.NOISE),
)
"""Of the errors of revisions: entity, name and colour."""
_BINS = 12
"""Of single readings over what they may follow, for their mean."""
_PARTS = ("mean", "law")


def error_series(rec: rr.RecordingStream) -> None:
    """Log what the series of errors are called, and how they look."""
    for entity, name, color in SERIES:
        line = rr.SeriesLines(names=[name], colors=[color], widths=[1.5])
        mark = rr.SeriesPoints(names=[name], colors=[color], markers=["circle"], marker_sizes=[4.0])
        rec.log(f"errors/{entity}", line, mark, static=True)


def revision_charts(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log one revision at the recording's current time."""
    sizes = (r.error_fit["rms_m"], r.error_holdout["rms_m"], r.error_fit["max_m"])
    for (entity, *_), size in zip(SERIES, (*sizes, d.story.noise_floor_m), strict=True):
        rec.log(f"errors/{entity}", rr.Scalars(1e6 * size))
    pose_bars(rec, d, r)
    curve_bars(rec, "follows", r.follows)
    if any(one.laws for one in d.story.revisions):
        curve_bars(rec, "law", r.laws[0] if r.laws else None)


def pose_charts(rec: rr.RecordingStream, d: Digest) -> None:
    """Send the bar of the current pose along `pose`, with the last revision."""
    sigma = np.sqrt(d.pose_norm2(d.story.revisions[-1]))
    starts, left, width = _bar_places(d)
    for k, height in enumerate(np.maximum.reduceat(sigma, starts)):
        rec.set_time("pose", sequence=int(d.poses[starts[k]]))
        one = slice(k, k + 1)
        bar = rr.BarChart([height], abscissa=left[one], widths=width[one], color=style.MEASURED)
        rec.log("bars/zcurrent", bar)  # the name puts it in front of the others
    rec.reset_time()


def pose_bars(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log the worst reading of each pose in σ, its Mahalanobis distance, one series per level.

    The tallest bar is the worst reading of all. A bar of several poses is that of the worst.
    """
    starts, left, width = _bar_places(d)
    norm2 = np.maximum.reduceat(d.pose_norm2(r), starts)
    height, level = np.sqrt(norm2), style.levels(norm2)
    for i, name in enumerate(style.LEVEL_NAMES):
        of = np.flatnonzero(level == i)
        some = of if len(of) else np.arange(1)
        rec.log(
            f"bars/{name}",
            rr.BarChart(
                height[some] if len(of) else [0.0],
                abscissa=left[some],
                widths=width[some],
                color=style.LEVEL_COLORS[i].tolist(),
            ),
        )


def _bar_places(d: Digest) -> tuple[Ints, Floats, Floats]:
    """First pose (index), left edge and width of every bar, in pose numbers."""
    starts = np.arange(0, len(d.poses), d.poses_per_bar)
    edges = np.append(d.poses[starts], d.poses[-1] + 1) - 0.5
    return starts, edges[:-1], np.diff(edges)


def curve_bars(rec: rr.RecordingStream, entity: str, c: Curve | None) -> None:
    """Log a curve as bars over its variable, and beside each that of the law, where it has one.

    Single readings are drawn by their mean in bins of equal count.
    """
    bars: dict[str, tuple[Floats, Floats]] = {}
    if c is not None and len(c.x):
        x, y = (c.x, c.y) if c.error is not None else _means(c)
        bars["mean"] = np.arange(float(len(x))) if c.names else x, y
        if c.line is not None:
            bars["law"] = x, np.interp(x, *c.line)
    for k, part in enumerate(_PARTS):
        if part not in bars:
            rec.log(f"{entity}/{part}", rr.Clear(recursive=False))
            continue
        x, y = bars[part]
        order = np.argsort(x, kind="stable")
        edges = _edges(x[order])
        width = np.diff(edges) / len(bars)
        chart = rr.BarChart(
            y[order],
            abscissa=edges[:-1] + k * width,
            widths=width,
            color=(style.MEASURED, style.NOISE)[k],
        )
        rec.log(f"{entity}/{part}", chart)


def _edges(x: Floats) -> Floats:
    """(K + 1,) of bins about growing centres (K,): half-way between them."""
    if len(x) == 1:
        return np.array([x[0] - 0.5, x[0] + 0.5])
    middle = 0.5 * (x[1:] + x[:-1])
    return np.concatenate([[2 * x[0] - middle[0]], middle, [2 * x[-1] - middle[-1]]])


def _means(c: Curve) -> tuple[Floats, Floats]:
    order = np.argsort(c.x, kind="stable")
    bins = np.array_split(order, min(_BINS, max(1, len(order) // 4)))
    return np.array([c.x[b].mean() for b in bins]), np.array([c.y[b].mean() for b in bins])
