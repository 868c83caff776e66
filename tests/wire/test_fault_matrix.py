"""Faults in the middle of a campaign: what the operator sees, and what is stored.

Of the arm, of the serial instruments, of the person beside them, and of another program. One
campaign is measured on one simulated cell, and every run of `hilcal run` meets a fault. Whatever
it is, the arm stands within half a second, the program ends by itself with one line, and leaves no
process; the resumed campaign has every reading exactly once. What is overcome without help, or
what the person is asked to put right, ends no run.
"""

import re
import socket
import time
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


START = {
    "mute": (arm("rtde_mute"), off("rtde_mute"), ("RTDE", "does not answer")),
    "negotiated, then no data": (arm("rtde_stall"), off("rtde_stall"), ("data",)),
    "refused": (arm("refuse"), off("refuse"), ("refuses the connection",)),
    "dashboard mute": (arm("dashboard_mute"), off("dashboard_mute"), ("dashboard",)),
    "local mode": (arm("local_mode"), arm("remote_mode"), ("local mode", "remote control")),
    "protective stop": (arm("protective_stop"), unlock, ("protective stop", "unlock")),
    "emergency stop": (arm("emergency_stop"), release, ("emergency stop",)),
}

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


MORE_READINGS = 8 + len(OVERCOME["tracker"])
NOT_FAST = tuple(replace(fault, fast=False) for fault in FORCE)


@cases.parametrize_faults((*ARM_MOTION, *FORCE, *PERSON_MOTION))
def test_a_fault_in_motion(fault, cell, path):
    cases.check_fault(fault, cell, path, moving=True)


@cases.parametrize_faults((*ARM_REST, *TRACKER, *NOT_FAST, *PERSON_REST))
def test_a_fault_at_rest(fault, cell, path):
    cases.check_fault(fault, cell, path, moving=False)


@pytest.mark.slow
def test_the_controller_loses_power_in_motion(cell, path):
    run, _ = cases.start_run(cell, path, cases.Run.moving)
    cell.simulated.kill("arm")
    try:
        assert "link" in cases.failed(run)
        cases.check_readings(cell, path)
        line = cases.failed(cases.Run(cell, path))  # nobody answers
    finally:
        cell.simulated.restart("arm")
    assert cell.config.robot.host is not None
    assert cell.config.robot.host in line


@pytest.mark.slow
def test_a_dashboard_that_is_dropped_or_mute_costs_nothing_and_the_arm_is_stopped_without_it(
    cell, path
):
    def without(run):
        cell.ask("arm", "dashboard_drop")
        run.next_reading("a dropped dashboard")
        cell.ask("arm", "dashboard_mute", on=True)
        run.next_reading("a mute dashboard")
        return run.moving()

    try:
        run, goal = cases.start_run(cell, path, without)
        since = time.monotonic()
        run.interrupt()
        assert "interrupted" in cases.failed(run, 130)
        cases.check_stopped_on_its_way(cell, since, goal)
    finally:
        cell.ask("arm", "dashboard_mute", on=False)
    cases.check_readings(cell, path)


@pytest.mark.slow
@pytest.mark.parametrize("name", START)
def test_an_arm_that_is_not_ready_is_named_and_not_waited_for(name, cell, path):
    do, undo, says = START[name]
    arrivals = cell.ask("arm", "state")["arrivals"]
    do(cell)
    try:
        line = cases.failed(cases.Run(cell, path))
        assert cell.ask("arm", "state")["arrivals"] == arrivals
    finally:
        undo(cell)
    assert "arm" in line
    for words in says:
        assert words in line


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
    found = []

    def under_load():
        name = run.site.ask("world", "state")["load"]
        found[:] = [] if name is None else [name]
        now = run.output.rstrip().rpartition("\n")[2]
        return bool(found) and "measuring" in now and found[0] in now

    run.wait_until(under_load, "a reading under a load")
    return found[0]


def test_a_load_that_falls_off_is_asked_for_again_and_no_reading_is_without_it(cell, path):
    run, name = cases.start_run(cell, path, loaded)
    cell.ask("world", "hang", name=None)
    run.wait_until(lambda: "touch the tool" in run.output, "words about the load")
    run.wait_until(lambda: cell.ask("world", "state")["load"] == name, "the load again")
    run.next_reading("the load that was hung again")
    run.interrupt()
    cases.failed(run, 130)
    cases.check_readings(cell, path)


NOT_READY = {
    what: [fault for fault in (*TRACKER, *FORCE) if fault.name.endswith(what)]
    for what in ("unplugged", "mute", "at another rate")
}


@pytest.mark.slow
@pytest.mark.parametrize("what", NOT_READY)
def test_instruments_that_are_not_ready_are_named_at_once(what, cell, path):
    arrivals = cell.ask("arm", "state")["arrivals"]
    for fault in NOT_READY[what]:
        fault.cause(cell)
    try:
        line = cases.failed(cases.Run(cell, path))
        assert cell.ask("arm", "state")["arrivals"] == arrivals
    finally:
        for fault in NOT_READY[what]:
            fault.mend(cell)
    assert "tracker" in line
    assert "force sensor" in line


@pytest.mark.slow
def test_a_hit_stops_the_arm(cell, path):
    """A collision is over after a moment, for the arm bounces off."""
    run, goal = cases.start_run(cell, path, cases.Run.moving)
    since = time.monotonic()
    cell.ask("force", "overload", force=HIT)
    time.sleep(0.1)
    cell.ask("force", "overload", force=NO_FORCE)
    line = cases.failed(run)
    cases.check_stopped_on_its_way(cell, since, goal)
    assert re.search(TOO_MUCH, line), line
    cases.check_readings(cell, path)


@pytest.mark.slow
def test_the_operator_hangs_the_wrong_load_and_is_told(cell, tmp_path):
    path = tmp_path / "loads.hilcal"
    short = cell.shorter(tmp_path, poses=1)
    cell.ask("world", "mistake", name="10kg")  # instead of nothing, at the start
    run = cases.Run(short, path)
    code, words = run.end()
    assert code == 0, words
    assert "asked to take everything off: the force sensor measures" in words
    cases.check_readings(short, path)


@pytest.mark.slow
def test_an_operator_who_keeps_hanging_the_wrong_load_ends_the_run(cell, tmp_path):
    path = tmp_path / "loads.hilcal"
    short = cell.shorter(tmp_path, poses=1)
    run, _ = cases.start_run(short, path, cases.Run.measuring)
    for _ in range(1 + 3):  # the plan hangs 10kg first
        cell.ask("world", "mistake", name="10kg")
    line = cases.failed(run)
    assert "asked 3 times to hang 5kg" in line
    assert "10.0 kg" in line
    cases.check_readings(short, path)
    cases.finish(short, path)


@pytest.mark.slow
def test_an_arm_jogged_before_a_campaign_goes_on_is_asked_for(cell, path):
    run, _ = cases.start_run(cell, path, cases.Run.measuring)
    run.kill()
    run.end()
    somebody_jogs(cell)
    again = cases.Run(cell, path)
    again.wait_until(lambda: "does not stand where its last" in again.output, "a question")
    again.interrupt()
    again.end()


def test_the_campaign_has_every_reading_exactly_once(cell, path):
    cases.finish(cell, path)
