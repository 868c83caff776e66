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
