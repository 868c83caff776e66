"""Candidate poses and motions: none ever breaks a limit, and what leaves nothing is named."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilcal.cell import cell_from_config, tracker_place
from hilcal.design.feasible import REASONS, FeasibleSpace, draw_poses
from hilcal.errors import CannotAnswerError
from hilcal.measuring.feasibility import BETWEEN_M, STATE_CHECKS, Feasibility, Margins
from hilcal.measuring.motion import SLACK_M, Guard
from hilcal.measuring.route import Stop, dry_run, route_problems
from hilcal.robot.catalogue import load_arm
from hilcal.store.plan import UNLOADED, Plan, Step
from tests.support.arm_cases import ODD, arm_of
from tests.support.fake_bench import Bench
from tests.support.refusals import refusal_of
from tests.support.serial_urdf import serial_urdf
from tests.support.space_cases import (
    TABLE,
    along,
    boxes,
    cell,
    conditioning,
    drawn_of,
    extent,
    frames,
    gap,
    gap_to,
    hung,
    least_distance,
    place,
    placed,
    self_gap,
    space_of,
    torques,
)

cells = st.fixed_dictionaries(
    {
        "robot": st.sampled_from(["ur3e", "ur5e", "ur10e", "ur16e", "ur20"]).map(
            lambda m: {"model": m}
        ),
        "obstacles": boxes.map(lambda box: [TABLE, box]),
        "limits": st.builds(
            lambda margin, low, share: {
                "joint_margin_rad": margin,
                "workspace_min_m": [-1.5, -1.5, low],
                "workspace_max_m": [1.5, 1.5, 2.0],
                "torque_share": share,
            },
            st.floats(0.0, 0.5),
            st.floats(-0.2, 0.2),
            st.floats(0.2, 0.7),
        ),
        "sight": st.builds(
            lambda at, normal, most: {
                "tracker_m": at,
                "target_normal": normal,
                "incidence_max_rad": most,
            },
            place,
            st.sampled_from([None, [0.0, 0.0, 1.0], [1.0, 0.5, 0.2]]),
            st.floats(0.4, 1.5),
        ),
        "loads": st.builds(
            lambda mass, hang, pull, cable: [
                {"name": "weight", "mass_kg": mass, "hang_m": hang},
                {"name": "pull", "force_N": list(pull), "cable_m": cable},
            ],
            st.floats(0.5, 2.5),
            st.floats(0.05, 0.5),
            st.tuples(*[st.floats(10.0, 40.0)] * 3),
            st.floats(0.0, 0.6),
        ),
    }
)


@pytest.mark.long
@settings(max_examples=8, deadline=None)
@given(cells, st.integers(0, 99))
def test_no_candidate_ever_breaks_a_limit(sections, seed):
    """Each limit is looked at by other means than the planner's."""
    config = cell(**sections)
    space = space_of(config)
    try:
        drawn = draw_poses(space, 15, np.random.default_rng(seed))
    except CannotAnswerError:
        return
    assert drawn.loads == (UNLOADED, "weight", "pull")
    assert drawn.allowed[:, 0].all()
    for q, allowed in zip(drawn.q, drawn.allowed, strict=True):
        _geometry(config, space, q)
        for name, may in zip(drawn.loads, allowed, strict=True):
            if may:
                _under_load(config, space, q, name)


def _geometry(config, space, q):
    arm, limits, the_cell = space.cell.arm, config.limits, space.cell
    low, high = arm.q_min + limits.joint_margin_rad, arm.q_max - limits.joint_margin_rad
    assert np.all(q >= low)
    assert np.all(q <= high)
    at, parts = frames(arm, q), space.shapes.scene.parts
    flange = at[-1]
    for offset in (np.zeros(3), the_cell.target[:3, 3], the_cell.load_point):
        point = flange[:3, :3] @ offset + flange[:3, 3]
        assert np.all(point > limits.workspace_min_m)
        assert np.all(point < limits.workspace_max_m)
    assert self_gap(parts, at) > 0.01 - 1e-9
    for part in parts:
        points = placed(part, at)
        if part.body > 2:
            assert np.all(points.min(axis=0) - part.radius > limits.workspace_min_m)
            assert np.all(points.max(axis=0) + part.radius < limits.workspace_max_m)
        for thing in config.obstacles if part.body > 1 else ():
            assert gap_to(thing, points) - part.radius > 0.02 - 1e-9
    assert conditioning(arm, q) >= config.planning.singularity * (1 - 1e-6)
    if config.sight.target_normal is not None:
        tracker = np.array(config.sight.tracker_m)
        way = tracker - (flange[:3, :3] @ the_cell.target[:3, 3] + flange[:3, 3])
        looks = flange[:3, :3] @ np.array(config.sight.target_normal)
        cosine = looks @ way / np.linalg.norm(looks) / np.linalg.norm(way)
        assert np.arccos(cosine) <= config.sight.incidence_max_rad + 1e-9


