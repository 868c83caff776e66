"""Henderson's mixed-model equations at given variances, and slopes of the restricted likelihood.

S is diagonal, s_f for random columns and 1 for the frames; R = Σ_k exp(2 η_k) R_k is the diagonal
covariance of the noise. With T = R^−½ X S and t = R^−½ y,

    C = Tᵀ T + E,    E = 1 for random columns, 0 for the frames
    C c = Tᵀ t,      coordinates S c
    P = 1 − T C⁻¹ Tᵀ,   e = P t
    −2 ℓ = log det R + log det C + tᵀ e

With γ_f = Σ_i T_iᵀ P T_i over the columns of family f, its effective number of parameters,

    ∂ℓ/∂log s_f = c_fᵀ c_f − γ_f
    ∂ℓ/∂η_k     = eᵀ W_k e − tr(P W_k),    W_k = exp(2 η_k) R_k R⁻¹
    AI_ij       = ½ v_iᵀ P v_j,    v_f = 2 T_f c_f,    v_k = 2 W_k e

Where T has fewer rows than columns, P = N⁻¹ − B (Qᵀ N⁻¹ Q)⁻¹ Bᵀ is used, with N = 1 + Z Zᵀ and
B = N⁻¹ Q, Q the frames' and Z the random columns of T; else Cholesky's factor of C.

Sources: Henderson, *Best linear unbiased estimation and prediction under a selection model*,
Biometrics 31 (1975) 423; Gilmour, Thompson and Cullis, *Average information REML*, Biometrics 51
(1995) 1440.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri, dtrtri

from hilcal.mixed.problem import MixedProblem
from hilcal.types import Floats, Ints

EIGENVALUE = 1e-12  # share of the largest below which an eigenvalue is zero


class _ByColumns:
    """P by Cholesky's factor of C (K, K)."""

    def __init__(self, rows: Floats, c: Floats, flat: int) -> None:
        """`c` is Tᵀ T (K, K) of the rows T, and is overwritten."""
        self.rows = rows
        random = np.arange(flat, len(c))
        c[random, random] += 1.0
        self.factor = cho_factor(c, lower=True, overwrite_a=True)
        self.log_det = 2.0 * float(np.log(np.diagonal(self.factor[0])).sum())

    def project(self, v: Floats) -> Floats:
        """P v."""
        return np.asarray(v - self.rows @ cho_solve(self.factor, self.rows.T @ v))

    @cached_property
    def _root(self) -> Floats:
        """(K, K) L⁻¹, C = L Lᵀ."""
        return np.tril(dtrtri(self.factor[0], lower=True)[0])

    @cached_property
    def spent(self) -> Floats:
        """(K,) T_iᵀ P T_i = 1 − (C⁻¹)_ii; holds for random columns only."""
        return np.asarray(1.0 - np.sum(self._root**2, axis=0))

    @cached_property
    def inverse(self) -> Floats:
        """(K, K) C⁻¹."""
        return np.asarray(cho_solve(self.factor, np.eye(len(self.factor[0]))))

    @cached_property
    def diagonal(self) -> Floats:
        """(R,) diagonal of P."""
        return np.asarray(1.0 - np.sum((self.rows @ self._root.T) ** 2, axis=1))


class _ByRows:
    """P (R, R) itself."""

    def __init__(self, rows: Floats, flat: int) -> None:
        self.rows, self.flat, q, z = rows, flat, rows[:, :flat], rows[:, flat:]
        n = z @ z.T
        n[np.diag_indices_from(n)] += 1.0
        self._factor = cho_factor(n, lower=True, overwrite_a=True)
        self.log_det = 2.0 * float(np.log(np.diagonal(self._factor[0])).sum())
        self.b, self.frames = cho_solve(self._factor, q), np.zeros((flat, flat))
        if flat:
            inner = cho_factor(q.T @ self.b, lower=True)
            self.log_det += 2.0 * float(np.log(np.diagonal(inner[0])).sum())
            self.frames = cho_solve(inner, np.eye(flat))

    @cached_property
    def p(self) -> Floats:
        """(R, R) P; not needed to try a step."""
        inverse, _ = dpotri(self._factor[0], lower=True)
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        inverse -= self.b @ self.frames @ self.b.T
        return np.asarray(inverse)

    def project(self, v: Floats) -> Floats:
        """P v."""
        solved = cho_solve(self._factor, v)
        return np.asarray(solved - self.b @ (self.frames @ (self.b.T @ v)))

    @cached_property
    def inverse(self) -> Floats:
        """(K, K) C⁻¹ = [F, −F Bᵀ Z; −Zᵀ B F, 1 − Zᵀ P Z], F = (Qᵀ N⁻¹ Q)⁻¹."""
        z, k = self.rows[:, self.flat :], self.flat
        out = np.empty((self.rows.shape[1],) * 2)
        out[:k, :k] = self.frames
        out[k:, :k] = -z.T @ (self.b @ self.frames)
        out[:k, k:] = out[k:, :k].T
        out[k:, k:] = np.eye(z.shape[1]) - z.T @ (self.p @ z)
        return out

    @cached_property
    def spent(self) -> Floats:
        """(K,) T_iᵀ P T_i."""
        return np.asarray(np.einsum("ri,ri->i", self.rows, self.p @ self.rows))

    @property
    def diagonal(self) -> Floats:
        """(R,) diagonal of P."""
        return np.asarray(np.diagonal(self.p))


