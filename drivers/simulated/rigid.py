"""Rigid displacements for the simulated world; its own code, apart from hilcal's."""

import numpy as np
import pinocchio as pin

from hilcal.types import Floats


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
    """Return Jacobians (N, 6, k) taken at a point that lies `arm` (N, 3) further, same axes.

    v' = v + omega × arm; rows are (v, omega), m and rad.
    """
    out = jacobian.copy()
    out[:, :3] += np.cross(jacobian[:, 3:], arm[:, :, None], axis=1)
    return out