def _under_load(config, space, q, name):
    arm, the_cell = space.cell.arm, space.cell
    at, parts = frames(arm, q), space.shapes.scene.parts
    load = next((x for x in config.loads if x.name == name), None)
    force = np.zeros(3) if load is None else load.wrench(the_cell.gravity)[:3]
    most = config.limits.torque_share * np.asarray(arm.torque_max)
    assert np.all(np.abs(torques(the_cell, q, force)) <= most)
    assert the_cell.tool_mass + (0.0 if load is None else load.mass_kg) <= arm.payload
    flange = at[-1]
    target = flange[:3, :3] @ the_cell.target[:3, 3] + flange[:3, 3]
    tracker = np.array(config.sight.tracker_m)
    way = tracker - target
    beam = along(tracker, target + 0.09 * way / np.linalg.norm(way))
    clear = config.sight.clearance_m
    for part in parts:
        if not part.name.startswith("tool at"):
            assert gap(placed(part, at), beam) > part.radius + clear - 1e-9
    for thing in config.obstacles:
        assert gap_to(thing, beam) > clear - 1e-9 or gap_to(thing, tracker[None]) <= clear
    for points, radius in [] if load is None else hung(the_cell, space.shapes, q, name):
        assert gap(points, beam) > radius + clear - 1e-9
        assert np.all(points.min(axis=0) - radius > config.limits.workspace_min_m)
        assert np.all(points.max(axis=0) + radius < config.limits.workspace_max_m)
        for thing in config.obstacles:
            assert gap_to(thing, points) > radius + 0.02 - 1e-9
        for part in parts:
            if part.body < arm.n:
                assert gap(placed(part, at), points) > part.radius + radius + 0.02 - 1e-9


def test_reasons_are_told_one_by_one_in_order():
    config = cell(obstacles=[TABLE], sight={"tracker_m": [-3.0, 0.0, 1.0]})
    space = space_of(config)
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (300, 6))
    reasons = space.reasons(q, "5kg")
    assert list(reasons) == list(REASONS)
    np.testing.assert_array_equal(np.all(list(reasons.values()), axis=0), space.allowed(q, "5kg"))
    assert reasons["payload"].all()
    for reason in ("self-collision", "obstacle", "singularity", "sight", "hanging"):
        assert 0 < reasons[reason].sum() < 300


