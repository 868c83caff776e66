"""Static equilibrium of the elastic arm under its own weight and a dead load."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from drivers.simulated.elastic_tree import ElasticTree
from drivers.simulated.elasticity import Elasticity
from drivers.simulated.misreading import Misreading
from drivers.simulated.rigid import moved_by, skew
from hilcal.errors import InputError
from hilcal.types import Floats, Ints

_ITERATIONS = 40
_STEP = 1e-9  # rad or m; Newton's next step, about its square, is below rounding
_AT_ONCE = 512  # states that are solved together; a choice by memory


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
    arm = _Loaded(tree, law, load_point, sensor)
    parts = [slice(k, k + _AT_ONCE) for k in range(0, max(len(q), 1), _AT_ONCE)]
    states = np.arange(len(q))
    grown = np.ones(len(q)) if growth is None else growth
    rests = [arm.rest(q[part], wrench[part], grown[part], states[part]) for part in parts]
    return Equilibrium(*(np.concatenate(values) for values in zip(*rests, strict=True)))


class _Pull(NamedTuple):
    """What acts on the degrees of freedom of N states where they are.

    Attributes:
        place: (N, 4, 4) last body in base axes.
        jacobian: (N, 6, v) twist of that body, its own axes.
        torque: (N, v) what weight and load exert.
        slope: (N, v, v) derivative of `torque`.
    """

    place: Floats
    jacobian: Floats
    torque: Floats
    slope: Floats


class _Loaded:
    """One elastic arm with a dead load; Pinocchio's work space is reused from state to state.

    Pinocchio takes one state at a time and a hundredth of a millisecond for each; everything
    else is done for all states at once.
    """

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
        self.lever = skew(tree.flange[:3, :3] @ load_point + tree.flange[:3, 3])
        self.forces = pin.StdVec_Force()
        for _ in range(tree.model.njoints):
            self.forces.append(pin.Force.Zero())
        self.sensor = None if sensor is None else sensor.in_axes(tree.flange[:3, :3])
        self.links: list[tuple[int, pin.SE3]] = []

    def grow(self, factor: float) -> None:
        """Make every constant translation of the links so many times as long.

        Raises:
            ValueError: the flange cannot tilt, so that the last link has no degree of freedom
                behind it.
        """
        if not self.links:
            if factor == 1.0:
                return
            if not len(self.tree.tool):
                raise ValueError("links can grow in a tree with tool=True only")
            self.model = self.tree.model.copy()
            placed = [(k, pin.SE3(place)) for k, place in enumerate(self.model.jointPlacements)]
            self.links = [(k, place) for k, place in placed if place.translation.any()]
        for k, place in self.links:
            self.model.jointPlacements[k] = pin.SE3(place.rotation, factor * place.translation)

    def rest(
        self, q: Floats, wrench: Floats, growth: Floats, states: Ints
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the fields of `Equilibrium` for the states of these numbers."""
        size = self.tree.model.nv
        start, delta = np.zeros((len(q), size)), np.zeros((len(q), size))
        start[:, self.tree.drive] = q
        moves = np.arange(len(q))
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
