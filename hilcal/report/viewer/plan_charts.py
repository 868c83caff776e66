"""The flat view of what is read when, and what all flat views of a plan are drawn with."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from hilcal.report.viewer import plan_style, style
from hilcal.report.viewer.plan_digest import PlanDigest
from hilcal.types import Floats

WIDTH, HEIGHT = 220.0, 80.0  # of the flat pictures, their own units; y points down
LONG = 500.0  # width of the schedule
LINE: style.Color = (90, 92, 100)
_TICKS = (1.0, 2.0, 5.0)
Place = tuple[float, float]


def step_charts(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Send the present step's place in the schedule, as columns on `step`."""
    x = _minutes(d)
    lines = np.stack([np.stack([x, 0 * x], 1), np.stack([x, 0 * x + HEIGHT], 1)], 1)
    rec.send_columns(
        "schedule/now",
        indexes=[rr.TimeColumn("step", sequence=d.numbers)],
        columns=rr.LineStrips2D.columns(
            strips=list(lines),
            colors=np.tile(np.array(style.PREDICTED, dtype=np.uint8), (len(d), 1)),
        ),
    )


def schedule(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Log a dot per reading: its load is its row, its minute its place."""
    colors = plan_style.load_colors(d.loads)
    x, y = _minutes(d), row(d.load, len(d.loads))
    rec.log(
        "schedule/readings",
        rr.Points2D(
            np.stack([x, y], 1), colors=colors[d.load], radii=rr.Radius.ui_points(_dot(len(d)))
        ),
        static=True,
    )
    lost = np.flatnonzero(d.unseen)
    rec.log(
        "schedule/unseen",
        rr.Boxes2D(
            centers=np.stack([x[lost], y[lost]], 1),
            half_sizes=np.full((len(lost), 2), 3.0),
            colors=plan_style.sight_colors(d.sight[lost]),
            radii=rr.Radius.ui_points(1.0),
        ),
        static=True,
    )
    rows = row(np.arange(len(d.loads)), len(d.loads))
    rec.log(
        "schedule/rows",
        rr.LineStrips2D(
            [[(0.0, r), (LONG, r)] for r in rows],
            colors=[(*LINE, 110)],
            radii=rr.Radius.ui_points(0.5),
            draw_order=-5.0,
        ),
        static=True,
    )
    words = [
        f"{plan_style.load_words(name)}: {int((d.load == k).sum())}"
        for k, name in enumerate(d.loads)
    ]
    write(rec, "schedule/loads", [(-0.08 * LONG, r - 6.0) for r in rows], words)
    last = float(d.time[-1]) / 60.0
    marks = ticks(last, 8)
    places = [(LONG * t / _end(d), HEIGHT + 1.0) for t in marks]
    write(rec, "schedule/minutes", places, [f"{t:g} min" for t in marks])


def _end(d: PlanDigest) -> float:
    """Return the end of the schedule's axis, min."""
    return max(1.02 * float(d.time[-1]) / 60.0, 1e-9)


def _minutes(d: PlanDigest) -> Floats:
    return np.asarray(LONG * d.time / 60.0 / _end(d))


def row(index: object, count: int) -> Floats:
    """Return the heights of rows by their numbers."""
    return np.asarray((np.asarray(index, dtype=float) + 0.5) * HEIGHT / max(count, 3))


def _dot(count: int) -> float:
    return 3.0 if count <= 150 else 2.0


def ticks(top: float, most: int) -> list[float]:
    """Return multiples of 1, 2 or 5 times a power of ten from 0 to `top`, at most so many."""
    power = 10.0 ** np.floor(np.log10(max(top, 1e-12) / most))
    steps = (f * power * scale for scale in (1.0, 10.0) for f in _TICKS)
    step = next(s for s in steps if top / s <= most)
    return [float(k * step) for k in range(int(top / step + 1e-9) + 1)]


def write(
    rec: rr.RecordingStream,
    path: str,
    places: Sequence[Place],
    texts: Sequence[str],
    color: style.Color = plan_style.TEXT,
) -> None:
    """Log texts in colours that can be read in both themes."""
    rec.log(
        path,
        rr.Points2D(
            list(places),
            labels=[style.safe(t) for t in texts],
            radii=rr.Radius.ui_points(0.1),
            colors=[color],
            show_labels=True,
        ),
        static=True,
    )