NOTHING = {
    "no visible pose": (
        {
            "sight": {
                "tracker_m": [3, 0, 0],
                "target_normal": [0, 0, 1],
                "incidence_max_rad": 1e-4,
            },
            "limits": {"workspace_min_m": [-1.0, -1.0, 0.1]},
        },
        r"no pose: of [\d,]+ drawn states [\d,]+ keep workspace and floor, 0 turn the target "
        r"to the tracker \(\[sight\] incidence_max_rad",
    ),
    "a wall before the tracker": (
        {
            "sight": {"tracker_m": [3.0, 0.0, 0.5]},
            "obstacles": [{"name": "wall", "center_m": [2, 0, 0], "size_m": [0.1, 20, 20]}],
        },
        r"0 leave the beam free \(\[sight\] clearance_m, \[\[obstacles\]\]",
    ),
    "a box that is too small": (
        {"limits": {"workspace_min_m": [0.3, 0.3, 0.3], "workspace_max_m": [0.32, 0.32, 0.32]}},
        r"no pose: of 32,768 drawn states 0 keep workspace and floor \(\[limits\] workspace_min_m",
    ),
    "walled in": (
        {"obstacles": [{"name": "block", "center_m": [0, 0, 1], "size_m": [4, 4, 4]}]},
        r"0 are clear of obstacles \(.+ and block touch in \d+ % of the others; look at \[\[obst",
    ),
    "no regular pose": ({"planning": {"singularity": 0.9}}, r"0 are not singular \(\[planning\] "),
    "weak": ({"limits": {"torque_share": 0.001}}, r"0 keep the joint torques \(\[limits\] torque_"),
    "a tool too heavy": ({"tool": {"mass_kg": 13.0}}, r"0 keep the payload \(\[tool\] mass_kg"),
    "no range": ({"limits": {"joint_margin_rad": 3.2}}, "joint_margin_rad leaves joint 1 no range"),
    "payload too large": (
        {"loads": [{"name": "20kg", "mass_kg": 20.0}]},
        r'load "20kg": tool and load are 20.8 kg; the payload of ur10e is 12.5 kg',
    ),
    "all loads too large": (
        {"loads": [{"name": f"{m} kg", "mass_kg": m} for m in (20.0, 30.0)]},
        r'load "20.0 kg": tool and load are 20.8 kg.*; load "30.0 kg": tool and load are 30.8',
    ),
    "a cable too long": (
        {"loads": [{"name": "down", "force_N": [0.0, 0.0, -50.0], "cable_m": 5.0}]},
        r'load "down": no pose: of [\d,]+ feasible poses 0 let what hangs or pulls hang free '
        r"\(\[\[loads\]\] hang_m",
    ),
    "a sensor too weak": (
        {
            "loads": [{"name": "10kg", "mass_kg": 10.0}],
            "force_sensor": {"driver": "x", "port": "y", "max_force_N": 50.0},
        },
        r'load "10kg": no pose: .* 0 keep the force sensor\'s range \(\[force_sensor\]',
    ),
}


@pytest.mark.parametrize(("sections", "message"), NOTHING.values(), ids=NOTHING.keys())
def test_what_leaves_nothing_is_named(sections, message):
    refusal_of(CannotAnswerError, message, lambda: drawn_of(cell(**sections)))


def test_too_few_is_told_by_what_takes_most():
    sight = {"tracker_m": [3, 0, 0.5], "target_normal": [0, 0, 1], "incidence_max_rad": 0.05}
    with pytest.raises(CannotAnswerError, match=r"only \d+ poses, 5,000 are needed: .* turn the t"):
        drawn_of(cell(sight=sight), 5000, min_poses=5000, max_states=1 << 16)


def test_one_load_that_cannot_be_hung_is_a_remark():
    loads = [{"name": "20kg", "mass_kg": 20.0}, {"name": "2kg", "mass_kg": 2.0}]
    drawn = drawn_of(cell(loads=loads), 30)
    assert not drawn.allowed[:, 1].any()
    assert drawn.allowed[:, 2].any()
    assert any('load "20kg": tool and load are 20.8 kg' in line for line in drawn.remarks)


def test_where_the_tracker_stands():
    """Of a registration: T_sensor_base maps base into tracker coordinates."""
    known = {"base_xyz_m": [2.0, 1.0, -0.5], "base_rotvec_rad": [0.0, 0.0, np.pi / 2]}
    config = cell(tracker=known)
    # the tracker's origin p: R p + t = 0 with R a quarter turn
    at = tracker_place(cell_from_config(config))
    np.testing.assert_allclose(at, [-1.0, 2.0, 0.5], atol=1e-12)
    for sections, station in (
        ({"tracker": {"frame": "base", "station_m": [1, 2, 3]}}, [1, 2, 3]),
        ({"tracker": {"frame": "base"}, "sight": {"tracker_m": [3, 2, 1]}}, [3, 2, 1]),
        ({"sight": {"tracker_m": [3, 2, 1]}}, [3, 2, 1]),
        ({}, None),
        ({"tracker": {"frame": "base"}}, None),
    ):
        config = cell(**sections)
        at = tracker_place(cell_from_config(config))
        assert (at is None) == (station is None)
        assert station is None or np.array_equal(at, station)
    assert any("tracker's place is not known" in line for line in drawn_of(cell(), 5).remarks)


