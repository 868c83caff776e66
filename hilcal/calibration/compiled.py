"""A model brought into the form that the compiled kernel evaluates, where it has that form.

What an effect does is found by asking it, not by its name: its deviation at random states and
wrenches is compared with

    dq_j = a_j + T_j(q_j) + Σ_i L_ji q_i + c_j · w_j + G_j(τ_j),      ξ_k = b_k + C_k w_k

(tables T, G by cubic splines). An effect of another form, or that needs more than joint values and
wrench, is not compiled; the model is then evaluated as everywhere else, some hundred times slower.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from hilcal.calibration.compensation import MOST_TURN, TOLERANCE
from hilcal.calibration.tool import Tool, in_chain
from hilcal.data.readings import States
from hilcal.data.whitening import Mode
from hilcal.effects.protocol import FRAME_ROLES, Effect, Situation
from hilcal.robot.deviation import Deviation
from hilcal.types import Floats

TURN = 2 * np.pi
"""Angles of the tables reach from −TURN to TURN."""
NODES = 16385
"""Nodes of a table over angles: 120 waves per turn with amplitudes of 0.1 mrad are met to 1e-11."""
TORQUE_NODES = 40001
TORQUES = 3.0
"""Tables over torques reach to so many times the joint's limit."""
TRIALS = 64
EXACT = 1e-12
"""How far the form may be off, rad and m, for an effect to count as of that form."""


@dataclass(frozen=True, slots=True, eq=False)
class Compiled:
    """Arrays for `kernel.invert_all`.

    Attributes:
        arm: links and centres of mass.
        load: where the load acts, and all weights.
        laws: constants and compliances.
        tables: of what depends on one angle, or one torque.
        tool: where it is on the flange, and where the base is.
        nominal: the same laws with nothing in them, of the nominal arm.
        reach: m.
        mode: kind of readings that the model was fitted to.
    """

    arm: tuple[Floats, ...]
    load: tuple[Any, ...]
    laws: tuple[Floats, ...]
    tables: tuple[Any, ...]
    tool: Tool
    nominal: tuple[tuple[Floats, ...], tuple[Any, ...]]
    reach: float
    mode: Mode

    def compensate(
        self, q: Floats, wrench: Floats, goal: tuple[Floats, Floats] | None
    ) -> tuple[Floats, Floats]:
        """Joint values (N, n) and residuals (N, 2), m and rad.

        Args:
            q: (N, n) joint values, rad.
            wrench: (N, 6) at the load point, base axes.
            goal: (N, 3, 3) wanted orientations and (N, 3) positions, m, base axes; those that the
                nominal arm (for deflections: the unloaded arm) has at q where None.
        """
        from hilcal.calibration.kernel import invert_all

        count = len(q)
        out, left = np.empty_like(q), np.zeros((count, 2))
        still = self.mode == "deflection"
        rotation, position = goal or (np.empty((count, 3, 3)), np.empty((count, 3)))
        if goal is None:
            laws, tables = (self.laws, self.tables) if still else self.nominal
            tool, nothing = self.tool.pose if still else self.tool.nominal, np.zeros((count, 6))
            invert_all(
                self.arm, self.load, laws, tables, _c(tool), self.reach, MOST_TURN, TOLERANCE,
                q, nothing, rotation, position, False, out, left,
            )  # fmt: skip
        if goal is not None or not still:
            rotation, position = in_chain(self.tool, rotation, position)
        invert_all(
            self.arm, self.load, self.laws, self.tables, _c(self.tool.pose), self.reach, MOST_TURN,
            TOLERANCE, q, wrench, _c(rotation), _c(position), True, out, left,
        )  # fmt: skip
        return out, left


def compiled(tool: Tool, mode: Mode) -> Compiled | None:
    """Return a model for the kernel; None where it has another form, or numba is absent."""
    try:
        import numba  # noqa: F401
    except ImportError:
        return None
    model = tool.model
    arm, cell = model.cell.arm, model.cell
    if arm.n != 6 or arm.drive is not None or arm.coupling is not None or tool.moving:
        return None
    situation = _situation(tool)
    if situation is None:
        return None
    form = _Form.empty(arm.n)
    first_moment, point = np.zeros((arm.n, 3)), cell.load_point
    for e, mine in zip(model.effects, model.slices(), strict=True):
        theta = tool.theta[mine]
        if e.role in FRAME_ROLES:
            continue
        if e.needs or e.wrench_change(theta, situation) is not None:
            return None
        change = e.load_change(theta)
        if change is not None:
            point = point if change.point is None else point + change.point
            moments = change.first_moment
            first_moment = first_moment if moments is None else first_moment + moments
        elif theta.any() and not form.take(e, theta, situation):
            return None
    load = (
        _c(point), float(cell.tool_mass), _c(cell.tool_com), _c(cell.gravity), _c(arm.masses),
        first_moment,
    )  # fmt: skip
    links = (_c(arm.links[:, :3, :3]), _c(arm.links[:, :3, 3]), _c(arm.coms))
    bare = _Form.empty(arm.n)
    nominal = bare.laws(), bare.tables()
    reach = float(arm.reach)
    return Compiled(links, load, form.laws(), form.tables(), tool, nominal, reach, mode)


