"""Why a motion ended: the causes in the order in which one masks another."""

import contextlib

from hilcal.drivers.ur_link import states
from hilcal.drivers.ur_link.brakes import ASK_S, Halt
from hilcal.drivers.ur_link.control_worker import WATCHDOG_HZ
from hilcal.drivers.ur_link.failure import CHECK_LINK, RESUME
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.reading import Reading
from hilcal.drivers.ur_link.supervision import Supervision
from hilcal.drivers.ur_link.worker import WorkerError

UNWATCHED = "nobody watched its motion for 0.5 s, so it was stopped"


def find(supervision: Supervision, halt: Halt, noticed: str) -> tuple[str, str]:
    """Return what happened and what to do about it, after the arm has been stopped.

    A safety stop ends the program, and a lost link the process that commands the arm: what was
    noticed first is reported only where nothing deeper is found.

    Args:
        supervision: the controller's, to be asked.
        halt: how the stop ended.
        noticed: what the driver noticed.
    """
    reading = halt.reading
    if reading is not None and reading.sample.safety != states.NORMAL:
        return reading.sample.safety, f"{states.safety_advice(reading.safety_bits)}, {RESUME}"
    if reading is not None and reading.mode != states.RUNNING:
        return _not_running(reading)
    with contextlib.suppress(LinkError):
        if supervision.in_remote_control(ASK_S) is False:
            return "it was switched to local mode", f"switch it to remote control, {RESUME}"
    if halt.lost:
        return f"the link is lost: {halt.lost}", CHECK_LINK
    return noticed, f"look at the pendant, {RESUME}"


def program_ended(reading: Reading, late: float) -> str:
    """Return why the robot's program does not play any more, as far as it is known.

    Args:
        reading: without a playing program.
        late: the longest pause in the signs of life to the robot's watchdog, s; 0 for none.
    """
    busy = f"this computer was too busy for {late:.2f} s to show that it lives"
    if late > 1.0 / WATCHDOG_HZ:
        return f"its watchdog stopped it: {busy}"
    word = states.runtime_word(reading.runtime)
    told = f" ({busy})" if late > 0.0 else ""
    return (
        f"its program is {word}: stopped by another program, on the pendant, or by its "
        f"watchdog{told}"
    )


def not_commanded(error: WorkerError) -> str:
    """Return why a command did not get through."""
    if error.lost:
        return f"the process that commands it ended ({error})"
    return f"it did not take a command ({error})"


def _not_running(reading: Reading) -> tuple[str, str]:
    word = states.mode_word(reading.mode)
    return f"it does not run any more ({word})", f"switch it on, {RESUME}"
