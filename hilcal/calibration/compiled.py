"""A model brought into the form that the compiled kernel evaluates, where it has that form.

What an effect does is found by asking it, not by its name: its deviation at random states and
wrenches is compared with

    dq_j = a_j + T_j(q_j) + Σ_i L_ji q_i + c_j · w_j + (s_j + P_j(q_j)) τ_j + G_j(τ_j)
    ξ_k = b_k + Q_k q + C_k w_k

(tables T, P, G by cubic splines). An effect that needs times, temperatures or sides of approach
gives a, b and s of each point, see `form`. One of another form is not compiled; the model is
then evaluated as everywhere else, some hundred times slower.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilcal.calibration.compensation import MOST_TURN, TOLERANCE
from hilcal.calibration.form import TRIALS, CompiledForm, given_the_columns, packed, repeated
from hilcal.calibration.tool import ToolPose, in_chain
from hilcal.effects.protocol import FRAME_ROLES, Effect, Situation
from hilcal.optional import install
from hilcal.readings.readings import States
from hilcal.readings.whitening import Mode
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Compiled:
    """Arrays for `kernel.invert_all`."""

    arm: tuple[Floats, ...]  # links and centres of mass
    load: tuple[Any, ...]  # where the load acts, and all weights
    laws: tuple[Floats, ...]  # constants and compliances
    tables: tuple[Any, ...]  # of what depends on one angle, or one torque
    tool: ToolPose  # where it is on the flange, and where the base is
    nominal: tuple[tuple[Floats, ...], tuple[Any, ...]]
    """The same laws with nothing in them, of the nominal arm."""
    reach: float  # m
    mode: Mode  # kind of readings that the model was fitted to
    by_point: tuple[tuple[Effect, Floats], ...]
    """Effects that need times, temperatures or sides of approach, with their parameters."""
    one: Situation  # a state, for these effects

    def compensate(
        self, states: States, goal: tuple[Floats, Floats] | None
    ) -> tuple[Floats, Floats]:
        """Joint values (N, n) and residuals (N, 2), m and rad.

        Args:
            goal: (N, 3, 3) wanted orientations and (N, 3) positions, m, base axes; those that the
                nominal arm (for deflections: the unloaded arm) has at q where None.
        """
        from hilcal.calibration.kernel import invert_all

        q, wrench, count = states.q, states.wrench, len(states)
        own = self._own(states)
        out, left = np.empty_like(q), np.zeros((count, 2))
        still = self.mode == "deflection"
        rotation, position = goal or (np.empty((count, 3, 3)), np.empty((count, 3)))
        if goal is None:
            laws, tables = (self.laws, self.tables) if still else self.nominal
            tool, nothing = self.tool.pose if still else self.tool.nominal, np.zeros((count, 6))
            none = own if still else _nothing(q.shape[1])
            invert_all(
                self.arm, self.load, laws, tables, none, packed(tool), self.reach, MOST_TURN,
                TOLERANCE, q, nothing, rotation, position, False, out, left,
            )  # fmt: skip
        if goal is not None or not still:
            rotation, position = in_chain(self.tool, rotation, position)
        invert_all(
            self.arm, self.load, self.laws, self.tables, own, packed(self.tool.pose), self.reach,
            MOST_TURN, TOLERANCE, q, wrench, packed(rotation), packed(position), True, out, left,
        )  # fmt: skip
        return out, left

    def _own(self, states: States) -> tuple[Floats, Floats, Floats]:
        """Displacements (N, n), twists (N, n + 1, 6) and compliances (N, n) of the points."""
        own = _nothing(states.q.shape[1])
        if not self.by_point:
            return own
        s = self.one if len(states) == 1 else repeated(self.one, len(states))
        s = replace(s, states=states, angle=states.q)
        dq, twist, soft = own
        for e, theta in self.by_point:
            d = e.deviation(theta, s)
            if e.elastic:
                soft = soft if d.dq is None else soft + d.dq
                continue
            dq = dq if d.dq is None else dq + d.dq
            twist = twist if d.twist is None else twist + d.twist
        return packed(dq), packed(twist), packed(soft)


def compiled(tool: ToolPose, mode: Mode) -> Compiled | tuple[str, ...]:
    """Return a model for the kernel; the names of what it has no form for where there is such."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return (f"numba, which is not installed ({install('numba')})",)
    model = tool.model
    arm, cell = model.cell.arm, model.cell
    if arm.n != 6 or arm.slides.any() or not (arm.drive is arm.coupling is None):
        return (f"{arm.name}'s joints (not six, coupled, or sliding)",)
    if tool.moving:
        return tuple(e.name for e, _ in tool.moving)
    s, form = _situation(tool), CompiledForm.empty(arm.n)
    first_moment, point = np.zeros((arm.n, 3)), cell.load_point
    by_point: list[tuple[Effect, Floats]] = []
    for e, mine in zip(model.effects, model.slices(), strict=True):
        theta = tool.theta[mine]
        if e.role in FRAME_ROLES or not theta.any():
            continue
        change = e.load_change(theta)
        if change is not None:
            point = point if change.point is None else point + change.point
            moments = change.first_moment
            first_moment = first_moment if moments is None else first_moment + moments
        elif e.needs and given_the_columns(e, theta, s):
            by_point.append((e, theta))
        elif not form.take(e, theta, s):
            return (e.name,)
    load = (
        packed(point), float(cell.tool_mass), packed(cell.tool_com), packed(cell.gravity),
        packed(arm.masses), first_moment, form.gain, form.bias,
    )  # fmt: skip
    links = (packed(arm.links[:, :3, :3]), packed(arm.links[:, :3, 3]), packed(arm.coms))
    bare = CompiledForm.empty(arm.n)
    nominal = bare.laws(), bare.tables()
    unit = np.zeros_like(s.wrench[:1])
    unit[..., 5] = 1.0
    one = replace(repeated(s, 1), wrench=unit)
    return Compiled(
        links, load, form.laws(), form.tables(), tool, nominal, float(arm.reach), mode,
        tuple(by_point), one,
    )  # fmt: skip


def _nothing(n: int) -> tuple[Floats, Floats, Floats]:
    """Return what points have where no effect gives them anything of their own."""
    return np.zeros((1, n)), np.zeros((1, n + 1, 6)), np.zeros((1, n))


def _situation(tool: ToolPose) -> Situation:
    """Return random states with every column, and random wrenches through their slots."""
    arm, rng = tool.model.cell.arm, np.random.default_rng(20250307)
    states = States(
        rng.uniform(-3, 3, (TRIALS, arm.n)),
        np.zeros((TRIALS, 6)),
        time=rng.uniform(0.0, 1e4, TRIALS),
        load_time=rng.uniform(0.0, 1e3, TRIALS),
        air_temperature=rng.uniform(15.0, 30.0, TRIALS),
        joint_temperature=rng.uniform(15.0, 50.0, (TRIALS, arm.n)),
        approach=np.sign(rng.standard_normal((TRIALS, arm.n))),
    )
    situation = tool.model.predict(states, np.zeros_like(tool.theta)).situation
    limit = np.where(np.isfinite(arm.torque_max), arm.torque_max, 100.0)
    wrench = rng.standard_normal((TRIALS, arm.n + 1, 6)) * np.append(limit, limit[-1])[:, None]
    wrench *= 10.0 ** rng.uniform(-4, 0, (TRIALS, 1, 1))  # laws may turn where torques are small
    compliance = tool.model._compliance(tool.theta)
    loads = replace(situation.states, wrench=100.0 * rng.standard_normal((TRIALS, 6)))
    return replace(situation, states=loads, wrench=wrench, compliance=compliance)