def test_a_tripod_under_the_tracker_is_not_in_its_way():
    tripod = {"name": "tripod", "bottom_m": [2.5, 0.0, -1.0], "radius_m": 0.4, "height_m": 1.8}
    config = cell(obstacles=[TABLE, tripod], sight={"tracker_m": [2.5, 0.0, 0.8]})
    assert len(drawn_of(config, 30).q) == 30


def plan_of(q, *steps):
    names = ("reference", *(f"p{k}" for k in range(1, len(q))))
    return Plan(names, q, tuple(Step(*step) for step in steps))


def problems(config, *states, load=UNLOADED):
    plan = plan_of(np.array(states, dtype=float), ("p1", load))
    return dry_run(cell_from_config(config), plan).problems


HOME = (0.0, -1.2, 1.5, -1.5, -1.5, 0.0)


def test_an_edited_plan_that_collides_is_refused_by_name():
    config = cell(obstacles=[TABLE])
    assert problems(config, HOME, (0.5, -1.0, 1.4, -1.2, -1.2, 0.3)) == ()
    folded = problems(config, HOME, (0.0, -1.5, 3.0, -1.5, -1.5, 0.0))
    expected = "pose p1: upper arm and wrist 1 collide: they overlap by "
    assert any(line.startswith(expected) for line in folded), folded
    low = problems(config, HOME, (0.0, 0.4, 0.3, -1.5, -1.5, 0.0))
    assert any(line.startswith("pose p1: forearm and table collide") for line in low)
    # what the ends do not show: over to the other side, through a post
    post = {"name": "post", "bottom_m": [-0.8, -0.2, 0.0], "radius_m": 0.05, "height_m": 2.0}
    config = cell(obstacles=[post])
    between = problems(config, (0.8, *HOME[1:]), (-0.8, *HOME[1:]))
    assert between
    assert all(line.startswith("between reference and p1") for line in between)
    assert any("and post collide: they overlap by" in line for line in between)


def test_what_hangs_is_seen_by_the_dry_run():
    limits = {"workspace_min_m": [-3.0, -3.0, 0.0]}
    config = cell(obstacles=[TABLE], limits=limits)
    up = (0.0, -1.2, 1.5, -1.9, 1.57, 0.0)  # the load point above the wrist
    assert problems(config, HOME, up) == ()
    refusals = problems(config, HOME, up, load="5kg")
    assert any("wrist 3 and what hangs (5kg) collide" in line for line in refusals), refusals
    long = [{"name": "5kg", "mass_kg": 5.0, "hang_m": 1.5}]
    refusals = problems(cell(limits=limits, loads=long), HOME, HOME, load="5kg")
    assert any(
        "what hangs (5kg) is" in line and "outside the workspace" in line for line in refusals
    )


def test_what_the_tracker_would_not_see_is_seen_by_the_dry_run():
    sight = {"tracker_m": [3.0, 0.0, 0.6]}
    config = cell(sight=sight)
    away = (np.pi, *HOME[1:])  # the tool on the tracker's side
    assert problems(config, away, away) == ()
    behind = problems(config, away, HOME)
    assert any("pose p1: " in line and "between tracker and target" in line for line in behind)
    config = cell(sight=sight | {"target_normal": [0.0, 0.0, 1.0], "incidence_max_rad": 0.3})
    assert any("incidence_max_rad is 0.3" in line for line in problems(config, away, away))


GEOMETRY = ("joint limits", "workspace", "self-collision", "obstacle", "hanging")
URDF = "urdf"
"""Six joints, a shape that nobody knows."""


PLACES = ("0 0 0.2", "0 0.1 0", "0 -0.1 0.5", "0 0 0.45", "0 0.1 0", "0 0 0.1")
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1", "0 1 0")
LAB = serial_urdf(
    [{"xyz": at, "axis": axis, "mass": 3, "lower": -3, "upper": 3, "effort": 300}
     for at, axis in zip(PLACES, AXES, strict=True)]
)  # fmt: skip


def arm(name):
    return load_arm("lab.urdf", text=LAB) if name == URDF else arm_of(name)


