"""Protocols of the devices of a run (arm, tracker, force sensor, operator), and cell time.

A driver is a factory `open(config: CellConfig) -> device`, an entry point of the groups below with
the name in the configuration. Opening connects and moves nothing; a device that does not answer
raises `DeviceError` with one clear line, within its deadline.
"""

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from hilcal.config import CellLoad
from hilcal.errors import DeviceError
from hilcal.robot.factory import FactoryKinematics
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class Clock:
    """Cell time, s, for all physical durations (motion, settling, windows).

    Time-outs of communication use `time.monotonic` directly: a wire is as fast in a simulated cell
    as in a real one.
    """

    scale: float = 1.0  # cell seconds per real second; 1 for a real cell

    def now(self) -> float:
        """Return the cell time, s since an arbitrary start."""
        return time.monotonic() * self.scale

    def sleep(self, seconds: float) -> None:
        """Wait; `seconds` are cell seconds."""
        time.sleep(max(0.0, seconds) / self.scale)

    def real(self, seconds: float) -> float:
        """Convert cell seconds to real seconds."""
        return seconds / self.scale


ARMS = "hilcal.arms"
TRACKERS = "hilcal.trackers"
FORCE_SENSORS = "hilcal.force_sensors"
OPERATORS = "hilcal.operators"


class TargetLostError(DeviceError):
    """The tracker does not see its target; worth another try after `TrackerDevice.find_target`."""


class LoadChangedError(DeviceError):
    """The load has changed during a run; worth another try once a person has restored it."""


@dataclass(frozen=True, slots=True)
class Report:
    """Identity, state and problems of a device, read without any motion."""

    device: str  # part of the cell: "arm", "tracker", "force sensor", "operator"
    name: str  # by its maker, with the serial number where known
    facts: tuple[tuple[str, str], ...] = ()
    """(name, text) for people: versions, modes, rates, temperatures."""
    problems: tuple[str, ...] = ()  # to be solved before a run, one clear line each
    fields: tuple[tuple[str, object], ...] = ()
    """(name, value) of the facts for scripts: numbers with their unit in the name."""
    kinematics: FactoryKinematics | None = None
    """kinematics in the arm's controller; None where unknown."""


Row = tuple[str, str, str, object]
"""A fact of a report: name and text for people, name and value for scripts; "" omits a pair."""


def report_of(
    device: str,
    name: str,
    rows: Iterable[Row],
    problems: Iterable[str] = (),
    kinematics: FactoryKinematics | None = None,
) -> Report:
    """Return a report of rows."""
    rows = tuple(rows)
    facts = tuple((fact, text) for fact, text, *_ in rows if fact)
    fields = tuple((key, value) for *_, key, value in rows if key)
    return Report(device, name, facts, tuple(problems), fields, kinematics)


@dataclass(frozen=True, slots=True, eq=False)
class ArmSample:
    """One consistent sample of the arm's state, SI."""

    host_ns: int  # `time.monotonic_ns` at arrival
    timestamp: float  # of the controller's clock, s
    q: Floats  # (n,) actual joint angles, rad
    q_target: Floats  # (n,) commanded joint angles, rad
    qd: Floats  # (n,) actual joint speeds, rad/s
    target_moment: Floats  # (n,) computed by the controller, N·m
    current: Floats  # (n,) actual motor currents, A
    target_current: Floats  # (n,) commanded motor currents, A
    joint_temperature: Floats  # (n,) °C
    tcp_pose: Floats  # (6,) position and rotation vector of the tool point, m and rad
    tcp_force: Floats  # (6,) wrench estimated by the controller, N and N·m
    ft_raw_wrench: Floats | None
    """(6,) raw wrench of a sensor built into the arm; None where unknown."""
    payload: float  # set in the controller, kg
    payload_com: Floats | None  # (3,) its centre of mass, flange axes, m; None where unknown
    speed_scaling: float  # factor that the controller applies to the speed, 0 to 1
    safety: str
    """Safety state in the maker's words, or that its brakes hold it; "normal" if it can move."""
    torque: Floats | None = None
    """(n,) measured torques of the drives, averaged since the previous sample, N·m, positive in the
    direction of larger joint values; None where unknown."""


