"""The processes of a simulated cell: they start, agree, answer, and end."""

import os
import signal
import socket
import stat
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from hilcal.drivers.simulated import cell_processes
from hilcal.drivers.simulated.admin import ask
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.cell_processes import (
    UR_PORTS,
    DeviceProcess,
    SimulatedCell,
    free_host,
)
from hilcal.drivers.simulated.truth import Truth
from hilcal.drivers.simulated.world import World
from hilcal.drivers.simulated.world_server import write_world
from hilcal.errors import DeviceError, InputError
from tests.support.arm_cases import ODD, arm_of
from tests.support.paths import ROOT
from tests.support.rows import first
from tests.support.running_world import WEIGHT, config, same_bytes, states, world_of
from tests.support.timing import runs, wait_until

DEVICES = ("world", "arm", "tracker", "force")
SENSOR = {"driver": "ft300", "port": "to be filled in", "origin_m": [0.0, 0.0, 0.04]}


def whole(**sections):
    return config(force_sensor=SENSOR, **sections)


def start(directory, made=None, seed=3):
    made = made or whole()
    return SimulatedCell.start(world_of(made), made, directory, seed)


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    with start(tmp_path_factory.mktemp("c")) as cell:
        yield cell


def answers(host, port):
    with socket.socket() as line:
        line.settimeout(2.0)
        return line.connect_ex((host, port)) == 0


def children():
    return set(psutil.Process().children(recursive=True))


# a running cell


def test_every_device_is_a_process_of_its_own_and_answers(cell):
    pids = cell.processes()
    assert tuple(pids) == DEVICES
    assert len({*pids.values(), os.getpid()}) == 5
    for device in DEVICES:
        assert isinstance(cell.ask(device, "state"), dict)
    with pytest.raises(InputError, match="no device 'robot'; valid: world, arm, tracker, force"):
        cell.ask("robot", "state")


def test_the_configuration_leads_to_the_devices_and_keeps_the_rest(cell):
    given, filled = whole(), cell.config
    assert (filled.robot.driver, filled.tracker.driver) == ("ur", "geocom")
    assert (filled.force_sensor.driver, filled.operator.driver) == ("ft300", "simulated")
    assert Path(filled.tracker.port) == cell.directory / "tracker"
    assert Path(filled.force_sensor.port) == cell.directory / "force"
    assert filled.operator.options == {"socket": str(cell.directory / "world.sock")}
    host = filled.robot.host
    assert host.startswith("127.")
    assert host != "127.0.0.1"
    assert all(answers(host, port) for port in UR_PORTS)
    untouched = {
        "robot": filled.robot.model_copy(update={"driver": None, "host": None}),
        "tracker": filled.tracker.model_copy(update={"driver": None, "port": None}),
        "operator": given.operator,
        "force_sensor": given.force_sensor,
    }
    assert filled.model_copy(update=untouched) == given
    assert filled == type(filled).from_json(filled.to_json())


@pytest.mark.long
def test_two_cells_have_arms_of_their_own(cell, tmp_path):
    with start(tmp_path, config()) as other:
        assert tuple(other.processes()) == DEVICES[:3]  # no force sensor was configured
        assert other.config.robot.host != cell.config.robot.host
        other.ask("world", "hang", name="5kg")
        assert cell.ask("world", "state")["load"] is None
        pids = other.processes().values()
    assert not any(map(runs, pids))
    assert all(map(runs, cell.processes().values()))


def test_a_directory_in_use_is_refused(cell):
    with pytest.raises(InputError, match="another one runs in"):
        start(cell.directory)
    assert all(map(runs, cell.processes().values()))


@pytest.mark.parametrize("device", first(1, DEVICES))
def test_a_killed_device_comes_back_at_the_same_place(cell, device):
    before = cell.processes()
    cell.ask("world", "hang", name="5kg")
    cell.kill(device)
    assert not runs(before[device])
    assert device not in cell.processes()
    with pytest.raises(DeviceError):
        cell.ask(device, "state")
    cell.restart(device)
    after = cell.processes()
    assert after.pop(device) != before.pop(device)
    assert after == before
    assert isinstance(cell.ask(device, "state"), dict)
    assert cell.ask("world", "state")["load"] == "5kg"
    assert all(answers(cell.config.robot.host, port) for port in UR_PORTS)
    cell.ask("world", "hang", name=None)


