"""`guide_error`: the guide of a slide is not straight, its carriage tilts, its scale is off."""

from typing import ClassVar

import numpy as np
from numpy.polynomial.legendre import legvander

from hilcal.cell import Cell
from hilcal.effects.link_geometry import AXES
from hilcal.effects.protocol import Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States

USUAL_ORDERS, MOST_ORDERS = 4, 12
STRAIGHTNESS, SCALE, TILT = 2e-5, 5e-5, 5e-5
"""Ordinary amplitudes: 20 µm across the travel, 50 µm along it at either end, 50 µrad. Guides of
machine tools are better, rack-driven tracks of robots worse; a choice."""


class GuideError(Effect):
    """Motion errors of a slide over its travel: a small rigid motion of its carriage.

        x, y = Σ_k a_k P_k(s), k = 2..K     z = a_1 s     rx, ry, rz = Σ_k b_k P_k(s), k = 1..K

    with s = −1 at the lower and 1 at the upper limit of the travel and Legendre's polynomials P_k,
    in axes with z along the travel, about the point of the carriage that lies on the joint's axis.
    Constant terms and the direction of the travel belong to `link_geometry`, waves along the travel
    to `transmission_error`. Units m and rad. Source of the names: ISO 230-1, error
    motions of a linear axis (positioning, straightness, roll, pitch and yaw).
    """

    name = "guide_error"
    summary = "carriage of a slide moves by Σ a_k P_k(travel): straightness, tilts and scale"
    plausible = 50.0  # 1 mm and 2.5 mrad at either end, as of a track laid by hand. A choice.
    option_help: ClassVar = {"orders": f"K, 1 to {MOST_ORDERS}; unless given, {USUAL_ORDERS}."}

    @classmethod
    def applies(cls, cell: Cell) -> bool:
        """Whether a joint of the arm slides."""
        return bool(cell.arm.slides.any())

    def setup(self, states: States) -> None:
        """Read the order; find the slides."""
        arm = self.cell.arm
        if not self.applies(self.cell):
            raise InputError(f"effect {self.name}: no joint of {arm.name} slides")
        k = self.options.setdefault("orders", USUAL_ORDERS)
        if isinstance(k, bool) or not isinstance(k, int) or not 1 <= k <= MOST_ORDERS:
            raise InputError(f"effect {self.name}: orders = {k!r}; valid: 1 to {MOST_ORDERS}")
        self.orders = k
        straightness = [(axis, i) for axis in "xy" for i in range(2, k + 1)]
        tilts = [(turn, i) for turn in AXES[3:] for i in range(1, k + 1)]
        self._terms = (*straightness, ("z", 1), *tilts)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Amplitudes of each slide's motions."""
        sizes = {"x": STRAIGHTNESS, "y": STRAIGHTNESS, "z": SCALE}
        return tuple(
            Parameter(
                f"j{j + 1}.{kind}{k}",
                "m" if kind in sizes else "rad",
                sizes.get(kind, TILT),
                f"{kind} of the carriage of joint {j + 1}, order {k} of its travel",
            )
            for j in np.flatnonzero(self.cell.arm.slides)
            for kind, k in self._terms
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Twist of slot j by each amplitude, at the slot's origin: v = d − ω × (q z)."""
        arm, count = self.cell.arm, len(self._terms)
        travel = np.asarray(arm.chain_angles(s.values))
        element = np.repeat(np.flatnonzero(arm.slides), count)
        values = np.zeros((len(travel), len(element), 6))
        for n, j in enumerate(np.flatnonzero(arm.slides).tolist()):
            # The limits are those of the controller's value; a coupling leaves the base as it is.
            low, high = arm.q_min[j], arm.q_max[j]
            waves = legvander((2 * s.values[:, j] - low - high) / (high - low), self.orders)
            for p, (kind, k) in enumerate(self._terms, start=n * count):
                values[:, p, AXES.index(kind)] = waves[:, k]
            of_slide = values[:, n * count : (n + 1) * count]
            of_slide[..., 0] -= of_slide[..., 4] * travel[:, None, j]
            of_slide[..., 1] += of_slide[..., 3] * travel[:, None, j]
        return (Columns("twist", np.arange(len(element)), element, values),)
