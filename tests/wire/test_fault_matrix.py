"""Faults in the middle of a campaign: what the operator sees, and what is stored.

Of the arm, of the serial instruments, of the person beside them, and of another program. One
campaign is measured on one simulated cell, and every run of `hilcal run` meets a fault. Whatever
it is, the arm stands within half a second, the program ends by itself with one line, and leaves no
process; the resumed campaign has every reading exactly once. What is overcome without help, or
what the person is asked to put right, ends no run.
"""

import socket
from dataclasses import replace
from itertools import zip_longest

import numpy as np
import pytest

from tests.support import campaign_cases as cases
from tests.support.timing import wait_until

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("nothing_goes_on")]


def arm(op, **arguments):
    return cases.act("arm", op, **arguments)


def off(*ops):
    """Switch faults off."""

    def undo(s):
        for op in ops:
            s.ask("arm", op, on=False)

    return undo


def unlock(s):
    """As on the pendant: acknowledge, and stop the paused program."""
    s.ask("arm", "set", unlock_s=0.0)
    s.dashboard("unlock protective stop", "stop")


def release(s):
    """As on the pendant; the dashboard powers an arm on in remote mode only."""
    s.ask("arm", "remote_mode")
    s.ask("arm", "release_emergency_stop")
    s.dashboard("power on", "brake release")
    wait_until(lambda: s.ask("arm", "state")["robot_mode"] == 7, "running")


def alone(op, **arguments):
    """The same while the dashboard, the second way to stop, does not answer."""

    def do(s):
        s.ask("arm", "dashboard_mute", on=True)
        s.ask("arm", op, **arguments)

    return do


PROTECTIVE = cases.Fault("protective stop", arm("protective_stop"), unlock, ("protective stop",))
STALLED = cases.Fault("link stalled", arm("rtde_stall"), off("rtde_stall"), ("link",))
ANYWHERE = (
    cases.Fault("emergency stop", arm("emergency_stop"), release, ("emergency stop",)),
    cases.Fault(
        "safeguard stop", arm("safeguard_stop"), arm("release_safeguard"), ("safeguard stop",)
    ),
    cases.Fault("reduced mode", arm("reduced_mode"), off("reduced_mode"), ("reduced mode",)),
    cases.Fault("local mode", arm("local_mode"), arm("remote_mode"), ("local",)),
    cases.Fault("program stopped", arm("kill_script"), cases.no_action, ("program",)),
    cases.Fault("link dropped", arm("rtde_drop"), cases.no_action, ("link",)),
    cases.Fault("half a frame", arm("rtde_half_frame"), cases.no_action, ("link",)),
    cases.Fault("controller mute", arm("rtde_mute"), off("rtde_mute"), ("arm",)),
)


ARM_MOTION = (
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
ARM_REST = (
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


NO_FORCE = [0.0] * 6
HIT = [0.0, 0.0, -280.0, 0.0, 0.0, 0.0]
TOO_MUCH = "max_force_N|over its range"  # with a load on the hook it may be beyond the range


def unplugged(device):
    name = f"{device} unplugged"
    says = (device, "unplugged")
    return cases.Fault(name, cases.act(device, "unplug"), cases.act(device, "replug"), says)


def rate(device, wrong, good, says):
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
    rate("tracker", 9600, 115200, "no answer|the bytes received are not GeoCOM"),
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


def damage(device, op):
    """The line flips or cuts for a while."""
    on, off = cases.act(device, op, probability=0.02), cases.act(device, op, probability=0.0)
    return cases.Fault(f"{device} {op}", on, off, ())


def once(device, op, **arguments):
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


SCRIPT_PORT = 30003
HAND = [20.0, 35.0, -44.0, 0.0, 0.0, 0.0]
NOBODY = [0.0] * 6


def somebody_jogs(s):
    """Move the arm by hand, a little, from where it is."""
    q = s.ask("arm", "state")["q"]
    s.ask("arm", "jog", q=[q[0] + 0.1, *q[1:5], q[5] + 0.2])


def another_program(s):
    """Send the arm elsewhere by the script port, as any program of the network may."""
    q = np.array(s.ask("arm", "state")["q"]) + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    text = f"def other():\n  movej([{', '.join(map(str, q))}], a=1.4, v=1.0)\nend\n"
    with socket.create_connection((s.config.robot.host, SCRIPT_PORT), timeout=5.0) as line:
        line.sendall(text.encode())


LEANING = cases.Fault(
    "somebody leans on the tool",
    cases.act("world", "push", wrench=HAND),
    cases.act("world", "push", wrench=NOBODY),
    ("asked 3 times|max_moment_Nm|max_force_N", "touch the tool|hangs|pulls|felt|touches"),
)
FOREIGN = "another program"
PERSON_MOTION = (
    cases.switch(
        "joint angles stand still", "arm", "freeze", "stood still|its angle is old", fast=True
    ),
    cases.Fault("another program", another_program, cases.no_action, (FOREIGN,)),
    LEANING,
)
PERSON_REST = (
    cases.Fault("jogged", somebody_jogs, cases.no_action, ("moved it|has commanded it",)),
    cases.Fault("another program", another_program, cases.no_action, (FOREIGN,), fast=True),
    cases.switch("tracker stands still", "tracker", "freeze", "same to the last digit", fast=True),
    cases.switch("another reflector", "tracker", "stray", "follows a reflector|sees its target"),
    cases.switch("force sensor stands still", "force", "freeze", "same to the last digit"),
    LEANING,
)


NOT_FAST = tuple(replace(fault, fast=False) for fault in FORCE)


@cases.parametrize_faults((*ARM_MOTION, *FORCE, *PERSON_MOTION))
def test_a_fault_in_motion(fault, cell, path):
    cases.check_fault(fault, cell, path, moving=True)


@cases.parametrize_faults((*ARM_REST, *TRACKER, *NOT_FAST, *PERSON_REST))
def test_a_fault_at_rest(fault, cell, path):
    cases.check_fault(fault, cell, path, moving=False)


def test_faults_that_are_overcome_cost_nothing(cell, path):
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


def loaded(run):
    """Wait for a reading under a load; returns its name."""
    collected = []

    def under_load():
        name = run.site.ask("world", "state")["load"]
        collected[:] = [] if name is None else [name]
        now = run.output.rstrip().rpartition("\n")[2]
        return bool(collected) and "measuring" in now and collected[0] in now

    run.wait_until(under_load, "a reading under a load")
    return collected[0]


def test_a_load_that_falls_off_is_asked_for_again_and_no_reading_is_without_it(cell, path):
    run, name = cases.start_run(cell, path, loaded)
    cell.ask("world", "hang", name=None)
    run.wait_until(lambda: "touch the tool" in run.output, "words about the load")
    run.wait_until(lambda: cell.ask("world", "state")["load"] == name, "the load again")
    run.next_reading("the load that was hung again")
    run.interrupt()
    cases.failed(run, 130)
    cases.check_readings(cell, path)


def test_the_campaign_has_every_reading_exactly_once(cell, path):
    cases.finish(cell, path)