@st.composite
def cells_of_same_feasibility(draw):
    """Any arm with targets, loads, obstacles and a workspace, or without."""
    limits = {"joint_margin_rad": draw(st.sampled_from([0.0, 0.3]))}
    if draw(st.booleans()):
        sides = [-draw(st.floats(0.2, 1.5)) for _ in range(2)]
        limits["workspace_min_m"] = [*sides, draw(st.floats(-0.6, 0.3))]
    if draw(st.booleans()):
        limits["workspace_max_m"] = [draw(st.floats(0.4, 1.5)) for _ in range(3)]
    place = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-0.3, 1.2))
    size = st.tuples(*[st.floats(0.02, 0.4)] * 3)
    things = draw(st.lists(st.tuples(place, size), max_size=2))
    offsets = draw(st.lists(st.tuples(*[st.floats(-0.3, 0.3)] * 3), min_size=1, max_size=3))
    tool = {"load_point_m": draw(st.tuples(*[st.floats(-0.15, 0.15)] * 3)), "mass_kg": 1.0}
    if len(offsets) > 1:
        tool["targets"] = [{"name": f"t{k}", "target_m": at} for k, at in enumerate(offsets)]
    else:
        tool["target_m"] = offsets[0]
    pull = draw(st.tuples(*[st.floats(-40.0, 40.0)] * 2, st.floats(5.0, 40.0)))
    config = cell(
        tool=tool,
        limits=limits,
        obstacles=[
            {"name": f"box {k}", "center_m": at, "size_m": wide}
            for k, (at, wide) in enumerate(things)
        ],
        loads=[
            {"name": "weight", "mass_kg": 2.0, "hang_m": draw(st.floats(0.05, 0.6))},
            {"name": "pull", "force_N": pull, "cable_m": draw(st.floats(0.05, 0.8))},
        ],
        force_sensor={"driver": "x", "port": "y", "max_force_N": 300, "max_moment_Nm": 12},
    )
    name = draw(st.sampled_from(["ur3e", "ur5", "ur10", "ur10e", "ur20", URDF, ODD]))
    return replace(cell_from_config(config), arm=arm(name))


SAMPLE = Bench().rig.arm.sample()
SEED = st.integers(0, 10_000)
LOAD = st.sampled_from([UNLOADED, "weight", "pull"])


def states(c, seed, count):
    """States (N, n) about a usual pose, of which some keep all and some do not."""
    rng = np.random.default_rng(seed)
    usual = np.resize([0.0, -1.2, 1.5, -1.5, -1.5, 0.0, 0.0], c.arm.n)
    return np.asarray(usual + rng.uniform(-1.2, 1.2, (count, c.arm.n)))


def gaps(shapes, q, load):
    """How far a state (n,) stays within the workspace, and from obstacles, by other means, m."""
    c, config = shapes.cell, shapes.config
    parts, at = shapes.scene.parts, frames(c.arm, q)
    loose = [] if load == UNLOADED else hung(c, shapes, q, load)
    low, high = extent([p for p in parts if p.body > 2], c, q[None])
    for points, radius in loose:
        low = np.minimum(low, points.min(axis=0) - radius)
        high = np.maximum(high, points.max(axis=0) + radius)
    turns = np.zeros((25, c.arm.n))
    turns[:, 0] = np.linspace(-np.pi, np.pi, 25)
    mount = extent([p for p in parts if p.body < 2], c, turns)
    upper = extent([p for p in parts if p.body == 2], c, q[None])
    least = config.limits.workspace_min_m or (-np.inf, -np.inf, 0.0)
    most = config.limits.workspace_max_m or (np.inf, np.inf, np.inf)
    low = np.where(mount[0] >= least, np.minimum(low, upper[0]), low)
    high = np.where(mount[1] <= most, np.maximum(high, upper[1]), high)
    inside = float(np.min([low - least, most - high]))
    bodies = [(placed(p, at), p.radius) for p in parts if p.body > 1] + loose
    apart = [gap_to(x, points) - radius for x in config.obstacles for points, radius in bodies]
    return inside, min(apart, default=np.inf)


def stopped(guard, q, load):
    here = replace(SAMPLE, q=q, qd=np.zeros(len(q)))
    return guard.check(here, None, load)


