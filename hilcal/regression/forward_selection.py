"""Families added to a model one after the other by algebra, the one with most evidence first.

A refit with one more effect takes seconds to minutes on a large campaign. At the linearisation of
a fit, with S and g of all families and ‖r‖² (see `evidence`), a family f with the ridge λ is added
by the elimination of its columns (`schur.eliminate`). The log evidence of a chain of additions is
the sum of theirs, ln p(r | all) − ln p(r | none), so that one large family and several small ones
compare.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.regression.schur import eliminate
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class CandidateFamilies:
    """Families that can be added to a model.

    Attributes:
        information: (P, P) S of all families' columns beside the model.
        gradient: (P,) g.
        rss: ‖r‖².
        dof: degrees of freedom ν of the residual without any of the families.
        columns: the columns of each family that is not in the model.
        spent: effective number of parameters of the families that are in the model by now.
        most: largest plausible strength of each family that has one.
    """

    information: Floats
    gradient: Floats
    rss: float
    dof: float
    columns: Mapping[str, slice]
    spent: float = 0.0
    most: Mapping[str, float] = field(default_factory=dict)

    def scores(self) -> dict[str, FamilyScore]:
        """Score each family by itself."""
        return {
            name: score_family(
                self.information[k, k],
                self.gradient[k],
                self.rss,
                self.dof,
                self.spent,
                self.most.get(name, np.inf),
            )
            for name, k in self.columns.items()
        }

    def without(self, names: Collection[str]) -> "CandidateFamilies":
        """Leave families out of the choice."""
        return replace(self, columns={n: k for n, k in self.columns.items() if n not in names})

    def with_family(self, name: str, found: FamilyScore) -> "CandidateFamilies":
        """Add a family to the model, with the ridge of its score."""
        s, g, rss = eliminate(
            self.information, self.gradient, self.rss, self.columns[name], found.ridge
        )
        others = {n: k for n, k in self.columns.items() if n != name}
        spent = self.spent + found.effective
        return CandidateFamilies(s, g, rss, self.dof, others, spent, self.most)


def families_beside(
    information: Floats,
    residual: Floats,
    dof: float,
    x: Floats,
    columns: Mapping[str, slice],
    most: Mapping[str, float],
) -> CandidateFamilies:
    """Return families beside a model.

    Args:
        information: (P, P) S of all families' columns beside the model.
        residual: (R,) residual r of the model.
        x: (R, P) whitened columns of all families, in ordinary magnitudes.
        most: largest plausible strength of each family that has one.
    """
    rss = float(residual @ residual)
    return CandidateFamilies(information, x.T @ residual, rss, dof, columns, most=most)


@dataclass(frozen=True, eq=False)
class Addition:
    """One step of forward selection, before it is taken.

    Attributes:
        name: the family with most evidence.
        scores: of all families that can be added.
        before: the families beside the model without it.
    """

    name: str
    score: FamilyScore
    scores: Mapping[str, FamilyScore]
    before: CandidateFamilies

    @cached_property
    def after(self) -> CandidateFamilies:
        """Return the families beside the model with it."""
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
