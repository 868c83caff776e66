"""The blueprint of a plan's recording: which view stands where, and what its title says."""

import numpy as np
import rerun.blueprint as rrb

from hilcal.report import numbers
from hilcal.report.viewer import plan_charts, plan_promises, plan_scene
from hilcal.report.viewer.plan_digest import PlanDigest
from hilcal.types import Floats

_FPS = 2.0
# Views that draw with light colours stay dark in the light theme too.
_DARK = rrb.Background(color=(22, 24, 29), kind=rrb.BackgroundKind.SolidColor)
STEPS = "Plan step by step: a bead per pose and load, beam green = seen"
TRACKER = "From the tracker"
SCHEDULE = "Schedule: which load is read when"
CURVE = "How many poses are enough: predicted position ±"
PARAMETERS = "Predicted ± in % of size"
BOUGHT = "What each criterion buys: ± small, O large"


def blueprint(d: PlanDigest) -> rrb.Blueprint:
    """Left: 3-D over the schedule. Right: the plan in words over what it promises."""
    scenes = [_steps(d)]
    if d.tracker is not None:
        scenes.append(_from_tracker(d, d.tracker))
    left = rrb.Vertical(rrb.Tabs(*scenes), _schedule(), row_shares=[7, 2])
    right: list[rrb.View | rrb.Container] = [
        rrb.Tabs(
            rrb.TextDocumentView(origin="words/plan", name="Plan"),
            rrb.TextDocumentView(origin="words/step", name="This step"),
            rrb.TextDocumentView(origin="words/guide", name="How to read this"),
        )
    ]
    shares = [11.0]
    if d.story.curve:
        right.append(_flat("curve", CURVE))
        shares.append(7.0)
    details = _details(d)
    if details:
        right.append(rrb.Tabs(*details))
        shares.append(8.0)
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*right, row_shares=shares), column_shares=[3, 2]),
        rrb.TimePanel(timeline="step", state="collapsed", fps=_FPS, play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def parameters_title(d: PlanDigest) -> str:
    """Return the title of the parameters' view, with how many it shows."""
    shown, all_ = len(plan_promises.shown_parameters(d.story)), len(d.story.predicted)
    return f"{PARAMETERS} ({shown} of {all_})" if shown < all_ else PARAMETERS


def _details(d: PlanDigest) -> list[rrb.View]:
    out: list[rrb.View] = []
    if plan_promises.shown_parameters(d.story):
        out.append(_flat("parameters", parameters_title(d)))
    if d.story.bought:
        out.append(_flat("bought", BOUGHT))
    if d.story.predicted:
        out.append(rrb.TextDocumentView(origin="words/parameters", name="Parameters"))
    if d.story.bought:
        out.append(rrb.TextDocumentView(origin="words/bought", name="Criteria"))
    return out


def _steps(d: PlanDigest) -> rrb.Spatial3DView:
    middle, size = plan_scene.framed(d)
    return _view3d(STEPS, ["+ $origin/**"], middle + size * _eye(d, middle), middle)


def _from_tracker(d: PlanDigest, place: Floats) -> rrb.Spatial3DView:
    contents = ["+ $origin/**"]
    contents += [f"- $origin/{x}/**" for x in ("tracker", "beam", "workspace", "way")]
    at = d.target.mean(axis=0)
    far = float(np.linalg.norm(place - at))
    return _view3d(f"{TRACKER}, {numbers.length(far)} away", contents, place, at)


def _eye(d: PlanDigest, middle: Floats) -> Floats:
    """Direction to the eye, in half sizes of the picture: across the beam where there is one."""
    turn = np.deg2rad(-52.0)
    if d.tracker is not None:
        beam = d.tracker - middle
        turn = np.arctan2(beam[1], beam[0]) - np.deg2rad(62.0)
    return np.array([1.7 * np.cos(turn), 1.7 * np.sin(turn), 0.75])


def _view3d(name: str, contents: list[str], eye: Floats, look: Floats) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin="world",
        contents=contents,
        name=name,
        background=_DARK,
        line_grid=rrb.LineGrid3D(
            visible=True, spacing=0.25, stroke_width=0.7, color=(120, 124, 132, 60)
        ),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye, look_target=look, eye_up=(0.0, 0.0, 1.0)
        ),
    )


def _schedule() -> rrb.Spatial2DView:
    w, h = plan_charts.LONG, plan_charts.HEIGHT
    return rrb.Spatial2DView(
        origin="schedule",
        name=SCHEDULE,
        background=_DARK,
        visual_bounds=rrb.VisualBounds2D(x_range=(-0.16 * w, 1.02 * w), y_range=(-5.0, h + 16.0)),
    )


def _flat(origin: str, name: str) -> rrb.Spatial2DView:
    w, h = plan_charts.WIDTH, plan_charts.HEIGHT
    return rrb.Spatial2DView(
        origin=origin,
        name=name,
        background=_DARK,
        visual_bounds=rrb.VisualBounds2D(x_range=(-0.09 * w, 1.05 * w), y_range=(-13.0, h + 13.0)),
    )
