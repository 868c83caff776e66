"""The simulated arm at rest, as the input of hidden laws."""

from dataclasses import dataclass

import numpy as np

from hilcal.drivers.simulated.mechanics import Equilibrium
from hilcal.drivers.simulated.world import World
from hilcal.readings.readings import States
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The arm at rest in N states.

    Attributes:
        states: the states.
        rest: equilibrium of the simulated arm.
        torque: (N, n) torque of the drives, N·m.
        place: (N, 3) position of the target, base axes, m.
        seen: (N, 3) position of the target, sensor axes, m.
        by_joint: (N, 3, n) motion of the target by each drive, sensor axes.
        view: (3, 3) base axes in sensor axes.
        before: scene of the first campaign with the law; None for the first campaign itself.
    """

    states: States
    rest: Equilibrium
    torque: Floats
    place: Floats
    seen: Floats
    by_joint: Floats
    view: Floats
    before: "Scene | None" = None

    @property
    def first(self) -> "Scene":
        """Scene that determines the constants of a law, so that fresh poses have the same law."""
        return self.before or self

    def of_joint(self, j: int, angle: Floats) -> Floats:
        """(N, 3) displacement by an error (N,) of joint j (from 1), rad."""
        return np.asarray(self.by_joint[:, :, j - 1] * angle[:, None])

    def in_base(self, shift: Floats) -> Floats:
        """(N, 3) displacement in sensor axes, from one in base axes."""
        return np.asarray(shift @ self.view.T)


def scene(world: World, states: States, before: Scene | None = None) -> Scene:
    """Return the arm at rest.

    Args:
        world: the simulated arm.
        states: the states.
        before: scene of the first campaign with the same law, if this is another one.
    """
    rest, sight = world.equilibrium(states), world.ideal_readings(states)
    flange = rest.flange
    place = flange[:, :3, 3] + flange[:, :3, :3] @ world.cell.target[:3, 3]
    return Scene(
        states, rest, world.drive_torque(states), place, sight.position, sight.jacobian[:, :3],
        world.registration[:3, :3], before,
    )  # fmt: skip
