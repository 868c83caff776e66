"""Tall matrices many of whose columns are known by their factors.

Row i of measurement d, of the columns p that move the readings along one of few directions s(p),

    A_(d i) p = v_(d i) s(p) c_d p

as the harmonics of a joint's transmission error all move a reading as the joint does. With m rows
per measurement, products of such columns take an m-th of the multiplications, and an m-th of the
memory:

    (AᵀA)_pq = Σ_d (Σ_i v_(d i) s(p) v_(d i) s(q)) c_d p c_d q
"""

from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from hilcal.types import Bools, Floats, Ints

Places = slice | Ints

TOGETHER = 128
"""Measurements whose rows are written out together; a choice, so that they stay in the cache."""


@dataclass(frozen=True, slots=True, eq=False)
class Factored:
    """A matrix (R, P), R = D m; `a @ x`, `a.T @ b`, `b @ a` and `a[:, index]` are as of an array.

    Attributes:
        own: (R, Q) the columns that are written out.
        at: (Q,) their places among the P.
        direction: (D, m, S) v.
        coefficient: (D, C) c of the other columns.
        site: (C,) s of each.
        along: (C,) their places.
    """

    own: Floats
    at: Ints
    direction: Floats
    coefficient: Floats
    site: Ints
    along: Ints

    __array_ufunc__ = None  # an array on the left leaves the product to this class

    @property
    def shape(self) -> tuple[int, int]:
        """R and P."""
        return len(self.own), len(self.at) + len(self.along)

    def __len__(self) -> int:
        """Return R."""
        return len(self.own)

    @property
    def T(self) -> "Transposed":
        """The transpose, for products."""
        return Transposed(self)

    def __matmul__(self, x: Floats) -> Floats:
        """A x (R,) or (R, K) of x (P,) or (P, K)."""
        out = np.asarray(self.own @ x[self.at])
        whole = out.reshape(*self.direction.shape[:2], out.shape[1] if out.ndim > 1 else 1)
        for s, columns, places in self._runs():
            moved = (self.coefficient[:, columns] @ x[places]).reshape(
                len(whole), 1, whole.shape[2]
            )
            whole += self.direction[:, :, s, None] * moved
        return out

    def __rmatmul__(self, b: Floats) -> Floats:
        """B A (K, P) of B (K, R)."""
        return np.asarray((self.T @ b.T).T)

    def __getitem__(self, index: tuple[slice, Ints | Bools]) -> Floats:
        """Return the columns (R, K) of an index, written out; the rows are all of them."""
        wanted = np.arange(self.shape[1])[index[1]]
        place = np.empty(self.shape[1], dtype=np.int64)
        place[self.at], place[self.along] = np.arange(len(self.at)), np.arange(len(self.along))
        written = np.zeros(self.shape[1], dtype=np.bool_)
        written[self.at] = True
        out = np.empty((len(self), len(wanted)))
        mine = written[wanted]
        out[:, mine] = self.own[:, place[wanted[mine]]]
        if not mine.all():
            other = place[wanted[~mine]]
            moved = self.direction[:, :, self.site[other]] * self.coefficient[:, None, other]
            out[:, ~mine] = moved.reshape(len(self), len(other))
        return out

    def restricted(self, kept: Bools) -> "Factored":
        """Return the matrix of the columns (P,) that are kept."""
        place = np.cumsum(kept) - 1
        own, other = kept[self.at], kept[self.along]
        return Factored(
            self.own[:, own],
            place[self.at[own]],
            self.direction,
            self.coefficient[:, other],
            self.site[other],
            place[self.along[other]],
        )

    def turned(self, flat: Ints, transform: Floats, held: Ints, sigma: Floats) -> "Factored":
        """Return the matrix [A_flat T, A_held diag(σ)].

        Args:
            flat: (F,) columns to turn.
            transform: (F, K) T.
            held: (H,) columns to scale.
            sigma: (H,) σ.
        """
        place = np.full(self.shape[1], -1)
        place[held] = np.arange(len(held))
        size = np.zeros(self.shape[1])
        size[held] = sigma
        own, other = place[self.at] >= 0, place[self.along] >= 0
        at, along = self.at[own], self.along[other]
        count = transform.shape[1]
        return Factored(
            np.hstack([self[:, flat] @ transform, self.own[:, own] * size[at]]),
            np.concatenate([np.arange(count), count + place[at]]),
            self.direction,
            self.coefficient[:, other] * size[along],
            self.site[other],
            count + place[along],
        )

    def scaled(self, by: Floats) -> "Factored":
        """Return A diag(by), by (P,)."""
        own, coefficient = self.own * by[self.at], self.coefficient * by[self.along]
        return replace(self, own=own, coefficient=coefficient)

    def ordered(self, order: Ints) -> "Factored":
        """Return the matrix with its columns in another order (P,)."""
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        return replace(self, at=place[self.at], along=place[self.along])

    def beside(self, b: "Tall") -> "Factored":
        """Return [A, B] of a matrix B (R, K) with as many rows per measurement."""
        count = self.shape[1]
        if not isinstance(b, Factored):
            own = np.hstack([self.own, b])
            return replace(self, own=own, at=np.append(self.at, count + np.arange(b.shape[1])))
        return Factored(
            np.hstack([self.own, b.own]),
            np.append(self.at, count + b.at),
            np.concatenate([self.direction, b.direction], axis=2),
            np.hstack([self.coefficient, b.coefficient]),
            np.append(self.site, self.direction.shape[2] + b.site),
            np.append(self.along, count + b.along),
        )

    def turned_rows(self, by: Floats) -> "Factored":
        """Return the matrix with the rows of each measurement turned by (D, m, m)."""
        count, m, _ = self.direction.shape
        own = (by @ self.own.reshape(count, m, len(self.at))).reshape(self.own.shape)
        return replace(self, own=own, direction=by @ self.direction)

    def of(self, measurements: Ints | Bools) -> "Factored":
        """Return the rows of some measurements (D,)."""
        direction, size = self.direction[measurements], len(self.at)
        own = self.own.reshape(*self.direction.shape[:2], size)[measurements]
        return Factored(
            own.reshape(direction.shape[0] * direction.shape[1], size),
            self.at,
            direction,
            self.coefficient[measurements],
            self.site,
            self.along,
        )

    def written(self) -> Floats:
        """Return the matrix (R, P) as an array."""
        out = np.empty(self.shape)
        out[:, self.at] = self.own
        whole = out.reshape(*self.direction.shape[:2], self.shape[1])
        for s, columns, places in self._runs():
            v, c = self.direction[:, :, s, None], self.coefficient[:, None, columns]
            if isinstance(places, slice):
                np.multiply(v, c, out=whole[:, :, places])
            else:
                whole[:, :, places] = v * c
        return out

    def gram(self) -> Floats:
        """Return AᵀA (P, P)."""
        out = np.empty((self.shape[1], self.shape[1]))
        out[np.ix_(self.at, self.at)] = self.own.T @ self.own
        runs = self._runs()

        for k, (s, one, rows) in enumerate(runs):
            found = self._along(s, self.own).T @ self.coefficient[:, one]
            _put(out, self.at, rows, found)
            _put(out, rows, self.at, found.T)
            for t, other, columns in runs[k:]:
                v = self.direction
                weight = np.einsum("di,di->d", v[:, :, s], v[:, :, t])[:, None]
                found = self.coefficient[:, one].T @ (self.coefficient[:, other] * weight)
                _put(out, rows, columns, found)
                _put(out, columns, rows, found.T)
        return out

    def forms(self, root: Floats) -> Floats:
        """Return A_d TᵀT A_dᵀ (D, m, m) of the rows of each measurement, T a root (K, P)."""
        (count, m, sites), size = self.direction.shape, len(root)
        runs = self._runs()
        to_own = np.ascontiguousarray(root[:, self.at].T)
        to_runs = [np.ascontiguousarray(root[:, places].T) for _, _, places in runs]
        out = np.empty((count, m, m))

        for start in range(0, count, TOGETHER):
            some = slice(start, min(start + TOGETHER, count))
            along = np.zeros((some.stop - start, sites, size))
            for (s, columns, _), to in zip(runs, to_runs, strict=True):
                along[:, s] += self.coefficient[some, columns] @ to
            seen = (self.own[m * start : m * some.stop] @ to_own).reshape(-1, m, size)
            seen += self.direction[some] @ along
            np.matmul(seen, np.swapaxes(seen, 1, 2), out=out[some])
        return out

    def _along(self, site: int, b: Floats) -> Floats:
        """Σ_i v_(d i) s b_(d i) (D, K) of rows b (R, K)."""
        v = self.direction[:, :, site]
        whole = b.reshape(*v.shape, b.shape[1] if b.ndim > 1 else 1)
        return np.asarray(np.matmul(v[:, None, :], whole)[:, 0])

    def transposed_times(self, b: Floats) -> Floats:
        """Return Aᵀ b (P,) or (P, K) of b (R,) or (R, K)."""
        out = np.empty((self.shape[1], *b.shape[1:]))
        out[self.at] = self.own.T @ b
        for s, columns, places in self._runs():
            found = self.coefficient[:, columns].T @ self._along(s, b)
            out[places] = found.reshape(len(found), *b.shape[1:])
        return out

    def _runs(self) -> list[tuple[int, slice, Places]]:
        """Directions, the successive columns of c along each, and their places."""
        found: list[tuple[int, slice, Places]] = []
        end = 0
        for site, run in groupby(self.site.tolist()):
            start, end = end, end + len(list(run))
            places = self.along[start:end]
            first, last = int(places[0]), int(places[-1]) + 1
            close = last - first == end - start and bool((np.diff(places) == 1).all())
            found.append((site, slice(start, end), slice(first, last) if close else places))
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Transposed:
    """The transpose of a `Factored` matrix, for products from the left."""

    of: Factored

    def __matmul__(self, b: Floats) -> Floats:
        """Aᵀ b (P,) or (P, K) of b (R,) or (R, K)."""
        return self.of.transposed_times(b)


