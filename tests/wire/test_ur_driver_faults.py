"""The UR driver when something goes wrong, also in its processes: what is read; the arm stands."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing, contextmanager

import numpy as np
import psutil
import pytest

from hilcal.drivers.simulated.cell_processes import free_host
from hilcal.drivers.ur import open_arm
from hilcal.drivers.ur_link import supervision
from hilcal.drivers.ur_link.worker import Worker, environment
from hilcal.errors import DeviceError
from tests.support import ur_driver_cases as cases
from tests.support.paths import ROOT
from tests.support.rows import first
from tests.support.timing import runs, wait_until
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
    for command in (arm.moving, lambda: arm.start_move(np.zeros(6), 0.5, 0.5)):
        with pytest.raises(DeviceError, match="not under control"):  # it has not ended by itself
            command()
    cases.restore(sim)
    arm.take_control(cases.MASS, cases.COM)  # what the next run does
    arm.start_move(cases.displaced_joints(arm, by=0.1), cases.SPEED, cases.ACCELERATION)
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
    goal = cases.displaced_joints(arm)
    text = cases.error_of(lambda: arm.start_move(goal, cases.SPEED, cases.ACCELERATION))
    assert "did not take the motion" in text
    assert not sim.admin()["moving"]


def test_sample_in_motion_stops_the_arm_when_the_link_is_lost(arm, sim):
    cases.under_way(arm, sim)
    since = sim.admin("rtde_drop")["fault_ns"]
    assert "the link is lost" in cases.error_of(arm.sample)
    cases.check_resting(sim, since)


def test_protective_stop_names_its_cause_and_is_recovered_from(tmp_path):
    with closing(cases.start(tmp_path)) as running, closing(cases.controlled(running)) as arm:
        cases.under_way(arm, running)
        since = running.admin("protective_stop")["fault_ns"]
        text = cases.error_of(arm.moving)
        cases.check_resting(running, since)
        for words in ("protective stop", "unlock", "--resume"):
            assert words in text
        with pytest.raises(DeviceError, match="protective stop"):
            arm.take_control(cases.MASS, cases.COM)
        assert any("protective stop" in problem for problem in arm.report().problems)


@pytest.mark.parametrize("mute", [False, True])
def test_an_arm_stopped_by_a_safeguard_stands_when_it_is_reset(arm, sim, mute):
    """The controller lets a paused program go on, which nobody watches any more."""
    goal = cases.under_way(arm, sim)
    sim.admin("dashboard_mute", on=mute)
    since = sim.admin("safeguard_stop")["fault_ns"]
    text = cases.error_of(arm.moving)
    cases.check_resting(sim, since)
    assert "safeguard stop; leave the guarded area and reset the safeguard" in text
    q = sim.admin()["q"]
    sim.admin("release_safeguard")
    time.sleep(1.0)
    moved = np.abs(np.array(sim.admin()["q"]) - q).max()  # the program's watchdog ends it, too
    assert moved < 1e-3 if mute else moved == 0.0
    assert abs(q[0] - goal[0]) > 0.1
    cases.restore(sim)
    arm.take_control(cases.MASS, cases.COM)


def test_a_safeguard_stop_at_rest_is_told_with_what_to_do(arm, sim):
    assert not arm.moving()
    sim.admin("safeguard_stop")
    assert "safeguard stop; leave the guarded area and reset" in cases.error_of(arm.moving)
    sim.admin("release_safeguard")
    cases.restore(sim)
    arm.take_control(cases.MASS, cases.COM)


def test_a_cell_that_always_works_in_reduced_mode_is_driven(sim):
    sim.admin("reduced_mode")
    try:
        with closing(cases.controlled(sim, reduced_mode=True)) as arm:
            assert not arm.report().problems
            arm.start_move(cases.displaced_joints(arm, by=0.1), cases.SPEED, cases.ACCELERATION)
            cases.finish(arm)
    finally:
        sim.admin("reduced_mode", on=False)


def test_an_arm_in_reduced_mode_is_stopped_and_goes_on_after_it(arm, sim):
    cases.under_way(arm, sim)
    since = sim.admin("reduced_mode")["fault_ns"]
    assert "reduced mode; leave the zone" in cases.error_of(arm.moving)
    cases.check_resting(sim, since)
    with pytest.raises(DeviceError, match="reduced mode"):
        arm.take_control(cases.MASS, cases.COM)
    sim.admin("reduced_mode", on=False)
    arm.take_control(cases.MASS, cases.COM)


@pytest.mark.slow
def test_program_that_a_protective_stop_left_paused_is_ended(tmp_path):
    with closing(cases.start(tmp_path)) as running, closing(cases.controlled(running)) as other:
        running.admin("protective_stop")
        os.kill(other.workers[0], signal.SIGSTOP)
        running.wait("runtime", 4)
        time.sleep(5.2)  # the robot takes an unlock no sooner
        supervision.ask(running.host, ("unlock protective stop",), 2.0)
        os.kill(other.workers[1], signal.SIGKILL)
        assert running.wait("safety", 1)["runtime"] == 4
        with closing(cases.controlled(running)) as arm:
            arm.start_move(cases.displaced_joints(arm, by=0.1), cases.SPEED, cases.ACCELERATION)
            cases.finish(arm)


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


@pytest.mark.long
def test_controller_dies_in_motion(tmp_path):
    with closing(cases.start(tmp_path)) as running, closing(cases.controlled(running)) as arm:
        cases.under_way(arm, running)
        with pytest.raises(DeviceError):
            running.admin("die")
        assert "the link is lost" in cases.error_of(arm.moving)
        assert "the link is lost" in cases.error_of(arm.sample)
        assert arm.report().problems
        with pytest.raises(DeviceError, match="refuses the connection"):
            arm.take_control(1.0, np.zeros(3))
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
    goal = cases.displaced_joints(arm, by=0.05)
    arm.start_move(goal, cases.SPEED, cases.ACCELERATION)
    cases.finish(arm)
    np.testing.assert_allclose(sim.admin()["q"], goal, atol=2e-5)


@pytest.mark.parametrize("fault", first(1, ["rtde_drop", "rtde_stall", "rtde_half_frame"]))
def test_link_lost_at_rest_gives_no_old_values(arm, sim, fault):
    sim.admin(fault)
    assert "the link is lost" in cases.error_of(arm.sample)
    for _ in range(3):
        with pytest.raises(DeviceError, match="the link is lost"):
            arm.sample()
    cases.restore(sim)
    arm.take_control(cases.MASS, cases.COM)
    assert arm.sample().payload == cases.MASS


@pytest.mark.parametrize(
    ("worker", "number"),
    [(1, signal.SIGSEGV), (1, signal.SIGKILL), (1, signal.SIGSTOP), (0, signal.SIGKILL)],
)
@pytest.mark.parametrize("mute", first(1, [False, True]))
def test_child_process_that_dies_or_hangs_in_motion(arm, sim, worker, number, mute):
    cases.under_way(arm, sim)
    if mute:
        sim.admin("dashboard_mute", on=True)
        assert arm.moving()
    since = time.monotonic_ns()
    os.kill(arm.workers[worker], number)
    text = cases.error_of(arm.moving)
    cases.check_resting(sim, since)
    assert ("process that commands it" if worker else "process that receives") in text
    assert cases.children() == [p for p in cases.children() if p.pid in arm.workers]


def test_stop_without_control_process_and_dashboard(arm, sim):
    cases.under_way(arm, sim)
    sim.admin("dashboard_mute", on=True)
    since = time.monotonic_ns()
    os.kill(arm.workers[1], signal.SIGKILL)
    arm.stop()
    cases.check_resting(sim, since)


def test_the_answer_to_a_request_that_was_interrupted_is_not_that_to_the_next(sim):
    worker = Worker("receive", (sim.host, "125.0", "timestamp"), 10.0)
    usual = signal.signal(signal.SIGALRM, signal.default_int_handler)  # as Ctrl-C
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with pytest.raises(KeyboardInterrupt):
            worker.call("rate", 2.0, window=0.3, stale=0.8)
        assert "fields" in worker.call("sample", 2.0, stale=0.8)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, usual)
        worker.kill()


def test_close_in_motion_stops_and_leaves_no_process(sim):
    arm = cases.controlled(sim)
    pids = [p.pid for p in cases.children()]
    assert len(pids) == 2 + sim.is_x  # the torques
    cases.under_way(arm, sim)
    called = time.monotonic_ns()
    arm.close()
    assert not any(psutil.pid_exists(pid) for pid in pids)
    state = sim.wait("moving", False)
    assert state["rest_ns"] - called < cases.STOP_NS
    sim.wait("script_running", False)
    sim.wait("rtde_clients", 0)
    arm.close()


def test_interrupt_from_the_terminal_does_not_end_the_children(arm, sim):
    goal = cases.under_way(arm, sim)
    for child in cases.children():
        os.kill(child.pid, signal.SIGINT)
    cases.finish(arm)
    np.testing.assert_allclose(sim.admin()["q"], goal, atol=2e-5)


@contextmanager
def program(code, host):
    """Another program that uses the arm at a host."""
    parent = subprocess.Popen(
        [sys.executable, "-c", code, host], stdout=subprocess.PIPE, cwd=ROOT, env=environment()
    )
    try:
        yield parent
    finally:
        parent.kill()
        parent.wait()
        parent.stdout.close()


MOVING = """
import sys, time
import numpy as np
from tests.support import ur_driver_cases as cases
from hilcal.drivers.ur import open_arm
arm = open_arm(cases.config(sys.argv[1]))
arm.take_control(1.0, np.array([0.0, 0.0, 0.1]))
arm.start_move(cases.displaced_joints(arm, 2.0), cases.SPEED, cases.ACCELERATION)
while arm.moving():
    print("moves", flush=True)
    time.sleep(0.02)
