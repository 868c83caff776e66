"""Exponential, logarithm, adjoint and right Jacobian against SciPy and finite differences."""

import numpy as np
import pytest

from hilcal.robot import se3
from hilcal.types import Floats
from tests.support.arm_cases import displacement

MAGNITUDES = (0.0, 1e-9, 1e-6, 1e-3, 0.1, 0.499, 0.501, 1.0, 3.0, 3.14)


def vectors(seed: int, magnitude: float, count: int = 4) -> Floats:
    """Random vectors (count, 3) of one length."""
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return magnitude * v / np.linalg.norm(v, axis=1, keepdims=True)


def twists(seed: int, magnitude: float, count: int = 4) -> Floats:
    """Twists (count, 6) that turn by `magnitude` and shift by about 1."""
    v = np.random.default_rng(seed + 1).normal(size=(count, 3))
    return np.hstack([v, vectors(seed, magnitude, count)])


@pytest.mark.parametrize("magnitude", MAGNITUDES)
def test_exp_is_the_matrix_exponential(magnitude: float) -> None:
    xi = twists(0, magnitude)
    expected = np.array([displacement(x) for x in xi])
    np.testing.assert_allclose(se3.matrix(*se3.exp(xi)), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.rotation(xi[:, 3:]), expected[:, :3, :3], rtol=0, atol=1e-14)


@pytest.mark.parametrize("short", [0.0, 1e-15, 1e-12, 1e-8, 1e-4, 0.1])
def test_vectors_of_rotations_by_about_half_a_turn(short: float) -> None:
    w = np.random.default_rng(2).standard_normal((200, 3))
    w = np.vstack([w, np.eye(3), -np.eye(3), np.eye(3)[:2] + np.eye(3)[1:]])
    w *= (np.pi - short) / np.linalg.norm(w, axis=1, keepdims=True)
    r = se3.rotation(w)
    found = se3.rotation_vector(r)
    assert np.linalg.norm(found, axis=1).max() <= np.pi + 1e-15
    np.testing.assert_allclose(se3.rotation(found), r, rtol=0, atol=1e-14)


def test_one_twist_and_none_at_all() -> None:
    r, p = se3.exp(np.zeros(6))
    np.testing.assert_array_equal(r, np.eye(3))
    np.testing.assert_array_equal(p, np.zeros(3))
    r, p = se3.exp(np.zeros((0, 6)))
    assert (r.shape, p.shape) == ((0, 3, 3), (0, 3))
    assert [x.shape for x in se3.right_jacobian_blocks(np.zeros((0, 6)))] == [(0, 3, 3)] * 2
