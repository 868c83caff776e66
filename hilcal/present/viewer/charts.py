"""The flat views: bars per pose, error per revision, residual, parameters."""

import numpy as np
import rerun as rr

from hilcal.present.story import StoryParameter, StoryRevision
from hilcal.present.viewer import style
from hilcal.present.viewer.digest import Digest
from hilcal.present.viewer.errors import error_now
from hilcal.present.viewer.flat import BELOW, FOOT, HEIGHT, RAISED, WIDTH, nothing, write
from hilcal.present.viewer.residuals import law_chart, residual_chart
from hilcal.types import Floats, Ints

_FOREST_SIGMAS = 10.0
_FOREST_ROWS = 10


def revision_charts(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log one revision at the recording's current time."""
    error_now(rec, d, r)
    pose_bars(rec, d, r)
    residual_chart(rec, d, r)
    parameter_chart(rec, r)
    if any(one.laws for one in d.story.revisions):
        law_chart(rec, r)


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


def parameter_chart(rec: rr.RecordingStream, r: StoryRevision) -> None:
    """Log each parameter as its value in units of its standard uncertainty, with ±2 σ."""
    known = [p for p in r.parameters if p.identifiable and p.value is not None and p.std]
    if not known:
        write(rec, "parameters/labels", [(WIDTH / 2, HEIGHT / 2)], ["no identifiable parameter"])
        for part in ("points", "whiskers", "axes"):
            rec.log(f"parameters/{part}", rr.Points2D([]) if part == "points" else nothing())
        return
    t = np.array([float(p.value or 0.0) / float(p.std or 1.0) for p in known])
    strongest = np.sort(np.argsort(-np.abs(t), kind="stable")[:_FOREST_ROWS])
    t = t[strongest]
    left = 0.42 * WIDTH
    row = (np.arange(len(t)) + 0.5) * HEIGHT / max(len(t), 6)

    def at(sigmas: Floats) -> Floats:
        bent = np.arcsinh(sigmas / 2) / np.arcsinh(max(_FOREST_SIGMAS, np.abs(t).max() + 2) / 2)
        return np.asarray(left + (WIDTH - left) * (bent + 1) / 2)

    significant = np.abs(t) > 2
    colors = np.where(significant[:, None], style.MEASURED, style.GREY).astype(np.uint8)
    rec.log(
        "parameters/points",
        rr.Points2D(np.stack([at(t), row], 1), colors=colors, radii=rr.Radius.ui_points(4.0)),
    )
    ends = np.stack([np.stack([at(t - 2), row], 1), np.stack([at(t + 2), row], 1)], 1)
    rec.log(
        "parameters/whiskers",
        rr.LineStrips2D(list(ends), colors=colors, radii=rr.Radius.ui_points(1.5)),
    )
    ticks = np.array([s for s in (-1000, -100, -10, -2, 0, 2, 10, 100, 1000)], dtype=float)
    ticks = ticks[(at(ticks) >= left) & (at(ticks) <= WIDTH)]
    lines = [[(a, 0), (a, HEIGHT)] for a in at(ticks)]
    rec.log(
        "parameters/axes",
        rr.LineStrips2D(lines, colors=[(90, 92, 100)], radii=rr.Radius.ui_points(0.6)),
    )
    names = [_in_words(known[i]) for i in strongest]
    few = f"; the {len(t)} strongest of {len(known)}" if len(t) < len(known) else ""
    places = [(0.38 * left, y + RAISED) for y in row] + [(a, FOOT) for a in at(ticks)]
    places += [(WIDTH / 2, BELOW)]
    words = [*names, *(f"{s:g}" for s in ticks), f"value in units of its standard uncertainty{few}"]
    write(rec, "parameters/labels", places, words)


def _in_words(p: StoryParameter) -> str:
    value, _, unit = style.quantity(float(p.value or 0), p.std, p.unit)
    return f"{p.name} = {value} {unit}"
