"""The deviated chain, batched over N states, and its Jacobians.

    T_base_flange = L_0 exp(ξ_0) M_1(q_1 + dq_1) L_1 exp(ξ_1) ... M_n(q_n + dq_n) L_n exp(ξ_n)

with M = Rz of a revolute and Tz of a prismatic joint, evaluated exactly. Only the n joints are
looped over, not the states. Deviations are added before the chain is evaluated, once.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.se3 import along_states, by_field, empty
from hilcal.types import Bools, Floats


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
    """Departure of N states from the nominal chain; None stands for zero."""

    dq: Floats | None = None  # (N, n) of the drives, rad, see `Arm.drive`
    # (N, n + 1, 6) small rigid displacement beyond slot k, in the axes of slot k, m and rad
    twist: Floats | None = None
    base: Floats | None = None  # (N, 6) twist of the base relative to its registration, base axes
    station: Floats | None = None  # (N, 6) twist of the readings about the sensor's origin
    target: Floats | None = None  # (N, 6) displacement of the tracked target, flange axes
    scale: Floats | None = None  # (N,) relative scale error of the sensor's ranges
    # (N, 6) twist of the position in the axes of its observer, if there are several; of a distance,
    # which is invariant to rotation, element 3 is the offset, m
    observer: Floats | None = None

    def __add__(self, other: "Deviation") -> "Deviation":
        """Add two deviations element by element."""
        return by_field((self, other), lambda arrays: np.asarray(sum(arrays[1:], arrays[0])))


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Frames of the deviated chain in base axes."""

    rotation: Floats  # (n + 1, N, 3, 3) orientation of slot k, after its twist
    position: Floats  # (n + 1, N, 3) origin of slot k, after its twist, m
    com: Floats  # (n, N, 3) centre of mass of body i + 1, m
    twist: Floats | None  # (n + 1, N, 6) applied twists, or None
    slides: tuple[int, ...] = ()  # prismatic joints, counted from 0

    def point(self, offset: Floats) -> Floats:
        """Return positions of a point fixed in flange axes, offset (3,) or (N, 3) -> (N, 3)."""
        return np.asarray(self.position[-1] + se3.apply(self.rotation[-1], offset))


JointMotions = tuple[Floats, Floats, Floats]  # cos, sin (N, n); travel (N, n) of slides


def joint_motions(arm: Arm, q: Floats) -> JointMotions:
    """Return the motions of the chain's joints at the controller's values q (N, n)."""
    moved = along_states(arm.chain_angles(q))
    angle = moved * ~arm.slides
    return np.cos(angle), np.sin(angle), moved * arm.slides


def _turned(nominal: JointMotions, dq: Floats, slides: Bools) -> JointMotions:
    """Add displacements (N, n), by the addition theorems, which cost less than cos and sin."""
    cos, sin, slid = nominal
    dq, slid = dq * ~slides, slid + dq * slides
    t2 = dq * dq
    b, c = se3.coefficients(t2)
    by_cos, by_sin = 1 - b * t2, dq * (1 - c * t2)
    return cos * by_cos - sin * by_sin, sin * by_cos + cos * by_sin, slid


