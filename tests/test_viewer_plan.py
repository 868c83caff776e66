"""The recording of a plan, read back: what is planned is what the viewer gets."""

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.data.plan import REFERENCE, UNLOADED, Plan, Step
from hilcal.errors import InputError
from hilcal.plan.story import Bought, Enough, OrderStory, PlanStory, Promised, Seen
from hilcal.report.picture import Shot, executable, pictures, vulkan_available
from hilcal.report.viewer import plan_cell, plan_layout, plan_style, plan_words, style
from hilcal.report.viewer.plan_charts import HEIGHT, LONG
from hilcal.report.viewer.plan_digest import HIDDEN, SEEN, TURNED, UNKNOWN, plan_digest
from hilcal.report.viewer.plan_promises import shown_parameters
from hilcal.report.viewer.plan_stream import record_plan
from hilcal.robot.chain import evaluate

CELL = Path(__file__).parents[1] / "configs" / "cells" / "demo_ur10e.toml"
TRACKER = np.array([-2.5, 1.0, 1.3])
Q = np.array(
    [
        [-0.6, -1.6, 1.6, -1.6, -1.5, 0.0],
        [0.4, -1.3, 1.2, -1.4, -1.4, 0.5],
        [-1.5, -1.8, 1.9, -1.7, -1.3, -0.4],
        [0.9, -2.0, 1.7, -1.2, -1.6, 0.9],
    ]
)
PLAN = Plan(
    (REFERENCE, "p1", "p2", "p3"),
    Q,
    (
        Step(REFERENCE, UNLOADED),
        Step("p1", UNLOADED),
        Step("p2", UNLOADED),
        Step("p3", UNLOADED),
        Step(REFERENCE, UNLOADED, 1),
        Step("p1", "10kg"),
        Step("p2", "10kg"),
        Step("p3", "pull x"),
        Step("p1", "pull x"),
        Step(REFERENCE, UNLOADED, 2),
    ),
)
STORY = PlanStory(
    poses=3,
    readings=10,
    loads={UNLOADED: 6, "10kg": 2, "pull x": 2},
    load_changes=3,
    motion_s=60.0,
    readings_s=90.0,
    load_changes_s=180.0,
    criterion="D",
    efficiency=0.98768,
    predicted=(
        Promised("joint_compliance.j1", 4e-8, 4e-6, "rad/(N·m)"),
        Promised("joint_compliance.j2", 6e-7, 6e-6, "rad/(N·m)"),
        Promised("target_offset.x", 2.2e-5, 0.0, "m"),
        Promised("base_frame.x", 1.2e-5, None, "m"),
    ),
    position_std_m=12e-6,
    bought=(
        Bought("D", 12e-6, 24e-6, 0.038, 132.0, 0.02, 4.0, 0.98768),
        Bought("test", 9e-6, 30e-6, None, 66.0, 0.01, 2.0, None),
    ),
    curve=(Enough(2, 24e-6), Enough(3, 12e-6), Enough(6, 8e-6)),
    seen=(Seen("hysteresis", 6e-6), Seen("tracker_drift", None)),
    order=OrderStory(0.03, 0.02, 0.4, 5e-9, 5e-6, 0.0, None),
    remarks=("only 3 candidates are left of load 10kg.",),
)
BARE = PlanStory(3, 10, {UNLOADED: 10}, 0, 1.0, 2.0, 0.0, "made by hand", None, (), None)


@pytest.fixture(autouse=True)
def _strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def configured(**sections: object) -> tuple[Cell, CellConfig]:
    """Return the demo's cell with some sections of its own."""
    told = load_config(CELL).model_dump(mode="json", exclude_none=True)
    config = CellConfig.model_validate(told | sections)
    return cell_from_config(config), config


def target(cell: Cell, pose: int) -> np.ndarray:
    return evaluate(cell.arm, Q[pose : pose + 1]).point(cell.target[:3, 3])[0]


@pytest.fixture(scope="module")
def shadowed() -> tuple[Cell, CellConfig]:
    """A screen stands between the tracker and the target in pose p1; a pillar stands apart."""
    cell, _ = configured()
    middle = 0.45 * target(cell, 1) + 0.55 * TRACKER
    return configured(
        obstacles=[
            {"name": "screen", "center_m": middle.tolist(), "size_m": [0.1, 0.1, 0.3]},
            {"name": "pillar", "bottom_m": [1.2, 1.2, 0.0], "radius_m": 0.1, "height_m": 1.6},
        ],
        sight={"tracker_m": TRACKER.tolist()},
    )


