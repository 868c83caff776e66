"""The charts of a plan: the minute of every reading by load, and the sample-size curve."""

import numpy as np
import rerun as rr

from hilcal import numbers
from hilcal.design.summary import PlanSummary
from hilcal.present.plan import load_name
from hilcal.present.viewer import plan_style, style
from hilcal.present.viewer.plan_digest import PlanDigest
from hilcal.types import Ints

_DOT = 3.5


def schedule(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Send the minute of each reading along `step`, one series per load; load changes are jumps."""
    colors = plan_style.load_colors(d.loads)
    for k, name in enumerate(d.loads):
        _dots(rec, d, f"load{k}", load_name(name), np.flatnonzero(d.load == k), tuple(colors[k]))
    if d.unseen.any():
        lost = np.flatnonzero(d.unseen)
        _dots(rec, d, "unseen", "not seen by the tracker", lost, style.RED, "cross")


def _dots(
    rec: rr.RecordingStream,
    d: PlanDigest,
    entity: str,
    name: str,
    steps: Ints,
    color: style.Color,
    marker: str = "circle",
) -> None:
    points = rr.SeriesPoints(
        names=[f"{style.safe(name)}: {len(steps)}"],
        colors=[color],
        markers=[marker],  # type: ignore[list-item]
        marker_sizes=[_DOT if marker == "circle" else 2.0 * _DOT],
    )
    rec.log(f"schedule/{entity}", points, static=True)
    rec.send_columns(
        f"schedule/{entity}",
        indexes=[rr.TimeColumn("step", sequence=d.numbers[steps])],
        columns=rr.Scalars.columns(scalars=d.time[steps] / 60.0),
    )


def curve_unit(s: PlanSummary) -> tuple[str, float]:
    """Return the unit of the sample-size curve and its factor."""
    return numbers.unit_for("m", [p.position_std_m for p in s.curve])


def curve(rec: rr.RecordingStream, s: PlanSummary) -> None:
    """Log the sample-size curve as bars; the one nearest to the plan is a series of its own."""
    poses = np.array([p.poses for p in s.curve], dtype=float)
    height = curve_unit(s)[1] * np.array([p.position_std_m for p in s.curve])
    width = 0.6 * float(np.diff(poses).min(initial=poses.max(initial=1.0)))
    own = np.zeros(len(poses), dtype=np.bool_)
    own[np.argmin(np.abs(poses - s.poses))] = True
    for name, bars, color in (("other", ~own, style.GREY), ("plan", own, style.MEASURED)):
        if bars.any():
            chart = rr.BarChart(
                height[bars],
                abscissa=poses[bars],
                widths=np.full(int(bars.sum()), width),
                color=color,
            )
            rec.log(f"curve/{name}", chart, static=True)
