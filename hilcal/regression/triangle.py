"""QR of a tall matrix whose rows come a few at a time: the triangle is all that is kept.

    [R; rows] = Q R'

by Householder reflections (LAPACK's `tpqrt`), so that R'ᵀ R' is the sum of all products of rows
without ever being formed: columns that are nearly dependent lose no digits. Triangles of parts of
the rows are combined in the same way (TSQR). Column by column the error is that of a QR of the
whole matrix, whatever the units of the columns are.

Source: Demmel, Grigori, Hoemmen and Langou, *Communication-optimal parallel and sequential QR and
LU factorizations*, SIAM J. Sci. Comput. 34 (2012) A206-A239.
"""

from collections.abc import Iterable

import numpy as np
from scipy.linalg.lapack import dtpqrt

from hilcal.types import Floats

ROWS = 3072
"""Rows that are reduced at a time; a choice by timing: they stay in the processor's cache."""
BLOCK = 8
"""Columns whose reflections are applied together; a choice by timing."""


class Triangle:
    """The triangle R (K, K) of all rows so far."""

    def __init__(self, size: int) -> None:
        """Begin without rows, of K columns."""
        self._r = np.zeros((size, size), order="F")

    @property
    def r(self) -> Floats:
        """(K, K) R, upper triangular."""
        return np.triu(self._r)

    def add(self, rows: Floats) -> None:
        """Reduce rows (N, K)."""
        block = min(BLOCK, len(self._r))
        for start in range(0, len(rows), ROWS):
            part = np.asfortranarray(rows[start : start + ROWS])
            if part.base is not None or part is rows:  # it is overwritten
                part = part.copy(order="F")
            self._r, _, _, info = dtpqrt(0, block, self._r, part, overwrite_a=1, overwrite_b=1)
            if info:
                raise ArithmeticError(f"LAPACK's dtpqrt refuses argument {-info}")


def combined(parts: Iterable[Floats], size: int) -> Floats:
    """Return the triangle (K, K) of triangles (K, K), in their order."""
    whole = Triangle(size)
    for part in parts:
        whole.add(part)
    return whole.r