@pytest.fixture(scope="module")
def recording(shadowed, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("plan") / "plan.rrd"
    record_plan(*shadowed, PLAN, STORY, path)
    return path


def rows(path: Path, entity: str, component: str) -> dict[int, list]:
    """Return the values of a component by step, under 0 what is static."""
    out: dict[int, list] = {}
    for chunk in RrdReader(path).stream().filter(content=entity).to_chunks():
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        values = batch.column(component).to_pylist()
        steps = batch.column("step").to_pylist() if "step" in batch.schema.names else [0]
        out |= {int(t): v for t, v in zip(steps, values, strict=True) if v is not None}
    return out


def entities(path: Path) -> set[str]:
    return {str(c.entity_path) for c in RrdReader(path).stream().to_chunks()}


def rgb(value: int) -> tuple[int, int, int]:
    return value >> 24 & 255, value >> 16 & 255, value >> 8 & 255


def turned(quaternion: np.ndarray) -> np.ndarray:
    """(K, 3) where quaternions x y z w lead the z axis."""
    x, y, z, w = np.asarray(quaternion).T
    return np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], 1)


# the arm


def test_capsules_end_where_they_should_in_any_direction():
    way = np.random.default_rng(1).normal(size=(20, 3))
    way[:3] = [[0.0, 0.0, 0.4], [0.0, 0.0, -0.4], [0.0, 0.0, 0.0]]
    start = np.ones((20, 3))
    made = plan_cell.capsules(start, start + way, np.full(20, 0.1), [(1, 2, 3)])
    quaternion = np.array(made.quaternions.as_arrow_array().to_pylist())
    length = np.array(made.lengths.as_arrow_array().to_pylist())
    np.testing.assert_allclose(length[:, None] * turned(quaternion), way, atol=1e-6)


def test_the_arm_is_drawn_as_what_is_checked_for_collisions(shadowed, recording):
    d = plan_digest(*shadowed, PLAN, STORY)
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
    frames = rows(recording, "/schedule/unseen", "Boxes2D:centers")[0]
    assert len(frames) == 3


def test_a_reflector_that_looks_away_is_told_from_a_hidden_one(shadowed):
    cell, config = shadowed
    way = TRACKER - target(cell, 2)
    normal = evaluate(cell.arm, Q[2:3]).rotation[-1][0].T @ way
    sight = config.sight.model_copy(
        update={"target_normal": tuple(normal), "incidence_max_rad": 0.02}
    )
    d = plan_digest(cell, config.model_copy(update={"sight": sight}), PLAN, STORY)
    status = dict(zip((s.pose for s in PLAN.steps), d.sight.tolist(), strict=True))
    assert status == {REFERENCE: TURNED, "p1": HIDDEN, "p2": SEEN, "p3": TURNED}
    assert "incidence" in plan_words.step_card(d, 0)
    assert "screen between" in plan_words.step_card(d, 1)
    assert [bool(w) for w in d.why] == [s != SEEN for s in d.sight]


def test_without_a_tracker_nothing_is_claimed(tmp_path):
    cell, config = configured()
    path = tmp_path / "x.rrd"
    record_plan(cell, config, PLAN, STORY, path)
    assert not {"/world/beam", "/world/tracker", "/world/target/unseen"} & entities(path)
    d = plan_digest(cell, config, PLAN, STORY)
    assert set(d.sight.tolist()) == {UNKNOWN}
    assert not d.unseen.any()
    assert "not known" in plan_words.summary(d)
    assert "not known" in plan_words.step_card(d, 0)
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
    by_load = dict(zip(PLAN.loads, plan_style.load_colors(PLAN.loads).tolist(), strict=True))
    assert len({tuple(c) for c in by_load.values()}) == 3
    for place, color, (pose, load) in zip(places, colors, pairs, strict=True):
        assert list(color) == by_load[load]
        off = place - target(shadowed[0], PLAN.pose_names.index(pose))
        np.testing.assert_allclose(off[:2], 0.0, atol=1e-6)
        assert off[2] >= -1e-6
        assert (off[2] < 1e-6) == (load == UNLOADED)
    assert len(np.unique(places.round(5), axis=0)) == 8  # none is inside another


