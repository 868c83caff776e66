"""Forward selection of laws with backward pruning, corrected for the size of the search.

At each step the term with the best odds beside those that are chosen is added (see `problem`), and
terms are taken out again where the others make them needless. Of terms that odds of 20 : 1 do not
tell apart the simplest is taken.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hilcal.discovery.problem import SHORT_LIST, SearchProblem
from hilcal.discovery.screen import LawTerm, Scored, Screen
from hilcal.regression.evidence import FamilyScore
from hilcal.regression.forward_selection import families_beside
from hilcal.types import Floats

BEAM = 3  # First terms with which selections are begun; a choice
MOST_TERMS = 3  # Terms of a law at most; a choice
MOST_COEFFICIENTS = 8  # Coefficients of a law at most; a choice: more is no law that one reads
LEAST = 3.0  # Logarithm of the odds, corrected for the search, that a further term needs: 20 : 1
FALSE_ALARM = 1e-3  # Chance of a first term where nothing is hidden, over the whole search
SAME = 0.98  # Correlation of two projected columns from which on they count as the same law


@dataclass(frozen=True, eq=False)
class Selection:
    """Terms that were chosen."""

    terms: tuple[LawTerm, ...]  # in the order of choosing them
    odds: tuple[float, ...]  # that each added

    @property
    def total(self) -> float:
        """Logarithm of the odds of the whole law against none."""
        return sum(self.odds)


def search(problem: SearchProblem, most: int = MOST_TERMS, beam: int = BEAM) -> list[Selection]:
    """Return the best selection of each number of terms, from one on; none where chance would do.

    A longer one is returned only where odds of 20 : 1 ask for it beside every shorter one.
    """
    found = _ordered(problem)
    if not found or not _sure(found[0]):
        return []
    starts = _distinct(problem, found, beam)
    best: dict[int, Selection] = {}
    for start in starts:
        s = Selection((start.term,), (start.odds,))
        _keep(problem, best, s)
        while len(s.terms) < most:
            further = _ordered(problem, s.terms)
            if not further or further[0].odds < LEAST:
                break
            more = further[0]
            terms = (*s.terms, more.term)
            if sum(t.count for t in terms) > MOST_COEFFICIENTS:
                break
            grown = _pruned(problem, replace(s, terms=terms, odds=chain(problem, terms)))
            if grown.total < s.total + LEAST:
                break
            # What was added last is the best beside the others already.
            s = _exchanged(problem, grown, last=len(grown.terms) - 1)
            _keep(problem, best, s)
    return [
        replace(s, terms=tuple(plain(problem.screen, t) for t in s.terms))
        for s in worth_their_length(best[k] for k in sorted(best))
    ]


def worth_their_length(selections: Iterable[Selection]) -> list[Selection]:
    """Return those that odds of 20 : 1 ask for beside every one before, which is shorter."""
    out: list[Selection] = []
    for s in selections:
        if all(s.total >= shorter.total + LEAST for shorter in out):
            out.append(s)
    return out


def _ordered(problem: SearchProblem, chosen: tuple[LawTerm, ...] = ()) -> list[Scored]:
    """Return the short list, best first; the simplest of those that odds of 20 : 1 do not tell."""
    found = problem.scored(chosen)
    if not found:
        return []
    as_good = [c for c in found if c.odds > found[0].odds - LEAST]
    first = min(as_good, key=lambda c: _preference(problem.screen, c))
    return [first, *(c for c in found if c is not first)]


def _preference(screen: Screen, c: Scored) -> tuple[float, ...]:
    """Which of terms as good is taken: the simplest, and of equally simple ones the likeliest."""
    *simple, functions = _simplicity(screen, c.term)
    return (*simple, -round(c.odds), functions, -c.odds)


def _simplicity(screen: Screen, t: LawTerm) -> tuple[float, ...]:
    """Numbers and complexity, rank of sites, joints apart, rank of functions; smaller is simpler.

    A coefficient, and a number that is not of the grid, count as much as a unit of complexity. Of
    causes that the readings do not tell apart, the one of the joint itself is simpler than that of
    another. A joint's temperature stands for whatever else changes with time: elsewhere it counts a
    unit more.
    """
    amplitudes = [screen.grammar.at(a) for _, a in t.parts]
    cost = max(a.cost + screen.grammar.tuned(a) for a in amplitudes)
    sites = max(screen.sites[s].rank for s, _ in t.parts)
    functions = max(sum(f.shape.rank for f in a.factors) for a in amplitudes)
    far = [
        [
            # of the site's own joint, of none, or of another one
            (0 if f.variable.joint == screen.sites[s].joint else 1 + (f.variable.joint >= 0),
             f.variable.kind)
            for f in a.factors
        ]
        for a, (s, _) in zip(amplitudes, t.parts, strict=True)
    ]  # fmt: skip
    apart = max(sum(distance for distance, _ in each) for each in far)
    cost += any((2, "temperature") in each for each in far)
    return t.count + cost, sites, apart, functions


def _keep(problem: SearchProblem, best: dict[int, Selection], s: Selection) -> None:
    count = len(s.terms)
    if count not in best or _better(problem, s, best[count]):
        best[count] = s


def plain(screen: Screen, t: LawTerm) -> LawTerm:
    """Name the simplest site that moves all readings alike; terms of several sites keep theirs."""
    places = {place for place, _ in t.parts}
    if len(places) > 1:
        return t
    return replace(t, parts=tuple((screen.alias[place], f) for place, f in t.parts))


def _better(problem: SearchProblem, s: Selection, other: Selection) -> bool:
    """Whether a law is more likely, or simpler where odds of 20 : 1 do not tell them apart."""
    if abs(s.total - other.total) > LEAST:
        return s.total > other.total
    return _extent(problem, s.terms) < _extent(problem, other.terms)


def _sure(c: Scored) -> bool:
    return c.odds > LEAST and np.log(max(c.score.p_value, 1e-300)) + c.term.price < np.log(
        FALSE_ALARM
    )


def _distinct(problem: SearchProblem, found: list[Scored], count: int) -> list[Scored]:
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


def _pruned(problem: SearchProblem, s: Selection) -> Selection:
    """Take out terms that the others make needless."""
    while len(s.terms) > 1:
        worth = []
        for k, term in enumerate(s.terms):
            others = (*s.terms[:k], *s.terms[k + 1 :])
            worth.append(problem.beside(others).score([term])[0].odds)
        weakest = int(np.argmin(worth))
        if worth[weakest] >= LEAST:
            return replace(s, odds=chain(problem, s.terms))
        terms = (*s.terms[:weakest], *s.terms[weakest + 1 :])
        terms = led(terms)
        s = replace(s, terms=terms, odds=chain(problem, terms))
    return s


def _exchanged(problem: SearchProblem, s: Selection, last: int) -> Selection:
    """Exchange each of the first terms for a better one beside the others, which came later."""
    for k in range(last):
        others = (*s.terms[:k], *s.terms[k + 1 :])
        found = _ordered(problem, others)
        if not found or found[0].term.parts == s.terms[k].parts:
            continue
        terms = led((*others, found[0].term))
        if sum(t.count for t in terms) > MOST_COEFFICIENTS:
            continue
        other = replace(s, terms=terms, odds=chain(problem, terms))
        if _better(problem, other, s):
            s = other
    return s


def led(terms: tuple[LawTerm, ...]) -> tuple[LawTerm, ...]:
    """Return terms of which the first pays the price of one that stands alone."""
    return (replace(terms[0], price=terms[0].alone), *terms[1:])


def _extent(problem: SearchProblem, terms: tuple[LawTerm, ...]) -> tuple[float, ...]:
    """Number of quantities, of sites, of coefficients; how simple the terms are."""
    screen = problem.screen
    parts = [part for t in terms for part in t.parts]
    names = {n for _, f in parts for n in screen.grammar.at(f).names}
    each = np.sum([_simplicity(screen, t) for t in terms], axis=0)
    return len(names), len({s for s, _ in parts}), *each.tolist()


def chain(problem: SearchProblem, terms: tuple[LawTerm, ...]) -> tuple[float, ...]:
    """Odds of each term beside those before it; they add up to the odds of the whole law."""
    scores = chained(problem, terms)
    return tuple(s.log_evidence - t.price for s, t in zip(scores, terms, strict=True))


def chained(problem: SearchProblem, terms: tuple[LawTerm, ...]) -> list[FamilyScore]:
    """Score each term beside those before it."""
    x = [problem.columns(t) for t in terms]
    ends = np.cumsum([0, *(c.shape[1] for c in x)])
    places = {str(k): slice(int(a), int(b)) for k, (a, b) in enumerate(pairwise(ends))}
    whole = np.hstack(x)
    families = families_beside(
        problem.model.information(whole), problem.residual, problem.dof, whole, places, {}
    )
    out = []
    for name in places:
        out.append(families.scores()[name])
        if out[-1].rank:
            families = families.with_family(name, out[-1])
    return out
