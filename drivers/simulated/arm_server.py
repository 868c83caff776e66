"""A simulated controller of an arm of any number of joints, also of slides; admin `arm.sock`.

    python -m hilcal.drivers.simulated.arm_server --directory DIR [--seed N]

DIR/world.json says which arm. It speaks no maker's protocol: `hilcal.drivers.simulated.arm` asks it
on its admin line, so that any arm can be rehearsed. Operations:
`sample`, `move {q, speed, acceleration}`,
`stop`, `payload {mass, com}`, `state`, `jog {q}` as somebody who moves the arm by hand,
`protective_stop`, `release`, `die`. A motion stops where nobody asks for half a second.
"""

import sys
import threading
import time
from typing import Any

import numpy as np

from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.ur.state import Kinematics, Trajectory, WorldClock, pose
from hilcal.drivers.simulated.world_server import read_world
from hilcal.errors import DeviceError, HilcalError
from hilcal.robot.arm import Arm
from hilcal.types import Floats

WATCHDOG_S = 0.5
"""A motion that nobody has looked at for so long is stopped, real s."""
PROTECTIVE = "protective stop"
_STEP_S, _REFRESH_S = 0.004, 0.01  # real s between steps in motion, and at rest
_STOPPING = 2.0  # rad/s² of the leading joint (a slide: m/s²)


class ArmController:
    """The trajectory of the arm, and who may command it; every method from any thread."""

    def __init__(self, arm: Arm, board: Blackboard, rng: np.random.Generator) -> None:
        """Take over where the arm stood, or was told to begin."""
        kept = board.read("arm")
        self._board, self._clock, self._lock = board, WorldClock(board), threading.RLock()
        self._arm, self._kinematics = arm, Kinematics(arm)
        side = kept["side"] if kept["alive"] else rng.choice([-1.0, 1.0], arm.n)
        arrivals = int(kept["arrivals"]) + bool(kept["moving"])
        self._motion = Trajectory(kept["q"], side, arrivals, self._clock.now)
        self._payload, self._com = float(kept["payload"]), kept["payload_com"].copy()
        self._safety, self._asked = "normal", time.monotonic()

    def step(self) -> bool:
        """Go on to now, and publish; returns whether the arm moves."""
        with self._lock:
            motion = self._motion
            if motion.moving and time.monotonic() - self._asked > WATCHDOG_S:
                motion.stop(_STOPPING, self._clock.now)
            motion.advance(self._clock.now)
            motion.publish(self._board, self._payload, self._com)
            return motion.moving

    def sample(self) -> dict[str, Any]:
        """Return what the controller knows of the arm now, as JSON can hold it."""
        with self._lock:
            self._asked = time.monotonic()
            self.step()
            motion, truth = self._motion, self._board.read("truth")
            told = int(truth["arrivals"]) == motion.arrivals and truth["flange"][3, 3] == 1.0
            q = truth["encoder"] if told and not motion.moving else motion.q
            return {
                "timestamp": self._clock.now,
                "q": q.tolist(),
                "q_target": motion.q.tolist(),
                "qd": motion.qd.tolist(),
                "moving": motion.moving,
                "torque": self._kinematics.weight_torque(q, self._payload, self._com).tolist(),
                "joint_temperature": truth["joint_temperature"].tolist(),
                "flange": pose(self._kinematics.flange(q)).tolist(),
                "payload": self._payload,
                "payload_com": self._com.tolist(),
                "safety": self._safety,
                "arrivals": motion.arrivals,
            }

    def move(self, q: list[float], speed: float, acceleration: float) -> None:
        """Begin a straight line in joint space.

        Raises:
            DeviceError: a safety stop, or a goal that the controller refuses.
        """
        goal = self._joints(q)
        with self._lock:
            if self._safety != "normal":
                raise DeviceError(f"the arm is in a {self._safety}")
            self._asked = time.monotonic()
            self._motion.start(goal, speed, acceleration, self._clock.now)

    def stop(self) -> None:
        """Stop the motion."""
        with self._lock:
            self._motion.stop(_STOPPING, self._clock.now)

    def payload(self, mass: float, com: list[float]) -> None:
        """Set what hangs at the flange, kg and m (flange axes)."""
        with self._lock:
            self._payload, self._com = float(mass), np.array(com, dtype=float)

    def jog(self, q: list[float]) -> None:
        """Stand elsewhere at once, as an arm that somebody has moved."""
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


def main() -> int:
    """Run until the parent ends; returns the exit code."""
    options = admin.device_parser(__doc__).parse_args()
    admin.end_with_parent()
    try:
        world, _ = read_world(options.directory / "world.json")
        board = Blackboard.attach(options.directory / "world.bin")
    except HilcalError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    controller = ArmController(world.cell.arm, board, np.random.default_rng(options.seed))
    controller.step()
    asked = {
        name: getattr(controller, name)
        for name in ("move", "stop", "payload", "jog", "protective_stop", "release")
    }
    handler = admin.Operations({**asked, "sample": controller.sample}, controller.sample)
    admin.serve(options.directory / "arm.sock", handler)
    while True:
        time.sleep(_STEP_S if controller.step() else _REFRESH_S)


if __name__ == "__main__":
    sys.exit(main())
