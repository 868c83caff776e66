"""Faults of the arm in the middle of a campaign: what the operator sees, and what is stored.

One campaign after the other is measured on one simulated cell, and every run of `hilcal run`
meets a fault. Whatever it is, the arm stands within half a second, the program ends by itself
with one line, and leaves no process; the resumed campaign has every reading exactly once.
"""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.support import campaign_cases as cases
from tests.support.timing import wait_until

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("nothing_goes_on")]


def arm(op: str, **arguments: object) -> cases.Act:
    return cases.act("arm", op, **arguments)


def off(*ops: str) -> cases.Act:
    """Switch faults off."""

    def undo(s: cases.Site) -> None:
        for op in ops:
            s.ask("arm", op, on=False)

    return undo


def unlock(s: cases.Site) -> None:
    """As on the pendant: acknowledge, and stop the paused program."""
    s.ask("arm", "set", unlock_s=0.0)
    s.dashboard("unlock protective stop", "stop")


def release(s: cases.Site) -> None:
    """As on the pendant; the dashboard powers an arm on in remote mode only."""
    s.ask("arm", "remote_mode")
    s.ask("arm", "release_emergency_stop")
    s.dashboard("power on", "brake release")
    wait_until(lambda: s.ask("arm", "state")["robot_mode"] == 7, "running")


def alone(op: str, **arguments: object) -> cases.Act:
    """The same while the dashboard, the second way to stop, does not answer."""

    def do(s: cases.Site) -> None:
        s.ask("arm", "dashboard_mute", on=True)
        s.ask("arm", op, **arguments)

    return do


PROTECTIVE = cases.Fault("protective stop", arm("protective_stop"), unlock, ("protective stop",))
STALLED = cases.Fault("link stalled", arm("rtde_stall"), off("rtde_stall"), ("link",))
ANYWHERE = (
    cases.Fault("emergency stop", arm("emergency_stop"), release, ("emergency stop",)),
    cases.Fault("local mode", arm("local_mode"), arm("remote_mode"), ("local",)),
    cases.Fault("program stopped", arm("kill_script"), cases.no_action, ("program",)),
    cases.Fault("link dropped", arm("rtde_drop"), cases.no_action, ("link",)),
    cases.Fault("half a frame", arm("rtde_half_frame"), cases.no_action, ("link",)),
    cases.Fault("controller mute", arm("rtde_mute"), off("rtde_mute"), ("arm",)),
)
MOTION = (
    replace(PROTECTIVE, patterns=("protective stop", "unlock"), fast=True),
    replace(STALLED, patterns=("link", "0.2 s")),
    *ANYWHERE,
    cases.Fault(
        "link dropped, dashboard mute",
        alone("rtde_drop"),
        off("dashboard_mute"),
        ("link",),
        fast=True,
    ),
    cases.Fault(
        "link stalled, dashboard mute",
        alone("rtde_stall"),
        off("rtde_stall", "dashboard_mute"),
        ("link",),
    ),
    cases.Fault(
        "paused by the speed slider",
        arm("set", slider=0.0),
        arm("set", slider=1.0),
        ("speed",),
        stops_arm=False,  # it stands already
    ),
)
REST = (
    PROTECTIVE,
    STALLED,
    *ANYWHERE,
    cases.Fault(
        "motion refused",
        arm("refuse_motion"),
        off("refuse_motion"),
        ("did not take the motion",),
        fast=True,
    ),
)


@cases.parametrize_faults(MOTION)
def test_a_fault_in_motion(fault: cases.Fault, cell: cases.Site, path: Path) -> None:
    cases.check_fault(fault, cell, path, moving=True)


@cases.parametrize_faults(REST)
def test_a_fault_at_rest(fault: cases.Fault, cell: cases.Site, path: Path) -> None:
    cases.check_fault(fault, cell, path, moving=False)


def test_the_campaign_has_every_reading_exactly_once(cell: cases.Site, path: Path) -> None:
    cases.finish(cell, path)
