"""What the controller's parts share: modes, registers, and the state of the arm."""

import time
from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag

import numpy as np

from drivers.simulated.blackboard import Blackboard
from drivers.simulated.ur.frames import REGISTERS
from drivers.simulated.ur.kinematics import Kinematics
from drivers.simulated.ur.motion import Trajectory
from hilcal.types import Floats


class RobotMode(IntEnum):
    """RTDE `robot_mode`."""

    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class Runtime(IntEnum):
    """RTDE `runtime_state`."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class Safety(IntFlag):
    """RTDE `safety_status_bits`."""

    NORMAL = 1 << 0
    PROTECTIVE_STOP = 1 << 2
    ROBOT_EMERGENCY_STOP = 1 << 6
    EMERGENCY_STOP = 1 << 7
    STOPPED = 1 << 10


class SafetyMode(IntEnum):
    """RTDE `safety_mode` and `safety_status`, and the dashboard's words for them."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


class WorldClock:
    """World time since this controller was switched on, and back to real time."""

    def __init__(self, board: Blackboard) -> None:
        """Start at 0."""
        self._start_ns = time.monotonic_ns()
        self._scale = board.scale

    @property
    def now(self) -> float:
        """World time, s."""
        return (time.monotonic_ns() - self._start_ns) * 1e-9 * self._scale

    def real_ns(self, now: float) -> int:
        """Return `time.monotonic_ns` at a world time."""
        return self._start_ns + round(now / self._scale * 1e9)

    def real(self, seconds: float) -> float:
        """Return how many real seconds so many world seconds take."""
        return seconds / self._scale


@dataclass(slots=True)
class Registers:
    """General-purpose registers; `inputs` are written by RTDE clients, `outputs` by scripts."""

    in_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    in_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    out_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    out_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    written_ns: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    """When each of `in_int` last came, `time.monotonic_ns`."""


@dataclass(slots=True, eq=False)
class ArmState:
    """State of controller and arm.

    Attributes:
        clock: world time.
        kinematics: of the nominal arm.
        trajectory: where the commanded arm is.
        version: of PolyScope.
        registers: the general-purpose ones.
        payload: what the controller has been told, kg.
        payload_com: (3,) flange axes, m.
        tcp: (6,) of the tool point on the flange, m and rad.
        robot_mode: power.
        runtime: of the program.
        safety_mode: what the safety system says.
        remote: whether it takes orders from the network.
        scaling: further factor on the speed, as the controller applies it by itself.
        slider: the speed slider.
        digital_outputs: RTDE `actual_digital_output_bits`.
        refuses_motion: whether a motion that is commanded ends the program instead.
        frozen_q: (n,) what the encoders tell in spite of any motion, rad; None is the truth.
        fault_ns: `time.monotonic_ns` of the last fault that was switched on.
        input_ns: the same of the last input package.
        log: (monotonic_ns, what happened).
    """

    clock: WorldClock
    kinematics: Kinematics
    trajectory: Trajectory
    version: tuple[int, int, int, int]
    registers: Registers = field(default_factory=Registers)
    payload: float = 0.0
    payload_com: Floats = field(default_factory=lambda: np.zeros(3))
    tcp: Floats = field(default_factory=lambda: np.zeros(6))
    robot_mode: RobotMode = RobotMode.RUNNING
    runtime: Runtime = Runtime.STOPPED
    safety_mode: SafetyMode = SafetyMode.NORMAL
    remote: bool = True
    scaling: float = 1.0
    slider: float = 1.0
    digital_outputs: int = 0
    refuses_motion: bool = False
    frozen_q: Floats | None = None
    fault_ns: int = 0
    input_ns: int = 0
    log: deque[tuple[int, str]] = field(default_factory=lambda: deque(maxlen=2000))

    @property
    def safety_bits(self) -> Safety:
        """RTDE `safety_status_bits`."""
        match self.safety_mode:
            case SafetyMode.PROTECTIVE_STOP:
                return Safety.PROTECTIVE_STOP | Safety.STOPPED
            case SafetyMode.ROBOT_EMERGENCY_STOP:
                return Safety.ROBOT_EMERGENCY_STOP | Safety.EMERGENCY_STOP | Safety.STOPPED
            case _:
                return Safety.NORMAL

    @property
    def able(self) -> bool:
        """Whether power and safety allow a program to run."""
        return self.robot_mode is RobotMode.RUNNING and self.safety_mode is SafetyMode.NORMAL

    def note(self, what: str) -> None:
        """Remember what happened."""
        self.log.append((time.monotonic_ns(), what))
