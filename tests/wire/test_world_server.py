"""The process of the physical world."""

import time

import pytest

from hilcal.drivers.simulated.admin import ask
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.cell_processes import DeviceProcess
from hilcal.drivers.simulated.world_server import write_world
from hilcal.errors import DeviceError
from tests.support.living_cell import config, world_of


def wait_until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "never came true"
        time.sleep(0.005)


@pytest.fixture
def process(tmp_path):
    made = config()
    write_world(tmp_path / "world.json", world_of(made), made)
    arguments = ("--seed", "5")
    process = DeviceProcess("world", "hilcal.drivers.simulated.world_server", tmp_path, arguments)
    process.start()
    wait_until(lambda: process.socket.exists() or process.ended)
    process.check()
    yield process
    process.end()


def test_a_world_that_died_goes_on_where_it_was(process, tmp_path):
    board = Blackboard(tmp_path / "world.bin")
    ask(process.socket, "hang", name="pull")
    since, begun = board.read("truth")["load_since"], board.time
    ask(process.socket, "die")
    wait_until(lambda: process.ended)
    with pytest.raises(DeviceError, match="ended with exit code 70"):
        process.check()
    with pytest.raises(DeviceError, match=r"simulated device at world\.sock"):
        ask(process.socket, "state")
    process.start()
    wait_until(lambda: process.socket.exists() or process.ended)
    state = ask(process.socket, "state")
    assert (state["load"], state["load_since"]) == ("pull", since)
    assert state["time"] > begun


def test_requests_that_cannot_be_are_answered_with_what_is_valid(process):
    with pytest.raises(DeviceError, match=r"no load '7kg'.*valid: none, 5kg, pull"):
        ask(process.socket, "hang", name="7kg")
    with pytest.raises(DeviceError, match="unknown op 'heng'; valid: hang, mistake"):
        ask(process.socket, "heng")
    with pytest.raises(DeviceError, match="six numbers"):
        ask(process.socket, "push", wrench=[1.0])
    ask(process.socket, "swing", wrench=[1.0] * 6, period=1.0, decay=1.0)
    assert ask(process.socket, "log") == []


def test_a_process_without_a_world_says_so_in_one_line(tmp_path):
    process = DeviceProcess(
        "world", "hilcal.drivers.simulated.world_server", tmp_path, ("--seed", "5")
    )
    process.start()
    wait_until(lambda: process.ended)
    with pytest.raises(DeviceError, match=r"world: ended with exit code 2: .*world\.json"):
        process.check()
    process.end()
    assert len((tmp_path / "world.log").read_text().splitlines()) == 1
