"""The simulated UR controller, by clients of its protocols; its motions."""

import struct
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest

from hilcal.calibration.urscript import movej_program, waypoints, with_joints
from hilcal.drivers.simulated.ur_programs import ScriptStream
from tests.support.sim_ur_cases import (
    Client,
    Lines,
    SimulatedUr,
    Wire,
    client,
    send_script,
    start,
)
from tests.support.timing import wait_until

SPEED, ACCELERATION = 0.5, 1.0
STOP_NS = 500_000_000  # the arm has to stand so soon after a fault


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedUr]:
    """One controller for a file; a protective stop can be unlocked soon."""
    running = start(tmp_path_factory.mktemp("u"))
    running.admin("set", unlock_s=0.3)
    yield running
    running.close()


@pytest.fixture
def sim(shared: SimulatedUr) -> Iterator[SimulatedUr]:
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


def goal_of(sim: SimulatedUr, by: float) -> list[float]:
    q = sim.admin()["q"]
    q[0] += by if q[0] < 0 else -by
    q[3] += 0.1 * by
    return q


def under_way(run: Client, sim: SimulatedUr) -> list[float]:
    """Start a long motion and wait until it has its full speed."""
    goal = goal_of(sim, 1.5)
    assert run("control", "moveJ", goal, SPEED, ACCELERATION, True)
    while abs(sim.admin()["qd"][0]) < 0.999 * SPEED:
        time.sleep(0.01)
    return goal


def rest_after(sim: SimulatedUr, fault_ns: int) -> dict:
    """The state once the arm stands; it came to rest within the time after the fault."""
    state = sim.wait("moving", False)
    assert 0 < state["rest_ns"] - fault_ns < STOP_NS
    return state


def learns(run: Client, part: str, call: str, good: Callable[[Any], bool] = bool) -> Any:
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


Q = np.array([[0.1, -1.2, 1.5, -1.0, -1.4, 0.3], [0.3, -1.1, 1.4, -0.9, -1.5, 0.4]])
PROGRAM = """def prog():
  set_tcp(p[0,0,0.1,0,0,0])
  movej([0,-1.57,1.57,0,1.57,0], a=20, v=30) # first
  sleep(0.01)
  movel([0.1,-1.5,1.5,0,1.5,0], a=20, v=30, r=0.01)
end
"""


def reached(sim, text: str, goals) -> None:
    send_script(sim.host, text)
    moves = [f"move to {np.round(goal, 6).tolist()}" for goal in goals]
    wait_until(
        lambda: [line for _, line in sim.admin("log") if line in moves] == moves, f"moved {moves}"
    )
    sim.wait("script_running", False)
    state = sim.admin()
    np.testing.assert_allclose(state["q"], goals[-1], atol=1e-8)
    assert not state["moving"]


def test_a_program_of_compensated_points_is_carried_out(sim) -> None:
    reached(sim, movej_program(["a", "b"], Q).replace("])", "], a=20, v=30)"), Q)


def test_a_rewritten_program_goes_to_its_new_waypoints(sim) -> None:
    reached(sim, with_joints(PROGRAM, waypoints(PROGRAM), Q), Q)


def test_programs_with_other_statements_are_foreign_and_move_nothing(sim) -> None:
    before = sim.admin()["q"]
    send_script(sim.host, "def p():\n  movej([0,0,0,0,0,0])\n  while (True):\n  end\nend\n")
    wait_until(
        lambda: any("foreign program" in line for _, line in sim.admin("log")), "a foreign program"
    )
    assert sim.admin()["q"] == before


LOCAL = "Command is not allowed due to safety reasons, please switch robot to Remote Control mode"


def test_clients_get_the_rate_that_they_asked_for(sim):
    with Wire(sim.host) as fast, Wire(sim.host) as slow:
        for wire, hz in ((fast, 250.0), (slow, 25.0)):
            wire.outputs("timestamp", hz)
            wire.ask("S")
            times = [struct.unpack(">Bd", wire.receive()[1])[1] for _ in range(int(hz))]
            assert times[-1] - times[0] == pytest.approx((hz - 1) / hz, abs=0.1)


def test_nonsense_ends_the_connection_and_nothing_else(sim):
    for data in (b"\x00\x04U\x09", b"\x00\x03U", b"\x00\x04V\x01", b"\x00\x0bO" + b"\xff" * 8):
        with Wire(sim.host) as wire:
            wire.socket.sendall(data)
            with pytest.raises(ConnectionError):
                wire.exactly(1)
    with Wire(sim.host) as wire:
        assert wire.ask("V", struct.pack(">H", 2)) == b"\x01"


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


def test_dashboard_connections_of_local_mode_stay_without_rights(sim):
    sim.admin("local_mode")
    with Lines(sim.host) as dashboard:
        dashboard.read()
        assert dashboard.ask("is in remote control") == "false"
        assert dashboard.ask("stop").startswith(LOCAL)
        sim.admin("remote_mode")
        assert dashboard.ask("is in remote control") == "true"
        assert dashboard.ask("stop").startswith(LOCAL)
    with Lines(sim.host) as dashboard:
        dashboard.read()
        assert dashboard.ask("stop") == "Stopped"


@pytest.mark.long
def test_a_restarted_controller_finds_its_arm_where_it_was(tmp_path):
    sim = start(tmp_path)
    q = sim.admin()["q"]
    sim.close()
    q[2] += 0.5
    sim.board.write("arm", q=q, moving=1.0, arrivals=41)
    with closing(sim):
        sim.start()
        state = sim.admin()
        assert state["q"] == q
        assert state["arrivals"] == 42
        assert sim.board.read("arm")["arrivals"] == 42


def test_script_port_cuts_programs_and_lines():
    text = "stopj(2.0)\ndef a():\n  def b():\n    x = 1\n  end\nend\n\nsec c():\n  y = 2\nend\nd()"
    stream = ScriptStream()
    programs = [p for k in range(0, len(text), 3) for p in stream.feed(text[k : k + 3].encode())]
    assert [p.split("\n")[0] for p in programs] == ["stopj(2.0)", "def a():", "sec c():"]
    assert programs[1].endswith("  end\nend")
    assert list(stream.feed(b"\r\n")) == ["d()"]
