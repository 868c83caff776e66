"""The joint torques that the controller makes of its motor currents, from a child process.

The output `actual_current_as_torque` (PolyScope 5.23, PolyScope X 10.11 and later) is none of the
client library's getters. The child receives it on an RTDE connection of its own, which commands
nothing, and answers with the mean of what came since it was asked last. Source: Universal Robots,
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
"""Packets older than the last ones of so long are forgotten while nobody asks; a choice."""
_PACKET = struct.Struct(">B7d")


class TorqueReader:
    """Means of the torques that the drives exert; None where nobody tells them any more."""

    def __init__(self, host: str, hz: float) -> None:
        """Connect to a controller that has the output; a failure shows as no torques."""
        self._arguments = (host, repr(hz))
        self._worker: Worker | None = None
        self.renew()

    @property
    def pids(self) -> tuple[int, ...]:
        """Number of the child process, if there is one."""
        return () if self._worker is None else (self._worker.pid,)

    def renew(self) -> None:
        """Connect again where the link is lost."""
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
    """Connect, say so, then answer requests until the parent or the controller ends the line."""
    line, (host, hz) = start()
    names = ("timestamp", TORQUE)
    try:
        stream = probe.stream(host, float(hz), names, _CONNECT_S)
    except LinkError as error:
        line.answer(0, error=words(error))
        return
    line.answer(0)
    last, recent = -1.0, list[tuple[float, ...]]()
    asked: int | None = None
    with contextlib.suppress(LinkError, struct.error):  # the parent sees that the line ends
        while True:
            stream.extend(_STALE_S)
            _, stamp, *torque = _PACKET.unpack(probe.packet(stream))
            if stamp != last:
                last = stamp
                recent.append(tuple(torque))
                del recent[: -round(_MEMORY_S * float(hz))]
            request = line.next(0.0) if asked is None else None
            asked = request["number"] if request is not None else asked
            if asked is not None and recent:
                mean = [sum(each) / len(recent) for each in zip(*recent, strict=True)]
                line.answer(asked, torque=mean)
                asked = None
                recent.clear()


if __name__ == "__main__":
    main()
