"""LAPACK outside of Python's lock: the same bits as by scipy, and errors in words."""

import sys
import threading
import time

import numpy as np
import pytest
import scipy.linalg as sl

from hilcal.regression import lapack
from hilcal.types import Floats

SIZES = [0, 1, 2, 7, 130]


def positive(size: int) -> Floats:
    a = np.random.default_rng(size).normal(size=(size, size + 3))
    return np.asarray(a @ a.T)


@pytest.mark.parametrize("lower", [True, False])
@pytest.mark.parametrize("size", SIZES[1:])
def test_factor_and_inverse_are_those_of_scipy(size: int, lower: bool) -> None:
    a = positive(size)
    found = lapack.column_major(a)
    assert lapack.factorise(found, lower)
    wanted, _ = sl.lapack.dpotrf(a, lower=lower)
    np.testing.assert_array_equal(found, wanted)
    lapack.invert(found, lower)
    np.testing.assert_array_equal(found, sl.lapack.dtrtri(wanted, lower=lower)[0])


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("shape", [(), (4,)])
def test_solutions_solve(size: int, shape: tuple[int, ...]) -> None:
    a = positive(size)
    b = np.random.default_rng(1).normal(size=(size, *shape))
    low = lapack.column_major(a)
    assert lapack.factorise(low)
    found = lapack.column_major(b)
    lapack.solve_factored(low, found)
    np.testing.assert_allclose(a @ found, b, atol=1e-6)
    found = lapack.column_major(b)
    lapack.solve_triangle(low, found)
    np.testing.assert_allclose(low @ found, b, atol=1e-9)
    lapack.solve_triangle(low, found, transposed=True)
    np.testing.assert_allclose(a @ found, b, atol=1e-6)


def test_what_is_not_positive_definite_is_told() -> None:
    assert not lapack.factorise(np.asfortranarray([[1.0, 2.0], [2.0, 1.0]]))


def test_a_singular_triangle_is_refused() -> None:
    singular = np.asfortranarray([[1.0, 0.0], [1.0, 0.0]])
    with pytest.raises(np.linalg.LinAlgError, match="zero in its diagonal"):
        lapack.invert(singular)
    with pytest.raises(np.linalg.LinAlgError, match="zero in its diagonal"):
        lapack.solve_triangle(singular, np.ones(2))


@pytest.mark.parametrize("a", [np.arange(4.0).reshape(2, 2), np.eye(2, dtype=np.float32)])
def test_other_memory_than_of_lapack_is_refused(a: Floats) -> None:
    with pytest.raises(ValueError, match="column-major matrices of double precision"):
        lapack.factorise(a)


def test_python_runs_beside_it() -> None:
    a = lapack.column_major(positive(1500))
    counted, stop = [0], threading.Event()

    def count() -> None:
        while not stop.is_set():
            counted[0] += 1
            time.sleep(0)

    interval = sys.getswitchinterval()
    other = threading.Thread(target=count)
    try:
        sys.setswitchinterval(100.0)  # threads change only where one gives up the lock itself
        other.start()
        before = counted[0]
        assert lapack.factorise(a)
        during = counted[0] - before
    finally:
        sys.setswitchinterval(interval)
        stop.set()
        other.join()
    assert during
