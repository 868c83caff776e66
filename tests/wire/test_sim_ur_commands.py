"""What the client library's commands do at the simulated UR controller."""

import time

import numpy as np
from scipy.spatial.transform import Rotation

from hilcal.robot.catalogue import load_arm
from tests.support.sim_ur_cases import client, start
from tests.support.sim_ur_client_cases import (
    ACCELERATION,
    SPEED,
    STOP_NS,
    goal_of,
    learns,
    shared,
    sim,
)

__all__ = ["shared", "sim"]  # fixtures


def turned(vector):
    return Rotation.from_rotvec(vector).as_matrix()


def test_asynchronous_move_reaches_its_goal(sim):
    before = sim.board.read("arm")
    with client(sim.host, "control", "receive") as run:
        goal = goal_of(sim, 0.2)
        sent = time.monotonic_ns()
        assert run("control", "moveJ", goal, SPEED, ACCELERATION, True)
        assert sim.board.read("arm")["moving"] == 1.0
        assert run("control", "getAsyncOperationProgress") >= 0
        state = sim.wait("moving", False)
        # d / v + v / a = 0.9 s: neither sooner nor much later
        assert 0.85e9 < state["rest_ns"] - sent < 1.5e9
        np.testing.assert_allclose(state["q"], goal, atol=1e-12)
        learns(run, "control", "getAsyncOperationProgress", lambda progress: progress < 0)
        learns(run, "receive", "getTargetQ", lambda q: np.allclose(q, goal, rtol=0.0, atol=1e-12))
        np.testing.assert_allclose(run("receive", "getActualQ"), goal, atol=5e-5)
    after = sim.board.read("arm")
    assert after["arrivals"] == before["arrivals"] + 1
    moved = np.array(goal) - before["q"]
    np.testing.assert_array_equal(after["side"][[0, 3]], np.sign(moved[[0, 3]]))
    np.testing.assert_array_equal(after["side"][[1, 2, 4, 5]], before["side"][[1, 2, 4, 5]])
    np.testing.assert_allclose(after["q"], goal, atol=1e-12)


def test_blocking_move_and_steadiness(sim):
    with client(sim.host, "control") as run:
        goal = goal_of(sim, 0.1)
        assert run("control", "moveJ", goal, 1.0, 4.0)
        assert not sim.admin()["moving"]
        assert not run("control", "isSteady")
        np.testing.assert_allclose(sim.admin()["q"], goal, atol=1e-12)
        time.sleep(0.55)
        assert run("control", "isSteady")


def test_path_goes_through_its_points(sim):
    with client(sim.host, "control") as run:
        start_q = sim.admin()["q"]
        first, second = goal_of(sim, 0.1), start_q
        path = [[*first, 1.0, 4.0, 0.0], [*second, 1.0, 4.0, 0.0]]
        before = sim.admin()["arrivals"]
        assert run("control", "moveJ", path)
        assert sim.admin()["arrivals"] == before + 2
        np.testing.assert_allclose(sim.admin()["q"], start_q, atol=1e-12)


def test_payload_keeps_its_centre_when_told_zeros(sim):
    with client(sim.host, "control", "receive") as run:
        assert run("control", "setPayload", 2.5, [0.01, 0.02, 0.03])
        assert run("control", "setPayload", 3.5, [0.0, 0.0, 0.0])
        learns(run, "receive", "getPayload", lambda mass: mass == 3.5)
        assert run("receive", "getPayloadCog") == [0.01, 0.02, 0.03]
    arm = sim.board.read("arm")
    assert arm["payload"] == 3.5
    np.testing.assert_array_equal(arm["payload_com"], [0.01, 0.02, 0.03])


def test_forward_kinematics_is_that_of_the_nominal_arm(sim):
    tool = [0.1, -0.05, 0.2, 0.3, -0.4, 0.5]
    with client(sim.host, "control", "receive") as run:
        assert run("control", "setTcp", tool)
        told = run("control", "getForwardKinematics")
        learns(run, "receive", "getActualTCPPose", lambda p: np.allclose(p, told, atol=1e-4))
        assert run("control", "setTcp", [0.0] * 6)
    place = np.eye(4)
    links = load_arm("ur10e").links
    for link, angle in zip(links, [*sim.admin()["q"], 0.0], strict=True):
        turn = np.eye(4)
        turn[:3, :3] = turned([0.0, 0.0, angle])
        place = place @ link @ turn
    offset = np.eye(4)
    offset[:3, :3], offset[:3, 3] = turned(tool[3:]), tool[:3]
    expected = place @ offset
    np.testing.assert_allclose(told[:3], expected[:3, 3], atol=1e-9)
    np.testing.assert_allclose(turned(told[3:]), expected[:3, :3], atol=1e-9)


def test_goal_beyond_the_joints_is_a_protective_stop(sim):
    with client(sim.host, "control") as run:
        goal = sim.admin()["q"]
        goal[5] = 7.0
        assert run("control", "moveJ", goal, SPEED, ACCELERATION) is False
    assert sim.admin()["safety"] & 1 << 2


def test_world_time_runs_faster_and_the_watchdog_does_not(tmp_path):
    sim = start(tmp_path, 20.0)
    try:
        with client(sim.host, "control", "receive") as run:
            goal = goal_of(sim, 2.0)
            sent = time.monotonic_ns()
            assert run("control", "moveJ", goal, SPEED, ACCELERATION, True)
            state = sim.wait("moving", False)
            # 4.5 s of world time
            assert 0.22e9 < state["rest_ns"] - sent < 0.22e9 + STOP_NS
            before, at = run("receive", "getTimestamp"), time.monotonic()
            time.sleep(0.3)
            after, then = run("receive", "getTimestamp"), time.monotonic()
            assert after - before > 10.0 * (then - at)
            assert run("control", "setWatchdog", 2.0)
            assert sim.admin()["script_running"]
            armed = sim.admin()["input_ns"]
            sim.wait("script_running", False)
            (barked,) = [ns for ns, what in sim.admin("log") if "watchdog: " in what]
            assert 0.4e9 < barked - armed < 1.5e9
    finally:
        sim.close()
