"""Protocols of the devices of a run (arm, tracker, force sensor, operator), and cell time.

A driver is a factory `open(config: CellConfig) -> device`, found by the name that the
configuration gives, as an entry point of the groups below. Opening connects and moves nothing;
a device that does not answer raises `DeviceError` with one clear line, within its deadline.
"""

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from hilcal.config import CellLoad
from hilcal.errors import DeviceError
from hilcal.robot.factory import FactoryKinematics
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class Clock:
    """Cell time in s; every duration of physics (motion, settling, windows) is measured in it.

    Time-outs of communication are not: a wire is as fast in a simulated cell as in a real one,
    so those use `time.monotonic` directly.
    """

    scale: float = 1.0  # cell seconds per real second; 1 for a real cell

    def now(self) -> float:
        """Return the cell time, s since an arbitrary start."""
        return time.monotonic() * self.scale

    def sleep(self, seconds: float) -> None:
        """Wait for so many cell seconds."""
        time.sleep(max(0.0, seconds) / self.scale)

    def real(self, seconds: float) -> float:
        """Return how many real seconds so many cell seconds take."""
        return seconds / self.scale


ARMS = "hilcal.arms"
TRACKERS = "hilcal.trackers"
FORCE_SENSORS = "hilcal.force_sensors"
OPERATORS = "hilcal.operators"


class TargetLostError(DeviceError):
    """The tracker does not see its target; worth another try after `TrackerDevice.find_target`."""


class WrongLoadError(DeviceError):
    """What hangs is not what was asked for."""


class LoadChangedError(DeviceError):
    """What hangs is no longer what should hang; worth another try once a person has mended it."""


@dataclass(frozen=True, slots=True)
class Report:
    """Identity, state and problems of a device, read without any motion."""

    device: str  # its part in the cell: "arm", "tracker", "force sensor", "operator"
    name: str  # the maker's name for it, with its serial number where known
    facts: tuple[tuple[str, str], ...] = ()
    """(what, value) for people: versions, modes, rates, temperatures."""
    problems: tuple[str, ...] = ()  # what has to be put right before a run, one clear line each
    fields: tuple[tuple[str, object], ...] = ()
    """(name, value) of the facts for scripts: numbers with their unit in the name."""
    kinematics: FactoryKinematics | None = None
    """of an arm, by which its controller computes poses; None where it does not tell."""


Row = tuple[str, str, str, object]
"""Of a report: what and how it is, for people; its name and value for scripts; "": not for them."""


def report_of(
    device: str,
    name: str,
    rows: Iterable[Row],
    problems: Iterable[str] = (),
    kinematics: FactoryKinematics | None = None,
) -> Report:
    """Return a report of rows."""
    rows = tuple(rows)
    facts = tuple((what, text) for what, text, *_ in rows if what)
    fields = tuple((key, value) for *_, key, value in rows if key)
    return Report(device, name, facts, tuple(problems), fields, kinematics)


@dataclass(frozen=True, slots=True, eq=False)
class ArmSample:
    """One consistent sample of the arm's state, SI."""

    host_ns: int  # `time.monotonic_ns` right after the sample came
    timestamp: float  # the controller's own clock, s
    q: Floats  # (n,) actual joint angles, rad
    q_target: Floats  # (n,) commanded joint angles, rad
    qd: Floats  # (n,) actual joint speeds, rad/s
    target_moment: Floats  # (n,) torques that the controller computes, N·m
    current: Floats  # (n,) actual motor currents, A
    target_current: Floats  # (n,) commanded motor currents, A
    joint_temperature: Floats  # (n,) °C
    tcp_pose: Floats  # (6,) position and rotation vector of the tool point, m and rad
    tcp_force: Floats  # (6,) wrench as the controller estimates it, N and N·m
    ft_raw_wrench: Floats | None
    """(6,) raw wrench of a sensor built into the arm; None where unknown."""
    payload: float  # payload that is set in the controller, kg
    payload_com: Floats | None  # (3,) its centre of mass, flange axes, m; None where unknown
    speed_scaling: float  # factor that the controller applies to the speed, 0 to 1
    safety: str  # the safety state in the maker's words, "normal" where all is well
    torque: Floats | None = None
    """(n,) mean torques that the drives were measured to exert since the sample before, N·m,
    positive in the direction in which the joint's value grows; None where unknown."""


