"""Joints give way under load: about their axes, by the angle, in time, and across the axes."""

from typing import ClassVar

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.options import Options, choice, ordinary_give, rated_moments
from hilcal.effects.per_joint import COMMON, EACH, PerJoint, TorqueLaw
from hilcal.effects.protocol import Changeable, Columns, Parameter, Response, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats


class JointCompliance(TorqueLaw):
    """dq_j = c_j τ_j, a compliance of each joint [rad/(N·m)]; of a slide c_j f_j [m/N]."""

    name = "joint_compliance"
    unit, meaning = "rad/(N·m)", "compliance of {joint}"
    summary = "dq_j = c_j τ_j: each joint gives way in proportion to its torque"
    change = Changeable(
        "joint", words="compliance", cause="wear, crash or repair?", listed=True, with_others=True
    )
    plausible = 10.0  # 30 mrad at the rated torque; gears state 1 to 5. A choice.
    spread = 0.5  # Springs and oil of one type of gear scatter by a third; a choice
    role = "baseline"

    def ordinary(self) -> Floats:
        """3 mrad (0.1 mm) at the rated torque (force)."""
        return ordinary_give(self.cell) / self.cell.arm.ratings

    def of_torque(self, s: Situation) -> tuple[Floats, Floats]:
        """Return τ_j, and 1."""
        return s.torque, np.ones((1, self.cell.arm.n))

    def compliance(self, theta: Floats) -> Floats:
        """Return c itself: `creep` builds on it."""
        return self.of_joints(theta)


class JointStiffening(TorqueLaw):
    """dq_j = s_j τ_j³ in addition to the linear term; a gear that stiffens has s_j < 0."""

    name = "joint_stiffening"
    unit, meaning = "rad/(N·m)³", "stiffening of {joint}"
    summary = "dq_j = s_j τ_j³: compliance changes with the torque (s_j < 0: stiffens)"
    plausible = 10.0  # 30 mrad at the rated torque, as for joint_compliance. A choice.

    def ordinary(self) -> Floats:
        """As much as the compliance at the joint's rated torque."""
        return ordinary_give(self.cell) / self.cell.arm.ratings**3

    def of_torque(self, s: Situation) -> tuple[Floats, Floats]:
        """Return τ_j³, and 3 τ_j²."""
        return s.torque**3, 3 * s.torque**2


MOST_ORDER = 1000


class PeriodicJointCompliance(PerJoint):
    """dq_j = τ_j Σ_k (a_jk cos k q_j + b_jk sin k q_j) beside the mean c_j τ_j [rad/(N·m)].

    Joints that share parameters have the same phase at their zeros.
    """

    name = "periodic_joint_compliance"
    summary = "dq_j = τ_j (a_j cos 2q_j + b_j sin 2q_j): compliance changes with the joint angle"
    plausible = 10.0  # Twice an ordinary compliance; more would make it negative. A choice.
    elastic = True
    local_response = True
    option_help: ClassVar = {
        **PerJoint.option_help,
        "orders": "periods k per turn of the joint, a list of whole numbers, 1 to 1000; unless "
        "given, [2]: the two-lobed wave generator of a strain wave gear.",
    }

    def setup(self, states: States) -> None:
        """Read the orders."""
        super().setup(states)
        orders = self.options.setdefault("orders", [2])
        if (
            not isinstance(orders, list | tuple)
            or not orders
            or len(set(orders)) < len(orders)
            or not all(type(k) is int and 1 <= k <= MOST_ORDER for k in orders)
        ):
            raise InputError(
                f"effect {self.name}: orders = {orders!r}; valid: a list of different whole "
                f"numbers, 1 to {MOST_ORDER}"
            )
        self.orders = np.array(orders)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Two per joint and order; a fifth of an ordinary compliance."""
        kinds = {f".{w}{k}": f"{w} {k} q" for k in self.orders for w in ("cos", "sin")}
        meaning = "part of the compliance of {joint} that goes with {kind}"
        ordinary = np.where(self.cell.arm.slides, 2e-5, 6e-4) / self.cell.arm.ratings
        return self.group_parameters("rad/(N·m)", ordinary, meaning, kinds)

    def _waves(self, s: Situation) -> Floats:
        """(N, n, 2 K) cosine and sine of each order."""
        phase = s.angle[:, :, None] * self.orders
        waves = np.stack([np.cos(phase), np.sin(phase)], axis=-1)
        return waves.reshape(*s.angle.shape, -1)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Torque times wave: ∂dq_j/∂a_jk = τ_j cos k q_j."""
        return (self.kind_columns(s.torque[:, :, None] * self._waves(s)),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return the compliance at the angle times dτ_j."""
        amplitudes = self.of_joints(theta.reshape(-1, 2 * len(self.orders)))
        compliance = np.sum(self._waves(s) * amplitudes, axis=2)
        return Response(dq=s.along(change) * compliance[:, None, :])


SECOND = 1.0  # Unit of time of the law, s


class Creep(TorqueLaw):
    """dq_j = k c_j τ_j log10(1 + t/1 s), t the time under the present load [1 per decade].

    c_j is the joint's compliance: the model's `joint_compliance`, or where the model has
    none a typical one from the joint's rated torque.

    `form`, "common" or "each", is an older name of `joints`.
    """

    name = "creep"
    unit, size, meaning = "1", 0.02, "creep of {joint} per decade of time"
    summary = "dq_j = k c_j τ_j log10(1 + t/1 s): joints go on giving way under the load"
    plausible = 10.0  # 20 % per decade of time: polymers; metals creep by less than 2 %. A choice.
    needs = ("load_time",)
    usual_joints = COMMON
    option_help: ClassVar = {
        "joints": 'which joints share a k: "common", all of them, "each" its own, or groups as '
        "2/3/4-6 (2+5 for joints apart); joints that are not named do not creep. Unless given, "
        "common."
    }

    def __init__(self, cell: Cell, states: States, options: Options | None = None) -> None:
        """Build the effect; raises InputError as every effect does."""
        chosen = dict(options or {})
        if "form" in chosen:
            form = choice(self.name, chosen, "form", (COMMON, EACH))
            if "joints" in chosen:
                raise InputError(f"effect {self.name}: form and joints; valid: joints alone")
            chosen = {**{k: v for k, v in chosen.items() if k != "form"}, "joints": form}
        super().__init__(cell, states, chosen)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The share of the elastic twist that every decade of time adds."""
        if self.shared.text == COMMON:
            return (Parameter("k", "1", self.size, "creep of all joints per decade of time"),)
        return super().parameters

    def _decades(self, s: Situation) -> Floats:
        assert s.states.load_time is not None  # noqa: S101 - checked at construction
        return np.asarray(np.log10(1 + s.states.load_time / SECOND))[:, None]

    def of_torque(self, s: Situation) -> tuple[Floats, Floats]:
        """Return c_j τ_j log10(1 + t/1 s), and c_j log10(1 + t/1 s)."""
        decades = self._decades(s)
        return s.compliance * s.torque * decades, s.compliance * decades

    def compliance_columns(self, theta: Floats, s: Situation) -> tuple[Columns, ...]:
        """Return ∂dq_j/∂c_j = k τ_j log10(1 + t/1 s)."""
        joints = np.arange(self.cell.arm.n)
        values = self.of_joints(theta) * s.torque * self._decades(s)
        return (Columns("dq", joints, joints, values),)


ACROSS = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
TURNS = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])


