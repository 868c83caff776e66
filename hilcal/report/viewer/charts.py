"""The flat views: bars per pose, error per revision, regressor, parameters."""

import numpy as np
import rerun as rr

from hilcal.report.story import Regressor, StoryRevision
from hilcal.report.viewer import style
from hilcal.report.viewer.digest import Digest, worst_and_even
from hilcal.types import Floats, Ints

WIDTH, HEIGHT = 220.0, 80.0  # of the flat pictures, their own units; y points down
SERIES = (
    ("fit", "fitted poses, rms", style.MEASURED, 3.0),
    ("holdout", "poses left out, rms", style.HOLDOUT, 3.0),
    ("worst", "worst reading", style.RED, 1.5),
    ("noise", "noise floor, rms", style.NOISE, 2.0),
)
_TREND_BINS = 12
_FOREST_SIGMAS = 10.0
_FOREST_ROWS = 16


def static_charts(rec: rr.RecordingStream) -> None:
    """Log the names and colours of the series."""
    for name, words, color, width in SERIES:
        line = rr.SeriesLines(names=[words], colors=[color], widths=[width])
        dots = rr.SeriesPoints(names=[words], colors=[color], marker_sizes=[3.5])
        rec.log(f"error/{name}", line, *([] if name == "noise" else [dots]), static=True)
    rec.log(
        "error/along/residual",
        rr.SeriesLines(names=["residual, rms"], colors=[style.MEASURED], widths=[1.5]),
        static=True,
    )
    rec.log(
        "error/along/noise",
        rr.SeriesLines(names=["noise floor, rms"], colors=[style.NOISE], widths=[2.0]),
        static=True,
    )


def revision_charts(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log one revision at the recording's current time."""
    pose_bars(rec, d, r)
    regressor_chart(rec, d, r)
    parameter_chart(rec, r)


def error_series(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log one revision's errors, µm."""
    values = {
        "fit": r.error_fit["rms_m"],
        "holdout": r.error_holdout["rms_m"],
        "worst": r.error_fit["max_m"],
        "noise": d.story.noise_floor_m,
    }
    for name, value in values.items():
        rec.log(f"error/{name}", rr.Scalars(value * 1e6))


def pose_charts(rec: rr.RecordingStream, d: Digest) -> None:
    """Send the last revision's residual along `pose`, and the bar of the current pose."""
    rms = d.pose_rms(d.story.revisions[-1]) * 1e6
    time = [rr.TimeColumn("pose", sequence=d.poses)]
    for name, series in (("residual", rms), ("noise", rms * 0 + 1e6 * d.story.noise_floor_m)):
        rec.send_columns(
            f"error/along/{name}", indexes=time, columns=rr.Scalars.columns(scalars=series)
        )
    starts, left, width = _bar_places(d)
    for k, height in enumerate(np.maximum.reduceat(rms, starts)):
        rec.set_time("pose", sequence=int(d.poses[starts[k]]))
        one = slice(k, k + 1)
        bar = rr.BarChart([height], abscissa=left[one], widths=width[one], color=style.MEASURED)
        rec.log("bars/zcurrent", bar)  # the name puts it in front of the others
    rec.reset_time()


def pose_bars(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log the bars, one series per level of Mahalanobis distance; a bar is its worst pose."""
    starts, left, width = _bar_places(d)
    height = np.maximum.reduceat(d.pose_rms(r) * 1e6, starts)
    level = style.levels(np.maximum.reduceat(d.pose_norm2(r), starts))
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


def regressor_chart(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log the residual against what the leading suspect depends on, with its running mean."""
    g = r.regressor
    if g is None or len(g.x) == 0:
        _write(rec, "regressor/labels", [(WIDTH / 2, HEIGHT / 2)], ["no suspect to plot against"])
        rec.log("regressor/points", rr.Points2D([]))
        rec.log("regressor/trend", rr.LineStrips2D([]))
        rec.log("regressor/axes", rr.LineStrips2D([]))
        return
    chosen = worst_and_even(np.abs(g.y), d.limits.points)
    x, y = _place(g, g.x[chosen], g.y[chosen])
    level = (
        style.levels(r.whitened_norm2)[chosen]
        if len(g.x) == len(d.row)
        else np.zeros(len(chosen), dtype=np.int64)
    )
    rec.log(
        "regressor/points",
        rr.Points2D(
            np.stack([x, y], 1),
            colors=style.LEVEL_COLORS[level],
            radii=rr.Radius.ui_points(2.5 if len(x) > 300 else 4.0),
        ),
    )
    rec.log(
        "regressor/trend",
        rr.LineStrips2D(
            [_trend(g)], colors=[style.MEASURED], radii=rr.Radius.ui_points(2.0), draw_order=40.0
        ),
    )
    zero = _place(g, np.array([g.x.min(), g.x.max()]), np.zeros(2))
    rec.log(
        "regressor/axes",
        rr.LineStrips2D(
            [np.stack(zero, 1), [(0, 0), (0, HEIGHT)]],
            colors=[style.GREY],
            radii=rr.Radius.ui_points(0.8),
        ),
    )
    top = float(np.abs(g.y).max())
    texts = [
        f"+{style.number(top)}",
        f"-{style.number(top)}",
        style.number(float(g.x.min())),
        style.number(float(g.x.max())),
        f"{g.y_label} against {g.x_label}",
    ]
    places = [(0, -2), (0, HEIGHT - 2), (10, HEIGHT + 8), (WIDTH, HEIGHT + 8)]
    places += [(WIDTH / 2, -9)]
    _write(rec, "regressor/labels", places, texts)


def parameter_chart(rec: rr.RecordingStream, r: StoryRevision) -> None:
    """Log each parameter as its value in units of its standard uncertainty, with ±2 σ."""
    known = [p for p in r.parameters if p.identifiable and p.value is not None and p.std]
    if not known:
        _write(rec, "parameters/labels", [(WIDTH / 2, HEIGHT / 2)], ["no identifiable parameter"])
        for part in ("points", "whiskers", "axes"):
            rec.log(f"parameters/{part}", rr.Points2D([]) if part == "points" else _nothing())
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
    names = [known[i].name for i in strongest]
    values = [
        f"{names[k]} = {style.number(float(known[i].value or 0), 3)} {known[i].unit}"
        for k, i in enumerate(strongest)
    ]
    places = [(0.38 * left, y) for y in row] + [(a, HEIGHT + 6) for a in at(ticks)]
    _write(rec, "parameters/labels", places, [*values, *(f"{s:g}" for s in ticks)])


def _place(g: Regressor, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    span = float(np.ptp(g.x)) or 1.0
    top = float(np.abs(g.y).max()) or 1.0
    return (x - g.x.min()) / span * WIDTH, (1 - y / top) * HEIGHT / 2


def _trend(g: Regressor) -> Floats:
    """(K, 2) mean of the residual over bins of equal count."""
    order = np.argsort(g.x, kind="stable")
    bins = np.array_split(order, min(_TREND_BINS, max(1, len(order) // 4)))
    x = np.array([g.x[b].mean() for b in bins])
    y = np.array([g.y[b].mean() for b in bins])
    return np.stack(_place(g, x, y), 1)


def _nothing() -> rr.LineStrips2D:
    return rr.LineStrips2D([])


def _write(
    rec: rr.RecordingStream, path: str, places: list[tuple[float, float]], texts: list[str]
) -> None:
    rec.log(
        path,
        rr.Points2D(
            places,
            labels=[style.safe(t) for t in texts],
            radii=rr.Radius.ui_points(0.1),
            colors=[style.GREY],
            show_labels=True,
        ),
    )
