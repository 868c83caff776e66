"""The dry run: finds everything that a plan must not do, and lets the rest pass."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilcal.config import CellLoad, ForceSensor, Limits, Obstacle, Tool
from hilcal.config.sections import Sight
from hilcal.measuring.clearance import Clearance
from hilcal.measuring.feasibility import BETWEEN_M
from hilcal.measuring.route import APPROACH_RAD, dry_run, duration, route
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from hilcal.store.plan import Plan, Step
from tests.support.fake_bench import POSES, Bench, plan_of, usual_plan
from tests.support.rows import first
from tests.support.space_cases import reached

WIDE = Limits(workspace_min_m=(-3, -3, -3), workspace_max_m=(3, 3, 3))


def problems(bench, plan):
    return dry_run(bench.cell, plan).problems


def test_a_good_plan_passes():
    bench = Bench()
    checked = dry_run(bench.cell, usual_plan())
    assert checked.problems == ()
    assert checked.remarks == ()
    assert checked.load_changes == 4
    # beside and at the reference; its reading needs no motion, nor do the readings there after
    # a change of the load: 4 poses, then twice: to the reference, 4 poses, to the reference
    assert checked.motions == 1 + 4 + 2 * (1 + 4) + 1
    assert checked.duration > 4 * 60.0


def test_a_plan_of_another_arm():
    bench, plan = Bench(), usual_plan()
    assert problems(bench, replace(plan, about={"robot": bench.cell.arm.name})) == ()
    (refusals,) = problems(bench, replace(plan, about={"robot": "ur3e"}))
    assert f"made for ur3e, and the cell's arm is {bench.cell.arm.name}" in refusals


def test_number_of_joints_and_names_of_loads_at_once():
    bench = Bench()
    plan = Plan(("a",), np.zeros((1, 7)), (Step("a", "none"), Step("a", "3 kg")))
    refusals = problems(bench, plan)
    assert len(refusals) == 2
    assert "7 joint angles" in refusals[0]
    assert '"3 kg"' in refusals[1]
    assert 'did you mean "3kg"' in refusals[1]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("joint", range(6))
def test_joint_limit_with_margin(joint, side):
    bench = Bench(limits=WIDE)
    arm, margin = bench.cell.arm, bench.config.limits.joint_margin_rad
    limit = (arm.q_max if side > 0 else arm.q_min)[joint] - side * margin
    for inside, wrong in ((1e-6, False), (-1e-6, True)):
        q = np.array(POSES["reference"])
        q[joint] = limit - side * inside
        poses = {"reference": POSES["reference"], "edge": tuple(q)}
        refusals = problems(bench, plan_of(("edge", "none", 0), poses=poses))
        assert any(arm.joint_names[joint] in line and "edge" in line for line in refusals) is wrong


@pytest.mark.parametrize("side", [-1, 1])
def test_reference_at_a_joint_limit_is_approached_from_within(side):
    bench = Bench(limits=WIDE)
    arm, margin = bench.cell.arm, bench.config.limits.joint_margin_rad
    q = np.array(POSES["reference"])
    q[5] = (arm.q_max[5] - margin) if side > 0 else (arm.q_min[5] + margin)
    plan = plan_of(("reference", "none", 0), poses={"reference": tuple(q)})
    assert problems(bench, plan) == ()
    beside = route(plan, arm, margin)[0]
    assert beside.q[5] == pytest.approx(q[5] - side * APPROACH_RAD)


def box(bench, q):
    """The smallest box around forearm, wrists and tool in all states."""
    parts = Clearance(bench.cell).scene.parts
    return reached(bench.cell, parts, np.asarray(q))


def all_of(plan, bench, points_per_leg):
    """Joint angles along the whole route."""
    stops = route(plan, bench.cell.arm)
    share = np.linspace(0.0, 1.0, points_per_leg)[:, None]
    return np.vstack([a.q + share * (b.q - a.q) for a, b in pairwise(stops)])


@pytest.mark.parametrize("axis", first(1, [2, 0, 1]))
@pytest.mark.parametrize("side", ["min", "max"])
def test_workspace_is_checked_along_the_whole_path(axis, side):
    """A box that is just wide enough passes; one narrower by 5 mm does not."""
    bench, plan = Bench(), plan_of(*((p, "none", 0) for p in ("p1", "p2", "p3", "p4")))
    low, high = box(bench, all_of(plan, bench, 60))
    for narrower, wrong in ((-1e-6, False), (5e-3, True)):
        a, b = [-3.0] * 3, [3.0] * 3
        if side == "min":
            a[axis] = float(low[axis]) + narrower
        else:
            b[axis] = float(high[axis]) - narrower
        limits = Limits(workspace_min_m=tuple(a), workspace_max_m=tuple(b))
        bench.config = bench.config.model_copy(update={"limits": limits})
        refusals = problems(bench, plan)
        assert bool(refusals) is wrong
        assert all(f"whose {'xyz'[axis]} ends" in line for line in refusals)


def test_torque_under_load_names_pose_load_joint_and_limit():
    bench = Bench(
        limits=WIDE,
        loads=(
            CellLoad(name="light", mass_kg=1.0),
            CellLoad(name="pull", force_N=(0.0, 0.0, -300.0)),
        ),
    )
    stretched = (0.0, -0.2, 0.3, -1.5, -1.5, 0.0)
    poses = {"reference": POSES["reference"], "stretched": stretched}
    light = plan_of(("stretched", "none", 0), ("stretched", "light", 0), poses=poses)
    assert problems(bench, light) == ()
    heavy = plan_of(("stretched", "none", 0), ("stretched", "pull", 0), poses=poses)
    refusals = [line for line in problems(bench, heavy) if "bears" in line]
    assert any("stretched under pull" in line and "shoulder_lift" in line for line in refusals)
    assert any("0.9 of 330" in line for line in refusals)


def test_what_hangs_is_checked_on_the_way_too_and_in_the_beam():
    """A stand that the bare tool passes above, and a tracker that looks up past the load."""
    bench, home = Bench(limits=WIDE), np.array(POSES["reference"])
    away = home + 0.8 * np.eye(6)[0]
    middle, end = evaluate(bench.cell.arm, np.array([0.5 * (home + away), away])).point(
        bench.cell.load_point
    )
    poses = {"reference": home, "p1": away}
    plan = plan_of(("p1", "none", 0), ("p1", "3kg", 0), ("reference", "none", 1), poses=poses)
    x, y, z = middle
    stand = Obstacle(name="stand", bottom_m=(x, y, 0.0), radius_m=0.02, height_m=z - 0.08)
    refusals = problems(Bench(limits=WIDE, obstacles=(stand,)), plan)
    assert [line.partition(":")[0] for line in refusals] == [
        "between reference and p1",
        "between p1 and reference",
    ]
    (hidden,) = problems(Bench(limits=WIDE, sight=Sight(tracker_m=tuple(end - [0, 0, 1.0]))), plan)
    assert hidden == "pose p1: what hangs (3kg) between tracker and target"


@pytest.mark.parametrize(("mass", "wrong"), [(12.5 - 0.8, False), (12.5 - 0.8 + 1e-3, True)])
def test_payload_counts_tool_and_load(mass, wrong):
    sensor = ForceSensor(driver="x", port="y", max_force_N=1e3, max_moment_Nm=1e3)
    bench = Bench(loads=(CellLoad(name="heavy", mass_kg=mass),), force_sensor=sensor)
    refusals = problems(bench, plan_of(("p1", "none", 0), ("p1", "heavy", 0)))
    assert any("payload" in line and "heavy" in line for line in refusals) is wrong


def test_what_force_sensor_and_arm_bear():
    sensor = ForceSensor(driver="x", port="y", max_force_N=50.0, max_moment_Nm=3.0)
    bench = Bench(force_sensor=sensor)
    refusals = problems(bench, plan_of(("p1", "none", 0), ("p1", "6kg", 0)))
    assert any("max_force_N is 50" in line for line in refusals)
    assert any("max_moment_Nm is 3" in line and "p1 under 6kg" in line for line in refusals)
    bench = Bench(loads=(CellLoad(name="pull", force_N=(150.0, 0.0, 0.0)),), limits=WIDE)
    refusals = problems(bench, plan_of(("p1", "none", 0), ("p1", "pull", 0)))
    assert not any("payload" in line for line in refusals)
    bench = Bench(tool=Tool(mass_kg=13.0))
    assert any("the tool is 13 kg" in p for p in problems(bench, plan_of(("p1", "none", 0))))


def test_unknown_keys_of_a_plan_are_remarks():
    plan = replace(usual_plan(), about={"duration": {"total": 9.0}, "x_why": "mine", "points": []})
    (remark,) = dry_run(Bench().cell, plan).remarks
    assert remark.startswith('"duration" is no key of a plan (did you mean "duration_s"?), and is ')


def test_lacking_unloaded_readings_and_reference_are_remarks():
    bench = Bench()
    poses = {name: q for name, q in POSES.items() if name != "reference"}
    plan = plan_of(("p1", "3kg", 0), ("p1", "none", 1), poses=poses)
    checked = dry_run(bench.cell, plan)
    assert checked.problems == ()
    assert any("p1, none, cycle 0" in line for line in checked.remarks)
    assert any('"reference"' in line for line in checked.remarks)
    assert plan.home == "p1"


def test_all_problems_at_once_and_each_once():
    limits = Limits(workspace_min_m=(-3, -3, 0.6), joint_speed_rad_s=0.1, torque_share=0.05)
    bench = Bench(limits=limits)
    plan = plan_of(*((p, load, 0) for load in ("none", "6kg", "brick") for p in POSES))
    refusals = problems(bench, plan)
    for word in ("brick", "joint_speed", "outside the workspace", "bears"):
        assert any(word in line for line in refusals), word
    assert len(set(refusals)) == len(refusals)
    assert all("\n" not in line for line in refusals)


steps = st.lists(
    st.tuples(
        st.sampled_from(list(POSES)), st.sampled_from(["none", "3kg", "6kg"]), st.integers(0, 2)
    ),
    min_size=1,
    max_size=8,
    unique=True,
)


@given(steps)
def test_route_reads_each_step_once_under_its_load(chosen):
    """Loads change only at the reference pose, and every stop is reached under what hangs."""
    plan = plan_of(*chosen)
    stops = route(plan, load_arm("ur10e"))
    assert [stop.step for stop in stops if stop.step is not None] == list(plan.steps)
    hanging = "none"
    for before, stop in pairwise(stops):
        assert stop.hanging == hanging
        if stop.change_to is not None:
            assert np.array_equal(stop.q, plan.joints("reference"))
            assert stop.change_to != hanging
            hanging = stop.change_to
        if stop.step is not None:
            assert stop.step.load == hanging
            assert np.array_equal(stop.q, plan.joints(stop.step.pose))
            if before.step is not None:
                assert not np.array_equal(before.q, stop.q), "a repeated reading not approached"
    assert np.all(stops[0].q != stops[1].q), "a joint whose approach side is unknown"


@given(
    st.floats(0.02, 3.0), st.floats(0.05, 2.0), st.floats(0.05, 10.0), st.floats(-1, 1, width=32)
)
def test_duration_is_that_of_the_leading_joint(way, speed, acceleration, other):
    """Against the integral of the speed's trapezoid."""
    end = np.array([way, other * way])
    lasts = duration(np.zeros(2), end, speed, acceleration)
    t = np.linspace(0.0, lasts, 20001)
    v = np.minimum(np.minimum(acceleration * t, acceleration * (lasts - t)), speed)
    assert np.trapezoid(v, t) == pytest.approx(way, rel=1e-4)


@pytest.mark.long
@settings(max_examples=10, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-3.0, 3.0)] * 6), min_size=2, max_size=4, unique=True))
def test_whatever_passes_keeps_every_limit_on_its_whole_way(drawn):
    """No random plan that passes leaves the box anywhere by more than what is said."""
    bench = Bench(limits=Limits(workspace_min_m=(-0.9, -0.9, 0.0), workspace_max_m=(0.9, 0.9, 1.4)))
    poses = {f"p{k}": q for k, q in enumerate(drawn)}
    plan = plan_of(*((name, "none", 0) for name in poses), poses=poses)
    way = all_of(plan, bench, 101)
    low, high = box(bench, way)
    limits = bench.config.limits
    over = max((limits.workspace_min_m - low).max(), (high - limits.workspace_max_m).max())
    outside = [line for line in problems(bench, plan) if "workspace" in line]
    if over > BETWEEN_M:
        assert outside
    if over < -1e-9:
        assert not outside
