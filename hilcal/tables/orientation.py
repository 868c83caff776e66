"""Orientations as instruments and robot makers write them.

Every convention gives the rotation R that maps the target's axes into the sensor's. Angles in
the order of their columns; "intrinsic" turns about the axes of the turned frame, "fixed" about
those of the frame that stands:

    intrinsic-zyx:  R = R_z(a) R_y(b) R_x(c)        fixed-xyz:  R = R_z(c) R_y(b) R_x(a)

Source of the makers' conventions: their manuals, as collected in the pose formats of the Basler
stereo visard documentation (KUKA, FANUC, ABB, Yaskawa, Mitsubishi, Universal Robots) and the
export formats of the SpatialAnalyzer manual.
"""

from itertools import permutations

import numpy as np

from hilcal.robot import se3
from hilcal.types import Floats

ROTATION_VECTOR, MATRIX, WXYZ, XYZW = "vector", "matrix", "wxyz", "xyzw"
QUATERNIONS = (WXYZ, XYZW)
NUMBERS = {ROTATION_VECTOR: 3, MATRIX: 9, WXYZ: 4, XYZW: 4}
"""Numbers of what is not three angles."""

_ORDERS = (
    *("".join(p) for p in permutations("xyz")),
    *(a + b + a for a in "xyz" for b in "xyz" if a != b),
)

CONVENTIONS: dict[str, str] = {
    "rotation-vector": ROTATION_VECTOR,
    "ur": ROTATION_VECTOR,
    "matrix": MATRIX,
    "quaternion-wxyz": WXYZ,
    "quaternion-xyzw": XYZW,
    "abb": WXYZ,
    "kuka": "ZYX",
    "fanuc": "xyz",
    "yaskawa": "xyz",
    "mitsubishi": "xyz",
    "staubli": "XYZ",
    "kawasaki": "ZYZ",
    "spatial-analyzer": "xyz",
    "roll-pitch-yaw": "xyz",
    **{f"intrinsic-{order}": order.upper() for order in _ORDERS},
    **{f"fixed-{order}": order for order in _ORDERS},
}
"""What each name means: a word of this module, or axes as scipy writes them (capital letters:
intrinsic). Rotations about fixed axes are intrinsic ones in the reverse order."""


def rotations(convention: str, numbers: Floats, unit: float) -> Floats:
    """(N, 3, 3) rotation matrices of the numbers (N, k) of a convention.

    Args:
        convention: a key of `CONVENTIONS`.
        numbers: in the order of the convention's columns; quaternions and matrices need not be
            exactly normalised, the nearest rotation is taken.
        unit: radians in the unit of angles.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    kind = CONVENTIONS[convention]
    if kind == ROTATION_VECTOR:
        return se3.rotation(unit * numbers)
    if kind == MATRIX:
        u, _, vt = np.linalg.svd(numbers.reshape(-1, 3, 3))
        return np.asarray(u @ vt)
    if kind in QUATERNIONS:
        xyzw = np.roll(numbers, -1, axis=1) if kind == WXYZ else numbers
        return np.asarray(Rotation.from_quat(xyzw).as_matrix())
    return np.asarray(Rotation.from_euler(kind, unit * numbers).as_matrix())


def defect(convention: str, numbers: Floats) -> Floats:
    """(N,) how far quaternions are from length 1, and matrices from orthogonal and right-handed."""
    kind = CONVENTIONS[convention]
    if kind in QUATERNIONS:
        return np.asarray(np.abs(np.linalg.norm(numbers, axis=1) - 1.0))
    if kind == MATRIX:
        m = numbers.reshape(-1, 3, 3)
        off = np.abs(m @ np.swapaxes(m, 1, 2) - np.eye(3)).max(axis=(1, 2))
        return np.asarray(np.where(np.linalg.det(m) > 0, off, np.maximum(off, 2.0)))
    return np.zeros(len(numbers))


def angle_axes(convention: str, numbers: Floats, unit: float) -> Floats:
    """(N, 3, 3) axes e_k, as columns, about which the sensor's frame sees each angle turn.

    A change da of the angles turns the target by E da in sensor axes; for rotation vectors,
    matrices and quaternions, whose uncertainty is given about the sensor's axes, E is 1.
    """
    kind = CONVENTIONS[convention]
    axes = np.broadcast_to(np.eye(3), (len(numbers), 3, 3)).copy()
    if kind in NUMBERS:
        return axes
    intrinsic = kind.isupper()
    order = kind.lower() if intrinsic else kind[::-1].lower()
    angles = unit * (numbers if intrinsic else numbers[:, ::-1])
    turned = np.broadcast_to(np.eye(3), (len(numbers), 3, 3))
    for k, axis in enumerate(order):
        unit_vector = np.eye(3)["xyz".index(axis)]
        axes[:, :, k if intrinsic else 2 - k] = turned @ unit_vector
        turned = turned @ se3.rotation(angles[:, k, None] * unit_vector)
    return axes