class JointTiltCompliance(PerJoint):
    """Rotation at p_j of k_j (t_j − z_j z_jᵀ t_j), a compliance of each joint [rad/(N·m)].

    The carriage of a slide turns about all three axes, about its point on the joint's axis, by the
    moment there: with q the travel, t = t_j − q z_j × f_j.
    """

    name = "joint_tilt_compliance"
    summary = "rotation k_j t_j⊥ at joint j: its bearing tilts under the moment across its axis"
    change = Changeable("joint", words="tilt compliance", cause="wear or crash?")
    plausible = 10.0  # 10 mrad at the rated torque; cross-roller bearings state under 1. A choice.
    elastic = True
    local_response = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One tilt compliance per joint; 1 mrad at the joint's rated torque is ordinary."""
        ordinary = 1e-3 / rated_moments(self.cell)
        meaning = "tilt compliance of {joint}"
        return self.group_parameters("rad/(N·m)", ordinary, meaning, of_drive=False)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Twist of slot j by the moment across the axis; slot axes have z along it."""
        return (self.joint_columns("twist", self._tilt(s.wrench[:, :-1], self._travel(s))),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Rotation k_j dt_j⊥."""
        k = np.append(self.of_joints(theta), 0.0)
        if not self.cell.arm.slides.any():
            return Response(twist=change * (k[:, None] * ACROSS))
        turned = self._tilt(change[:, :, :-1], self._travel(s)[:, None])
        return Response(twist=np.pad(turned, ((0, 0), (0, 0), (0, 1), (0, 0))) * k[:, None])

    def _travel(self, s: Situation) -> Floats:
        """(N, n) displacements of the slides, m; 0 of joints that turn."""
        return np.asarray(self.cell.arm.chain_angles(s.values) * self.cell.arm.slides)

    def _tilt(self, w: Floats, travel: Floats) -> Floats:
        """Twists (..., n, 6) of the slots by wrenches there, for a compliance of 1."""
        slides = self.cell.arm.slides
        if not slides.any():
            return np.asarray(w * ACROSS)
        turned = w * np.where(slides[:, None], TURNS, ACROSS) + 0.0 * travel[..., None]
        turned[..., 3] += travel * w[..., 1]
        turned[..., 4] -= travel * w[..., 0]
        turned[..., 0], turned[..., 1] = -travel * turned[..., 4], travel * turned[..., 3]
        return np.asarray(turned)
