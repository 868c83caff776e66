"""Static equilibrium of the elastic arm under its own weight and a dead load."""

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from drivers.simulated.elastic_tree import ElasticTree
from drivers.simulated.rigid import moved_by
from hilcal.errors import InputError
from hilcal.types import Floats

_ITERATIONS = 40
_STEP = 1e-12  # rad or m; Newton's next step is its square


@dataclass(frozen=True, slots=True, eq=False)
class Elasticity:
    """The elastic law of every degree of freedom: delta = C tau + s tau³.

    Attributes:
        linear: (v, v) C, symmetric, rad/(N·m) and its like for the tips of beams.
        cubic: (v,) s, rad/(N·m)³; negative where a gear stiffens under load.
    """

    linear: Floats
    cubic: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Equilibrium:
    """Where N states come to rest.

    Attributes:
        flange: (N, 4, 4) T_base_flange.
        deflection: (N, v) elastic displacement of every degree of freedom, rad or m.
        torque: (N, v) what weight and load exert on it there, N·m or N.
        jacobian: (N, 6, n) twist (v, omega) of the flange, at its origin and in base axes,
            per commanded joint angle, with the other degrees of freedom held.
    """

    flange: Floats
    deflection: Floats
    torque: Floats
    jacobian: Floats


def elasticity(
    tree: ElasticTree,
    joint: Floats,
    stiffening: Floats,
    tilt: Floats,
    base: Floats,
    beam: Floats,
) -> Elasticity:
    """Assemble the elastic law from physical constants.

    A beam of length L that carries (F, M) at its tip gives way there by L³/3EI F + L²/2EI M,
    turns by L²/2EI F + L/EI M and twists by L/GJ M (Euler-Bernoulli; e.g. Gere and
    Timoshenko, Mechanics of Materials, table of cantilever deflections).

    Args:
        tree: the degrees of freedom.
        joint: (n,) compliances of the drives, rad/(N·m).
        stiffening: (n,) their cubic terms, rad/(N·m)³.
        tilt: (n,) compliances of the bearings, rad/(N·m).
        base: (3,) compliance of the base about x, y, z, rad/(N·m).
        beam: (b, 2) 1/EI and 1/GJ of the long links, 1/(N·m²).
    """
    size = tree.model.nv
    linear, cubic = np.zeros((size, size)), np.zeros(size)
    linear[tree.base, tree.base] = base
    linear[tree.drive, tree.drive] = joint
    linear[tree.tilt, tree.tilt] = tilt[:, None]
    cubic[tree.drive] = stiffening
    for (py, pz, rx, ry, rz), length, (bend, twist) in zip(
        tree.beam, tree.beam_length, beam, strict=True
    ):
        linear[[py, pz], [py, pz]] = length**3 / 3.0 * bend
        linear[[ry, rz], [ry, rz]] = length * bend
        linear[rx, rx] = length * twist
        half = length**2 / 2.0 * bend
        linear[[py, rz], [rz, py]] = half  # a force along +y turns the tip about +z
        linear[[pz, ry], [ry, pz]] = -half  # a force along +z turns it about -y
    return Elasticity(linear, cubic)


def equilibrium(
    tree: ElasticTree, law: Elasticity, q: Floats, wrench: Floats, load_point: Floats
) -> Equilibrium:
    """Solve delta = C tau(delta) + s tau(delta)³ by Newton's method, to rounding.

    tau(delta) is what weight and load exert on each degree of freedom *at the deflected
    configuration*. The load is dead: force and moment keep their directions in base axes
    while the point where they act moves with the deflected flange.

    Args:
        tree: the arm.
        law: its elasticity.
        q: (N, n) joint angles without elasticity, rad.
        wrench: (N, 6) force and moment at the load point, base axes, N and N·m.
        load_point: (3,) flange axes, m.

    Raises:
        InputError: when a state has no equilibrium, or the gear would soften to nothing.
    """
    count, size = len(q), tree.model.nv
    arm = _Loaded(tree, law, load_point)
    out = Equilibrium(
        np.empty((count, 4, 4)),
        np.empty((count, size)),
        np.empty((count, size)),
        np.empty((count, 6, q.shape[1])),
    )
    start = np.zeros(size)
    shift = np.empty((count, 3))
    for i in range(count):
        start[tree.drive] = q[i]
        try:
            out.deflection[i], out.torque[i] = arm.rest(start, wrench[i])
        except InputError as error:
            raise InputError(f"state {i}: {error}") from None
        last = arm.data.oMi[tree.last]
        pose = last * arm.flange
        out.flange[i] = pose.homogeneous
        shift[i] = pose.translation - last.translation
        jac = pin.getJointJacobian(tree.model, arm.data, tree.last, pin.LOCAL_WORLD_ALIGNED)
        out.jacobian[i] = jac[:, tree.drive]
    return replace(out, jacobian=moved_by(out.jacobian, shift))


