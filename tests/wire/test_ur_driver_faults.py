"""The UR driver when something goes wrong: what the operator reads, and that the arm stands."""

import os
import signal
import time

import numpy as np
import pytest

from drivers.ur_link import dashboard
from hilcal.errors import DeviceError
from tests.support import ur_driver_cases as cases
from tests.support.ur_driver_cases import arm, sim

__all__ = ["arm", "sim"]  # fixtures


FAULTS = {
    "emergency_stop": ("emergency stop", "release"),
    "kill_script": ("its program is stopped", "pendant"),
    "local_mode": ("local mode", "remote control"),
    "rtde_drop": ("the link is lost", "network cable"),
    "rtde_stall": ("the link is lost: no new data", "network cable"),
    "rtde_half_frame": ("the link is lost: no new data", "network cable"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_in_motion_stops_the_arm_and_names_its_cause(arm, sim, fault):
    cases.under_way(arm, sim)
    since = sim.admin(fault)["fault_ns"]
    text = cases.error_of(arm.moving)
    cases.check_resting(sim, since)
    for words in (sim.host, *FAULTS[fault], "--resume"):
        assert words in text
    assert error_again(arm)
    cases.put_right(sim)
    arm.take_control(cases.MASS, cases.COM)  # what the next run does
    arm.start_move(cases.away(arm, by=0.1), cases.SPEED, cases.ACCELERATION)
    cases.finish(arm)


def test_program_that_ended_is_the_cause_though_the_process_that_commands_hangs(arm, sim):
    cases.under_way(arm, sim)
    os.kill(arm.workers[1], signal.SIGSTOP)
    since = sim.admin("kill_script")["fault_ns"]
    text = cases.error_of(arm.moving)
    cases.check_resting(sim, since)
    assert "its program is stopped" in text
    assert "ended" not in text


def test_motion_that_is_refused_is_told(arm, sim):
    sim.admin("refuse_motion", on=True)
    goal = cases.away(arm)
    text = cases.error_of(lambda: arm.start_move(goal, cases.SPEED, cases.ACCELERATION))
    assert "did not take the motion" in text
    assert not sim.admin()["moving"]


def error_again(arm):
    """A motion that failed is not taken for one that has ended."""
    with pytest.raises(DeviceError, match="not under control"):
        arm.moving()
    with pytest.raises(DeviceError, match="not under control"):
        arm.start_move(np.zeros(6), 0.5, 0.5)
    return True


def test_sample_in_motion_stops_the_arm_when_the_link_is_lost(arm, sim):
    cases.under_way(arm, sim)
    since = sim.admin("rtde_drop")["fault_ns"]
    assert "the link is lost" in cases.error_of(arm.sample)
    cases.check_resting(sim, since)


def test_protective_stop_names_its_cause_and_is_recovered_from(tmp_path):
    running = cases.start(tmp_path)
    arm = None
    try:
        arm = cases.controlled(running)
        cases.under_way(arm, running)
        since = running.admin("protective_stop")["fault_ns"]
        text = cases.error_of(arm.moving)
        cases.check_resting(running, since)
        for words in ("protective stop", "unlock", "--resume"):
            assert words in text
        with pytest.raises(DeviceError, match="protective stop"):
            arm.take_control(cases.MASS, cases.COM)
        assert any("protective stop" in problem for problem in arm.report().problems)
    finally:
        if arm is not None:
            arm.close()
        running.close()


@pytest.mark.slow
def test_program_that_a_protective_stop_left_paused_is_ended(tmp_path):
    running = cases.start(tmp_path)
    arm = other = None
    try:
        other = cases.controlled(running)
        running.admin("protective_stop")
        os.kill(other.workers[0], signal.SIGSTOP)
        running.wait("runtime", 4)
        time.sleep(5.2)  # the robot takes an unlock no sooner
        dashboard.ask(running.host, ("unlock protective stop",), 2.0)
        os.kill(other.workers[1], signal.SIGKILL)
        assert running.wait("safety", 1)["runtime"] == 4
        arm = cases.controlled(running)
        arm.start_move(cases.away(arm, by=0.1), cases.SPEED, cases.ACCELERATION)
        cases.finish(arm)
    finally:
        for one in (arm, other):
            if one is not None:
                one.close()
        running.close()


def test_controller_mute_in_motion(arm, sim):
    # it hears nothing either, so its own watchdog stops it
    cases.under_way(arm, sim)
    since = sim.admin("rtde_mute", on=True)["fault_ns"]
    text = cases.error_of(arm.moving)
    cases.check_resting(sim, since)
    assert "its program is stopped" in text or "the link is lost" in text


def test_stop_says_so_when_it_cannot_be_seen_that_the_arm_stands(arm, sim):
    cases.under_way(arm, sim)
    since = sim.admin("rtde_stall", on=True)["fault_ns"]
    begun = time.monotonic()
    with pytest.raises(DeviceError, match="NOT SURE THAT THE ARM STANDS"):
        arm.stop()
    assert time.monotonic() - begun < 5.0
    cases.check_resting(sim, since)


def test_controller_dies_in_motion(tmp_path):
    running = cases.start(tmp_path)
    arm = cases.controlled(running)
    try:
        cases.under_way(arm, running)
        with pytest.raises(DeviceError):
            running.admin("die")
        assert "the link is lost" in cases.error_of(arm.moving)
        assert "the link is lost" in cases.error_of(arm.sample)
        assert arm.report().problems
        with pytest.raises(DeviceError, match="refuses the connection"):
            arm.take_control(1.0, np.zeros(3))
    finally:
        arm.close()
        running.close()
    assert cases.children() == []


@pytest.mark.slow
def test_motion_scaled_to_nothing_is_given_up(arm, sim):
    goal = cases.under_way(arm, sim)
    sim.admin("set", speed_scaling=0.0)
    assert "scaled to 0" in cases.error_of(arm.moving)
    assert not sim.admin()["moving"]
    sim.admin("set", speed_scaling=1.0)
    time.sleep(0.2)
    assert abs(sim.admin()["q"][0] - goal[0]) > 0.05  # it does not go on later


def test_slow_speed_slider_is_waited_for(arm, sim):
    sim.admin("set", slider=0.2)
    goal = cases.away(arm, by=0.05)
    arm.start_move(goal, cases.SPEED, cases.ACCELERATION)
    cases.finish(arm)
    np.testing.assert_allclose(sim.admin()["q"], goal, atol=2e-5)


@pytest.mark.parametrize("fault", ["rtde_drop", "rtde_stall", "rtde_half_frame"])
def test_link_lost_at_rest_gives_no_old_values(arm, sim, fault):
    sim.admin(fault)
    assert "the link is lost" in cases.error_of(arm.sample)
    for _ in range(3):
        with pytest.raises(DeviceError, match="the link is lost"):
            arm.sample()
    cases.put_right(sim)
    arm.take_control(cases.MASS, cases.COM)
    assert arm.sample().payload == cases.MASS
