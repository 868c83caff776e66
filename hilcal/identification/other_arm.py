"""Whether the readings are those of another arm of the catalogue.

Arms of one size differ by millimetres from one generation to the next, and registration hides part
of that: readings of a UR10 leave some 4 mm with the description of a UR10e, which is not too much
for an arm before calibration. So every arm of the catalogue with as many joints is registered to
the readings as the described one was.

With e the displacements by the errors of the true arm and d those from one description to the
other, the frames projected off, the wrong description leaves |e + d| and the right one |e|. One
that leaves less than half of what the described one leaves is named. For the described arm to be
the right one then, |e − d| ≤ |e|/2: its errors would be larger than 2/3 |d|, and lie along d.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.errors import CannotAnswerError
from hilcal.identification.registration import Registration, angles, register, seen_of
from hilcal.identification.rigid_frames import Frames, Free, minimise
from hilcal.readings.readings import Readings
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.chain import evaluate
from hilcal.robot.conventions import as_counted
from hilcal.types import Ints

HALF = 0.5
"""Share of the described arm's misfit that another one may leave to be named. A choice: of 900
simulated arms off by 1 and 3 mm and mrad none was named another one
(`tests/unit/identification/test_other_arm.py` keeps a part of them)."""
BEYOND_NOISE = 3.0
"""Misfit in standard deviations of the readings from which on other arms are tried; a choice."""
ROWS = 100
"""Readings that every arm is tried on; the best is registered to all. A choice."""
STEPS = 10
"""Gauss-Newton steps of a registration, from the frames of the described arm; a choice."""


@dataclass(frozen=True, slots=True)
class OtherArm:
    """An arm of the catalogue that fits better than the described one.

    Attributes:
        name: its name.
        rms: what the described arm leaves after registration, m.
        rms_with: what this one leaves, m.
    """

    name: str
    rms: float
    rms_with: float

    def to_json(self) -> dict[str, object]:
        """Return its JSON."""
        return {"arm": self.name, "rms_m": self.rms, "rms_with_m": self.rms_with}


def other_arm(registered: Registration, readings: Readings) -> OtherArm | None:
    """Return the arm of the catalogue that these readings are of; None where none fits better.

    Args:
        registered: the registration of the described arm.
        readings: the readings.
    """
    noise = float(np.sqrt(np.mean(np.trace(readings.covariance[:, :3, :3], axis1=1, axis2=2))))
    cell = registered.cell
    if registered.rms <= BEYOND_NOISE * noise:
        return None
    tried = {arm.name: _left(cell, arm, readings[_spread(readings)]) for arm in _others(cell)}
    if not tried:
        return None
    name = min(tried, key=lambda k: tried[k])
    if tried[name] > HALF * registered.rms:
        return None
    arm = next(a for a in _others(cell) if a.name == name)
    left = _left(cell, arm, readings)
    return OtherArm(name, registered.rms, left) if left <= HALF * registered.rms else None


def other_arm_of(cell: Cell, readings: Readings) -> OtherArm | None:
    """Register the described arm, and return the one that fits better; see `other_arm`."""
    try:
        return other_arm(register(cell, readings), readings)
    except CannotAnswerError:
        return None


def _spread(readings: Readings) -> Ints:
    return np.unique(np.linspace(0, len(readings) - 1, ROWS).astype(int))


def _others(cell: Cell) -> Iterator[Arm]:
    """Yield the other arms of the catalogue with as many joints, as the controller counts them."""
    robot = None if cell.config is None else cell.config.robot
    for name in robot_names():
        arm = load_arm(name)
        if name != cell.arm.name and arm.n == cell.arm.n:
            yield arm if robot is None else as_counted(arm, robot)


def _left(cell: Cell, arm: Arm, readings: Readings) -> float:
    """Rms misfit of the positions with another arm, from the frames of the described one, m."""
    chain = evaluate(arm, angles(readings))
    seen = seen_of(readings, chain.rotation[-1], chain.position[-1])
    given = Frames(cell.registration, cell.all_targets)
    free = Free.of(not cell.registration_known, ~np.array(cell.known_targets), seen.m == 6)
    off = minimise(seen, given, free, steps=STEPS).off
    return float(np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1))))
