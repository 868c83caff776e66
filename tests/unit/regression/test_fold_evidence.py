"""The error that folds predict is the error on rows that were never there."""

import numpy as np

from hilcal.regression.empirical_bayes import FamilyProblem, maximise_evidence, solutions

GROUPS, MEMBERS, ROWS, FLAT, FOLDS = 100, 2, 300, 4, 10


def errors(seed: int) -> tuple[float, float, float]:
    """RMS error: promised by folds, promised with the strengths of all rows, and real."""
    rng = np.random.default_rng(seed)
    group = np.repeat(np.arange(GROUPS), MEMBERS)
    size = np.where(rng.random(GROUPS) < 0.2, 0.3, 0.0)[group]
    truth = np.concatenate([5 * rng.normal(size=FLAT), size * rng.normal(size=len(group))])
    a = rng.normal(size=(ROWS, len(truth)))
    y = a @ truth + rng.normal(size=ROWS)

    def fitted(rows: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        gram, rhs = rows.T @ rows, rows.T @ target
        found = maximise_evidence(
            gram, rhs, float(target @ target), len(rows), FLAT, group, np.full(len(group), 0.1)
        )
        return found.std, rhs, found.beta

    std, _, beta = fitted(a, y)
    problem = FamilyProblem(a, y, np.zeros((FLAT, FLAT)), np.zeros(FLAT), group, std, beta)
    fold = np.arange(ROWS) % FOLDS
    honest = solutions(problem, fold)

    def at(strengths: np.ndarray, rows: np.ndarray, target: np.ndarray) -> np.ndarray:
        live = np.append(np.arange(FLAT), FLAT + np.flatnonzero(strengths))
        ridge = np.append(np.zeros(FLAT), beta / strengths[strengths > 0] ** 2)
        x = rows[:, live]
        u = np.zeros(rows.shape[1])
        u[live] = np.linalg.solve(x.T @ x + np.diag(ridge), x.T @ target)
        return u

    def left(u_of: list[np.ndarray]) -> float:
        off = [y[fold == f] - a[fold == f] @ u for f, u in enumerate(u_of)]
        return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))

    kept = [at(std, a[fold != f], y[fold != f]) for f in range(FOLDS)]
    real = float(np.sqrt(1 + np.sum((at(std, a, y) - truth) ** 2)))
    return left(list(honest)), left(kept), real


def test_folds_promise_the_error_on_rows_that_were_never_there() -> None:
    found = np.array([errors(seed) for seed in range(20)])
    honest, fixed = found[:, 2] / found[:, 0], found[:, 2] / found[:, 1]
    # A fold has nine tenths of the rows, so that it promises a little too much error.
    assert 0.93 < np.mean(honest) < 1.03
    assert np.mean(fixed) > 1.1


def test_without_dropped_groups_and_shrinkage_a_fold_is_least_squares() -> None:
    rng = np.random.default_rng(0)
    a, truth = rng.normal(size=(200, 8)), rng.normal(size=8)
    y = a @ truth + 1e-3 * rng.normal(size=200)
    p = FamilyProblem(
        a / 1e-3, y / 1e-3, np.zeros((2, 2)), np.zeros(2), np.arange(6) // 3, np.ones(6), 1.0
    )
    fold = np.arange(200) % 5
    for f, u in enumerate(solutions(p, fold)):
        exact = np.linalg.lstsq(a[fold != f], y[fold != f], rcond=None)[0]
        np.testing.assert_allclose(u, exact, rtol=0, atol=1e-5)
