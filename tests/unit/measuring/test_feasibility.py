"""The guard in motion, and that planner, dry run and guard judge by one rule."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellLoad, ForceSensor, Limits, Obstacle
from hilcal.design.feasible import FeasibleSpace
from hilcal.measuring.clearance import Clearance
from hilcal.measuring.motion import SLACK_M, Guard
from hilcal.measuring.route import dry_run
from hilcal.store.plan import UNLOADED, Plan, Step
from tests.support.arm_cases import ODD, arm_of
from tests.support.fake_bench import POSES, Bench
from tests.support.space_cases import cell, reached


@pytest.fixture
def bench():
    return Bench(
        limits=Limits(
            joint_speed_rad_s=1.0, workspace_min_m=(-2, -2, 0.0), workspace_max_m=(2, 2, 2)
        ),
        force_sensor=ForceSensor(
            driver="fake", port="nowhere", max_force_N=100.0, max_moment_Nm=10.0
        ),
    )


def sample(bench, **changes):
    bench.world.q = np.array(POSES["p1"])
    return replace(bench.rig.arm.sample(), **changes)


def test_all_is_well_with_and_without_a_force_sensor_but_for_an_arm_that_is_not_ready(bench):
    guard = Guard(bench.cell)
    assert guard.check(sample(bench), np.zeros(6)) is None
    assert guard.check(sample(bench)) is None
    assert "protective stop" in str(guard.check(sample(bench, safety="protective stop")))
    assert "7 joints" in str(guard.check(sample(bench, q=np.zeros(7))))


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_speed_of_every_joint(bench, joint, sign):
    guard, one = Guard(bench.cell), sign * np.eye(6)[joint]
    assert guard.check(sample(bench, qd=0.999 * one)) is None
    assert bench.cell.arm.joint_names[joint] in str(guard.check(sample(bench, qd=1.001 * one)))


@pytest.mark.parametrize(
    "way", [*np.eye(6), np.repeat([3**-0.5, 0.0], 3), np.repeat([0.0, 3**-0.5], 3)]
)
def test_force_and_moment_are_limited_by_the_lengths_of_their_vectors(bench, way):
    guard = Guard(bench.cell)
    limit, key = (100.0, "max_force_N") if way[:3].any() else (10.0, "max_moment_Nm")
    assert guard.check(sample(bench), -0.999 * limit * way) is None
    assert key in str(guard.check(sample(bench), -1.001 * limit * way))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_a_number_is_never_well(bench, bad):
    guard = Guard(bench.cell)
    q = np.array(POSES["p1"])
    q[2] = bad
    assert guard.check(sample(bench, q=q)) is not None
    assert guard.check(sample(bench, qd=np.full(6, bad))) is not None
    for axis in range(6):
        assert guard.check(sample(bench), np.where(np.arange(6) == axis, bad, 0.0)) is not None


@pytest.mark.parametrize("side", ["min", "max"])
@pytest.mark.parametrize("axis", range(3))
def test_workspace_of_the_actual_pose(bench, side, axis):
    """A box that ends where forearm, wrists and tool do, less and more than the slack."""
    parts = Clearance(bench.cell).scene.parts
    low, high = reached(bench.cell, parts, np.array([POSES["p1"]]))
    edge = (low if side == "min" else high)[axis]
    inwards = 1.0 if side == "min" else -1.0
    for over, wrong in ((0.5 * SLACK_M, False), (2 * SLACK_M, True)):
        box = {"min": [-3.0] * 3, "max": [3.0] * 3}
        box[side][axis] = edge + inwards * over
        limits = Limits(workspace_min_m=tuple(box["min"]), workspace_max_m=tuple(box["max"]))
        config = bench.config.model_copy(update={"limits": limits})
        said = Guard(bench.cell.with_config(config)).check(sample(bench))
        assert (said is not None) is wrong
        if said is not None:
            assert f"is {2 * SLACK_M:.3g} m outside the workspace, whose {'xyz'[axis]}" in said


def test_what_hangs_stops_the_arm_when_it_is_told():
    """At 0.45 m a weight that hangs 0.5 m low is through the floor, and nothing else is."""
    load = CellLoad(name="long", mass_kg=2.0, hang_m=0.5)
    bench = Bench(loads=(load,), limits=Limits(), force_sensor=None)
    guard, here = Guard(bench.cell), sample(bench, q=np.array(POSES["reference"]))
    assert guard.check(here) is None
    said = str(guard.check(here, hanging="long"))
    assert "what hangs (long)" in said
    assert "mounting plane" in said


def test_arm_and_obstacles_that_touch_stop_the_arm():
    folded = (0.0, -1.5, 3.0, -1.5, -1.5, 0.0)
    bench = Bench(limits=Limits(workspace_min_m=(-2, -2, -2)))
    said = Guard(bench.cell).check(sample(bench, q=np.array(folded)))
    assert "shoulder and forearm collide" in str(said)


@pytest.mark.parametrize("deep_m", [-0.005, 0.005])
def test_a_plate_stops_the_arm_as_soon_as_it_touches(bench, deep_m):
    """A wall before, and behind, the outermost point of wrists and tool."""
    low, _ = reached(bench.cell, Clearance(bench.cell).scene.parts, np.array([POSES["p1"]]))
    wall = Obstacle(name="wall", center_m=(low[0] + deep_m - 0.1, 0, 0.5), size_m=(0.2, 4, 3))
    config = bench.config.model_copy(update={"obstacles": (wall,)})
    said = Guard(bench.cell.with_config(config)).check(sample(bench))
    assert ("wall" in str(said)) is (deep_m > 0)


HOME = (0.0, -1.2, 1.5, -1.5, -1.5, 0.0)
BELOW = (0.0, 0.5, 0.9, -1.5, -1.5, 0.0)


def refused_lines(config, *states, load=UNLOADED):
    names = ("reference", *(f"p{k}" for k in range(1, len(states))))
    plan = Plan(names, np.array(states, dtype=float), (Step(names[-1], load),))
    return dry_run(cell_from_config(config), plan).problems


def stopped(config, q):
    joints = np.array(q, dtype=float)
    here = replace(Bench().rig.arm.sample(), q=joints, qd=np.zeros(len(joints)))
    return Guard(cell_from_config(config)).check(here)


def planned(config, q):
    space = FeasibleSpace(cell_from_config(config))
    return bool(space.allowed(np.array([q], dtype=float), UNLOADED, GEOMETRY).all())


GEOMETRY = ("joint limits", "workspace", "self-collision", "obstacle")


TARGETS = [{"name": f"t{k}", "target_m": [0.0, 0.0, z]} for k, z in ((1, 0.1), (2, 0.7))]
SECOND_OUTSIDE = cell(tool={"targets": TARGETS}, limits={"workspace_min_m": [-3.0, -3.0, 0.17]})


@pytest.mark.parametrize(
    ("config", "q", "word"), [(cell(), BELOW, "mounting plane"), (SECOND_OUTSIDE, HOME, "t2")]
)
def test_what_the_planner_refuses_is_refused_and_stops_the_arm(config, q, word):
    """The tool 0.86 m below the plane, without a workspace; a second target 0.39 m outside."""
    assert not planned(config, q)
    refusals = refused_lines(config, q)
    assert any(word in line for line in refusals), refusals
    assert word in str(stopped(config, q))


def test_the_shape_of_an_unknown_arm_is_said_to_be_guessed():
    config = cell()
    unknown = replace(cell_from_config(config), arm=arm_of(ODD))
    q = np.zeros((1, unknown.arm.n))
    checked = dry_run(
        unknown.with_config(config), Plan(("reference",), q, (Step("reference", UNLOADED),))
    )
    said = "the shape of odd is not known: its links are guessed"
    assert said in checked.remarks
    assert said in FeasibleSpace(unknown.with_config(config)).remarks
