"""A step of many rows is solved by QR: exact to what its condition leaves, as LAPACK's lstsq is."""

import numpy as np
import pytest
import scipy.linalg as sl

from hilcal.identification.gauss_newton import NewtonPoint, linear_problem, regularise
from hilcal.regression.normal_equations import TALL
from hilcal.types import Floats


def nearly_dependent(condition: float, columns: int) -> Floats:
    """Rows (2 TALL, P) of that condition number, whose columns have units over eight decades."""
    rng = np.random.default_rng(5)
    q = np.linalg.qr(rng.standard_normal((2 * TALL, columns)))[0]
    turn = np.linalg.qr(rng.standard_normal((columns, columns)))[0]
    return np.asarray(q * np.geomspace(1e8, 1e8 / condition, columns) @ turn)


def solved(a: Floats, white: Floats, scale: Floats) -> Floats:
    """Step of Gauss-Newton from zero, all parameters without a prior."""
    columns = a.shape[1]
    start, prior = np.zeros(columns), np.full(columns, np.inf)
    point = NewtonPoint(start, start, float(white @ white), white.size)
    linear = linear_problem(point, prior, a, white, len(a), 1.0, whitened=True)
    assert len(linear.a) == columns + 1
    assert linear.rows is a
    by = regularise(linear, scale, prior, np.full(columns, -1), choose=False)
    return np.asarray(by.basis.transform @ linear.equations(by.basis).solve(by.beta))


@pytest.mark.parametrize("condition", [1e2, 1e5, 1e8])
def test_errors_are_those_of_lapacks_qr(condition: float) -> None:
    """At 1e8 the normal equations AᵀA have no correct digit."""
    rng = np.random.default_rng(6)
    columns = 8
    a, units = nearly_dependent(condition, columns), np.geomspace(1e-4, 1e4, columns)
    truth = rng.standard_normal(columns)
    noise = rng.standard_normal(len(a))
    exact = np.linalg.lstsq(a, noise, rcond=None)[0]
    white = a @ truth + 1e-6 * (noise - a @ exact)
    error = np.abs(units * solved(a * units, white, 1 / units) - truth).max()
    lapack = np.abs(sl.lstsq(a, white, lapack_driver="gelsy")[0] - truth).max()
    assert error < 10 * max(lapack, 1e-14 * condition)
    if condition == 1e8:
        squared = np.abs(np.linalg.solve(a.T @ a, a.T @ white) - truth).max()
        assert squared > 1e3 * error
