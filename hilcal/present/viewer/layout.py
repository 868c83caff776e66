"""The blueprint: which view stands where, and what its title says."""

from typing import Literal

import numpy as np
import rerun.blueprint as rrb

from hilcal.present.viewer import eye
from hilcal.present.viewer.digest import Digest
from hilcal.present.viewer.scene import center, seen

FOLLOWS = "What the residual follows"
LAW = "Law beyond the catalogue"
ERRORS = "Error of each revision [µm]"
EYE = np.array([1.05, -1.35, 0.55])
# Views that draw with light colours stay dark in the light theme too.
BACKGROUND = rrb.Background(color=(22, 24, 29), kind=rrb.BackgroundKind.SolidColor)

GRID = rrb.LineGrid3D(visible=True, spacing=0.25, stroke_width=0.7, color=(120, 124, 132, 70))


def blueprint(d: Digest) -> rrb.Blueprint:
    """Left: 3-D over the error of each revision. Right: the verdict over residual and details.

    It opens at the first revision and stands there; that of a growing story goes along with it.
    """
    left = rrb.Vertical(
        rrb.Tabs(_residuals(d), _deflections(d)),
        rrb.Tabs(
            rrb.TimeSeriesView(origin="errors", name=ERRORS),
            _bars("bars", bars_title(d)),
        ),
        row_shares=[11, 4],
    )
    laws = [_bars("law", LAW)] if any(r.laws for r in d.story.revisions) else []
    right = rrb.Vertical(
        rrb.Tabs(
            rrb.TextDocumentView(origin="words/verdict", name="Verdict"),
            rrb.TextDocumentView(origin="words/details", name="Details"),
            rrb.TextDocumentView(origin="words/guide", name="How to read this"),
        ),
        rrb.Tabs(
            _bars("follows", FOLLOWS),
            *laws,
            rrb.TextDocumentView(origin="words/parameters", name="Parameters ± σ"),
            rrb.TextDocumentView(origin="words/revisions", name="Table"),
            rrb.TextLogView(origin="log", name="Log"),
        ),
        row_shares=[5, 4],
    )
    play: Literal["following", "paused"] = "following" if d.story.growing else "paused"
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline="revision", state="collapsed", fps=1.0, play_state=play),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def residual_title(d: Digest) -> str:
    """Return the title of the residual view, with its scale and how much it shows."""
    shown, n = len(d.shown(d.story.revisions[0])), len(d.row)
    part = f" (about {shown} of {n} readings)" if shown < n else ""
    scale = f"{d.residual_scale:g}"
    return f"Residual ×{scale}{part}: an arrow that leaves its noise ball = model wrong"


def deflection_title(d: Digest) -> str:
    """Return the title of the deflection view, with its scale."""
    what = "Deflection" if d.story.mode == "deflection" else "Deviation from nominal"
    return f"{what} ×{d.deflection_scale:g}: blue measured, white predicted, red missed"


def bars_title(d: Digest) -> str:
    """Return the title of the bars, with what one bar stands for."""
    part = f" ({d.poses_per_bar} poses per bar)" if d.poses_per_bar > 1 else ""
    return f"Worst reading of each pose, in σ{part}: grey noise, amber doubtful, red model wrong"


def _view3d(d: Digest, name: str, hidden: str) -> rrb.Spatial3DView:
    middle, size = center(d)
    return rrb.Spatial3DView(
        origin="world",
        contents=["+ $origin/**", f"- $origin/{hidden}/**", "- $origin/live/**"],
        name=name,
        background=BACKGROUND,
        line_grid=GRID,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=eye.near(middle, EYE * size, seen(d)),
            look_target=middle,
            eye_up=(0.0, 0.0, 1.0),
        ),
    )


def _residuals(d: Digest) -> rrb.Spatial3DView:
    return _view3d(d, residual_title(d), "deflection")


def _deflections(d: Digest) -> rrb.Spatial3DView:
    return _view3d(d, deflection_title(d), "residual")


def _bars(origin: str, name: str) -> rrb.BarChartView:
    return rrb.BarChartView(origin=origin, name=name, plot_legend=rrb.PlotLegend(visible=False))
