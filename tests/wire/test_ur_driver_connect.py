"""The UR driver and what answers, or does not, when it connects or takes control."""

import socket
import threading
import time

import numpy as np
import pytest

from drivers.ur import open_arm
from hilcal.errors import DeviceError
from tests.support import sim_ur_cases
from tests.support import ur_driver_cases as cases

CONNECT_S = 8.0
"""Deadline of opening (the requirement)."""


@pytest.fixture(scope="module")
def sim(tmp_path_factory):
    running = cases.start(tmp_path_factory.mktemp("ur"))
    yield running
    running.close()


def test_local_mode_is_refused_before_anything_is_uploaded(sim):
    scripts = sim.admin("local_mode")["scripts"]
    arm = open_arm(cases.config(sim.host))
    try:
        with pytest.raises(DeviceError, match="local mode"):
            arm.take_control(1.0, np.zeros(3))
        assert sim.admin()["scripts"] == scripts
    finally:
        arm.close()
        cases.put_right(sim)


def fails_to_open(host):
    """The error of opening, which has to come before its deadline and leave nothing behind."""
    begun = time.monotonic()
    with pytest.raises(DeviceError) as caught:
        open_arm(cases.config(host))
    assert time.monotonic() - begun < CONNECT_S
    assert cases.children() == []
    text = str(caught.value)
    assert host in text
    assert "\n" not in text
    return text


def test_nobody_there():
    assert "refuses the connection" in fails_to_open(sim_ur_cases.free_host())


def test_mute_controller(sim):
    sim.admin("rtde_mute", on=True)
    try:
        assert "does not answer" in fails_to_open(sim.host)
    finally:
        cases.put_right(sim)


def test_controller_that_negotiates_and_sends_no_data(sim):
    sim.admin("rtde_stall", on=True)
    try:
        assert "no data" in fails_to_open(sim.host)
    finally:
        cases.put_right(sim)


def test_mute_dashboard(sim):
    sim.admin("dashboard_mute", on=True)
    arm = open_arm(cases.config(sim.host))
    try:
        assert any("dashboard" in problem for problem in arm.report().problems)
        begun = time.monotonic()
        with pytest.raises(DeviceError, match="dashboard"):
            arm.take_control(1.0, np.zeros(3))
        assert time.monotonic() - begun < CONNECT_S
        assert not sim.admin()["script_running"]
    finally:
        cases.put_right(sim)
        arm.close()


@pytest.mark.parametrize("says", [b"", b"\x00\x05V\x01", b"SSH-2.0-OpenSSH_9\r\n", b"\x00\x01V"])
def test_something_else_on_the_port(says):
    host = sim_ur_cases.free_host()
    with socket.socket() as server:
        server.bind((host, 30004))
        server.listen(4)

        def answer():
            line, _ = server.accept()
            with line:
                line.sendall(says)
                line.recv(100)

        thread = threading.Thread(target=answer)
        thread.start()
        fails_to_open(host)
        thread.join()
