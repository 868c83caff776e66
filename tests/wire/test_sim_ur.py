"""The simulated UR controller, by clients of its protocols; its motions."""

import socket
import struct
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.calibration.programs.urscript import movej_program, waypoints, with_joints
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.cell_processes import free_host
from hilcal.drivers.simulated.ur_state import GRAVITY, Kinematics, Trajectory
from hilcal.errors import DeviceError
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from tests.support.rows import first
from tests.support.sim_ur_cases import Lines, Wire, client, send_script, server, start
from tests.support.timing import wait_until

SPEED, ACCELERATION = 0.5, 1.0
STOP_NS = 500_000_000  # the arm has to stand so soon after a fault


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """One controller for a file; a protective stop can be unlocked soon."""
    running = start(tmp_path_factory.mktemp("u"))
    running.admin("set", unlock_s=0.3)
    yield running
    running.close()


@pytest.fixture
def sim(shared):
    """A controller without faults; it has none after the test either."""
    yield shared
    shared.admin("set", unlock_s=0.3)
    shared.admin("remote_mode")
    shared.admin("release_emergency_stop")
    with Lines(shared.host) as dashboard:
        dashboard.read()
        while dashboard.ask("unlock protective stop").startswith("Cannot"):
            time.sleep(0.05)
        assert dashboard.ask("brake release") == "Brake releasing"
        shared.wait("robot_mode", 7)
        assert dashboard.ask("stop") == "Stopped"
    shared.wait("moving", False)
    shared.wait("rtde_clients", 0)


def goal_of(sim, by):
    q = sim.admin()["q"]
    q[0] += by if q[0] < 0 else -by
    q[3] += 0.1 * by
    return q


def under_way(run, sim):
    """Start a long motion and wait until it has its full speed."""
    goal = goal_of(sim, 1.5)
    assert run("control", "moveJ", goal, SPEED, ACCELERATION, True)
    while abs(sim.admin()["qd"][0]) < 0.999 * SPEED:
        time.sleep(0.01)
    return goal


def rest_after(sim, fault_ns):
    """The state once the arm stands; it came to rest within the time after the fault."""
    state = sim.wait("moving", False)
    assert 0 < state["rest_ns"] - fault_ns < STOP_NS
    return state


def learns(run, part, call, good=bool):
    """Wait until the client knows: what it says is as old as the last package that it has read."""
    deadline = time.monotonic() + 5.0
    while not good(answer := run(part, call)):
        assert time.monotonic() < deadline, f"{call} stays {answer!r}"
        time.sleep(0.005)
    return answer


@pytest.mark.parametrize("how", ["dashboard", "line", "program", "killed"])
def test_ways_to_stop(sim, how):
    with client(sim.host, "control", "dashboard") as run:
        goal = under_way(run, sim)
        before = sim.admin()["arrivals"]
        at = time.monotonic_ns()
        if how == "dashboard":
            run("dashboard", "stop")
        elif how == "line":
            send_script(sim.host, "stopj(4.0)\n")
        elif how == "program":
            send_script(sim.host, "def halt():\n  stopj(4.0)\nend\n")
        else:
            sim.admin("kill_script")
        state = rest_after(sim, at)
        assert state["arrivals"] == before + 1
        assert abs(state["q"][0] - goal[0]) > 0.1
        sim.wait("script_running", False)
        learns(run, "control", "isProgramRunning", lambda running: running is False)
        assert run("control", "moveJ", goal, SPEED, ACCELERATION) is False


def turned(vector):
    return Rotation.from_rotvec(vector).as_matrix()


def test_asynchronous_move_reaches_its_goal(sim):
    before = sim.board.read("arm")
    with client(sim.host, "control", "receive") as run:
        goal = goal_of(sim, 0.2)
        assert run("control", "moveJ", goal, SPEED, ACCELERATION, True)
        assert sim.board.read("arm")["moving"] == 1.0
        assert run("control", "getAsyncOperationProgress") >= 0
        state = sim.wait("moving", False)
        # d / v + v / a = 0.9 s: neither sooner nor much later
        begun = [ns for ns, what in sim.admin("log") if what.startswith("move to ")][-1]
        assert 0.85e9 < state["rest_ns"] - begun < 1.5e9
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
        pose = run("control", "getForwardKinematics")
        learns(run, "receive", "getActualTCPPose", lambda p: np.allclose(p, pose, atol=1e-4))
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
    np.testing.assert_allclose(pose[:3], expected[:3, 3], atol=1e-9)
    np.testing.assert_allclose(turned(pose[3:]), expected[:3, :3], atol=1e-9)


Q = np.array([[0.1, -1.2, 1.5, -1.0, -1.4, 0.3], [0.3, -1.1, 1.4, -0.9, -1.5, 0.4]])
PROGRAM = """def prog():
  set_tcp(p[0,0,0.1,0,0,0])
  movej([0,-1.57,1.57,0,1.57,0], a=20, v=30) # first
  sleep(0.01)
  movel([0.1,-1.5,1.5,0,1.5,0], a=20, v=30, r=0.01)
end
"""


def reached(sim, text, goals):
    send_script(sim.host, text)
    moves = [f"move to {np.round(goal, 6).tolist()}" for goal in goals]
    wait_until(
        lambda: [line for _, line in sim.admin("log") if line in moves] == moves, f"moved {moves}"
    )
    sim.wait("script_running", False)
    state = sim.admin()
    np.testing.assert_allclose(state["q"], goals[-1], atol=1e-8)
    assert not state["moving"]


def test_a_program_of_compensated_points_is_carried_out(sim):
    reached(sim, movej_program(["a", "b"], Q).replace("])", "], a=20, v=30)"), Q)


