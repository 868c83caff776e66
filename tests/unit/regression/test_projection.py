"""The projection off a fitted model's columns, against dense algebra."""

import numpy as np
import pytest

from hilcal.regression.projection import projection
from tests.support.regression_cases import KINDS, problem


@pytest.mark.parametrize("kind", KINDS)
def test_products_are_those_of_the_dense_matrix(kind: str) -> None:
    of = problem(kind)
    p, m = of.projection, of.dense
    np.testing.assert_allclose(p.project_out(of.x), m @ of.x, atol=1e-12)
    np.testing.assert_allclose(p.project_out(of.y), m @ of.y, atol=1e-12)
    np.testing.assert_allclose(p.information(of.x), of.x.T @ m @ of.x, rtol=1e-12, atol=1e-11)
    q = p.root()
    np.testing.assert_allclose(np.eye(len(m)) - q @ q.T, m, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_the_effective_number_of_parameters_is_the_trace_of_the_hat_matrix(kind: str) -> None:
    of = problem(kind)
    hat = np.eye(len(of.y)) - of.dense
    assert of.projection.effective() == pytest.approx(np.trace(hat), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("off", [0.0, 0.3])
def test_the_residual_does_not_depend_on_where_the_model_stands(kind: str, off: float) -> None:
    of = problem(kind)
    z = of.estimate + off
    found = of.projection.residual(of.y - of.rows @ z, z)
    np.testing.assert_allclose(found, of.dense @ of.y, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_columns_that_depend_on_each_other_count_once(scale: float) -> None:
    rng = np.random.default_rng(0)
    own, y = rng.standard_normal((30, 3)), rng.standard_normal(30)
    double = scale * np.hstack([own, own @ rng.standard_normal((3, 2)), np.zeros((30, 1))])
    p, q = projection(double, np.zeros(6)), np.linalg.qr(own)[0]
    np.testing.assert_allclose(p.project_out(y), y - q @ (q.T @ y), atol=1e-10)
    assert p.effective() == pytest.approx(3.0)
