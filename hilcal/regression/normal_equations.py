"""The whitened linear problem: rank analysis, parameter scaling, priors, solution; QR in parts.

    minimise ‖r − A δ‖² + β ‖(θ + δ − 0)/σ‖²  over δ

A (R, P) whitened Jacobian, r (R,) whitened residual, σ (P,) prior standard deviations
(infinite for flat), β the noise variance factor that the prior is weighed against.

Parameter scaling: columns are multiplied by an ordinary magnitude of their parameter, so
that singular values are pure numbers: s = by how many σ all data together move when the
parameters move along a direction by an ordinary amount. Directions with s below
`INFORMATION` (or below rounding) are not identifiable and are held at zero; the other flat
directions are rotated and scaled to be orthonormal before the normal equations are formed,
so that forming them costs no accuracy.

Of a tall matrix whose rows come a few at a time only the triangle of its QR is kept,

    [R; rows] = Q R'

by Householder reflections (LAPACK's `tpqrt`), so that R'ᵀ R' is the sum of all products of rows
without ever being formed: columns that are nearly dependent lose no digits. Triangles of parts of
the rows are combined in the same way (TSQR). Source: Demmel, Grigori, Hoemmen and Langou,
*Communication-optimal parallel and sequential QR and LU factorizations*, SIAM J. Sci. Comput. 34
(2012) A206-A239.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as sl
from scipy.linalg.lapack import dtpqrt

from hilcal.regression.schur import inverse_root, positive_solve
from hilcal.types import Bools, Floats, Ints

INFORMATION = 0.2
"""In units of the residual's spread: a direction is estimated where five times the ordinary
magnitude along it would move all data together by one σ."""
NULL_SHARE = 0.1
"""Share of its standard uncertainty by which an unidentifiable direction, off by an ordinary
magnitude, may move an identifiable parameter; a choice, no study set it."""
ROUNDING = 1e-10
TALL = 10_000
"""Rows from which on the QR is done in parts that stay in the processor's cache: a third of the
time for 300,000 rows of 30; a choice by timing."""
_ROWS = 4096  # rows that are worked on at a time; a choice by memory
ROWS = 3072
"""Rows that are reduced at a time; a choice by timing: they stay in the processor's cache."""
BLOCK = 8  # columns whose reflections are applied together; a choice by timing


class Triangle:
    """The triangle R (K, K) of all rows so far."""

    def __init__(self, size: int) -> None:
        """Begin without rows, of K columns."""
        self._r = np.zeros((size, size), order="F")

    @property
    def r(self) -> Floats:
        """(K, K) R, upper triangular."""
        return np.triu(self._r)

    def add(self, rows: Floats, right: Floats | None = None) -> None:
        """Reduce rows (N, K); (N, K − 1) with the last column `right` (N,) given apart."""
        block = min(BLOCK, len(self._r))
        for start in range(0, len(rows), ROWS):
            some = slice(start, start + ROWS)
            part = np.empty((len(rows[some]), len(self._r)), order="F")  # it is overwritten
            part[:, : rows.shape[1]] = rows[some]
            if right is not None:
                part[:, -1] = right[some]
            self._r, _, _, info = dtpqrt(0, block, self._r, part, overwrite_a=1, overwrite_b=1)
            if info:
                raise ArithmeticError(f"LAPACK's dtpqrt refuses argument {-info}")


def triangle_of(a: Floats, right: Floats) -> Floats:
    """Return the triangle (P + 1, P + 1) of a matrix A (R, P) and a column b (R,) beside it.

    Its rows have the products of those of [A, b]: they can be solved in place of them.
    """
    whole = Triangle(a.shape[1] + 1)
    whole.add(a, right)
    return whole.r


def combined(parts: Iterable[Floats], size: int) -> Floats:
    """Return the triangle (K, K) of triangles (K, K), in their order."""
    whole = Triangle(size)
    for part in parts:
        whole.add(part)
    return whole.r


@dataclass(frozen=True, slots=True, eq=False)
class Basis:
    """Coordinates z of the identifiable subspace: θ = T z."""

    transform: Floats  # (P, K) columns of θ per z; prior columns are scaled units
    prior_precision: Floats  # (K,) 1/σ² in z coordinates (zero for flat ones)
    # (P, U) unit directions, in units of the ordinary magnitudes, that are not identifiable
    null: Floats
    flat: Bools  # (P,) parameters without a prior
    held: Ints  # indices of the parameters with a prior, in the order of their z
    singular: Floats  # (K_flat,) singular values that were kept
    # number of directions of the flat parameters that the columns span, up to rounding,
    # identifiable under the noise or not
    structural: int
    condition_unscaled: float  # condition number of A in physical units, identifiable part
    condition_scaled: float  # the same after parameter scaling

    def restricted(self, kept: Bools) -> "Basis":
        """Return the basis over some of the parameters (P,), where the others are held at zero."""
        if kept.all():
            return self
        place = np.cumsum(kept) - 1
        return replace(
            self,
            transform=self.transform[kept],
            null=self.null[kept],
            flat=self.flat[kept],
            held=place[self.held],
        )

    def flat_rows(self, a: Floats) -> Floats:
        """Return rows (R, F) by the flat coordinates of rows A (R, P) by the parameters."""
        flat = np.flatnonzero(self.flat)
        return np.asarray(a[:, flat] @ self.transform[flat, : len(self.singular)])

    def rows(self, a: Floats) -> Floats:
        """Return rows (R, K) by z of rows A (R, P) by the parameters: A T.

        A column with a prior is only scaled, and a part of the rows is worked on at a time: for a
        thousand columns of many rows, products with all of T take long, and copies much memory.
        """
        count, flat = len(self.singular), np.flatnonzero(self.flat)
        out = np.empty((len(a), self.transform.shape[1]))
        sigma = self.transform[self.held, count + np.arange(len(self.held))]
        turned = self.transform[flat, :count]
        for start in range(0, len(a), _ROWS):
            part = slice(start, start + _ROWS)
            out[part, :count] = a[part][:, flat] @ turned
            out[part, count:] = a[part][:, self.held] * sigma
        return out


