"""The spectrum of the information on a family, S = U Λ Uᵀ, which every score of it needs."""

from dataclasses import dataclass

import numpy as np

from hilcal.types import Bools, Floats

VISIBLE = 1e-4
"""Eigenvalues of S below this are left out of tests: such a direction moves all data together by
less than 0.01 σ at ordinary magnitude; a guess."""
RELATIVE = 1e-10
"""Eigenvalues of S below this share of the largest are rounding."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues and eigenvectors of S (P, P).

    Attributes:
        values: (P,) eigenvalues, ascending.
        seen: (P,) which belong to directions that can be tested.
        vectors: (P, P) U, eigenvectors in columns.
    """

    values: Floats
    seen: Bools
    vectors: Floats

    @property
    def rank(self) -> int:
        """Number of directions that can be tested."""
        return int(np.count_nonzero(self.seen))

    def along(self, g: Floats) -> Floats:
        """Return Uᵀ g (P,) of a vector g (P,)."""
        return np.asarray(self.vectors.T @ g)

    def combined(self, c: Floats) -> Floats:
        """Return U c (P,), the vector of coordinates c (P,) by the eigenvectors."""
        return np.asarray(self.vectors @ c)


def visible(values: Floats) -> Bools:
    """Return which eigenvalues (..., P) of S belong to directions that can be tested."""
    largest = values.max(axis=-1, keepdims=True, initial=0.0)
    return np.asarray(values > np.maximum(VISIBLE, RELATIVE * largest))


def spectrum(s: Floats) -> Spectrum:
    """Return the spectrum of S (P, P).

    Raises:
        LinAlgError: the eigenvalues do not converge, as where S is not finite.
    """
    values, vectors = np.linalg.eigh((s + s.T) / 2)
    return Spectrum(values, visible(values), vectors)
