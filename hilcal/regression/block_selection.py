"""Blocks of columns chosen beside a model one after the other by their evidence, without each fold.

With B (R, K) the columns of the model with the ridge Λ, X_l (R, W) the blocks, y what remains, and
M = 1 − B H⁻¹ Bᵀ, H = BᵀB + Λ, on the rows that are not left out, blocks are columns M X_l that
explain M y:

    X_kᵀ M M X_l = X_kᵀ X_l − E_kᵀ C_l − C_kᵀ Λ C_l,    E = Bᵀ X,  C = H⁻¹ E

and likewise with y in the place of a block. All products are sums over rows, so that they are
formed once for each fold, and without a fold are those of the others together.
"""

from dataclasses import dataclass
from functools import reduce

import numpy as np

from hilcal.regression.evidence import log_evidence
from hilcal.regression.schur import positive_solve
from hilcal.regression.spectrum import visible
from hilcal.types import Bools, Floats, Ints

SPANNED = 1e-6
"""Eigenvalues of a chosen block's gram below this share of the largest are left out: directions
that the model and earlier blocks nearly explain; a choice."""


def block_evidence(gram: Floats, g: Floats, rss: float, dof: float, strengths: Floats) -> Floats:
    """(L,) gain in log evidence of each of L blocks, at its best prior strength.

    Args:
        gram: (L, W, W) of the blocks beside the model.
        g: (L, W) their products with the residual.
        strengths: (T,) prior standard deviations that are tried.
    """
    lam, u = np.linalg.eigh(gram)
    seen = visible(lam)
    c2 = np.einsum("lij,li->lj", u, g) ** 2
    explained = np.where(seen, c2 / np.where(seen, lam, 1.0), 0.0)
    found = log_evidence(np.where(seen, lam, 0.0), explained, rss, dof, strengths)
    return np.asarray(found.max(axis=0))


@dataclass(frozen=True, slots=True, eq=False)
class _BlockSums:
    """Products over some rows: BᵀB, Bᵀ[X, y], X_lᵀX_l (L, W, W), Xᵀy, yᵀy, and their number."""

    gram: Floats
    cross: Floats
    blocks: Floats
    slope: Floats
    square: float
    rows: int

    def plus(self, other: "_BlockSums", sign: int = 1) -> "_BlockSums":
        """Return those over these rows and others; without the others where the sign is −1."""
        return _BlockSums(
            self.gram + sign * other.gram,
            self.cross + sign * other.cross,
            self.blocks + sign * other.blocks,
            self.slope + sign * other.slope,
            self.square + sign * other.square,
            self.rows + sign * other.rows,
        )


class BlockSelection:
    """Blocks that can be chosen beside a model."""

    def __init__(self, own: Floats, ridge: Floats, x: Floats, y: Floats, fold: Ints) -> None:
        """Form all products, fold by fold.

        Args:
            own: (R, K) B.
            ridge: (K,) Λ.
            x: (R, L, W) all blocks.
            y: (R,) what remains where the model stands.
            fold: (R,) fold of each row, from 0.
        """
        self._shape = x.shape[1:]
        self._own, self._ridge, self._y = own, ridge, y
        self._x = x.reshape(len(y), -1)
        self._fold = fold
        folds = range(int(fold.max()) + 1)
        self._of = [self._sums(fold == f) for f in folds]
        self._all = reduce(_BlockSums.plus, self._of)

    def _sums(self, rows: Bools) -> _BlockSums:
        own, x, y = self._own[rows], self._x[rows], self._y[rows]
        blocks = x.reshape(len(y), *self._shape).transpose(1, 2, 0)
        return _BlockSums(
            own.T @ own,
            np.column_stack([own.T @ x, own.T @ y]),
            blocks @ blocks.transpose(0, 2, 1),
            x.T @ y,
            float(y @ y),
            len(y),
        )

    def without(self, f: int, most: int, least: float, strengths: Floats) -> list[int]:
        """Return the blocks that the rows without fold f choose, the first one first.

        Args:
            most: number of blocks at most.
            least: gain in log evidence that each needs.
            strengths: (T,) prior standard deviations that are tried.
        """
        # a sample of the rows need not have any of the last folds
        s = self._all.plus(self._of[f], -1) if f < len(self._of) else self._all
        count, width = self._shape
        c = positive_solve(s.gram + np.diag(self._ridge), s.cross)
        e, by_ridge = s.cross[:, :-1], self._ridge[:, None] * c
        c, own = c[:, :-1], c[:, -1]
        lifted, pull = e + by_ridge[:, :-1], by_ridge[:, -1]
        blocks = [m.reshape(len(e), count, width).transpose(1, 2, 0) for m in (c, lifted)]
        gram = s.blocks - blocks[0] @ blocks[1].transpose(0, 2, 1)
        gram = (gram + gram.transpose(0, 2, 1)) / 2
        g = s.slope - e.T @ own - c.T @ pull
        rss = s.square - float((s.cross[:, -1] + pull) @ own)
        dof, rows = max(s.rows - len(e), 1), self._fold != f
        chosen: list[int] = []
        gone = np.zeros((0, count * width))
        for _ in range(most):
            evidence = block_evidence(gram, g.reshape(count, width), rss, dof, strengths)
            best = int(np.argmax(evidence))
            if evidence[best] < least:
                break
            chosen.append(best)
            at = slice(best * width, (best + 1) * width)
            beside = self._x[rows].T @ self._x[rows, at] - lifted.T @ c[:, at]
            beside -= gone.T @ gone[:, at]
            lam, u = np.linalg.eigh(gram[best])
            kept = lam > SPANNED * lam[-1]
            unit = (u[:, kept] / np.sqrt(lam[kept])).T
            along, size = unit @ beside.T, unit @ g[at]
            of_block = along.reshape(-1, count, width).transpose(1, 2, 0)
            gram = gram - of_block @ of_block.transpose(0, 2, 1)
            g, rss = g - along.T @ size, rss - float(size @ size)
            gone = np.vstack([gone, along])
            dof = max(dof - len(unit), 1)
        return chosen