def find_basis(
    a: Floats,  # (R, P) whitened Jacobian
    scale: Floats,  # (P,) ordinary magnitudes
    prior: Floats,
    spread: float | None = 1.0,
    triangle: Floats | None = None,  # what `flat_triangle` returns, where it is known
) -> Basis:
    """Rank analysis of A (R, P): the identifiable directions of the flat parameters.

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
    r = flat_triangle(a, columns, scale) if triangle is None else triangle
    _, s, vt = np.linalg.svd(r, full_matrices=True)
    s = np.concatenate([s, np.zeros(len(columns) - len(s))])
    floor = ROUNDING * s.max(initial=0.0)
    keep = s > (floor if spread is None else max(INFORMATION * max(spread, 1.0), floor))
    transform = np.zeros((p, int(keep.sum()) + len(held)))
    kept = int(keep.sum())
    transform[columns, :kept] = scale[columns, None] * vt[keep].T / s[keep]
    transform[held, kept + np.arange(len(held))] = prior[held]
    null = np.zeros((p, len(columns) - kept))
    null[columns] = vt[~keep].T
    precision = np.concatenate([np.zeros(kept), np.ones(len(held))])
    conditions = _conditions(r, scale[columns], kept)
    structural = int(np.count_nonzero(s > floor))
    return Basis(transform, precision, null, flat, held, s[keep], structural, *conditions)


def flat_triangle(a: Floats, columns: Ints, scale: Floats) -> Floats:
    """Return R of the QR of some columns of A (R, P), multiplied by their magnitudes (P,)."""
    if len(a) > TALL and len(columns):
        whole = Triangle(len(columns))
        whole.add(a if len(columns) == a.shape[1] else a[:, columns])
        return np.asarray(whole.r * scale[columns])
    scaled = a[:, columns] * scale[columns]
    return np.asarray(sl.qr(scaled, mode="r", check_finite=False)[0], dtype=float)[: len(columns)]


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
    # (K,) Tᵀ Aᵀ target; z is a step for flat directions, absolute for those with a prior
    rhs: Floats

    def inverse_root(self, beta: float) -> Floats:
        """T (K, K) with Tᵀ T = H⁻¹, by the rule of `schur` where H is singular."""
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


@dataclass(frozen=True, slots=True, eq=False)
class FlatProducts:
    """Products of the rows by F flat coordinates, from which normal equations are put together."""

    own: Floats  # (F, F) with each other
    all: Floats  # (F, P) with all columns of A
    target: Floats  # (F,) with the target
    columns: Floats  # (P,) of all columns of A with the target

    def restricted(self, kept: Bools) -> "FlatProducts":
        """Return those over some columns (P,) of A, which the flat coordinates are made of."""
        return replace(self, all=self.all[:, kept], columns=self.columns[kept])


def flat_products(a: Floats, target: Floats, basis: Basis) -> FlatProducts:
    """Form the products of the flat coordinates of a basis: the rows are orthonormal."""
    rows = basis.flat_rows(a)
    return FlatProducts(rows.T @ rows, rows.T @ a, rows.T @ target, a.T @ target)


def normal_equations(
    a: Floats, target: Floats, basis: Basis, gram: Floats, known: FlatProducts | None = None
) -> NormalEquations:
    """Form the normal equations of A (R, P), with AᵀA (P, P), in the coordinates of a basis.

    The flat directions are formed from their rows, which are orthonormal, so that squaring
    costs no accuracy; columns with a prior are taken from AᵀA, for speed.
    """
    flat, of = len(basis.singular), flat_products(a, target, basis) if known is None else known
    held = basis.held
    sigma = basis.transform[held, flat + np.arange(len(held))]
    size = basis.transform.shape[1]
    full = np.empty((size, size))
    full[:flat, :flat] = of.own
    if not len(held):
        return NormalEquations(basis, full, of.target)
    full[:flat, flat:] = of.all[:, held] * sigma
    full[flat:, :flat] = full[:flat, flat:].T
    inner = gram[np.ix_(held, held)]
    inner *= sigma
    np.multiply(inner, sigma[:, None], out=full[flat:, flat:])
    return NormalEquations(basis, full, np.concatenate([of.target, sigma * of.columns[held]]))
