"""Simulated UR controllers of their own: versions, the truth, start and end of the process."""

import os
import signal
import socket
import struct
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest

from drivers.simulated.blackboard import Blackboard
from hilcal.errors import DeviceError
from tests.support.sim_ur_cases import ROOT, Lines, Wire, command, environment, free_host, start


def test_older_controllers_do_not_know_everything(tmp_path):
    sim = start(tmp_path, 1.0, None, "--version", "5.5.0.0")
    try:
        with Wire(sim.host) as wire:
            kinds = wire.outputs("payload,payload_cog,ft_raw_wrench")
            assert kinds == "DOUBLE,NOT_FOUND,NOT_FOUND"
    finally:
        sim.close()


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


def test_polyscope_x_has_no_dashboard(tmp_path):
    sim = start(tmp_path, 1.0, None, "--version", "10.7.0.0")
    try:
        with pytest.raises(ConnectionRefusedError):
            Lines(sim.host)
        with Wire(sim.host) as wire:
            assert struct.unpack(">4I", wire.ask("v"))[0] == 10
    finally:
        sim.close()


@pytest.mark.parametrize("port", [29999, 30003, 30004])
def test_an_address_in_use_is_refused(tmp_path, port):
    Blackboard.create(tmp_path / "world.bin", 1.0)
    host = free_host()
    with socket.socket() as taken:
        taken.bind((host, port))
        taken.listen()
        keep = subprocess.Popen(
            command(tmp_path, host),
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment(),
        )
        try:
            assert keep.wait(20) == 3
            text = keep.stderr.read().decode()
        finally:
            keep.kill()
            keep.stdin.close()
            keep.stderr.close()
            keep.wait()
    assert text.count("\n") == 1
    assert f"{host}:{port} is in use" in text
    assert not (tmp_path / "arm.sock").exists()


def test_a_restarted_controller_finds_its_arm_where_it_was(tmp_path):
    sim = start(tmp_path)
    q = sim.admin()["q"]
    sim.close()
    (tmp_path / "arm.sock").unlink()
    board = Blackboard.attach(tmp_path / "world.bin")
    q[2] += 0.5
    board.write("arm", q=q, moving=1.0, arrivals=41)
    process = subprocess.Popen(
        command(tmp_path, sim.host), stdin=subprocess.PIPE, env=environment()
    )
    try:
        deadline = time.monotonic() + 20.0
        while not (tmp_path / "arm.sock").exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        state = sim.admin()
        assert state["q"] == q
        assert state["arrivals"] == 42
        assert board.read("arm")["arrivals"] == 42
    finally:
        process.stdin.close()
        process.wait(10)


def test_dies_on_request_and_with_its_parent(tmp_path):
    sim = start(tmp_path)
    with pytest.raises(DeviceError):
        sim.admin("die")
    assert sim.process.wait(5) == 1
    sim.close()
    (tmp_path / "arm.sock").unlink()
    code = (
        "import subprocess, sys, time\n"
        f"p = subprocess.Popen({command(tmp_path, sim.host)!r}, stdin=subprocess.PIPE)\n"
        "print(p.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, env=environment(), cwd=ROOT
    )
    child = psutil.Process(int(parent.stdout.readline()))
    try:
        deadline = time.monotonic() + 20.0
        while not (tmp_path / "arm.sock").exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
        psutil.wait_procs([child], timeout=5.0)
        assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE
    finally:
        parent.kill()
        parent.stdout.close()
        parent.wait()
