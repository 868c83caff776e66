"""Forward selection of laws with backward pruning, the size of the search paid for.

A term is a site, or a few that belong together, times one amplitude or two: a periodic function
with free phase, all axes of a site, all joints with a coefficient each. At each step all candidates
are screened beside the terms that are chosen; the short list is scored as families are in the
diagnosis, together with the terms that extend it. The evidence of a term less what the search
costs it decides; it is the logarithm of the odds of the term against none, before the data a
candidate of a complexity being as likely as each other.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from hilcal.discover.screen import Screen
from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.regression.forward_selection import families_beside
from hilcal.regression.projection import Projection, projection
from hilcal.types import Bools, Floats

SHORT_LIST = 200
"""Candidates that are scored in full at each step; a choice."""
EXTENDED = 40
"""Of these, those that are extended to other axes and joints; a choice."""
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


@dataclass(frozen=True, slots=True)
class Term:
    """Columns of a law that are chosen together.

    Attributes:
        parts: (site, amplitude) of each column, by index.
        price: what the search costs it.
        common: whether all columns have one coefficient.
    """

    parts: tuple[tuple[int, int], ...]
    price: float
    common: bool = False

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return 1 if self.common else len(self.parts)


@dataclass(frozen=True, eq=False)
class Scored:
    """A term beside others.

    Attributes:
        term: the term.
        score: its score as a family.
    """

    term: Term
    score: FamilyScore

    @property
    def odds(self) -> float:
        """Evidence less what the search costs."""
        return self.score.log_evidence - self.term.price


@dataclass(frozen=True, eq=False)
class Selection:
    """Terms that were chosen, and the odds that each added."""

    terms: tuple[Term, ...]
    odds: tuple[float, ...]
    near: tuple[Scored, ...] = ()
    p_value: float = 1.0

    @property
    def total(self) -> float:
        """Logarithm of the odds of the whole law against none."""
        return sum(self.odds)


class Problem:
    """The search on some of the rows."""

    def __init__(self, screen: Screen, rows: Bools | None = None) -> None:
        """Refit the model to the rows.

        Args:
            screen: all candidates.
            rows: (R,) those that are used; all by default.
        """
        linear = screen.linear
        self.screen = screen
        every = np.ones(len(linear.residual), dtype=np.bool_)
        self.rows = every if rows is None else rows
        used = self.rows
        if rows is None:
            self.model: Projection = linear.projection
            self.residual = linear.residual
        else:
            ridge = np.maximum(linear.projection.ridge, 1e-6)
            self.model = projection(linear.rows[used], ridge)
            z = linear.fit.solution.coordinates()
            self.residual = self.model.residual(linear.fit.white[used], z)
        self.rss = float(self.residual @ self.residual)
        lost = (1.0 - used.mean()) * len(used)
        self.dof = max(linear.fit.dof - lost, 1.0)
        self.share = float(used.mean())
        self._square = self.share * screen.square
        self._across = self.share * screen.across

    def full(self, v: Floats) -> Floats:
        """(R,) rows that are used, zero in the others."""
        out = np.zeros(len(self.rows))
        out[self.rows] = v
        return out

    @cached_property
    def slope(self) -> Floats:
        """(S, F) xᵀ r."""
        return self.screen.inner(self.full(self.residual))

    def columns(self, term: Term) -> Floats:
        """(R', P) whitened columns of a term in the rows that are used."""
        x = self.screen.columns(list(term.parts))[self.rows]
        return x.sum(axis=1, keepdims=True) if term.common else x

    def beside(self, chosen: Sequence[Term]) -> "Beside":
        """Return the candidates beside chosen terms."""
        return Beside(self, tuple(chosen))


class Beside:
    """The candidates beside a model and chosen terms, whose coefficients are free."""

    def __init__(self, problem: Problem, chosen: tuple[Term, ...]) -> None:
        """Project the chosen terms out."""
        self.problem, self.chosen = problem, chosen
        p = problem
        self.rss, self.dof, self.slope = p.rss, p.dof, p.slope
        self._square, self._across = p._square, p._across
        self.unit = np.zeros((len(p.residual), 0))
        if not chosen:
            return
        x = np.hstack([p.columns(t) for t in chosen])
        free = p.model.project_out(x)
        gram = x.T @ free
        values, vectors = np.linalg.eigh((gram + gram.T) / 2)
        kept = values > 1e-9 * values[-1]
        turn = vectors[:, kept] / np.sqrt(values[kept])
        self.turn, self.x = turn, x
        self.unit = free @ turn  # M X T with Tᵀ Xᵀ M X T = 1
        along = (x @ turn).T @ p.residual
        self.rss = max(p.rss - float(along @ along), 1e-12 * p.rss)
        self.dof = max(p.dof - int(kept.sum()), 1.0)
        shadows = [p.screen.inner(p.full(u)) for u in self.unit.T]
        self.slope = p.slope - sum(float(a) * s for a, s in zip(along, shadows, strict=True))
        self._square = p._square - sum(s**2 for s in shadows)
        partner = p.screen.grammar.partner
        self._across = p._across - sum(s * s[:, partner] for s in shadows)
        self._square = np.where(self._square > 1e-3 * p._square, self._square, 0.0)

    def odds(self) -> tuple[Floats, Floats]:
        """(S, F) logarithm of the odds of each candidate, and with its partner (free phase)."""
        price = self.problem.screen.price
        seen = self._square > 0
        square = np.where(seen, self._square, 1.0)
        gain = np.where(seen, self.slope**2 / square, 0.0)
        single = np.where(seen, _evidence(gain, 1, self.rss, self.dof) - price, -np.inf)
        partner = self.problem.screen.grammar.partner
        both = np.full_like(single, -np.inf)
        has = np.flatnonzero(partner >= 0)
        a, b, c = square[:, has], square[:, partner[has]], self._across[:, has]
        det = a * b - c**2
        ok = seen[:, has] & seen[:, partner[has]] & (det > 1e-3 * a * b)
        g, h = self.slope[:, has], self.slope[:, partner[has]]
        gain2 = (b * g**2 - 2 * c * g * h + a * h**2) / np.where(ok, det, 1.0)
        both[:, has] = np.where(
            ok, _evidence(gain2, 2, self.rss, self.dof) - price[has] - np.log(2.0), -np.inf
        )
        return single, both

    def score(self, terms: Sequence[Term]) -> list[Scored]:
        """Score terms exactly beside the chosen ones."""
        p = self.problem
        out = []
        for start in range(0, len(terms), 64):
            some = terms[start : start + 64]
            flat = [part for t in some for part in t.parts]
            x = p.screen.columns(flat)[p.rows]
            ends = np.cumsum([0] + [len(t.parts) for t in some])
            columns = [
                x[:, a:b].sum(axis=1, keepdims=True) if t.common else x[:, a:b]
                for t, a, b in zip(some, ends[:-1], ends[1:], strict=True)
            ]
            for t, own in zip(some, columns, strict=True):
                out.append(Scored(t, self._score(own)))
        return out

    def _score(self, x: Floats) -> FamilyScore:
        p = self.problem
        s, g = p.model.information(x), x.T @ p.residual
        if self.unit.shape[1]:
            along = self.unit.T @ x
            s = s - along.T @ along
            g = g - along.T @ (self.unit.T @ p.residual)
        return score_family(s, g, self.rss, self.dof)

    def shortlist(self) -> list[Term]:
        """Return the candidates with the best odds, extended to phases, axes and joints."""
        single, both = self.odds()
        price = self.problem.screen.price
        out: dict[tuple[tuple[int, int], ...], Term] = {}
        best = _largest(single, SHORT_LIST)
        for s, f in best:
            out[((s, f),)] = Term(((s, f),), float(price[f]))
        partner = self.problem.screen.grammar.partner
        pairs = _largest(both, EXTENDED)
        for s, f in pairs:
            parts = ((s, f), (s, int(partner[f])))
            out[parts] = Term(parts, float(price[f]) + np.log(2.0))
        for s, f in best[:EXTENDED]:
            for t in self._extended(s, f):
                out.setdefault((*t.parts, (-1, int(t.common))), t)
        return list(out.values())

    def _extended(self, s: int, f: int) -> Iterator[Term]:
        screen = self.problem.screen
        site, price = screen.sites[s], float(screen.price[f]) + np.log(2.0)
        same = [
            k for k, o in enumerate(screen.sites) if o.group == site.group and screen.square[k, f]
        ]
        if len(same) > 1:
            yield Term(tuple((k, f) for k in same), price)
        for inner in screen.grammar.inner(f):
            # The zero of one factor is free, as that of a temperature.
            if screen.square[s, inner]:
                yield Term(((s, f), (s, inner)), price)
        if site.joint < 0:
            return
        amplitude, place = screen.grammar.amplitudes[f], screen.grammar.place
        parts = []
        for k, o in enumerate(screen.sites):
            if (o.field, o.axis) != (site.field, site.axis) or o.joint < 0:
                continue
            other = amplitude.of_joint(site.joint, o.joint, screen.grammar.known)
            at = None if other is None else place(other)
            if at is not None and screen.square[k, at] > 0:
                parts.append((k, at))
        if len(parts) > 1:
            yield Term(tuple(parts), price)
            yield Term(tuple(parts), price, common=True)


def _evidence(gain: Floats, count: int, rss: float, dof: float) -> Floats:
    """Log evidence of columns at the best strength, by Laplace: for the short list only."""
    gain = np.clip(gain, 0.0, 0.999999 * rss)
    per = np.maximum(gain * dof / rss / count, 1.0)
    return np.asarray(-0.5 * dof * np.log1p(-gain / rss) - 0.5 * count * (np.log(per) + 1.0))


def _largest(x: Floats, count: int) -> list[tuple[int, int]]:
    flat = x.ravel()
    count = min(count, int(np.count_nonzero(np.isfinite(flat))))
    if not count:
        return []
    top = np.argpartition(-flat, count - 1)[:count]
    top = top[np.argsort(-flat[top], kind="stable")]
    return [tuple(map(int, np.unravel_index(k, x.shape))) for k in top]  # type: ignore[misc]


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
        s = Selection((start.term,), (start.odds,), near, start.score.p_value)
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
    """Coefficients, complexity, and rank of sites and functions, smaller is simpler."""
    amplitudes = [screen.grammar.amplitudes[a] for _, a in t.parts]
    cost = max(a.cost for a in amplitudes)
    sites = max(screen.sites[s].rank for s, _ in t.parts)
    functions = max(sum(f.shape.rank for f in a.factors) for a in amplitudes)
    return t.count, cost, sites, functions


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
