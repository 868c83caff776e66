"""State, kinematics and torques of the arm, each from a checked source; the survey of all.

The kinematics come from the controller's primary port. A package there has a size (i32, header
included), a type (u8) and a body. The body of type 16, a robot state, is a sequence of parts of the
same form. Part 5, the kinematics, has checksums (6 u32), theta, a, d and alpha of the classic
Denavit-Hartenberg rows (6 f64 each), and the status of the calibration (u32). The controller sends
it to each client that connects. All is big-endian. Source: Universal Robots, "Remote Control via
TCP/IP", and `KinematicsInfo` of the Universal Robots Client Library.
"""

import contextlib
import math
import re
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilcal.drivers.ur_link import probe, states
from hilcal.drivers.ur_link.children import OUTPUTS as OUTPUTS
from hilcal.drivers.ur_link.children import TORQUE as TORQUE
from hilcal.drivers.ur_link.probe import Connection, LinkError
from hilcal.drivers.ur_link.supervision import PRIMARY_PORT, UrController
from hilcal.drivers.ur_link.worker import Worker, WorkerError
from hilcal.errors import InputError
from hilcal.measuring.devices import ArmSample, Report, Row, report_of
from hilcal.robot.factory import FactoryKinematics, of_rows
from hilcal.types import Floats

_PRIMARY = f"the primary port ({PRIMARY_PORT})"
_HEAD = struct.Struct(">iB")
_KINEMATICS = struct.Struct(">6I24dI")
_STATE, _PART = 16, 5
_LONGEST = 1 << 20
_PACKAGES = 50  # packages read: the state comes ten times a second, among messages


def read_kinematics(host: str, seconds: float) -> FactoryKinematics:
    """Return the kinematics of the controller's arm."""
    with Connection(host, PRIMARY_PORT, "primary port", seconds) as line:
        for _ in range(_PACKAGES):
            size, kind = _HEAD.unpack(line.read(_HEAD.size))
            if not _HEAD.size <= size <= _LONGEST:
                raise LinkError(f"{_PRIMARY} does not answer as a controller does")
            body = line.read(size - _HEAD.size)
            part = _kinematics_part(body) if kind == _STATE else None
            if part is None:
                continue
            values = _KINEMATICS.unpack_from(part)
            rows = np.array(values[6:30]).reshape(4, 6)
            try:
                return of_rows(rows, "the controller", values[30], tuple(values[:6]))
            except InputError as error:
                raise LinkError(f"{_PRIMARY}: {error}") from None
    raise LinkError(f"{_PRIMARY} does not send the arm's kinematics")


def _kinematics_part(body: bytes) -> bytes | None:
    at = 0
    while at + _HEAD.size <= len(body):
        size, kind = _HEAD.unpack_from(body, at)
        if size < _HEAD.size or at + size > len(body):
            break
        if kind == _PART and size >= _HEAD.size + _KINEMATICS.size:
            return body[at + _HEAD.size : at + size]
        at += size
    return None


N = 6  # joints of every arm of this maker

OPTIONAL = frozenset({"target_speed_fraction", "payload", "payload_cog", "ft_raw_wrench"})
"""Outputs that older controllers lack: payload and payload_cog before 5.5.1, ft_raw_wrench before
5.9."""


FIELDS = {
    "timestamp": ("timestamp", 0, 1e10),
    "q": ("actual_q", N, 100.0),
    "q_target": ("target_q", N, 100.0),
    "qd": ("actual_qd", N, 100.0),
    "target_moment": ("target_moment", N, 1e5),
    "current": ("actual_current", N, 1e4),
    "target_current": ("target_current", N, 1e4),
    "joint_temperature": ("joint_temperatures", N, 200.0),
    "tcp_pose": ("actual_TCP_pose", 6, 100.0),
    "tcp_force": ("actual_TCP_force", 6, 1e5),
    "ft_raw_wrench": ("ft_raw_wrench", 6, 1e5),
    "payload": ("payload", 0, 1e3),
    "payload_com": ("payload_cog", 3, 100.0),
    "speed_scaling": ("speed_scaling", 0, 10.0),
}
"""For each field of a sample: its output, its length (0: a scalar), and the largest magnitude that
is possible (s, rad, rad/s, N·m, A, °C, m, N, kg). The limits are choices, ten times and more beyond
the largest arm; a packet damaged on the way is as a rule far outside."""