class _Loaded:
    """One elastic arm with a dead load; Pinocchio's work space is reused from state to state."""

    def __init__(self, tree: ElasticTree, law: Elasticity, load_point: Floats) -> None:
        """Prepare the work space; `load_point` (3,) in flange axes, m."""
        self.tree, self.law = tree, law
        self.data = tree.model.createData()
        self.flange = pin.SE3(tree.flange)
        self.lever = pin.skew(tree.flange[:3, :3] @ load_point + tree.flange[:3, 3])
        self.forces = pin.StdVec_Force()
        for _ in range(tree.model.njoints):
            self.forces.append(pin.Force.Zero())
        self.unit = np.eye(tree.model.nv)
        self.stiffens = law.cubic != 0.0
        self.cubic = bool(self.stiffens.any())

    def rest(self, start: Floats, wrench: Floats) -> tuple[Floats, Floats]:
        """Return the deflection and torque, (v,) each, at which one state rests."""
        law = self.law
        delta = np.zeros(len(start))
        for _ in range(_ITERATIONS):
            tau, jac, local = self.pull(start + delta, wrench)
            give, slack = law.linear @ tau, law.linear
            if self.cubic:
                give = give + law.cubic * tau**3
                slack = slack + np.diag(3.0 * law.cubic * tau**2)
                if np.any(np.diag(slack)[self.stiffens] <= 0.0):
                    raise InputError(
                        "joint_stiffening is too strong for joint_compliance: the joint would "
                        "spring back under more torque; valid: c + 3 s tau^2 > 0"
                    )
            slope = self.slope(start + delta, jac, local)
            step = np.linalg.solve(self.unit - slack @ slope, give - delta)
            delta = delta + step
            if np.abs(step).max() < _STEP:
                return delta, self.pull(start + delta, wrench)[0]
        raise InputError(
            f"the elastic arm finds no equilibrium under the wrench {wrench.tolist()}; "
            "valid: compliances and loads that bend the arm by less than about 0.5 rad"
        )

    def pull(self, q: Floats, wrench: Floats) -> tuple[Floats, Floats, Floats]:
        """Return what weight and load exert (v,), the local Jacobian, and the local wrench."""
        model, last = self.tree.model, self.tree.last
        pin.computeJointJacobians(model, self.data, q)
        jac = pin.getJointJacobian(model, self.data, last, pin.LOCAL)
        back = self.data.oMi[last].rotation.T
        local = np.concatenate([back @ wrench[:3], back @ wrench[3:]])
        self.forces[last] = pin.Force(local[:3], local[3:] + self.lever @ local[:3])
        return -pin.computeStaticTorque(model, self.data, q, self.forces), jac, local

    def slope(self, q: Floats, jac: Floats, local: Floats) -> Floats:
        """Return the derivative (v, v) of what `pull` returned, at the same q.

        Pinocchio holds the wrench fixed in the last body; a dead wrench stays in base axes,
        so that in body axes it turns against the body: d(Rᵀf) = Rᵀf × omega.
        """
        follower = pin.computeStaticTorqueDerivatives(self.tree.model, self.data, q, self.forces)
        force = pin.skew(local[:3])
        turn = np.vstack([force, pin.skew(local[3:]) + self.lever @ force])
        return np.asarray(jac.T @ (turn @ jac[3:]) - follower)
