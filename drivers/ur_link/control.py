"""Motions of the arm through the control worker, and the ways to stop the arm.

The third way to stop is a program sent to the port for URScript, where it replaces the running
program. Source: Universal Robots, "Remote Control via TCP/IP", port 30003; the primary port, 30001,
takes the same programs, and PolyScope X opens only this one.
"""

import contextlib
import time
from dataclasses import dataclass, replace

import numpy as np

from hilcal.drivers.ur_link import probe, states
from hilcal.drivers.ur_link.children import WATCHDOG_HZ
from hilcal.drivers.ur_link.probe import Connection, LinkError
from hilcal.drivers.ur_link.reading import STALE_S, Reading, Receiver
from hilcal.drivers.ur_link.states import CHECK_LINK, RESUME, failure
from hilcal.drivers.ur_link.supervision import PRIMARY_PORT, UrController
from hilcal.drivers.ur_link.worker import Worker, WorkerError
from hilcal.errors import undone_by
from hilcal.measuring.route import duration
from hilcal.types import Floats

REST_RAD_S = 0.01  # joints slower than this stand; measured speeds are noisy, rad/s
MARGIN_S = 5.0
"""Allowed delay of a motion, and longest pause, real s."""
SLACK = 1.5  # allowed duration of a motion, as a multiple of the computed one
PAUSED_SPEED_SHARE = 0.02  # below this share of its speed a motion counts as paused
_TARGET_RAD = 1e-5
_BRAKE_S = 0.15
_BRAKE_MIN, _BRAKE_MAX = 2.0, 10.0


def deceleration(speed: float) -> float:
    """Return the deceleration of the leading joint, rad/s², to stop within about 0.15 s."""
    return float(np.clip(speed / _BRAKE_S, _BRAKE_MIN, _BRAKE_MAX))


def at_rest(reading: Reading) -> bool:
    """Whether no joint moves."""
    return float(np.abs(reading.sample.qd).max()) < REST_RAD_S


class MotionInProgress:
    """A commanded motion and the time spent on it; `brake`: its deceleration, rad/s²."""

    def __init__(
        self,
        start: Floats,
        goal: Floats,
        speed: float,
        acceleration: float,
        arrival: float,
        clock: float,
    ) -> None:
        """Begin, from `start` to `goal` (6,), rad; `clock` is cell seconds per real second."""
        self.brake = deceleration(speed)
        self._goal, self._arrival = goal, arrival
        self._expected = duration(start, goal, speed, acceleration) / clock
        self._spent = 0.0
        self._checked = time.monotonic()
        self._paused: float | None = None

    def arrived(self, reading: Reading) -> bool:
        """Whether the target and the actual joints are at the goal, and the arm stands."""
        sample = reading.sample
        return (
            float(np.abs(sample.q_target - self._goal).max()) <= _TARGET_RAD
            and float(np.abs(sample.q - self._goal).max()) <= self._arrival
            and at_rest(reading)
        )

    def overdue(self, reading: Reading) -> str | None:
        """Return why the motion has failed, or None; call with every reading.

        Time is weighted by the share of the speed that the controller allows.
        """
        sample, now = reading.sample, time.monotonic()
        interval, self._checked = now - self._checked, now
        self._spent += interval * max(min(sample.speed_scaling, 1.0), PAUSED_SPEED_SHARE)
        if sample.speed_scaling >= PAUSED_SPEED_SHARE:
            self._paused = None
        elif self._paused is None:
            self._paused = now
        elif now - self._paused > MARGIN_S:
            return f"its speed has been scaled to 0 for {MARGIN_S:g} s (speed slider, or paused)"
        if self._spent <= SLACK * self._expected + MARGIN_S:
            return None
        error = np.abs(sample.q - self._goal)
        k = int(np.argmax(error))
        return (
            f"it did not arrive in time: joint {k + 1} stands {error[k]:.3g} rad off its goal "
            f"(arrival_rad is {self._arrival:g})"
        )


LEASE_S = 0.5  # a motion whose lease is not renewed for this time is stopped, real s
COMMAND_S = 0.5  # deadline of a command, real s
CONNECT_S = 8.0  # deadline for taking control, real s
_ORPHAN_S = 1.6
_HZ = 125.0
_IN_USE = "already in use"  # in ur_rtde's message
_CONTROLLED = (
    "another program controls it (its RTDE input registers are in use)",
    "end the other program, or the fieldbus that uses the registers",
)
_NO_COG = 1e-6
"""z of a centre of mass at the flange, m: ur_rtde's script takes (0, 0, 0) for "unchanged"."""


