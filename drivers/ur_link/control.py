"""The command of the arm, through the control worker."""

import contextlib
import time
from dataclasses import dataclass

from hilcal.drivers.ur_link import probe, states
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.reading import Receiver
from hilcal.drivers.ur_link.states import CHECK_LINK, failure
from hilcal.drivers.ur_link.supervision import PRIMARY_PORT, Generation
from hilcal.drivers.ur_link.worker import Worker, WorkerError
from hilcal.types import Floats

LEASE_S = 0.5
"""Lease of a motion: not renewed for so long, the motion is stopped, real s."""
COMMAND_S = 0.5
"""Deadline of a command, real s."""
CONNECT_S = 8.0
"""Deadline for taking control, real s."""
_ORPHAN_S = 1.6
_HZ = 125.0
_NO_COG = 1e-6
"""Stands for a centre of mass at the flange: (0, 0, 0) keeps the old one in ur_rtde's script, m."""


@dataclass(frozen=True, slots=True)
class Pulse:
    """State of the control worker."""

    expired: bool  # the motion was stopped because its lease was not renewed
    late: float  # the longest pause between two signs of life that was too long, s; 0 for none


class Control:
    """Commands the arm; every call may raise WorkerError, and ends by its deadline."""

    def __init__(self, worker: Worker) -> None:
        """Use a worker that has taken control."""
        self._worker = worker

    @property
    def pid(self) -> int:
        """Number of the worker's process."""
        return self._worker.pid

    def alive(self, seconds: float = COMMAND_S) -> Pulse:
        """Watch the motion: renew its lease; the answer comes within a deadline, real s."""
        answer = self._worker.call("alive", seconds)
        return Pulse(bool(answer["expired"]), float(answer["late"]))

    def move(self, q: Floats, speed: float, acceleration: float, brake: float) -> bool:
        """Start a motion, rad; False where the controller does not take it."""
        answer = self._worker.call(
            "move",
            COMMAND_S,
            q=q.tolist(),
            speed=speed,
            acceleration=acceleration,
            deceleration=brake,
        )
        return bool(answer["done"])

    def rest(self) -> None:
        """Say that the motion has ended: no lease any more."""
        self._worker.call("rest", COMMAND_S)

    def stop(self, brake: float, seconds: float) -> None:
        """Brake, rad/s² of the leading joint."""
        self._worker.call("stop", seconds, deceleration=brake)

    def set_payload(self, mass: float, com: Floats) -> bool:
        """Tell the payload, kg and m; whether the controller took it has to be read back."""
        told = com.tolist() if com.any() else [0.0, 0.0, _NO_COG]
        return bool(self._worker.call("payload", COMMAND_S, mass=mass, com=told)["done"])

    def give_back(self) -> None:
        """End the robot's program and the process; never raises."""
        with contextlib.suppress(WorkerError):
            self._worker.call("bye", COMMAND_S)
        self._worker.kill()

    def kill(self) -> None:
        """End the process at once; the robot's watchdog then stops the arm."""
        self._worker.kill()


def take(host: str, receiver: Receiver, generation: Generation) -> Control:
    """Take control of an arm that is ready for it.

    Raises:
        DeviceError: it is not, somebody else controls it, or it does not answer in time.
    """
    end = time.monotonic() + CONNECT_S
    try:
        _ready(host, receiver)
        if probe.in_use(host, generation.registers, 1.0):
            raise _controlled(host)
        _no_program(host, receiver, generation)
        if generation.supervision.in_remote_control(1.0) is False:
            raise failure(host, "it is in local mode", "switch it to remote control on the pendant")
    except LinkError as error:
        raise failure(host, str(error), CHECK_LINK) from None
    try:
        worker = _start(host, generation, end)
    except WorkerError as error:
        text = str(error)
        if "already in use" in text:
            raise _controlled(host) from None
        if "remote control" in text:
            text = "it is in local mode; switch it to remote control on the pendant"
        raise failure(host, f"cannot take control: {text}") from None
    try:
        _wait_for(receiver, (states.PLAYING,), 1.0)
    except LinkError as error:
        worker.kill()
        raise failure(host, f"cannot take control: {error}") from None
    return Control(worker)


def _start(host: str, generation: Generation, end: float) -> Worker:
    """Start the worker; the registers may be ours for a moment longer, from being asked for."""
    relayed = str(int(generation.script_port == PRIMARY_PORT))
    arguments = (host, repr(_HZ), repr(LEASE_S), relayed, str(int(generation.upper)))
    module = "hilcal.drivers.ur_link.control_worker"
    try:
        return Worker(module, arguments, end - time.monotonic())
    except WorkerError as error:
        if "already in use" not in str(error):
            raise
    time.sleep(0.3)
    return Worker(module, arguments, end - time.monotonic())


def _controlled(host: str) -> Exception:
    return failure(
        host,
        "another program controls it (its RTDE input registers are in use)",
        "end the other program, or the fieldbus that uses the registers",
    )


def _ready(host: str, receiver: Receiver) -> None:
    """Refuse a robot that is not running, or not in a normal safety state."""
    reading = receiver.read()
    if reading.sample.safety != states.NORMAL:
        raise failure(host, reading.sample.safety, states.safety_advice(reading.safety_bits))
    if reading.mode != states.RUNNING:
        word = states.mode_word(reading.mode)
        raise failure(host, f"it is not running ({word})", "switch it on and release the brakes")


def _no_program(host: str, receiver: Receiver, generation: Generation) -> None:
    """Refuse a robot that runs somebody's program; end a paused one, which a stop left behind."""
    with contextlib.suppress(LinkError):  # an orphan of ours ends by its watchdog
        _wait_for(receiver, (states.STOPPED, states.PAUSED), _ORPHAN_S)
    runtime = receiver.read().runtime
    if runtime == states.PAUSED:
        generation.supervision.stop(1.0)
        _wait_for(receiver, (states.STOPPED,), 2.0)
    elif runtime != states.STOPPED:
        word = states.runtime_word(runtime)
        raise failure(host, f"a program is on the robot ({word})", "stop it on the pendant")


def _wait_for(receiver: Receiver, wanted: tuple[int, ...], seconds: float) -> None:
    end = time.monotonic() + seconds
    while (runtime := receiver.read().runtime) not in wanted:
        if time.monotonic() > end:
            raise LinkError(f"the robot's program is {states.runtime_word(runtime)}")
        time.sleep(0.01)
