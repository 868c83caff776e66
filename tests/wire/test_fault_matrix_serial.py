"""Faults of the serial instruments in the middle of a campaign, and of the person at the hook.

As for the arm: one campaign on one simulated cell, and every run meets a fault. Some of them are
overcome without help: then the run goes on, and says what happened.
"""

from itertools import zip_longest
from pathlib import Path

import pytest

from tests.support import campaign_cases as cases

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("nothing_goes_on")]

NO_FORCE = [0.0] * 6
HIT = [0.0, 0.0, -280.0, 0.0, 0.0, 0.0]
TOO_MUCH = "max_force_N|over its range"  # with a load on the hook it may be beyond the range


def unplugged(device: str) -> cases.Fault:
    name = f"{device} unplugged"
    says = (device, "unplugged")
    return cases.Fault(name, cases.act(device, "unplug"), cases.act(device, "replug"), says)


def rate(device: str, wrong: int, good: int, says: str) -> cases.Fault:
    on, off = cases.act(device, "baud", baud=wrong), cases.act(device, "baud", baud=good)
    return cases.Fault(f"{device} at another rate", on, off, (device, says))


TRACKER = (
    cases.switch(
        "beam broken", "tracker", "beam", "tracker", "no target in sight", "searched 2 times"
    ),
    cases.Fault(
        "angles only, distance 0.0 (1285)",
        cases.act("tracker", "meas_s", seconds=10.0),  # longer than it is waited for
        cases.act("tracker", "meas_s", seconds=0.3),
        ("tracker", "only angles", "1285", "searched 2 times"),
        fast=True,
    ),
    cases.switch("no distance (1292)", "tracker", "dist_error", "tracker", "distance", "1292"),
    cases.switch("tracker mute", "tracker", "mute", "tracker", "no answer"),
    cases.switch("tracker busy", "tracker", "busy", "tracker", "1293"),
    unplugged("tracker"),
    rate("tracker", 9600, 115200, "no answer|what comes is no GeoCOM"),
)

FORCE = (
    unplugged("force"),
    cases.switch("force sensor stalled", "force", "stall", "force", "nothing came"),
    cases.switch("force sensor mute", "force", "mute", "force", "nothing came"),
    rate("force", 57600, 19200, "no whole frame|nothing came"),
    cases.Fault(
        "overload",
        cases.act("force", "overload", force=HIT),
        cases.act("force", "overload", force=NO_FORCE),
        ("force sensor", TOO_MUCH),
        fast=True,
    ),
)


def damage(device: str, op: str) -> cases.Fault:
    """The line flips or cuts for a while."""
    on, off = cases.act(device, op, probability=0.02), cases.act(device, op, probability=0.0)
    return cases.Fault(f"{device} {op}", on, off, ())


def once(device: str, op: str, **arguments: object) -> cases.Fault:
    """What is over after once."""
    return cases.Fault(f"{device} {op}", cases.act(device, op, **arguments), cases.no_action, ())


OVERCOME = {
    "tracker": (
        once("tracker", "lock_lost"),
        cases.Fault(
            "tracker warns",
            cases.act("tracker", "warn", code=1283),
            cases.act("tracker", "warn", code=0),
            (),
        ),
        once("tracker", "wrong_trid", count=1),
        once("tracker", "delay", rpc=2167, seconds=1.5),  # the answer comes too late
        once("tracker", "half_frame"),
        damage("tracker", "flip"),
    ),
    "force": (
        once("force", "half_frame"),
        once("force", "garbage", count=50),
        damage("force", "flip"),
        damage("force", "cut"),
    ),
}
"""Faults that a run goes on from, by the line that they are on."""


@cases.parametrize_faults(TRACKER)
def test_a_fault_of_the_tracker(fault: cases.Fault, cell: cases.Site, path: Path) -> None:
    cases.check_fault(fault, cell, path, moving=False)


@cases.parametrize_faults(FORCE)
def test_a_fault_of_the_force_sensor_in_motion(
    fault: cases.Fault, cell: cases.Site, path: Path
) -> None:
    cases.check_fault(fault, cell, path, moving=True)


@pytest.mark.slow
@cases.parametrize_faults(FORCE)
def test_a_fault_of_the_force_sensor_at_rest(
    fault: cases.Fault, cell: cases.Site, path: Path
) -> None:
    cases.check_fault(fault, cell, path, moving=False)


def test_faults_that_are_overcome_cost_nothing(cell: cases.Site, path: Path) -> None:
    """All of them in one run, each for a whole reading, at both lines at a time."""
    run, _ = cases.start_run(cell, path, cases.Run.measuring)
    for row in zip_longest(*OVERCOME.values()):
        faults = [fault for fault in row if fault is not None]
        for fault in faults:
            fault.cause(cell)
        run.measuring()
        run.next_reading(", ".join(fault.name for fault in faults))
        for fault in faults:
            fault.mend(cell)
    run.interrupt()
    cases.failed(run, 130)
    cases.check_readings(cell, path)


@pytest.mark.slow
def test_the_campaign_has_every_reading_exactly_once(cell: cases.Site, path: Path) -> None:
    cases.finish(cell, path)
