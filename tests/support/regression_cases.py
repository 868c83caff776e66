"""Random linear problems, and the same in dense algebra."""

from dataclasses import dataclass

import numpy as np

from hilcal.regression.schur import projection
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A model with and without priors, fitted to y, and a family beside it."""

    rows: Floats  # (R, K) columns of the model
    ridge: Floats  # (K,) of their priors
    x: Floats  # (R, P) columns of the family
    y: Floats  # (R,) the data

    @property
    def projection(self):
        return projection(self.rows, self.ridge)

    @property
    def dense(self):
        """M (R, R)."""
        h = self.rows.T @ self.rows + np.diag(self.ridge)
        return np.eye(len(self.y)) - self.rows @ np.linalg.inv(h) @ self.rows.T

    @property
    def estimate(self):
        h = self.rows.T @ self.rows + np.diag(self.ridge)
        return np.linalg.solve(h, self.rows.T @ self.y)


def problem(kind="priors", rows=60, family=4, noise=1.0, seed=0):
    """Return a random problem; kinds: "flat", "priors", "no columns", "rank deficient"."""
    rng = np.random.default_rng(seed)
    size = 0 if kind == "no columns" else 7
    b = rng.standard_normal((rows, size))
    ridge = np.zeros(size)
    if kind != "flat":
        ridge[size // 2 :] = rng.uniform(0.1, 30.0, size - size // 2)
    x = rng.standard_normal((rows, family)) * np.logspace(-0.5, 1, family)
    if size:
        x += b[:, :1]
    if kind == "rank deficient":
        x = np.hstack([x, x[:, :1] + x[:, 1:2], b[:, :1]])
    y = noise * rng.standard_normal(rows) + b @ rng.standard_normal(size)
    y += x[:, :family] @ (0.7 / np.logspace(-0.5, 1, family))
    return Problem(b, ridge, x, y)


KINDS = ("flat", "priors", "no columns", "rank deficient")
