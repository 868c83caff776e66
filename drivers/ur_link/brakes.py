"""Bringing the arm to a stand, in every way there is, and making sure of it."""

import contextlib
import time
from dataclasses import dataclass, replace

from hilcal.drivers.ur_link import script_port, states
from hilcal.drivers.ur_link.control import Control
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.motion import stands
from hilcal.drivers.ur_link.reading import Reading
from hilcal.drivers.ur_link.receiver import STALE_S, Receiver
from hilcal.drivers.ur_link.supervision import Generation
from hilcal.drivers.ur_link.worker import WorkerError

ASK_S = 0.25
"""Deadline of each way to stop, real s."""
_GENTLE_S = 0.6
_SURE_S = 1.0
_AGAIN_S = 0.3
_RENEW_S = 1.5


@dataclass(frozen=True, slots=True)
class Halt:
    """How a stop ended.

    Attributes:
        reading: after the stop; None where the arm's state cannot be read.
        stands: whether it is sure that the arm stands.
        lost: why the state could not be read before it was connected to anew; else empty.
    """

    reading: Reading | None
    stands: bool
    lost: str


@dataclass(frozen=True, slots=True)
class Brakes:
    """The ways to stop one arm.

    Attributes:
        host: address of the controller.
        receiver: for seeing that it stands.
        generation: how it is supervised, and where programs go.
    """

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

        Args:
            control: ends with this; None where there is none.
            brake: deceleration of the leading joint, rad/s².
            lost: why the link is lost, if it is known to be.
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
        with contextlib.suppress(LinkError):
            script_port.stop(self.host, brake, ASK_S, self.generation.script_port)

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
