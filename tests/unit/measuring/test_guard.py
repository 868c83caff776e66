"""The guard: every limit, from both sides of it."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.config import CellLoad, ForceSensor, Limits
from hilcal.measuring.clearance import clearance_of
from hilcal.measuring.devices import ArmSample
from hilcal.measuring.motion import SLACK_M, Guard
from tests.support.fake_bench import POSES, Bench
from tests.support.space_cases import reached


@pytest.fixture
def bench() -> Bench:
    return Bench(
        limits=Limits(
            joint_speed_rad_s=1.0, workspace_min_m=(-2, -2, 0.0), workspace_max_m=(2, 2, 2)
        ),
        force_sensor=ForceSensor(
            driver="fake", port="nowhere", max_force_N=100.0, max_moment_Nm=10.0
        ),
    )


def sample(bench: Bench, **changes: object) -> ArmSample:
    bench.world.q = np.array(POSES["p1"])
    return replace(bench.rig.arm.sample(), **changes)  # type: ignore[arg-type]


def test_all_is_well(bench: Bench) -> None:
    assert Guard(bench.cell, bench.config).check(sample(bench), np.zeros(6)) is None


def test_without_a_force_sensor_no_wrench_is_asked(bench: Bench) -> None:
    assert Guard(bench.cell, bench.config).check(sample(bench)) is None


def test_safety_state_is_told_in_the_makers_words(bench: Bench) -> None:
    said = Guard(bench.cell, bench.config).check(sample(bench, safety="protective stop"))
    assert said is not None
    assert "protective stop" in said


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_speed_of_every_joint(bench: Bench, joint: int, sign: float) -> None:
    guard = Guard(bench.cell, bench.config)
    qd = np.zeros(6)
    qd[joint] = sign * 0.999
    assert guard.check(sample(bench, qd=qd)) is None
    qd[joint] = sign * 1.001
    said = guard.check(sample(bench, qd=qd))
    assert said is not None
    assert bench.cell.arm.joint_names[joint] in said


@pytest.mark.parametrize("axis", range(6))
def test_force_and_moment(bench: Bench, axis: int) -> None:
    guard = Guard(bench.cell, bench.config)
    limit = 100.0 if axis < 3 else 10.0
    felt = np.zeros(6)
    felt[axis] = -0.999 * limit
    assert guard.check(sample(bench), felt) is None
    felt[axis] = -1.001 * limit
    said = guard.check(sample(bench), felt)
    assert said is not None
    assert ("max_force_N" if axis < 3 else "max_moment_Nm") in said


@pytest.mark.parametrize(("part", "key"), [(0, "max_force_N"), (3, "max_moment_Nm")])
def test_force_and_moment_are_the_lengths_of_their_vectors(
    bench: Bench, part: int, key: str
) -> None:
    felt = np.zeros(6)
    felt[part : part + 3] = 70.0 if part == 0 else 7.0  # the limits are 100 N and 10 N·m
    said = Guard(bench.cell, bench.config).check(sample(bench), felt)
    assert said is not None
    assert key in said


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_a_number_is_never_well(bench: Bench, bad: float) -> None:
    guard = Guard(bench.cell, bench.config)
    q = np.array(POSES["p1"])
    q[2] = bad
    assert guard.check(sample(bench, q=q)) is not None
    assert guard.check(sample(bench, qd=np.full(6, bad))) is not None
    for axis in range(6):
        felt = np.zeros(6)
        felt[axis] = bad
        assert guard.check(sample(bench), felt) is not None, axis


def test_wrong_number_of_joints(bench: Bench) -> None:
    said = Guard(bench.cell, bench.config).check(sample(bench, q=np.zeros(7)))
    assert said is not None
    assert "7 joints" in said


@pytest.mark.parametrize("side", ["min", "max"])
@pytest.mark.parametrize("axis", range(3))
def test_workspace_of_the_actual_pose(bench: Bench, side: str, axis: int) -> None:
    """A box that ends where forearm, wrists and tool do, less and more than the slack."""
    parts = clearance_of(bench.cell, bench.config).scene.parts
    low, high = reached(bench.cell, parts, np.array([POSES["p1"]]))
    edge = (low if side == "min" else high)[axis]
    inwards = 1.0 if side == "min" else -1.0
    for over, wrong in ((0.5 * SLACK_M, False), (2 * SLACK_M, True)):
        box = {"min": [-3.0] * 3, "max": [3.0] * 3}
        box[side][axis] = edge + inwards * over
        limits = Limits(workspace_min_m=tuple(box["min"]), workspace_max_m=tuple(box["max"]))
        config = bench.config.model_copy(update={"limits": limits})
        said = Guard(bench.cell, config).check(sample(bench))
        assert (said is not None) is wrong
        if said is not None:
            assert f"is {2 * SLACK_M:.3g} m outside the workspace, whose {'xyz'[axis]}" in said


def test_what_hangs_stops_the_arm_when_it_is_told() -> None:
    """At 0.45 m a weight that hangs 0.5 m low is through the floor, and nothing else is."""
    load = CellLoad(name="long", mass_kg=2.0, hang_m=0.5)
    bench = Bench(loads=(load,), limits=Limits(), force_sensor=None)
    guard, here = Guard(bench.cell, bench.config), sample(bench, q=np.array(POSES["reference"]))
    assert guard.check(here) is None
    said = guard.check(here, hanging="long")
    assert said is not None
    assert "what hangs (long)" in said
    assert "mounting plane" in said


def test_arm_and_obstacles_that_touch_stop_the_arm() -> None:
    folded = (0.0, -1.5, 3.0, -1.5, -1.5, 0.0)
    bench = Bench(limits=Limits(workspace_min_m=(-2, -2, -2)))
    said = Guard(bench.cell, bench.config).check(sample(bench, q=np.array(folded)))
    assert said is not None
    assert "shoulder and forearm collide" in said
