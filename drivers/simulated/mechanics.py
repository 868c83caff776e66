"""Static equilibrium of the elastic arm under its own weight and a dead load."""

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from drivers.simulated.elastic_tree import ElasticTree
from drivers.simulated.elasticity import Elasticity
from drivers.simulated.misreading import Misreading
from drivers.simulated.rigid import moved_by
from hilcal.errors import InputError
from hilcal.types import Floats

_ITERATIONS = 40
_STEP = 1e-12  # rad or m; Newton's next step is its square


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


def equilibrium(
    tree: ElasticTree,
    law: Elasticity,
    q: Floats,
    wrench: Floats,
    load_point: Floats,
    *,
    growth: Floats | None = None,
    sensor: Misreading | None = None,
) -> Equilibrium:
    """Solve delta = law(tau(delta)) by Newton's method, to rounding.

    tau(delta) is what weight and load exert on each degree of freedom *at the deflected
    configuration*. The load is dead: force and moment keep their directions in base axes
    while the point where they act moves with the deflected flange. Where a force sensor
    misread it, what it said is what keeps its directions in base axes: what acts follows from
    that and from how the deflected flange holds the sensor.

    Args:
        tree: the arm.
        law: its elasticity.
        q: (N, n) joint angles without elasticity, rad.
        wrench: (N, 6) force and moment at the load point, base axes, N and N·m.
        load_point: (3,) flange axes, m.
        growth: (N,) factor on every constant translation of the links, for a tree whose
            flange can tilt; None: 1.
        sensor: how `wrench` was misread, where it is not zero; None: it is true.

    Raises:
        InputError: when a state has no equilibrium, or the gear would soften to nothing.
    """
    count, size = len(q), tree.model.nv
    arm = _Loaded(tree, law, load_point, sensor)
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
        if growth is not None:
            arm.grow(float(growth[i]))
        try:
            out.deflection[i], out.torque[i] = arm.rest(start, wrench[i], i)
        except InputError as error:
            raise InputError(f"state {i}: {error}") from None
        last = arm.data.oMi[tree.last]
        pose = last * arm.flange
        out.flange[i] = pose.homogeneous
        shift[i] = pose.translation - last.translation
        jac = pin.getJointJacobian(arm.model, arm.data, tree.last, pin.LOCAL_WORLD_ALIGNED)
        out.jacobian[i] = jac[:, tree.drive]
    return replace(out, jacobian=moved_by(out.jacobian, shift))


class _Loaded:
    """One elastic arm with a dead load; Pinocchio's work space is reused from state to state."""

    def __init__(
        self,
        tree: ElasticTree,
        law: Elasticity,
        load_point: Floats,
        sensor: Misreading | None = None,
    ) -> None:
        """Prepare the work space; `load_point` (3,) in flange axes, m."""
        self.tree, self.law = tree, law
        self.model = tree.model
        self.data = tree.model.createData()
        self.flange = pin.SE3(tree.flange)
        self.lever = pin.skew(tree.flange[:3, :3] @ load_point + tree.flange[:3, 3])
        self.forces = pin.StdVec_Force()
        for _ in range(tree.model.njoints):
            self.forces.append(pin.Force.Zero())
        self.unit = np.eye(tree.model.nv)
        self.sensor = None if sensor is None else sensor.in_axes(tree.flange[:3, :3])
        self.links: list[tuple[int, pin.SE3]] = []

    def grow(self, factor: float) -> None:
        """Make every constant translation of the links so many times as long.

        Raises:
            ValueError: the flange cannot tilt, so that the last link has no degree of freedom
                behind it.
        """
        if not self.links:
            if not len(self.tree.tool):
                raise ValueError("links can grow in a tree with tool=True only")
            self.model = self.tree.model.copy()
            placed = [(k, pin.SE3(place)) for k, place in enumerate(self.model.jointPlacements)]
            self.links = [(k, place) for k, place in placed if place.translation.any()]
        for k, place in self.links:
            self.model.jointPlacements[k] = pin.SE3(place.rotation, factor * place.translation)

    def rest(self, start: Floats, wrench: Floats, state: int) -> tuple[Floats, Floats]:
        """Return the deflection and torque, (v,) each, at which one state rests."""
        delta = np.zeros(len(start))
        for _ in range(_ITERATIONS):
            tau, jac, local = self.pull(start + delta, wrench)
            give, slack = self.law.give(tau, state)
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
        """Return what weight and load exert (v,), the local Jacobian, and the local wrench.

        The wrench is the one that was said, in the axes of the last body.
        """
        model, last = self.model, self.tree.last
        pin.computeJointJacobians(model, self.data, q)
        jac = pin.getJointJacobian(model, self.data, last, pin.LOCAL)
        back = self.data.oMi[last].rotation.T
        local = np.concatenate([back @ wrench[:3], back @ wrench[3:]])
        acts = local
        if self.sensor is not None and wrench.any():
            acts = self.sensor.acting(local)
        self.forces[last] = pin.Force(acts[:3], acts[3:] + self.lever @ acts[:3])
        return -pin.computeStaticTorque(model, self.data, q, self.forces), jac, local

    def slope(self, q: Floats, jac: Floats, local: Floats) -> Floats:
        """Return the derivative (v, v) of what `pull` returned, at the same q.

        Pinocchio holds the wrench fixed in the last body; a dead wrench stays in base axes,
        so that in body axes it turns against the body: d(Rᵀf) = Rᵀf × omega.
        """
        follower = pin.computeStaticTorqueDerivatives(self.model, self.data, q, self.forces)
        turn = np.vstack([pin.skew(local[:3]), pin.skew(local[3:])])
        if self.sensor is not None:
            turn = self.sensor.gain @ turn
        turn[3:] += self.lever @ turn[:3]
        return np.asarray(jac.T @ (turn @ jac[3:]) - follower)