class Control(Worker):
    """Commands the arm; every call has a deadline, and may raise WorkerError.

    If the process is killed, the robot's watchdog stops the arm.
    """

    def __init__(self, controller: UrController, seconds: float) -> None:
        """Take control of the arm within a deadline."""
        flags = controller.script_port == PRIMARY_PORT, controller.upper_registers
        arguments = repr(_HZ), repr(LEASE_S), *(str(int(flag)) for flag in flags)
        try:
            super().__init__("control", (controller.host, *arguments), seconds)
        except BaseException as error:  # ended between upload and watchdog, it leaves its program
            if _IN_USE not in str(error):
                with contextlib.suppress(LinkError):
                    controller.supervision.stop(ASK_S)
            raise

    def renew_lease(self, seconds: float = COMMAND_S) -> tuple[bool, float]:
        """Renew the lease of the motion; `seconds`: deadline of the answer, real s.

        Return whether the motion was stopped because its lease had expired, and the longest pause
        between two signs of life, if too long, s; else 0.
        """
        answer = self.call("alive", seconds)
        return bool(answer["expired"]), float(answer["late"])

    def move(self, q: Floats, speed: float, acceleration: float, brake: float) -> bool:
        """Start a motion, rad; False if the controller does not take it."""
        how = {"speed": speed, "acceleration": acceleration, "deceleration": brake}
        return bool(self.call("move", COMMAND_S, q=q.tolist(), **how)["done"])

    def end_lease(self) -> None:
        """End the lease: the motion has ended."""
        self.call("rest", COMMAND_S)

    def stop(self, brake: float, seconds: float) -> None:
        """Stop the motion; `brake`: deceleration of the leading joint, rad/s²."""
        self.call("stop", seconds, deceleration=brake)

    def set_payload(self, mass: float, com: Floats) -> bool:
        """Set the payload, kg and m; the caller has to read it back."""
        cog = com.tolist() if com.any() else [0.0, 0.0, _NO_COG]
        return bool(self.call("payload", COMMAND_S, mass=mass, com=cog)["done"])

    def release(self) -> None:
        """End the robot's program and the process; never raises."""
        with contextlib.suppress(WorkerError):
            self.call("bye", COMMAND_S)
        self.kill()


def take_control(controller: UrController, receiver: Receiver) -> Control:
    """Take control of an arm that is ready for it."""
    host, end = controller.host, time.monotonic() + CONNECT_S
    try:
        _check_ready(controller, receiver)
    except LinkError as error:
        raise failure(host, str(error), CHECK_LINK) from None
    try:
        control = _start(controller, end)
    except WorkerError as error:
        text = str(error)
        if _IN_USE in text:
            raise failure(host, *_CONTROLLED) from None
        if "remote control" in text:
            text = "it is in local mode; switch it to remote control on the pendant"
        raise failure(host, f"cannot take control: {text}") from None
    with undone_by(control.kill):
        try:
            _wait_for(receiver, (states.PLAYING,), 1.0)
        except LinkError as error:
            raise failure(host, f"cannot take control: {error}") from None
    return control


def _start(controller: UrController, end: float) -> Control:
    """Start the worker; try twice: our query of the registers may still hold them."""
    try:
        return Control(controller, end - time.monotonic())
    except WorkerError as error:
        if _IN_USE not in str(error):
            raise
    time.sleep(0.3)
    return Control(controller, end - time.monotonic())


def _check_ready(controller: UrController, receiver: Receiver) -> None:
    """Refuse a robot that cannot be controlled; end a program that a stop has left paused."""
    host, reading = controller.host, receiver.read()
    if reading.sample.safety != states.NORMAL:
        raise failure(host, reading.sample.safety, reading.advice)
    if probe.in_use(host, controller.registers, 1.0):
        raise failure(host, *_CONTROLLED)
    with contextlib.suppress(LinkError):  # the watchdog ends a program left by us
        _wait_for(receiver, (states.STOPPED, states.PAUSED), _ORPHAN_S)
    runtime = receiver.read().runtime
    if runtime == states.PAUSED:
        controller.supervision.stop(1.0)
        _wait_for(receiver, (states.STOPPED,), 2.0)
    elif runtime != states.STOPPED:
        word = states.runtime_word(runtime)
        raise failure(host, f"a program is on the robot ({word})", "stop it on the pendant")
    if controller.supervision.in_remote_control(1.0) is False:
        raise failure(host, "it is in local mode", "switch it to remote control on the pendant")


def _wait_for(receiver: Receiver, runtimes: tuple[int, ...], seconds: float) -> None:
    end = time.monotonic() + seconds
    while (runtime := receiver.read().runtime) not in runtimes:
        if time.monotonic() > end:
            raise LinkError(f"the robot's program is {states.runtime_word(runtime)}")
        time.sleep(0.01)


