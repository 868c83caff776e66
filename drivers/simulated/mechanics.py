"""The elastic arm, its laws, and its static equilibrium under its own weight and a dead load."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from hilcal.cell import Cell
from hilcal.drivers.simulated.truth import Misreading, Truth, crossing_torque, long_links
from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints


def displacement(twist: Floats) -> Floats:
    """Return the (4, 4) rigid displacement exp([twist]) of a (6,) twist (v, omega), m and rad."""
    return np.asarray(pin.exp6(pin.Motion(twist[:3], twist[3:])).homogeneous)


def turned(rotation: Floats) -> Floats:
    """Return (N, 3, 3) rotation matrices of (N, 3) rotation vectors, rad."""
    return np.array([pin.exp3(w) for w in rotation]).reshape(-1, 3, 3)


def rotation_vector(matrix: Floats) -> Floats:
    """Return (N, 3) rotation vectors of (N, 3, 3) rotation matrices, rad, length at most pi."""
    return np.array([pin.log3(r) for r in matrix]).reshape(-1, 3)


def inverse(transform: Floats) -> Floats:
    """Return the inverse of rigid transforms (..., 4, 4)."""
    out = np.zeros_like(transform)
    turn = np.swapaxes(transform[..., :3, :3], -1, -2)
    out[..., :3, :3] = turn
    out[..., :3, 3] = -(turn @ transform[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def skew(vector: Floats) -> Floats:
    """Return (..., 3, 3) matrices that multiply as (..., 3) vectors do in a cross product."""
    out = np.zeros((*vector.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = np.moveaxis(vector, -1, 0)
    return out - np.swapaxes(out, -1, -2)


def moved_by(jacobian: Floats, arm: Floats) -> Floats:
    """Return Jacobians (N, 6, k) at a point `arm` (N, 3) further: v' = v + omega × arm."""
    out = jacobian.copy()
    out[:, :3] += np.cross(jacobian[:, 3:], arm[:, :, None], axis=1)
    return out


_MASSLESS = 1e-9  # kg; what carries the first moment of a body without a mass


@dataclass(frozen=True, slots=True, eq=False)
class ElasticTree:
    """Pinocchio model of the elastic arm and where its degrees of freedom sit.

    The tree from base to flange is

        RX RY RZ (base origin), then for each joint j: RX RY (bearing) RZ (drive),
        of a joint that slides: PZ (drive), PX PY RX RY RZ (errors of the guide),
        RX RY RZ (bearing of the carriage),
        and behind the drive of a long link: PY PZ RX RY RZ (its tip, x along the beam);
        last RX RY RZ (flange).
    """

    model: pin.Model  # the Pinocchio model, v degrees of freedom
    base: Ints  # (3,) indices of the base's tilts about x, y, z; (0,) where nothing tilts
    tilt: Ints
    """Indices of the bearings' tilts about the axes across each joint, of a slide about all; (0,)
    where nothing tilts."""
    tilt_joint: Ints  # the joint of each of them, counted from 0
    guide: Ints  # (g, 5) indices of the errors of the guides of the g joints that slide; or (0, 5)
    drive: Ints  # (n,) indices of the joints themselves: command, errors and elasticity add
    beam: Ints  # (b, 5) indices of the tips: two displacements, twist, two rotations
    beam_length: Floats  # (b,) lengths, m
    tool: Ints  # (3,) indices of the flange's tilts about its x, y, z; (0,) where it has none
    last: int  # number of the last Pinocchio joint, which carries the flange
    flange: Floats  # (4, 4) flange in the last joint's frame


