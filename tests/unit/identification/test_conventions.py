"""The nominal arm tells which convention orientations are written in."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.config import load_config
from hilcal.identification.table_preview import clearly_best, rank_conventions
from hilcal.robot.catalogue import load_arm
from tests.support.foreign_tables import CELL, campaign

ARM = load_arm(load_config(CELL).robot.model)
C = campaign(30)
# an arm's own errors: about a milliradian
ATTITUDE = C.attitude * Rotation.from_rotvec(1e-3 * np.random.default_rng(2).normal(size=(30, 3)))


@pytest.mark.parametrize("order", ["XYZ", "ZYX", "xyz", "zyx", "ZYZ", "zxz", "YZX"])
def test_three_angles(order: str) -> None:
    ranked = rank_conventions(ARM, C.q, C.position, ATTITUDE.as_euler(order), 1.0)
    kind = "intrinsic" if order.isupper() else "fixed"
    assert clearly_best(ranked) == f"{kind}-{order.lower()}"
    assert ranked[0].angle < 3e-3
    assert ranked[0].position < 1e-3


def test_rotation_vectors_and_quaternions() -> None:
    ranked = rank_conventions(ARM, C.q, C.position, ATTITUDE.as_rotvec(degrees=True), np.pi / 180)
    assert clearly_best(ranked) == "rotation-vector"
    for shift, name in ((0, "quaternion-xyzw"), (1, "quaternion-wxyz")):
        numbers = np.roll(ATTITUDE.as_quat(), shift, axis=1)
        ranked = rank_conventions(ARM, C.q, C.position, numbers, 1.0)
        assert clearly_best(ranked) == name


def test_one_axis_tells_nothing() -> None:
    """All conventions turn about z in the same way."""
    angle = np.linspace(-1, 1, 12)
    q = np.zeros((12, 6))
    q[:, 0] = angle
    numbers = np.stack([0 * angle, 0 * angle, angle], axis=1)
    ranked = rank_conventions(ARM, q, C.position[:12], numbers, 1.0)
    assert clearly_best(ranked) is None


def test_what_is_no_orientation_is_not_decided() -> None:
    noise = np.random.default_rng(0).uniform(-3, 3, (30, 3))
    ranked = rank_conventions(ARM, C.q, C.position, noise, 1.0)
    assert clearly_best(ranked) is None
    assert rank_conventions(ARM, C.q[:4], C.position[:4], noise[:4], 1.0) == ()
