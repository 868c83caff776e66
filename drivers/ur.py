"""UR arm on ur_rtde: driver `ur` of the group `hilcal.arms`.

ur_rtde can hang, crash, or repeat old values. Every call into it is therefore made in a child
process, with a deadline: one process has the receive interface; another, which exists only after
`take_control`, the control interface. The arm can be stopped in three independent ways: by the
control interface, by the dashboard server or Robot API, and by a program on the script port. The
controller's watchdog also stops it 0.1 s after the control process has ended.
"""

import contextlib
import importlib.util
import sys
import time
from dataclasses import replace
from typing import NoReturn

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers.ur_link import control as command
from hilcal.drivers.ur_link import probe, states
from hilcal.drivers.ur_link.probe import LinkError
from hilcal.drivers.ur_link.reading import (
    OPTIONAL,
    OUTPUTS,
    PATIENCE_S,
    STALE_S,
    TORQUE,
    N,
    Reading,
    Receiver,
    TorqueReader,
    survey,
)
from hilcal.drivers.ur_link.states import CHECK_LINK, CONTROL, HOLD_ON, failure
from hilcal.drivers.ur_link.supervision import UrController, UrOptions
from hilcal.drivers.ur_link.worker import WorkerError
from hilcal.errors import InputError, undone_by
from hilcal.measuring.devices import ArmSample, Report
from hilcal.optional import install
from hilcal.toml import check_section
from hilcal.types import Floats

_PROBE_S, _ASK_S, _RECEIVE_S = 2.5, 1.5, 4.0  # 8 s together
_PAYLOAD_S = 1.5
_ORPHAN_S = 1.6
_PULSE_S = 0.1
"""Deadline for asking the control process why the program ended, real s; it delays the stop."""
_MASS_KG, _COM_M = 1e-3, 1e-4  # tolerances of a payload read back
_MAX_Q, _MAX_SPEED, _MAX_ACCELERATION = 6.34, 3.2, 40.0

NO_WHEEL = (3, 13)
"""First Python without a wheel of ur-rtde 1.6.5; pyproject.toml requires it below this version."""


