"""Exponential, logarithm, adjoint and right Jacobian against SciPy and finite differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.robot import se3
from hilcal.types import Floats
from tests.support.arm_cases import displacement, slope

MAGNITUDES = (0.0, 1e-9, 1e-6, 1e-3, 0.1, 0.499, 0.501, 1.0, 3.0, 3.14)
magnitudes = st.floats(-9, np.log10(3.0)).map(lambda e: float(10.0**e))
seeds = st.integers(0, 2**32 - 1)


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


@given(seeds, magnitudes)
def test_rotation_and_its_vector_are_inverse(seed: int, magnitude: float) -> None:
    w = vectors(seed, magnitude)
    back = se3.rotation_vector(se3.rotation(w))
    np.testing.assert_allclose(back, w, rtol=0, atol=2e-15 + 1e-13 * magnitude)


@pytest.mark.parametrize("short", [0.0, 1e-15, 1e-12, 1e-8, 1e-4, 0.1])
def test_vectors_of_rotations_by_about_half_a_turn(short: float) -> None:
    w = np.random.default_rng(2).standard_normal((200, 3))
    w = np.vstack([w, np.eye(3), -np.eye(3), np.eye(3)[:2] + np.eye(3)[1:]])
    w *= (np.pi - short) / np.linalg.norm(w, axis=1, keepdims=True)
    r = se3.rotation(w)
    found = se3.rotation_vector(r)
    assert np.linalg.norm(found, axis=1).max() <= np.pi + 1e-15
    np.testing.assert_allclose(se3.rotation(found), r, rtol=0, atol=1e-14)


def right_jacobian(twist: Floats) -> Floats:
    j, q = se3.right_jacobian_blocks(twist)
    return np.block([[j, q], [np.zeros((3, 3)), j]])


@given(seeds, magnitudes)
def test_right_jacobian_is_the_slope_of_exp(seed: int, magnitude: float) -> None:
    # exp(ξ)⁻¹ exp(ξ + δ) = exp(J_r(ξ) δ): the twist of the left side is read off its matrix.
    xi, h = twists(seed, magnitude, 1)[0], 2e-3
    back = se3.inverse(se3.matrix(*se3.exp(xi)))

    def relative(t: float, unit: Floats) -> Floats:
        m = back @ se3.matrix(*se3.exp(xi + t * unit))
        return np.array([*m[:3, 3], m[2, 1], m[0, 2], m[1, 0]])

    expected = np.array([slope(lambda t, u=u: relative(t, u), h) for u in np.eye(6)]).T
    np.testing.assert_allclose(right_jacobian(xi), expected, rtol=0, atol=1e-10)


@given(seeds, magnitudes, magnitudes)
def test_adjoint_carries_twists(seed: int, outer: float, inner: float) -> None:
    t = displacement(twists(seed, outer, 1)[0])
    xi = twists(seed + 5, inner, 1)[0]
    ad = se3.adjoint(t[:3, :3], t[:3, 3])
    # T exp(ξ) T⁻¹ = exp(Ad_T ξ)
    carried = t @ displacement(xi) @ se3.inverse(t)
    np.testing.assert_allclose(displacement(ad @ xi), carried, rtol=0, atol=1e-12)


@given(seeds)
def test_small_products_are_those_of_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b, v = rng.normal(size=(2, 5, 3, 3)), rng.normal(size=(5, 3, 3)), rng.normal(size=(5, 3))
    np.testing.assert_allclose(se3.product(a, b), a @ b, rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.apply(a, v), (a @ v[..., None])[..., 0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.cross(a, v[:, None]), np.cross(a, v[:, None]), atol=1e-14)
    np.testing.assert_allclose(se3.apply(se3.skew(v), b[:, 0]), np.cross(v, b[:, 0]), atol=1e-14)


def test_one_twist_and_none_at_all() -> None:
    r, p = se3.exp(np.zeros(6))
    np.testing.assert_array_equal(r, np.eye(3))
    np.testing.assert_array_equal(p, np.zeros(3))
    r, p = se3.exp(np.zeros((0, 6)))
    assert (r.shape, p.shape) == ((0, 3, 3), (0, 3))
    assert [x.shape for x in se3.right_jacobian_blocks(np.zeros((0, 6)))] == [(0, 3, 3)] * 2