def build(cell: Cell, hidden: Truth) -> ElasticTree:
    """Build the tree of a cell's arm with its true links and first moments.

    It has no degree of freedom more than the truth needs. Only where the flange can tilt is no
    constant transform left behind the last one.
    """
    arm = cell.arm
    twists = zip(arm.links, hidden.link_geometry, strict=True)
    links = np.array([link @ displacement(twist) for link, twist in twists])
    tilts = np.any(hidden.joint_tilt_compliance) or np.any(hidden.base_compliance)
    guides = np.any(hidden.guide_error)
    bent = long_links(arm) if np.any(hidden.link_compliance) else np.zeros(0, dtype=np.int64)
    model = pin.Model()
    model.gravity.linear = np.asarray(cell.gravity, dtype=float)
    here = pin.SE3.Identity()
    last = 0

    def add(kind: object, name: str) -> int:
        nonlocal here, last
        last = model.addJoint(last, kind, here, name)
        here = pin.SE3.Identity()
        return int(model.idx_qs[last])

    turns = [(pin.JointModelRX(), "x"), (pin.JointModelRY(), "y"), (pin.JointModelRZ(), "z")]
    base = [add(kind, f"base_{axis}") for kind, axis in turns] if tilts else []
    here = pin.SE3(links[0])
    tilt, tilt_joint, drive, beam = [], [], [], []
    guide: list[list[int]] = []
    for j in range(arm.n):
        slides = bool(arm.slides[j])
        if slides:
            drive.append(add(pin.JointModelPZ(), f"drive{j + 1}"))
            shifts = [(pin.JointModelPX(), "px"), (pin.JointModelPY(), "py")]
            if guides:
                guide.append([add(kind, f"guide_{axis}{j + 1}") for kind, axis in shifts + turns])
        axes = (turns if slides else turns[:2]) if tilts else []
        tilt += [add(kind, f"tilt_{axis}{j + 1}") for kind, axis in axes]
        tilt_joint += [j] * len(axes)
        if not slides:
            drive.append(add(pin.JointModelRZ(), f"drive{j + 1}"))
        body = _body(float(arm.masses[j]), arm.coms[j], hidden.link_mass[j])
        model.appendBodyToJoint(last, body, pin.SE3.Identity())
        here = pin.SE3(links[j + 1])
        if j + 1 in bent:
            tip = pin.SE3(_beam_axes(links[j + 1][:3, 3]), links[j + 1][:3, 3])
            here = tip
            moves = (pin.JointModelPY(), pin.JointModelPZ(), *(kind for kind, _ in turns))
            beam.append([add(kind, f"beam{j + 1}_{i}") for i, kind in enumerate(moves)])
            here = tip.inverse() * pin.SE3(links[j + 1])
    tool = np.any(hidden.tool_compliance) or np.any(hidden.thermal_growth)
    hand = [add(kind, f"tool_{axis}") for kind, axis in turns] if tool else []
    model.appendBodyToJoint(last, _body(float(cell.tool_mass), cell.tool_com), here)
    return ElasticTree(
        model=model,
        base=np.array(base, dtype=np.int64),
        tilt=np.array(tilt, dtype=np.int64),
        tilt_joint=np.array(tilt_joint, dtype=np.int64),
        guide=np.array(guide, dtype=np.int64).reshape(-1, 5),
        drive=np.array(drive),
        beam=np.array(beam, dtype=np.int64).reshape(-1, 5),
        beam_length=np.linalg.norm(links[bent, :3, 3], axis=1),
        tool=np.array(hand, dtype=np.int64),
        last=last,
        flange=np.asarray(here.homogeneous),
    )


def _body(mass: float, com: Floats, moment: Floats | None = None) -> pin.Inertia:
    """Return a body of the given mass whose first moment is mass com + moment, kg·m."""
    if moment is not None and np.any(moment):
        held = max(mass, _MASSLESS)
        com, mass = (mass * com + moment) / held, held
    return pin.Inertia(mass, np.asarray(com, dtype=float), np.zeros((3, 3)))