@dataclass(slots=True, eq=False)
class _Form:
    """The sum of the effects so far."""

    a: Floats
    linear: Floats
    by_wrench: Floats
    b: Floats
    compliance: Floats
    by_angle: Floats
    by_torque: Floats
    torque: Floats

    @classmethod
    def empty(cls, n: int) -> "_Form":
        return cls(
            np.zeros(n), np.zeros((n, n)), np.zeros((n, 6)), np.zeros((n + 1, 6)),
            np.zeros((n + 1, 6, 6)), np.zeros((0, NODES)), np.zeros((0, TORQUE_NODES)), np.ones(n),
        )  # fmt: skip

    def laws(self) -> tuple[Floats, ...]:
        return self.a, self.linear, self.by_wrench, self.b, self.compliance

    def tables(self) -> tuple[Any, ...]:
        angle = np.linspace(-TURN, TURN, NODES)
        steps = 2 * self.torque / (TORQUE_NODES - 1)
        slopes = np.zeros_like(self.by_angle)
        if len(self.by_angle):
            slopes = CubicSpline(angle, self.by_angle, axis=1)(angle, 1)
        torque_slopes = np.zeros_like(self.by_torque)
        for j, values in enumerate(self.by_torque):
            grid = np.linspace(-self.torque[j], self.torque[j], TORQUE_NODES)
            torque_slopes[j] = CubicSpline(grid, values)(grid, 1)
        return (
            self.by_angle, _c(slopes), -TURN, float(angle[1] - angle[0]),
            self.by_torque, torque_slopes, -self.torque, steps,
        )  # fmt: skip

    def take(self, e: Effect, theta: Floats, s: Situation) -> bool:
        """Add an effect; False where it has another form."""
        return self._elastic(e, theta, s) if e.elastic else self._rigid(e, theta, s)

    def _elastic(self, e: Effect, theta: Floats, s: Situation) -> bool:
        n = s.angle.shape[1]
        found = e.deviation(theta, s)
        if not _only(found):
            return False
        by_wrench, compliance = np.zeros((n, 6)), np.zeros((n + 1, 6, 6))
        for c in range(6):
            unit = np.zeros_like(s.wrench)
            unit[:, :, c] = 1.0
            d = e.deviation(theta, replace(s, wrench=unit))
            if d.dq is not None:
                by_wrench[:, c] = d.dq[0]
            if d.twist is not None:
                compliance[:, :, c] = d.twist[0]
        dq = np.einsum("je,nje->nj", by_wrench, s.wrench[:, :n])
        twist = np.einsum("kef,nkf->nke", compliance, s.wrench)
        if _same(found, dq, twist):
            self.by_wrench += by_wrench
            self.compliance += compliance
            return True
        return found.twist is None and self._by_torque(e, theta, s, found)

    def _by_torque(self, e: Effect, theta: Floats, s: Situation, found: Deviation) -> bool:
        """Take displacements that depend on the joint's own torque alone."""
        n = s.angle.shape[1]
        torque = TORQUES * np.where(np.isfinite(s.cell.arm.torque_max), s.cell.arm.torque_max, 1e3)
        share = np.linspace(-1.0, 1.0, TORQUE_NODES)
        grid = _repeated(s, TORQUE_NODES)
        wrench = np.zeros((TORQUE_NODES, n + 1, 6))
        wrench[:, :n, 5] = share[:, None] * torque
        values = e.deviation(theta, replace(grid, wrench=wrench)).dq
        if values is None or found.dq is None:
            return False
        splines = [CubicSpline(share * torque[j], values[:, j]) for j in range(n)]
        dq = np.stack([splines[j](s.wrench[:, j, 5]) for j in range(n)], axis=1)
        if not _same(found, dq, None):
            return False
        self.torque = torque
        self.by_torque = values.T + (self.by_torque if len(self.by_torque) else 0.0)
        self.by_torque = _c(self.by_torque)
        return True

    def _rigid(self, e: Effect, theta: Floats, s: Situation) -> bool:
        found = e.deviation(theta, s)
        if not _only(found):
            return False
        twist = np.zeros(self.b.shape) if found.twist is None else found.twist[0]
        n = s.angle.shape[1]
        if found.dq is None:
            if not _same(
                found, np.zeros((TRIALS, n)), np.broadcast_to(twist, (TRIALS, *twist.shape))
            ):
                return False
            self.b += twist
            return True
        angle = np.linspace(-TURN, TURN, NODES)
        own = np.concatenate([_at(e, theta, s, part) for part in np.array_split(angle, 16)])
        waves = CubicSpline(angle, own)
        each = np.stack([waves(s.angle[:, j])[:, j] for j in range(n)], axis=1)
        # What is left may follow other joints in proportion.
        left = found.dq - each
        rows = np.hstack([s.angle, np.ones((TRIALS, 1))])
        solved = np.linalg.lstsq(rows, left, rcond=None)[0]
        if np.abs(left).max() < EXACT:
            solved = np.zeros_like(solved)
        dq = each + rows @ solved
        if not _same(found, dq, np.broadcast_to(twist, (TRIALS, *twist.shape))):
            return False
        self.b += twist
        self.a += solved[-1]
        self.linear += solved[:-1].T
        self.by_angle = _c(own.T + (self.by_angle if len(self.by_angle) else 0.0))
        return True


