"""The simulated UR controller as the real client library sees it: stops, faults, refusals."""

import time

import numpy as np
import pytest

from tests.support.sim_ur_cases import ClientError, Lines, client, send_script
from tests.support.sim_ur_client_cases import (
    ACCELERATION,
    SPEED,
    goal_of,
    learns,
    rest_after,
    shared,
    sim,
    under_way,
)

__all__ = ["shared", "sim"]  # fixtures


def test_watchdog_stops_the_arm_when_the_client_is_killed(sim):
    with client(sim.host, "control") as run:
        goal = under_way(run, sim, watchdog=10.0)
        assert sim.admin()["watchdog_hz"] == 10.0
        killed = time.monotonic_ns()
        run.kill()
        state = rest_after(sim, killed)
        assert abs(state["q"][0] - goal[0]) > 0.1
        assert state["runtime"] == 1
        assert not state["script_running"]


def test_the_watchdog_waits_for_a_client_that_had_no_turn(sim):
    with client(sim.host, "control") as run:
        goal = under_way(run, sim, watchdog=10.0)
        time.sleep(0.3)
        assert sim.admin()["qd"][0] == 0.0  # nothing moves meanwhile
        assert sim.admin()["script_running"]
        run("control", "kickWatchdog")
        while sim.admin()["moving"]:
            run("control", "kickWatchdog")
            time.sleep(0.01)
        np.testing.assert_allclose(sim.admin()["q"], goal, atol=1e-12)
        time.sleep(0.8)  # no machine is so busy
        assert not sim.admin()["script_running"]


def test_without_watchdog_the_arm_goes_on(sim):
    with client(sim.host, "control") as run:
        goal = under_way(run, sim)
        run.kill()
        time.sleep(0.5)
        state = sim.admin()
        assert state["moving"]
        sim.wait("moving", False)
        np.testing.assert_allclose(sim.admin()["q"], goal, atol=1e-12)


def test_stopj_decelerates_as_told(sim):
    with client(sim.host, "control") as run:
        under_way(run, sim)
        run("control", "stopJ", 1.0)
        state = sim.admin()
        assert not state["moving"]  # it blocked until the arm stood
        assert state["script_running"]
    (began,) = [ns for ns, what in sim.admin("log") if what == "stop command, 1"]
    assert state["rest_ns"] - began == pytest.approx(SPEED / 1.0 * 1e9, rel=0.05)


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


def test_protective_stop_has_to_be_unlocked_and_the_script_uploaded_again(sim):
    sim.admin("set", unlock_s=1000.0)
    with client(sim.host, "control", "receive", "dashboard") as run:
        goal = under_way(run, sim)
        fault = sim.admin("protective_stop")["fault_ns"]
        state = rest_after(sim, fault)
        sim.wait("runtime", 4)
        assert state["safety"] & 1 << 2
        assert not state["safety"] & 1
        assert learns(run, "receive", "isProtectiveStopped")
        assert run("dashboard", "safetystatus") == "Safetystatus: PROTECTIVE_STOP"
        assert run("control", "moveJ", goal, SPEED, ACCELERATION) is False
        with pytest.raises(ClientError, match="unlock"):
            run("dashboard", "unlockProtectiveStop")
        sim.admin("set", unlock_s=0.0)
        run("dashboard", "unlockProtectiveStop")
        state = sim.admin()
        assert state["safety"] == 1
        assert state["runtime"] == 4
        run("dashboard", "stop")
        assert run("control", "reuploadScript")
        assert sim.wait("runtime", 2)["q"] == state["q"]
        # until a package says that the program plays, the library takes it for ended
        learns(run, "control", "isProgramRunning")
        assert run("control", "moveJ", goal_of(sim, 0.05), SPEED, ACCELERATION)


def test_resumed_program_goes_on_to_its_goal(sim):
    with client(sim.host, "control") as run, Lines(sim.host) as dashboard:
        dashboard.read()
        goal = goal_of(sim, 0.3)
        assert run("control", "moveJ", goal, SPEED, ACCELERATION, True)
        sim.admin("protective_stop")
        sim.wait("runtime", 4)
        assert dashboard.ask("play") == "Failed to execute: play"
        sim.admin("set", unlock_s=0.0)
        assert dashboard.ask("unlock protective stop") == "Protective stop releasing"
        assert abs(sim.admin()["q"][0] - goal[0]) > 0.1
        assert dashboard.ask("play") == "Starting program"
        sim.wait("moving", False)
        np.testing.assert_allclose(sim.admin()["q"], goal, atol=1e-12)


def test_emergency_stop_cuts_the_power(sim):
    with client(sim.host, "control", "receive", "dashboard") as run:
        under_way(run, sim)
        state = rest_after(sim, sim.admin("emergency_stop")["fault_ns"])
        assert state["safety"] & 1 << 7
        assert state["robot_mode"] == 3
        assert state["runtime"] == 1
        assert learns(run, "receive", "isEmergencyStopped")
        assert run("receive", "getRobotMode") == 3
        assert run("dashboard", "robotmode") == "Robotmode: POWER_OFF"
    with Lines(sim.host) as dashboard:
        dashboard.read()
        assert dashboard.ask("power on") == "Failed to execute: power on"
        assert dashboard.ask("unlock protective stop").startswith("Failed")
        assert sim.admin("release_emergency_stop")["robot_mode"] == 3
        assert dashboard.ask("power on") == "Powering on"
        sim.wait("robot_mode", 5)
        assert dashboard.ask("brake release") == "Brake releasing"
        sim.wait("robot_mode", 7)
    with client(sim.host, "control") as run:
        assert run("control", "moveJ", goal_of(sim, 0.05), SPEED, ACCELERATION)


def test_second_control_client_is_refused_and_the_first_goes_on(sim):
    with client(sim.host, "control") as first, client(sim.host) as second:
        with pytest.raises(ClientError, match="in use"):
            second("control", "open", sim.host)
        assert first("control", "moveJ", goal_of(sim, 0.05), SPEED, ACCELERATION)


def test_local_mode_refuses_control(sim):
    sim.admin("local_mode")
    scripts = sim.admin()["scripts"]
    with client(sim.host, "receive", "dashboard") as run:
        assert run("dashboard", "isInRemoteControl") is False
        with pytest.raises(ClientError, match="remote"):
            run("control", "open", sim.host)
    assert not sim.admin()["script_running"]
    send_script(sim.host, "stopj(4.0)\n")
    sim.wait("scripts", scripts + 1)
    assert sim.admin("log")[-1][1] == "script ignored: local mode"
