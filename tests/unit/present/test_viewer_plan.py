"""The recording of a plan, read back: scene, charts and words are what is planned."""

from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from hilcal.config import Obstacle
from hilcal.design.next import PairPower
from hilcal.design.summary import DetectableEffect, PredictedParameter
from hilcal.errors import InputError
from hilcal.present.viewer import plan, style
from hilcal.present.viewer.plan import HIDDEN, SEEN, TURNED, UNKNOWN, PlanView, record_plan
from hilcal.robot.chain import evaluate
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, Step
from tests.support.picture import Shot, needs_vulkan, pictures
from tests.support.recordings import entities, rows, texts
from tests.support.refusals import refusal
from tests.support.viewer_plan import (
    BARE,
    PLAN,
    SUMMARY,
    TRACKER,
    Q,
    configured,
    recording,
    rgb,
    shadowed,
    target,
    turned,
)

__all__ = ["recording", "shadowed"]  # fixtures
pytestmark = pytest.mark.usefixtures("strict")
POWERS = (
    PairPower("joint_tilt_compliance", "link_compliance", 0.744, 0.98, False),
    PairPower("link_compliance", "joint_tilt_compliance", 0.56, 0.1, True),
)
STEPS = list(enumerate(PLAN.steps, start=1))


@pytest.fixture(scope="module")
def d(shadowed):
    return PlanView(shadowed, PLAN, SUMMARY)


def words(path, of="plan"):
    return rows(path, f"/words/{of}", "TextDocument:text")[0][0].replace("\\", "")


def test_capsules_end_where_they_should_in_any_direction():
    way = np.random.default_rng(1).normal(size=(20, 3))
    way[:3] = [[0.0, 0.0, 0.4], [0.0, 0.0, -0.4], [0.0, 0.0, 0.0]]
    start = np.ones((20, 3))
    made = style.drawn_capsules(start, start + way, np.full(20, 0.1), [(1, 2, 3)])
    quaternion = np.array(made.quaternions.as_arrow_array().to_pylist())
    length = np.array(made.lengths.as_arrow_array().to_pylist())
    np.testing.assert_allclose(length[:, None] * turned(quaternion), way, atol=1e-6)


def test_the_arm_is_drawn_as_what_is_checked_for_collisions(d, recording):
    parts, drawn = d.shapes.scene.parts, []
    for i in range(7):
        start, length, quaternion, radius = (
            np.array(rows(recording, f"/world/arm/body{i}", f"Capsules3D:{name}")[0])
            for name in ("translations", "lengths", "quaternions", "radii")
        )
        drawn += [(i, *x) for x in np.hstack([start, length[:, None], radius[:, None]]).tolist()]
        ends = start + length[:, None] * turned(quaternion)
        np.testing.assert_allclose(ends, [p.end for p in parts if p.body == i], atol=1e-6)
    true = [(p.body, *p.start, np.linalg.norm(p.end - p.start), p.radius) for p in parts]
    np.testing.assert_allclose(sorted(drawn), sorted(true), atol=1e-6)
    assert len(drawn) > 13  # the tool too


def test_arm_and_target_are_in_the_pose_of_every_step(shadowed, recording):
    arm, link = shadowed.arm, shadowed.arm.links[6]
    moves = rows(recording, "/world/arm/body6", "Transform3D:translation")
    now = rows(recording, "/world/target/now", "Points3D:positions")
    assert sorted(moves) == sorted(now) == list(range(1, 11))
    for k, step in STEPS:
        chain = evaluate(arm, PLAN.joints(step.pose)[None])
        flange = chain.rotation[-1][0] @ (link[:3, :3].T @ np.array(link[:3, 3]))
        np.testing.assert_allclose(moves[k][0], chain.point(np.zeros(3))[0] - flange, atol=1e-6)
        np.testing.assert_allclose(now[k][0], chain.point(shadowed.target[:3, 3])[0], atol=1e-6)


def test_the_beam_is_red_where_a_screen_stands_and_green_elsewhere(shadowed, recording):
    strips = rows(recording, "/world/beam", "LineStrips3D:strips")
    colors = rows(recording, "/world/beam", "LineStrips3D:colors")
    labels = rows(recording, "/world/label", "Points3D:labels")
    for k, step in STEPS:
        ends = [TRACKER, target(shadowed, PLAN.pose_names.index(step.pose))]
        np.testing.assert_allclose(strips[k][0], ends, atol=1e-6)
        hidden = step.pose == "p1"
        assert rgb(colors[k][0]) == (style.RED if hidden else style.NOISE)
        assert labels[k][0].endswith("hidden" if hidden else "seen")
    cages = rows(recording, "/world/target/unseen", "Ellipsoids3D:centers")[0]
    assert len(cages) == 3  # p1 under three loads
    crosses = rows(recording, "/schedule/unseen", "Scalars:scalars")
    assert sorted(crosses) == [k for k, s in STEPS if s.pose == "p1"]


