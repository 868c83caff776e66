"""Posterior probabilities of the structures of a law, and predictions averaged over them.

A structure is the sites of a law with the functions and quantities that move them, without free
numbers such as a bend or an exponent. The evidence is averaged over the strengths of the
coefficients (`FamilyScore.marginal`). The priors of the search are its price for a candidate
(`grammar`) and odds of 1 : 20 for each term beyond the first. Then

    P(S | r) = Σ_numbers exp(evidence + log prior) / the same over all structures and no law

over the structures that the search tries: all of one term on the short list, and all that differ
from a chosen law in one term, or have one more. Structures within odds of 20 : 1 of the likeliest
are returned (Occam's window; Madigan and Raftery 1994, J. Am. Stat. Assoc. 89, 1535), and the best
of each complexity. With mean μ_S and covariance V_S of a reading by a structure, the average has

    mean Σ P(S) μ_S,    covariance Σ P(S) (V_S + μ_S μ_Sᵀ) − mean meanᵀ

(Hoeting et al. 1999, Statistical Science 14, 382). Calibrated by `python -m studies odds`.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from hilcal.discovery.amplitudes import Composed, Factor
from hilcal.discovery.law import Coefficient, Form, coefficients, form_of
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.refit import refine
from hilcal.discovery.screen import LawTerm, Screen
from hilcal.discovery.search import (
    LEAST_LOG_ODDS,
    MOST_COEFFICIENTS,
    MOST_TERMS,
    Selection,
    scored_stepwise,
    with_first_price,
    with_simplest_site,
)
from hilcal.discovery.sites import motions_of
from hilcal.identification.fit import Fit
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
from hilcal.types import Floats

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
    """Return the likely structures and the best of each complexity, the likeliest first."""
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

    The std includes the model's parameters, the laws' coefficients, and the choice of the law.
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
