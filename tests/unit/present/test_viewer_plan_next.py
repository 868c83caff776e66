"""A plan's recording: what `next` asks comes first, and nothing hides the arm."""

import numpy as np
import pytest
from rerun.chunk import RrdReader

from hilcal.config import Obstacle
from hilcal.design.next import PairPower
from hilcal.present.viewer import style
from hilcal.present.viewer.plan import PlanView, record_plan
from tests.support.recordings import rows
from tests.support.viewer_plan import PLAN, SUMMARY, configured, strict

__all__ = ["strict"]  # fixture
POWERS = (
    PairPower("joint_tilt_compliance", "link_compliance", 0.744, 0.98, False),
    PairPower("link_compliance", "joint_tilt_compliance", 0.56, 0.1, True),
)


def eye_place(path) -> np.ndarray:
    """Return where the eye of the first view stands, as the recording says."""
    reader = RrdReader(path)
    (blueprint,) = reader.blueprints()
    found = [
        value
        for chunk in reader.stream(store=blueprint).to_chunks()
        if "EyeControls3D:position" in (batch := chunk.to_record_batch()).schema.names
        for value in batch.column("EyeControls3D:position").to_pylist()
    ]
    return np.array(found[0][0])


def test_the_suspects_and_their_powers_come_before_the_plan(tmp_path):
    record_plan(*configured(), PLAN, SUMMARY, tmp_path / "next.rrd", POWERS)
    text = rows(tmp_path / "next.rrd", "/words/plan", "TextDocument:text")[0][0]
    lines = text.replace("\\", "").splitlines()
    assert lines[0] == "### Which is it: joint_tilt_compliance or link_compliance?"
    assert "| joint_tilt_compliance | link_compliance | 74 % | 98 % |" in lines[1:6]
    assert "| link_compliance | joint_tilt_compliance | 56 % | not in this cell |" in lines[1:6]
    assert any(line.startswith("### Plan: 3 poses") for line in lines[5:])


def test_a_plan_without_suspects_begins_with_itself(tmp_path):
    record_plan(*configured(), PLAN, SUMMARY, tmp_path / "plan.rrd")
    text = rows(tmp_path / "plan.rrd", "/words/plan", "TextDocument:text")[0][0]
    assert text.startswith("### Plan: 3 poses, 10 readings")


def test_a_tripod_before_the_arm_makes_the_eye_go_elsewhere(tmp_path):
    free = tmp_path / "free.rrd"
    record_plan(*configured(), PLAN, SUMMARY, free)
    preferred = eye_place(free)
    away = preferred[:2] / np.linalg.norm(preferred[:2])
    tripod = {
        "name": "tripod",
        "bottom_m": [*(0.9 * away).tolist(), 0.0],
        "radius_m": 0.3,
        "height_m": 1.2,
    }
    cell, config = configured(obstacles=[tripod])
    path = tmp_path / "tripod.rrd"
    record_plan(cell, config, PLAN, SUMMARY, path)
    d = PlanView(cell, config, PLAN, SUMMARY)
    arm = d.bodies[:, 1:, :3, 3].reshape(-1, 3)
    assert style.hidden(preferred, arm, config.obstacles).mean() > 0.3
    assert style.hidden(eye_place(path), arm, config.obstacles).mean() < 0.02


@pytest.mark.parametrize(
    "thing",
    [
        Obstacle(name="box", center_m=(1.0, 0.0, 0.5), size_m=(0.2, 0.4, 1.0)),
        Obstacle(name="pillar", bottom_m=(1.0, 0.0, 0.0), radius_m=0.2, height_m=1.0),
    ],
)
def test_what_stands_behind_an_obstacle_is_hidden_and_nothing_else(thing):
    behind, above, aside, before = [0, 0, 0.5], [0, 0, 2.0], [0, 1.5, 0.5], [1.5, 0, 0.5]
    points = np.array([behind, above, aside, before], dtype=float)
    found = style.hidden(np.array([2.0, 0.0, 0.5]), points, (thing,))
    assert found.tolist() == [True, False, False, False]


def test_the_eye_is_as_near_as_shows_everything():
    look, way = np.array([0.0, 0.0, 0.5]), np.array([1.0, -1.3, 0.5])
    corners = np.array([[x, y, z] for x in (-0.6, 0.6) for y in (-0.6, 0.6) for z in (0.0, 1.0)])
    place = style.near(look, way, corners)
    assert style.in_view(place, look, corners).all()
    assert not style.in_view(look + 0.9 * (place - look), look, corners).all()
    behind = place + (place - look)
    assert not style.in_view(place, look, behind[None])[0]