def test_a_reflector_that_looks_away_is_told_from_a_hidden_one(shadowed):
    cell, config = shadowed, shadowed.config
    normal = evaluate(cell.arm, Q[2:3]).rotation[-1][0].T @ (TRACKER - target(cell, 2))
    more = {"target_normal": tuple(normal), "incidence_max_rad": 0.02}
    sight = config.sight.model_copy(update=more)
    d = PlanView(cell.with_config(config.model_copy(update={"sight": sight})), PLAN, SUMMARY)
    status = dict(zip((s.pose for s in PLAN.steps), d.sight.tolist(), strict=True))
    assert status == {REFERENCE: TURNED, "p1": HIDDEN, "p2": SEEN, "p3": TURNED}
    assert "incidence" in plan.step_card(d, 0)
    assert "screen between" in plan.step_card(d, 1)
    assert [bool(d.sight_problem(k)) for k in range(len(d))] == [s != SEEN for s in d.sight]


def test_without_a_tracker_nothing_is_claimed(tmp_path):
    cell = configured()
    path = tmp_path / "x.rrd"
    record_plan(cell, PLAN, SUMMARY, path)
    assert not {"/world/beam", "/world/tracker", "/world/target/unseen"} & entities(path)
    d = PlanView(cell, PLAN, SUMMARY)
    assert set(d.sight.tolist()) == {UNKNOWN}
    assert not d.unseen.any()
    assert "not known" in plan.overview(d)
    assert "not known" in plan.step_card(d, 0)
    assert not any("seen" in v[0] for v in rows(path, "/world/label", "Points3D:labels").values())


def test_a_weight_hangs_below_the_load_point_and_a_pull_is_an_arrow(shadowed, recording):
    cell = shadowed
    radii = rows(recording, "/world/load/capsules", "Capsules3D:radii")
    starts = rows(recording, "/world/load/capsules", "Capsules3D:translations")
    cleared = rows(recording, "/world/load/capsules", "Clear:is_recursive")
    hung = [k for k, s in STEPS if s.load == "10kg"]
    assert sorted(radii) == hung
    assert sorted([*cleared, *hung]) == list(range(1, 11))
    for k in hung:
        hook = evaluate(cell.arm, PLAN.joints(PLAN.steps[k - 1].pose)[None]).point(cell.load_point)
        off = np.array(starts[k][0]) - hook[0]
        np.testing.assert_allclose(off, [0.0, 0.0, -radii[k][0]], atol=1e-6)
    arrows = rows(recording, "/world/load/arrow", "Arrows3D:vectors")
    assert sorted(arrows) == [8, 9]
    assert all(a[0][0] > 0.1 and a[0][1:] == [0.0, 0.0] for a in arrows.values())


def test_one_bead_per_pose_and_load_in_the_loads_colour(d, shadowed, recording):
    places = np.array(rows(recording, "/world/target/beads", "Points3D:positions")[0])
    colors = [rgb(c) for c in rows(recording, "/world/target/beads", "Points3D:colors")[0]]
    pairs = list(dict.fromkeys((s.pose, s.load) for s in PLAN.steps))
    by_load = {n: tuple(c) for n, c in zip(PLAN.loads, d.colors.tolist(), strict=True)}
    assert colors == [by_load[load] for _, load in pairs]
    assert (len(places), len(set(by_load.values()))) == (8, 3)
    off = places - [target(shadowed, PLAN.pose_names.index(pose)) for pose, _ in pairs]
    np.testing.assert_allclose(off[:, :2], 0.0, atol=1e-6)
    assert (off[:, 2] > -1e-6).all()
    assert [z < 1e-6 for z in off[:, 2]] == [load == UNLOADED for _, load in pairs]
    assert len(np.unique(places.round(5), axis=0)) == 8  # none is inside another