class ArmDevice(Protocol):
    """An arm that moves in joint space.

    Without `take_control` nothing can move. Any failure of the arm or of its link raises
    DeviceError that names the cause, after a stop has been commanded.
    """

    def report(self) -> Report:
        """Return identity, versions, state, and every problem at once; moves nothing."""

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
        """Whether the motion is still going on; call at least every 0.1 s (real time).

        If nobody calls for 0.5 s (real time) while the arm moves, the arm stops by itself.
        DeviceError, the arm stopped: the motion failed, or the robot is not in a state to move
        (protective stop, emergency stop, program stopped, link lost).
        """

    def stop(self) -> None:
        """Stop the arm by every way there is; DeviceError: not sure that it stands."""

    def close(self) -> None:
        """Stop, give control back, end all helpers. Never raises, may be called twice."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackerSample:
    """One measurement of the target."""

    host_ns: int  # `time.monotonic_ns` right after it came
    value: Floats  # (m,) position in m and, for m = 6, rotation vector in rad, sensor axes
    covariance: Floats
    """(m, m) of this one measurement, from the instrument's specification and what it says of
    itself."""
    warning: str = ""  # what the instrument remarked, empty where nothing


class TrackerDevice(Protocol):
    """An instrument that measures the position (or pose) of one target."""

    def report(self) -> Report:
        """Say who answered, versions, lock state, and every problem at once."""

    def measure(self) -> TrackerSample:
        """Measure once; TargetLostError: no target, beam broken, lock lost, no distance."""

    def find_target(self) -> None:
        """Search and lock the target again; TargetLostError: not found."""

    def close(self) -> None:
        """Give the port back. Never raises, may be called twice."""


@runtime_checkable
class PointingTracker(TrackerDevice, Protocol):
    """A tracker that can be told which of several targets to measure."""

    def aim(self, position: Floats, radius: float) -> None:
        """Turn to where a target is expected (3,), sensor axes, m; find and lock it.

        One farther than `radius` from there is another one; TargetLostError: there is none.
        """


@dataclass(frozen=True, slots=True, eq=False)
class WrenchSample:
    """The raw reading of a force sensor, averaged over a window."""

    host_ns: int  # `time.monotonic_ns` right after the last frame came
    wrench: Floats  # (6,) mean force and moment, sensor axes, N and N·m; the sensor's own zero
    covariance: Floats  # (6, 6) of one frame in the window (not of the mean); zero for one frame
    frames: int  # number of frames in the window
    temperature: float | None = None  # of the sensor, °C; None where it does not tell


@dataclass(frozen=True, slots=True)
class Losses:
    """What went wrong on the line since it was opened."""

    frames: int  # good frames
    lost: int  # frames that should have come and did not
    corrupt: int  # frames whose checksum was wrong
    skipped: int  # bytes that belonged to no frame


class ForceSensorDevice(Protocol):
    """A six-component wrench sensor that streams."""

    def report(self) -> Report:
        """Say who answered, versions, rate, temperature, and every problem at once."""

    def latest(self) -> WrenchSample:
        """Return the newest frame, younger than 0.2 s; DeviceError: the stream is dead or stale."""

    def average(self, seconds: float) -> WrenchSample:
        """Return the mean of the frames of the next so many real seconds; DeviceError: too few."""

    def losses(self) -> Losses:
        """Return the counters."""

    def close(self) -> None:
        """Stop the stream, give the port back. Never raises, may be called twice."""


class OperatorDevice(Protocol):
    """The person who hangs the loads."""

    def report(self) -> Report:
        """Say who is asked."""

    def hang(self, load: CellLoad | None, why: str) -> None:
        """Ask for a load (None: take everything off) and wait until it is said to be done.

        `why` tells why it is asked for again; DeviceError: the person gives up.
        """

    def close(self) -> None:
        """Give the terminal back. Never raises, may be called twice."""


@runtime_checkable
class ConfirmingOperator(OperatorDevice, Protocol):
    """An operator who can be asked whether the arm may go on."""

    def confirm(self, question: str) -> None:
        """Ask about what the arm does next, and wait; DeviceError: the person gives up."""


@runtime_checkable
class TerminalPerson(OperatorDevice, Protocol):
    """An operator who is asked at the terminal on which the campaign is shown."""

    at_terminal: bool  # whether that is so now; the live display gives way to the question then
