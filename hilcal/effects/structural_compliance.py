"""Links, the base and the tool give way."""

from abc import abstractmethod

import numpy as np

from hilcal.effects.options import rated_moments
from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Response, Situation
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints


class SlotCompliance(Effect):
    """Twist θ_p L_p w of a slot by the wrench w there, for each parameter θ_p."""

    elastic = True
    local_response = True

    @abstractmethod
    def laws(self) -> tuple[Ints, Floats]:
        """Slots (P,) and L (P, 6, 6), in the axes of the slot."""

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Twist of each slot by the wrench there, for a unit of each parameter."""
        slots, laws = self.laws()
        values = np.stack([s.wrench[:, k] @ x.T for k, x in zip(slots, laws, strict=True)], axis=1)
        return (Columns("twist", np.arange(len(slots)), slots, values),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Twist of each slot by the change of the wrench there."""
        twist = np.zeros_like(change)
        for k, law, t in zip(*self.laws(), theta, strict=True):
            twist[:, :, k] += change[:, :, k] @ (t * law.T)
        return Response(twist=twist)


class LinkCompliance(SlotCompliance):
    """Each long link is a cantilever from joint k, along L_k, with its tip at slot k.

    With d the unit vector along the link, L its length, F and M what everything beyond the
    tip exerts there, ⊥ for across d, and the parameters bend = 1/EI and twist = 1/GJ:

        displacement = bend (L³/3 F⊥ + L²/2 M × d)
        rotation     = bend (L²/2 d × F + L M⊥) + twist L d (d·M)

    The link's own weight does not bend it. Long links are the two longest between two joints,
    without one that is less than a third of the longest (upper arm and forearm). Units
    1/(N·m²). Source: Euler-Bernoulli beam, e.g. Gere and Timoshenko, *Mechanics of
    Materials*, table of deflections of cantilevers.
    """

    name = "link_compliance"
    summary = "tip moves L³/3EI F + L²/2EI M, turns L²/2EI F + L/EI M, twists L/GJ M: links bend"
    plausible = 10.0  # Ten times as soft as a link of ordinary section, see `parameters`. A choice.

    @property
    def links(self) -> Ints:
        """(b,) numbers k of the long links L_k."""
        return long_links(self.cell.arm)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """1/EI and 1/GJ of each; 1 mrad at the tip by the rated torque of its joint."""
        rated = rated_moments(self.cell)
        out = []
        for k in self.links:
            length = float(np.linalg.norm(self.cell.arm.links[k, :3, 3])) or 1.0
            scale = 1e-3 / (rated[k - 1] * length)
            out.append(Parameter(f"link{k}.bend", "1/(N·m²)", scale, f"1/EI of link {k}"))
            out.append(Parameter(f"link{k}.twist", "1/(N·m²)", scale, f"1/GJ of link {k}"))
        return tuple(out)

    def laws(self) -> tuple[Ints, Floats]:
        """Twist of the tip by its wrench: bending and twist of each link."""
        out = []
        for k in self.links:
            along = self.cell.arm.links[k, :3, :3].T @ self.cell.arm.links[k, :3, 3]
            length = float(np.linalg.norm(along))
            d = along / (length or 1.0)
            across, turn = np.eye(3) - np.outer(d, d), se3.skew(d)
            bend, twist = np.zeros((6, 6)), np.zeros((6, 6))
            bend[:3, :3], bend[:3, 3:] = length**3 / 3 * across, -(length**2) / 2 * turn
            bend[3:, :3], bend[3:, 3:] = length**2 / 2 * turn, length * across
            twist[3:, 3:] = length * np.outer(d, d)
            out += [bend, twist]
        return np.repeat(self.links, 2), np.array(out)


def long_links(arm: Arm) -> Ints:
    """(b,) numbers k, at most two, of the links L_k that bend; n where none has a length."""
    lengths = np.linalg.norm(arm.links[1:-1, :3, 3], axis=1)
    if not np.any(lengths):
        return np.array([arm.n])
    longest = np.argsort(-lengths, kind="stable")[:2]
    long = longest[lengths[longest] > lengths.max() / 3]
    return np.asarray(np.sort(long) + 1)


class BaseCompliance(SlotCompliance):
    """Rotation B t_0 of the whole arm about the base origin; B diagonal, rad/(N·m).

    t_0 is the moment about the base origin, base axes. Slot 0 is the frame of the first
    joint, so moments are carried to the base origin and rotations back by L_0, exactly.
    """

    name = "base_compliance"
    summary = "rotation B t_0 about the base origin: the ground gives way"
    change = Changeable("base", "base", "the ground under the base", "loose bolts?")
    plausible = 30.0  # 90 µrad/(N·m): an arm on a trolley. A choice.
    parameters = tuple(
        Parameter(axis, "rad/(N·m)", 3e-6, f"rotation of the base about {axis}") for axis in "xyz"
    )

    def laws(self) -> tuple[Ints, Floats]:
        """Twist of slot 0 by the rotation about each base axis that the moment about it causes."""
        l0 = self.cell.arm.links[0]
        back, r = se3.inverse(l0), l0[:3, :3]
        moments = np.hstack([se3.skew(l0[:3, 3]) @ r, r])
        twists = se3.adjoint(back[:3, :3], back[:3, 3])[:, 3:]
        return np.zeros(3, dtype=np.int64), np.einsum("ia,aj->aij", twists, moments)


class ToolCompliance(SlotCompliance):
    """Rotation at the flange of a t_z z + c t_⊥, t the moment there: adapter, sensor, changer.

    t is the moment about the flange's origin of tool and load; a (along) and c (across the
    flange's z axis) in rad/(N·m). Where the last joint turns about z, a is the same as that
    joint's compliance.
    """

    name = "tool_compliance"
    summary = "rotation a t_z + c t_⊥ at the flange: tool or force sensor tilts under the moment"
    change = Changeable("tool", "tool", "the stiffness of what is bolted to the flange")
    plausible = 30.0  # 30 mrad at the rated torque of the last joint: a slender tool. A choice.
    of_setup = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Along and across; 1 mrad at the rated torque of the last joint is ordinary."""
        scale = 1e-3 / float(rated_moments(self.cell)[-1])
        return (
            Parameter("along", "rad/(N·m)", scale, "turn about the flange's z axis"),
            Parameter("across", "rad/(N·m)", scale, "tilt across the flange's z axis"),
        )

    def laws(self) -> tuple[Ints, Floats]:
        """Twist of slot n by the moment at the flange, about z and across it."""
        parts = np.diag([0, 0, 0, 0, 0, 1.0]), np.diag([0, 0, 0, 1.0, 1.0, 0])
        return np.full(2, self.cell.arm.n), np.array(parts)
