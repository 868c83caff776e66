"""Errors of the unloaded arm: zeros, links, coupled joints, guides of slides."""

import re
from typing import ClassVar

import numpy as np
from numpy.polynomial.legendre import legvander

from hilcal.cell import Cell
from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.robot.conventions import may_follow


class EncoderOffset(PerJoint):
    """dq_j = o_j, constant [rad]."""

    name = "encoder_offset"
    unit, size, meaning = "rad", 1e-3, "zero offset of {joint}"
    summary = "dq_j = o_j: the zero of each joint is off"
    kinematic = True
    change = Changeable(
        "joint",
        words="zero",
        cause="repair, crash or a slipped joint?",
        listed=True,
        by_frame=True,
        with_others=True,
    )
    plausible = 5.0  # 5 mrad: mastering to a mark, without a gauge, leaves 0.1° to 0.5°. A choice.

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit steps: ∂dq_j/∂o_j = 1."""
        return (self.joint_columns("dq", np.ones((1, self.cell.arm.n))),)


AXES = ("x", "y", "z", "rx", "ry", "rz")


class LinkGeometry(Effect):
    """Constant twist of each link, in the axes of its end; over-complete on purpose.

    Six parameters for each of the n + 1 links. Many combinations are not identifiable (a shift
    along a joint's axis can be made before or after it); rank analysis drops those.
    """

    name = "link_geometry"
    summary = "constant displacement and rotation of each link's end (over-complete)"
    kinematic = True
    change = Changeable("link", words="geometry", cause="crash?")
    plausible = 3.0  # 3 mm, 3 mrad; links differ from drawings by 0.1 to 2. A choice.

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Displacements [m] and rotations [rad] of links 0..n."""
        return tuple(
            Parameter(f"link{k}.{axis}", "m" if i < 3 else "rad", 1e-3)
            for k in range(self.cell.arm.n + 1)
            for i, axis in enumerate(AXES)
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit twists of the slots."""
        slots = self.cell.arm.n + 1
        values = np.tile(np.eye(6), (slots, 1))[None]
        return (Columns("twist", np.arange(6 * slots), np.repeat(np.arange(slots), 6), values),)


ABOUT, ALONG = np.eye(6)[5], np.eye(6)[2]  # twists of a slot about, along its joint's axis
_PAIR = re.compile(r"([0-9]{1,3}):([0-9]{1,3})")


class JointCoupling(Effect):
    """dq_j = Σ_i k_ji q_i, for the pairs (j, i) of the option `pairs` [rad].

    q are the controller's values, so that k_ji is the error of the coupling factor in the arm's
    description (`[robot] joint_coupling`, 0 where there is none); i = j is an error of a
    joint's own ratio.

    Unless given, the pairs are those of `may_follow`: couplings that arms have. Errors of a joint's
    own ratio are not among them: gears have whole numbers of teeth, and the first harmonics of
    `transmission_error` describe a slope over the range of a joint.
    """

    name = "joint_coupling"
    summary = "dq_j = Σ k_ji q_i: a joint is taken along by another one"
    plausible = 50.0
    """0.01: a strain wave gear of ratio 100 whose reaction on the next joint is not compensated.
    More is a wrong description, which the gate before the fit names."""
    option_help: ClassVar = {
        "pairs": "which joint is taken along by which, as 3:2/6:5 for joint 3 by joint 2 and joint "
        "6 by joint 5; 4:4 is an error of joint 4's own ratio. Unless given, each joint by the one "
        "before it, and the last joint by the last but two."
    }

    def setup(self, states: States) -> None:
        """Read the pairs."""
        n = self.cell.arm.n
        slides = self.cell.arm.slides
        alike = [(j, i) for j, i in may_follow(n) if slides[j - 1] == slides[i - 1]]
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
        terms = [("x", i) for i in range(2, k + 1)] + [("y", i) for i in range(2, k + 1)]
        terms += [("z", 1)] + [(turn, i) for turn in AXES[3:] for i in range(1, k + 1)]
        self._terms = tuple(terms)

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
