"""The simulated arm of any maker, with any number of joints and slides, and its controller.

    python -m hilcal.drivers.simulated.arm --directory DIR [--seed N]

runs the controller of the arm in DIR/world.json. It speaks no maker's protocol: the driver
`open_arm` uses its admin line, DIR/arm.sock. Operations: `sample`, `move {q, speed, acceleration}`,
`stop`, `payload {mass, com}`, `state`, `jog {q}` (a motion by hand), `protective_stop`, `release`,
`die`. A motion stops after half a second without a request. Arms of Universal Robots have another
controller, which speaks their protocols.
"""

import contextlib
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.ur_state import Kinematics, Trajectory, WorldClock
from hilcal.drivers.simulated.world_server import read_world
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import ArmSample, Report
from hilcal.robot.arm import Arm
from hilcal.robot.se3 import six
from hilcal.types import Floats

WATCHDOG_S = 0.5  # without a request for this time a motion is stopped, real s
PROTECTIVE = "protective stop"
_STEP_S, _REFRESH_S = 0.004, 0.01  # real s between steps in motion, and at rest
_STOPPING = 2.0  # rad/s² of the leading joint (a slide: m/s²)


class ArmController:
    """The trajectory, payload and safety state of the arm; thread-safe."""

    def __init__(self, arm: Arm, board: Blackboard, rng: np.random.Generator) -> None:
        state = board.read("arm")
        self._board, self._clock, self._lock = board, WorldClock(board), threading.RLock()
        self._arm, self._kinematics = arm, Kinematics(arm)
        side = state["side"] if state["alive"] else rng.choice([-1.0, 1.0], arm.n)
        arrivals = int(state["arrivals"]) + bool(state["moving"])
        self._motion = Trajectory(state["q"], side, arrivals, self._clock.now)
        self._payload, self._com = float(state["payload"]), state["payload_com"].copy()
        self._safety, self._last_request = "normal", time.monotonic()

    def step(self) -> bool:
        """Advance to the present, and publish; return whether the arm moves."""
        with self._lock:
            motion = self._motion
            if motion.moving and time.monotonic() - self._last_request > WATCHDOG_S:
                motion.stop(_STOPPING, self._clock.now)
            motion.advance(self._clock.now)
            motion.publish(self._board, self._payload, self._com)
            return motion.moving

    def sample(self) -> dict[str, Any]:
        """Return the present state of the arm as the controller knows it, for JSON."""
        with self._lock:
            self._last_request = time.monotonic()
            self.step()
            motion, truth = self._motion, self._board.read("truth")
            current = int(truth["arrivals"]) == motion.arrivals and truth["flange"][3, 3] == 1.0
            q = truth["encoder"] if current and not motion.moving else motion.q
            return {
                "timestamp": self._clock.now,
                "q": q.tolist(),
                "q_target": motion.q.tolist(),
                "qd": motion.qd.tolist(),
                "moving": motion.moving,
                "torque": self._kinematics.weight_torque(q, self._payload, self._com).tolist(),
                "joint_temperature": truth["joint_temperature"].tolist(),
                "flange": six(self._kinematics.flange(q)),
                "payload": self._payload,
                "payload_com": self._com.tolist(),
                "safety": self._safety,
                "arrivals": motion.arrivals,
            }

    def move(self, q: list[float], speed: float, acceleration: float) -> None:
        """Start a straight line in joint space."""
        goal = self._joints(q)
        with self._lock:
            if self._safety != "normal":
                raise DeviceError(f"the arm is in a {self._safety}")
            self._last_request = time.monotonic()
            self._motion.start(goal, speed, acceleration, self._clock.now)

    def stop(self) -> None:
        """Stop the motion."""
        with self._lock:
            self._motion.stop(_STOPPING, self._clock.now)

    def payload(self, mass: float, com: list[float]) -> None:
        """Set the payload, kg and m (flange axes)."""
        with self._lock:
            self._payload, self._com = float(mass), np.array(com, dtype=float)

    def jog(self, q: list[float]) -> None:
        """Place the arm elsewhere at once, as if moved by hand."""
        with self._lock:
            self._motion.place(self._joints(q))

    def protective_stop(self) -> None:
        """Stop, and refuse motions until `release`."""
        with self._lock:
            self.stop()
            self._safety = PROTECTIVE

    def release(self) -> None:
        """Allow motions again."""
        with self._lock:
            self._safety = "normal"

    def _joints(self, q: list[float]) -> Floats:
        goal, arm = np.asarray(q, dtype=float), self._arm
        if goal.shape != (arm.n,) or not np.isfinite(goal).all():
            raise DeviceError(f"joint values {q}; {arm.name} has {arm.n} joints")
        if np.any((goal < arm.q_min) | (goal > arm.q_max)):
            raise DeviceError(f"joint values {q} are beyond the limits of {arm.name}")
        return goal


