"""Faults of the serial instruments in the middle of a campaign, and of the person at the hook.

As for the arm: one campaign on one simulated cell, and every run meets a fault. Some of them are
overcome without help: then the run goes on, and says what happened.
"""

import re
import time
from itertools import zip_longest
from pathlib import Path

import pytest

from tests.support.campaign_cases import (
    Fault,
    Run,
    Site,
    act,
    begin,
    cell,
    each,
    failed,
    finish,
    meets,
    nothing_goes_on,
    path,
    right,
    stopped_on_its_way,
)

pytestmark = pytest.mark.long

__all__ = ["cell", "nothing_goes_on", "path"]  # fixtures

NO_FORCE = [0.0] * 6
HIT = [0.0, 0.0, -280.0, 0.0, 0.0, 0.0]
TOO_MUCH = "max_force_N|over its range"  # with a load on the hook it may be beyond the range


def switch(name: str, device: str, op: str, says: tuple[str, ...], *, fast: bool = False) -> Fault:
    """A fault that is switched on and off."""
    on, off = act(device, op, on=True), act(device, op, on=False)
    return Fault(name, on, off, (device, *says), fast=fast)


def unplugged(device: str) -> Fault:
    name = f"{device} unplugged"
    says = (device, "unplugged")
    return Fault(name, act(device, "unplug"), act(device, "replug"), says)


def rate(device: str, wrong: int, good: int, says: str) -> Fault:
    on, off = act(device, "baud", baud=wrong), act(device, "baud", baud=good)
    return Fault(f"{device} at another rate", on, off, (device, says))


TRACKER = (
    switch("beam broken", "tracker", "beam", ("no target in sight", "searched 2 times")),
    Fault(
        "angles only, distance 0.0 (1285)",
        act("tracker", "meas_s", seconds=10.0),  # longer than it is waited for
        act("tracker", "meas_s", seconds=0.3),
        ("tracker", "only angles", "1285", "searched 2 times"),
        fast=True,
    ),
    switch("no distance (1292)", "tracker", "dist_error", ("distance", "1292")),
    switch("tracker mute", "tracker", "mute", ("no answer",)),
    switch("tracker busy", "tracker", "busy", ("1293",)),
    unplugged("tracker"),
    rate("tracker", 9600, 115200, "no answer|what comes is no GeoCOM"),
)

FORCE = (
    unplugged("force"),
    switch("force sensor stalled", "force", "stall", ("nothing came",)),
    switch("force sensor mute", "force", "mute", ("nothing came",)),
    rate("force", 57600, 19200, "no whole frame|nothing came"),
    Fault(
        "overload",
        act("force", "overload", force=HIT),
        act("force", "overload", force=NO_FORCE),
        ("force sensor", TOO_MUCH),
        fast=True,
    ),
)

NONE = ("flip", {"probability": 0.0})
FLIPS = {"probability": 0.02}
OVERCOME = {
    "tracker": (
        ("lock_lost", {}, None),
        ("warn", {"code": 1283}, ("warn", {"code": 0})),
        ("wrong_trid", {"count": 1}, None),
        ("delay", {"rpc": 2167, "seconds": 1.5}, None),  # the answer comes too late
        ("half_frame", {}, None),
        ("flip", FLIPS, NONE),
    ),
    "force": (
        ("half_frame", {}, None),
        ("garbage", {"count": 50}, None),
        ("flip", FLIPS, NONE),
        ("cut", FLIPS, ("cut", {"probability": 0.0})),
    ),
}
MORE_READINGS = len(OVERCOME["tracker"])
BOTH = ("tracker", "force")
START = {
    "unplugged": tuple([(d, op, {}) for d in BOTH] for op in ("unplug", "replug")),
    "mute": tuple([(d, "mute", {"on": on}) for d in BOTH] for on in (True, False)),
    "at another rate": (
        [("tracker", "baud", {"baud": 9600}), ("force", "baud", {"baud": 57600})],
        [("tracker", "baud", {"baud": 115200}), ("force", "baud", {"baud": 19200})],
    ),
}


@each(TRACKER)
def test_a_fault_of_the_tracker(fault: Fault, cell: Site, path: Path) -> None:
    meets(fault, cell, path, moving=False)


@each(FORCE)
def test_a_fault_of_the_force_sensor_in_motion(fault: Fault, cell: Site, path: Path) -> None:
    meets(fault, cell, path, moving=True)


@pytest.mark.slow
@each(FORCE)
def test_a_fault_of_the_force_sensor_at_rest(fault: Fault, cell: Site, path: Path) -> None:
    meets(fault, cell, path, moving=False)


@pytest.mark.slow
def test_a_hit_stops_the_arm(cell: Site, path: Path) -> None:
    """A collision is over after a moment, for the arm bounces off."""
    run, goal = begin(cell, path, Run.moving)
    since = cell.now()
    cell.ask("force", "overload", force=HIT)
    time.sleep(0.1)
    cell.ask("force", "overload", force=NO_FORCE)
    line = failed(run)
    stopped_on_its_way(cell, since, goal)
    assert re.search(TOO_MUCH, line), line
    right(cell, path)


def test_faults_that_are_overcome_cost_nothing(cell: Site, path: Path) -> None:
    """All of them in one run, each for a whole reading, at both lines at a time."""
    run, _ = begin(cell, path, Run.measuring)
    for row in zip_longest(*OVERCOME.values()):
        faults = [(d, *fault) for d, fault in zip(OVERCOME, row, strict=True) if fault is not None]
        for device, op, on, _ in faults:
            cell.ask(device, op, **on)
        run.measuring()
        run.next_reading(str(faults))
        for device, _, _, off in faults:
            if off is not None:
                cell.ask(device, off[0], **off[1])
    run.interrupt()
    failed(run, 130)
    right(cell, path)


@pytest.mark.slow
@pytest.mark.parametrize("what", START)
def test_instruments_that_are_not_ready_are_named_at_once(
    what: str, cell: Site, path: Path
) -> None:
    arrivals = cell.ask("arm", "state")["arrivals"]
    for device, op, arguments in START[what][0]:
        cell.ask(device, op, **arguments)
    try:
        line = failed(Run(cell, path))
        assert cell.ask("arm", "state")["arrivals"] == arrivals
    finally:
        for device, op, arguments in START[what][1]:
            cell.ask(device, op, **arguments)
    assert "tracker" in line
    assert "force sensor" in line


@pytest.mark.slow
def test_the_operator_hangs_the_wrong_load_and_is_told(cell: Site, tmp_path: Path) -> None:
    path = tmp_path / "loads.hilcal"
    short = cell.shorter(tmp_path, poses=1)
    cell.ask("world", "mistake", name="10kg")  # instead of nothing, at the start
    run = Run(short, path)
    code, words = run.end()
    assert code == 0, words
    assert "asked to take everything off: the force sensor feels" in words
    right(short, path)


@pytest.mark.slow
def test_an_operator_who_keeps_hanging_the_wrong_load_ends_the_run(
    cell: Site, tmp_path: Path
) -> None:
    path = tmp_path / "loads.hilcal"
    short = cell.shorter(tmp_path, poses=1)
    run, _ = begin(short, path, Run.measuring)
    for _ in range(3):
        cell.ask("world", "mistake", name="10kg")
    line = failed(run)
    assert "asked 3 times to hang 5kg" in line
    assert "10.0 kg" in line
    right(short, path)
    finish(short, path)


@pytest.mark.slow
def test_the_campaign_has_every_reading_exactly_once(cell: Site, path: Path) -> None:
    finish(cell, path)
