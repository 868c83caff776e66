"""Drivers are found by name, also somebody else's; what fails is told, device by device."""

import _thread
import importlib
import sys
import threading
from textwrap import dedent

import pytest

from hilcal.config import load_config
from hilcal.errors import InputError
from hilcal.measuring.connect import connect, driver
from hilcal.measuring.devices import TRACKERS
from tests.support.refusals import refusal

FOREIGN = """
from hilcal.measuring.devices import Report

closed = []


class Device:
    def __init__(self, device, name):
        self.device, self.name = device, name

    def report(self):
        if "mute" in self.name:
            raise ValueError("nothing\\nsaid")
        return Report(self.device, self.name)

    def close(self):
        closed.append(self.name)


def open_arm(config):
    return Device("arm", "their arm")


def open_tracker(config):
    if config.tracker.options.get("broken"):
        raise RuntimeError("no licence\\nfound")
    return Device("tracker", "their tracker at " + config.tracker.port)


def open_operator(config):
    return Device("operator", "their operator")
"""
CELL = """
[robot]
model = "ur10e"
driver = "their_arm"
[tool]
target_m = [0.06, 0.02, 0.12]
load_point_m = [0.1, 0.0, 0.15]
[tracker]
driver = "their_tracker"
port = "{port}"
[tracker.options]
broken = {broken}
[operator]
driver = "their_operator"
"""


@pytest.fixture
def foreign(tmp_path, monkeypatch):
    """Somebody's installed package with a driver for every part."""
    (tmp_path / "their_devices.py").write_text(FOREIGN, encoding="utf-8")
    about = tmp_path / "their_devices-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: their-devices\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(
        dedent("""\
        [hilcal.arms]
        their_arm = their_devices:open_arm
        [hilcal.trackers]
        their_tracker = their_devices:open_tracker
        not_there = their_devices:no_such_function
        [hilcal.operators]
        their_operator = their_devices:open_operator
        """)
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "their_devices", raising=False)
    return tmp_path


def cell(directory, broken="false", port="COM9"):
    path = directory / "cell.toml"
    path.write_text(CELL.format(broken=broken, port=port), encoding="utf-8")
    return path


def closed():
    """What the foreign package has closed."""
    return sorted(importlib.import_module("their_devices").closed)


def test_a_driver_of_another_package_is_found_by_its_name(foreign):
    rig, answers = connect(load_config(cell(foreign)))
    assert [a.problems for a in answers] == [(), (), ()]
    names = {a.device: a.report.name for a in answers if a.report is not None}
    assert names["tracker"] == "their tracker at COM9"
    assert rig.tracker.report().name == "their tracker at COM9"
    rig.close()


def test_a_driver_that_fails_in_its_own_way_is_told_and_all_are_closed(foreign):
    rig, answers = connect(load_config(cell(foreign, "true")))
    assert rig is None
    problems = {a.device: a.problems for a in answers}
    assert problems["arm"] == problems["operator"] == ()
    assert problems["tracker"] == ("tracker: RuntimeError: no licence found",)
    assert closed() == ["their arm", "their operator"]
    rig, answers = connect(load_config(cell(foreign, port="mute")))
    assert rig is None
    assert [a.problems for a in answers if a.device == "tracker"] == [
        ("tracker: ValueError: nothing said",)
    ]
    assert "their tracker at mute" in closed()


def test_an_interrupt_does_not_wait_for_a_driver_that_hangs(foreign, monkeypatch):
    given_up, returned = threading.Event(), threading.Event()

    def hangs(config):
        _thread.interrupt_main()
        given_up.wait(10.0)
        returned.set()

    config = load_config(cell(foreign))
    monkeypatch.setattr(importlib.import_module("their_devices"), "open_tracker", hangs)
    with pytest.raises(KeyboardInterrupt):
        connect(config)
    assert not returned.is_set()
    given_up.set()


def test_a_driver_that_is_unknown_or_cannot_be_loaded_is_one_line(foreign):
    with pytest.raises(InputError, match=r"their_trackr.*their_tracker") as raised:
        driver(TRACKERS, "their_trackr", "[tracker] driver")
    assert "geocom" in str(raised.value)
    refusal("their_devices:no_such_function", driver, TRACKERS, "not_there", "[tracker] driver")