Tall = Floats | Factored
"""A matrix (R, P) of many rows."""


def gram(a: Tall) -> Floats:
    """Return AᵀA (P, P)."""
    return a.gram() if isinstance(a, Factored) else np.asarray(a.T @ a)


def forms(a: Tall, root: Floats, m: int) -> Floats:
    """Return A_d TᵀT A_dᵀ (D, m, m) of each m rows of A (R, P), T a root (K, P)."""
    if isinstance(a, Factored):
        return a.forms(root)
    seen = (a @ root.T).reshape(-1, m, len(root))
    return np.asarray(seen @ np.swapaxes(seen, 1, 2))


def keep_columns(a: Tall, kept: Bools) -> Tall:
    """Return the columns of A (R, P) that are kept."""
    return a.restricted(kept) if isinstance(a, Factored) else np.asarray(a[:, kept])


def ordered(a: Tall, order: Ints) -> Tall:
    """Return A (R, P) with its columns in another order (P,)."""
    if np.array_equal(order, np.arange(a.shape[1])):
        return a
    return a.ordered(order) if isinstance(a, Factored) else a[:, order]


def scaled(a: Tall, by: Floats) -> Tall:
    """Return A diag(by) of A (R, P)."""
    return a.scaled(by) if isinstance(a, Factored) else a * by


def beside(a: Tall, b: Tall) -> Tall:
    """Return [A, B] of matrices (R, P) and (R, K), by their factors where A is."""
    return a.beside(b) if isinstance(a, Factored) else np.hstack([a, written(b)])


def of_rows(a: Tall, rows: Bools) -> Tall:
    """Return some rows (R,) of A (R, P), whole measurements."""
    if not isinstance(a, Factored):
        return a[rows]
    return a.of(rows[:: a.direction.shape[1]])


def written(a: Tall) -> Floats:
    """Return A (R, P) as an array."""
    return a.written() if isinstance(a, Factored) else a


def _put(out: Floats, rows: Places, columns: Places, values: Floats) -> None:
    """Write a block."""
    if isinstance(rows, slice) or isinstance(columns, slice):
        out[rows, columns] = values
    else:
        out[np.ix_(rows, columns)] = values
