"""The elastic laws of every degree of freedom of the arm."""

from dataclasses import dataclass

import numpy as np

from drivers.simulated.elastic_tree import ElasticTree
from hilcal.errors import InputError
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Elasticity:
    """delta = (C + diag x) tau + s tau³ + b tanh(tau / tau_0).

    Where drives turn several joints, this is the law of the drives, with their torques; the joints
    then turn by T delta, and tau = Tᵀ (torques about the axes).

    Attributes:
        linear: (v, v) C, symmetric, rad/(N·m) and its like for the tips of beams.
        cubic: (v,) s, rad/(N·m)³; negative where a gear stiffens under load.
        play: (v,) b, rad: half of the play that a joint crosses with the sign of its torque.
        crossing: (v,) tau_0, the torque that takes it most of the way, over 0, N·m.
        extra: (N, v) x, compliance that belongs to one of N states, rad/(N·m); None: nothing.
        turns: (v, v) T; None: 1.
    """

    linear: Floats
    cubic: Floats
    play: Floats
    crossing: Floats
    extra: Floats | None = None
    turns: Floats | None = None

    def give(self, tau: Floats, states: Ints) -> tuple[Floats, Floats]:
        """Return delta (K, v) and its derivative by tau (K, v, v) in K of the states.

        Raises:
            InputError: the gear would soften to nothing.
        """
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
    tree: ElasticTree,
    joint: Floats,
    stiffening: Floats,
    tilt: Floats,
    base: Floats,
    beam: Floats,
    *,
    tool: Floats | None = None,
    play: Floats | None = None,
    crossing: Floats | None = None,
    extra: Floats | None = None,
    drive: Floats | None = None,
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
        tool: (2,) compliance of the flange along and across its z axis, rad/(N·m).
        play: (n,) half of the play of the drives, rad.
        crossing: (n,) torque that crosses it, over 0, N·m.
        extra: (N, n) compliances of the drives that belong to N states, rad/(N·m).
        drive: (n, n) how far each drive turns each joint; None: its own.
    """
    size = tree.model.nv
    linear, cubic = np.zeros((size, size)), np.zeros(size)
    linear[tree.base, tree.base] = base[: len(tree.base)]
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
    if tool is not None and len(tree.tool):
        linear[tree.tool, tree.tool] = tool[[1, 1, 0]]
    free, torque = np.zeros(size), np.ones(size)
    if play is not None and crossing is not None:
        free[tree.drive], torque[tree.drive] = play, crossing
    own = None
    if extra is not None:
        own = np.zeros((len(extra), size))
        own[:, tree.drive] = extra
    turns = None
    if drive is not None:
        turns = np.eye(size)
        turns[np.ix_(tree.drive, tree.drive)] = drive
    return Elasticity(linear, cubic, free, torque, own, turns)