def test_ways_are_one_path_of_straight_joint_motions(shadowed):
    d = plan_digest(*shadowed, PLAN, STORY)
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


# charts and words


def test_the_schedule_has_every_reading_in_time_and_in_its_loads_row(recording):
    dots = np.array(rows(recording, "/schedule/readings", "Points2D:positions")[0])
    assert len(dots) == 10
    assert np.all(np.diff(dots[:, 0]) > 0)
    assert dots[-1, 0] <= LONG
    heights = {s.load: {y} for s, y in zip(PLAN.steps, dots[:, 1], strict=True)}
    for s, y in zip(PLAN.steps, dots[:, 1], strict=True):
        heights[s.load].add(y)
    assert [len(h) for h in heights.values()] == [1, 1, 1]
    now = rows(recording, "/schedule/now", "LineStrips2D:strips")
    np.testing.assert_allclose([now[k][0][0][0] for k in range(1, 11)], dots[:, 0], rtol=1e-6)
    gaps = np.diff(dots[:, 0])
    changes = [a.load != b.load for a, b in zip(PLAN.steps, PLAN.steps[1:], strict=False)]
    assert gaps[changes].min() > gaps[~np.array(changes)].max()  # changing a load takes longest


def test_the_curve_falls_as_the_numbers_and_the_plan_is_marked(recording):
    at = np.array(rows(recording, "/curve/points", "Points2D:positions")[0])
    np.testing.assert_allclose((HEIGHT - at[:, 1]) / (HEIGHT - at[0, 1]), [1, 1 / 2, 1 / 3])
    np.testing.assert_allclose(at[:, 0] / at[0, 0], [1, 1.5, 3], rtol=1e-6)
    colors = [rgb(c) for c in rows(recording, "/curve/points", "Points2D:colors")[0]]
    assert [c == style.MEASURED for c in colors] == [False, True, False]
    assert "3 poses, ± 12.0 µm" in rows(recording, "/curve/plan", "Points2D:labels")[0][0]


def test_parameters_of_no_size_are_in_the_table_but_not_in_the_chart(recording):
    assert [p.name for p in shown_parameters(STORY)] == [
        "joint_compliance.j1",
        "joint_compliance.j2",
    ]
    assert rows(recording, "/parameters/shares", "Points2D:labels")[0] == ["1.0 %", "10 %"]
    at = np.array(rows(recording, "/parameters/points", "Points2D:positions")[0])
    ticks = np.array(rows(recording, "/parameters/ticks", "Points2D:positions")[0])
    words = rows(recording, "/parameters/ticks", "Points2D:labels")[0]
    np.testing.assert_allclose(at[:, 0], [ticks[words.index(w), 0] for w in ("1 %", "10 %")])
    table = rows(recording, "/words/parameters", "TextDocument:text")[0][0].replace("\\", "")
    assert "| base_frame.x | 12 µm |" in table
    assert "| target_offset.x | 22 µm |" in table


def test_criteria_have_bars_in_proportion(recording):
    bars = np.array(rows(recording, "/bought/bars", "LineStrips2D:strips")[0])
    colors = [rgb(c) for c in rows(recording, "/bought/bars", "LineStrips2D:colors")[0]]
    length = bars[:, 1, 0] - bars[:, 0, 0]
    own = [c == style.MEASURED for c in colors]
    assert own == [True, False, True, False, True, True, False, True, False, True, False]
    full = length.max()
    expected = [1, 0.75, 0.8, 1, 1, 1, 0.5, 1, 0.5, 1, 0.5]
    np.testing.assert_allclose(length / full, expected, rtol=1e-5)
    values = rows(recording, "/bought/values", "Points2D:labels")[0]
    assert values[:6] == ["12.0 µm", "9.00 µm", "24.0 µm", "30.0 µm", "3.8 %", "-"]