def evaluate(
    arm: Arm, q: Floats, deviation: Deviation | None = None, nominal: JointMotions | None = None
) -> Chain:
    """Evaluate the deviated chain at values q (N, n) of the controller.

    `nominal` are the `joint_motions` at q, if already computed.
    """
    deviation = deviation or Deviation()
    moved = joint_motions(arm, q) if nominal is None else nominal
    if deviation.dq is not None:
        moved = _turned(moved, along_states(arm.driven(deviation.dq)), arm.slides)
    cos, sin, slid = moved
    twist = deviation.twist
    if twist is not None:
        twist = np.swapaxes(along_states(twist), 0, 1)
    count, n = cos.shape
    cos, sin = cos[..., None], sin[..., None]
    rotation = empty(count, 3, 3, n + 1).transpose(3, 0, 1, 2)
    position = empty(count, 3, n + 1).transpose(2, 0, 1)
    com = empty(count, 3, n).transpose(2, 0, 1)
    body, linked = empty(count, 3, 3), empty(count, 3, 3)
    body[...] = np.eye(3)  # the frame that link k starts from
    p: Floats = np.zeros(3)
    coms = arm.coms.tolist()
    for k, link in enumerate(np.swapaxes(arm.links, 1, 2).tolist()):
        turned_by = twist is not None and twist[k].any()
        r = linked if turned_by else rotation[k]
        for axis in range(3):
            _combine(body, link[axis][:3], r[..., axis])
        position[k] = _offset(p, body, link[3])
        if twist is not None and turned_by:
            step_r = se3.rotation(twist[k][:, 3:])
            if twist[k][:, :3].any():
                position[k] += se3.apply(r, se3.exp(twist[k])[1])
            r = np.einsum("nij,njk->nik", linked, step_r, out=rotation[k])
        p = position[k]
        if k < n and arm.slides[k]:
            p = p + r[..., 2] * slid[:, k, None]
            body[...] = r
            com[k] = _offset(p, body, coms[k])
        elif k < n:
            c, s = cos[:, k], sin[:, k]
            np.multiply(r[..., 0], c, out=body[..., 0])
            body[..., 0] += r[..., 1] * s
            np.multiply(r[..., 1], c, out=body[..., 1])
            body[..., 1] -= r[..., 0] * s
            body[..., 2] = r[..., 2]
            com[k] = _offset(p, body, coms[k])
    return Chain(rotation, position, com, twist, tuple(np.flatnonzero(arm.slides).tolist()))


def _combine(axes: Floats, weights: Sequence[float], out: Floats) -> None:
    """Write Σ_j w_j a_j, a_j the columns of axes (N, 3, 3), to (N, 3); most w are zero."""
    first, *following = [j for j in range(3) if weights[j]] or [0]
    np.multiply(axes[..., first], weights[first], out=out)
    for j in following:
        out += axes[..., j] * weights[j]


def _offset(p: Floats, axes: Floats, offset: Sequence[float]) -> Floats:
    """Return points p (N, 3) or (3,) displaced by an offset (3,) along axes (N, 3, 3)."""
    for j in range(3):
        if offset[j]:
            p = p + axes[..., j] * offset[j]
    return p


def joint_jacobian(chain: Chain, x: Floats) -> Floats:
    """Return the geometric Jacobian (N, 6, n) of a flange-fixed point at x (N, 3) by chain angles.

    Column j is (z_j × (x − p_j), z_j), of a prismatic joint (z_j, 0); base axes, m/rad and rad/rad.
    """
    n = len(chain.com)
    z = np.swapaxes(chain.rotation[:n, :, :, 2], 0, 1)
    lever = x[:, None] - np.swapaxes(chain.position[:n], 0, 1)
    out = empty(len(x), 6, n)
    out[:, :3] = np.swapaxes(se3.cross(z, lever), 1, 2)
    out[:, 3:] = np.swapaxes(z, 1, 2)
    for j in chain.slides:
        out[:, :3, j], out[:, 3:, j] = out[:, 3:, j], 0.0
    return out


def drive_jacobian(arm: Arm, chain: Chain, x: Floats) -> Floats:
    """Return the geometric Jacobian (N, 6, n) by displacements of the drives."""
    out = joint_jacobian(chain, x)
    return out if arm.drive is None else np.asarray(out @ arm.drive)


def twist_jacobian(r: Floats, lever: Floats, twist: Floats | None) -> Floats:
    """Return the motion (N, 6, 6) of a point fixed to a frame, per change of the frame's twist.

        (v, ω) = [R, −[l]× R; 0, R] [J(ξ), Q(ξ); 0, J(ξ)] dξ

    with R (N, 3, 3) the frame's orientation after its twist ξ (N, 6), l (N, 3) the lever from its
    origin to the point, and J, Q the blocks of the right Jacobian (`se3`), in the outer axes of R.
    """
    out = empty(len(lever), 6, 6)
    shift: Floats | float = 0.0
    if twist is not None and np.any(twist):
        j, q = se3.right_jacobian_blocks(twist)
        r, shift = se3.product(r, j), se3.product(r, q) if q.any() else 0.0
    out[:, :3, :3] = out[:, 3:, 3:] = r
    out[:, 3:, :3] = 0.0
    columns = np.swapaxes(r, 1, 2)
    out[:, :3, 3:] = np.swapaxes(se3.cross(columns, lever[:, None]), 1, 2) + shift
    return out
