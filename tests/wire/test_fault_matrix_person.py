"""A person beside the arm, another program, and instruments that repeat themselves, in a campaign.

As for the arm: one campaign on one simulated cell, and every run meets something. What a person
can put right is asked for and put right, and the run goes on; all else ends it with one line.
"""

import re
import socket
from pathlib import Path

import numpy as np
import pytest

from tests.support import campaign_cases as cases

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("nothing_goes_on")]

SCRIPT_PORT = 30003
HAND = [20.0, 35.0, -44.0, 0.0, 0.0, 0.0]
NOBODY = [0.0] * 6


def somebody_jogs(s: cases.Site) -> None:
    """Move the arm by hand, a little, from where it is."""
    q = s.ask("arm", "state")["q"]
    s.ask("arm", "jog", q=[q[0] + 0.1, *q[1:5], q[5] + 0.2])


def another_program(s: cases.Site) -> None:
    """Send the arm elsewhere by the script port, as any program of the network may."""
    q = np.array(s.ask("arm", "state")["q"]) + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5])
    text = f"def other():\n  movej([{', '.join(map(str, q))}], a=1.4, v=1.0)\nend\n"
    assert s.config.robot.host is not None
    with socket.create_connection((s.config.robot.host, SCRIPT_PORT), timeout=5.0) as line:
        line.sendall(text.encode())


LEANING = cases.Fault(
    "somebody leans on the tool",
    cases.act("world", "push", wrench=HAND),
    cases.act("world", "push", wrench=NOBODY),
    ("asked 3 times|max_moment_Nm|max_force_N", "touch the tool|hangs|pulls|felt|touches"),
)
FOREIGN = "another program"
MOTION = (
    cases.switch(
        "joint angles stand still", "arm", "freeze", "stood still|its angle is old", fast=True
    ),
    cases.Fault("another program", another_program, cases.no_action, (FOREIGN,)),
    LEANING,
)
REST = (
    cases.Fault("jogged", somebody_jogs, cases.no_action, ("moved it|has commanded it",)),
    cases.Fault("another program", another_program, cases.no_action, (FOREIGN,), fast=True),
    cases.switch("tracker stands still", "tracker", "freeze", "same to the last digit", fast=True),
    cases.switch("another reflector", "tracker", "stray", "follows a reflector|sees its target"),
    cases.switch("force sensor stands still", "force", "freeze", "same to the last digit"),
    LEANING,
)


@cases.parametrize_faults(MOTION)
def test_in_motion(fault: cases.Fault, cell: cases.Site, path: Path) -> None:
    cases.check_fault(fault, cell, path, moving=True)


@cases.parametrize_faults(REST)
def test_at_rest(fault: cases.Fault, cell: cases.Site, path: Path) -> None:
    cases.check_fault(fault, cell, path, moving=False)


def loaded(run: cases.Run) -> str:
    """Wait for a reading under a load; returns its name."""
    found: list[str] = []

    def under_load() -> bool:
        name = run.site.ask("world", "state")["load"]
        found[:] = [] if name is None else [name]
        now = run.output.rstrip().rpartition("\n")[2]
        return bool(found) and "measuring" in now and found[0] in now

    run.wait_until(under_load, "a reading under a load")
    return found[0]


def test_a_load_that_falls_off_is_asked_for_again_and_no_reading_is_without_it(
    cell: cases.Site, path: Path
) -> None:
    run, name = cases.start_run(cell, path, loaded)
    cell.ask("world", "hang", name=None)
    run.wait_until(lambda: "touch the tool" in run.output, "words about the load")
    run.wait_until(lambda: cell.ask("world", "state")["load"] == name, "the load again")
    run.next_reading("the load that was hung again")
    run.interrupt()
    cases.failed(run, 130)
    cases.check_readings(cell, path)


@pytest.mark.slow
def test_the_campaign_is_finished(cell: cases.Site, path: Path) -> None:
    cases.finish(cell, path)
    assert re.search("doubted", path.with_suffix(".hilcal").read_bytes().decode("latin-1"))
