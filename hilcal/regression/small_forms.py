"""Quadratic forms gᵀ A⁻ g of many small matrices, element by element over all of them.

A⁻ is the inverse on the eigenvectors of A whose eigenvalue exceeds a threshold. Where all of them
do, it is the inverse, and Cholesky's factor serves: the trace of the inverse is at least the
inverse of the least eigenvalue. The loops run over the elements of the factor; each step is one
operation for all matrices, many times as fast as their eigenvalues.
"""

import numpy as np

from hilcal.types import Bools, Floats


def quadratic_forms(a: Floats, g: Floats, threshold: Floats) -> Floats:
    """Return gᵀ A⁻ g (N,).

    Args:
        a: (N, m, m) A, symmetric, positive semidefinite up to rounding.
        g: (N, m).
        threshold: (N,) eigenvalues up to this are left out, more than zero.
    """
    out, sound = _by_cholesky(a, g, threshold)
    rest = np.flatnonzero(~sound)
    if len(rest):
        values, vectors = np.linalg.eigh(a[rest])
        c = np.einsum("kij,ki->kj", vectors, g[rest])
        kept = values > threshold[rest, None]
        out[rest] = np.sum(np.where(kept, c**2 / np.where(kept, values, 1.0), 0.0), axis=1)
    return out


def _by_cholesky(a: Floats, g: Floats, threshold: Floats) -> tuple[Floats, Bools]:
    """Forms (N,) by the inverse, and which of them serve."""
    m = a.shape[1]
    of = np.ascontiguousarray(np.moveaxis(a, 0, -1))
    low, inverse = np.zeros_like(of), np.zeros_like(of)
    sound = np.ones(len(a), dtype=bool)
    total, trace = np.zeros(len(a)), np.zeros(len(a))
    for i in range(m):
        for j in range(i):
            low[i, j] = (of[i, j] - _dot(low[i, :j], low[j, :j])) * inverse[j, j]
        pivot = of[i, i] - _dot(low[i, :i], low[i, :i])
        sound &= pivot > threshold
        inverse[i, i] = 1.0 / np.sqrt(np.where(sound, pivot, 1.0))
        for j in range(i):
            inverse[i, j] = -_dot(low[i, j:i], inverse[j:i, j]) * inverse[i, i]
        trace += _dot(inverse[i, : i + 1], inverse[i, : i + 1])
        total += _dot(inverse[i, : i + 1], g.T[: i + 1]) ** 2
    return total, sound & (trace * threshold < 1.0)


def _dot(x: Floats, y: Floats) -> Floats:
    """Σ_k x_k y_k (N,) of (K, N)."""
    return np.asarray(np.einsum("kn,kn->n", x, y))
