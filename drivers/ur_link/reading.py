"""The state of the arm: packets from the receive worker, each checked."""

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilcal.drivers.ur_link import probe, states
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.receive_worker import GETTERS
from hilcal.drivers.ur_link.worker import Worker, WorkerError
from hilcal.measuring.devices import ArmSample
from hilcal.types import Floats

N = 6
"""Joints of every arm of this maker."""

OUTPUTS = tuple(GETTERS)
"""The outputs of the client library that are recorded."""

OPTIONAL = frozenset({"target_speed_fraction", "payload", "payload_cog", "ft_raw_wrench"})
"""Outputs that older controllers lack (payload and payload_cog come with 5.5.1, ft_raw_wrench
with 5.9)."""


LARGEST = {
    "timestamp": 1e10,
    "actual_q": 100.0,
    "target_q": 100.0,
    "actual_qd": 100.0,
    "target_moment": 1e5,
    "actual_current": 1e4,
    "target_current": 1e4,
    "joint_temperatures": 200.0,
    "actual_TCP_pose": 100.0,
    "actual_TCP_force": 1e5,
    "ft_raw_wrench": 1e5,
    "payload": 1e3,
    "payload_cog": 100.0,
    "speed_scaling": 10.0,
    "target_speed_fraction": 10.0,
}
"""Magnitudes beyond which a field cannot be what an arm of this maker measures (s, rad, rad/s, N·m,
A, °C, m, N, kg); choices, ten times and more beyond the largest of them. A packet that a fault on
the way has changed is as a rule far outside."""

STALE_S = 0.2
"""In a motion, the link is lost when the controller's timestamp stands for so long, real s."""
PATIENCE_S = 0.8
"""At rest, new data are waited for so long, real s."""
_ANSWER_S = 0.3


class ReadingError(Exception):
    """The packet cannot be what the controller sent."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The sample for the run, and what the driver itself looks at."""

    sample: ArmSample  # the arm's state
    mode: int  # robot mode, 7 is running
    runtime: int  # state of the robot's program, 2 is playing
    safety_bits: int  # the safety state as bits


def read(answer: dict[str, Any]) -> Reading:
    """Return the reading in the answer of the receive worker.

    Raises:
        ReadingError: a field has a wrong length, is not finite, or larger than can be.
    """
    fields, host_ns = answer["fields"], int(answer["host_ns"])

    def number(name: str) -> float:
        value = float(fields[name])
        if not math.isfinite(value) or abs(value) > LARGEST[name]:
            raise ReadingError(f"{name} is {value}")
        return value

    def vector(name: str, n: int) -> Floats:
        value = np.asarray(fields[name], dtype=np.float64)
        if value.shape != (n,) or not (np.abs(value) <= LARGEST[name]).all():
            raise ReadingError(f"{name} is {fields[name]}")
        return value

    bits = int(fields["safety_status_bits"])
    scaling = number("speed_scaling")
    if "target_speed_fraction" in fields:  # the slider; the two multiply
        scaling *= number("target_speed_fraction")
    sample = ArmSample(
        host_ns=host_ns,
        timestamp=number("timestamp"),
        q=vector("actual_q", N),
        q_target=vector("target_q", N),
        qd=vector("actual_qd", N),
        target_moment=vector("target_moment", N),
        current=vector("actual_current", N),
        target_current=vector("target_current", N),
        joint_temperature=vector("joint_temperatures", N),
        tcp_pose=vector("actual_TCP_pose", 6),
        tcp_force=vector("actual_TCP_force", 6),
        ft_raw_wrench=vector("ft_raw_wrench", 6) if "ft_raw_wrench" in fields else None,
        payload=number("payload") if "payload" in fields else math.nan,
        payload_com=vector("payload_cog", 3) if "payload_cog" in fields else None,
        speed_scaling=scaling,
        safety=states.safety_word(bits),
    )
    return Reading(sample, int(fields["robot_mode"]), int(fields["runtime_state"]), bits)


class Receiver:
    """Reads the arm's state; each reading is newer than the call for it."""

    def __init__(self, host: str, hz: float, outputs: tuple[str, ...], seconds: float) -> None:
        """Connect within a deadline; each call raises LinkError where no new data come."""
        self._host = host
        self._arguments = (host, repr(hz), ",".join(outputs))
        self._worker = self._start(seconds)

    @property
    def pid(self) -> int:
        """Number of the worker's process."""
        return self._worker.pid

    def read(self, stale: float = PATIENCE_S) -> Reading:
        """Return the next packet, which is newer than the call, within `stale` real s."""
        try:
            return read(self._worker.call("sample", stale + _ANSWER_S, stale=stale))
        except WorkerError as error:
            how = "the process that receives over RTDE: " if error.lost else ""
            raise LinkError(f"{how}{error}") from None
        except ReadingError as error:
            raise LinkError(f"the RTDE data are damaged: {error}") from None

    def rate(self, seconds: float) -> float:
        """Return the packets per second over a while."""
        try:
            deadline = seconds + PATIENCE_S + _ANSWER_S
            answer = self._worker.call("rate", deadline, window=seconds, stale=PATIENCE_S)
            return float(answer["rate"])
        except WorkerError as error:
            raise LinkError(str(error)) from None

    def renew(self, seconds: float) -> None:
        """Connect again, in a new process."""
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
