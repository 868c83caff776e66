"""Units and conventions: their size in SI, lengths and durations, orientations.

Every convention gives the rotation R that maps the target's axes into the sensor's. Angles in
the order of their columns; "intrinsic" turns about the axes of the turned frame, "fixed" about
those of the sensor:

    intrinsic-zyx:  R = R_z(a) R_y(b) R_x(c)        fixed-xyz:  R = R_z(c) R_y(b) R_x(a)

Source of the makers' conventions: their manuals, as collected in the pose formats of the Basler
stereo visard documentation (KUKA, FANUC, ABB, Yaskawa, Mitsubishi, Universal Robots) and the
export formats of the SpatialAnalyzer manual.
"""

import math
import re
from collections.abc import Mapping
from itertools import permutations
from typing import Literal

import numpy as np

from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.types import Floats

Length = Literal["m", "cm", "mm", "um", "in"]
Angle = Literal["rad", "mrad", "deg", "arcsec"]
Temperature = Literal["degC", "degF", "K"]
METRIC = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6}
LENGTHS = {**METRIC, "cm": 1e-2, "in": 0.0254}  # Metres in a unit
ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295, "arcsec": 4.84813681109536e-6}
"""Radians in a unit."""
FORCES = {"N": 1.0, "kN": 1e3, "kgf": 9.80665, "lbf": 4.4482216152605}  # Newtons in a unit
MOMENTS = {"Nm": 1.0, "Nmm": 1e-3, "kNm": 1e3}  # Newton metres in a unit
MASSES = {"kg": 1.0, "g": 1e-3, "lb": 0.45359237}  # Kilograms in a unit
SECONDS = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}  # Seconds in a unit of time
TIMES = {**SECONDS, "us": 1e-6, "ns": 1e-9}  # Seconds in a unit of the times of a table
_QUANTITY = re.compile(
    r"\s*(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>\S*)\s*"
)


def parse_length(text: str, option: str) -> float:
    """Return a length in m, e.g. of "0.1 mm"."""
    return _parse(text, option, METRIC, 'a length over 0 in m, mm, um, e.g. "0.1 mm"')


def parse_duration(text: str, option: str) -> float:
    """Return a duration in s, e.g. of "90 min"."""
    return _parse(text, option, SECONDS, 'a duration over 0 in s, min, h, e.g. "90 min"')


def _parse(text: str, what: str, units: Mapping[str, float], valid: str) -> float:
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise InputError(f'{what} "{text}" is not understood; valid: {valid}')
    if match["unit"] not in units:
        wrong = f'has the unit "{match["unit"]}"' if match["unit"] else "has no unit"
        raise InputError(f'{what} "{text}" {wrong}; valid: {valid}')
    number = float(match["number"]) * units[match["unit"]]
    if not 0 < number < math.inf:
        raise InputError(f'{what} "{text}" is not over 0; valid: {valid}')
    return number


ROTATION_VECTOR, MATRIX, WXYZ, XYZW = "vector", "matrix", "wxyz", "xyzw"
QUATERNIONS = (WXYZ, XYZW)
NUMBERS = {ROTATION_VECTOR: 3, MATRIX: 9, WXYZ: 4, XYZW: 4}  # Where it is not three angles

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
"""Meaning of each name: one of the kinds above, or axes as scipy writes them (capital letters:
intrinsic). Rotations about fixed axes are intrinsic ones in the reverse order."""


def rotations(convention: str, numbers: Floats, unit: float) -> Floats:
    """(N, 3, 3) rotations nearest to numbers (N, k) of a convention; `unit` of angles, rad."""
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
