"""Damped Gauss-Newton against scipy's, on a curved valley and on rotations."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from hilcal.errors import CannotAnswerError
from hilcal.identification.solver import minimise, shortened
from hilcal.types import Floats


@dataclass(frozen=True)
class Valley:
    """Rosenbrock's function, and a third row so that a residual is left; forbidden for x > most."""

    x: float
    y: float
    most: float = np.inf

    @property
    def residual(self) -> Floats:
        if self.x > self.most:
            raise CannotAnswerError("forbidden")
        return np.array([1 - self.x, 10 * (self.y - self.x**2), 0.3 + self.y])

    def jacobian(self) -> Floats:
        return np.array([[1.0, 0.0], [20 * self.x, -10.0], [0.0, -1.0]])

    def moved(self, step: Floats) -> "Valley":
        return replace(self, x=self.x + step[0], y=self.y + step[1])


@pytest.mark.parametrize("most", [np.inf, 0.9])
@pytest.mark.parametrize("start", [(-1.2, 1.0), (0.5, -3.0)])
def test_the_minimum_is_that_of_scipy(start: tuple[float, float], most: float) -> None:
    found = minimise(Valley(*start, most), steps=100)
    expected = least_squares(lambda x: Valley(*x).residual, start, xtol=1e-14, ftol=1e-14).x
    np.testing.assert_allclose([found.x, found.y], expected, atol=1e-5)


@dataclass(frozen=True)
class Turned:
    """A rotation that takes vectors (N, 3) to others, in steps about the turned axes."""

    vectors: Floats
    others: Floats
    turn: Rotation

    @property
    def residual(self) -> Floats:
        return (self.others - self.turn.apply(self.vectors)).reshape(-1)

    def jacobian(self) -> Floats:
        each = [np.cross(axis, self.turn.apply(self.vectors)) for axis in np.eye(3)]
        return np.stack(each, axis=2).reshape(-1, 3)

    def moved(self, step: Floats) -> "Turned":
        return replace(self, turn=Rotation.from_rotvec(step) * self.turn)


@pytest.mark.parametrize("seed", range(5))
def test_rotations_are_found_from_far_off(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vectors, true = rng.normal(size=(10, 3)), Rotation.from_rotvec(rng.uniform(-1.2, 1.2, 3))
    others = true.apply(vectors) + 1e-3 * rng.normal(size=(10, 3))
    found = minimise(Turned(vectors, others, Rotation.identity())).turn
    expected = Rotation.align_vectors(others, vectors)[0]
    assert (found * expected.inv()).magnitude() < 1e-7


def test_a_step_is_shortened_until_it_can_be_taken() -> None:
    def moved(step: Floats) -> float:
        if step[0] > 1.0:
            raise CannotAnswerError("too far")
        return float(step[0])

    step = np.array([3.0])
    assert shortened(moved, step, 3) == 0.75
    assert shortened(moved, step, 4, cost=lambda x: x, limit=0.5) == 0.375
    assert shortened(moved, step, 2) is None
