"""Forward selection of laws with backward pruning, the size of the search paid for.

At each step the term with the best odds beside those that are chosen is added (see `problem`), and
terms are taken out again where the others make them needless. Of terms that odds of 20 : 1 do not
tell apart the simplest is taken.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hilcal.discover.problem import SHORT_LIST, Beside, Problem, Scored, Term
from hilcal.discover.screen import Screen
from hilcal.regression.forward_selection import families_beside
from hilcal.types import Floats

BEAM = 3
"""First terms with which selections are begun; a choice."""
MOST_TERMS = 3
"""Terms of a law at most; a choice."""
MOST_COEFFICIENTS = 8
"""Coefficients of a law at most; a choice: more is no law that one reads."""
LEAST = 3.0
"""Logarithm of the odds, the search paid for, that a further term needs: 20 : 1."""
FALSE_ALARM = 1e-3
"""Chance of a first term where nothing is hidden, over the whole search."""
SAME = 0.98
"""Correlation of two projected columns from which on they count as the same law."""


@dataclass(frozen=True, eq=False)
class Selection:
    """Terms that were chosen.

    Attributes:
        terms: in the order of choosing them.
        odds: that each added.
        near: first terms whose odds are not much less than those of the best.
    """

    terms: tuple[Term, ...]
    odds: tuple[float, ...]
    near: tuple[Scored, ...] = ()

    @property
    def total(self) -> float:
        """Logarithm of the odds of the whole law against none."""
        return sum(self.odds)


def search(problem: Problem, most: int = MOST_TERMS, beam: int = BEAM) -> list[Selection]:
    """Return the best selection of each number of terms, from one on; none where chance would do.

    Args:
        problem: the rows to search on.
        most: terms at most.
        beam: first terms that are followed.
    """
    beside = problem.beside(())
    found = _ordered(beside)
    if not found or not _sure(found[0], problem):
        return []
    starts = _distinct(problem, found, beam)
    near = tuple(c for c in found if c.odds > found[0].odds - 2 * LEAST)
    best: dict[int, Selection] = {}
    for start in starts:
        s = Selection((start.term,), (start.odds,), near)
        _keep(best, s)
        while len(s.terms) < most:
            after = problem.beside(s.terms)
            further = _ordered(after)
            if not further or further[0].odds < LEAST:
                break
            more = further[0]
            terms = (*s.terms, more.term)
            if sum(t.count for t in terms) > MOST_COEFFICIENTS:
                break
            grown = _pruned(problem, replace(s, terms=terms, odds=_chain(problem, terms)))
            if grown.total < s.total + LEAST:
                break
            s = grown
            _keep(best, s)
    return [best[k] for k in sorted(best)]


def _ordered(beside: Beside) -> list[Scored]:
    """Score the short list, best first; the simplest of those that odds of 20 : 1 do not tell."""
    found = sorted(beside.score(beside.shortlist()), key=lambda c: -c.odds)
    if not found:
        return []
    as_good = [c for c in found if c.odds > found[0].odds - LEAST]
    first = min(as_good, key=lambda c: (_simplicity(beside.problem.screen, c.term), -c.odds))
    return [first, *(c for c in found if c is not first)]


def _simplicity(screen: Screen, t: Term) -> tuple[float, ...]:
    """Coefficients, complexity, rank of sites and functions, joints apart; smaller is simpler.

    Of causes that the readings do not tell apart, as joints that warm alike, the one of the joint
    itself is simpler than that of another.
    """
    amplitudes = [screen.grammar.amplitudes[a] for _, a in t.parts]
    cost = max(a.cost for a in amplitudes)
    sites = max(screen.sites[s].rank for s, _ in t.parts)
    functions = max(sum(f.shape.rank for f in a.factors) for a in amplitudes)
    apart = max(
        sum(f.variable.joint not in (-1, screen.sites[s].joint) for f in amplitudes[k].factors)
        for k, (s, _) in enumerate(t.parts)
    )
    return t.count, cost, sites, functions, apart


def _keep(best: dict[int, Selection], s: Selection) -> None:
    count = len(s.terms)
    if count not in best or s.total > best[count].total:
        best[count] = s


def _sure(c: Scored, problem: Problem) -> bool:
    """Whether chance would not do the same, over the whole search."""
    return c.odds > LEAST and np.log(max(c.score.p_value, 1e-300)) + c.term.price < np.log(
        FALSE_ALARM
    )


def _distinct(problem: Problem, found: list[Scored], count: int) -> list[Scored]:
    """Return the best terms that are not the same law."""
    out: list[Scored] = []
    units: list[Floats] = []
    for c in found[:SHORT_LIST]:
        if c.odds < LEAST:
            break
        x = problem.columns(c.term)
        fit = problem.model.project_out(x) @ c.score.step
        size = float(np.linalg.norm(fit))
        if size == 0:
            continue
        fit = fit / size
        if all(abs(float(fit @ u)) < SAME for u in units):
            out.append(c)
            units.append(fit)
        if len(out) == count:
            break
    return out


def _pruned(problem: Problem, s: Selection) -> Selection:
    """Take out terms that the others make needless."""
    while len(s.terms) > 1:
        worth = []
        for k, term in enumerate(s.terms):
            others = (*s.terms[:k], *s.terms[k + 1 :])
            worth.append(problem.beside(others).score([term])[0].odds)
        weakest = int(np.argmin(worth))
        if worth[weakest] >= LEAST:
            return replace(s, odds=_chain(problem, s.terms))
        terms = (*s.terms[:weakest], *s.terms[weakest + 1 :])
        s = replace(s, terms=terms, odds=_chain(problem, terms))
    return s


def _chain(problem: Problem, terms: tuple[Term, ...]) -> tuple[float, ...]:
    """Odds of each term beside those before it, whose coefficients keep their priors.

    So they add up to the odds of the whole law, and compare with those of effects.
    """
    x = [problem.columns(t) for t in terms]
    ends = np.cumsum([0, *(c.shape[1] for c in x)])
    places = {str(k): slice(int(a), int(b)) for k, (a, b) in enumerate(pairwise(ends))}
    whole = np.hstack(x)
    families = families_beside(
        problem.model.information(whole), problem.residual, problem.dof, whole, places, {}
    )
    out = []
    for k, term in enumerate(terms):
        score = families.scores()[str(k)]
        out.append(score.log_evidence - term.price)
        if score.rank:
            families = families.with_family(str(k), score)
    return tuple(out)