def test_the_summary_tells_what_the_plan_costs_and_promises(recording):
    text = rows(recording, "/words/plan", "TextDocument:text")[0][0].replace("\\", "")
    for told in (
        "Plan: 3 poses, 10 readings",
        "At least 98.7 % of the best possible",
        "unloaded 6, 10kg 2, pull x 2",
        "3 load changes by hand 3 min",
        "± 12.0 µm",
        "does not see the target in 3 of 10 readings",
        "hysteresis from 6.00 µm",
        "cannot show tracker_drift",
        "only 3 candidates are left of load 10kg.",
    ):
        assert told in text
    cards = rows(recording, "/words/step", "TextDocument:text")
    assert "Step 6 of 10: p1, under 10kg" in cards[6][0]
    assert "10kg is hung, by hand" in cards[6][0]
    assert "by hand" not in cards[7][0]
    assert "everything is taken off" in cards[10][0]


def test_what_a_story_lacks_has_no_view(tmp_path):
    cell, config = configured()
    record_plan(cell, config, PLAN, BARE, tmp_path / "x.rrd")
    assert not {"/curve/line", "/parameters/points", "/bought/bars"} & entities(tmp_path / "x.rrd")
    text = rows(tmp_path / "x.rrd", "/words/plan", "TextDocument:text")[0][0]
    for word in ("best possible", "±", "None", "nan", "drift"):
        assert word not in text


def test_equal_plans_give_equal_recordings(shadowed, recording, tmp_path):
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    record_plan(*shadowed, PLAN, STORY, again)
    record_plan(*shadowed, replace(PLAN, steps=PLAN.steps[:-1]), STORY, other)
    compared = [
        subprocess.run(
            [executable(), "rrd", "compare", str(recording), str(path)],
            capture_output=True,
            check=False,
        ).returncode
        for path in (again, other)
    ]
    assert compared[0] == 0
    assert compared[1] != 0


def test_no_character_without_a_glyph_reaches_the_viewer(tmp_path):
    bad = "█ |漢⟂ *x*"
    cell, config = configured(
        loads=[{"name": bad, "mass_kg": 2.0}],
        obstacles=[{"name": bad, "center_m": [2.0, 2.0, 0.0], "size_m": [0.1, 0.1, 0.1]}],
        sight={"tracker_m": TRACKER.tolist()},
    )
    plan = Plan((bad,), Q[:1], (Step(bad, UNLOADED), Step(bad, bad)))
    story = replace(
        STORY,
        criterion=bad,
        loads={bad: 1},
        predicted=(Promised(bad, 1.0, 2.0, bad),),
        seen=(Seen(bad, 1e-6), Seen(bad, None)),
        remarks=(bad,),
        bought=(replace(STORY.bought[0], criterion=bad),),
    )
    path = tmp_path / "x.rrd"
    record_plan(cell, config, plan, story, path)
    found = []
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith((":text", ":labels", ":names", ":name")):
                found += [t for row in batch.column(name).to_pylist() for t in row or []]
    assert len(found) > 20
    assert [t for t in found if style.safe(t) != t] == []


def test_what_does_not_fit_is_refused(shadowed, tmp_path):
    with pytest.raises(InputError, match="5 joint angles per pose; ur10e has 6"):
        record_plan(*shadowed, replace(PLAN, q=Q[:, :5]), STORY, tmp_path / "x.rrd")
    with pytest.raises(InputError, match="no folder"):
        record_plan(*shadowed, PLAN, STORY, tmp_path / "none" / "x.rrd")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.vulkan
@pytest.mark.slow
@pytest.mark.skipif(not vulkan_available(), reason="no Vulkan driver installed")
def test_every_view_is_drawn_without_a_report(recording, shadowed, tmp_path):
    names = [plan_layout.STEPS, plan_layout.SCHEDULE, plan_layout.CURVE, plan_layout.BOUGHT]
    names += [plan_layout.parameters_title(plan_digest(*shadowed, PLAN, STORY))]
    names += ["Plan", "This step", "How to read this", "Parameters", "Criteria"]
    shots = [Shot(tmp_path / f"{i}.png", "step", 6, name) for i, name in enumerate(names)]
    reports = pictures(recording, shots, (960, 540), 480)
    assert set(names) <= {v.name for v in reports}
    assert any(v.name.startswith(plan_layout.TRACKER) for v in reports)
    assert [v for v in reports if v.problems] == []
    assert all(shot.png.stat().st_size > 1000 for shot in shots)
