"""The flat views of what a plan promises: enough poses, parameters, criteria."""

from collections.abc import Callable, Sequence

import numpy as np
import rerun as rr

from hilcal.plan.story import Bought, PlanStory, Promised
from hilcal.report import numbers
from hilcal.report.viewer import plan_style, style
from hilcal.report.viewer.plan_charts import HEIGHT, LINE, WIDTH, Place, row, ticks, write
from hilcal.types import Floats

PARAMETERS = 14
"""So many are drawn at most, those that are known worst."""
_ROWS = 8


def promises(rec: rr.RecordingStream, story: PlanStory) -> None:
    """Log the charts, each where the story has its numbers."""
    curve_chart(rec, story)
    parameter_chart(rec, shown_parameters(story))
    bought_chart(rec, story.bought, story.criterion)


def curve_chart(rec: rr.RecordingStream, story: PlanStory) -> None:
    """Log the predicted position's standard uncertainty over the number of poses."""
    if not story.curve:
        return
    poses = np.array([p.poses for p in story.curve], dtype=float)
    std = np.array([p.position_std_m for p in story.curve])
    unit, factor = numbers.unit_for("m", std.tolist())
    top = _above(float(std.max()) * factor)
    wide = float(poses.max()) * 1.04
    at = np.stack([poses / wide * WIDTH, (1.0 - std * factor / top) * HEIGHT], 1)
    mine = poses == story.poses
    colors = np.where(mine[:, None], np.array(style.MEASURED), np.array(plan_style.BARE))
    heights = ticks(top, 4)
    _grid(
        rec,
        "curve",
        [[(0.0, _up(h, top)), (WIDTH, _up(h, top))] for h in heights],
        [(-9.0, _up(h, top) - 4.5) for h in heights],
        [f"{h:g} {unit}" for h in heights],
    )
    rec.log(
        "curve/line",
        rr.LineStrips2D([at], colors=[style.GREY], radii=rr.Radius.ui_points(1.5)),
        static=True,
    )
    rec.log(
        "curve/points",
        rr.Points2D(
            at,
            colors=colors.astype(np.uint8),
            radii=rr.Radius.ui_points([6.0 if m else 3.5 for m in mine]),
        ),
        static=True,
    )
    apart = _apart(at[:, 0], 12.0)
    write(
        rec,
        "curve/poses",
        [(float(at[k, 0]), HEIGHT + 2.0) for k in apart],
        [f"{poses[k]:.0f}" for k in apart],
    )
    for k in np.flatnonzero(mine)[:1]:
        said = f"this plan: {story.poses} poses, ± {numbers.length(story.curve[k].position_std_m)}"
        place = (float(np.clip(at[k, 0] + 25.0, 40.0, WIDTH - 40.0)), float(at[k, 1]) - 18.0)
        write(rec, "curve/plan", [place], [said], plan_style.OWN_TEXT)


def shown_parameters(story: PlanStory) -> tuple[Promised, ...]:
    """Return the parameters with a magnitude, the worst known of them, in the story's order."""
    with_value = [p for p in story.predicted if p.value]
    worst = sorted(with_value, key=share, reverse=True)[:PARAMETERS]
    kept = {p.name for p in worst}
    return tuple(p for p in with_value if p.name in kept)


def share(p: Promised) -> float:
    """Return a parameter's standard uncertainty by its magnitude."""
    return p.std / abs(p.value) if p.value else float("inf")