STALE_S = 0.2
"""Age of the controller's timestamp at which the link counts as lost in a motion, real s."""
PATIENCE_S = 0.8  # longest wait for new data at rest, real s
_CONNECT_S, _ANSWER_S = 4.0, 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """The sample for the run, and the states that the driver checks."""

    sample: ArmSample  # the arm's state
    mode: int  # robot mode, 7 is running
    runtime: int  # state of the robot's program, 2 is playing
    safety_bits: int  # the safety state as bits

    @property
    def advice(self) -> str:
        """What to do about the safety state or the mode; empty if the arm can move."""
        return states.safety_advice(self.safety_bits, self.mode)


def read(answer: dict[str, Any], reduced: bool = False) -> Reading:
    """Return the reading in an answer of the receive worker; raises LinkError.

    `reduced`: the reduced mode is normal.
    """
    fields = answer["fields"]

    def checked(name: str, count: int, largest: float) -> Any:
        value = np.asarray(fields[name], dtype=np.float64)
        if value.shape != (count,) * (count > 0) or not (np.abs(value) <= largest).all():
            raise LinkError(f"the RTDE data are damaged: {name} is {fields[name]}")
        return value if count else float(value)

    values: dict[str, Any] = {"ft_raw_wrench": None, "payload": math.nan, "payload_com": None}
    values |= {key: checked(*field) for key, field in FIELDS.items() if field[0] in fields}
    if "target_speed_fraction" in fields:  # the slider; the two multiply
        values["speed_scaling"] *= checked("target_speed_fraction", 0, 10.0)
    bits = int(fields["safety_status_bits"]) & ~(reduced << states.REDUCED)
    mode = int(fields["robot_mode"])
    host_ns, safety = int(answer["host_ns"]), states.safety_word(bits, mode)
    sample = ArmSample(host_ns=host_ns, safety=safety, **values)
    return Reading(sample, mode, int(fields["runtime_state"]), bits)


class Receiver:
    """Reads the arm's state; each reading is newer than its call."""

    def __init__(
        self, host: str, hz: float, outputs: tuple[str, ...], seconds: float, reduced: bool = False
    ) -> None:
        """Connect within `seconds`; each call raises LinkError if no new data come.

        `reduced`: the reduced mode is normal.
        """
        self._host, self.hz, self._reduced = host, hz, reduced
        self._arguments = (host, repr(hz), ",".join(outputs))
        self._worker = self._start(seconds)

    @property
    def pid(self) -> int:
        """Number of the worker's process."""
        return self._worker.pid

    def read(self, stale: float = PATIENCE_S) -> Reading:
        """Return the first packet newer than the call, within `stale` real s."""
        try:
            answer = self._worker.call("sample", stale + _ANSWER_S, stale=stale)
            return read(answer, self._reduced)
        except WorkerError as error:
            source = "the process that receives over RTDE: " if error.lost else ""
            raise LinkError(f"{source}{error}") from None

    def rate(self, seconds: float) -> float:
        """Return the packets per second, counted for `seconds`."""
        try:
            deadline = seconds + PATIENCE_S + _ANSWER_S
            answer = self._worker.call("rate", deadline, window=seconds, stale=PATIENCE_S)
            return float(answer["rate"])
        except WorkerError as error:
            raise LinkError(str(error)) from None

    def renew(self, seconds: float) -> None:
        """Connect again, in a new process."""
        start = time.monotonic()
        self._worker.kill()
        # Detects a silent controller much earlier than the library does.
        probe.check_stream(self._host, min(seconds, 0.25))
        self._worker = self._start(seconds - (time.monotonic() - start))

    def close(self) -> None:
        """End the process; may be called twice."""
        self._worker.kill()

    def _start(self, seconds: float) -> Worker:
        try:
            return Worker("receive", self._arguments, seconds)
        except WorkerError as error:
            raise LinkError(f"no data over RTDE: {error}") from None


_LARGEST = 1e5  # N·m; no drive exerts as much


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
                self._worker = Worker("torques", self._arguments, _CONNECT_S)

    def mean(self) -> Floats | None:
        """(6,) mean torque of each drive since the last call, N·m; of the last second at most.

        Positive in the direction in which the joint's angle grows, as the drive pushes.
        """
        if self._worker is None:
            return None
        with contextlib.suppress(WorkerError):
            torque = np.asarray(self._worker.call("mean", _ANSWER_S)["torque"], dtype=np.float64)
            if torque.shape == (6,) and (np.abs(torque) <= _LARGEST).all():
                return torque
        self.close()
        return None

    def close(self) -> None:
        """End the process; may be called twice."""
        if self._worker is not None:
            self._worker.kill()
            self._worker = None


_RATE_S = (0.4, 2.0)  # time of counting packets, and of a second count if few; choices
_SHARE = 0.5
"""Least share of the requested packets for a run; a choice."""
_ASK_S = 1.5


