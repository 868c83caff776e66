"""Families, or blocks of columns, added to a model in order of their evidence.

A refit with one more effect takes seconds to minutes on a large campaign. At the linearisation of a
fit, with S and g of all families and ‖r‖² (see `evidence`), a family f with the ridge λ is added by
the elimination of its columns (`schur.eliminate`). The log evidences of a chain of additions add up
to ln p(r | all) − ln p(r | none), so that one large family can be compared with several small ones.

Blocks are chosen without each fold. With B (R, K) the columns of the model, Λ the precision of
their prior (zero for those without one), X_l (R, W) the blocks, y the measurements less the model
with the parameters zero, and M = 1 − B H⁻¹ Bᵀ, H = BᵀB + Λ, on the rows outside of the fold,
generalised least squares needs

    X_kᵀ M X_l = X_kᵀ X_l − E_kᵀ C_l,    E = Bᵀ X,  C = H⁻¹ E

and likewise with y in the place of a block: M is the inverse covariance of y beside the columns
without a prior. All products are sums over rows: they are formed once for each fold, and those
without a fold are the sums over the other folds.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from typing import Any

import numpy as np

from hilcal.regression.evidence import FamilyScore, log_evidence, score_family, visible
from hilcal.regression.schur import eliminate, positive_solve
from hilcal.types import Bools, Floats, Ints

SPANNED = 1e-6  # eigenvalues of a chosen block's gram below this share of the largest are ignored:
# directions that the model and earlier blocks nearly explain; a choice


@dataclass(frozen=True, slots=True, eq=False)
class CandidateFamilies:
    """Families that can be added to a model."""

    information: Floats  # (P, P) S of all families' columns
    gradient: Floats  # (P,) g
    rss: float  # ‖r‖²
    dof: float  # degrees of freedom ν of the residual without any of the families
    columns: Mapping[str, slice]  # of each family outside of the model
    spent: float = 0.0  # effective number of parameters of the families in the model
    largest: Mapping[str, float] = field(default_factory=dict)  # largest plausible strengths

    def scores(self) -> dict[str, FamilyScore]:
        """Score each family alone."""
        s, g, model = self.information, self.gradient, (self.rss, self.dof, self.spent)
        return {
            name: score_family(s[k, k], g[k], *model, self.largest.get(name, np.inf))
            for name, k in self.columns.items()
        }

    def without(self, names: Collection[str]) -> "CandidateFamilies":
        """Leave families out of the choice."""
        return replace(self, columns={n: k for n, k in self.columns.items() if n not in names})

    def with_family(self, name: str, score: FamilyScore) -> "CandidateFamilies":
        """Add a family to the model, with the ridge of its score."""
        columns = self.columns[name]
        s, g, rss = eliminate(self.information, self.gradient, self.rss, columns, score.ridge)
        spent = self.spent + score.effective
        return replace(self.without([name]), information=s, gradient=g, rss=rss, spent=spent)


def families_beside(
    information: Floats,  # (P, P) S of all families' columns
    residual: Floats,  # (R,) r of the model
    noise: tuple[float, float],  # ‖r‖², with a background yᵀ M y, and its degrees of freedom
    x: Floats,  # (R, P) whitened columns of all families, in ordinary magnitudes
    columns: Mapping[str, slice],
    largest: Mapping[str, float],  # largest plausible strength of each family that has one
) -> CandidateFamilies:
    """Return the families that can be added to a model."""
    return CandidateFamilies(information, x.T @ residual, *noise, columns, largest=largest)


@dataclass(frozen=True, eq=False)
class Addition:
    """A proposed step of forward selection."""

    name: str  # the family with most evidence, of those that pass
    score: FamilyScore
    scores: Mapping[str, FamilyScore]  # of all candidate families
    before: CandidateFamilies  # without the proposed family in the model

    @cached_property
    def after(self) -> CandidateFamilies:
        """The candidates with the proposed family in the model."""
        return self.before.with_family(self.name, self.score)


def forward_selection(
    families: CandidateFamilies,
    most: int,
    passes: Callable[[FamilyScore], bool] = lambda score: True,
) -> Iterator[Addition]:
    """Yield up to `most` additions, each with the previous ones in the model.

    Each is the family with most evidence of those that pass. An addition is carried out when the
    next one is requested, so that the caller decides when to stop.
    """
    for _ in range(most):
        scores = families.scores()
        passing = [n for n, score in scores.items() if passes(score)]
        if not passing:
            return
        best = max(passing, key=lambda n: scores[n].log_evidence)
        step = Addition(best, scores[best], scores, families)
        yield step
        families = step.after


def block_evidence(gram: Floats, g: Floats, rss: float, dof: float, strengths: Floats) -> Floats:
    """Gain in log evidence (L,) of each of L blocks, at its best of the prior strengths (T,).

    Of blocks projected off the model, with their gram (L, W, W) and products with r, g (L, W).
    """
    lam, u = np.linalg.eigh(gram)
    testable = visible(lam)
    c2 = np.einsum("lij,li->lj", u, g) ** 2
    explained = np.where(testable, c2 / np.where(testable, lam, 1.0), 0.0)
    evidence = log_evidence(np.where(testable, lam, 0.0), explained, rss, dof, strengths)[0]
    return np.asarray(evidence.max(axis=0))


class BlockSelection:
    """Blocks that can be added to a model."""

    def __init__(
        self, b: Floats, ridge: Floats, x: Floats, y: Floats, fold: Ints, flat: int
    ) -> None:
        """Form all products of B (R, K), Λ (K,), all blocks (R, L, W) and y (R,), fold by fold.

        Folds are numbered from 0; `flat` is the number of columns of B without a prior.
        """
        self._shape, self._b, self._ridge, self._y = x.shape[1:], b, ridge, y
        self._x, self._fold, self._flat = x.reshape(len(y), -1), fold, flat
        self._of_fold = [self._sums(fold == f) for f in range(int(fold.max()) + 1)]
        self._all = [reduce(np.add, parts) for parts in zip(*self._of_fold, strict=True)]

    def _sums(self, rows: Bools) -> list[Any]:
        """Products of some rows: BᵀB, Bᵀ[X, y], X_lᵀX_l (L, W, W), Xᵀy, yᵀy, and their number."""
        b, x, y = self._b[rows], self._x[rows], self._y[rows]
        blocks = x.reshape(len(y), *self._shape).transpose(1, 2, 0)
        cross = np.column_stack([b.T @ x, b.T @ y])
        square = blocks @ blocks.transpose(0, 2, 1)
        return [b.T @ b, cross, square, x.T @ y, float(y @ y), len(y)]

    def without(self, f: int, most: int, least: float, strengths: Floats) -> list[int]:
        """Return the blocks that the rows outside of fold f support, in the order of choice.

        At most `most`, each with a gain in log evidence of at least `least` at its best strength.
        """
        # A sample of the rows may lack the last folds.
        fold = self._of_fold[f] if f < len(self._of_fold) else [0] * len(self._all)
        inner, cross, square, slope, rss, count_of_rows = (
            total - part for total, part in zip(self._all, fold, strict=True)
        )
        count, width = self._shape
        c = positive_solve(inner + np.diag(self._ridge), cross)
        e, c, step = cross[:, :-1], c[:, :-1], c[:, -1]
        blocks = [m.reshape(len(e), count, width).transpose(1, 2, 0) for m in (c, e)]
        gram = square - blocks[0] @ blocks[1].transpose(0, 2, 1)
        gram = (gram + gram.transpose(0, 2, 1)) / 2
        g = slope - e.T @ step
        rss = float(rss - cross[:, -1] @ step)
        dof, rows = max(count_of_rows - self._flat, 1), self._fold != f
        chosen: list[int] = []
        explained = np.zeros((0, count * width))
        for _ in range(most):
            evidence = block_evidence(gram, g.reshape(count, width), rss, dof, strengths)
            best = int(np.argmax(evidence))
            if evidence[best] < least:
                break
            chosen.append(best)
            block = slice(best * width, (best + 1) * width)
            products = self._x[rows].T @ self._x[rows, block] - e.T @ c[:, block]
            products -= explained.T @ explained[:, block]
            lam, u = np.linalg.eigh(gram[best])
            free = lam > SPANNED * lam[-1]
            unit = (u[:, free] / np.sqrt(lam[free])).T
            along, size = unit @ products.T, unit @ g[block]
            of_block = along.reshape(-1, count, width).transpose(1, 2, 0)
            gram = gram - of_block @ of_block.transpose(0, 2, 1)
            g, rss = g - along.T @ size, rss - float(size @ size)
            explained = np.vstack([explained, along])
            dof = max(dof - len(unit), 1)
        return chosen
