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


def rotation_matrices(rotation: Floats) -> Floats:
    """Return (N, 3, 3) rotation matrices of (N, 3) rotation vectors, rad."""
    return np.array([pin.exp3(w) for w in rotation]).reshape(-1, 3, 3)


def rotation_vector(matrix: Floats) -> Floats:
    """Return (N, 3) rotation vectors of (N, 3, 3) rotation matrices, rad, length at most pi."""
    return np.array([pin.log3(r) for r in matrix]).reshape(-1, 3)


def skew(vector: Floats) -> Floats:
    """Return the (..., 3, 3) matrices of the cross product with (..., 3) vectors."""
    out = np.zeros((*vector.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = np.moveaxis(vector, -1, 0)
    return out - np.swapaxes(out, -1, -2)


def at_point(jacobian: Floats, arm: Floats) -> Floats:
    """Return Jacobians (N, 6, k) at a point displaced by `arm` (N, 3): v' = v + omega × arm."""
    out = jacobian.copy()
    out[:, :3] += np.cross(jacobian[:, 3:], arm[:, :, None], axis=1)
    return out


_MASSLESS = 1e-9  # kg; mass of a massless body that has a first moment


@dataclass(frozen=True, slots=True, eq=False)
class ElasticTree:
    """Pinocchio model of the elastic arm, and the indices of its degrees of freedom.

    The tree from base to flange is

        RX RY RZ (base origin), then for each joint j: RX RY (bearing) RZ (drive),
        of a joint that slides: PZ (drive), PX PY RX RY RZ (errors of the guide),
        RX RY RZ (bearing of the carriage),
        and after the drive of a long link: PY PZ RX RY RZ (its tip, x along the beam);
        last RX RY RZ (flange).
    """

    model: pin.Model  # the Pinocchio model, v degrees of freedom
    base: Ints  # (3,) indices of the base's tilts about x, y, z; (0,) if nothing tilts
    tilt: Ints
    """Indices of the bearings' tilts about the two axes across each joint, of a slide about all
    three; (0,) if nothing tilts."""
    tilt_joint: Ints  # the joint of each tilt, counted from 0
    guide: Ints  # (g, 5) indices of the guides' errors of the g sliding joints; or (0, 5)
    drive: Ints  # (n,) indices of the joints: sum of command, errors and elasticity
    beam: Ints  # (b, 5) indices of the tips: two displacements, twist, two rotations
    beam_length: Floats  # (b,) lengths, m
    tool: Ints  # (3,) indices of the flange's tilts about x, y, z; (0,) if none
    last: int  # number of the last Pinocchio joint, which carries the flange
    flange: Floats  # (4, 4) flange in the last joint's frame


def build(cell: Cell, hidden: Truth) -> ElasticTree:
    """Build the tree of a cell's arm with its true links and first moments.

    It has only the degrees of freedom that the truth needs. If the flange can tilt, `flange` is the
    identity.
    """
    arm = cell.arm
    twists = zip(arm.links, hidden.link_geometry, strict=True)
    links = np.array([link @ displacement(twist) for link, twist in twists])
    tilts = np.any(hidden.joint_tilt_compliance) or np.any(hidden.base_compliance)
    guides = np.any(hidden.guide_error)
    bending = long_links(arm) if np.any(hidden.link_compliance) else np.zeros(0, dtype=np.int64)
    model = pin.Model()
    model.gravity.linear = np.asarray(cell.gravity, dtype=float)
    placement = pin.SE3.Identity()
    last = 0

    def add(kind: object, name: str) -> int:
        nonlocal placement, last
        last = model.addJoint(last, kind, placement, name)
        placement = pin.SE3.Identity()
        return int(model.idx_qs[last])

    turns = [(pin.JointModelRX(), "x"), (pin.JointModelRY(), "y"), (pin.JointModelRZ(), "z")]
    base = [add(kind, f"base_{axis}") for kind, axis in turns] if tilts else []
    placement = pin.SE3(links[0])
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
        placement = pin.SE3(links[j + 1])
        if j + 1 in bending:
            tip = pin.SE3(_beam_axes(links[j + 1][:3, 3]), links[j + 1][:3, 3])
            placement = tip
            moves = (pin.JointModelPY(), pin.JointModelPZ(), *(kind for kind, _ in turns))
            beam.append([add(kind, f"beam{j + 1}_{i}") for i, kind in enumerate(moves)])
            placement = tip.inverse() * pin.SE3(links[j + 1])
    tilts_tool = np.any(hidden.tool_compliance) or np.any(hidden.thermal_growth)
    tool = [add(kind, f"tool_{axis}") for kind, axis in turns] if tilts_tool else []
    model.appendBodyToJoint(last, _body(float(cell.tool_mass), cell.tool_com), placement)
    return ElasticTree(
        model=model,
        base=np.array(base, dtype=np.int64),
        tilt=np.array(tilt, dtype=np.int64),
        tilt_joint=np.array(tilt_joint, dtype=np.int64),
        guide=np.array(guide, dtype=np.int64).reshape(-1, 5),
        drive=np.array(drive),
        beam=np.array(beam, dtype=np.int64).reshape(-1, 5),
        beam_length=np.linalg.norm(links[bending, :3, 3], axis=1),
        tool=np.array(tool, dtype=np.int64),
        last=last,
        flange=np.asarray(placement.homogeneous),
    )


def _body(mass: float, com: Floats, moment: Floats | None = None) -> pin.Inertia:
    """Return a body whose first moment is mass com + moment, kg·m."""
    if moment is not None and np.any(moment):
        positive = max(mass, _MASSLESS)
        com, mass = (mass * com + moment) / positive, positive
    return pin.Inertia(mass, np.asarray(com, dtype=float), np.zeros((3, 3)))


def _beam_axes(along: Floats) -> Floats:
    """Return a (3, 3) rotation whose x axis is along a vector."""
    x = along / np.linalg.norm(along)
    across = np.eye(3)[int(np.argmin(np.abs(x)))]
    y = np.cross(across, x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


@dataclass(frozen=True, slots=True, eq=False)
class Elasticity:
    """delta = (C + diag x) tau + s tau³ + b tanh(tau / tau_0).

    If drives turn several joints, this is the law of the drives with their torques,
    tau = Tᵀ (torques about the axes); the joints then turn by T delta.
    """

    linear: Floats  # (v, v) C, symmetric, rad/(N·m), or in m and N for the tips of beams
    cubic: Floats  # (v,) s, rad/(N·m)³; negative for a gear that stiffens under load
    play: Floats  # (v,) b, rad: half of the play
    crossing: Floats  # (v,) tau_0 > 0, torque at which 76 % of b are reached, N·m
    extra: Floats | None  # (N, v) x, additional compliance in each of N states, rad/(N·m); None: 0
    turns: Floats | None  # (v, v) T; None: identity

    def deflection(self, tau: Floats, states: Ints) -> tuple[Floats, Floats]:
        """Return delta (K, v) and its derivative by tau (K, v, v) for K of the states."""
        if self.turns is not None:
            tau = tau @ self.turns
        delta, slope = tau @ self.linear.T, np.zeros_like(tau)
        if self.extra is not None:
            slope += self.extra[states]
            delta += slope * tau
        stiffens = self.cubic != 0.0
        if stiffens.any():
            delta += self.cubic * tau**3
            slope += 3.0 * self.cubic * tau**2
            soft = np.any((np.diag(self.linear) + slope)[:, stiffens] <= 0.0, axis=1)
            if soft.any():
                raise InputError(
                    f"state {states[soft][0]}: joint_stiffening is too strong for "
                    "joint_compliance: the joint would spring back under more torque; "
                    "valid: c + 3 s tau^2 > 0"
                )
        if self.play.any():
            share = np.tanh(tau / self.crossing)
            delta += self.play * share
            slope += self.play / self.crossing * (1.0 - share**2)
        slope = self.linear + slope[:, :, None] * np.eye(len(self.linear))
        if self.turns is None:
            return delta, slope
        return delta @ self.turns.T, self.turns @ slope @ self.turns.T


def elasticity(
    tree: ElasticTree, hidden: Truth, arm: Arm, extra: Floats | None = None
) -> Elasticity:
    """Return the elastic law of an arm; `extra` (N, n): compliance of drives in N states.

    The tip of a beam of length L under (F, M) there is displaced by L³/3EI F + L²/2EI M, turns by
    L²/2EI F + L/EI M and twists by L/GJ M (Euler-Bernoulli; e.g. Gere and Timoshenko, Mechanics of
    Materials, table of cantilever deflections).
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
    play, crossing = np.zeros(size), np.ones(size)
    play[tree.drive], crossing[tree.drive] = hidden.backlash, crossing_torque(arm)
    added = None
    if extra is not None:
        added = np.zeros((len(extra), size))
        added[:, tree.drive] = extra
    turns = None
    if arm.drive is not None:
        turns = np.eye(size)
        turns[np.ix_(tree.drive, tree.drive)] = arm.drive
    return Elasticity(linear, cubic, play, crossing, added, turns)


_ITERATIONS = 40
_STEP = 1e-9  # rad or m; the next step of Newton's method, about its square, is below rounding
_AT_ONCE = 512  # states solved together; a choice by memory


@dataclass(frozen=True, slots=True, eq=False)
class Equilibrium:
    """Static equilibria of N states."""

    flange: Floats  # (N, 4, 4) T_base_flange
    deflection: Floats  # (N, v) elastic displacement of each degree of freedom, rad or m
    torque: Floats  # (N, v) torque or force of weight and load on each, N·m or N
    jacobian: Floats
    """(N, 6, n) twist (v, omega) of the flange, at its origin, in base axes, per commanded joint
    angle, with all other degrees of freedom fixed."""


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

    tau(delta) is the torque of weight and load on each degree of freedom *at the deflected
    configuration*. The load is dead: force and moment keep their directions in base axes, while
    their point of action moves with the deflected flange. With a misreading `sensor`, the wrench
    that the sensor reads keeps its directions in base axes; the acting wrench follows from it and
    from the orientation of the deflected flange. `growth` (N,): factor on the links' lengths, for a
    tree whose flange can tilt; `guide` (N, g, 5): errors of the guides.
    """
    arm = _LoadedArm(tree, law, load_point, sensor)
    parts = [slice(k, k + _AT_ONCE) for k in range(0, max(len(q), 1), _AT_ONCE)]
    states = np.arange(len(q))
    factor = np.ones(len(q)) if growth is None else growth
    start = np.zeros((len(q), tree.model.nv))
    start[:, tree.drive] = q
    if guide is not None:
        start[:, tree.guide] = guide
    rests = [arm.rest(start[part], wrench[part], factor[part], states[part]) for part in parts]
    return Equilibrium(*(np.concatenate(values) for values in zip(*rests, strict=True)))


class _LoadTorque(NamedTuple):
    """Torques of weight and load on the degrees of freedom at N configurations."""

    pose: Floats  # (N, 4, 4) last body in base axes
    jacobian: Floats  # (N, 6, v) twist of the last body, in its axes
    torque: Floats  # (N, v) N·m or N
    slope: Floats  # (N, v, v) derivative of `torque` with respect to the configuration


class _LoadedArm:
    """An elastic arm with a dead load; vectorised but for the calls of Pinocchio."""

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
        """Scale every constant translation of the links by `factor` of its nominal length."""
        if not self.links:
            if factor == 1.0:
                return
            if not len(self.tree.tool):
                raise ValueError("links can grow only in a tree whose flange can tilt")
            self.model = self.tree.model.copy()
            nominal = [(k, pin.SE3(pose)) for k, pose in enumerate(self.model.jointPlacements)]
            self.links = [(k, pose) for k, pose in nominal if pose.translation.any()]
        for k, pose in self.links:
            self.model.jointPlacements[k] = pin.SE3(pose.rotation, factor * pose.translation)

    def rest(
        self, start: Floats, wrench: Floats, growth: Floats, states: Ints
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the fields of `Equilibrium` for the states with these numbers, from `start`."""
        size = self.tree.model.nv
        delta = np.zeros_like(start)
        active = np.arange(len(start))  # not yet converged
        for _ in range(_ITERATIONS):
            load = self.load(start[active] + delta[active], wrench[active], growth[active])
            elastic, slope = self.law.deflection(load.torque, states[active])
            jacobian = np.eye(size) - slope @ load.slope
            step = np.linalg.solve(jacobian, (elastic - delta[active])[:, :, None])[:, :, 0]
            delta[active] += step
            active = active[~(np.abs(step).max(axis=1) < _STEP)]
            if not len(active):
                break
        else:
            raise InputError(
                f"state {states[active[0]]}: the elastic arm finds no equilibrium under the wrench "
                f"{wrench[active[0]].tolist()}; "
                "valid: compliances and loads that bend the arm by less than about 0.5 rad"
            )
        # A rigid arm rests at the start.
        final = self.load(start + delta, wrench, growth) if delta.any() else load
        flange = final.pose @ self.tree.flange
        turn = final.pose[:, :3, :3]
        twist = final.jacobian[:, :, self.tree.drive]
        twist = np.concatenate([turn @ twist[:, :3], turn @ twist[:, 3:]], axis=1)
        shift = flange[:, :3, 3] - final.pose[:, :3, 3]
        return flange, delta, final.torque, at_point(twist, shift)

    def load(self, q: Floats, wrench: Floats, growth: Floats) -> _LoadTorque:
        """Return the torques at N configurations; `wrench` as the sensor reads it.

        Pinocchio keeps the wrench fixed in the last body. A dead wrench is fixed in base axes and
        turns against the body in body axes: d(Rᵀf) = Rᵀf × omega.
        """
        count, size, last = len(q), self.tree.model.nv, self.tree.last
        pose, jac = np.empty((count, 4, 4)), np.empty((count, 6, size))
        grows = bool(self.links) or bool(np.any(growth != 1.0))
        for i in range(count):
            if grows:
                self.grow(growth[i])
            pin.computeJointJacobians(self.model, self.data, q[i])
            pose[i] = self.data.oMi[last].homogeneous
            jac[i] = pin.getJointJacobian(self.model, self.data, last, pin.LOCAL)
        to_body = np.swapaxes(pose[:, :3, :3], 1, 2)
        local = (to_body[:, None] @ wrench.reshape(-1, 2, 3, 1)).reshape(-1, 6)
        turn = np.concatenate([skew(local[:, :3]), skew(local[:, 3:])], axis=1)
        acting = local.copy()
        if self.sensor is not None:
            loaded = wrench.any(axis=1)
            acting[loaded] = (local[loaded] - self.sensor.bias) @ self.sensor.gain.T
            turn = self.sensor.gain @ turn
        acting[:, 3:] += acting[:, :3] @ self.lever.T
        turn[:, 3:] += self.lever @ turn[:, :3]
        torque, slope = np.empty((count, size)), np.empty((count, size, size))
        for i in range(count):
            if grows:
                self.grow(growth[i])
            self.forces[last].vector = acting[i]
            slope[i] = pin.computeStaticTorqueDerivatives(self.model, self.data, q[i], self.forces)
            torque[i] = self.data.tau
        turns = np.swapaxes(jac, 1, 2) @ (turn @ jac[:, 3:])
        return _LoadTorque(pose, jac, -torque, turns - slope)