class UrArm:
    """An arm of Universal Robots; see `hilcal.measuring.devices.ArmDevice`."""

    def __init__(
        self,
        config: CellConfig,
        controller: UrController,
        silent: str,
        receiver: Receiver,
        torques: TorqueReader | None = None,
    ) -> None:
        """Use an open connection; `silent`: why the supervision does not answer, or empty."""
        self._controller, self._silent = controller, silent
        self._receiver, self._torques = receiver, torques
        self._host, self._model = controller.host, config.robot.model
        self._arrival, self._clock = config.motion.arrival_rad, config.clock
        self._brakes = command.Brakes(controller, receiver)
        self._control: command.Control | None = None
        self._motion: command.MotionInProgress | None = None
        self._brake = command.deceleration(config.motion.speed_rad_s)
        self._fault = ""
        self._program_uploaded = False

    @property
    def workers(self) -> tuple[int, ...]:
        """Process numbers of all child processes."""
        control = () if self._control is None else (self._control.pid,)
        torques = () if self._torques is None else self._torques.pids
        return (self._receiver.pid, *control, *torques)

    def report(self) -> Report:
        """Report identity, versions, state and every problem; moves nothing."""
        end = time.monotonic() + _ORPHAN_S
        while True:
            report = survey(self._controller, self._receiver, self._model, self._silent)
            others = tuple(p for p in report.problems if not p.startswith("a program runs"))
            if self._control is not None:  # the program is ours
                return replace(report, problems=others)
            if others == report.problems or time.monotonic() >= end:
                return report
            time.sleep(0.2)  # the program of a killed hilcal ends by its watchdog

    def sample(self) -> ArmSample:
        """Return a sample newer than the call; see `ArmDevice.sample`."""
        sample = self._read().sample
        if self._torques is None or self._motion is not None:
            return sample
        return replace(sample, torque=self._torques.mean())

    def take_control(self, mass: float, com: Floats) -> None:
        """Take control of the arm and set its payload; see `ArmDevice.take_control`."""
        if self._motion is not None:
            raise failure(self._host, "the previous motion has not ended")
        self._release_control()
        try:
            self._receiver.read()
        except LinkError:
            try:
                self._receiver.renew(_RECEIVE_S)
            except LinkError as error:
                raise failure(self._host, str(error), CHECK_LINK) from None
        if self._torques is not None:
            self._torques.renew()
        self._silent = self._controller.why_silent(_ASK_S)
        if self._silent:
            raise failure(self._host, f"cannot take control: {self._silent}")
        self._end_program()
        self._control = command.take_control(self._controller, self._receiver)
        self._program_uploaded = True
        self._fault = ""
        with undone_by(self._release_control):
            self.set_payload(mass, com)

    def set_payload(self, mass: float, com: Floats) -> None:
        """Set mass, kg, and centre of mass, m, at the flange; read back and compared."""
        com = np.asarray(com, dtype=np.float64)
        if com.shape != (3,) or not np.isfinite([mass, *com]).all() or mass < 0:
            raise InputError(
                f"payload {mass} kg at {com.tolist()} m is not valid: a mass of 0 or more and "
                "three finite numbers"
            )
        control = self._in_control()
        if self._motion is not None:
            raise failure(self._host, "the payload cannot be changed during a motion")
        try:
            control.set_payload(mass, com)
        except WorkerError as error:
            self._fail_without_effect(command.not_commanded(error))
        end = time.monotonic() + _PAYLOAD_S
        while True:
            reading = self._read()
            sample, reported = reading.sample, reading.sample.payload_com
            if reported is None:
                raise failure(
                    self._host,
                    "it does not report its payload; that needs PolyScope 5.5.1 or newer",
                )
            com_error = np.abs(reported - com).max()
            if abs(sample.payload - mass) <= _MASS_KG and com_error <= _COM_M:
                return
            if reading.runtime != states.PLAYING:
                self._fail_without_effect("it did not take the payload")
            if time.monotonic() > end:
                self._fail(
                    f"it reports {sample.payload:g} kg at {np.round(reported, 4).tolist()} m after "
                    f"a payload of {mass:g} kg at {np.round(com, 4).tolist()} m was set"
                )

    def start_move(self, q: Floats, speed: float, acceleration: float) -> None:
        """Start a motion along a straight line in joint space; see `Arm.start_move`."""
        q = np.asarray(q, dtype=np.float64)
        if q.shape != (N,) or not np.isfinite(q).all() or np.abs(q).max() > _MAX_Q:
            raise InputError(
                f"goal {q.tolist()} is not valid: {N} finite angles within ±{_MAX_Q} rad"
            )
        for name, value, top in (
            ("speed", speed, _MAX_SPEED),
            ("acceleration", acceleration, _MAX_ACCELERATION),
        ):
            if not 0.0 < value <= top:
                raise InputError(f"{name} {value} is not valid: over 0 and up to {top}")
        control = self._in_control()
        if self._motion is not None:
            raise failure(self._host, "the previous motion has not ended")
        reading = self._read()
        self._check_state(reading)
        if reading.runtime != states.PLAYING:
            self._fail(command.program_ended(reading, 0.0))
        motion = command.MotionInProgress(
            reading.sample.q, q, speed, acceleration, self._arrival, self._clock
        )
        self._motion, self._brake = motion, motion.brake
        try:
            accepted = control.move(q, speed, acceleration, motion.brake)
        except WorkerError as error:
            self._fail_without_effect(command.not_commanded(error))
        if not accepted:
            self._fail_without_effect("it did not take the motion")

    def moving(self) -> bool:
        """Whether the motion is still going on; see `Arm.moving`."""
        motion = self._motion
        if motion is None:
            if self._fault:
                self._in_control()
            if self._control is not None:
                self._check_state(self._read())  # of an arm at rest, too
            return False
        control = self._in_control()
        reading = self._read()  # first: the control process can hang after the program's end
        self._check_state(reading)
        if reading.runtime != states.PLAYING:
            self._fail(_why_ended(reading, control))
        try:
            expired, _ = control.renew_lease()
        except WorkerError as error:
            self._fail(command.not_commanded(error))
        if expired:
            self._fail(command.UNWATCHED)
        if motion.arrived(reading):
            self._motion = None
            with contextlib.suppress(WorkerError):  # at rest; the next command shows a failure
                control.end_lease()
            return False
        late = motion.overdue(reading)
        if late is not None:
            self._fail(late)
        return True

    def stop(self) -> None:
        """Stop the arm in every available way; returns when it stands."""
        if self._control is None and self._is_at_rest():
            return
        if self._control is not None and self._brakes.stop_in_control(self._control, self._brake):
            self._motion = None
            return
        halt = self._brakes.halt(self._control, self._brake)
        self._control = self._motion = None
        self._fault = "its program was ended to stop it"
        if not halt.at_rest:
            why = f" ({halt.link_failure})" if halt.link_failure else ""
            raise failure(self._host, f"it was commanded to stop{why}", HOLD_ON)

    def close(self) -> None:
        """Stop, give control back, end all child processes. Never raises."""
        with contextlib.suppress(Exception):
            if self._motion is not None:
                self.stop()
        with contextlib.suppress(Exception):
            self._release_control()
        with contextlib.suppress(Exception):
            self._end_program()
        with contextlib.suppress(Exception):
            self._receiver.close()
        if self._torques is not None:
            self._torques.close()

    def _in_control(self) -> command.Control:
        if self._control is None:
            why = f" ({self._fault})" if self._fault else ""
            raise failure(self._host, f"it is not under control{why}", CONTROL)
        return self._control

    def _release_control(self) -> None:
        control, self._control, self._motion = self._control, None, None
        if control is not None:
            control.release()

    def _end_program(self) -> None:
        """End our program, which ur_rtde may have uploaded again after a lost link."""
        if self._program_uploaded and not self._silent:
            with contextlib.suppress(LinkError):
                self._controller.supervision.stop(_ASK_S)
                self._program_uploaded = False

    def _is_at_rest(self) -> bool:
        """Whether an arm not under control stands."""
        with contextlib.suppress(LinkError):
            first, second = self._receiver.read(), self._receiver.read()
            return command.at_rest(first) and command.at_rest(second)
        return False

    def _read(self) -> Reading:
        """Return a new reading; a dead link ends a motion with a failure."""
        try:
            return self._receiver.read(PATIENCE_S if self._motion is None else STALE_S)
        except LinkError as error:
            if self._motion is not None:
                self._fail("", lost=str(error))
            raise failure(self._host, f"the link is lost: {error}", CHECK_LINK) from None

    def _check_state(self, reading: Reading) -> None:
        """Fail unless the robot is in a state to move."""
        if reading.sample.safety != states.NORMAL:
            self._fail("it is not ready to move")

    def _fail_without_effect(self, symptom: str) -> NoReturn:
        """Fail on a command without effect; the cause may be that the program has ended."""
        with contextlib.suppress(LinkError):  # the stop detects the lost link, too
            reading = self._receiver.read(STALE_S)
            if reading.runtime != states.PLAYING:
                symptom = f"{symptom}: {command.program_ended(reading, 0.0)}"
        self._fail(symptom)

    def _fail(self, symptom: str, lost: str = "") -> NoReturn:
        """Stop the arm, then find the cause and raise DeviceError."""
        halt = self._brakes.halt(self._control, self._brake, lost)
        self._control = self._motion = None
        self._fault, advice = command.cause_of(self._controller, halt, symptom)
        if not halt.at_rest:
            advice = f"{HOLD_ON}; {advice}"
        raise failure(self._host, self._fault, advice)


