"""`link_compliance`: the long links bend and twist like beams."""

import numpy as np

from hilcal.effects.options import rated_moments
from hilcal.effects.protocol import Parameter
from hilcal.effects.slot_compliance import SlotCompliance
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints


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
