"""Conversion of a model to the form that the compiled kernel evaluates, where it has that form.

An effect is recognised by its deviation, not by its name: the deviation at random states and
wrenches is compared with

    dq_j = a_j + T_j(q_j) + Σ_i L_ji q_i + c_j · w_j + (s_j + P_j(q_j)) τ_j + G_j(τ_j)
    ξ_k = b_k + Q_k q + C_k w_k

(tables T, P, G by cubic splines). An effect that needs times, temperatures or sides of approach
gives a, b and s of each point. A model with an effect of another form is not compiled, but
evaluated by `Model.predict`, some hundred times slower.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilcal.calibration.compensation import MAX_JOINT_STEP, TOLERANCE, Inverse, ToolPose, in_chain
from hilcal.effects.protocol import FRAME_ROLES, Effect, Situation
from hilcal.optional import install
from hilcal.readings.readings import States
from hilcal.readings.whitening import Mode
from hilcal.robot import se3
from hilcal.robot.chain import Deviation
from hilcal.types import Floats

TURN = 2 * np.pi  # angles of the tables reach from −TURN to TURN
NODES = 65537
"""Nodes of a table over angles: 120 waves per turn of 0.1 mrad are met to 1e-13, 1000 of 0.04 mrad
to 2e-10."""
TORQUE_NODES = 40001
TORQUES = 3.0  # range of tables over torques, in units of the joint's limit
TRIALS = 64
EXACT = 1e-9
"""Largest difference, rad and m, between an effect and the form that represents it: a thousandth of
the least step of an arm. A choice."""


class CompiledForm:
    """The sum of the added effects; arrays without any effect have no rows."""

    def __init__(self, n: int) -> None:
        self.a, self.linear, self.by_wrench = np.zeros(n), np.zeros((n, n)), np.zeros((n, 6))
        self.b, self.compliance = np.zeros((n + 1, 6)), np.zeros((n + 1, 6, 6))
        self.by_values: Floats = np.zeros((0, 6, n))
        self.by_angle: Floats = np.zeros((0, NODES - 1, 4))
        self.angle_compliance: Floats = np.zeros((0, NODES - 1, 4))
        self.by_torque: Floats = np.zeros((0, TORQUE_NODES - 1, 4))
        self.torque = np.ones(n)
        self.gain: Floats = np.zeros((0, 6))
        self.bias = np.zeros(6)

    def laws(self) -> tuple[Floats, ...]:
        """Return constants and compliances, as the kernel takes them."""
        return self.a, self.linear, self.by_wrench, self.b, self.compliance, self.by_values

    def tables(self) -> tuple[Any, ...]:
        """Return first nodes, steps and polynomials of the tables, as the kernel takes them."""
        grids = -TURN, 2 * TURN / (NODES - 1), -self.torque, 2 * self.torque / (TORQUE_NODES - 1)
        return grids, (self.by_angle, self.by_torque, self.angle_compliance)

    def add(self, e: Effect, theta: Floats, s: Situation) -> bool:
        """Add an effect; return False where it has another form."""
        change = e.wrench_change(theta, s)
        if change is not None:
            return self._sensed(change, s)
        d = e.deviation(theta, s)
        if all(x is None for x in (d.dq, d.twist, d.base, d.target)):
            return True  # effects of instruments move no tool
        if e.needs or not _joints_and_links_only(d):
            return False
        add = self._elastic if e.elastic else self._rigid
        return add(e, theta, s, d)

    def _elastic(self, e: Effect, theta: Floats, s: Situation, deviation: Deviation) -> bool:
        n = s.angle.shape[1]
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
        if _same(deviation, dq, twist):
            self.by_wrench += by_wrench
            self.compliance += compliance
            return True
        if deviation.twist is not None or deviation.dq is None:
            return False
        added = self._angle_compliance(e, theta, s, deviation.dq)
        return added or self._by_torque(e, theta, s, deviation)

    def _sensed(self, change: Floats, s: Situation) -> bool:
        """Add the wrench error of a force sensor on the flange: R (bias + gain Rᵀ w)."""
        r = s.chain.rotation[-1]
        w, y = (
            np.einsum("nij,nki->nkj", r, x.reshape(-1, 2, 3)).reshape(-1, 6)
            for x in (s.states.wrench, change)
        )
        coefficients, remainder = _affine(w, y)
        if np.abs(remainder).max() > 1e3 * EXACT * max(np.abs(y).max(), 1.0):
            return False
        self.gain = _added(self.gain, coefficients[:-1].T)
        self.bias = self.bias + coefficients[-1]
        return True

    def _angle_compliance(self, e: Effect, theta: Floats, s: Situation, dq: Floats) -> bool:
        """Add compliances of joints that depend on the joint's own angle."""
        waves, compliance = _waves(e, theta, replace(s, wrench=_unit_torque(s)))
        if not _same(Deviation(dq=dq), compliance * s.wrench[:, :-1, 5]):
            return False
        self.angle_compliance = _added(self.angle_compliance, waves)
        return True

    def _by_torque(self, e: Effect, theta: Floats, s: Situation, deviation: Deviation) -> bool:
        n = s.angle.shape[1]
        torque = TORQUES * np.where(np.isfinite(s.cell.arm.torque_max), s.cell.arm.torque_max, 1e3)
        share = np.linspace(-1.0, 1.0, TORQUE_NODES)
        grid = repeated(s, TORQUE_NODES)
        wrench = np.zeros((TORQUE_NODES, n + 1, 6))
        wrench[:, :n, 5] = share[:, None] * torque
        values = e.deviation(theta, replace(grid, wrench=wrench)).dq
        if values is None or deviation.dq is None:
            return False
        splines = [_spline(share * torque[j], values[:, j]) for j in range(n)]
        dq = np.stack([splines[j](s.wrench[:, j, 5]) for j in range(n)], axis=1)
        if not _same(deviation, dq):
            return False
        self.torque = torque
        self.by_torque = _added(self.by_torque, np.stack([f.c.T for f in splines]))
        return True

    def _rigid(self, e: Effect, theta: Floats, s: Situation, deviation: Deviation) -> bool:
        dq, twist, shape = deviation.dq, deviation.twist, self.b.shape
        if twist is not None:
            flat = np.broadcast_to(twist, (TRIALS, *shape)).reshape(TRIALS, -1)
            coefficients, remainder = _affine(s.angle, flat)
            if np.abs(remainder).max() > EXACT:
                return False
            slopes = np.moveaxis(coefficients[:-1].reshape(-1, *shape), 0, -1)
        if dq is not None:
            waves, by_angle = _waves(e, theta, s)
            # The remainder may be linear in the other joints.
            by_others, remainder = _affine(s.angle, dq - by_angle)
            if not _same(Deviation(dq=dq), dq - remainder):
                return False
            self.a += by_others[-1]
            self.linear += by_others[:-1].T
            self.by_angle = _added(self.by_angle, waves)
        if twist is not None:
            self.b += coefficients[-1].reshape(shape)
            self.by_values = _added(self.by_values, slopes) if slopes.any() else self.by_values
        return True


