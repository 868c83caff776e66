"""The charts and the blueprint of a plan's recording."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilcal import numbers
from hilcal.design.summary import PlanSummary
from hilcal.present.plan import load_name
from hilcal.present.viewer import layout, plan_scene, style
from hilcal.present.viewer.plan_digest import PlanDigest
from hilcal.types import Floats, Ints

_DOT = 3.5


def schedule(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Send the minute of each reading along `step`, one series per load; load changes are jumps."""
    colors = plan_scene.load_colors(d.loads)
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


_FPS = 2.0
_LOOKED_AT = 20
"""Steps whose arm is to be seen from the eye."""
STEPS = "Plan step by step: a bead per pose and load, beam green = seen"
TRACKER = "From the tracker"
SCHEDULE = "Schedule: minute of each reading by step, colour by load"


def blueprint(d: PlanDigest) -> rrb.Blueprint:
    """Left: 3-D over the schedule. Right: the plan in words over the curve, with tables."""
    scenes = [_steps(d)]
    if d.tracker is not None:
        scenes.append(_from_tracker(d, d.tracker))
    left = rrb.Vertical(rrb.Tabs(*scenes), _schedule(), row_shares=[7, 2])
    right: list[rrb.View | rrb.Container] = [
        rrb.Tabs(
            rrb.TextDocumentView(origin="words/plan", name="Plan"),
            rrb.TextDocumentView(origin="words/step", name="This step"),
            rrb.TextDocumentView(origin="words/notes", name="Notes"),
            rrb.TextDocumentView(origin="words/guide", name="How to read this"),
        )
    ]
    details = _details(d)
    if details:
        right.append(rrb.Tabs(*details))
    shares = [5, 4][: len(right)]
    return layout.whole(
        rrb.Horizontal(left, rrb.Vertical(*right, row_shares=shares), column_shares=[3, 2]),
        "step",
        fps=_FPS,
    )


def curve_title(d: PlanDigest) -> str:
    """Return the title of the sample-size curve, with its unit."""
    unit = curve_unit(d.summary)[0]
    return f"Position ± [{unit}] by number of poses; blue: nearest to this plan"


def _details(d: PlanDigest) -> list[rrb.View]:
    out: list[rrb.View] = []
    if d.summary.curve:
        out.append(
            rrb.BarChartView(
                origin="curve", name=curve_title(d), plot_legend=rrb.PlotLegend(visible=False)
            )
        )
    if d.summary.criteria:
        out.append(rrb.TextDocumentView(origin="words/criteria", name="Criteria"))
    if d.summary.parameters:
        out.append(rrb.TextDocumentView(origin="words/parameters", name="Parameters"))
    return out


def _steps(d: PlanDigest) -> rrb.Spatial3DView:
    middle, size = plan_scene.framed(d)
    return layout.view3d("world", STEPS, middle + size * _eye(d, middle, size), middle)


def _from_tracker(d: PlanDigest, place: Floats) -> rrb.Spatial3DView:
    contents = ["+ $origin/**"]
    contents += [f"- $origin/{x}/**" for x in ("tracker", "beam", "workspace", "way")]
    at = d.target.mean(axis=0)
    far = float(np.linalg.norm(place - at))
    return layout.view3d("world", f"{TRACKER}, {numbers.length(far)} away", place, at, contents)


def _eye(d: PlanDigest, middle: Floats, size: float) -> Floats:
    """Direction to the eye: across the beam where there is one, and where no obstacle hides."""
    turn = float(np.deg2rad(-52.0))
    if d.tracker is not None:
        beam = d.tracker - middle
        turn = float(np.arctan2(beam[1], beam[0]) - np.deg2rad(62.0))
    some = np.unique(np.linspace(0, len(d) - 1, _LOOKED_AT).round().astype(np.int64))
    points = np.vstack([d.bodies[some, 1:, :3, 3].reshape(-1, 3), d.target[some]])
    return layout.direction(turn, middle, size, points, d.config.obstacles)


def _schedule() -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="schedule", name=SCHEDULE, plot_legend=rrb.PlotLegend(rrb.Corner2D.RightBottom)
    )
