"""The recording of a plan, read back: the scene is what is planned."""

import numpy as np

from hilcal.present.viewer import plan, style
from hilcal.present.viewer.plan import HIDDEN, SEEN, TURNED, UNKNOWN, PlanView, record_plan
from hilcal.robot.chain import evaluate
from hilcal.store.plan import REFERENCE, UNLOADED
from tests.support.recordings import entities, rows
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
    strict,
    target,
    turned,
)

__all__ = ["recording", "shadowed", "strict"]  # fixtures


def test_capsules_end_where_they_should_in_any_direction():
    way = np.random.default_rng(1).normal(size=(20, 3))
    way[:3] = [[0.0, 0.0, 0.4], [0.0, 0.0, -0.4], [0.0, 0.0, 0.0]]
    start = np.ones((20, 3))
    made = style.drawn_capsules(start, start + way, np.full(20, 0.1), [(1, 2, 3)])
    quaternion = np.array(made.quaternions.as_arrow_array().to_pylist())
    length = np.array(made.lengths.as_arrow_array().to_pylist())
    np.testing.assert_allclose(length[:, None] * turned(quaternion), way, atol=1e-6)


def test_the_arm_is_drawn_as_what_is_checked_for_collisions(shadowed, recording):
    d = PlanView(*shadowed, PLAN, SUMMARY)
    parts = d.shapes.scene.parts
    drawn = []
    for i in range(7):
        entity = f"/world/arm/body{i}"
        start, length, quaternion, radius = (
            np.array(rows(recording, entity, f"Capsules3D:{name}")[0])
            for name in ("translations", "lengths", "quaternions", "radii")
        )
        drawn += [(i, *x) for x in np.hstack([start, length[:, None], radius[:, None]]).tolist()]
        ends = start + length[:, None] * turned(quaternion)
        np.testing.assert_allclose(ends, [p.end for p in parts if p.body == i], atol=1e-6)
    true = [(p.body, *p.start, np.linalg.norm(p.end - p.start), p.radius) for p in parts]
    np.testing.assert_allclose(sorted(drawn), sorted(true), atol=1e-6)
    assert len(drawn) > 13  # the tool too


def test_arm_and_target_are_in_the_pose_of_every_step(shadowed, recording):
    cell = shadowed[0]
    moves = rows(recording, "/world/arm/body6", "Transform3D:translation")
    now = rows(recording, "/world/target/now", "Points3D:positions")
    assert sorted(moves) == sorted(now) == list(range(1, 11))
    for k, step in enumerate(PLAN.steps, start=1):
        chain = evaluate(cell.arm, PLAN.joints(step.pose)[None])
        flange = np.array(cell.arm.links[6][:3, 3])
        at = chain.point(np.zeros(3))[0] - chain.rotation[-1][0] @ (
            cell.arm.links[6][:3, :3].T @ flange
        )
        np.testing.assert_allclose(moves[k][0], at, atol=1e-6)
        np.testing.assert_allclose(now[k][0], chain.point(cell.target[:3, 3])[0], atol=1e-6)


# the tracker


def test_the_beam_is_red_where_a_screen_stands_and_green_elsewhere(shadowed, recording):
    strips = rows(recording, "/world/beam", "LineStrips3D:strips")
    colors = rows(recording, "/world/beam", "LineStrips3D:colors")
    labels = rows(recording, "/world/label", "Points3D:labels")
    for k, step in enumerate(PLAN.steps, start=1):
        np.testing.assert_allclose(strips[k][0][0], TRACKER, atol=1e-6)
        pose = PLAN.pose_names.index(step.pose)
        np.testing.assert_allclose(strips[k][0][1], target(shadowed[0], pose), atol=1e-6)
        hidden = step.pose == "p1"
        assert rgb(colors[k][0]) == (style.RED if hidden else style.NOISE)
        assert labels[k][0].endswith("hidden" if hidden else "seen")
    cages = rows(recording, "/world/target/unseen", "Ellipsoids3D:centers")[0]
    assert len(cages) == 3  # p1 under three loads
    crosses = rows(recording, "/schedule/unseen", "Scalars:scalars")
    assert sorted(crosses) == [k for k, s in enumerate(PLAN.steps, start=1) if s.pose == "p1"]


def test_a_reflector_that_looks_away_is_told_from_a_hidden_one(shadowed):
    cell, config = shadowed
    way = TRACKER - target(cell, 2)
    normal = evaluate(cell.arm, Q[2:3]).rotation[-1][0].T @ way
    sight = config.sight.model_copy(
        update={"target_normal": tuple(normal), "incidence_max_rad": 0.02}
    )
    d = PlanView(cell, config.model_copy(update={"sight": sight}), PLAN, SUMMARY)
    status = dict(zip((s.pose for s in PLAN.steps), d.sight.tolist(), strict=True))
    assert status == {REFERENCE: TURNED, "p1": HIDDEN, "p2": SEEN, "p3": TURNED}
    assert "incidence" in plan.step_card(d, 0)
    assert "screen between" in plan.step_card(d, 1)
    assert [bool(d.why(k)) for k in range(len(d))] == [s != SEEN for s in d.sight]