def _at(e: Effect, theta: Floats, s: Situation, angle: Floats) -> Floats:
    """(K, n) displacements with all joints at the same angles (K,)."""
    grid = _repeated(s, len(angle))
    q = np.repeat(angle[:, None], s.angle.shape[1], axis=1)
    moved = replace(grid, states=replace(grid.states, q=q), angle=q)
    found = e.deviation(theta, moved).dq
    return np.zeros_like(q) if found is None else found


def _situation(tool: Tool) -> Situation | None:
    """Return random states, and random wrenches through their slots."""
    arm, rng = tool.model.cell.arm, np.random.default_rng(20250307)
    states = States(rng.uniform(-3, 3, (TRIALS, arm.n)), np.zeros((TRIALS, 6)))
    if not all(e.computable(states) for e in tool.model.effects):
        return None
    situation = tool.model.predict(states, np.zeros_like(tool.theta)).situation
    limit = np.where(np.isfinite(arm.torque_max), arm.torque_max, 100.0)
    wrench = rng.standard_normal((TRIALS, arm.n + 1, 6)) * np.append(limit, limit[-1])[:, None]
    wrench *= 10.0 ** rng.uniform(-4, 0, (TRIALS, 1, 1))  # laws may turn where torques are small
    compliance = tool.model._compliance(tool.theta)
    return replace(situation, wrench=wrench, compliance=compliance)


def _repeated(s: Situation, count: int) -> Situation:
    """Return the first state, so many times."""
    rows = np.zeros(count, dtype=np.int64)
    chain = replace(
        s.chain,
        rotation=s.chain.rotation[:, rows],
        position=s.chain.position[:, rows],
        com=s.chain.com[:, rows],
        twist=None if s.chain.twist is None else s.chain.twist[:, rows],
    )
    load = replace(s.load, wrench=s.load.wrench[rows])
    return replace(
        s, states=s.states[rows], angle=s.angle[rows], chain=chain, wrench=s.wrench[rows], load=load
    )


def _only(d: Deviation) -> bool:
    """Whether nothing but joints and slots moves."""
    return d.base is None and d.station is None and d.target is None and d.scale is None


def _same(d: Deviation, dq: Floats, twist: Floats | None) -> bool:
    """Whether a deviation is what the form makes of it."""
    zero = 0.0
    a = (zero if d.dq is None else d.dq) - dq
    b = (zero if d.twist is None else d.twist) - (zero if twist is None else twist)
    size = max(np.abs(dq).max(initial=0.0), 1e-3)
    return bool(np.abs(a).max() <= 1e3 * EXACT * size and np.abs(b).max(initial=0.0) <= EXACT)


def _c(x: Floats) -> Floats:
    """Return a copy of one layout: others, and those that are read-only, would be compiled anew."""
    return np.array(x, dtype=float, order="C")
