"""The residual against what it follows: the leading suspect, or else a recorded variable."""

import numpy as np
import rerun as rr

from hilcal.present.story import Regressor, StoryCurve, StoryRevision
from hilcal.present.viewer import style
from hilcal.present.viewer.digest import Digest, worst_and_even
from hilcal.present.viewer.flat import (
    BELOW,
    FOOT,
    HEIGHT,
    RAISED,
    TITLE,
    WIDTH,
    Frame,
    around,
    nothing,
    numbers_at,
    ticks,
    write,
)
from hilcal.types import Floats

_ROWS = 6
_TREND_BINS = 12
_SIGMAS = 2.0


def residual_chart(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log what the residual follows, or in words that there is nothing to plot."""
    if r.curves:
        _curve(rec, r.curves[0], title(r))
    elif r.regressor is not None and len(r.regressor.x):
        _regressor(rec, d, r, r.regressor)
    elif r.verdict == "adequate" and any(np.isfinite(s.displacement_m) for s in r.limits):
        _limits(rec, r)
    else:
        for part in ("bars", "trend", "axes"):
            rec.log(f"regressor/{part}", nothing())
        rec.log("regressor/points", rr.Points2D([]))
        write(rec, "regressor/labels", [(WIDTH / 2, HEIGHT / 2)], [title(r)])


def title(r: StoryRevision) -> str:
    """Return what the picture of a revision shows."""
    if r.curves:
        why = {
            "unknown_effect": "unknown effect",
            "noise_misjudged": "the noise is not what was stated",
        }.get(r.verdict, "no suspect")
        if r.suspects:
            share = style.percent(max(r.suspects[0].holdout_share, 0.0))
            why = f"{r.suspects[0].effect} explains {share} of it"
        return f"Residual against {r.curves[0].variable} ({why})"
    if r.regressor is not None:
        lead = f" {r.suspects[0].effect}" if r.suspects else ""
        return f"Residual against the leading suspect{lead}"
    if r.verdict == "adequate":
        return "What is left looks like noise: no suspect to plot against"
    return "No suspect to plot against"


def _curve(rec: rr.RecordingStream, c: StoryCurve, name: str) -> None:
    """Log a mean error with its uncertainty in each bin of a variable."""
    places = np.arange(len(c.x), dtype=float) if c.names else c.x
    reach = _SIGMAS * c.error
    frame = Frame(around(places), around(np.concatenate([c.y - reach, c.y + reach, np.zeros(1)])))
    at = frame.place(places, c.y)
    ends = np.stack([frame.place(places, c.y - reach), frame.place(places, c.y + reach)], axis=1)
    rec.log(
        "regressor/points",
        rr.Points2D(at, colors=[style.MEASURED], radii=rr.Radius.ui_points(5.0), draw_order=50.0),
    )
    rec.log(
        "regressor/bars",
        rr.LineStrips2D(list(ends), colors=[style.MEASURED], radii=rr.Radius.ui_points(1.5)),
    )
    rec.log(
        "regressor/trend",
        nothing()
        if c.names
        else rr.LineStrips2D([at], colors=[style.GREY], radii=rr.Radius.ui_points(1.0)),
    )
    x = places if c.names else ticks(*frame.x, most=9, angle=c.x_label.endswith("[°]"))
    names = list(c.names) or numbers_at(x)
    _axes(rec, frame, x, names, f"{name}: mean ±2 σ", f"{c.y_label} against {c.x_label}")


def law_chart(rec: rr.RecordingStream, r: StoryRevision) -> None:
    """Log the first law that the catalogue does not have, beside what the readings say."""
    if not r.laws:
        for part in ("bars", "line", "axes"):
            rec.log(f"law/{part}", nothing())
        rec.log("law/points", rr.Points2D([]))
        write(rec, "law/labels", [(WIDTH / 2, HEIGHT / 2)], ["no law beyond the catalogue yet"])
        return
    c = r.laws[0]
    reach = _SIGMAS * c.error
    frame = Frame(
        around(np.concatenate([c.x, c.line[0]])),
        around(np.concatenate([c.y - reach, c.y + reach, c.line[1], np.zeros(1)])),
    )
    ends = np.stack([frame.place(c.x, c.y - reach), frame.place(c.x, c.y + reach)], axis=1)
    rec.log(
        "law/points",
        rr.Points2D(
            frame.place(c.x, c.y),
            colors=[style.MEASURED],
            radii=rr.Radius.ui_points(5.0),
            draw_order=50.0,
        ),
    )
    rec.log(
        "law/bars",
        rr.LineStrips2D(list(ends), colors=[style.MEASURED], radii=rr.Radius.ui_points(1.5)),
    )
    rec.log(
        "law/line",
        rr.LineStrips2D(
            [frame.place(*c.line)], colors=[style.NOISE], radii=rr.Radius.ui_points(2.0)
        ),
    )
    x = ticks(*frame.x, most=9, angle=c.x_label.endswith("[°]"))
    above = f"{c.name}: {c.formula}; blue: readings, mean ±2 σ"
    below = f"{c.y_label} against {c.x_label}"
    _axes(rec, frame, x, numbers_at(x), above, below, at="law")


def _limits(rec: rr.RecordingStream, r: StoryRevision) -> None:
    """Log bars as long as the strength at which an effect would have been named."""
    seen = [s for s in r.limits if np.isfinite(s.displacement_m)]
    last = seen[-_ROWS:][::-1]
    micrometres = np.array([1e6 * s.displacement_m for s in last])
    row = (np.arange(len(last)) + 0.5) * HEIGHT / len(last)
    frame = Frame((-0.5 * micrometres.max(), 1.05 * micrometres.max()), (0.0, 1.0))
    zero = frame.place(np.zeros(len(last)), np.zeros(len(last)))[:, 0]
    end = frame.place(micrometres, micrometres)[:, 0]
    bars = np.stack([np.stack([zero, row], 1), np.stack([end, row], 1)], axis=1)
    rec.log(
        "regressor/bars",
        rr.LineStrips2D(list(bars), colors=[style.NOISE], radii=rr.Radius.ui_points(4.0)),
    )
    rec.log("regressor/points", rr.Points2D([]))
    rec.log("regressor/trend", nothing())
    x = ticks(0.0, frame.x[1])
    rec.log("regressor/axes", frame.lines(x, np.zeros(0)))
    at = frame.place(x, np.zeros(len(x)))[:, 0]
    of = f"; the {len(last)} least visible of {len(seen)}" if len(last) < len(seen) else ""
    name = "Only noise is left; an effect stronger than its bar would have been named"
    words = [((WIDTH / 2, TITLE), name)]
    words += [((WIDTH / 2, BELOW), f"rms displacement of the target [µm]{of}")]
    words += [((float(a), FOOT), t) for a, t in zip(at, numbers_at(x), strict=True)]
    left = float(zero[0]) / 2 - 3.0
    words += [((left, float(a) + RAISED), s.effect) for a, s in zip(row, last, strict=True)]
    write(rec, "regressor/labels", [w[0] for w in words], [w[1] for w in words])


def _regressor(rec: rr.RecordingStream, d: Digest, r: StoryRevision, g: Regressor) -> None:
    """Log the residual against what the leading suspect depends on, with its running mean."""
    frame = Frame(around(g.x), around(np.concatenate([g.y, -g.y])))
    chosen = worst_and_even(np.abs(g.y), d.limits.points)
    level = (
        style.levels(r.whitened_norm2)[chosen]
        if len(g.x) == len(d.row)
        else np.zeros(len(chosen), dtype=np.int64)
    )
    rec.log(
        "regressor/points",
        rr.Points2D(
            frame.place(g.x[chosen], g.y[chosen]),
            colors=style.LEVEL_COLORS[level],
            radii=rr.Radius.ui_points(2.5 if len(chosen) > 300 else 4.0),
        ),
    )
    rec.log("regressor/bars", nothing())
    rec.log(
        "regressor/trend",
        rr.LineStrips2D(
            [_trend(frame, g)],
            colors=[style.MEASURED],
            radii=rr.Radius.ui_points(2.0),
            draw_order=40.0,
        ),
    )
    x = ticks(*frame.x, most=9)
    _axes(rec, frame, x, numbers_at(x), title(r), f"{g.y_label} against {g.x_label}")


def _axes(
    rec: rr.RecordingStream,
    frame: Frame,
    x: Floats,
    names: list[str],
    above: str,
    below: str,
    at: str = "regressor",
) -> None:
    """Log ticks, those of x with their names, and what is seen: a title, and what the axes are."""
    y = ticks(*frame.y, most=5)
    rec.log(f"{at}/axes", frame.lines(x, y))
    at_x = frame.place(x, np.full(len(x), frame.y[0]))[:, 0]
    at_y = frame.place(np.full(len(y), frame.x[0]), y)[:, 1]
    words = [((WIDTH / 2, TITLE), above), ((WIDTH / 2, BELOW), below)]
    words += [((float(a), FOOT), t) for a, t in zip(at_x, names, strict=True)]
    words += [((-7.0, float(a) + RAISED), t) for a, t in zip(at_y, numbers_at(y), strict=True)]
    write(rec, f"{at}/labels", [w[0] for w in words], [w[1] for w in words])


def _trend(frame: Frame, g: Regressor) -> Floats:
    """(K, 2) mean of the residual over bins of equal count."""
    order = np.argsort(g.x, kind="stable")
    bins = np.array_split(order, min(_TREND_BINS, max(1, len(order) // 4)))
    x = np.array([g.x[b].mean() for b in bins])
    y = np.array([g.y[b].mean() for b in bins])
    return frame.place(x, y)