def test_the_truth_goes_on_with_the_arm_after_a_restart_of_the_world(cell):
    cell.restart("world")
    board = Blackboard(cell.directory / "world.bin")
    cell.ask("world", "hang", name="5kg")
    truth, state = board.read("truth"), cell.ask("world", "state")
    arm = board.read("arm")
    state_of = replace(states(arm["q"], WEIGHT, 0.0), approach=arm["side"][None].copy())
    want = world_of(whole()).ideal_readings(state_of, np.array([state["slip"]]))
    assert same_bytes(truth["target"], want.position[0])
    cell.ask("world", "hang", name=None)


# its end


def test_nothing_is_left_behind(tmp_path):
    before, threads = children(), psutil.Process().num_threads()
    cell = start(tmp_path)
    pids = list(cell.processes().values())
    with pytest.raises(KeyError, match="the campaign"), cell:
        raise KeyError("the campaign")
    assert not any(map(runs, pids))
    assert children() == before
    assert psutil.Process().num_threads() == threads
    assert not list(tmp_path.glob("*.sock"))
    cell.close()


PARENT = """
import sys, time
from pathlib import Path
from tests.support.running_world import config, world_of
from hilcal.drivers.simulated.cell_processes import SimulatedCell
made = config(force_sensor={"driver": "bota", "port": "x"})
cell = SimulatedCell.start(world_of(made), made, Path(sys.argv[1]), 3)
print(*cell.processes().values(), flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("how", first(1, [signal.SIGKILL, signal.SIGINT]))
def test_the_devices_end_with_a_parent_that_is_killed(tmp_path, how):
    with subprocess.Popen(
        [sys.executable, "-c", PARENT, str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as parent:
        pids = [int(word) for word in parent.stdout.readline().split()]
        assert len(pids) == 4
        assert all(map(runs, pids))
        parent.send_signal(how)
        parent.wait(10.0)
        wait_until(lambda: not any(map(runs, pids)), "ended", 15.0)


# what goes wrong at the start


@pytest.mark.long
def test_an_address_that_another_program_took_is_not_insisted_on(tmp_path, monkeypatch):
    used_host, free = free_host(), free_host()
    hosts = iter([used_host, free])
    monkeypatch.setattr(cell_processes, "free_host", lambda: next(hosts))
    with socket.socket() as line:
        line.bind((used_host, UR_PORTS[0]))
        line.listen()
        with start(tmp_path) as cell:
            assert cell.config.robot.host == free
            assert isinstance(cell.ask("arm", "state"), dict)


def broken(monkeypatch, module, *arguments):
    """Let the tracker of the next cells be another module."""
    devices = cell_processes._devices

    def replaced(world, made, directory, *more):
        wrong = DeviceProcess("tracker", module, directory, arguments)
        made_devices, connected = devices(world, made, directory, *more)
        return {**made_devices, "tracker": wrong}, connected

    monkeypatch.setattr(cell_processes, "_devices", replaced)


def test_a_device_that_ends_early_is_named_with_its_last_words(tmp_path, monkeypatch):
    before = children()
    broken(monkeypatch, "hilcal.drivers.simulated.no_such_device")
    with pytest.raises(DeviceError, match=r"tracker: ended with exit code 1: .*No module"):
        start(tmp_path)
    assert children() == before


@pytest.mark.long
def test_a_device_that_never_gets_ready_is_named_at_the_deadline(tmp_path, monkeypatch):
    before = children()
    (tmp_path / "asleep.py").write_text("import time\ntime.sleep(600)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    broken(monkeypatch, "asleep")
    monkeypatch.setattr(cell_processes, "START_TIMEOUT", 2.0)
    with pytest.raises(DeviceError, match=r"tracker: not ready within 2 s; see .*\.log"):
        start(tmp_path, config())
    assert children() == before


def test_what_cannot_be_simulated_is_refused_before_anything_starts(tmp_path):
    made = whole()
    world = world_of(made)

    def refused(match, world=world, made=made, directory=tmp_path):
        with pytest.raises(InputError, match=match):
            SimulatedCell.start(world, made, directory, 1)

    refused(
        "no simulated force sensor 'ati'; valid: ft300",
        made=config(force_sensor={**SENSOR, "driver": "ati"}),
    )
    refused("too long for its sockets", directory=tmp_path / ("x" * 100))
    refused(
        "differ in load_point",
        made=whole(
            tool={"target_m": [0.06, 0.02, 0.12], "mass_kg": 0.8, "com_m": [0.01, 0.02, 0.06]}
        ),
    )
    at_the_base = replace(world, station=np.diag([-1.0, -1.0, 1.0, 1.0]))
    refused("a station measures from where it stands", world=at_the_base)
    arm = arm_of(ODD)
    odd = World(
        replace(world.cell, arm=arm), Truth.rigid(arm), *(np.eye(4),) * 2, world.noise, np.zeros(7)
    )
    refused("differ in arm.links", world=odd)
    (tmp_path / "force").mkdir()
    refused("cannot be used")
    assert not list(tmp_path.glob("*.log"))


def test_a_world_that_died_goes_on_where_it_was(tmp_path):
    made = config()
    write_world(tmp_path / "world.json", world_of(made), made)
    arguments = ("--seed", "5")
    process = DeviceProcess("world", "hilcal.drivers.simulated.world_server", tmp_path, arguments)

    def begin():
        process.start()
        wait_until(lambda: process.socket.exists() or process.has_ended, "started")
        process.check()

    with ExitStack() as ending:
        ending.callback(process.end)
        begin()
        board = Blackboard(tmp_path / "world.bin")
        ask(process.socket, "hang", name="pull")
        since, begun = board.read("truth")["load_since"], board.time
        ask(process.socket, "die")
        wait_until(lambda: process.has_ended, "ended")
        with pytest.raises(DeviceError, match="ended with exit code 70"):
            process.check()
        with pytest.raises(DeviceError, match=r"simulated device at world\.sock"):
            ask(process.socket, "state")
        begin()
        state = ask(process.socket, "state")
        assert (state["load"], state["load_since"]) == ("pull", since)
        assert state["time"] > begun


def test_requests_that_cannot_be_are_answered_with_what_is_valid(cell):
    before = cell.ask("world", "log")
    with pytest.raises(DeviceError, match=r"no load '7kg'.*valid: none, 5kg, pull"):
        cell.ask("world", "hang", name="7kg")
    with pytest.raises(DeviceError, match="unknown op 'heng'; valid: hang, mistake"):
        cell.ask("world", "heng")
    with pytest.raises(DeviceError, match="six numbers"):
        cell.ask("world", "push", wrench=[1.0])
    cell.ask("world", "swing", wrench=[1.0] * 6, period=1.0, decay=1.0)
    assert cell.ask("world", "log") == before


def test_a_process_without_a_world_says_so_in_one_line(tmp_path):
    process = DeviceProcess(
        "world", "hilcal.drivers.simulated.world_server", tmp_path, ("--seed", "5")
    )
    process.start()
    wait_until(lambda: process.has_ended, "ended")
    with pytest.raises(DeviceError, match=r"world: ended with exit code 2: .*world\.json"):
        process.check()
    process.end()
    assert len((tmp_path / "world.log").read_text().splitlines()) == 1


def listening(pid):
    """Addresses on which a process listens on TCP, by the kernel."""
    files = Path(f"/proc/{pid}/fd")
    held = {os.readlink(link) for link in files.iterdir() if link.is_symlink()}
    out = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in held:
                raw = bytes.fromhex(words[1].split(":")[0])
                out.append(socket.inet_ntoa(raw[::-1]) if len(raw) == 4 else "IPv6")
    return out


def test_the_simulated_arm_listens_on_loopback_alone(cell):
    addresses = listening(cell.processes()["arm"])
    assert len(addresses) == 4  # RTDE, dashboard, primary, script
    assert all(address.startswith("127.") for address in addresses)


def test_admin_lines_are_of_the_user_who_started_them(cell):
    for device in DEVICES:
        line = (cell.directory / f"{device}.sock").stat()
        assert stat.S_IMODE(line.st_mode) == 0o600
        assert line.st_uid == os.getuid()