ASK_S = 0.25  # deadline of each way to stop, real s
_GENTLE_S = 0.6
_SURE_S = 1.0
_AGAIN_S = 0.3
_RENEW_S = 1.5
_TAKEN_S = 0.05
"""Time before closing the connection, real s: the controller drops a program whose sender leaves
before it has taken the program; a choice."""
UNWATCHED = "its motion was not supervised for 0.5 s, so it was stopped"


@dataclass(frozen=True, slots=True)
class Halt:
    """How a stop ended."""

    reading: Reading | None  # after the stop; None if the state cannot be read
    at_rest: bool
    link_failure: str  # why the link was lost before it was renewed; else empty


@dataclass(frozen=True, slots=True)
class Brakes:
    """The ways to stop one arm."""

    controller: UrController
    receiver: Receiver

    def stop_in_control(self, control: Control, brake: float) -> bool:
        """Stop through the control worker and keep control; return whether the arm stands."""
        with contextlib.suppress(WorkerError, LinkError):
            control.stop(brake, 0.3)
            reading = self._until_still(_GENTLE_S, program=False)
            if reading is not None and reading.runtime == states.PLAYING:
                control.end_lease()
                return True
        return False

    def halt(self, control: Control | None, brake: float, link_failure: str = "") -> Halt:
        """Stop in every way, which ends control; never raises.

        `brake`: deceleration of the leading joint, rad/s²; `link_failure`: why the link is lost.
        """
        if control is not None:
            try:
                if not link_failure:
                    control.stop(brake, 0.1)
            except WorkerError:
                pass
            finally:
                control.kill()  # the robot's watchdog then stops the arm, whatever else fails
        try:
            self.controller.supervision.stop(ASK_S)
        except LinkError:
            self._by_script(brake)
        try:
            if not link_failure:
                return self._watch(brake)
        except LinkError as error:
            link_failure = str(error)
        try:
            self.receiver.renew(_RENEW_S)
            return replace(self._watch(brake), link_failure=link_failure)
        except LinkError:
            return Halt(None, False, link_failure)

    def _watch(self, brake: float) -> Halt:
        """Wait until the arm stands; command the stop once more if it does not."""
        reading = self._until_still(_AGAIN_S, program=True)
        if reading is None:
            self._by_script(brake)
            reading = self._until_still(_SURE_S - _AGAIN_S, program=True)
        return Halt(reading or self.receiver.read(STALE_S), reading is not None, "")

    def _by_script(self, brake: float) -> None:
        """Send a program that stops the arm along its path; `brake`: as for `halt`."""
        program = f"def stop_arm():\n  stopj({brake:.3f})\nend\n"
        with (
            contextlib.suppress(LinkError),
            Connection(
                self.controller.host, self.controller.script_port, "script port", ASK_S
            ) as line,
        ):
            line.send(program.encode())
            time.sleep(_TAKEN_S)

    def _until_still(self, seconds: float, *, program: bool) -> Reading | None:
        """Return the second of two successive readings at rest; with `program`, of an ended one."""
        end, count = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            reading = self.receiver.read(STALE_S)
            ended = reading.runtime not in (states.PLAYING, states.RESUMING)
            safe = not program or ended or reading.sample.safety != states.NORMAL
            count = count + 1 if at_rest(reading) and safe else 0
            if count == 2:
                return reading
        return None


def cause_of(controller: UrController, halt: Halt, symptom: str) -> tuple[str, str]:
    """Return cause and advice, after the arm has been stopped.

    A safety stop also ends the program, and a lost link the process that commands the arm. So the
    symptom noticed first is returned only if no deeper cause is found.
    """
    reading = halt.reading
    if reading is not None and reading.sample.safety != states.NORMAL:
        return reading.sample.safety, f"{reading.advice}, {RESUME}"
    with contextlib.suppress(LinkError):
        if controller.supervision.in_remote_control(ASK_S) is False:
            return "it was switched to local mode", f"switch it to remote control, {RESUME}"
    if halt.link_failure:
        return f"the link is lost: {halt.link_failure}", CHECK_LINK
    return symptom, f"look at the pendant, {RESUME}"


def program_ended(reading: Reading, late: float) -> str:
    """Return why the robot's program ended; `late` is the longest pause in the signs of life, s."""
    busy = f"this computer was too busy to send a sign of life for {late:.2f} s"
    if late > 1.0 / WATCHDOG_HZ:
        return f"its watchdog stopped it: {busy}"
    word = states.runtime_word(reading.runtime)
    hint = f" ({busy})" if late > 0.0 else ""
    return (
        f"its program is {word}: stopped by another program, on the pendant, or by its "
        f"watchdog{hint}"
    )


def not_commanded(error: WorkerError) -> str:
    """Return why a command failed."""
    if error.lost:
        return f"the process that commands it ended ({error})"
    return f"it did not take a command ({error})"
