"""Coordinates in which the prior of a model's parameters is independent.

    θ = m + U y

y of unit variance, or flat along directions without information; y = θ for parameters without a
carried prior. With Λ the prior information in ordinary magnitudes and E its eigenvectors with
eigenvalues λ > 0, N the others, D the variances of the drift,

    U = [E L, N],    L Lᵀ = (1 + δ_0²) diag(1/λ) + Eᵀ D E

so that the prior has the information ((1 + δ_0²) Λ⁻¹ + D)⁻¹ where Λ has some, and none elsewhere.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy.linalg as sl

from hilcal.identification.carried import CarriedPrior
from hilcal.identification.posterior import Posterior
from hilcal.identification.priors import names_of
from hilcal.model.model import Model
from hilcal.regression.normal_equations import INFORMATION
from hilcal.regression.schur import schur_complement
from hilcal.types import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """θ = m + U y of the K parameters at `index`, θ = y of all others.

    Attributes:
        index: (K,) parameters of the model with a carried prior; y has theirs at the same places.
        mean: (K,) m, SI.
        matrix: (K, K) U, SI.
        inverse: (K, K) y = inverse (θ − m).
        std: (K,) standard deviations of y: 1, infinite for flat ones, 0 for those left out.
        rest: (K,) variance of θ by the coordinates that were left out, SI.
    """

    index: Ints
    mean: Floats
    matrix: Floats
    inverse: Floats
    std: Floats
    rest: Floats

    def theta(self, y: Floats) -> Floats:
        """(P,) parameters."""
        if not len(self.index):
            return y
        out = y.copy()
        out[self.index] = self.mean + self.matrix @ y[self.index]
        return out

    def of_theta(self, theta: Floats) -> Floats:
        """(P,) y."""
        if not len(self.index):
            return theta
        out = theta.copy()
        out[self.index] = self.inverse @ (theta[self.index] - self.mean)
        return out

    def transform(self, t: Floats) -> Floats:
        """(P, Q) change of θ by changes of y (P, Q)."""
        if not len(self.index):
            return t
        out = t.copy()
        out[self.index] = self.matrix @ t[self.index]
        return out

    def columns(self, a: Floats) -> Floats:
        """(R, P) derivatives by y of derivatives by θ (R, P)."""
        if not len(self.index):
            return a
        out = a.copy()
        out[:, self.index] = a[:, self.index] @ self.matrix
        return out

    def prior(self, std: Floats) -> Floats:
        """Prior standard deviations (P,) of y; `std` where there is no carried one."""
        out = std.copy()
        out[self.index] = self.std
        return out

    def scales(self, scale: Floats) -> Floats:
        """(P,) ordinary magnitudes of y, of those of θ."""
        out = scale.copy()
        out[self.index] = 1.0
        return out

    def carried(self, size: int) -> Bools:
        """(P,) which parameters have a carried prior."""
        out = np.zeros(size, dtype=np.bool_)
        out[self.index] = True
        return out

    def felt(self, a: Floats) -> "Coordinates":
        """Return coordinates of which only those are kept that rows A (R, P) by θ depend on.

        Readings say nothing of the others, so that these stay where the prior has them. The same
        where there are more rows than coordinates.
        """
        held = np.flatnonzero(self.std == 1.0)
        if len(a) >= len(held):
            return self
        u = self.matrix[:, held]
        turn = sl.qr((a[:, self.index] @ u).T, mode="economic", check_finite=False)[0]
        count = turn.shape[1]
        matrix, inverse, std = self.matrix.copy(), self.inverse.copy(), self.std.copy()
        matrix[:, held], inverse[held], std[held] = 0.0, 0.0, 0.0
        kept = held[:count]
        matrix[:, kept] = u @ turn
        inverse[kept] = turn.T @ self.inverse[held]
        std[kept] = 1.0
        rest = np.sum(u**2, axis=1) - np.sum(matrix[:, kept] ** 2, axis=1)
        return replace(self, matrix=matrix, inverse=inverse, std=std, rest=np.maximum(rest, 0.0))


def coordinates_of(model: Model) -> Coordinates:
    """Return the coordinates of a model's parameters; y = θ where it has no carried prior."""
    if model.prior is None:
        none = np.zeros(0)
        return Coordinates(none.astype(np.int64), none, none[:, None], none[:, None], none, none)
    return _coordinates(model.prior, names_of(model))


@lru_cache(maxsize=3)
def _coordinates(prior: CarriedPrior, names: tuple[str, ...]) -> Coordinates:
    p = prior.posterior
    index, own = prior.index_in(names)
    values, vectors = _spectrum(p, tuple(own.tolist()))
    scale = p.scale[own]
    seen = values > 0
    root = vectors[:, seen] / np.sqrt(values[seen])
    back = np.sqrt(values[seen])[:, None] * vectors[:, seen].T
    if prior.drift is not None and prior.drift.any():
        drift = prior.drift[1:]
        variance = (drift[prior.group[own]] * prior.unit[own] / scale) ** 2
        e = vectors[:, seen]
        inner = (e.T * variance) @ e
        inner[np.diag_indices_from(inner)] += (1.0 + prior.drift[0] ** 2) / values[seen]
        low = np.linalg.cholesky(inner)
        root = e @ low
        back = sl.solve_triangular(low, e.T, lower=True, check_finite=False)
    matrix = np.hstack([root, vectors[:, ~seen]])
    inverse = np.vstack([back, vectors[:, ~seen].T])
    std = np.concatenate([np.ones(root.shape[1]), np.full(int((~seen).sum()), np.inf)])
    return Coordinates(
        index,
        p.mean[own],
        scale[:, None] * matrix,
        inverse / scale,
        std,
        np.zeros(len(index)),
    )


@lru_cache(maxsize=3)
def _spectrum(p: Posterior, own: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Eigenvalues and eigenvectors of the information on some parameters, in ordinary magnitudes.

    Those without information are zero. Without any information the axes are the parameters.
    """
    scaled = p.information * (p.scale[:, None] * p.scale)
    rows = np.array(own, dtype=np.int64)
    some = scaled if len(own) == len(scaled) else schur_complement(scaled, rows)
    values, vectors = np.linalg.eigh((some + some.T) / 2)
    values[values < INFORMATION**2 / 2] = 0.0
    if not values.any():
        vectors = np.eye(len(values))
    return values, vectors