@pytest.mark.long
@settings(max_examples=20, deadline=None)
@given(cells_of_same_feasibility(), SEED, LOAD)
def test_a_state_is_refused_by_all_or_by_none(c, seed, load):
    space, guard = FeasibleSpace(c, Margins()), Guard(c)
    for q in states(c, seed, 4):
        lines = route_problems(Feasibility(c), (Stop("p", q, load),))
        without_torques = [line for line in lines if "N·m" not in line]
        assert without_torques == [
            x.line("pose p") for x in space.findings(q[None], load, GEOMETRY)
        ]
        assert bool(without_torques) is not space.allowed(q[None], load, GEOMETRY).all()
        inside, apart = gaps(space.shapes, q, load)
        outside = [x for x in without_torques if "workspace" in x or "mounting plane" in x]
        assert bool(outside) == (inside < 0.0) or abs(inside) < 1e-6
        assert apart >= 0.005 - 1e-9 or any("collide" in x for x in without_torques)
        said = stopped(guard, q, load)
        assert lines or said is None
        if inside < -SLACK_M - 1e-6 or apart < -1e-9:
            assert said is not None


@pytest.mark.long
@settings(max_examples=20, deadline=None)
@given(cells_of_same_feasibility(), SEED, LOAD)
def test_a_motion_that_is_planned_passes_and_touches_nothing(c, seed, load):
    """What the planner allows the dry run allows; what that allows the guard allows."""
    space, guard = FeasibleSpace(c), Guard(c)
    q = states(c, seed, 30)
    planned = q[space.allowed(q, load, STATE_CHECKS)][:3]
    if len(planned):
        for end in planned[space.passable(planned[0], planned, load)]:
            assert route_problems(Feasibility(c), _way(planned[0], end, load)) == []
    loose = q[FeasibleSpace(c, Margins()).allowed(q, load, STATE_CHECKS)][:3]
    for end in loose[1:]:
        if route_problems(Feasibility(c), _way(loose[0], end, load)):
            continue
        for share in np.random.default_rng(seed).random(8):
            between = loose[0] + share * (end - loose[0])
            assert stopped(guard, between, load) is None
            inside, apart = gaps(space.shapes, between, load)
            assert inside >= -BETWEEN_M - 1e-9
            assert apart > 0.0
            assert least_distance(space.shapes.scene.self_pairs, between) > 0.0


@pytest.mark.long
@settings(max_examples=8, deadline=None)
@given(st.sampled_from(["ur3e", "ur10e", URDF]), SEED, st.floats(0.05, 0.95), LOAD)
def test_nothing_small_is_passed_between_two_samples(name, seed, share, load):
    """A cube of 4 mm where hook, elbow or what hangs comes by, and a side that they just pass."""
    free = cell(limits={"workspace_min_m": [-9.0, -9.0, -9.0], "joint_margin_rad": 0.0})
    c = replace(cell_from_config(free), arm=arm(name))
    space, q = FeasibleSpace(c), states(c, seed, 30)
    start, *ends = q[space.allowed(q, load, STATE_CHECKS)]
    clear = np.array(ends)[space.passable(start, np.array(ends), load)]
    for end in clear[:2]:
        between = start + share * (end - start)
        at, parts = frames(c.arm, between), space.shapes.scene.parts
        for point in (placed(parts[-1], at)[-1], at[4][:3, 3]):
            cube = {"name": "cube", "center_m": point.tolist(), "size_m": [0.004] * 3}
            obstructed = cell(limits=free.limits.model_dump(), obstacles=[cube])
            assert (
                not FeasibleSpace(c.with_config(obstructed)).passable(start, end[None], load).any()
            )
            problems = route_problems(
                Feasibility(c.with_config(obstructed)), _way(start, end, load)
            )
            assert any("cube collide" in x for x in problems)
        low, _ = extent([p for p in parts if p.body > 2], c, between[None])
        box = free.limits.model_dump() | {"workspace_min_m": [-9.0, -9.0, low[2] + 0.002]}
        assert route_problems(Feasibility(c.with_config(cell(limits=box))), _way(start, end, load))


def _way(start, end, load):
    return Stop("a", start, load), Stop("b", end, load)
