"""The Schur complement of nuisance parameters, and the projection off a model's columns.

For parameters of interest i and nuisance parameters n

    S = M_ii − M_in M_nn⁻ M_ni = min over U of Uᵀ M U, U the identity at i and zero outside of i, n

is the information on i when n is estimated as well. With U = (1, −M_nn⁻ M_ni) at the minimum, and
Y = M_nn⁻ at n and zero elsewhere, S is a concave function of M = Σ w_k H_k with

    ∂S/∂w_k = Uᵀ H_k U,    ∂²S/∂w_k∂w_l = −Uᵀ (H_k Y H_l + H_l Y H_k) U.

Rule for singular blocks: M_nn is scaled to unit diagonal, and M_nn⁻ is the inverse on its
eigenvectors whose eigenvalue exceeds `DETERMINED`. Directions without information explain
nothing. The scaling makes the rule independent of the units of the parameters.

With B (R, K) the whitened columns of a fitted model and Λ (K,) the ridge of their priors, zero for
a column without one,

    M = 1 − B H⁻¹ Bᵀ,    H = BᵀB + diag(Λ)

is the marginal precision of the data when the model's parameters are integrated out (`Projection`):
without priors the orthogonal projection off the columns of B; with priors M M ≠ M. Columns may be
linearly dependent, by the rule above.

Source: Pukelsheim, *Optimal Design of Experiments* (1993), chapter 3.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.types import Floats, Ints

# Least eigenvalue of an information matrix of unit diagonal that counts as information. Rounding of
# double precision turns a zero into about 1e-16 times the number of rows; at 1e-12 a parameter's
# standard uncertainty is a million times that with all other parameters known.
DETERMINED = 1e-12
_SOUND = 1e-2  # share of the largest inverse, 1/`DETERMINED`, up to which Cholesky's factor is used


def inverse_root(block: Floats) -> Floats:
    """Return T (..., F, F) with Tᵀ T = M⁻ of blocks M (..., F, F), by the rule for singular blocks.

    Directions without information have zero rows in T. The number of the other rows is the rank.
    """
    size = block.shape[-1]
    if not size:
        return block
    flat = block.reshape(-1, size, size)
    root = np.sqrt(np.maximum(np.diagonal(flat, axis1=1, axis2=2), 0.0))
    root[root == 0.0] = 1.0
    scaled = flat / (root[:, :, None] * root[:, None, :])
    out = np.zeros_like(scaled)
    for k, m in enumerate(scaled):
        low, failed = sl.lapack.dpotrf(m.T, lower=1, clean=1)
        if not failed:
            out[k] = sl.lapack.dtrtri(low, lower=1)[0]
            # The trace of an inverse is at least the inverse of the least eigenvalue.
            failed = float(np.sum(out[k] ** 2)) >= _SOUND / DETERMINED
        if failed:
            values, vectors = np.linalg.eigh(m)
            determined = values > DETERMINED
            inverse = np.where(determined, 1.0 / np.sqrt(np.where(determined, values, 1.0)), 0.0)
            out[k] = inverse[:, None] * vectors.T
    return np.asarray((out / root[:, None, :]).reshape(block.shape))


def positive_solve(m: Floats, rhs: Floats) -> Floats:
    """Return M⁻ times (P,) or (P, K), M (P, P) positive semidefinite, by the rule above."""
    root = inverse_root(m)
    return np.asarray(root.T @ (root @ rhs))


def nuisance_inverse(m: Floats, nuisance: Ints) -> Floats:
    """Return Y (P, P): M_nn⁻ at the nuisance parameters, zero elsewhere."""
    out = np.zeros_like(m)
    root = inverse_root(m[np.ix_(nuisance, nuisance)])
    out[np.ix_(nuisance, nuisance)] = root.T @ root
    return out


def schur_complement(m: Floats, interest: Ints, nuisance: Ints | None = None) -> Floats:
    """Return S (..., I, I) of positive semidefinite information matrices M (..., P, P).

    `interest` (I,) and `nuisance` (N,) are indices of parameters, by default all others.
    """
    if nuisance is None:
        nuisance = np.setdiff1d(np.arange(m.shape[-1]), interest)
    block = m[..., nuisance[:, None], nuisance]
    explained = inverse_root(block) @ m[..., nuisance[:, None], interest]
    inner = m[..., interest[:, None], interest]
    return np.asarray(inner - np.swapaxes(explained, -1, -2) @ explained)


@dataclass(frozen=True, slots=True, eq=False)
class SchurComplement:
    """S of a matrix M, with U and Y for its derivatives by M."""

    matrix: Floats  # (I, I) S
    lift: Floats  # (P, I) U
    inverse: Floats | None  # (P, P) Y; None without nuisance parameters


def differentiable_schur_complement(m: Floats, interest: Ints | None) -> SchurComplement:
    """Return S of M (P, P), with all other parameters as nuisance; M itself without `interest`."""
    size = len(m)
    if interest is None or len(interest) == size:
        return SchurComplement(m, np.eye(size), None)
    inverse = nuisance_inverse(m, np.setdiff1d(np.arange(size), interest))
    lift = np.zeros((size, len(interest)))
    lift[interest] = np.eye(len(interest))
    lift -= inverse @ m[:, interest]
    s = m[interest] @ lift
    return SchurComplement((s + s.T) / 2, lift, inverse)


def eliminate(
    gram: Floats, rhs: Floats, square: float, out: slice, ridge: float = 0.0
) -> tuple[Floats, Floats, float]:
    """Eliminate parameters from normal equations, or add them to a model: the same operation.

    With G = XᵀX (P, P), b = Xᵀy (P,) and ‖y‖² of all columns X, o the columns to eliminate and λ
    their ridge, the inverse of their prior variance in units of the noise,

        G ← G − G_o (G_oo + λ 1)⁻ G_oᵀ,   b ← b − G_o (G_oo + λ 1)⁻ b_o,
        ‖y‖² ← ‖y‖² − b_oᵀ (G_oo + λ 1)⁻ b_o

    are the normal equations of the other columns after elimination of o, and the penalised sum of
    squares that remains. The rows at o are meaningless.
    """
    inner = gram[out, out] + ridge * np.eye(len(rhs[out]))
    solved = inverse_root(inner) @ np.column_stack([gram[out], rhs[out]])
    cross, side = solved[:, :-1], solved[:, -1]
    return gram - cross.T @ cross, rhs - cross.T @ side, square - float(side @ side)


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """M of one linear model."""

    rows: Floats  # (R, K) B
    ridge: Floats  # (K,) Λ
    inverse_root: Floats  # (K, K) T with Tᵀ T = H⁻¹

    def solve(self, rhs: Floats) -> Floats:
        """Return H⁻¹ times (K,) or (K, P)."""
        return np.asarray(self.inverse_root.T @ (self.inverse_root @ rhs))

    def project_out(self, x: Floats) -> Floats:
        """Return M X = X − B H⁻¹ Bᵀ X of whitened columns (R,) or (R, P)."""
        return np.asarray(x - self.rows @ self.solve(self.rows.T @ x))

    def information(self, x: Floats) -> Floats:
        """Return Xᵀ M X (P, P) of X (R, P), the Schur complement of the model."""
        return self.schur(x.T @ x, self.rows.T @ x)

    def schur(self, gram: Floats, cross: Floats) -> Floats:
        """Return Xᵀ M X (P, P) from XᵀX (P, P) and BᵀX (K, P)."""
        lifted = self.inverse_root @ cross
        return np.asarray(gram - lifted.T @ lifted)

    def residual(self, y: Floats, z: Floats) -> Floats:
        """Return the residual (R,) after the remaining Gauss-Newton step of the model.

            y − B H⁻¹ (Bᵀ y − Λ z)

        y is its residual, z (K,) its coordinates, used only where they have a prior. Else this step
        would be ascribed to a column that the model nearly explains, whose remainder is small.
        """
        return np.asarray(y - self.rows @ self.solve(self.rows.T @ y - self.ridge * z))


def projection(rows: Floats, ridge: Floats, gram: Floats | None = None) -> Projection:
    """Return M of the columns B (R, K) with the ridge Λ (K,); `gram` is BᵀB (K, K) if computed."""
    h = (rows.T @ rows if gram is None else gram) + np.diag(ridge)
    return Projection(rows, ridge, inverse_root(h))