def survey(controller: UrController, receiver: Receiver, model: str, silent: str) -> Report:
    """Report all that needs no motion; `silent`: why the supervision does not answer, or empty."""
    supervision, hz = controller.supervision, receiver.hz
    version = states.version_word(controller.version)
    rows: list[Row] = [
        ("address", controller.host, "address", controller.host),
        ("controller version", version, "controller_version", version),
    ]
    problems: list[str] = []
    name, kinematics = "Universal Robots arm", None
    try:
        kinematics = read_kinematics(controller.host, _ASK_S)
        rows.append(("", "", "kinematics", kinematics.to_dict()))
    except LinkError as error:
        rows.append(("its kinematics", f"not reported: {error}", "", None))
        if controller.script_port == PRIMARY_PORT:
            problems.append(
                f"{error}; programs are sent through it, so the arm cannot be controlled without "
                "it: enable the primary client interface in the controller's settings, services"
            )
    if silent:
        rows.append((supervision.name, silent, "", None))
    try:
        if silent:
            raise LinkError(silent)
        robot = supervision.describe(_ASK_S)
    except LinkError as error:
        problems.append(f"{error}; the arm cannot be controlled without it")
    else:
        serial = f", serial number {robot.serial}" if robot.serial else ""
        name = f"Universal Robots {robot.model or 'arm'}{serial}"
        remote = {True: "yes", False: "no (local mode)", None: "not known to this controller"}
        rows += [
            ("model", robot.model, "model", robot.model),
            ("serial number", robot.serial, "serial_number", robot.serial),
            ("PolyScope", robot.version, "software_version", robot.version),
            ("remote control", remote[robot.remote], "remote_control", robot.remote),
            ("program", robot.program, "program", robot.program),
        ]
        if robot.remote is False:
            problems.append("it is in local mode; switch it to remote control on the pendant")
        # "UR10" may stand for an UR10e or UR12e as well: only the size decides
        size, configured = _size(robot.model), _size(model)
        if size and configured and configured != size:
            problems.append(f'it is a {robot.model}; the configuration says model = "{model}"')
    try:
        reading = receiver.read()
        rate = settled_rate(receiver.rate, hz)
    except LinkError as error:
        problems.append(str(error))
    else:
        rows += _state(reading)
        rows.append(("RTDE rate", f"{rate:.0f} Hz of {hz:g} Hz", "rtde_rate_Hz", rate))
        rows.append(("", "", "rtde_rate_asked_Hz", hz))
        problems += _state_problems(reading)
        if rate < _SHARE * hz:
            problems.append(f"RTDE comes at {rate:.0f} Hz instead of {hz:g} Hz; check the network")
    return report_of("arm", name, rows, problems, kinematics)


def settled_rate(count: Callable[[float], float], hz: float) -> float:
    """Return the packets per second of the requested `hz`; a low rate is counted again, longer."""
    rate = count(_RATE_S[0])
    return rate if rate >= _SHARE * hz else count(_RATE_S[1])


def _size(model: str) -> str:
    """Return the number in an arm's name; of UR7e and UR12e the number of UR5e and UR10e."""
    match = re.match(r"ur(\d+)", model.lower())
    return "" if match is None else {"7": "5", "12": "10"}.get(match[1], match[1])


def _state(reading: Reading) -> list[Row]:
    sample, mode = reading.sample, states.mode_word(reading.mode)
    com, celsius = sample.payload_com, sample.joint_temperature
    at = "" if com is None else f" at {_list(1e3 * com)} mm"
    safety = states.safety_word(reading.safety_bits)
    mass = None if math.isnan(sample.payload) else sample.payload
    payload = "not reported" if mass is None else f"{mass:.3f} kg{at}"
    return [
        ("robot mode", mode, "robot_mode", mode),
        ("safety", safety, "safety", safety),
        ("payload", payload, "payload_kg", mass),
        ("", "", "payload_com_m", None if com is None else com.tolist()),
        ("joint temperatures", f"{_list(celsius)} °C", "joint_temperature_degC", celsius.tolist()),
    ]


def _state_problems(reading: Reading) -> list[str]:
    out, sample = [], reading.sample
    if sample.safety != states.NORMAL:
        out.append(f"{sample.safety}: {reading.advice}")
    if reading.runtime in (states.PLAYING, states.RESUMING):
        out.append("a program runs on the robot; stop it on the pendant")
    if math.isnan(sample.payload) or sample.payload_com is None:
        out.append("it does not report its payload; that needs PolyScope 5.5.1 or newer")
    return out


def _list(values: Floats) -> str:
    return ", ".join(f"{v:.1f}" for v in values)