def _why_ended(reading: Reading, control: command.Control) -> str:
    """Return why the robot's program ended, from the controller and the control process."""
    try:
        expired, late = control.renew_lease(_PULSE_S)
    except WorkerError:
        return command.program_ended(reading, 0.0)
    return command.UNWATCHED if expired else command.program_ended(reading, late)


def _missing_library(python: tuple[int, ...]) -> str:
    cause, remedy = "is not installed", install("rtde_control")
    if python >= NO_WHEEL:
        cause = f"has no wheel for Python {python[0]}.{python[1]}"
        remedy = "use Python 3.11 or 3.12 for the cell's computer"
    return f"arm: driver ur needs ur-rtde, which {cause}; {remedy}"


def open_arm(config: CellConfig) -> UrArm:
    """Connect to the controller of [robot] host; moves nothing and uploads nothing."""
    host = config.robot.host
    if host is None:
        raise InputError(
            '[robot] host is missing: the driver "ur" needs the controller\'s address, '
            'e.g. host = "192.168.56.101"'
        )
    options = check_section(dict(config.robot.options), UrOptions, "[robot.options]")
    if importlib.util.find_spec("rtde_control") is None:
        raise InputError(_missing_library(sys.version_info[:2]))
    try:
        version, available = probe.controller(host, (*OUTPUTS, TORQUE), _PROBE_S)
        outputs = tuple(name for name in available if name != TORQUE)
        missing = set(OUTPUTS) - OPTIONAL - set(outputs)
        if missing:
            word = states.version_word(version)
            raise failure(host, f"its version {word} lacks {', '.join(sorted(missing))}")
        controller = UrController.of(host, version, options.robot_api_port)
        silent = controller.why_silent(_ASK_S)
        reduced = options.reduced_mode
        receiver = Receiver(host, options.receive_hz, outputs, _RECEIVE_S, reduced)
    except LinkError as error:
        advice = "check that the controller is on and [robot] host"
        raise failure(host, str(error), advice) from None
    torques = TorqueReader(host, options.receive_hz) if TORQUE in available else None
    return UrArm(config, controller, silent, receiver, torques)