_STOPPED_S = 5.0  # longest time from the stop to a standstill, real s


class SimulatedArm:
    """See `hilcal.measuring.devices.ArmDevice`."""

    def __init__(self, socket: Path) -> None:
        self._socket, self._ours = socket, False

    def report(self) -> Report:
        """Report joints, payload and safety state; moves nothing."""
        state = self._ask("sample")
        problems = () if state["safety"] == "normal" else (f"it is in a {state['safety']}",)
        facts = (("joints", str(len(state["q"]))), ("payload", f"{state['payload']:g} kg"))
        return Report("arm", "simulated arm", facts, problems, (("joints", len(state["q"])),))

    def sample(self) -> ArmSample:
        """Return the controller's present state; currents and tool forces are zero."""
        state = self._ask("sample")
        zeros = np.zeros(len(state["q"]))
        names = ("q", "q_target", "qd", "joint_temperature", "payload_com")
        return ArmSample(
            host_ns=time.monotonic_ns(),
            timestamp=float(state["timestamp"]),
            target_moment=np.array(state["torque"]),
            current=zeros,
            target_current=zeros,
            tcp_pose=np.array(state["flange"]),
            tcp_force=np.zeros(6),
            ft_raw_wrench=None,
            payload=float(state["payload"]),
            speed_scaling=1.0,
            safety=str(state["safety"]),
            **{name: np.array(state[name]) for name in names},
        )

    def take_control(self, mass: float, com: Floats) -> None:
        """Take control of the arm, and set its payload, kg and m."""
        self._ours = True
        self.set_payload(mass, com)

    def set_payload(self, mass: float, com: Floats) -> None:
        """Set the payload, kg and m (flange axes)."""
        self._ask("payload", mass=float(mass), com=np.asarray(com, dtype=float).tolist())

    def start_move(self, q: Floats, speed: float, acceleration: float) -> None:
        """Start a straight line in joint space; `speed`: of the leading joint."""
        if not self._ours:
            raise DeviceError("arm: a motion without control; call take_control first")
        self._ask("move", q=q.tolist(), speed=float(speed), acceleration=float(acceleration))

    def moving(self) -> bool:
        """Whether the arm is moving."""
        state = self._ask("sample")
        if state["safety"] != "normal":
            raise DeviceError(f"arm: {state['safety']}; release it, then go on with --resume")
        return bool(state["moving"])

    def stop(self) -> None:
        """Stop the arm and wait until it stands."""
        self._ask("stop")
        end = time.monotonic() + _STOPPED_S
        while self._ask("sample")["moving"]:
            if time.monotonic() > end:
                raise DeviceError(f"arm: it has not stopped within {_STOPPED_S:g} s")
            time.sleep(0.01)

    def close(self) -> None:
        """Stop the arm if it is under control."""
        if self._ours:
            with contextlib.suppress(DeviceError):
                self._ask("stop")
        self._ours = False

    def _ask(self, op: str, **arguments: Any) -> Any:
        try:
            return admin.ask(self._socket, op, **arguments)
        except DeviceError as error:
            raise DeviceError(f"arm: {error}") from None


def open_arm(config: CellConfig) -> SimulatedArm:
    """Return the simulated arm of a configuration, whose [robot] options name its `socket`."""
    socket = config.robot.options.get("socket")
    if not isinstance(socket, str) or not socket:
        raise InputError(
            "[robot] options lacks socket: the simulated arm lives in a simulated cell "
            "(hilcal run --rehearse, hilcal simulate); a real arm needs the driver of its maker"
        )
    arm = SimulatedArm(Path(socket))
    arm.sample()
    return arm


def start(options: admin.Arguments) -> admin.Device:
    """Return the controller of the arm in DIR/world.json."""
    world, _ = read_world(options.directory / "world.json")
    board = Blackboard(options.directory / "world.bin")
    controller = ArmController(world.cell.arm, board, np.random.default_rng(options.seed))
    controller.step()
    names = ("move", "stop", "payload", "jog", "protective_stop", "release", "sample")
    functions = {name: getattr(controller, name) for name in names}

    def step() -> None:
        time.sleep(_STEP_S if controller.step() else _REFRESH_S)

    return admin.Operations(functions, controller.sample), step


if __name__ == "__main__":
    admin.run(__doc__, "arm", start)
