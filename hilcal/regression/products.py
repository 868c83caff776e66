"""Products of tall matrices, on two processors where they are large.

Columns are halved by the size alone, so that the bits of a product do not depend on the number of
processors.
"""

import numpy as np

from hilcal.threads import in_threads
from hilcal.types import Bools, Floats, Ints

LARGE = 1e8
"""Multiplications from which a product is halved, 5 ms of one processor; a choice by timing."""

ROWS = 4096
"""Rows that are copied at a time; a choice by memory."""


def keep_columns(a: Floats, kept: Bools) -> Floats:
    """Return the columns of A (R, P) that are kept, in the memory of A, which is used up."""
    if not a.flags.c_contiguous:
        return np.asarray(a[:, kept])
    count, size = len(a), int(np.count_nonzero(kept))
    out = a.reshape(-1)[: count * size].reshape(count, size)
    for start in range(0, count, ROWS):
        rows = slice(start, start + ROWS)
        out[rows] = a[rows][:, kept]  # of rows that have been read
    return np.asarray(out)


def submatrix(g: Floats, rows: Ints) -> Floats:
    """Return G (K, K) of some rows and columns; two steps take a fraction of indexing both."""
    return np.asarray(g.take(rows, axis=0).take(rows, axis=1))


def gram(a: Floats) -> Floats:
    """Return AᵀA (P, P) of A (R, P)."""
    count, size = a.shape
    if count * size**2 < LARGE:
        return np.asarray(a.T @ a)
    half = size // 2
    out = np.empty((size, size))
    first, second = a[:, :half], a[:, half:]

    def fill(part: int) -> None:
        if part:  # a symmetric product takes half as long
            out[:half, :half] = first.T @ first
            out[half:, half:] = second.T @ second
        else:
            out[:half, half:] = first.T @ second

    in_threads(fill, range(2))
    out[half:, :half] = out[:half, half:].T
    return out


def times(a: Floats, b: Floats) -> Floats:
    """Return AB (R, Q) of A (R, P) and B (P, Q)."""
    count, size = a.shape
    if count * size * b.shape[1] < LARGE / 4:
        return np.asarray(a @ b)
    half = count // 2
    out = np.empty((count, b.shape[1]))

    def fill(rows: slice) -> None:
        np.matmul(a[rows], b, out=out[rows])

    in_threads(fill, (slice(0, half), slice(half, count)))
    return out


def cross(a: Floats, b: Floats) -> Floats:
    """Return AᵀB (P, Q) of A (R, P) and B (R, Q)."""
    count, size = b.shape
    if count * size * a.shape[1] < LARGE or size < 2:
        return np.asarray(a.T @ b)
    half = size // 2
    out = np.empty((a.shape[1], size))

    def fill(columns: slice) -> None:
        np.matmul(a.T, b[:, columns], out=out[:, columns])

    in_threads(fill, (slice(0, half), slice(half, size)))
    return out