@dataclass(frozen=True, eq=False)
class Equations:
    """Mixed-model equations of a problem at log s and η."""

    problem: MixedProblem  # rows, columns and noise
    log_std: Floats  # (F + N,) log s of the families, η of the noise
    scale: Floats  # (K,) S
    rows: Floats  # (R, K) T
    target: Floats  # (R,) t
    noise_std: Floats  # (R,) R^½
    projection: _ByColumns | _ByRows  # P

    @property
    def _count(self) -> int:
        """Number of families."""
        return len(self.problem.families.random)

    @cached_property
    def residual(self) -> Floats:
        """(R,) e."""
        return self.projection.project(self.target)

    @cached_property
    def solution(self) -> Floats:
        """(K,) solution c, in units of the standard deviations S."""
        q, z = self.rows[:, : self.problem.flat], self.rows[:, self.problem.flat :]
        random = z.T @ self.residual
        frames = np.linalg.lstsq(q, self.target - z @ random, rcond=None)[0]
        return np.concatenate([frames, random])

    @cached_property
    def log_likelihood(self) -> float:
        """ℓ, the restricted log likelihood, without its constant."""
        square = float(self.target @ self.residual)
        log_std = float(np.log(self.noise_std).sum())
        log_std += self.problem.zeros * float(self.log_std[self._count])
        return -log_std - 0.5 * (self.projection.log_det + square)

    @cached_property
    def spent(self) -> Floats:
        """(F,) γ_f, effective number of parameters of each family."""
        p = self.problem
        weights = self.projection.spent[p.flat :]
        return np.bincount(p.family, weights, minlength=self._count).astype(np.float64)

    @cached_property
    def slope(self) -> Floats:
        """(F + N,) derivatives of ℓ by log s and η."""
        p = self.problem
        square = np.bincount(p.family, self.solution[p.flat :] ** 2, minlength=self._count)
        noise = self.residual**2 @ self._white_noise - self._freedom
        noise[0] -= p.zeros
        return np.concatenate([square - self.spent, noise])

    @property
    def _freedom(self) -> Floats:
        """(N,) tr(P W_k), degrees of freedom of each component of the noise.

        Together they are the measured rows less the parameters.
        """
        if self._white_noise.shape[1] > 1:
            return np.asarray(self.projection.diagonal @ self._white_noise)
        return np.asarray(self._white_noise.sum(axis=0) - self.problem.flat - self.spent.sum())

    @cached_property
    def _white_noise(self) -> Floats:
        """(R, N) diagonals of W_k."""
        p = self.problem
        eta = self.log_std[self._count :]
        parts = np.stack([n.variance for n in p.noise], axis=1) * np.exp(2 * eta)
        return np.asarray(parts / self.noise_std[:, None] ** 2)

    @cached_property
    def working_variates(self) -> Floats:
        """(R, F + N) working variates v."""
        p, first = self.problem, self._count
        out = np.zeros((len(self.target), len(self.log_std)))
        for f in range(first):
            columns = np.flatnonzero(p.family == f) + p.flat
            out[:, f] = 2.0 * (self.rows[:, columns] @ self.solution[columns])
        out[:, first:] = 2.0 * self._white_noise * self.residual[:, None]
        return out

    @cached_property
    def information(self) -> Floats:
        """(F + N, F + N) AI, the average information on log s and η."""
        return np.asarray(
            0.5 * self.working_variates.T @ self.projection.project(self.working_variates)
        )

    @property
    def coordinates(self) -> Floats:
        """(K,) S c: coordinates of the frames, and u in ordinary magnitudes."""
        return self.scale * self.solution

    @cached_property
    def covariance(self) -> Floats:
        """(K, K) covariance of the coordinates' errors at the given variances."""
        return self.scale[:, None] * self.projection.inverse * self.scale

    @cached_property
    def sensitivity(self) -> Floats:
        """(K, F + N) derivative of the coordinates by log s and η."""
        p, first = self.problem, self._count
        rhs = np.zeros((len(self.solution), len(self.log_std)))
        rhs[p.flat + np.arange(len(p.family)), p.family] = 2.0 * self.solution[p.flat :]
        rhs[:, first:] = -self.rows.T @ self.working_variates[:, first:]
        return np.asarray(self.scale[:, None] * (self.projection.inverse @ rhs))

    def profile(self, family: int, log_std: Floats) -> Floats:
        """Exact gain of ℓ (G,) when the size of one family is changed to log s (G,).

        With Z_fᵀ P Z_f = U diag(μ) Uᵀ, κ = 1 − s_f² μ and g = Uᵀ Z_fᵀ P y, the eigenvalues without
        the family are μ/κ, and 2 ℓ(s) = Σ [g²/(μ κ) s² μ/κ / (1 + s² μ/κ) − log(1 + s² μ/κ)].
        """
        columns = self.problem.x[:, self.problem.flat :][:, self.problem.family == family]
        inner, score = self.score(columns)
        mu, u = np.linalg.eigh((inner + inner.T) / 2)
        visible = mu > EIGENVALUE * max(float(mu.max(initial=0.0)), 1e-300)
        mu, g = mu[visible], u[:, visible].T @ score
        present = float(self.log_std[family])
        kappa = np.maximum(1.0 - np.exp(2 * present) * mu, EIGENVALUE)
        without = np.exp(2 * np.append(log_std, present))[:, None] * mu / kappa
        twice = (g**2 / (mu * kappa) * without / (1 + without) - np.log1p(without)).sum(axis=1)
        return np.asarray((twice[:-1] - twice[-1]) / 2)

    def score(self, columns: Floats) -> tuple[Floats, Floats]:
        """Return Zᵀ P Z (q, q) and Zᵀ P y (q,) of columns Z (R, q) that are not in the problem."""
        white = columns / self.noise_std[:, None]
        return np.asarray(white.T @ self.projection.project(white)), white.T @ self.residual


