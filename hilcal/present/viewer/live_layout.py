"""The blueprint while a campaign is measured: 3-D over residuals in time; words over the log."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint import archetypes

from hilcal.present.viewer import eye
from hilcal.present.viewer.layout import BACKGROUND, EYE, GRID
from hilcal.present.viewer.live_digest import LiveDigest
from hilcal.types import Floats

TIMELINE = "time"
RESIDUALS = "in σ: an arrow that leaves its noise ball = model wrong"
IN_TIME = "in σ: grey noise, amber doubtful, red model wrong"


def blueprint(d: LiveDigest, world: str, series: str) -> rrb.Blueprint:
    """Return the blueprint.

    Args:
        d: the campaign.
        world: the entity below which its readings are drawn.
        series: the entity below which its residuals are in time.
    """
    every = archetypes.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    of = "Residual of each reading," if d.group == 1 else f"Worst of every {d.group} residuals,"
    middle, size = _center(d)
    scene = rrb.Spatial3DView(
        origin="world",
        contents=[f"+ {world}/**"],
        name=f"{of} {RESIDUALS}",
        background=BACKGROUND,
        line_grid=GRID,
        overrides={f"{world}/{name}": every for name in ("arrows", "balls", "dots")},
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=eye.near(middle, EYE * size, seen(d)),
            look_target=middle,
            eye_up=(0.0, 0.0, 1.0),
        ),
    )
    in_time = rrb.TimeSeriesView(
        origin=series,
        name=f"{of} {IN_TIME}",
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=archetypes.TimeAxis(
            view_range=rr.TimeRange(
                start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
            )
        ),
    )
    told = rrb.Tabs(
        rrb.TextDocumentView(origin="words/measuring", name="So far"),
        rrb.TextDocumentView(origin="words/live_guide", name="How to read this"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(scene, in_time, row_shares=[11, 4]),
            rrb.Vertical(told, _log(), row_shares=[3, 2]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _log() -> rrb.TextLogView:
    kinds = (rrb.encodings.TextLogColumnKind.LogLevel, rrb.encodings.TextLogColumnKind.Body)
    shown = archetypes.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(timeline=TIMELINE, visible=False)],
        text_log_columns=[rrb.encodings.TextLogColumn(kind=kind, visible=True) for kind in kinds],
    )
    return rrb.TextLogView(origin="log", name="Log", columns=shown)


def seen(d: LiveDigest) -> Floats:
    """(K, 3) what is to be in the picture: targets and the arm in the first pose, m."""
    return np.vstack([d.anchor.reshape(-1, 3), d.bodies[0, :, :3, 3]])


def _center(d: LiveDigest) -> tuple[Floats, float]:
    points = np.vstack([d.anchor.reshape(-1, 3), np.zeros((1, 3))])
    lo, hi = points.min(0), points.max(0)
    half = float(np.linalg.norm(hi - lo)) / 2
    return (lo + hi) / 2, max(half, 0.3 * d.told.arm.reach)