def test_a_rewritten_program_goes_to_its_new_waypoints(sim):
    reached(sim, with_joints(PROGRAM, waypoints(PROGRAM), Q), Q)


def test_dashboard_answers(sim):
    with Lines(sim.host) as dashboard:
        assert dashboard.read() == "Connected: Universal Robots Dashboard Server"
        assert dashboard.ask("PolyscopeVersion").startswith("URSoftware 5.11.6.1010327 ")
        assert dashboard.ask("get robot model") == "UR10e"
        assert dashboard.ask("get serial number").isdigit()
        assert dashboard.ask("robotmode") == "Robotmode: RUNNING"
        assert dashboard.ask("safetystatus") == "Safetystatus: NORMAL"
        assert dashboard.ask("running") == "Program running: false"
        assert dashboard.ask("programState").split()[0] == "STOPPED"
        assert dashboard.ask("play") == "Failed to execute: play"
        assert dashboard.ask("close safety popup") == "closing safety popup"
        assert dashboard.ask("dance") == "could not understand: 'dance'"
        assert dashboard.ask("quit") == "Disconnected"
        assert dashboard.read() == ""


def test_the_truth_is_what_the_sensors_tell(tmp_path):
    rng = np.random.default_rng(4)
    truth = {
        "encoder": rng.normal(size=6),
        "joint_temperature": 30.0 + rng.normal(size=6),
        "drive_torque": 20.0 * rng.normal(size=6),
        "sensor_wrench": np.array([1.0, 2.0, -60.0, 0.5, 0.25, 0.0]),
    }
    sim = start(tmp_path, 1.0, {**truth, "arrivals": 0})
    names = (
        "actual_q,joint_temperatures,target_moment,ft_raw_wrench,actual_TCP_force,target_current"
    )

    def values():
        with Wire(sim.host) as wire:
            wire.outputs(names)
            wire.ask("S")
            return np.array(struct.unpack(">B36d", wire.receive()[1])[1:]).reshape(6, 6)

    try:
        q, temperature, moment, wrench, force, current = values()
        np.testing.assert_array_equal(q, truth["encoder"])
        np.testing.assert_array_equal(temperature, truth["joint_temperature"])
        np.testing.assert_array_equal(moment, truth["drive_torque"])
        assert np.all(np.sign(current) == np.sign(moment))
        offset = wrench - truth["sensor_wrench"]
        assert 2.0 < np.linalg.norm(offset[:3]) < 10.0
        # no payload was told: what the controller calls contact is all of the load
        assert np.linalg.norm(force[:3]) == pytest.approx(np.linalg.norm(wrench[:3]), rel=1e-9)
        sim.board.write("truth", arrivals=7)  # not that of this arm's rest
        np.testing.assert_allclose(values()[0], sim.admin()["q"], atol=5e-5)
    finally:
        sim.close()


@pytest.mark.parametrize("port", first(1, [30004, 29999, 30003]))
def test_an_address_in_use_is_refused(tmp_path, port):
    Blackboard.create(tmp_path / "world.bin", 1.0)
    host = free_host()
    with socket.socket() as occupied:
        occupied.bind((host, port))
        occupied.listen()
        process = server(tmp_path, host)
        process.start()
        wait_until(lambda: process.has_ended, "ended")
        with pytest.raises(DeviceError, match=rf"exit code 3: .*{host}:{port} is in use"):
            process.check()
        process.end()
    assert process.log.read_text().count("\n") == 1
    assert not (tmp_path / "arm.sock").exists()


GOAL = np.array([1.0, -0.5, 0.0, 0.2, 0.0, -1.5])


def trajectory():
    return Trajectory(np.zeros(6), np.ones(6), 5, 100.0)


@pytest.mark.parametrize("when", [0.2, 1.5, 3.1, 3.45])
def test_stop_is_smooth_and_stays_on_the_line(when):
    path = trajectory()
    path.start(GOAL, 0.5, 1.0, 100.0)
    path.advance(100.0 + when)
    speed, q = np.max(np.abs(path.qd)), path.q.copy()
    path.stop(2.0, 100.0 + when)
    assert path.moving
    path.advance(100.0 + when + 1e-6)
    assert np.max(np.abs(path.qd)) == pytest.approx(speed, rel=1e-3)
    path.advance(104.0)
    assert not path.moving
    assert path.arrivals == 6
    rest = path.rest_time - 100.0 - when
    assert rest <= speed / 2.0 + 1e-9
    np.testing.assert_allclose(path.q - q, GOAL / 1.5 * 0.5 * speed * rest, atol=1e-9)
    assert np.all(np.abs(path.q) <= np.abs(GOAL) + 1e-12)


def test_jacobian_and_weight_are_derivatives():
    kinematics = Kinematics(load_arm("ur10e"))
    arm = kinematics.arm
    rng = np.random.default_rng(2)
    q, com, mass, h = rng.uniform(-2, 2, 6), np.array([0.05, -0.1, 0.2]), 4.0, 1e-6

    def tip(q):
        place = kinematics.flange(q)
        return place[:3, 3] + place[:3, :3] @ com

    def energy(q):
        """Work of gravity, J."""
        centres = evaluate(arm, q[None]).com[:, 0]
        return arm.masses @ centres @ GRAVITY + mass * GRAVITY @ tip(q)

    steps = h * np.eye(6)
    numeric = np.array([(tip(q + s) - tip(q - s)) / (2 * h) for s in steps]).T
    np.testing.assert_allclose(kinematics.jacobian(q, tip(q))[:3], numeric, atol=1e-8)
    work = [(energy(q + s) - energy(q - s)) / (2 * h) for s in steps]
    np.testing.assert_allclose(kinematics.weight_torque(q, mass, com), work, atol=1e-6)