def test_ways_are_one_path_of_straight_joint_motions(d, shadowed):
    assert len(d.paths) == len(PLAN.steps)
    for k, way in enumerate(d.paths):
        np.testing.assert_allclose(way[-1], d.target[k], atol=1e-12)
        if k:
            np.testing.assert_allclose(way[0], d.target[k - 1], atol=1e-12)
    half = evaluate(shadowed.arm, 0.5 * (Q[1:2] + Q[2:3])).point(shadowed.target[:3, 3])
    near = np.linalg.norm(d.paths[2] - half, axis=1).min()
    assert near <= np.linalg.norm(np.diff(d.paths[2], axis=0), axis=1).max()
    # a weight is hung at the reference pose on the way
    assert np.linalg.norm(d.paths[5] - d.target[0], axis=1).min() < 1e-12


def test_only_sides_of_the_workspace_that_are_given_are_drawn(recording, tmp_path):
    sides = np.array(rows(recording, "/world/workspace", "LineStrips3D:strips")[0])
    assert sides.shape == (3, 5, 3)
    for axis, low in enumerate((-1.6, -1.6, 0.05)):
        np.testing.assert_allclose(sides[axis][:, axis], low, atol=1e-6)
    cell = configured(limits={"workspace_max_m": [1.2, 1.0, 1.5]})
    record_plan(cell, PLAN, BARE, tmp_path / "x.rrd")
    sides = np.array(rows(tmp_path / "x.rrd", "/world/workspace", "LineStrips3D:strips")[0])
    np.testing.assert_allclose(sides.max(axis=(0, 1)), [1.2, 1.0, 1.5], atol=1e-6)


def test_obstacles_stand_where_they_are_and_are_named(shadowed, recording):
    where = [shadowed.config.obstacles[0].center_m]
    for entity, name, expected in (
        ("box/body", "Boxes3D:half_sizes", [[0.05, 0.05, 0.15]]),
        ("box/body", "Boxes3D:centers", where),
        ("cylinder", "Cylinders3D:centers", [[1.2, 1.2, 0.8]]),
    ):
        drawn = rows(recording, f"/world/obstacles/{entity}", name)[0]
        np.testing.assert_allclose(drawn, expected, atol=1e-6)
    assert rows(recording, "/world/obstacles/names", "Points3D:labels")[0] == ["screen", "pillar"]


def test_the_schedule_has_every_reading_at_its_minute_in_its_loads_series(d, recording):
    drawn = {}
    for k, load in enumerate(PLAN.loads):
        at = rows(recording, f"/schedule/load{k}", "Scalars:scalars")
        steps = [i for i, s in STEPS if s.load == load]
        assert sorted(at) == steps
        drawn |= at
        name = "unloaded" if load == UNLOADED else load
        label = rows(recording, f"/schedule/load{k}", "SeriesPoints:names")[0]
        assert label == [f"{name}: {len(steps)}"]
        color = rows(recording, f"/schedule/load{k}", "SeriesPoints:colors")[0][0]
        assert rgb(color) == tuple(d.colors[k])
    times = np.array([drawn[k][0] for k in range(1, 11)])
    np.testing.assert_allclose(times, d.time / 60.0)
    changes = np.array([a.load != b.load for a, b in zip(PLAN.steps, PLAN.steps[1:], strict=False)])
    gaps = np.diff(times)
    assert gaps[changes].min() > gaps[~changes].max()  # changing a load takes longest


def test_words_are_what_the_terminal_prints(recording):
    details, overview = words(recording, "details"), words(recording)
    assert "| joint_compliance.j1 | 0.040 | 4.00 | µrad/(N·m) | 1.0 % |" in details
    assert "?" not in details
    assert "⚠" not in overview  # remarks are no warnings
    assert "**efficiency** of the plan: at least 98.7 % (certified lower bound)" in overview
    assert "does not see the target in 3 of 10 readings" in overview
    cards = rows(recording, "/words/step", "TextDocument:text")
    assert "Step 6 of 10: p1, under 10kg" in cards[6][0]
    assert "10kg is hung, by hand" in cards[6][0]
    assert "by hand" not in cards[7][0]
    assert "everything is taken off" in cards[10][0]


def test_the_suspects_and_their_powers_come_before_the_plan(tmp_path):
    record_plan(configured(), PLAN, SUMMARY, tmp_path / "next.rrd", POWERS)
    lines = words(tmp_path / "next.rrd").splitlines()
    assert lines[0] == "### Which is it: joint_tilt_compliance or link_compliance?"
    assert "| joint_tilt_compliance | link_compliance | 74 % | 98 % |" in lines[1:6]
    assert "| link_compliance | joint_tilt_compliance | 56 % | not in this cell |" in lines[1:6]
    assert any(line.startswith("### Plan: 3 poses") for line in lines[5:])


