"""The projection off a fitted model's columns, against dense algebra."""

import numpy as np
import pytest

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
