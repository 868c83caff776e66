"""The state of the arm, from the receive worker."""

import time

from hilcal.drivers.ur_link import probe
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.reading import Reading, ReadingError, read
from hilcal.drivers.ur_link.worker import Worker, WorkerError

STALE_S = 0.2
"""In a motion, the link is lost when the controller's timestamp stands for so long, real s."""
PATIENCE_S = 0.8
"""At rest, new data are waited for so long, real s."""
_ANSWER_S = 0.3


class Receiver:
    """Reads the arm's state; each reading is newer than the call for it."""

    def __init__(self, host: str, hz: float, outputs: tuple[str, ...], seconds: float) -> None:
        """Connect within a deadline.

        Raises:
            LinkError: the controller does not answer or sends no data.
        """
        self._host = host
        self._arguments = (host, repr(hz), ",".join(outputs))
        self._worker = self._start(seconds)

    @property
    def pid(self) -> int:
        """Number of the worker's process."""
        return self._worker.pid

    def read(self, stale: float = PATIENCE_S) -> Reading:
        """Return the next packet, which is newer than the call.

        Args:
            stale: within so long, real s.

        Raises:
            LinkError: no new data.
        """
        try:
            return read(self._worker.call("sample", stale + _ANSWER_S, stale=stale))
        except WorkerError as error:
            how = "the process that receives over RTDE: " if error.lost else ""
            raise LinkError(f"{how}{error}") from None
        except ReadingError as error:
            raise LinkError(f"the RTDE data are damaged: {error}") from None

    def rate(self, seconds: float) -> float:
        """Return the packets per second over a while.

        Raises:
            LinkError: no new data.
        """
        try:
            deadline = seconds + PATIENCE_S + _ANSWER_S
            answer = self._worker.call("rate", deadline, window=seconds, stale=PATIENCE_S)
            return float(answer["rate"])
        except WorkerError as error:
            raise LinkError(str(error)) from None

    def renew(self, seconds: float) -> None:
        """Connect again, in a new process.

        Raises:
            LinkError: the controller does not answer or sends no data.
        """
        begun = time.monotonic()
        self._worker.kill()
        # It shows much earlier than the library does that no data come.
        probe.check_stream(self._host, min(seconds, 0.25))
        self._worker = self._start(seconds - (time.monotonic() - begun))

    def close(self) -> None:
        """End the process; may be called twice."""
        self._worker.kill()

    def _start(self, seconds: float) -> Worker:
        try:
            return Worker("hilcal.drivers.ur_link.receive_worker", self._arguments, seconds)
        except WorkerError as error:
            raise LinkError(f"no data over RTDE: {error}") from None
