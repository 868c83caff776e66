"""The whitened linear problem: rank analysis, parameter scaling, priors, solution; QR in parts.

    minimise ‖r − A δ‖² + β ‖(θ + δ)/σ‖²  over δ

A (R, P) whitened Jacobian, r (R,) whitened residual, σ (P,) prior standard deviations
(infinite for flat parameters), β the noise variance factor that multiplies the prior precision.

Parameter scaling: columns are multiplied by the ordinary magnitude of their parameter, so that a
singular value is a pure number: s σ is the motion of all data together for an ordinary magnitude
along its direction. Directions with s below `INFORMATION`, or below rounding, are not identifiable
and are held at zero. The other flat directions are rotated and scaled to be orthonormal before the
normal equations are formed, so that forming them costs no accuracy.

A tall matrix whose rows arrive a few at a time is reduced to the triangle of its QR,

    [R; rows] = Q R'

by Householder reflections (LAPACK's `tpqrt`). R'ᵀ R' equals the sum of all products of rows, but is
never formed: nearly dependent columns lose no digits. Triangles of parts of the rows are combined
in the same way (TSQR). Source: Demmel, Grigori, Hoemmen and Langou, *Communication-optimal parallel
and sequential QR and LU factorizations*, SIAM J. Sci. Comput. 34 (2012) A206-A239.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as sl
from scipy.linalg.lapack import dtpqrt

from hilcal.regression.schur import inverse_root, positive_solve
from hilcal.types import Bools, Floats, Ints

INFORMATION = 0.2  # least singular value s of an identifiable direction, in residuals' spreads
NULL_SHARE = 0.1
"""Share of its standard uncertainty by which an identifiable parameter may move for an ordinary
magnitude along an unidentifiable direction; a choice, no study set it."""
ROUNDING = 1e-10
_ROWS = 4096  # rows multiplied at a time; a choice by memory
ROWS = 3072  # rows reduced at a time, which fit into the processor's cache; a choice by timing
BLOCK = 8  # columns whose reflections are applied together; a choice by timing


class Triangle:
    """The triangle R (K, K) of the QR of all rows added so far."""

    def __init__(self, size: int) -> None:
        self._r = np.zeros((size, size), order="F")

    @property
    def r(self) -> Floats:
        """(K, K) R, upper triangular."""
        return np.triu(self._r)

    def add(self, rows: Floats, right: Floats | None = None) -> None:
        """Reduce rows (N, K), or rows (N, K − 1) and their last column `right` (N,)."""
        block = min(BLOCK, len(self._r))
        for start in range(0, len(rows), ROWS):
            some = slice(start, start + ROWS)
            part = np.empty((len(rows[some]), len(self._r)), order="F")  # overwritten by LAPACK
            part[:, : rows.shape[1]] = rows[some]
            if right is not None:
                part[:, -1] = right[some]
            self._r, _, _, info = dtpqrt(0, block, self._r, part, overwrite_a=1, overwrite_b=1)
            if info:
                raise ArithmeticError(f"LAPACK's dtpqrt refuses argument {-info}")


def triangle_of(a: Floats, right: Floats) -> Floats:
    """Return the triangle T (P + 1, P + 1) of [A, b], A (R, P) and b (R,).

    Its rows can replace those of [A, b] in a least-squares problem, as TᵀT = [A, b]ᵀ [A, b].
    """
    triangle = Triangle(a.shape[1] + 1)
    triangle.add(a, right)
    return triangle.r


def combined(parts: Iterable[Floats], size: int) -> Floats:
    """Return the triangle (K, K) of all rows of triangles (K, K), in their order."""
    triangle = Triangle(size)
    for part in parts:
        triangle.add(part)
    return triangle.r


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """Coordinates z of the identifiable subspace: θ = T z."""

    transform: Floats  # (P, K) T; parameters with a prior are only scaled by σ
    prior_precision: Floats  # (K,) 1/σ² in z coordinates (zero for flat ones)
    null: Floats  # (P, U) unidentifiable unit directions, in ordinary magnitudes
    flat: Bools  # (P,) parameters without a prior
    with_prior: Ints  # indices of the parameters with a prior, in the order of their z
    singular: Floats  # (K_flat,) singular values of the identifiable directions
    structural: int  # rank of the flat parameters' columns up to rounding, whatever the noise
    condition_unscaled: float  # condition number of A in physical units, identifiable part
    condition_scaled: float  # the same after parameter scaling

    def restricted(self, free: Bools) -> "Basis":
        """Return the basis over the free parameters (P,) where the others are held at zero."""
        if free.all():
            return self
        place = np.cumsum(free) - 1
        return replace(
            self,
            transform=self.transform[free],
            null=self.null[free],
            flat=self.flat[free],
            with_prior=place[self.with_prior],
        )

    def flat_rows(self, a: Floats) -> Floats:
        """Return rows (R, F) by the flat coordinates of rows A (R, P) by the parameters."""
        flat = np.flatnonzero(self.flat)
        return np.asarray(a[:, flat] @ self.transform[flat, : len(self.singular)])

    def rows(self, a: Floats) -> Floats:
        """Return A T (R, K), the derivatives by z, of A (R, P), those by the parameters.

        To save time and memory, columns with a prior are only scaled, and the rows are multiplied
        in parts.
        """
        count, flat = len(self.singular), np.flatnonzero(self.flat)
        out = np.empty((len(a), self.transform.shape[1]))
        sigma = self.transform[self.with_prior, count + np.arange(len(self.with_prior))]
        turned = self.transform[flat, :count]
        for start in range(0, len(a), _ROWS):
            part = slice(start, start + _ROWS)
            out[part, :count] = a[part][:, flat] @ turned
            out[part, count:] = a[part][:, self.with_prior] * sigma
        return out


def find_basis(
    a: Floats,  # (R, P) whitened Jacobian
    scale: Floats,  # (P,) ordinary magnitudes
    prior: Floats,
    spread: float | None = 1.0,
) -> Basis:
    """Find the identifiable directions of the flat parameters of A (R, P).

    Args:
        prior: (P,) prior standard deviations, infinite for flat parameters, zero for parameters
            held at zero.
        spread: standard deviation of the whitened residual, at least 1; None where rows are not in
            units of noise, so that only rounding decides the rank.
    """
    flat = np.isinf(prior)
    held = np.flatnonzero(~flat & (prior > 0))
    columns = np.flatnonzero(flat)
    p = a.shape[1]
    scaled = a[:, columns] * scale[columns]
    r = np.asarray(sl.qr(scaled, mode="r", check_finite=False)[0], dtype=float)[: len(columns)]
    _, s, vt = np.linalg.svd(r, full_matrices=True)
    s = np.concatenate([s, np.zeros(len(columns) - len(s))])
    floor = ROUNDING * s.max(initial=0.0)
    keep = s > (floor if spread is None else max(INFORMATION * max(spread, 1.0), floor))
    rank = int(keep.sum())
    transform = np.zeros((p, rank + len(held)))
    transform[columns, :rank] = scale[columns, None] * vt[keep].T / s[keep]
    transform[held, rank + np.arange(len(held))] = prior[held]
    null = np.zeros((p, len(columns) - rank))
    null[columns] = vt[~keep].T
    precision = np.concatenate([np.zeros(rank), np.ones(len(held))])
    conditions = _conditions(r, scale[columns], rank)
    structural = int(np.count_nonzero(s > floor))
    return Basis(transform, precision, null, flat, held, s[keep], structural, *conditions)


def echelon(rows: Floats, blocks: Sequence[Sequence[int]], least: float = 0.0) -> Floats:
    """Bring directions (U, P) to reduced echelon form, so that each involves few parameters.

    Columns of a block become pivots before those of the next one; elements up to `least` are no
    pivots.
    """
    rows, done = rows.copy(), 0
    for block in blocks:
        while done < len(rows) and len(block):
            sub = np.abs(rows[done:][:, block])
            i, j = np.unravel_index(int(np.argmax(sub)), sub.shape)
            if sub[i, j] <= least:
                break
            pivot = block[int(j)]
            rows[[done, done + int(i)]] = rows[[done + int(i), done]]
            rows[done] /= rows[done, pivot]
            remaining = np.arange(len(rows)) != done
            rows[remaining] -= rows[remaining, pivot][:, None] * rows[done]
            done += 1
    return rows


def _conditions(r: Floats, scale: Floats, rank: int) -> tuple[float, float]:
    """Condition numbers of the identifiable part, in physical units and scaled."""
    if rank == 0:
        return 1.0, 1.0
    physical = np.linalg.svd(r / scale, compute_uv=False)
    norms = np.linalg.norm(r, axis=0)
    scaled = np.linalg.svd(r / np.where(norms > 0, norms, 1.0), compute_uv=False)
    return float(physical[0] / physical[rank - 1]), float(scaled[0] / scaled[rank - 1])


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """H z = b in the coordinates of a basis, H = gram + β·diag(prior precision)."""

    basis: Basis
    gram: Floats  # (K, K) Tᵀ AᵀA T
    # (K,) Tᵀ Aᵀ target; z is a step along flat directions, absolute for parameters with a prior
    rhs: Floats

    def inverse_root(self, beta: float) -> Floats:
        """W (K, K) with Wᵀ W = H⁻¹, by the rule of `schur` where H is singular."""
        return inverse_root(self._h(beta))

    def _h(self, beta: float) -> Floats:
        h = self.gram.copy()
        h[np.diag_indices_from(h)] += beta * self.basis.prior_precision
        return h

    def solve(self, beta: float = 1.0) -> Floats:
        """Solution z (K,)."""
        return positive_solve(self._h(beta), self.rhs)

    def inverse(self, beta: float = 1.0) -> Floats:
        """H⁻¹ (K, K): covariance of z for unit noise variance."""
        root = self.inverse_root(beta)
        return np.asarray(root.T @ root)


def normal_equations(a: Floats, target: Floats, basis: Basis, gram: Floats) -> NormalEquations:
    """Form the normal equations of A (R, P), with AᵀA (P, P), in the coordinates of a basis.

    Flat directions are formed from their rows, whose columns are orthonormal, so that squaring
    costs no accuracy; parameters with a prior from AᵀA, for speed.
    """
    flat, held, rows = len(basis.singular), basis.with_prior, basis.flat_rows(a)
    sigma = basis.transform[held, flat + np.arange(len(held))]
    size = basis.transform.shape[1]
    full = np.empty((size, size))
    full[:flat, :flat] = rows.T @ rows
    full[:flat, flat:] = (rows.T @ a)[:, held] * sigma
    full[flat:, :flat] = full[:flat, flat:].T
    inner = gram[np.ix_(held, held)]
    inner *= sigma
    np.multiply(inner, sigma[:, None], out=full[flat:, flat:])
    rhs = np.concatenate([rows.T @ target, sigma * (a.T @ target)[held]])
    return NormalEquations(basis, full, rhs)