class ArmDevice(Protocol):
    """An arm that moves in joint space.

    Nothing moves before `take_control`. Any failure of the arm or of its link raises a DeviceError
    that names the cause, after a stop has been commanded.
    """

    def report(self) -> Report:
        """Return identity, versions, state, and all problems; moves nothing."""

    def sample(self) -> ArmSample:
        """Return a sample younger than 0.2 s (real time), or raise DeviceError."""

    def take_control(self, mass: float, com: Floats) -> None:
        """Take control of the arm; set its payload, kg and m (flange axes)."""

    def set_payload(self, mass: float, com: Floats) -> None:
        """Set the payload in the controller, kg and m (flange axes), and verify it."""

    def start_move(self, q: Floats, speed: float, acceleration: float) -> None:
        """Start a straight line in joint space to q (n,) and return at once.

        Speed and acceleration are those of the leading joint, rad/s and rad/s².
        """

    def moving(self) -> bool:
        """Whether the arm is moving; call at least every 0.1 s (real time).

        The arm stops by itself if this is not called for 0.5 s (real time) during a motion.
        DeviceError, with the arm stopped: the motion failed, or the robot cannot move (protective
        stop, emergency stop, program stopped, link lost).
        """

    def stop(self) -> None:
        """Stop the arm by all available ways; DeviceError: it may still move."""

    def close(self) -> None:
        """Stop, release control, end all helpers. Never raises, may be called twice."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackerSample:
    """One measurement of the target; DeviceError for values that no measurement has."""

    host_ns: int  # `time.monotonic_ns` at arrival
    value: Floats  # (m,) position in m and, for m = 6, rotation vector in rad, sensor axes
    covariance: Floats
    """(m, m) of this measurement, from the instrument's specification and its own statements."""
    warning: str = ""  # of the instrument; empty without

    def __post_init__(self) -> None:
        """Refuse numbers that are not finite, and noise without a size."""
        _refuse_invalid("tracker", self.value, self.covariance, (3, 6))
        if np.linalg.eigvalsh(self.covariance)[0] <= 0.0:
            raise DeviceError("tracker: it gives a covariance that is not positive definite")


class TrackerDevice(Protocol):
    """An instrument that measures the position (or pose) of one target."""

    def report(self) -> Report:
        """Return identity, versions, lock state, and every problem at once."""

    def measure(self) -> TrackerSample:
        """Measure once; TargetLostError: no target, beam broken, lock lost, no distance."""

    def find_target(self) -> None:
        """Search and lock the target again; TargetLostError: not found."""

    def close(self) -> None:
        """Release the port. Never raises, may be called twice."""


@runtime_checkable
class PointingTracker(TrackerDevice, Protocol):
    """A tracker that can be aimed at one of several targets."""

    def aim(self, position: Floats, radius: float) -> None:
        """Turn to the expected position (3,) of a target, sensor axes, m; find and lock it.

        A reflector farther away than `radius`, m, is another one; TargetLostError: none found.
        """


@dataclass(frozen=True, slots=True, eq=False)
class WrenchSample:
    """The raw reading of a force sensor, averaged over a window; DeviceError as `TrackerSample`."""

    host_ns: int  # `time.monotonic_ns` at arrival of the last frame
    wrench: Floats  # (6,) mean force and moment, sensor axes, N and N·m; not tared
    covariance: Floats  # (6, 6) of one frame in the window (not of the mean); zero for one frame
    frames: int  # number of frames in the window
    temperature: float | None = None  # of the sensor, °C; None where unknown

    def __post_init__(self) -> None:
        """Refuse numbers that are not finite."""
        _refuse_invalid("force sensor", self.wrench, self.covariance, (6,))


def _refuse_invalid(device: str, value: Floats, covariance: Floats, sizes: tuple[int, ...]) -> None:
    """Refuse a sample of a driver: the one place through which the values of all drivers pass."""
    for name, array, shapes in (
        ("value", value, [(m,) for m in sizes]),
        ("covariance", covariance, [(m, m) for m in sizes if value.shape == (m,)]),
    ):
        if array.shape not in shapes:
            raise DeviceError(
                f"{device}: it gives a {name} of shape {array.shape}; valid: "
                f"{' or '.join(map(str, shapes))}"
            )
        if not np.isfinite(array).all():
            raise DeviceError(f"{device}: it gives a {name} that is not a number")


@dataclass(frozen=True, slots=True)
class Losses:
    """Errors of the line since it was opened."""

    frames: int  # good frames
    lost: int  # frames that did not arrive
    corrupt: int  # frames with a wrong checksum
    skipped: int  # bytes outside of frames


class ForceSensorDevice(Protocol):
    """A six-component wrench sensor that streams."""

    def report(self) -> Report:
        """Return identity, versions, rate, temperature, and every problem at once."""

    def latest(self) -> WrenchSample:
        """Return the newest frame, younger than 0.2 s; DeviceError: the stream is dead or stale."""

    def average(self, seconds: float) -> WrenchSample:
        """Return the mean of the frames of the next real seconds; DeviceError: too few frames."""

    def losses(self) -> Losses:
        """Return the counters."""

    def close(self) -> None:
        """Stop the stream, release the port. Never raises, may be called twice."""


class OperatorDevice(Protocol):
    """The person who hangs the loads."""

    def report(self) -> Report:
        """Return the operator's identity."""

    def hang(self, load: CellLoad | None, why: str) -> None:
        """Ask for a load (None: take everything off) and wait for the person's confirmation.

        `why` is the reason of a repeated request; DeviceError: the person gives up.
        """

    def close(self) -> None:
        """Release the terminal. Never raises, may be called twice."""


@runtime_checkable
class ConfirmingOperator(OperatorDevice, Protocol):
    """An operator who can confirm the arm's next action."""

    def confirm(self, question: str) -> None:
        """Ask about the arm's next action, and wait; DeviceError: the person gives up."""


@runtime_checkable
class TerminalPerson(OperatorDevice, Protocol):
    """An operator who may be asked at the terminal that shows the campaign."""

    at_terminal: bool  # whether it is that terminal; the live display then pauses for the question
