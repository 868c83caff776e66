"""Forward selection of laws with backward pruning, corrected for the size of the search.

At each step the term with the best odds beside the chosen ones is added (see `problem`), and
redundant terms are removed. Of terms within odds of 20 : 1 the simplest is chosen.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from hilcal.discovery.problem import SHORT_LIST, CandidateTerms, SearchProblem
from hilcal.discovery.screen import LawTerm, ScoredTerm, Screen
from hilcal.regression.evidence import FamilyScore
from hilcal.regression.forward_selection import families_beside
from hilcal.types import Floats

BEAM = 3  # First terms that start a selection each; a choice
MOST_TERMS = 3  # Most terms of a law; a choice
MOST_COEFFICIENTS = 8  # Most coefficients of a law; a choice: more are not readable
LEAST_LOG_ODDS = 3.0  # Log odds, corrected for the search, that a further term needs: 20 : 1
FALSE_ALARM = 1e-3  # Probability that the whole search finds a first term in noise
SAME_CORRELATION = 0.98  # Correlation of projected columns above which two laws count as one


@dataclass(frozen=True, eq=False)
class Selection:
    """Chosen terms."""

    terms: tuple[LawTerm, ...]  # in the order of choosing
    odds: tuple[float, ...]  # log odds that each added

    @property
    def total(self) -> float:
        """Logarithm of the odds of the whole law against none."""
        return sum(self.odds)


def search(problem: SearchProblem, most: int = MOST_TERMS, beam: int = BEAM) -> list[Selection]:
    """Return the best selection of each number of terms with sufficient odds; none if by chance."""
    ordered = _ordered(problem)
    if not ordered or ordered[0].odds <= LEAST_LOG_ODDS:
        return []
    first = ordered[0]
    if np.log(max(first.score.p_value, 1e-300)) + first.term.price >= np.log(FALSE_ALARM):
        return []
    starts = _distinct(problem, ordered, beam)
    best: dict[int, Selection] = {}

    def keep(s: Selection) -> None:
        shorter = best.setdefault(len(s.terms), s)
        if _better(problem, s, shorter):
            best[len(s.terms)] = s

    for start in starts:
        s = Selection((start.term,), (start.odds,))
        keep(s)
        while len(s.terms) < most:
            further = _ordered(problem, s.terms)
            if not further or further[0].odds < LEAST_LOG_ODDS:
                break
            terms = (*s.terms, further[0].term)
            if sum(t.count for t in terms) > MOST_COEFFICIENTS:
                break
            grown = _pruned(
                problem, replace(s, terms=terms, odds=stepwise_log_odds(problem, terms))
            )
            if grown.total < s.total + LEAST_LOG_ODDS:
                break
            # The last term is already the best beside the others.
            s = _exchanged(problem, grown, last=len(grown.terms) - 1)
            keep(s)
    return [
        replace(s, terms=tuple(with_simplest_site(problem.screen, t) for t in s.terms))
        for s in sufficiently_better(best[k] for k in sorted(best))
    ]


def sufficiently_better(selections: Iterable[Selection]) -> list[Selection]:
    """Return the selections that have odds of 20 : 1 over every shorter one."""
    out: list[Selection] = []
    for s in selections:
        if all(s.total >= shorter.total + LEAST_LOG_ODDS for shorter in out):
            out.append(s)
    return out


def _ordered(problem: SearchProblem, chosen: tuple[LawTerm, ...] = ()) -> list[ScoredTerm]:
    """Return the short list, best first; the first is the simplest within odds of 20 : 1."""
    scored = problem.scored(chosen)
    if not scored:
        return []

    def preference(c: ScoredTerm) -> tuple[float, ...]:
        """Sort key of terms that are as good: the simplest, then the likeliest first."""
        *simple, functions = _simplicity(problem.screen, c.term)
        return (*simple, -round(c.odds), functions, -c.odds)

    first = min((c for c in scored if c.odds > scored[0].odds - LEAST_LOG_ODDS), key=preference)
    return [first, *(c for c in scored if c is not first)]


def _simplicity(screen: Screen, t: LawTerm) -> tuple[float, ...]:
    """Complexity, rank of sites, distance of joints, rank of functions; smaller is simpler.

    A coefficient, and a number that is not on the grid, count as a unit of complexity each. A
    quantity of the site's own joint is simpler than one of another joint. A joint's temperature
    correlates with everything that changes with time: at another joint it counts a unit more.
    """
    amplitudes = [screen.grammar.amplitude(a) for _, a in t.parts]
    cost = max(a.cost + screen.grammar.tuned(a) for a in amplitudes)
    sites = max(screen.sites[s].rank for s, _ in t.parts)
    functions = max(sum(f.shape.rank for f in a.factors) for a in amplitudes)
    distances = [
        [
            # 0 for the site's own joint, 1 for none, 2 for another one
            (0 if f.variable.joint == screen.sites[s].joint else 1 + (f.variable.joint >= 0),
             f.variable.kind)
            for f in a.factors
        ]
        for a, (s, _) in zip(amplitudes, t.parts, strict=True)
    ]  # fmt: skip
    distance_of_joints = max(sum(distance for distance, _ in part) for part in distances)
    cost += any((2, "temperature") in part for part in distances)
    return t.count + cost, sites, distance_of_joints, functions


def with_simplest_site(screen: Screen, t: LawTerm) -> LawTerm:
    """Replace the site of a term by its simplest alias; terms of several sites keep theirs."""
    places = {place for place, _ in t.parts}
    if len(places) > 1:
        return t
    return replace(t, parts=tuple((screen.alias[place], f) for place, f in t.parts))


def _better(problem: SearchProblem, s: Selection, other: Selection) -> bool:
    """Whether a law is likelier than another one, or simpler if within odds of 20 : 1."""
    if abs(s.total - other.total) > LEAST_LOG_ODDS:
        return s.total > other.total
    return _extent(problem, s.terms) < _extent(problem, other.terms)


def _distinct(problem: SearchProblem, scored: list[ScoredTerm], count: int) -> list[ScoredTerm]:
    out: list[ScoredTerm] = []
    units: list[Floats] = []
    for c in scored[:SHORT_LIST]:
        if c.odds < LEAST_LOG_ODDS:
            break
        x = problem.columns(c.term)
        fit = problem.model.project_out(x) @ c.score.step
        size = float(np.linalg.norm(fit))
        if size == 0:
            continue
        fit = fit / size
        if all(abs(float(fit @ u)) < SAME_CORRELATION for u in units):
            out.append(c)
            units.append(fit)
        if len(out) == count:
            break
    return out


def _pruned(problem: SearchProblem, s: Selection) -> Selection:
    """Remove redundant terms."""
    while len(s.terms) > 1:
        worth = []
        for k, term in enumerate(s.terms):
            remaining = (*s.terms[:k], *s.terms[k + 1 :])
            worth.append(CandidateTerms(problem, remaining).score([term])[0].odds)
        weakest = int(np.argmin(worth))
        if worth[weakest] >= LEAST_LOG_ODDS:
            return replace(s, odds=stepwise_log_odds(problem, s.terms))
        terms = (*s.terms[:weakest], *s.terms[weakest + 1 :])
        terms = with_first_price(terms)
        s = replace(s, terms=terms, odds=stepwise_log_odds(problem, terms))
    return s


def _exchanged(problem: SearchProblem, s: Selection, last: int) -> Selection:
    """Exchange each of the first `last` terms for a better one beside the others."""
    for k in range(last):
        remaining = (*s.terms[:k], *s.terms[k + 1 :])
        ordered = _ordered(problem, remaining)
        if not ordered or ordered[0].term.parts == s.terms[k].parts:
            continue
        terms = with_first_price((*remaining, ordered[0].term))
        if sum(t.count for t in terms) > MOST_COEFFICIENTS:
            continue
        exchanged = replace(s, terms=terms, odds=stepwise_log_odds(problem, terms))
        if _better(problem, exchanged, s):
            s = exchanged
    return s


def with_first_price(terms: tuple[LawTerm, ...]) -> tuple[LawTerm, ...]:
    """Return terms, the first one at its price as the first term."""
    return (replace(terms[0], price=terms[0].price_alone), *terms[1:])


def _extent(problem: SearchProblem, terms: tuple[LawTerm, ...]) -> tuple[float, ...]:
    """Sort key: number of quantities, of sites, and the summed simplicity of the terms."""
    screen = problem.screen
    parts = [part for t in terms for part in t.parts]
    names = {n for _, f in parts for n in screen.grammar.amplitude(f).names}
    simplicity = np.sum([_simplicity(screen, t) for t in terms], axis=0)
    return len(names), len({s for s, _ in parts}), *simplicity.tolist()


def stepwise_log_odds(problem: SearchProblem, terms: tuple[LawTerm, ...]) -> tuple[float, ...]:
    """Log odds of each term beside the previous ones; their sum is that of the whole law."""
    scores = scored_stepwise(problem, terms)
    return tuple(s.log_evidence - t.price for s, t in zip(scores, terms, strict=True))


def scored_stepwise(problem: SearchProblem, terms: tuple[LawTerm, ...]) -> list[FamilyScore]:
    """Score each term beside the previous ones."""
    x = [problem.columns(t) for t in terms]
    ends = np.cumsum([0, *(c.shape[1] for c in x)])
    places = {str(k): slice(int(a), int(b)) for k, (a, b) in enumerate(pairwise(ends))}
    columns = np.hstack(x)
    families = families_beside(
        problem.model.information(columns), problem.residual, problem.noise, columns, places, {}
    )
    out = []
    for name in places:
        out.append(families.scores()[name])
        if out[-1].rank:
            families = families.with_family(name, out[-1])
    return out
