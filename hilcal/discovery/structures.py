"""Posterior probabilities of the structures of a law, and predictions averaged over them.

A structure is where a law acts and by which functions of which quantities; free numbers in these,
as a bend or an exponent, are not part of it. With the evidence averaged over the strengths of the
coefficients (`FamilyScore.marginal`), and the priors of the search, which are its price for a
candidate (`grammar`) and odds of 1 : 20 for each term beyond the first,

    P(S | r) = Σ_numbers exp(evidence + log prior) / the same over all structures, none among them

over the structures that the search meets: all of one term on the short list, and all that differ
from a chosen law in one term, or have one more. Those within odds of 20 : 1 of the likeliest are
kept (Occam's window; Madigan and Raftery 1994, J. Am. Stat. Assoc. 89, 1535), and the best of each
complexity. With mean μ_S and covariance V_S of a reading by a structure, the model average has

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
    LEAST,
    MOST_COEFFICIENTS,
    MOST_TERMS,
    Selection,
    chained,
    led,
    plain,
)
from hilcal.discovery.sites import motions_of
from hilcal.identification.fit import Fit
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
from hilcal.types import Floats

Terms = tuple[LawTerm, ...]
MOST_LIKELY = 8  # Structures within Occam's window that are kept; a choice
CLOSE = 12.0  # log odds from the best within which a structure counts; a choice


@dataclass(frozen=True, eq=False)
class Structure:
    """A structure of a law, its numbers where they explain most."""

    kind: Hashable  # sites and functions; see `structure_of`
    form: Form
    probability: float  # posterior, of all that were met
    holdout_share: float  # share of the misfit that it explains on poses left out, by algebra
    step: Floats  # (P,) posterior mean of its coefficients, in ordinary motions
    root: Floats  # (P, Q) root of their posterior covariance
    absorbed: Floats  # (K, P) change of the model's coordinates that describes most of each column
    law: str = ""  # name of the law that it is, where it is proposed

    @property
    def parameters(self) -> tuple[Coefficient, ...]:
        """Its coefficients, SI."""
        return coefficients(self.form, self.step, np.linalg.norm(self.root, axis=1))


def posterior(odds: Mapping[Hashable, Sequence[float]]) -> dict[Hashable, float]:
    """Return the probability of each structure, from the log odds of its members against no law."""
    each = {kind: float(logsumexp(of)) for kind, of in odds.items()}
    whole = float(logsumexp([0.0, *each.values()]))
    return {kind: float(np.exp(x - whole)) for kind, x in each.items()}


def structures(problem: SearchProblem, selections: Sequence[Selection]) -> tuple[Structure, ...]:
    """Return the likely structures and the best of each complexity, the likeliest first."""
    screen = problem.screen
    met = _met(problem, selections)
    groups: dict[Hashable, list[tuple[float, Terms]]] = {}
    for odds, terms in met:
        groups.setdefault(structure_of(screen, terms), []).append((odds, terms))
    chosen = {structure_of(screen, s.terms): s.terms for s in selections}
    for s in selections:
        own = log_odds(problem, s.terms), s.terms
        groups.setdefault(structure_of(screen, s.terms), [own])
    chance = posterior({kind: [odds for odds, _ in own] for kind, own in groups.items()})
    best = {kind: chosen.get(kind, max(own, key=lambda m: m[0])[1]) for kind, own in groups.items()}
    order = sorted(chance, key=lambda kind: -chance[kind])
    likely = [kind for kind in order if chance[kind] > np.exp(-LEAST) * chance[order[0]]]
    likely = [*likely[:MOST_LIKELY], *chosen]
    simplest = {form_of(screen, best[kind]).complexity: kind for kind in reversed(order)}
    made = [
        _structure(screen, kind, best[kind], chance[kind])
        for kind in order
        if kind in likely or kind in simplest.values()
    ]
    made = [x for x in made if len(x.step)]  # else the model explains it
    return tuple(x for x in made if x.kind in likely or x in pareto(made))


def structure_of(screen: Screen, terms: Terms) -> Hashable:
    """Sites and functions of a law, without their free numbers, and its number of coefficients."""
    return sum(t.count for t in terms), frozenset(
        (screen.alias[s], frozenset(map(_function, screen.grammar.at(a).factors)))
        for t in terms
        for s, a in t.parts
    )


def _function(f: Factor) -> Hashable:
    v = f.variable
    of = tuple(a.text() for _, a in v.terms) if isinstance(v, Composed) else v.symbol
    return of, f.shape.name, f.numbers if f.shape.name in ("cos", "sin") else ()


def _met(problem: SearchProblem, selections: Iterable[Selection]) -> list[tuple[float, Terms]]:
    """Return log odds against no law, and terms, of the laws near those that were chosen."""
    bases: dict[Terms, None] = {(): None}
    for s in selections:
        for k in range(len(s.terms)):
            bases[s.terms[:k] + s.terms[k + 1 :]] = None
        if len(s.terms) < MOST_TERMS:
            bases[s.terms] = None
    out: dict[Hashable, tuple[float, Terms]] = {}
    for others in bases:
        known = log_odds(problem, others)
        for c in problem.scored(others):
            terms = led((*others, plain(problem.screen, c.term)))
            if not c.score.rank or sum(t.count for t in terms) > MOST_COEFFICIENTS:
                continue
            odds = known + c.score.marginal - c.term.price - LEAST * bool(others)
            key = frozenset((t.parts, t.common) for t in (*others, c.term))
            if key not in out or out[key][0] < odds:
                out[key] = odds, terms
    least = max((odds for odds, _ in out.values()), default=0.0) - CLOSE
    # Beside chosen terms, which are free there, a term is scored a little differently.
    return [
        (odds if len(terms) == 1 else log_odds(problem, terms), terms)
        for odds, terms in out.values()
        if len(terms) == 1 or odds > least
    ]


def log_odds(problem: SearchProblem, terms: Terms) -> float:
    """Return the log posterior odds of a law, its numbers as they are, against none."""
    if not terms:
        return 0.0
    terms = led(terms)
    evidence = sum(s.marginal for s in chained(problem, terms))
    return evidence - sum(t.price for t in terms) - LEAST * (len(terms) - 1)


def _structure(screen: Screen, kind: Hashable, terms: Terms, chance: float) -> Structure:
    linear = screen.linear
    form = refine(screen, form_of(screen, terms))
    x = form.columns(screen, linear.fit.solution.prediction.situation)
    score = linear.score(x)
    (held,) = linear.held_out([(linear.products([x])[0], score)])
    absorbed = linear.projection.solve(linear.rows.T @ x)
    return Structure(kind, form, chance, held.share, score.step, score.root, absorbed)


def pareto(of: Sequence[Structure]) -> tuple[Structure, ...]:
    """Return those that no other one beats in complexity and on poses left out, simplest first."""
    order = sorted(of, key=lambda s: (s.form.complexity, -s.holdout_share))
    out: list[Structure] = []
    for s in order:
        if not out or s.holdout_share > out[-1].holdout_share:
            out.append(s)
    return tuple(out)


def averaged(fit: Fit, of: Sequence[Structure], readings: Readings) -> tuple[Floats, Floats]:
    """Return the (D, m) mean of what likely laws add to a prediction of readings, and its std.

    The uncertainty is of the model's parameters, the laws' coefficients, and the choice of the law.
    """
    prediction = fit.model.predict(readings.states, fit.theta)
    w, s = whitening(readings, fit.mode), prediction.situation
    base = w.raw(fit.model.jacobian(prediction, fit.theta, w.m)) @ fit.solution.transform
    sites, motion = motions_of(fit.model, prediction, fit.theta, w.m)
    known = base @ fit.solution.projection().inverse_root.T
    chance = np.array([x.probability for x in of])
    mean, square = np.zeros(base.shape[:2]), np.sum(known**2, axis=-1)
    for x, p in zip(of, chance / chance.sum(), strict=True):
        own = w.raw(x.form.motion(sites, motion, s)) - base @ x.absorbed
        told = own @ x.step
        mean += p * told
        square += p * (told**2 + np.sum((own @ x.root) ** 2, axis=-1))
    return mean, np.sqrt(np.maximum(square - mean**2, 0.0))
