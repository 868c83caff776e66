"""A program of waypoints, as it comes in on the script port: moves to joint values, and waits.

    def name():
      movej([q1, ..., q6], a=1.4, v=1.05, t=0, r=0)
      movel([q1, ..., q6], a=1.2, v=0.25)
      sleep(0.5)
    end

`movel` and `movep` go there in joint space, at a joint speed of v over 1 m: where they arrive is
right, the way is not. Blends (r) are left out: every waypoint is reached. Source: Universal Robots,
*The URScript Programming Language*.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drivers.simulated.ur.state import ArmState
from hilcal.types import Floats

SPEEDS = {"movej": (1.4, 1.05), "movel": (1.2, 0.25), "movep": (1.2, 0.25)}
"""Default acceleration and speed of the language."""
_LEVER = 1.0
"""Distance of the tool from a joint that turns tool speeds into joint speeds, m; a choice."""
_JOINT_LIMIT = 2.0 * np.pi + 1e-6
_MOVE = re.compile(r"(movej|movel|movep)\(\s*\[([^\]]*)\]\s*((?:,[^)]*)?)\)")
_SLEEP = re.compile(r"sleep\(\s*([0-9.eE+-]+)\s*\)")
_IGNORED = re.compile(r"(textmsg|set_tcp|set_payload|popup)\(.*\)|(?:global\s+)?\w+\s*=.*|end")


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A motion to joint values (6,), rad, with its speed and acceleration at the joints."""

    goal: Floats
    speed: float
    acceleration: float


class WaypointProgram:
    """A program of moves, while it plays."""

    watchdog = 0.0
    late = 0.0

    def __init__(self, text: str, arm: ArmState) -> None:
        """Read the program.

        Raises:
            ValueError: it has statements that are not emulated, or no moves.
        """
        self._arm = arm
        self._steps = list(_steps(text))
        if not any(isinstance(step, Move) for step in self._steps):
            raise ValueError("no waypoints")
        self._work = self._run()

    def poll(self) -> bool:
        """Do what there is to do; return whether the program goes on.

        Raises:
            ValueError: a motion that is refused: the program ends.
        """
        return next(self._work, False)

    def _run(self) -> Iterator[bool]:
        motion = self._arm.trajectory
        for step in self._steps:
            if isinstance(step, float):
                end = self._arm.clock.now + step
                while self._arm.clock.now < end:
                    yield True
                continue
            if self._arm.refuses_motion:
                raise ValueError("the motion is refused")
            motion.start(step.goal, step.speed, step.acceleration, self._arm.clock.now)
            self._arm.note(f"move to {np.round(step.goal, 6).tolist()}")
            while motion.moving:
                yield True


def _steps(text: str) -> Iterator[Move | float]:
    """Yield the moves, and the waits in s.

    Raises:
        ValueError: a statement that is not emulated.
    """
    for line in text.splitlines():
        statement = line.split("#")[0].strip()
        if not statement or re.match(r"def\s+\w+\(\s*\)\s*:", statement):
            continue
        move, sleep = _MOVE.fullmatch(statement), _SLEEP.fullmatch(statement)
        if move:
            yield _move(move[1], move[2], move[3])
        elif sleep:
            yield float(sleep[1])
        elif not _IGNORED.fullmatch(statement):
            raise ValueError(f"not emulated: {statement}")


def _move(function: str, numbers: str, options: str) -> Move:
    """Return a move.

    Raises:
        ValueError: no six joint values within the limits, or a speed that is none.
    """
    goal = np.array([float(x) for x in numbers.split(",")])
    if goal.shape != (6,) or not np.all(np.abs(goal) <= _JOINT_LIMIT):
        raise ValueError(f"no joint values: {numbers}")
    given = dict(re.findall(r"([avtr])\s*=\s*([0-9.eE+-]+)", options))
    acceleration, speed = (
        float(given.get(key, usual)) for key, usual in zip("av", SPEEDS[function], strict=True)
    )
    if not (0.0 < speed < np.inf and 0.0 < acceleration < np.inf):
        raise ValueError(f"move with speed {speed}, acceleration {acceleration}")
    lever = 1.0 if function == "movej" else _LEVER
    return Move(goal, speed / lever, acceleration / lever)
