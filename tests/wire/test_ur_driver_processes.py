"""The UR driver's child processes: they die, hang, or have to end, and the arm stands."""

import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

from drivers.ur_link import dashboard
from tests.support import sim_ur_cases
from tests.support import ur_driver_cases as cases
from tests.support.ur_driver_cases import arm, sim

__all__ = ["arm", "sim"]  # fixtures


@pytest.mark.parametrize(
    ("worker", "number"),
    [(1, signal.SIGSEGV), (1, signal.SIGKILL), (1, signal.SIGSTOP), (0, signal.SIGKILL)],
)
@pytest.mark.parametrize("mute", [False, True])
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


def test_close_in_motion_stops_and_leaves_no_process(sim):
    arm = cases.controlled(sim)
    pids = [p.pid for p in cases.children()]
    assert len(pids) == 2
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


_PARENT = """
import sys, time
import numpy as np
from tests.support import ur_driver_cases as cases
from drivers.ur import open_arm
arm = open_arm(cases.config(sys.argv[1]))
arm.take_control(1.0, np.array([0.0, 0.0, 0.1]))
arm.start_move(cases.away(arm, 2.0), cases.SPEED, cases.ACCELERATION)
while arm.moving():
    print("moves", flush=True)
    time.sleep(0.02)
"""


def test_kill_9_of_the_program_stops_the_arm_and_leaves_no_process(sim):
    parent = subprocess.Popen(
        [sys.executable, "-c", _PARENT, sim.host],
        stdout=subprocess.PIPE,
        cwd=sim_ur_cases.ROOT,
        env=sim_ur_cases.environment(),
    )
    try:
        for _ in range(30):
            assert parent.stdout.readline() == b"moves\n"
        pids = [p.pid for p in psutil.Process(parent.pid).children(recursive=True)]
        assert len(pids) == 2
        killed = time.monotonic_ns()
        parent.kill()
        state = sim.wait("moving", False)
        assert state["rest_ns"] - killed < cases.STOP_NS
        parent.wait()
        end = time.monotonic() + 5.0
        while any(_runs(pid) for pid in pids):
            assert time.monotonic() < end, "a child outlived the program"
            time.sleep(0.01)
    finally:
        parent.kill()
        parent.wait()
        parent.stdout.close()
    arm = cases.controlled(sim)  # and the next program takes over
    arm.close()


_TAKING = """
import sys
from tests.support import ur_driver_cases as cases
from drivers.ur import open_arm
open_arm(cases.config(sys.argv[1])).take_control(cases.MASS, cases.COM)
"""


def test_kill_9_while_control_is_taken_leaves_no_program_behind(sim):
    scripts = sim.admin()["scripts"]
    parent = subprocess.Popen(
        [sys.executable, "-c", _TAKING, sim.host],
        cwd=sim_ur_cases.ROOT,
        env=sim_ur_cases.environment(),
    )
    try:
        while sim.admin()["scripts"] == scripts:
            assert parent.poll() is None
            time.sleep(0.001)
        parent.kill()  # the robot's program is uploaded and has no watchdog yet
        sim.wait("script_running", False)
        sim.wait("rtde_clients", 0)
        arm = cases.controlled(sim)  # and the next program takes over
        arm.close()
    finally:
        parent.kill()
        parent.wait()
        dashboard.ask(sim.host, ("stop",), 2.0)


def _runs(pid):
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


_HANGING = """
import sys, threading
from drivers.ur_link.worker import Worker
arguments = (sys.argv[1], "125.0", "timestamp")
start = lambda: Worker("drivers.ur_link.receive_worker", arguments, 60.0)
thread = threading.Thread(target=start)
thread.start()
thread.join()
"""


def test_child_that_hangs_in_the_client_library_ends_with_the_program():
    host = sim_ur_cases.free_host()
    with socket.socket() as server:
        server.bind((host, 30004))
        server.listen(4)
        parent = subprocess.Popen(
            [sys.executable, "-c", _HANGING, host],
            cwd=sim_ur_cases.ROOT,
            env=sim_ur_cases.environment(),
        )
        try:
            line, _ = server.accept()  # the library is in its constructor, and stays there
            with line:
                (child,) = psutil.Process(parent.pid).children()
                parent.kill()
                parent.wait()
                end = time.monotonic() + 5.0
                while child.is_running() and child.status() != psutil.STATUS_ZOMBIE:
                    assert time.monotonic() < end, "the child outlived the program"
                    time.sleep(0.01)
        except psutil.NoSuchProcess:
            pass
        finally:
            parent.kill()
            parent.wait()