def equations(problem: MixedProblem, log_std: Floats) -> Equations:
    """Return the equations at log s and η (F + N,).

    Raises:
        numpy.linalg.LinAlgError: Cholesky's factorisation fails, as the standard deviations differ
            too much.
    """
    eta, flat = log_std[len(problem.families.random) :], problem.flat
    noise_std = problem.noise_std(eta)
    scale = np.concatenate([np.ones(flat), np.exp(log_std)[problem.family]])
    rows, target = problem.x / noise_std[:, None] * scale, problem.y / noise_std
    projection: _ByColumns | _ByRows
    if rows.shape[0] < rows.shape[1]:
        projection = _ByRows(rows, flat)
    elif problem.white:
        weight = np.exp(-eta[0]) * scale
        projection = _ByColumns(rows, problem.gram * weight * weight[:, None], flat)
    else:
        projection = _ByColumns(rows, rows.T @ rows, flat)
    return Equations(problem, log_std, scale, rows, target, noise_std, projection)


def left_out(e: Equations, fold: Ints) -> tuple[Floats, Floats]:
    """Predict the rows of each fold F from all other rows, at the same variances.

        y_F − ŷ_F = D (P_FF)⁻¹ P_F t,    covariance D (P_FF)⁻¹ D,    D² = R_FF

    Args:
        e: the equations of all rows.
        fold: (R,) number of each row's fold.

    Returns:
        (R,) measured minus predicted, and (R,) its variance with that of the noise.
    """
    p = e.projection.project(np.eye(len(fold)))
    error, variance = np.empty(len(fold)), np.empty(len(fold))
    for f in range(int(fold.max()) + 1):
        in_fold = fold == f
        inverse, std = np.linalg.inv(p[np.ix_(in_fold, in_fold)]), e.noise_std[in_fold]
        error[in_fold] = std * (inverse @ e.residual[in_fold])
        variance[in_fold] = std**2 * np.diagonal(inverse)
    return error, variance