def test_without_a_tracker_nothing_is_claimed(tmp_path):
    cell, config = configured()
    path = tmp_path / "x.rrd"
    record_plan(cell, config, PLAN, SUMMARY, path)
    assert not {"/world/beam", "/world/tracker", "/world/target/unseen"} & entities(path)
    d = PlanView(cell, config, PLAN, SUMMARY)
    assert set(d.sight.tolist()) == {UNKNOWN}
    assert not d.unseen.any()
    assert "not known" in plan.overview(d)
    assert "not known" in plan.step_card(d, 0)
    assert not any("seen" in v[0] for v in rows(path, "/world/label", "Points3D:labels").values())


# loads, places, ways


def test_a_weight_hangs_below_the_load_point_while_it_is_hung(shadowed, recording):
    cell = shadowed[0]
    radii = rows(recording, "/world/load/capsules", "Capsules3D:radii")
    starts = rows(recording, "/world/load/capsules", "Capsules3D:translations")
    cleared = rows(recording, "/world/load/capsules", "Clear:is_recursive")
    hung = [k for k, s in enumerate(PLAN.steps, start=1) if s.load == "10kg"]
    assert sorted(radii) == hung
    assert sorted(cleared) == sorted(set(range(1, 11)) - set(hung))
    for k in hung:
        hook = evaluate(cell.arm, PLAN.joints(PLAN.steps[k - 1].pose)[None]).point(cell.load_point)
        off = np.array(starts[k][0]) - hook[0]
        np.testing.assert_allclose(off, [0.0, 0.0, -radii[k][0]], atol=1e-6)


def test_a_pull_is_an_arrow_along_its_force(recording):
    arrows = rows(recording, "/world/load/arrow", "Arrows3D:vectors")
    assert sorted(arrows) == [8, 9]
    assert all(a[0][0] > 0.1 and a[0][1:] == [0.0, 0.0] for a in arrows.values())


def test_one_bead_per_pose_and_load_in_the_loads_colour(shadowed, recording):
    places = np.array(rows(recording, "/world/target/beads", "Points3D:positions")[0])
    colors = [rgb(c) for c in rows(recording, "/world/target/beads", "Points3D:colors")[0]]
    pairs = list(dict.fromkeys((s.pose, s.load) for s in PLAN.steps))
    assert len(places) == len(pairs) == 8
    by_load = dict(zip(PLAN.loads, PlanView(*shadowed, PLAN, SUMMARY).colors.tolist(), strict=True))
    assert len({tuple(c) for c in by_load.values()}) == 3
    for place, color, (pose, load) in zip(places, colors, pairs, strict=True):
        assert list(color) == by_load[load]
        off = place - target(shadowed[0], PLAN.pose_names.index(pose))
        np.testing.assert_allclose(off[:2], 0.0, atol=1e-6)
        assert off[2] >= -1e-6
        assert (off[2] < 1e-6) == (load == UNLOADED)
    assert len(np.unique(places.round(5), axis=0)) == 8  # none is inside another


def test_ways_are_one_path_of_straight_joint_motions(shadowed):
    d = PlanView(*shadowed, PLAN, SUMMARY)
    assert len(d.ways) == len(PLAN.steps)
    for k, way in enumerate(d.ways):
        np.testing.assert_allclose(way[-1], d.target[k], atol=1e-12)
        if k:
            np.testing.assert_allclose(way[0], d.target[k - 1], atol=1e-12)
    half = evaluate(shadowed[0].arm, 0.5 * (Q[1:2] + Q[2:3])).point(shadowed[0].target[:3, 3])
    near = np.linalg.norm(d.ways[2] - half, axis=1).min()
    step = np.linalg.norm(np.diff(d.ways[2], axis=0), axis=1).max()
    assert near <= step
    changed = d.ways[5]  # a weight is hung at the reference pose on the way
    np.testing.assert_allclose(np.linalg.norm(changed - d.target[0], axis=1).min(), 0, atol=1e-12)


def test_only_sides_of_the_workspace_that_are_given_are_drawn(recording, tmp_path):
    sides = np.array(rows(recording, "/world/workspace", "LineStrips3D:strips")[0])
    assert sides.shape == (3, 5, 3)
    low = np.array([-1.6, -1.6, 0.05])
    for axis, side in enumerate(sides):
        np.testing.assert_allclose(side[:, axis], low[axis], atol=1e-6)
    cell, config = configured(limits={"workspace_max_m": [1.2, 1.0, 1.5]})
    record_plan(cell, config, PLAN, BARE, tmp_path / "x.rrd")
    sides = np.array(rows(tmp_path / "x.rrd", "/world/workspace", "LineStrips3D:strips")[0])
    np.testing.assert_allclose(sides.max(axis=(0, 1)), [1.2, 1.0, 1.5], atol=1e-6)


def test_obstacles_stand_where_they_are_and_are_named(shadowed, recording):
    config = shadowed[1]
    box = rows(recording, "/world/obstacles/box/body", "Boxes3D:half_sizes")[0]
    np.testing.assert_allclose(box, [[0.05, 0.05, 0.15]], atol=1e-6)
    where = rows(recording, "/world/obstacles/box/body", "Boxes3D:centers")[0]
    np.testing.assert_allclose(where, [config.obstacles[0].center_m], atol=1e-6)
    middle = rows(recording, "/world/obstacles/cylinder", "Cylinders3D:centers")[0]
    np.testing.assert_allclose(middle, [[1.2, 1.2, 0.8]], atol=1e-6)
    assert rows(recording, "/world/obstacles/names", "Points3D:labels")[0] == ["screen", "pillar"]
