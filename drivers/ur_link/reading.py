"""One packet of the controller's state, checked."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilcal.drivers.ur_link import states
from hilcal.drivers.ur_link.receive_worker import GETTERS
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


class ReadingError(Exception):
    """The packet cannot be what the controller sent."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The sample for the run, and what the driver itself looks at.

    Attributes:
        sample: the arm's state.
        mode: robot mode, 7 is running.
        runtime: state of the robot's program, 2 is playing.
        safety_bits: the safety state as bits.
    """

    sample: ArmSample
    mode: int
    runtime: int
    safety_bits: int


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
