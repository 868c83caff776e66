"""Joint torques that the controller computes from motor currents, read by a child process.

The output `actual_current_as_torque` (PolyScope 5.23, PolyScope X 10.11 and later) has no getter
in the client library. The child receives it on a separate RTDE connection, which commands nothing,
and answers with the mean since the last request. Source: Universal Robots,
"Real-Time Data Exchange (RTDE) Guide", controller output fields.
"""

import contextlib
import struct

import numpy as np

from hilcal.drivers.ur_link import probe
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.worker import Worker, WorkerError, start, words
from hilcal.types import Floats

TORQUE = "actual_current_as_torque"
_LARGEST = 1e5  # N·m; no drive exerts as much
_CONNECT_S, _ANSWER_S = 4.0, 0.3
_STALE_S = 0.8
_MEMORY_S = 1.0
"""Between requests the packets of this last time are kept, s; a choice."""
_PACKET = struct.Struct(">B7d")


class TorqueReader:
    """Mean torques of the drives; None if the link is lost."""

    def __init__(self, host: str, hz: float) -> None:
        """Connect to a controller that has the output; after a failure, `mean` is None."""
        self._arguments = (host, repr(hz))
        self._worker: Worker | None = None
        self.renew()

    @property
    def pids(self) -> tuple[int, ...]:
        """Number of the child process, if there is one."""
        return () if self._worker is None else (self._worker.pid,)

    def renew(self) -> None:
        """Connect again if the link is lost."""
        if self._worker is None:
            with contextlib.suppress(WorkerError):
                self._worker = Worker(
                    "hilcal.drivers.ur_link.torque_reader", self._arguments, _CONNECT_S
                )

    def mean(self) -> Floats | None:
        """(6,) mean torque of each drive since the last call, N·m; of the last second at most.

        Positive in the direction in which the joint's angle grows, as the drive pushes.
        """
        if self._worker is None:
            return None
        try:
            torque = np.asarray(self._worker.call("mean", _ANSWER_S)["torque"], dtype=np.float64)
        except WorkerError:
            self.close()
            return None
        if torque.shape != (6,) or not (np.abs(torque) <= _LARGEST).all():
            self.close()
            return None
        return torque

    def close(self) -> None:
        """End the process; may be called twice."""
        if self._worker is not None:
            self._worker.kill()
            self._worker = None


def main() -> None:
    """Connect, report it, then answer requests until parent or controller ends the line."""
    line, (host, hz) = start()
    names = ("timestamp", TORQUE)
    try:
        stream = probe.stream(host, float(hz), names, _CONNECT_S)
    except LinkError as error:
        line.answer(0, error=words(error))
        return
    line.answer(0)
    last, recent = -1.0, list[tuple[float, ...]]()
    pending: int | None = None
    with contextlib.suppress(LinkError, struct.error):  # the parent notices the end of the line
        while True:
            stream.extend(_STALE_S)
            _, stamp, *torque = _PACKET.unpack(probe.packet(stream))
            if stamp != last:
                last = stamp
                recent.append(tuple(torque))
                del recent[: -round(_MEMORY_S * float(hz))]
            request = line.next(0.0) if pending is None else None
            pending = request["number"] if request is not None else pending
            if pending is not None and recent:
                mean = [sum(values) / len(recent) for values in zip(*recent, strict=True)]
                line.answer(pending, torque=mean)
                pending = None
                recent.clear()


if __name__ == "__main__":
    main()