def test_no_character_without_a_glyph_reaches_the_viewer(tmp_path):
    bad = "█ |漢⟂ *x*"
    cell = configured(
        loads=[{"name": bad, "mass_kg": 2.0}],
        obstacles=[{"name": bad, "center_m": [2.0, 2.0, 0.0], "size_m": [0.1, 0.1, 0.1]}],
        sight={"tracker_m": TRACKER.tolist()},
    )
    summary = replace(
        SUMMARY,
        criterion=bad,
        loads={bad: 1},
        parameters=(PredictedParameter(bad, 1.0, 2.0, bad),),
        detectable=(DetectableEffect(bad, 1e-6), DetectableEffect(bad, None)),
        remarks=(bad,),
        criteria=(replace(SUMMARY.criteria[0], criterion=bad),),
    )
    made = Plan((bad,), Q[:1], (Step(bad, UNLOADED), Step(bad, bad)))
    record_plan(cell, made, summary, tmp_path / "x.rrd")
    shown_texts = texts(tmp_path / "x.rrd")
    assert len(shown_texts) > 10
    assert [t for t in shown_texts if style.storable(t) != t] == []


def test_what_does_not_fit_is_refused(shadowed, tmp_path):
    with pytest.raises(InputError, match="5 joint angles per pose; ur10e has 6"):
        record_plan(shadowed, replace(PLAN, q=Q[:, :5]), SUMMARY, tmp_path / "x.rrd")
    refusal("no folder", record_plan, shadowed, PLAN, SUMMARY, tmp_path / "none" / "x.rrd")
    assert list(tmp_path.iterdir()) == []


# the eye


def eye_place(path):
    """Where the eye of the first view stands, as the recording says."""
    reader = RrdReader(path)
    (blueprint,) = reader.blueprints()
    name = "EyeControls3D:position"
    batches = (c.to_record_batch() for c in reader.stream(store=blueprint).to_chunks())
    positions = [v for b in batches if name in b.schema.names for v in b.column(name).to_pylist()]
    return np.array(positions[0][0])


def test_a_tripod_before_the_arm_makes_the_eye_go_elsewhere(tmp_path):
    free, path = tmp_path / "free.rrd", tmp_path / "tripod.rrd"
    record_plan(configured(), PLAN, SUMMARY, free)
    preferred = eye_place(free)
    at = [*(0.9 * preferred[:2] / np.linalg.norm(preferred[:2])).tolist(), 0.0]
    tripod = {"name": "tripod", "bottom_m": at, "radius_m": 0.3, "height_m": 1.2}
    cell = configured(obstacles=[tripod])
    record_plan(cell, PLAN, SUMMARY, path)
    arm = PlanView(cell, PLAN, SUMMARY).bodies[:, 1:, :3, 3].reshape(-1, 3)
    assert style.hidden_points(preferred, arm, cell.config.obstacles).mean() > 0.3
    assert style.hidden_points(eye_place(path), arm, cell.config.obstacles).mean() < 0.02


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
    hidden = style.hidden_points(np.array([2.0, 0.0, 0.5]), points, (thing,))
    assert hidden.tolist() == [True, False, False, False]


def test_the_eye_is_as_near_as_shows_everything():
    look, way = np.array([0.0, 0.0, 0.5]), np.array([1.0, -1.3, 0.5])
    corners = np.array([[x, y, z] for x in (-0.6, 0.6) for y in (-0.6, 0.6) for z in (0.0, 1.0)])
    place = style.nearest_eye(look, way, corners)
    assert style.in_view(place, look, corners).all()
    assert not style.in_view(look + 0.9 * (place - look), look, corners).all()
    assert not style.in_view(place, look, (2 * place - look)[None])[0]  # what is behind


@pytest.mark.vulkan
@pytest.mark.slow
@needs_vulkan
def test_every_view_is_drawn_without_a_report(recording, tmp_path):
    names = [plan.STEPS, plan.SCHEDULE, "Plan", "This step", "How to read this", "Details"]
    shots = [Shot(tmp_path / f"{i}.png", "step", 6, name) for i, name in enumerate(names)]
    reports = pictures(recording, shots, (960, 540), 480)
    assert set(names) <= {v.name for v in reports}
    assert any(v.name.startswith(plan.TRACKER) for v in reports)
    assert [v for v in reports if v.problems] == []
    assert all(shot.png.stat().st_size > 1000 for shot in shots)
