"""`link_mass`: the links are not as heavy, or not balanced, as configured."""

import numpy as np

from hilcal.effects.protocol import (
    Changeable,
    Columns,
    Directions,
    Effect,
    LoadChange,
    Parameter,
    Situation,
)
from hilcal.robot.statics import first_moment_change
from hilcal.types import Floats


def tool_weight(effect: Effect) -> Directions:
    """Mass at the flange, and first moment of the last link: a tool that is heavier, or elsewhere.

    A mass δm at the origin of slot n is carried by every link before it: its first moments there
    are δm p_k, p_k (3,) the place of slot k in the axes of link k, k = 1..n.
    """
    arm = effect.cell.arm
    scale = np.array([0.1, 5e-3, 5e-3, 5e-3])
    matrix = np.zeros((3 * arm.n, 4))
    matrix[:, 0] = scale[0] * arm.links[1:, :3, 3].reshape(-1)
    matrix[-3:, 1:] = scale[1:] * np.eye(3)
    units = ("kg", "kg·m", "kg·m", "kg·m")
    return Directions("tool_weight", ("mass", "x", "y", "z"), units, scale, matrix)


class LinkMass(Effect):
    """First moment (mass × centre of mass) of link k is off by δ_k, link axes [kg·m].

    The weight exerts the moment (R_k δ_k) × g more about the origin of joint k. Link k is what
    joint k moves; its axes turn with that joint.
    """

    name = "link_mass"
    summary = "moment (R_k δ_k) × g at joint k: links are heavier or balanced otherwise"
    change = Changeable("tool", "tool", "the tool's weight", directions=tool_weight)
    for_missing_weight = True
    plausible = 20.0  # 1 kg·m: a fifth of the first moment of an upper arm of 20 kg. A choice.

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Three per link; half a kilogram at a decimetre is ordinary."""
        return tuple(
            Parameter(f"link{k + 1}.{a}", "kg·m", 5e-2, f"first moment of link {k + 1} along {a}")
            for k in range(self.cell.arm.n)
            for a in "xyz"
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """No deviation of its own."""
        return ()

    def load_change(self, theta: Floats) -> LoadChange:
        """First moments of the links."""
        return LoadChange(first_moment=theta.reshape(self.cell.arm.n, 3))

    def wrench_columns(self, theta: Floats, s: Situation) -> Floats:
        """Moments of unit first moments, carried by all joints up to the link's."""
        return first_moment_change(self.cell.arm, s.chain, s.load.gravity)

    def most(self) -> float:
        """As usual; infinite where the arm is described without masses."""
        return super().most() if np.any(self.cell.arm.masses) else np.inf
