"""Prediction of rows left out and models without columns, against explicit refits."""

import numpy as np
import pytest

from hilcal.identification.linearisation import eliminate_columns
from hilcal.regression.leave_out import FamilyFolds, folds
from hilcal.regression.normal_equations import find_basis, normal_equations
from hilcal.regression.schur import projection

PRIOR = np.array([np.inf, np.inf, 0.5, 2.0, np.inf, 1.0])
MAGNITUDE = np.array([1.0, 2.0, 1.0, 1.0, 0.5, 1.0])


def refit(a, y, std, beta):
    """Parameters of least squares with priors about zero, by rows that are appended."""
    known = np.isfinite(std)
    more = np.sqrt(beta) * np.eye(len(std))[known] / std[known][:, None]
    return np.linalg.lstsq(np.vstack([a, more]), np.append(y, np.zeros(len(more))), rcond=None)[0]


def case(beta):
    """Columns (R, 6), family (R, 2), data, and the parameters of the fit."""
    rng = np.random.default_rng(2)
    a, x = rng.standard_normal((60, 6)), rng.standard_normal((60, 2))
    y = a @ rng.standard_normal(6) + x @ np.array([0.5, -1.0]) + rng.standard_normal(60)
    return a, x, y, refit(a, y, PRIOR, beta)


def model(beta):
    """Folds and columns of the fit of `case`, its basis and residual, and a family."""
    a, x, y, theta = case(beta)
    basis = find_basis(a, np.ones(6), PRIOR)
    equations = normal_equations(a, y, basis, a.T @ a)
    p = projection(a @ basis.transform, beta * basis.prior_precision)
    fold = np.arange(60) % 5
    each = folds(p, y - a @ theta, equations, theta, PRIOR, MAGNITUDE, beta, fold)
    return each, p, basis, y - a @ theta, x


@pytest.mark.parametrize("beta", [1.0, 2.5])
def test_rows_left_out_are_predicted_as_by_a_refit_without_them(beta):
    a, x, y, theta = case(beta)
    each, p, basis, white, _ = model(beta)
    fold, ridge, family = np.arange(60) % 5, 0.8, FamilyFolds(each, x)
    before = each.left_out(white, of_fit=True)
    predicted, alone = family.left_out(before, ridge), before.residual
    information = p.schur(family.gram, family.cross)
    np.testing.assert_allclose(information, p.information(x), rtol=1e-11, atol=1e-12)
    # Without a fold the flat parameters have a prior, too.
    std = np.where(np.isinf(PRIOR), MAGNITUDE, PRIOR)
    for f in range(5):
        out = fold == f
        whole = np.hstack([a, x])
        both = refit(whole[~out], y[~out], np.append(std, np.full(2, np.sqrt(beta / ridge))), beta)
        np.testing.assert_allclose(predicted[out], y[out] - whole[out] @ both, atol=1e-4)
        bare = refit(a[~out], y[~out], std, beta)
        np.testing.assert_allclose(alone[out], y[out] - a[out] @ bare, atol=1e-4)
        step = basis.transform @ each.folds[f].step()
        np.testing.assert_allclose(theta + step, bare, atol=1e-4)


@pytest.mark.parametrize("ridge", [0.0, 0.8, 40.0])
def test_simulated_residuals_are_predicted_as_by_refits_without_their_fold(ridge):
    each, p, _, _, x = model(1.0)
    y = np.random.default_rng(6).standard_normal((60, 3))
    family, before = FamilyFolds(each, x), each.left_out(y)
    for again in (ridge, 2.0, ridge):  # another ridge in between changes nothing
        left = family.left_out(before, again)
    alone = before.residual
    for fold in each.folds:
        rows, stay = p.rows[fold.left_out_rows], ~fold.left_out_rows
        h = np.linalg.inv(fold.inverse_root.T @ fold.inverse_root)
        cross = p.rows[stay].T @ x[stay]
        block = x[stay].T @ x[stay] + ridge * np.eye(2)
        rhs = np.vstack([p.rows[stay].T @ y[stay], x[stay].T @ y[stay]])
        step = np.linalg.solve(np.block([[h, cross], [cross.T, block]]), rhs)
        expected = y[fold.left_out_rows] - np.hstack([rows, x[fold.left_out_rows]]) @ step
        np.testing.assert_allclose(left[fold.left_out_rows], expected, atol=1e-8)
        plain = y[fold.left_out_rows] - rows @ np.linalg.solve(h, p.rows[stay].T @ y[stay])
        np.testing.assert_allclose(alone[fold.left_out_rows], plain, atol=1e-8)


@pytest.mark.parametrize("out", [[0], [2, 3], [4, 5], [0, 1, 4]])
def test_a_model_without_columns_is_as_a_refit_without_them(out):
    beta = 1.7
    a, _, y, theta = case(beta)
    removed = np.isin(np.arange(6), out)
    reduced = eliminate_columns(a, a.T @ a, y - a @ theta, theta, PRIOR, removed, beta, 60)
    again = refit(a[:, ~removed], y, PRIOR[~removed], beta)
    np.testing.assert_allclose(reduced.residual, y - a[:, ~removed] @ again, atol=1e-11)
    h = a[:, ~removed].T @ a[:, ~removed] + np.diag(beta / PRIOR[~removed] ** 2)
    spent = np.trace(np.linalg.solve(h, a[:, ~removed].T @ a[:, ~removed]))
    assert reduced.dof == pytest.approx(60 - spent, rel=1e-12)
    s = removed.sum()
    assert reduced.score().rank == s
