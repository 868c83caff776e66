"""Families, or blocks of columns, added to a model one after the other, most evidence first.

A refit with one more effect takes seconds to minutes on a large campaign. At the linearisation of
a fit, with S and g of all families and ‖r‖² (see `evidence`), a family f with the ridge λ is added
by the elimination of its columns (`schur.eliminate`). The log evidence of a chain of additions is
the sum of theirs, ln p(r | all) − ln p(r | none), so that one large family and several small ones
compare.

Blocks are chosen without each fold. With B (R, K) the columns of the model with the ridge Λ,
X_l (R, W) the blocks, y what remains, and M = 1 − B H⁻¹ Bᵀ, H = BᵀB + Λ, on the rows that are not
left out, blocks are columns M X_l that explain M y:

    X_kᵀ M M X_l = X_kᵀ X_l − E_kᵀ C_l − C_kᵀ Λ C_l,    E = Bᵀ X,  C = H⁻¹ E

and likewise with y in the place of a block. All products are sums over rows, so that they are
formed once for each fold, and without a fold are those of the others together.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np

from hilcal.regression.evidence import FamilyScore, log_evidence, score_family, visible
from hilcal.regression.schur import eliminate, positive_solve
from hilcal.types import Bools, Floats, Ints

SPANNED = 1e-6
"""Eigenvalues of a chosen block's gram below this share of the largest are left out: directions
that the model and earlier blocks nearly explain; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class CandidateFamilies:
    """Families that can be added to a model."""

    information: Floats  # (P, P) S of all families' columns beside the model
    gradient: Floats  # (P,) g
    rss: float  # ‖r‖²
    dof: float  # degrees of freedom ν of the residual without any of the families
    columns: Mapping[str, slice]  # of each family that is not in the model
    spent: float = 0.0  # effective number of parameters of the families that are in the model
    most: Mapping[str, float] = field(default_factory=dict)  # largest plausible strengths

    def scores(self) -> dict[str, FamilyScore]:
        """Score each family by itself."""
        s, g, model = self.information, self.gradient, (self.rss, self.dof, self.spent)
        return {
            name: score_family(s[k, k], g[k], *model, self.most.get(name, np.inf))
            for name, k in self.columns.items()
        }

    def without(self, names: Collection[str]) -> "CandidateFamilies":
        """Leave families out of the choice."""
        return replace(self, columns={n: k for n, k in self.columns.items() if n not in names})

    def with_family(self, name: str, found: FamilyScore) -> "CandidateFamilies":
        """Add a family to the model, with the ridge of its score."""
        out = self.columns[name]
        s, g, rss = eliminate(self.information, self.gradient, self.rss, out, found.ridge)
        spent = self.spent + found.effective
        return replace(self.without([name]), information=s, gradient=g, rss=rss, spent=spent)


def families_beside(
    information: Floats,  # (P, P) S of all families' columns beside the model
    residual: Floats,  # (R,) r of the model
    dof: float,
    x: Floats,  # (R, P) whitened columns of all families, in ordinary magnitudes
    columns: Mapping[str, slice],
    most: Mapping[str, float],  # largest plausible strength of each family that has one
) -> CandidateFamilies:
    """Return families beside a model."""
    rss = float(residual @ residual)
    return CandidateFamilies(information, x.T @ residual, rss, dof, columns, most=most)


@dataclass(frozen=True, eq=False)
class Addition:
    """One step of forward selection, before it is taken."""

    name: str  # the family with most evidence
    score: FamilyScore
    scores: Mapping[str, FamilyScore]  # of all families that can be added
    before: CandidateFamilies  # beside the model without it

    @cached_property
    def after(self) -> CandidateFamilies:
        """The families beside the model with it."""
        return self.before.with_family(self.name, self.score)


def forward_selection(families: CandidateFamilies, most: int) -> Iterator[Addition]:
    """Yield up to `most` additions, each with the earlier ones in the model.

    An addition is made when the next one is asked for, so that the caller decides when to stop.
    """
    for _ in range(most):
        if not families.columns:
            return
        scores = families.scores()
        best = max(scores, key=lambda n: scores[n].log_evidence)
        step = Addition(best, scores[best], scores, families)
        yield step
        families = step.after


def block_evidence(gram: Floats, g: Floats, rss: float, dof: float, strengths: Floats) -> Floats:
    """(L,) gain in log evidence of each of L blocks, at its best of the prior strengths (T,).

    `gram` (L, W, W) is of the blocks beside the model, g (L, W) their products with the residual.
    """
    lam, u = np.linalg.eigh(gram)
    seen = visible(lam)
    c2 = np.einsum("lij,li->lj", u, g) ** 2
    explained = np.where(seen, c2 / np.where(seen, lam, 1.0), 0.0)
    found = log_evidence(np.where(seen, lam, 0.0), explained, rss, dof, strengths)
    return np.asarray(found.max(axis=0))


class BlockSelection:
    """Blocks that can be chosen beside a model."""

    def __init__(self, own: Floats, ridge: Floats, x: Floats, y: Floats, fold: Ints) -> None:
        """Form all products of B (R, K), Λ (K,), all blocks (R, L, W) and y (R,), fold by fold.

        y is what remains where the model stands; folds are numbered from 0.
        """
        self._shape, self._own, self._ridge, self._y = x.shape[1:], own, ridge, y
        self._x, self._fold = x.reshape(len(y), -1), fold
        self._of = [self._sums(fold == f) for f in range(int(fold.max()) + 1)]
        self._all = [reduce(np.add, parts) for parts in zip(*self._of, strict=True)]

    def _sums(self, rows: Bools) -> list[Any]:
        """Products of some rows: BᵀB, Bᵀ[X, y], X_lᵀX_l (L, W, W), Xᵀy, yᵀy, and their number."""
        own, x, y = self._own[rows], self._x[rows], self._y[rows]
        blocks = x.reshape(len(y), *self._shape).transpose(1, 2, 0)
        cross = np.column_stack([own.T @ x, own.T @ y])
        square = blocks @ blocks.transpose(0, 2, 1)
        return [own.T @ own, cross, square, x.T @ y, float(y @ y), len(y)]

    def without(self, f: int, most: int, least: float, strengths: Floats) -> list[int]:
        """Return the blocks that the rows without fold f choose, the first one first.

        At most `most`, each with a gain in log evidence of at least `least` at its best strength.
        """
        # a sample of the rows need not have any of the last folds
        out = self._of[f] if f < len(self._of) else [0] * len(self._all)
        inner, cross, square, slope, rss, count_of_rows = (
            whole - part for whole, part in zip(self._all, out, strict=True)
        )
        count, width = self._shape
        c = positive_solve(inner + np.diag(self._ridge), cross)
        e, by_ridge = cross[:, :-1], self._ridge[:, None] * c
        c, own = c[:, :-1], c[:, -1]
        lifted, pull = e + by_ridge[:, :-1], by_ridge[:, -1]
        blocks = [m.reshape(len(e), count, width).transpose(1, 2, 0) for m in (c, lifted)]
        gram = square - blocks[0] @ blocks[1].transpose(0, 2, 1)
        gram = (gram + gram.transpose(0, 2, 1)) / 2
        g = slope - e.T @ own - c.T @ pull
        rss = float(rss - (cross[:, -1] + pull) @ own)
        dof, rows = max(count_of_rows - len(e), 1), self._fold != f
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
