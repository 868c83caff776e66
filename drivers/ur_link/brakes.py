"""Bringing the arm to a stand in every way there is, making sure of it, and why it was needed.

The third way is a program on the port that takes URScript: one that arrives there replaces the one
that runs. Source: Universal Robots, "Remote Control via TCP/IP", port 30003; the primary port,
30001, takes the same and is the one that PolyScope X opens.
"""

import contextlib
import time
from dataclasses import dataclass, replace

from hilcal.drivers.ur_link import states
from hilcal.drivers.ur_link.control import Control
from hilcal.drivers.ur_link.control_worker import WATCHDOG_HZ
from hilcal.drivers.ur_link.lines import Connection, LinkError
from hilcal.drivers.ur_link.motion import stands
from hilcal.drivers.ur_link.reading import STALE_S, Reading, Receiver
from hilcal.drivers.ur_link.states import CHECK_LINK, RESUME
from hilcal.drivers.ur_link.supervision import Generation, Supervision
from hilcal.drivers.ur_link.worker import WorkerError

ASK_S = 0.25
"""Deadline of each way to stop, real s."""
_GENTLE_S = 0.6
_SURE_S = 1.0
_AGAIN_S = 0.3
_RENEW_S = 1.5
_TAKEN_S = 0.05
"""Time before the connection is closed: a program is lost where its sender has gone before it was
taken; a choice."""
UNWATCHED = "nobody watched its motion for 0.5 s, so it was stopped"


@dataclass(frozen=True, slots=True)
class Halt:
    """How a stop ended."""

    reading: Reading | None  # after the stop; None where the arm's state cannot be read
    stands: bool
    lost: str  # why the state could not be read before it was connected to anew; else empty


@dataclass(frozen=True, slots=True)
class Brakes:
    """The ways to stop one arm."""

    host: str
    receiver: Receiver
    generation: Generation

    def ease(self, control: Control, brake: float) -> bool:
        """Stop through the control worker and keep control; whether the arm stands."""
        with contextlib.suppress(WorkerError, LinkError):
            control.stop(brake, 0.3)
            reading = self._until_still(_GENTLE_S, program=False)
            if reading is not None and reading.runtime == states.PLAYING:
                control.rest()
                return True
        return False

    def halt(self, control: Control | None, brake: float, lost: str = "") -> Halt:
        """Stop in every way, which ends control; never raises.

        `brake` is the deceleration of the leading joint, rad/s²; `lost` why the link is lost, if it
        is known to be.
        """
        if control is not None:
            try:
                if not lost:
                    control.stop(brake, 0.1)
            except WorkerError:
                pass
            finally:
                control.kill()  # and the robot's watchdog stops it, whatever else fails
        if not self._by_order():
            self._by_script(brake)
        try:
            if not lost:
                return self._watch(brake)
        except LinkError as error:
            lost = str(error)
        try:
            self.receiver.renew(_RENEW_S)
            return replace(self._watch(brake), lost=lost)
        except LinkError:
            return Halt(None, False, lost)

    def _watch(self, brake: float) -> Halt:
        """Wait until the arm stands; command the stop once more if it does not."""
        reading = self._until_still(_AGAIN_S, program=True)
        if reading is None:
            self._by_script(brake)
            reading = self._until_still(_SURE_S - _AGAIN_S, program=True)
        return Halt(reading or self.receiver.read(STALE_S), reading is not None, "")

    def _by_order(self) -> bool:
        with contextlib.suppress(LinkError):
            self.generation.supervision.stop(ASK_S)
            return True
        return False

    def _by_script(self, brake: float) -> None:
        """Send a program that brakes the arm along its path, rad/s² of the leading joint."""
        program = f"def stop_arm():\n  stopj({brake:.3f})\nend\n"
        with (
            contextlib.suppress(LinkError),
            Connection(self.host, self.generation.script_port, "script port", ASK_S) as line,
        ):
            line.send(program.encode())
            time.sleep(_TAKEN_S)

    def _until_still(self, seconds: float, *, program: bool) -> Reading | None:
        """Return the second of two readings at rest in a row; None if there is none in time.

        With `program`, nothing may be running either that could move the arm again.
        """
        end, still = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            reading = self.receiver.read(STALE_S)
            ended = reading.runtime not in (states.PLAYING, states.RESUMING)
            safe = not program or ended or reading.sample.safety != states.NORMAL
            still = still + 1 if stands(reading) and safe else 0
            if still == 2:
                return reading
        return None


def cause_of(supervision: Supervision, halt: Halt, noticed: str) -> tuple[str, str]:
    """Return what happened and what to do about it, after the arm has been stopped.

    A safety stop ends the program, and a lost link the process that commands the arm: what was
    noticed first is reported only where nothing deeper is found.
    """
    reading = halt.reading
    if reading is not None and reading.sample.safety != states.NORMAL:
        return reading.sample.safety, f"{states.safety_advice(reading.safety_bits)}, {RESUME}"
    if reading is not None and reading.mode != states.RUNNING:
        word = states.mode_word(reading.mode)
        return f"it does not run any more ({word})", f"switch it on, {RESUME}"
    with contextlib.suppress(LinkError):
        if supervision.in_remote_control(ASK_S) is False:
            return "it was switched to local mode", f"switch it to remote control, {RESUME}"
    if halt.lost:
        return f"the link is lost: {halt.lost}", CHECK_LINK
    return noticed, f"look at the pendant, {RESUME}"


def program_ended(reading: Reading, late: float) -> str:
    """Return why the robot's program does not play any more, as far as it is known.

    `late` is the longest pause in the signs of life to the robot's watchdog, s; 0 for none.
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
