"""Forward selection of laws with backward pruning, corrected for the size of the search.

At each step the term with the best odds beside the chosen ones is added (see `problem`), and
redundant terms are removed. Of terms within odds of 20 : 1 the simplest is chosen. `structures`
are what the chosen laws and those near them have in common, with their posterior probabilities.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import logsumexp

from hilcal.discovery.amplitudes import Composed, Factor
from hilcal.discovery.law import Coefficient, Form, coefficients, form_of
from hilcal.discovery.problem import SHORT_LIST, CandidateTerms, SearchProblem
from hilcal.discovery.refit import refine
from hilcal.discovery.screen import LawTerm, ScoredTerm, Screen
from hilcal.discovery.sites import motions_of
from hilcal.identification.fit import Fit
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
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


Terms = tuple[LawTerm, ...]
MOST_LIKELY = 8  # Most structures within Occam's window; a choice
OCCAM_WINDOW = 12.0  # Log odds from the best within which a structure counts; a choice


@dataclass(frozen=True, eq=False)
class Structure:
    """A structure of a law, with the numbers that explain most."""

    kind: Hashable  # sites and functions; see `structure_of`
    form: Form
    probability: float  # posterior, among all structures that the search tried
    holdout_share: float  # share of the misfit on poses left out that it explains, by algebra
    step: Floats  # (P,) posterior mean of its coefficients, in ordinary motions
    root: Floats  # (P, Q) root of their posterior covariance
    absorbed: Floats  # (K, P) step of the model's coordinates that absorbs most of each column
    law: str = ""  # name of the proposed law with this structure; empty for none

    @property
    def parameters(self) -> tuple[Coefficient, ...]:
        """Its coefficients, SI."""
        return coefficients(self.form, self.step, np.linalg.norm(self.root, axis=1))


def posterior(odds: Mapping[Hashable, Sequence[float]]) -> dict[Hashable, float]:
    """Return probabilities of structures from log odds of their members against no law."""
    by_kind = {kind: float(logsumexp(members)) for kind, members in odds.items()}
    total = float(logsumexp([0.0, *by_kind.values()]))
    return {kind: float(np.exp(x - total)) for kind, x in by_kind.items()}


def structures(problem: SearchProblem, selections: Sequence[Selection]) -> tuple[Structure, ...]:
    """Return the likely structures and the best of each complexity, the likeliest first.

    A structure is the sites of a law with the functions and quantities that move them, without free
    numbers such as a bend or an exponent. The evidence is averaged over the strengths of the
    coefficients (`FamilyScore.marginal`). The priors of the search are its price for a candidate
    (`grammar`) and odds of 1 : 20 for each term beyond the first. Then

        P(S | r) = Σ_numbers exp(evidence + log prior) / the same over all structures and no law

    over the structures that the search tries: all of one term on the short list, and all that
    differ from a chosen law in one term, or have one more. Structures within odds of 20 : 1 of the
    likeliest are returned (Occam's window; Madigan and Raftery 1994, J. Am. Stat. Assoc. 89, 1535).
    Calibrated by `python -m studies odds`.
    """
    screen = problem.screen
    groups: dict[Hashable, list[tuple[float, Terms]]] = {}
    for odds, terms in _laws_nearby(problem, selections):
        groups.setdefault(structure_of(screen, terms), []).append((odds, terms))
    chosen = {structure_of(screen, s.terms): s.terms for s in selections}
    for s in selections:
        law = log_odds(problem, s.terms), s.terms
        groups.setdefault(structure_of(screen, s.terms), [law])
    chance = posterior({kind: [odds for odds, _ in laws] for kind, laws in groups.items()})
    best = {
        kind: chosen.get(kind, max(laws, key=lambda m: m[0])[1]) for kind, laws in groups.items()
    }
    order = sorted(chance, key=lambda kind: -chance[kind])
    likely = [kind for kind in order if chance[kind] > np.exp(-LEAST_LOG_ODDS) * chance[order[0]]]
    likely = [*likely[:MOST_LIKELY], *chosen]
    simplest = {form_of(screen, best[kind]).complexity: kind for kind in reversed(order)}
    out = [
        _structure(screen, kind, best[kind], chance[kind])
        for kind in order
        if kind in likely or kind in simplest.values()
    ]
    out = [x for x in out if len(x.step)]  # without those that the model absorbs
    return tuple(x for x in out if x.kind in likely or x in pareto(out))


def structure_of(screen: Screen, terms: Terms) -> Hashable:
    """Sites and functions of a law, without their free numbers, and its number of coefficients."""
    return sum(t.count for t in terms), frozenset(
        (screen.alias[s], frozenset(map(_function, screen.grammar.amplitude(a).factors)))
        for t in terms
        for s, a in t.parts
    )


def _function(f: Factor) -> Hashable:
    v = f.variable
    quantity = tuple(a.text() for _, a in v.terms) if isinstance(v, Composed) else v.symbol
    return quantity, f.shape.name, f.numbers if f.shape.name in ("cos", "sin") else ()


def _laws_nearby(
    problem: SearchProblem, selections: Iterable[Selection]
) -> list[tuple[float, Terms]]:
    """Return log odds against no law, and terms, of the laws near the chosen ones."""
    bases: dict[Terms, None] = {(): None}
    for s in selections:
        for k in range(len(s.terms)):
            bases[s.terms[:k] + s.terms[k + 1 :]] = None
        if len(s.terms) < MOST_TERMS:
            bases[s.terms] = None
    out: dict[Hashable, tuple[float, Terms]] = {}
    for base in bases:
        base_odds = log_odds(problem, base)
        for c in problem.scored(base):
            terms = with_first_price((*base, with_simplest_site(problem.screen, c.term)))
            if not c.score.rank or sum(t.count for t in terms) > MOST_COEFFICIENTS:
                continue
            odds = base_odds + c.score.marginal - c.term.price - LEAST_LOG_ODDS * bool(base)
            key = frozenset((t.parts, t.common) for t in (*base, c.term))
            if key not in out or out[key][0] < odds:
                out[key] = odds, terms
    least = max((odds for odds, _ in out.values()), default=0.0) - OCCAM_WINDOW
    # Scores beside chosen terms, whose coefficients are free, differ slightly from the exact odds.
    return [
        (odds if len(terms) == 1 else log_odds(problem, terms), terms)
        for odds, terms in out.values()
        if len(terms) == 1 or odds > least
    ]


def log_odds(problem: SearchProblem, terms: Terms) -> float:
    """Return the log posterior odds of a law with these numbers, against no law."""
    if not terms:
        return 0.0
    terms = with_first_price(terms)
    evidence = sum(s.marginal for s in scored_stepwise(problem, terms))
    return evidence - sum(t.price for t in terms) - LEAST_LOG_ODDS * (len(terms) - 1)


def _structure(screen: Screen, kind: Hashable, terms: Terms, chance: float) -> Structure:
    linear = screen.linear
    form = refine(screen, form_of(screen, terms))
    x = form.columns(screen, linear.fit.solution.prediction.situation)
    score = linear.score(x)
    (held,) = linear.held_out([(linear.products([x])[0], score)])
    absorbed = linear.projection.solve(linear.rows.T @ x)
    return Structure(kind, form, chance, held.share, score.step, score.root, absorbed)


def pareto(candidates: Sequence[Structure]) -> tuple[Structure, ...]:
    """Return structures that are best in complexity and on poses left out, simplest first."""
    order = sorted(candidates, key=lambda s: (s.form.complexity, -s.holdout_share))
    out: list[Structure] = []
    for s in order:
        if not out or s.holdout_share > out[-1].holdout_share:
            out.append(s)
    return tuple(out)


def averaged(fit: Fit, laws: Sequence[Structure], readings: Readings) -> tuple[Floats, Floats]:
    """Return the (D, m) mean motion of readings by likely laws, and its std.

    With mean μ_S and covariance V_S of a reading by a structure (Hoeting et al. 1999, Statistical
    Science 14, 382):

        mean Σ P(S) μ_S,    covariance Σ P(S) (V_S + μ_S μ_Sᵀ) − mean meanᵀ
    """
    prediction = fit.model.predict(readings.states, fit.theta)
    w, s = whitening(readings, fit.mode), prediction.situation
    base = w.raw(fit.model.jacobian(prediction, fit.theta, w.m)) @ fit.solution.transform
    sites, motion = motions_of(fit.model, prediction, fit.theta, w.m)
    by_model = base @ fit.solution.projection().inverse_root.T
    chance = np.array([x.probability for x in laws])
    mean, square = np.zeros(base.shape[:2]), np.sum(by_model**2, axis=-1)
    for x, p in zip(laws, chance / chance.sum(), strict=True):
        columns = w.raw(x.form.motion(sites, motion, s)) - base @ x.absorbed
        contribution = columns @ x.step
        mean += p * contribution
        square += p * (contribution**2 + np.sum((columns @ x.root) ** 2, axis=-1))
    return mean, np.sqrt(np.maximum(square - mean**2, 0.0))
