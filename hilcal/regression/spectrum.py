"""The spectrum of the information on a family, which every score of it needs.

    S = U Λ Uᵀ,    U = Q Z

Q are the reflections that make S tridiagonal, Z the eigenvectors of the tridiagonal matrix. Scores
need U times single vectors: of a large family U itself, a third of the time, is not formed for it.

Source: Golub and Van Loan, *Matrix Computations* (2013), section 8.3.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.threads import once
from hilcal.types import Bools, Floats

VISIBLE = 1e-4
"""Eigenvalues of S below this are left out of tests: such a direction moves all data together by
less than 0.01 σ at ordinary magnitude; a guess."""
RELATIVE = 1e-10
"""Eigenvalues of S below this share of the largest are rounding."""
LARGE = 128
"""Parameters from which on the eigenvectors are kept as a product; a choice by timing."""
_BLOCK = 64
"""Reflections that LAPACK applies together."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues and eigenvectors of S.

    Attributes:
        values: (P,) eigenvalues, ascending.
        seen: (P,) which belong to directions that can be tested.
        inner: (P, P) Z; U where there are no reflections.
        reflections: of Q, (P − 1, P − 1) and (P − 1,) as LAPACK keeps them; None for Q = 1.
    """

    values: Floats
    seen: Bools
    inner: Floats
    reflections: tuple[Floats, Floats] | None = None

    @property
    def rank(self) -> int:
        """Number of directions that can be tested."""
        return int(np.count_nonzero(self.seen))

    @once
    def vectors(self) -> Floats:
        """(P, P) U, eigenvectors in columns."""
        return self._turned(self.inner, "N")

    def along(self, g: Floats) -> Floats:
        """Return Uᵀ g (P,) of a vector g (P,)."""
        return np.asarray(self.inner.T @ self._turned(g[:, None], "T")[:, 0])

    def combined(self, c: Floats) -> Floats:
        """Return U c (P,), the vector of coordinates c (P,) by the eigenvectors."""
        return self._turned((self.inner @ c)[:, None], "N")[:, 0]

    def _turned(self, x: Floats, how: str) -> Floats:
        """Return Q X (how = "N") or Qᵀ X ("T") of X (P, K)."""
        if self.reflections is None:
            return x
        out, work = np.array(x, order="F"), _BLOCK * x.shape[1] if x.shape[1] > 1 else 1
        turned, _, info = sl.lapack.dormqr("L", how, *self.reflections, out[1:], work)
        if info:
            raise ArithmeticError(f"LAPACK's dormqr refuses argument {-info}")
        out[1:] = turned
        return np.asarray(out)


def visible(values: Floats) -> Bools:
    """Return which eigenvalues (..., P) of S belong to directions that can be tested."""
    largest = values.max(axis=-1, keepdims=True, initial=0.0)
    return np.asarray(values > np.maximum(VISIBLE, RELATIVE * largest))


def spectrum(s: Floats) -> Spectrum:
    """Return the spectrum of S (P, P).

    Raises:
        LinAlgError: the eigenvalues do not converge, as where S is not finite.
    """
    size = len(s)
    if size >= LARGE:
        low, diagonal, beside, tau, _ = sl.lapack.dsytrd(s.T, lower=1, lwork=_BLOCK * size)
        values, inner, info = sl.lapack.dstevd(diagonal, beside)
        if info:
            raise np.linalg.LinAlgError("Eigenvalues did not converge")
        return Spectrum(values, visible(values), inner, (np.array(low[1:, :-1], order="F"), tau))
    values, vectors = np.linalg.eigh((s + s.T) / 2)
    return Spectrum(values, visible(values), vectors)