"""


def test_kill_9_of_the_program_stops_the_arm_and_leaves_no_process(sim):
    with program(MOVING, sim.host) as parent:
        for _ in range(30):
            assert parent.stdout.readline() == b"moves\n"
        pids = [p.pid for p in psutil.Process(parent.pid).children(recursive=True)]
        assert len(pids) == 2 + 2 * sim.is_x  # the relay and the torques
        killed = time.monotonic_ns()
        parent.kill()
        state = sim.wait("moving", False)
        assert state["rest_ns"] - killed < cases.STOP_NS
        parent.wait()
        wait_until(lambda: not any(map(runs, pids)), "ended: the children", 5.0)
    cases.controlled(sim).close()  # and the next program takes over


TAKING = """
import sys
from tests.support import ur_driver_cases as cases
from hilcal.drivers.ur import open_arm
open_arm(cases.config(sys.argv[1])).take_control(cases.MASS, cases.COM)
"""


@pytest.mark.long
def test_kill_9_while_control_is_taken_leaves_no_program_behind(sim):
    scripts = sim.admin()["scripts"]
    try:
        with program(TAKING, sim.host) as parent:
            while sim.admin()["scripts"] == scripts:
                assert parent.poll() is None
                time.sleep(0.001)
            parent.kill()  # the robot's program is uploaded and has no watchdog yet
            sim.wait("script_running", False)
            sim.wait("rtde_clients", 0)
            cases.controlled(sim).close()  # and the next program takes over
    finally:
        cases.supervision(sim).stop(2.0)


def test_ctrl_c_while_control_is_taken_leaves_no_program_behind(sim):
    scripts = sim.admin()["scripts"]

    def interrupt():
        while sim.admin()["scripts"] == scripts:
            time.sleep(0.001)
        os.kill(os.getpid(), signal.SIGINT)  # the program is uploaded and has no watchdog yet

    person = threading.Thread(target=interrupt)
    try:
        with closing(open_arm(cases.config(sim.host))) as arm:
            person.start()
            with pytest.raises(KeyboardInterrupt):
                arm.take_control(cases.MASS, cases.COM)
        sim.wait("script_running", False)
    finally:
        person.join()
        cases.supervision(sim).stop(2.0)


HANGING = """
import sys, threading
from hilcal.drivers.ur_link.worker import Worker
arguments = (sys.argv[1], "125.0", "timestamp")
start = lambda: Worker("receive", arguments, 60.0)
thread = threading.Thread(target=start)
thread.start()
thread.join()
"""


@pytest.mark.long
def test_child_that_hangs_in_the_client_library_ends_with_the_program():
    host = free_host()
    with socket.socket() as server:
        server.bind((host, 30004))
        server.listen(4)
        with program(HANGING, host) as parent:
            line, _ = server.accept()  # the library is in its constructor, and stays there
            with line:
                (child,) = psutil.Process(parent.pid).children()
                parent.kill()
                parent.wait()
                wait_until(lambda: not runs(child.pid), "ended: the child", 5.0)