def fixed_columns_suffice(e: Effect, theta: Floats, s: Situation) -> bool:
    """Whether an effect, at fixed columns, is a constant or a compliance of joints."""
    turned = np.roll(s.angle, 1, axis=0)
    permuted = replace(s, states=replace(s.states, q=turned), angle=turned)
    d = e.deviation(theta, s)
    if not _joints_and_links_only(d) or (d.dq is None and d.twist is None):
        return False
    if not e.elastic:
        dq = np.zeros_like(s.angle) if d.dq is None else d.dq
        return _same(e.deviation(theta, permuted), dq, d.twist)
    unit, other = (e.deviation(theta, replace(x, wrench=_unit_torque(s))).dq for x in (s, permuted))
    if d.twist is not None or unit is None or other is None:
        return False
    return _same(Deviation(dq=other), unit) and _same(d, unit * s.wrench[:, :-1, 5])


def _unit_torque(s: Situation) -> Floats:
    unit = np.zeros_like(s.wrench)
    unit[..., 5] = 1.0
    return unit


def _affine(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Coefficients (n + 1, K) of y (N, K) by x (N, n) and 1, and the remainder (N, K)."""
    if np.ptp(y, axis=0).max() <= EXACT:
        return np.vstack([np.zeros((x.shape[1], y.shape[1])), y[:1]]), y - y[0]
    rows = np.hstack([x, np.ones((len(x), 1))])
    coefficients: Floats = np.asarray(np.linalg.lstsq(rows, y, rcond=None)[0], dtype=float)
    return coefficients, np.asarray(y - rows @ coefficients)


def _spline(x: Floats, y: Floats) -> Any:
    from scipy.interpolate import CubicSpline  # slow to import

    return CubicSpline(x, y)


def _added(rows: Floats, added: Any) -> Floats:
    return packed(added + rows if len(rows) else added)


def _waves(e: Effect, theta: Floats, s: Situation) -> tuple[Floats, Floats]:
    """Polynomials (n, NODES − 1, 4) of the displacements over one angle, and (N, n) those at s."""
    angle, parts = np.linspace(-TURN, TURN, NODES), []
    for part in np.array_split(angle, 16):
        grid, q = repeated(s, len(part)), np.repeat(part[:, None], s.angle.shape[1], axis=1)
        dq = e.deviation(theta, replace(grid, states=replace(grid.states, q=q), angle=q)).dq
        parts.append(np.zeros_like(q) if dq is None else dq)
    waves = _spline(angle, np.concatenate(parts))
    at_states = np.stack([waves(a)[:, j] for j, a in enumerate(s.angle.T)], axis=1)
    return waves.c.T, at_states


def repeated(s: Situation, count: int) -> Situation:
    """Return the first state, repeated `count` times."""
    rows = np.zeros(count, dtype=np.int64)
    chain = se3.by_field([s.chain], lambda arrays: arrays[0][:, rows])
    load = replace(s.load, wrench=s.load.wrench[rows])
    return replace(
        s, states=s.states[rows], angle=s.angle[rows], chain=chain, wrench=s.wrench[rows], load=load
    )


def _joints_and_links_only(d: Deviation) -> bool:
    return all(f is None for f in (d.base, d.station, d.target, d.scale, d.observer))


def _same(d: Deviation, dq: Floats, twist: Floats | None = None) -> bool:
    a = (0.0 if d.dq is None else d.dq) - dq
    b = (0.0 if d.twist is None else d.twist) - (0.0 if twist is None else twist)
    size = max(np.abs(dq).max(initial=0.0), 1e-3)
    return bool(np.abs(a).max() <= 1e3 * EXACT * size and np.abs(b).max(initial=0.0) <= EXACT)


def packed(x: Floats | np.ndarray) -> Floats:
    """Return a writable C-ordered copy: numba compiles each other layout anew."""
    return np.array(x, dtype=float, order="C")


@dataclass(frozen=True, slots=True, eq=False)
class Compiled:
    """Arrays for `kernel.invert_all`."""

    arm: tuple[Floats, ...]  # links and centres of mass
    load: tuple[Any, ...]  # load point and all masses
    laws: tuple[Floats, ...]  # constants and compliances
    tables: tuple[Any, ...]  # of effects that depend on one angle, or one torque
    tool: ToolPose
    nominal: tuple[tuple[Floats, ...], tuple[Any, ...]]
    """Laws and tables of the nominal arm: without effects."""
    reach: float  # m
    mode: Mode  # kind of readings that the model was fitted to
    by_point: tuple[tuple[Effect, Floats], ...]
    """Effects that need times, temperatures or sides of approach, with their parameters."""
    situation: Situation  # a state to evaluate these effects at

    def covers(self, q: Floats) -> bool:
        """Whether the tables hold at joint values (N, n); some wrists turn without a stop."""
        _, (by_angle, _, angle_compliance) = self.tables
        return not (len(by_angle) or len(angle_compliance)) or bool(np.all(np.abs(q) <= TURN))

    def compensate(self, states: States, goal: tuple[Floats, Floats] | None) -> Inverse:
        """Joint values (N, n) and residuals (N, 2), m and rad.

        `goal` are target orientations (N, 3, 3) and positions (N, 3), m, base axes; if None, those
        of the nominal arm (for deflections: the unloaded arm) at q.
        """
        from hilcal.calibration.kernel import invert_all

        q, wrench, count = states.q, states.wrench, len(states)
        by_point = self._at_points(states)
        out, residual = np.empty_like(q), np.zeros((count, 2))
        deflection = self.mode == "deflection"
        rotation, position = goal or (np.empty((count, 3, 3)), np.empty((count, 3)))
        if goal is None:
            laws, tables = (self.laws, self.tables) if deflection else self.nominal
            tool = self.tool.pose if deflection else self.tool.nominal
            unloaded = np.zeros((count, 6))
            deviations = by_point if deflection else _zeros(q.shape[1])
            invert_all(
                self.arm, self.load, laws, tables, deviations, packed(tool), self.reach,
                MAX_JOINT_STEP, TOLERANCE, q, unloaded, rotation, position, False, out, residual,
            )  # fmt: skip
        if goal is not None or not deflection:
            rotation, position = in_chain(self.tool, rotation, position)
        invert_all(
            self.arm, self.load, self.laws, self.tables, by_point, packed(self.tool.pose),
            self.reach, MAX_JOINT_STEP, TOLERANCE, q, wrench, packed(rotation), packed(position),
            True, out, residual,
        )  # fmt: skip
        return Inverse(out, residual[:, 0], residual[:, 1])

    def _at_points(self, states: States) -> tuple[Floats, Floats, Floats]:
        """Displacements (N, n), twists (N, n + 1, 6) and compliances (N, n) of the points."""
        zeros = _zeros(states.q.shape[1])
        if not self.by_point:
            return zeros
        s = self.situation if len(states) == 1 else repeated(self.situation, len(states))
        s = replace(s, states=states, angle=states.q)
        dq, twist, angle_compliance = zeros
        for e, theta in self.by_point:
            d = e.deviation(theta, s)
            if e.elastic:
                angle_compliance = angle_compliance if d.dq is None else angle_compliance + d.dq
                continue
            dq = dq if d.dq is None else dq + d.dq
            twist = twist if d.twist is None else twist + d.twist
        return packed(dq), packed(twist), packed(angle_compliance)


def compiled(tool: ToolPose, mode: Mode) -> Compiled | tuple[str, ...]:
    """Return a model for the kernel, or the names of what the kernel does not cover."""
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
    s, form = _situation(tool), CompiledForm(arm.n)
    first_moment, point = np.zeros((arm.n, 3)), cell.load_point
    by_point: list[tuple[Effect, Floats]] = []
    for e, columns in zip(model.effects, model.slices(), strict=True):
        theta = tool.theta[columns]
        if e.role in FRAME_ROLES or not theta.any():
            continue
        change = e.load_change(theta)
        if change is not None:
            point = point if change.point is None else point + change.point
            moments = change.first_moment
            first_moment = first_moment if moments is None else first_moment + moments
        elif e.needs and fixed_columns_suffice(e, theta, s):
            by_point.append((e, theta))
        elif not form.add(e, theta, s):
            return (e.name,)
    load = (
        packed(point), float(cell.tool_mass), packed(cell.tool_com), packed(cell.gravity),
        packed(arm.masses), first_moment, form.gain, form.bias,
    )  # fmt: skip
    links = (packed(arm.links[:, :3, :3]), packed(arm.links[:, :3, 3]), packed(arm.coms))
    bare = CompiledForm(arm.n)
    nominal = bare.laws(), bare.tables()
    one = repeated(s, 1)
    one = replace(one, wrench=_unit_torque(one))
    return Compiled(
        links, load, form.laws(), form.tables(), tool, nominal, float(arm.reach), mode,
        tuple(by_point), one,
    )  # fmt: skip


def _zeros(n: int) -> tuple[Floats, Floats, Floats]:
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