def parameter_chart(rec: rr.RecordingStream, promised: Sequence[Promised]) -> None:
    """Log each parameter's standard uncertainty by its magnitude, on a logarithmic axis."""
    if not promised:
        return
    shares = np.array([share(p) for p in promised])
    low = np.floor(np.log10(max(float(shares.min()), 1e-9)))
    high = max(np.ceil(np.log10(max(float(shares.max()), 1e-9))), low + 1.0)
    left, right = 0.5 * WIDTH, 0.9 * WIDTH

    def across(value: Floats) -> Floats:
        return np.asarray(left + (right - left) * (np.log10(value) - low) / (high - low))

    rows = row(np.arange(len(promised)), max(len(promised), _ROWS))
    decades = 10.0 ** np.arange(low, high + 0.5)
    _grid(
        rec,
        "parameters",
        [[(float(a), 0.0), (float(a), HEIGHT)] for a in across(decades)],
        [(float(a), HEIGHT + 1.0) for a in across(decades)],
        [f"{100.0 * t:g} %" for t in decades],
    )
    x = across(np.maximum(shares, 10.0**low))
    rec.log(
        "parameters/points",
        rr.Points2D(
            np.stack([x, rows], 1), colors=[style.MEASURED], radii=rr.Radius.ui_points(4.5)
        ),
        static=True,
    )
    write(
        rec,
        "parameters/names",
        [(0.2 * WIDTH, float(r) - 4.5) for r in rows],
        [f"{p.name} ± {amount(p)}" for p in promised],
    )
    write(
        rec,
        "parameters/shares",
        [(float(min(a + 13.0, WIDTH)), float(r) - 4.5) for a, r in zip(x, rows, strict=True)],
        [_percent(s) for s in shares],
    )


def amount(p: Promised) -> str:
    """Return a parameter's standard uncertainty in a unit that reads well."""
    unit, factor = numbers.unit_for(p.unit, [abs(p.value) if p.value else p.std])
    return f"{numbers.digits(factor * p.std, 2)} {unit}"


def bought_chart(rec: rr.RecordingStream, bought: Sequence[Bought], own: str) -> None:
    """Log a bar per criterion and measure, each measure by its largest."""
    if not bought:
        return
    measures: list[tuple[str, list[float | None], Callable[[float], str]]] = [
        ("position ±", [b.position_std_m for b in bought], numbers.length),
        ("open ±", [b.position_open_m for b in bought], numbers.length),
        ("joint ±", [b.joint_share for b in bought], _percent),
        ("O1 (D)", [b.o1 for b in bought], numbers.digits),
        ("O2 (K)", [b.o2 for b in bought], numbers.digits),
        ("O3 (E)", [b.o3 for b in bought], numbers.digits),
    ]
    measures = [m for m in measures if any(v is not None for v in m[1])]
    rows = row(np.arange(len(bought)), max(len(bought), 4))
    left = 0.17 * WIDTH
    step = (WIDTH - left) / len(measures)
    bars, colors, places, words = [], [], [], []
    for k, (_, values, say) in enumerate(measures):
        most = max((v for v in values if v is not None), default=0.0) or 1.0
        at = left + k * step
        for value, height, b in zip(values, rows, bought, strict=True):
            places.append((at + 0.35 * step, float(height) - 8.0))
            words.append("-" if value is None else say(value))
            if value is not None:
                end = at + max(0.7 * step * value / most, 0.4)
                bars.append([(at, float(height) + 2.5), (end, float(height) + 2.5)])
                colors.append(style.MEASURED if b.criterion == own else style.GREY)
    rec.log("bought/bars", rr.LineStrips2D(bars, colors=colors, radii=rr.Radius(1.3)), static=True)
    write(rec, "bought/values", places, words)
    heads = [(left + (k + 0.35) * step, -12.5) for k in range(len(measures))]
    write(rec, "bought/heads", heads, [head for head, *_ in measures])
    names = [f"{b.criterion} (this plan)" if b.criterion == own else b.criterion for b in bought]
    write(rec, "bought/names", [(0.055 * WIDTH, float(r) - 4.5) for r in rows], names)


def _percent(share: float) -> str:
    return f"{numbers.digits(100.0 * share, 2)} %"


def _above(value: float) -> float:
    """Return a little more than a value."""
    return 1.08 * value if value > 0.0 else 1.0


def _up(value: float, top: float) -> float:
    return (1.0 - value / top) * HEIGHT


def _apart(x: Floats, gap: float) -> list[int]:
    """Return indices whose values keep a gap, the last one always."""
    out = [len(x) - 1]
    for k in range(len(x) - 2, -1, -1):
        if x[out[-1]] - x[k] >= gap:
            out.append(k)
    return out


def _grid(
    rec: rr.RecordingStream,
    path: str,
    lines: list[list[Place]],
    places: list[Place],
    texts: list[str],
) -> None:
    rec.log(
        f"{path}/axes",
        rr.LineStrips2D(lines, colors=[LINE], radii=rr.Radius.ui_points(0.6), draw_order=-5.0),
        static=True,
    )
    write(rec, f"{path}/ticks", places, texts)
