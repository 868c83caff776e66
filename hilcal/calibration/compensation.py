"""The inverse of an identified model: joint values that put the tool where it was asked to be.

Newton's method on the pose of the tool, T(q) = T_wanted, from the joint values that were given, so
that the branch stays theirs:

    q ← q + J⁺ e,   e = (p_wanted − p, Log(R_wanted Rᵀ)),   J = ∂(p, ω)/∂q by the chain alone

Every residual is of the whole model at equilibrium, so the solution is exact; leaving the effects
out of J only costs a step or two, each about 10³ times closer.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import Chain, evaluate, joint_jacobian
from hilcal.types import Bools, Floats, Ints

TOLERANCE = 1e-10
"""Residual at which a point is solved, m and rad."""
MOST_STEPS = 30
"""Newton steps at most; four are usual."""
MOST_TURN = 0.2
"""Largest step of a joint, rad: longer ones are shortened, so that no branch is left."""
LEAST_SINGULAR = 1e-3
"""Ratio of the smallest to the largest singular value of J, lengths in units of the reach, below
which a pose is singular: joints may turn a thousand times as far as the tool. A choice."""

Pose = tuple[Floats, Floats, Chain]
"""Orientation (N, 3, 3) and position (N, 3) of the tool, base axes, with the chain."""


@dataclass(frozen=True, slots=True, eq=False)
class Inverse:
    """The solution for N points."""

    q: Floats  # (N, n) joint values
    residual_m: Floats  # (N,) distance from the wanted position that is left
    residual_rad: Floats  # (N,) angle from the wanted orientation that is left

    @property
    def solved(self) -> Bools:
        """(N,) points at which the tool is where it was asked to be."""
        return np.asarray(np.maximum(self.residual_m, self.residual_rad) <= TOLERANCE)


def invert(
    arm: Arm,
    poses: Callable[[Floats, Ints], Pose],
    q: Floats,
    rotation: Floats,
    position: Floats,
) -> Inverse:
    """Find joint values.

    Args:
        q: (N, n) joint values to begin with.
        rotation: (N, 3, 3) wanted orientation of the tool, base axes.
        position: (N, 3) wanted position, base axes, m.
    """
    q, count = q.copy(), len(q)
    left = np.full((count, 2), np.inf)
    active = np.arange(count)
    scale = np.array([arm.reach] * 3 + [1.0] * 3)
    for _ in range(MOST_STEPS):
        r, p, chain = poses(q[active], active)
        e = _error(r, p, rotation[active], position[active])
        left[active] = np.stack([np.linalg.norm(part, axis=1) for part in (e[:, :3], e[:, 3:])], 1)
        u, s, vt = np.linalg.svd(_jacobian(arm, chain, p), full_matrices=False)
        step = np.einsum("nji,nj,nkj,nk->ni", vt, 1.0 / np.maximum(s, 1e-6), u, e / scale)
        going = left[active].max(axis=1) > TOLERANCE
        if not going.any():
            break
        longest = np.abs(step).max(axis=1, keepdims=True)
        step *= np.minimum(1.0, MOST_TURN / np.maximum(longest, 1e-300))
        q[active[going]] += step[going]
        active = active[going]
    return Inverse(q, left[:, 0], left[:, 1])


def nominal_pose(arm: Arm, tool: Floats, q: Floats) -> Pose:
    """Where the nominal arm has a tool T_flange_tool (4, 4) at joint values (N, n)."""
    chain = evaluate(arm, q)
    return se3.product(chain.rotation[-1], tool[:3, :3]), chain.point(tool[:3, 3]), chain


def invert_nominal(
    arm: Arm, tool: Floats, q: Floats, rotation: Floats, position: Floats
) -> Inverse:
    """Find joint values at which the nominal arm has a tool; one pose or N, else as `invert`."""
    return invert(
        arm,
        lambda at, _: nominal_pose(arm, tool, at),
        q,
        np.broadcast_to(rotation, (len(q), 3, 3)),
        np.broadcast_to(position, (len(q), 3)),
    )


def singular(arm: Arm, chain: Chain, position: Floats) -> Bools:
    """(N,) whether poses with the tool at points (N, 3) are singular."""
    s = np.linalg.svd(_jacobian(arm, chain, position), compute_uv=False)
    return np.asarray(s[:, -1] < LEAST_SINGULAR * s[:, 0])


def _jacobian(arm: Arm, chain: Chain, position: Floats) -> Floats:
    """(N, 6, n) derivative of displacement over reach, and turn, by the controller's values."""
    jacobian = joint_jacobian(chain, position)
    jacobian[:, :3] /= arm.reach
    return jacobian if arm.coupling is None else np.asarray(jacobian @ arm.coupling)


def _error(r: Floats, p: Floats, rotation: Floats, position: Floats) -> Floats:
    """(N, 6) displacement and turn that are missing, base axes."""
    turn = se3.rotation_vector(se3.product(rotation, np.swapaxes(r, 1, 2)))
    return np.concatenate([position - p, turn], axis=1)
