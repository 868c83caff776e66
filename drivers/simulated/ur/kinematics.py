"""Nominal kinematics and weight of the arm, as its controller knows them."""

import numpy as np

from hilcal.robot.arm import Arm
from hilcal.types import Floats

GRAVITY = np.array([0.0, 0.0, -9.80665])


def rotation(vector: Floats) -> Floats:
    """Return the rotation matrix (3, 3) of a rotation vector: exp([w]), Rodrigues."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross))


def rotation_vector(matrix: Floats) -> Floats:
    """Return the rotation vector (3,) of a rotation matrix, angle in [0, pi]."""
    axis = np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    )
    sine, cosine = 0.5 * float(np.linalg.norm(axis)), 0.5 * (float(np.trace(matrix)) - 1.0)
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-6:
        return np.asarray(axis * (0.5 * angle / sine))
    if cosine > 0.0:
        return np.asarray(0.5 * axis)
    # close to a half turn: n nᵀ = (R + 1) / 2
    square = 0.5 * (matrix + np.eye(3))
    k = int(np.argmax(np.diag(square)))
    return np.asarray(angle * square[:, k] / np.sqrt(square[k, k]))


def transform(pose: Floats) -> Floats:
    """Return the (4, 4) transform of position and rotation vector (6,)."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation(pose[3:]), pose[:3]
    return out


def pose(place: Floats) -> Floats:
    """Return position and rotation vector (6,) of a transform (4, 4)."""
    return np.concatenate([place[:3, 3], rotation_vector(place[:3, :3])])


class Kinematics:
    """T_base_flange(q) = L_0 Rz(θ_1) L_1 ... Rz(θ_n) L_n of a nominal arm, θ = C q."""

    def __init__(self, arm: Arm) -> None:
        """Take the arm's constants."""
        self.arm = arm

    def frames(self, q: Floats) -> Floats:
        """Return (n + 1, 4, 4): the body frame of each joint (turned by it), and the flange."""
        arm = self.arm
        out = np.empty((arm.n + 1, 4, 4))
        place = arm.links[0]
        angle = arm.chain_angles(q)
        cos, sin = np.cos(angle), np.sin(angle)
        for k in range(arm.n):
            turn = np.eye(4)
            turn[:2, :2] = [[cos[k], -sin[k]], [sin[k], cos[k]]]
            out[k] = place @ turn
            place = out[k] @ arm.links[k + 1]
        out[arm.n] = place
        return out

    def flange(self, q: Floats) -> Floats:
        """Return T_base_flange (4, 4)."""
        return np.asarray(self.frames(q)[-1])

    def jacobian(self, q: Floats, point: Floats) -> Floats:
        """Return (6, n): velocity of a point (3,), base axes, and turn, per joint speed."""
        frames = self.frames(q)[:-1]
        axes = frames[:, :3, 2]
        by_angle = np.concatenate([np.cross(axes, point - frames[:, :3, 3]).T, axes.T])
        return by_angle if self.arm.coupling is None else by_angle @ self.arm.coupling

    def weight_torque(self, q: Floats, mass: float, com: Floats) -> Floats:
        """Return the (n,) torque that the arm's weight and a payload exert at its drives, N·m.

        tau_j = sum over bodies i >= j of z_j · ((c_i - p_j) x m_i g) about the axes; `com` (3,) in
        flange axes.
        """
        frames, arm = self.frames(q), self.arm
        centres = np.einsum("kij,kj->ki", frames[:-1, :3, :3], arm.coms) + frames[:-1, :3, 3]
        centres = np.vstack([centres, frames[-1, :3, :3] @ com + frames[-1, :3, 3]])
        forces = np.append(arm.masses, mass)[:, None] * GRAVITY
        torque = np.empty(arm.n)
        for j in range(arm.n):
            moments = np.cross(centres[j:] - frames[j, :3, 3], forces[j:])
            torque[j] = frames[j, :3, 2] @ moments.sum(axis=0)
        return self.arm.drive_torques(torque)
