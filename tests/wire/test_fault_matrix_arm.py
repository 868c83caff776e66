"""Faults of the arm in the middle of a campaign: what the operator sees, and what is stored.

One campaign after the other is measured on one simulated cell, and every run of `hilcal run`
meets a fault. Whatever it is, the arm stands within half a second, the program ends by itself
with one line, and leaves no process; the resumed campaign has every reading exactly once.
"""

import time
from dataclasses import replace
from pathlib import Path

import pytest

from hilcal.types import Floats
from tests.support.campaign_cases import (
    Act,
    Fault,
    Run,
    Site,
    act,
    begin,
    each,
    failed,
    finish,
    meets,
    nothing,
    right,
    stopped_on_its_way,
)
from tests.support.timing import wait_until

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("nothing_goes_on")]


def arm(op: str, **arguments: object) -> Act:
    return act("arm", op, **arguments)


def off(*ops: str) -> Act:
    """Switch faults off."""

    def undo(s: Site) -> None:
        for op in ops:
            s.ask("arm", op, on=False)

    return undo


def unlock(s: Site) -> None:
    """As on the pendant: acknowledge, and stop the paused program."""
    s.ask("arm", "set", unlock_s=0.0)
    s.dashboard("unlock protective stop", "stop")


def release(s: Site) -> None:
    """As on the pendant; the dashboard powers an arm on in remote mode only."""
    s.ask("arm", "remote_mode")
    s.ask("arm", "release_emergency_stop")
    s.dashboard("power on", "brake release")
    wait_until(lambda: s.ask("arm", "state")["robot_mode"] == 7, "running")


def alone(op: str, **arguments: object) -> Act:
    """The same while the dashboard, the second way to stop, does not answer."""

    def do(s: Site) -> None:
        s.ask("arm", "dashboard_mute", on=True)
        s.ask("arm", op, **arguments)

    return do


PROTECTIVE = Fault("protective stop", arm("protective_stop"), unlock, ("protective stop",))
STALLED = Fault("link stalled", arm("rtde_stall"), off("rtde_stall"), ("link",))
ANYWHERE = (
    Fault("emergency stop", arm("emergency_stop"), release, ("emergency stop",)),
    Fault("local mode", arm("local_mode"), arm("remote_mode"), ("local",)),
    Fault("program stopped", arm("kill_script"), nothing, ("program",)),
    Fault("link dropped", arm("rtde_drop"), nothing, ("link",)),
    Fault("half a frame", arm("rtde_half_frame"), nothing, ("link",)),
    Fault("controller mute", arm("rtde_mute"), off("rtde_mute"), ("arm",)),
)
MOTION = (
    replace(PROTECTIVE, says=("protective stop", "unlock"), fast=True),
    replace(STALLED, says=("link", "0.2 s")),
    *ANYWHERE,
    Fault(
        "link dropped, dashboard mute",
        alone("rtde_drop"),
        off("dashboard_mute"),
        ("link",),
        fast=True,
    ),
    Fault(
        "link stalled, dashboard mute",
        alone("rtde_stall"),
        off("rtde_stall", "dashboard_mute"),
        ("link",),
    ),
    Fault(
        "paused by the speed slider",
        arm("set", slider=0.0),
        arm("set", slider=1.0),
        ("speed",),
        stops=False,  # it stands already
    ),
)
REST = (
    PROTECTIVE,
    STALLED,
    *ANYWHERE,
    Fault(
        "motion refused",
        arm("refuse_motion"),
        off("refuse_motion"),
        ("did not take the motion",),
        fast=True,
    ),
)
START = {
    "mute": (arm("rtde_mute"), off("rtde_mute"), ("RTDE", "does not answer")),
    "negotiated, then no data": (arm("rtde_stall"), off("rtde_stall"), ("data",)),
    "refused": (arm("refuse"), off("refuse"), ("refuses the connection",)),
    "dashboard mute": (arm("dashboard_mute"), off("dashboard_mute"), ("dashboard",)),
    "local mode": (arm("local_mode"), arm("remote_mode"), ("local mode", "remote control")),
    "protective stop": (arm("protective_stop"), unlock, ("protective stop", "unlock")),
    "emergency stop": (arm("emergency_stop"), release, ("emergency stop",)),
}


@each(MOTION)
def test_a_fault_in_motion(fault: Fault, cell: Site, path: Path) -> None:
    meets(fault, cell, path, moving=True)


@each(REST)
def test_a_fault_at_rest(fault: Fault, cell: Site, path: Path) -> None:
    meets(fault, cell, path, moving=False)


@pytest.mark.slow
def test_the_controller_loses_power_in_motion(cell: Site, path: Path) -> None:
    run, _ = begin(cell, path, Run.moving)
    cell.simulated.kill("arm")
    try:
        assert "link" in failed(run)
        right(cell, path)
        line = failed(Run(cell, path))  # nobody answers
    finally:
        cell.simulated.restart("arm")
    assert cell.config.robot.host is not None
    assert cell.config.robot.host in line


@pytest.mark.slow
def test_a_dashboard_that_is_dropped_or_mute_costs_nothing_and_the_arm_is_stopped_without_it(
    cell: Site, path: Path
) -> None:
    def without(run: Run) -> Floats:
        cell.ask("arm", "dashboard_drop")
        run.next_reading("a dropped dashboard")
        cell.ask("arm", "dashboard_mute", on=True)
        run.next_reading("a mute dashboard")
        return run.moving()

    try:
        run, goal = begin(cell, path, without)
        since = time.monotonic()
        run.interrupt()
        assert "interrupted" in failed(run, 130)
        stopped_on_its_way(cell, since, goal)
    finally:
        cell.ask("arm", "dashboard_mute", on=False)
    right(cell, path)


@pytest.mark.slow
@pytest.mark.parametrize("name", START)
def test_an_arm_that_is_not_ready_is_named_and_not_waited_for(
    name: str, cell: Site, path: Path
) -> None:
    do, undo, says = START[name]
    arrivals = cell.ask("arm", "state")["arrivals"]
    do(cell)
    try:
        line = failed(Run(cell, path))
        assert cell.ask("arm", "state")["arrivals"] == arrivals
    finally:
        undo(cell)
    assert "arm" in line
    for words in says:
        assert words in line


def test_the_campaign_has_every_reading_exactly_once(cell: Site, path: Path) -> None:
    finish(cell, path)