def _beam_axes(along: Floats) -> Floats:
    """Return a (3, 3) rotation whose x runs along the given vector."""
    x = along / np.linalg.norm(along)
    other = np.eye(3)[int(np.argmin(np.abs(x)))]
    y = np.cross(other, x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


@dataclass(frozen=True, slots=True, eq=False)
class Elasticity:
    """delta = (C + diag x) tau + s tau³ + b tanh(tau / tau_0).

    Where drives turn several joints, this is the law of the drives, with their torques; the joints
    then turn by T delta, and tau = Tᵀ (torques about the axes).
    """

    linear: Floats  # (v, v) C, symmetric, rad/(N·m) and its like for the tips of beams
    cubic: Floats  # (v,) s, rad/(N·m)³; negative where a gear stiffens under load
    play: Floats  # (v,) b, rad: half of the play that a joint crosses with the sign of its torque
    crossing: Floats  # (v,) tau_0, the torque that takes it most of the way, over 0, N·m
    extra: Floats | None = None
    """(N, v) x, compliance that belongs to one of N states, rad/(N·m); None: nothing."""
    turns: Floats | None = None  # (v, v) T; None: 1

    def give(self, tau: Floats, states: Ints) -> tuple[Floats, Floats]:
        """Return delta (K, v) and its derivative by tau (K, v, v) in K of the states."""
        if self.turns is None:
            return self._give(tau, states)
        delta, slack = self._give(tau @ self.turns, states)
        return delta @ self.turns.T, self.turns @ slack @ self.turns.T

    def _give(self, tau: Floats, states: Ints) -> tuple[Floats, Floats]:
        delta, bend = tau @ self.linear.T, np.zeros_like(tau)
        if self.extra is not None:
            bend += self.extra[states]
            delta += bend * tau
        stiffens = self.cubic != 0.0
        if stiffens.any():
            delta += self.cubic * tau**3
            bend += 3.0 * self.cubic * tau**2
            soft = np.any((np.diag(self.linear) + bend)[:, stiffens] <= 0.0, axis=1)
            if soft.any():
                raise InputError(
                    f"state {states[soft][0]}: joint_stiffening is too strong for "
                    "joint_compliance: the joint would spring back under more torque; "
                    "valid: c + 3 s tau^2 > 0"
                )
        if self.play.any():
            part = np.tanh(tau / self.crossing)
            delta += self.play * part
            bend += self.play / self.crossing * (1.0 - part**2)
        return delta, self.linear + bend[:, :, None] * np.eye(len(self.linear))


def elasticity(
    tree: ElasticTree, hidden: Truth, arm: Arm, extra: Floats | None = None
) -> Elasticity:
    """Assemble the elastic law of an arm with this truth; `extra` (N, n) belongs to N states.

    A beam of length L that carries (F, M) at its tip gives way there by L³/3EI F + L²/2EI M,
    turns by L²/2EI F + L/EI M and twists by L/GJ M (Euler-Bernoulli; e.g. Gere and
    Timoshenko, Mechanics of Materials, table of cantilever deflections).
    """
    size = tree.model.nv
    linear, cubic = np.zeros((size, size)), np.zeros(size)
    linear[tree.base, tree.base] = hidden.base_compliance[: len(tree.base)]
    linear[tree.drive, tree.drive] = hidden.joint_compliance
    linear[tree.tilt, tree.tilt] = hidden.joint_tilt_compliance[tree.tilt_joint]
    cubic[tree.drive] = hidden.joint_stiffening
    for (py, pz, rx, ry, rz), length, (bend, twist) in zip(
        tree.beam, tree.beam_length, hidden.link_compliance[: len(tree.beam)], strict=True
    ):
        linear[[py, pz], [py, pz]] = length**3 / 3.0 * bend
        linear[[ry, rz], [ry, rz]] = length * bend
        linear[rx, rx] = length * twist
        half = length**2 / 2.0 * bend
        linear[[py, rz], [rz, py]] = half  # a force along +y turns the tip about +z
        linear[[pz, ry], [ry, pz]] = -half  # a force along +z turns it about -y
    if len(tree.tool):
        linear[tree.tool, tree.tool] = hidden.tool_compliance[[1, 1, 0]]
    free, torque = np.zeros(size), np.ones(size)
    free[tree.drive], torque[tree.drive] = hidden.backlash, crossing_torque(arm)
    own = None
    if extra is not None:
        own = np.zeros((len(extra), size))
        own[:, tree.drive] = extra
    turns = None
    if arm.drive is not None:
        turns = np.eye(size)
        turns[np.ix_(tree.drive, tree.drive)] = arm.drive
    return Elasticity(linear, cubic, free, torque, own, turns)


_ITERATIONS = 40
_STEP = 1e-9  # rad or m; Newton's next step, about its square, is below rounding
_AT_ONCE = 512  # states that are solved together; a choice by memory


@dataclass(frozen=True, slots=True, eq=False)
class Equilibrium:
    """Where N states come to rest."""

    flange: Floats  # (N, 4, 4) T_base_flange
    deflection: Floats  # (N, v) elastic displacement of every degree of freedom, rad or m
    torque: Floats  # (N, v) what weight and load exert on it there, N·m or N
    jacobian: Floats
    """(N, 6, n) twist (v, omega) of the flange, at its origin and in base axes, per commanded joint
    angle, with the other degrees of freedom held."""


def equilibrium(
    tree: ElasticTree,
    law: Elasticity,
    q: Floats,
    wrench: Floats,
    load_point: Floats,
    *,
    growth: Floats | None = None,
    sensor: Misreading | None = None,
    guide: Floats | None = None,
) -> Equilibrium:
    """Solve delta = law(tau(delta)) by Newton's method, to rounding, for N states.

    tau(delta) is what weight and load exert on each degree of freedom *at the deflected
    configuration*. The load is dead: force and moment keep their directions in base axes
    while the point where they act moves with the deflected flange. Where a force sensor
    misread it, what it said is what keeps its directions in base axes: what acts follows from
    that and from how the deflected flange holds the sensor. `growth` (N,) is a factor on the links,
    of a tree whose flange can tilt; `guide` (N, g, 5) the errors of guides.
    """
    arm = _Loaded(tree, law, load_point, sensor)
    parts = [slice(k, k + _AT_ONCE) for k in range(0, max(len(q), 1), _AT_ONCE)]
    states = np.arange(len(q))
    grown = np.ones(len(q)) if growth is None else growth
    begun = np.zeros((len(q), tree.model.nv))
    begun[:, tree.drive] = q
    if guide is not None:
        begun[:, tree.guide] = guide
    rests = [arm.rest(begun[part], wrench[part], grown[part], states[part]) for part in parts]
    return Equilibrium(*(np.concatenate(values) for values in zip(*rests, strict=True)))


class _Pull(NamedTuple):
    """What acts on the degrees of freedom of N states where they are."""

    place: Floats  # (N, 4, 4) last body in base axes
    jacobian: Floats  # (N, 6, v) twist of that body, its own axes
    torque: Floats  # (N, v) what weight and load exert
    slope: Floats  # (N, v, v) derivative of `torque`


class _Loaded:
    """One elastic arm with a dead load; only Pinocchio takes one state at a time."""

    def __init__(
        self,
        tree: ElasticTree,
        law: Elasticity,
        load_point: Floats,
        sensor: Misreading | None = None,
    ) -> None:
        self.tree, self.law = tree, law
        self.model = tree.model
        self.data = tree.model.createData()
        self.lever = skew(tree.flange[:3, :3] @ load_point + tree.flange[:3, 3])
        self.forces = pin.StdVec_Force()
        for _ in range(tree.model.njoints):
            self.forces.append(pin.Force.Zero())
        self.sensor = None if sensor is None else sensor.in_axes(tree.flange[:3, :3])
        self.links: list[tuple[int, pin.SE3]] = []

    def grow(self, factor: float) -> None:
        """Make every constant translation of the links so many times as long."""
        if not self.links:
            if factor == 1.0:
                return
            if not len(self.tree.tool):
                raise ValueError("links can grow only in a tree whose flange can tilt")
            self.model = self.tree.model.copy()
            placed = [(k, pin.SE3(place)) for k, place in enumerate(self.model.jointPlacements)]
            self.links = [(k, place) for k, place in placed if place.translation.any()]
        for k, place in self.links:
            self.model.jointPlacements[k] = pin.SE3(place.rotation, factor * place.translation)

    def rest(
        self, start: Floats, wrench: Floats, growth: Floats, states: Ints
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the fields of `Equilibrium` for the states of these numbers, begun at `start`."""
        size = self.tree.model.nv
        delta = np.zeros_like(start)
        moves = np.arange(len(start))
        for _ in range(_ITERATIONS):
            pull = self.pull(start[moves] + delta[moves], wrench[moves], growth[moves])
            give, slack = self.law.give(pull.torque, states[moves])
            stiff = np.eye(size) - slack @ pull.slope
            step = np.linalg.solve(stiff, (give - delta[moves])[:, :, None])[:, :, 0]
            delta[moves] += step
            moves = moves[~(np.abs(step).max(axis=1) < _STEP)]
            if not len(moves):
                break
        else:
            raise InputError(
                f"state {states[moves[0]]}: the elastic arm finds no equilibrium under the wrench "
                f"{wrench[moves[0]].tolist()}; "
                "valid: compliances and loads that bend the arm by less than about 0.5 rad"
            )
        # A rigid arm is where it was first looked at.
        there = self.pull(start + delta, wrench, growth) if delta.any() else pull
        flange = there.place @ self.tree.flange
        turn = there.place[:, :3, :3]
        twist = there.jacobian[:, :, self.tree.drive]
        twist = np.concatenate([turn @ twist[:, :3], turn @ twist[:, 3:]], axis=1)
        shift = flange[:, :3, 3] - there.place[:, :3, 3]
        return flange, delta, there.torque, moved_by(twist, shift)

    def pull(self, q: Floats, wrench: Floats, growth: Floats) -> _Pull:
        """Return what acts on N states, the wrench as it was said.

        Pinocchio holds the wrench fixed in the last body; a dead wrench stays in base axes,
        so that in body axes it turns against the body: d(Rᵀf) = Rᵀf × omega.
        """
        count, size, last = len(q), self.tree.model.nv, self.tree.last
        place, jac = np.empty((count, 4, 4)), np.empty((count, 6, size))
        grows = bool(self.links) or bool(np.any(growth != 1.0))
        for i in range(count):
            if grows:
                self.grow(growth[i])
            pin.computeJointJacobians(self.model, self.data, q[i])
            place[i] = self.data.oMi[last].homogeneous
            jac[i] = pin.getJointJacobian(self.model, self.data, last, pin.LOCAL)
        back = np.swapaxes(place[:, :3, :3], 1, 2)
        local = (back[:, None] @ wrench.reshape(-1, 2, 3, 1)).reshape(-1, 6)
        turn = np.concatenate([skew(local[:, :3]), skew(local[:, 3:])], axis=1)
        acts = local.copy()
        if self.sensor is not None:
            loaded = wrench.any(axis=1)
            acts[loaded] = self.sensor.acting(local[loaded])
            turn = self.sensor.gain @ turn
        acts[:, 3:] += acts[:, :3] @ self.lever.T
        turn[:, 3:] += self.lever @ turn[:, :3]
        torque, slope = np.empty((count, size)), np.empty((count, size, size))
        for i in range(count):
            if grows:
                self.grow(growth[i])
            self.forces[last].vector = acts[i]
            slope[i] = pin.computeStaticTorqueDerivatives(self.model, self.data, q[i], self.forces)
            torque[i] = self.data.tau
        turns = np.swapaxes(jac, 1, 2) @ (turn @ jac[:, 3:])
        return _Pull(place, jac, -torque, turns - slope)
