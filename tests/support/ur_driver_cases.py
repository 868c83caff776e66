"""The UR driver on a simulated controller: how tests open it, move it, and put faults right."""

import socket
import threading
import time
from contextlib import contextmanager, suppress

import numpy as np
import psutil
import pytest

from hilcal.config import CellConfig
from hilcal.drivers.simulated.cell_processes import free_host
from hilcal.drivers.simulated.ur_server import API
from hilcal.drivers.ur import open_arm
from hilcal.drivers.ur_link.supervision import Dashboard, RobotApi, ask
from hilcal.errors import DeviceError
from tests.support import sim_ur_cases

MASS, COM = 2.5, np.array([0.01, -0.02, 0.08])
SPEED, ACCELERATION = 0.5, 4.0
STOP_NS = 500_000_000  # in this time the arm has to stand after a fault (the requirement)


def config(host, model="ur10e", clock=1.0, **options):
    options = {"robot_api_port": API, **options}
    robot = {"model": model, "driver": "ur", "host": host, "options": options}
    simulated = {"operator": {"driver": "simulated"}, "simulation": {"clock": clock}}
    return CellConfig.model_validate({"robot": robot, **simulated})


def start(directory, *arguments, scale=1.0):
    return sim_ur_cases.start(directory, scale, None, *arguments)


def controlled(sim, clock=1.0, **options):
    arm = open_arm(config(sim.host, clock=clock, **options))
    try:
        arm.take_control(MASS, COM)
    except BaseException:
        arm.close()
        raise
    return arm


def displaced_joints(arm, by=0.8):
    """A goal that takes a while, and stays within the joint limits."""
    q = arm.sample().q.copy()
    q[0] += by if q[0] < 0 else -by
    return q


def finish(arm):
    while arm.moving():
        time.sleep(0.01)


def under_way(arm, sim):
    """Start a motion and watch it until it has its full speed; returns the goal."""
    goal = displaced_joints(arm)
    arm.start_move(goal, SPEED, ACCELERATION)
    while abs(sim.admin()["qd"][0]) < 0.99 * SPEED:
        assert arm.moving()
        time.sleep(0.01)
    return goal


def error_of(call, seconds=20.0):
    """Call until a DeviceError comes; returns its text, which has to be one line."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            call()
        except DeviceError as error:
            text = str(error)
            break
        time.sleep(0.01)
    else:
        raise AssertionError(f"no DeviceError within {seconds} s")
    assert "\n" not in text
    return text


def supervision(sim):
    return RobotApi(sim.host, API) if sim.is_x else Dashboard(sim.host)


def api(sim):
    return RobotApi(sim.host, API)


def children():
    """Child processes of the driver (the simulated controllers are children, too)."""
    end = time.monotonic() + 2.0
    while True:
        processes = psutil.Process().children(recursive=True)
        ours = [(p, " ".join(_words(p))) for p in processes]
        relays = sum("ur_link.relay" in words for _, words in ours)
        commands = sum("ur_link.children" in words and " control " in words for _, words in ours)
        if relays <= commands or time.monotonic() > end:
            assert relays <= commands
            return [p for p, words in ours if "ur_link" in words and "relay" not in words]
        time.sleep(0.01)


def _words(process):
    try:
        return process.cmdline()
    except psutil.NoSuchProcess:
        return []


def restore(sim):
    """Switch off every fault and bring the robot back to running (not a protective stop)."""
    for op in ("rtde_stall", "rtde_mute", "dashboard_mute", "refuse", "refuse_motion"):
        sim.admin(op, on=False)
    sim.admin("set", slider=1.0, speed_scaling=1.0)
    sim.admin("remote_mode")
    sim.admin("release_emergency_stop")
    if sim.admin()["robot_mode"] != 7:
        if sim.is_x:
            for action in ("POWER_ON", "BRAKE_RELEASE"):
                api(sim).order("/robotstate/v1/state", action, 2.0)
        else:
            ask(sim.host, ("power on", "brake release"), 2.0)
        sim.wait("robot_mode", 7)
    sim.wait("moving", False)


def check_resting(sim, since):
    """The arm came to rest in time after a moment, and stays there."""
    state = sim.wait("moving", False)
    assert state["rest_ns"] - since < STOP_NS
    time.sleep(0.05)
    assert sim.admin()["q"] == state["q"]


@contextmanager
def server(port, says):
    """Something that listens on a port, and what it was asked, one connection after the other."""
    host, asked = free_host(), []
    with socket.socket() as door:
        door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        door.bind((host, port))
        door.listen(8)

        def serve():
            while True:
                try:
                    line, _ = door.accept()
                except OSError:
                    return
                with line:
                    line.settimeout(0.3)
                    data = b""
                    with suppress(TimeoutError):  # an order's body comes in a packet of its own
                        while not data or (data.startswith(b"PUT") and not data.endswith(b"}")):
                            data += line.recv(65536)
                    asked.append(data)
                    line.sendall(says(asked[-1]))

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield host, asked
        door.shutdown(socket.SHUT_RDWR)
    thread.join(2.0)


GENERATIONS = ("5.11.6.1010327", "10.14.0.0")
"""With a dashboard server, and with the Robot API of PolyScope X: one contract."""


@pytest.fixture(
    scope="module", params=[GENERATIONS[0], pytest.param(GENERATIONS[1], marks=pytest.mark.long)]
)
def sim(tmp_path_factory, request):
    """One controller of each generation for a file."""
    running = start(tmp_path_factory.mktemp("ur"), "--version", request.param)
    yield running
    running.close()


@pytest.fixture
def arm(sim):
    """An arm under control; after the test there is no fault and no process."""
    opened = controlled(sim)
    yield opened
    restore(sim)
    opened.close()
    assert children() == []
