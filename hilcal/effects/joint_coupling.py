"""`joint_coupling`: the motion of one joint moves another one."""

import re
from typing import ClassVar

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.robot.arm import possible_couplings

ABOUT, ALONG = np.eye(6)[5], np.eye(6)[2]  # twists of a slot about, along its joint's axis
_PAIR = re.compile(r"([0-9]{1,3}):([0-9]{1,3})")


class JointCoupling(Effect):
    """dq_j = Σ_i k_ji q_i, for the pairs (j, i) of the option `pairs` [rad].

    q are the controller's values, so that k_ji is the error of the coupling factor in the arm's
    description (`[robot] joint_coupling`, 0 where there is none); i = j is an error of a
    joint's own ratio.

    Unless given, the pairs are those of `possible_couplings`, couplings that arms have, and the own
    ratio of each joint that turns. Gears have whole numbers of teeth, but belts, scales and wrong
    figures in a description do not; the few harmonics of `transmission_error` that readings of some
    ten poses determine describe a slope badly. The ratio of a slide is that of `guide_error`.
    """

    name = "joint_coupling"
    summary = "dq_j = Σ k_ji q_i: a joint is taken along by another one"
    plausible = 50.0
    """0.01: a strain wave gear of ratio 100 whose reaction on the next joint is not compensated.
    More is a wrong description, which the gate before the fit names."""
    option_help: ClassVar = {
        "pairs": "which joint is taken along by which, as 3:2/6:5 for joint 3 by joint 2 and joint "
        "6 by joint 5; 4:4 is an error of joint 4's own ratio. Unless given, each joint by the one "
        "before it, the last joint by the last but two, and the own ratio of each that turns."
    }

    def log_std_prior(self, pool: int) -> tuple[float, float]:
        """A tenth of the ordinary size where the arm's description has no couplings.

        A joint that has a drive of its own, as those of collaborative arms, is not coupled.
        """
        mean, spread = super().log_std_prior(pool)
        return mean if self.cell.arm.coupling is not None else mean - float(np.log(10.0)), spread

    def setup(self, states: States) -> None:
        """Read the pairs."""
        n = self.cell.arm.n
        slides = self.cell.arm.slides
        alike = [(j, i) for j, i in possible_couplings(n) if slides[j - 1] == slides[i - 1]]
        alike = sorted([*alike, *((j + 1, j + 1) for j in range(n) if not slides[j])])
        usual = "/".join(f"{j}:{i}" for j, i in alike) or "1:1"
        text = self.options.setdefault("pairs", usual)
        pairs = _pairs(text, n)
        if not pairs:
            raise InputError(
                f"effect {self.name}: pairs = {text!r}; valid: pairs of joints 1 to {n}, each "
                "once, as 3:2/6:5 for joint 3 taken along by joint 2, joint 6 by joint 5"
            )
        self.options["pairs"] = "/".join(f"{j}:{i}" for j, i in pairs)
        self._pairs = np.array(pairs) - 1

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One factor per pair; 2e-4, a length of 0.04 mm in 200 mm of a parallelogram, is usual."""
        slides = self.cell.arm.slides
        units = {(False, True): "rad/m", (True, False): "m/rad"}
        return tuple(
            Parameter(
                f"j{j}.q{i}",
                units.get((bool(slides[j - 1]), bool(slides[i - 1])), "1"),
                2e-4,
                f"own ratio of joint {j}" if i == j else f"joint {j} per turn of joint {i}",
            )
            for j, i in self._pairs + 1
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Controller's values: ∂dq_j/∂k_ji = q_i, a turn of slot j − 1 about the joint's axis."""
        driven, driving = self._pairs.T
        axes = np.where(self.cell.arm.slides[driven, None], ALONG, ABOUT)
        twist = s.values[:, driving, None] * axes
        return (Columns("twist", np.arange(len(driven)), driven, twist),)


def _pairs(text: object, n: int) -> list[tuple[int, int]]:
    """Return the pairs (j, i) that are written, or none where they are not valid."""
    matches = [_PAIR.fullmatch(p.strip()) for p in text.split("/")] if isinstance(text, str) else []
    pairs = sorted((int(p[1]), int(p[2])) for p in matches if p)
    good = len(pairs) == len(matches) == len(set(pairs))
    return pairs if good and all(1 <= k <= n for p in pairs for k in p) else []
