"""The search repeated without some of the poses: its laws predict them, and are the same or not.

The poses that are left out take no part in the choice of a law, nor in its coefficients. What the
law then explains of their misfit is what the whole procedure may claim.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.discovery.law import Again
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.screen import Screen
from hilcal.discovery.search import Selection, search
from hilcal.discovery.terms import LawTerm
from hilcal.identification.folds import random_folds
from hilcal.identification.linearisation import by_pose
from hilcal.regression.paired_test import improves
from hilcal.types import Bools, Floats

FOLDS = 5
"""As in the regression of the residual; a choice."""
RIDGE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class FoldSearch:
    """What the search without each fold came to.

    Attributes:
        share: of the misfit of the poses left out that its laws explain.
        sure: whether their error falls by more than it scatters from pose to pose.
        found: the laws of each fold; empty where it proposes none.
    """

    share: float
    sure: bool
    found: tuple[Selection | None, ...]


def search_by_folds(screen: Screen, most: int) -> FoldSearch:
    """Repeat the search without each fold of poses."""
    linear = screen.linear
    fit = linear.fit
    fold = fit.whitening.rows_of(random_folds(fit.pose, FOLDS))
    before, after = np.zeros(len(fold)), np.zeros(len(fold))
    found: list[Selection | None] = []
    for f in range(int(fold.max()) + 1):
        out = fold == f
        problem = SearchProblem(screen, ~out)
        selections = search(problem, most, beam=1)
        chosen = max(selections, key=lambda s: s.total, default=None)
        found.append(chosen)
        before[out] = predicted(problem, None, out)
        after[out] = before[out] if chosen is None else predicted(problem, chosen, out)
    of_pose = by_pose(fit, before), by_pose(fit, after)
    rank = fit.whitening.rank
    misfit = max(float(of_pose[0].sum()) - rank, 3.0 * np.sqrt(2.0 * rank))
    share = float(np.clip((of_pose[0].sum() - of_pose[1].sum()) / misfit, -1.0, 1.0))
    return FoldSearch(share, improves(*of_pose), tuple(found))


def predicted(problem: SearchProblem, selection: Selection | None, out: Bools) -> Floats:
    """Residual of rows that are left out, by model and law refitted to the others."""
    screen = problem.screen
    linear = screen.linear
    rows, white = linear.rows, linear.fit.white
    terms = () if selection is None else selection.terms
    x = np.hstack([rows, *map(screen.columns_of, terms)])
    used = problem.rows
    own = x[used]
    ridge = np.full(x.shape[1], RIDGE)
    ridge[: rows.shape[1]] = np.maximum(linear.projection.ridge, RIDGE)
    step = np.linalg.solve(own.T @ own + np.diag(ridge), own.T @ white[used])
    return np.asarray(white[out] - x[out] @ step)


def found_again(screen: Screen, folds: FoldSearch, terms: tuple[LawTerm, ...]) -> tuple[Again, ...]:
    """Say of each site and what moves it in how many searches without a fold it was found again."""
    searches = [_causes(screen, s.terms) for s in folds.found if s is not None]
    count = max(len(folds.found), 1)
    return tuple(
        Again(place, names, sum((place, frozenset(names)) in s for s in searches) / count)
        for (place, _), names in _causes(screen, terms).items()
    )


def _causes(
    screen: Screen, terms: tuple[LawTerm, ...]
) -> dict[tuple[str, frozenset[str]], tuple[str, ...]]:
    """Sites with the quantities that move them; a constant is not one where others do."""
    named = [(screen.sites[s].words, screen.grammar.at(f).names) for t in terms for s, f in t.parts]
    moved = {place for place, names in named if names}
    return {
        (place, frozenset(names)): names for place, names in named if names or place not in moved
    }
