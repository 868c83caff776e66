"""The candidates beside a model and chosen terms, on all rows or some, and their odds.

A term is a site, or a few related ones, times one amplitude or two: a periodic function with free
phase, a factor with free zero, all axes of a site, all joints with a coefficient each. The short
list of the screening, extended to such terms, is scored as families are in the diagnosis. The log
odds of a term are its log evidence minus its price.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from hilcal.discovery.compose import composed_terms, grown
from hilcal.discovery.screen import (
    INDEPENDENT,
    LOG2,
    LawTerm,
    ScoredTerm,
    Screen,
    ScreenedTerm,
)
from hilcal.identification.linearisation import Linearisation
from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.regression.schur import Projection, projection
from hilcal.types import Bools, Floats, Ints

EXTENDED = 40  # Candidates that are extended to other axes and joints; a choice
LOG_ZERO = 2 * LOG2  # Price of a free zero of one of two factors, and of the choice of factor
LEAST_RIDGE = 1e-6  # For directions of the model that some rows do not determine; a choice


def _refitted(linear: Linearisation, rows: Bools) -> tuple[Projection, Floats]:
    """Return the model's projection in some rows (R,), and the residual of a fit to these."""
    ridge = np.maximum(linear.projection.ridge, LEAST_RIDGE)
    model = projection(linear.rows[rows], ridge)
    return model, model.residual(linear.fit.white[rows], linear.fit.solution.coordinates())


class SearchProblem:
    """The misfit in some of the rows, with the model refitted to these."""

    def __init__(self, screen: Screen, rows: Bools | None = None) -> None:
        """Refit the model to some of the rows (R,); by default to all."""
        linear = screen.linear
        self.screen = screen
        self.rows = np.ones(len(linear.residual), dtype=np.bool_) if rows is None else rows
        self.model: Projection = linear.projection
        self.residual = linear.residual
        if rows is not None:
            self.model, self.residual = _refitted(linear, rows)
        self.share = float(self.rows.mean())
        self.rss, self.dof = self.noise = linear.noise_of(self.residual, self.rows)
        self.square = self.share * screen.square
        self.across = self.share * screen.across
        self.across_one = self.share * screen.across_constant
        # of many readings, the screening uses only some of these rows
        self.screened = self.rows & screen.rows
        self.screened_share = float(self.screened.sum() / self.rows.sum())
        self._thin, self._thin_residual = self.model, self.residual
        if self.screened_share < 1.0:
            self._thin, self._thin_residual = _refitted(linear, self.screened)
        self._scored: dict[
            tuple[tuple[tuple[tuple[int, int], ...], bool], ...], list[ScoredTerm]
        ] = {}

    @cached_property
    def screening_residual(self) -> Floats:
        """The residual in the rows of the screening (R',)."""
        return self._in_screening(self._thin_residual)

    @cached_property
    def slope(self) -> Floats:
        """(S, F) xᵀ r in the rows that are screened."""
        return self.screen.inner(self.screening_residual)

    def _in_screening(self, v: Floats) -> Floats:
        """Expand values of this problem's screened rows to all rows of the screening (R',)."""
        expanded = np.zeros(len(self.rows))
        expanded[self.screened] = v
        return np.asarray(expanded[self.screen.rows], dtype=np.float32)

    def directions_of(self, x: Floats) -> tuple[list[Floats], Floats, list[Floats]]:
        """Orthonormal directions u of columns (R', P): (S, F) xᵀ u each, uᵀ r, and u."""
        directions = orthonormal(self._thin, x[self.screened[self.rows]])
        units = [self._in_screening(u) for u in directions.T]
        return [self.screen.inner(u) for u in units], directions.T @ self._thin_residual, units

    def columns(self, term: LawTerm) -> Floats:
        """(R', P) whitened columns of a term in the rows that are used."""
        return self.screen.columns_of(term)[self.rows]

    def scored(self, chosen: tuple[LawTerm, ...] = ()) -> list[ScoredTerm]:
        """Return the short list beside chosen terms, the best odds first; cached."""
        key = tuple((t.parts, t.common) for t in chosen)
        if key not in self._scored:
            candidates = CandidateTerms(self, chosen)
            scored = candidates.score(candidates.shortlist())
            self._scored[key] = sorted(scored, key=lambda c: -c.odds)
        return self._scored[key]


class CandidateTerms:
    """The candidates beside a model and chosen terms, whose coefficients are free."""

    def __init__(self, problem: SearchProblem, chosen: tuple[LawTerm, ...]) -> None:
        """Project the chosen terms out."""
        self.problem, self.chosen = problem, chosen
        self.rss, self.dof = problem.rss, problem.dof
        self.unit = np.zeros((len(problem.residual), 0))
        if not chosen:
            return
        self._x = np.hstack([problem.columns(t) for t in chosen])
        self.unit = orthonormal(problem.model, self._x)
        along = self.unit.T @ problem.residual
        self.rss = max(problem.rss - float(along @ along), 1e-12 * problem.rss)
        self.dof = max(problem.dof - self.unit.shape[1], 1.0)

    @cached_property
    def _directions(self) -> tuple[list[Floats], Floats, list[Floats]]:
        return self.problem.directions_of(self._x) if self.chosen else ([], np.zeros(0), [])

    def directions(self) -> Iterator[tuple[float, Floats]]:
        """Yield uᵀ r and u (R',) of the chosen terms' directions, in the rows of the screening."""
        _, along, units = self._directions
        yield from zip(along.tolist(), units, strict=True)

    def _screened(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Inner products of all candidates, projected off the chosen terms as well as the model.

        Four arrays (S, F), as in `Screen`: xᵀ r; xᵀ M x, zero where x depends on the chosen terms;
        xᵀ M x' with x' the partner; and xᵀ M x' with x' constant at the site.
        """
        p = self.problem
        slope, square, across, across_one = p.slope, p.square, p.across, p.across_one
        partner, one = p.screen.grammar.partner, p.screen.constant
        for products, along in zip(*self._directions[:2], strict=True):
            slope = slope - np.float32(along) * products
            square = square - products**2
            across = across - products * products[:, partner]
            across_one = across_one - products * products[:, [one]]
        if self.chosen:
            square = np.where(square > INDEPENDENT * p.square, square, np.float32(0.0))
        return slope, square, across, across_one

    @cached_property
    def _chosen_causes(self) -> tuple[frozenset[int], frozenset[str]]:
        screen = self.problem.screen
        parts = [part for t in self.chosen for part in t.parts]
        names = (n for _, f in parts for n in screen.grammar.amplitude(f).names)
        return frozenset(s for s, _ in parts), frozenset(names)

    @cached_property
    def _same_causes(self) -> tuple[Bools, Floats]:
        """(F,) amplitudes of chosen quantities alone; prices of such terms, by complexity."""
        screen, (places, names) = self.problem.screen, self._chosen_causes
        same = np.fromiter((d <= names for d in screen.grammar.depends), np.bool_)
        cost = screen.grammar.cost
        count = np.bincount(cost[same], minlength=int(cost.max()) + 1) * len(places)
        return same, np.log(np.maximum(count, 1)) + LOG2 * (np.arange(len(count)) + 1)

    def price(self, s: int, f: int) -> float:
        """Return the price of a candidate: lower for chosen sites and quantities."""
        full = self.problem.screen.price_of(f)
        if not self.chosen:
            return full
        a = self.problem.screen.grammar.amplitude(f)
        (places, names), (_, prices) = self._chosen_causes, self._same_causes
        if s in places and a.cost < len(prices) and {*a.names} <= names:
            return float(prices[a.cost])
        return full + LOG2

    def _prices(self, s: int) -> Floats:
        """(F,) prices of all candidates at a site."""
        price = self.problem.screen.price
        if not self.chosen:
            return price
        if s not in self._chosen_causes[0]:
            return np.asarray(price + LOG2)
        same, lower = self._same_causes
        return np.where(same, lower[self.problem.screen.grammar.cost], price + LOG2)

    def term(
        self, parts: tuple[tuple[int, int], ...], price: float = 0.0, common: bool = False
    ) -> LawTerm:
        """Return a term; `price` is added to that of its first part."""
        s, f = parts[0]
        return LawTerm(
            parts, self.price(s, f) + price, common, self.problem.screen.price_of(f) + price
        )

    def best(self) -> dict[str, list["ScreenedTerm"]]:
        """Return the candidates with the best odds, by their free numbers besides the coefficient.

        Keys: "" for none; "p" for the phase, by the partner; "c" for a constant at the site, "pc"
        for both; "1" and "2" for the zero of the first and second factor of a product.
        """
        p = self.problem
        slopes, squares, across, across_one = self._screened()
        amplitudes, one = p.screen.grammar, p.screen.constant
        partner = amplitudes.partner
        paired = np.flatnonzero(partner >= 0)
        products = np.flatnonzero((amplitudes.without_factor >= 0).all(axis=0))
        best: dict[str, list[ScreenedTerm]] = {k: [] for k in ("", "p", "c", "pc", "1", "2")}
        for s in range(len(p.screen.sites)):
            price = self._prices(s).astype(np.float32)
            a, g, h = squares[s], slopes[s], across[s]
            for constant in (False, True):
                suffix = ""
                visible = a > 0
                gain0 = 0.0
                if constant:
                    if not visible[one]:
                        break
                    suffix, c = "c", across_one[s]
                    gain0 = float(g[one] ** 2 / a[one])
                    h = h - c * (c[partner] / a[one])
                    g = g - c * (g[one] / a[one])
                    a = a - c * (c / a[one])
                    visible = visible & (a > INDEPENDENT * squares[s])
                safe = np.where(visible, a, 1.0)
                gain = np.where(visible, g * g / safe, 0.0)
                odds = self.evidence(gain + gain0, 1 + constant) - price - LOG2 * constant
                keep_largest(best[suffix], np.where(visible, odds, -np.inf), s)
                both = pair_gain(safe, g, h, visible, paired, partner)
                odds = self.evidence(both + gain0, 2 + constant)
                odds = odds - price[paired] - LOG2 * (1 + constant)
                keep_largest(best["p" + suffix], np.where(both > 0, odds, -np.inf), s, paired)
            a, g = squares[s], slopes[s]
            for key, less, h in zip(
                "12", amplitudes.without_factor, p.screen.across_without_factor[:, s], strict=True
            ):
                h = np.float32(p.share) * h
                for along in (product[s] for product in self._directions[0]):
                    h = h - along * along[less]
                both = pair_gain(np.where(a > 0, a, 1.0), g, h, a > 0, products, less)
                odds = self.evidence(both, 2) - price[products] - LOG_ZERO
                keep_largest(best[key], np.where(both > 0, odds, -np.inf), s, products)
        return best

    def evidence(self, gain: Floats, count: int) -> Floats:
        """Log evidence of columns at the best strength, by Laplace, to choose the short list."""
        share = np.clip(gain / np.float32(self.problem.screened_share * self.rss), 0.0, 0.99999)
        share = share.astype(np.float32)
        ratio = np.maximum(share * np.float32(self.dof / count), np.float32(1.0))
        return np.asarray(
            np.float32(-0.5 * self.dof) * np.log(1 - share)
            - np.float32(0.5 * count) * (np.log(ratio) + np.float32(1.0))
        )

    def score(self, terms: Sequence[LawTerm]) -> list[ScoredTerm]:
        """Score terms exactly beside the chosen ones."""
        p = self.problem
        out = []
        for start in range(0, len(terms), 64):
            batch = terms[start : start + 64]
            x = p.screen.columns([part for t in batch for part in t.parts])[p.rows]
            ends = np.cumsum([0] + [len(t.parts) for t in batch])
            for t, a, b in zip(batch, ends[:-1], ends[1:], strict=True):
                columns = x[:, a:b].sum(axis=1, keepdims=True) if t.common else x[:, a:b]
                out.append(ScoredTerm(t, self._score(columns)))
        return out

    def _score(self, x: Floats) -> FamilyScore:
        p = self.problem
        s, g = p.model.information(x), x.T @ p.residual
        if self.unit.shape[1]:
            projected = self.unit.T @ x
            s = s - projected.T @ projected
            g = g - projected.T @ (self.unit.T @ p.residual)
        return score_family(s, g, self.rss, self.dof)

    def shortlist(self) -> list[LawTerm]:
        """Return the candidates with the best odds, extended to phases, axes and joints."""
        best_of, one = self.best(), self.problem.screen.constant
        substituted = self.problem.screen.grammar.with_sine
        out: dict[tuple[tuple[tuple[int, int], ...], bool], LawTerm] = {}

        def add(t: LawTerm) -> None:
            out.setdefault((tuple(sorted(t.parts)), t.common), t)

        for x in best_of[""]:
            add(self.term(((x.s, x.f),)))
        for x in best_of["c"][:EXTENDED]:
            add(self.term(((x.s, x.f), (x.s, one)), LOG2))
        for key, extra in (("p", ()), ("pc", (one,))):
            for x in best_of[key][:EXTENDED]:
                partner = substituted(x.f)
                if partner is not None:
                    parts = ((x.s, x.f), (x.s, partner), *((x.s, k) for k in extra))
                    add(self.term(parts, LOG2 * (1 + len(extra))))
        for key, factor in (("1", 0), ("2", 1)):
            for x in best_of[key][:EXTENDED]:
                less = self.problem.screen.grammar.without_factor[:, x.f].tolist()
                add(self.term(((x.s, x.f), (x.s, less[factor])), LOG_ZERO))
                parts = tuple((x.s, k) for k in (x.f, *less) if self.problem.screen.visible(x.s, k))
                add(self.term(parts, LOG_ZERO + LOG2))
        firsts = best_of[""][:EXTENDED]
        for x in firsts:
            for t in self._extended(x.s, x.f):
                add(t)
        best = sorted(firsts + best_of["c"][:EXTENDED], key=lambda x: -x.odds)
        for t in (*grown(self, best), *composed_terms(self)):
            add(t)
        return list(out.values())

    def _extended(self, s: int, f: int) -> Iterator[LawTerm]:
        screen = self.problem.screen
        site, grammar = screen.sites[s], screen.grammar
        amplitude, place = grammar.amplitude(f), grammar.place

        def visible(parts: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
            return tuple(p for p in parts if screen.visible(*p))

        of_group = [k for k, o in enumerate(screen.sites) if o.group == site.group]
        parts = visible([(k, f) for k in of_group])
        if len(parts) > 1:
            yield self.term(parts, LOG2)
        for inner in grammar.inner(f):
            # The zero of one factor is free, e.g. that of a temperature.
            if screen.visible(s, inner):
                yield self.term(((s, f), (s, inner)), LOG_ZERO)
        if any(x.variable.vector for x in amplitude.factors):
            # A vector's components along all axes of the site.
            by_axis = []
            for k in of_group:
                substituted = amplitude.of_axis(
                    site.axis % 3, screen.sites[k].axis % 3, grammar.known
                )
                index = None if substituted is None else place(substituted)
                if index is not None:
                    by_axis.append((k, index))
            yield from self._separate_and_common(visible(by_axis))
        if site.joint < 0:
            return
        by_joint = []
        for k, o in enumerate(screen.sites):
            if (o.field, o.axis) != (site.field, site.axis) or o.joint < 0:
                continue
            substituted = amplitude.of_joint(site.joint, o.joint, grammar.known)
            index = None if substituted is None else place(substituted)
            if index is not None:
                by_joint.append((k, index))
        yield from self._separate_and_common(visible(by_joint))

    def _separate_and_common(self, parts: tuple[tuple[int, int], ...]) -> Iterator[LawTerm]:
        if len(parts) > 1:
            yield self.term(parts, LOG2)
            yield self.term(parts, LOG2, common=True)


SHORT_LIST = 200  # Candidates that are scored in full at each step; a choice
MOST_OF_SITE = 60  # Most of these of one site; a choice
SPANNED = 1e-9  # Directions of chosen columns below this share of the largest are rounding


def orthonormal(model: Projection, x: Floats) -> Floats:
    """(R, K) M X T of columns X (R, P) with Tᵀ Xᵀ M X T = 1; K is the rank of M X."""
    free = model.project_out(x)
    gram = x.T @ free
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    spanned = values > SPANNED * values[-1]
    return np.asarray(free @ (vectors[:, spanned] / np.sqrt(values[spanned])))


def pair_gain(
    square: Floats, slope: Floats, across: Floats, visible: Bools, which: Ints, partner: Ints
) -> Floats:
    """Return (H,) the gain of candidates `which` with their partners; 0 where both are dependent.

    The other arguments (F,) are of all candidates of one site: xᵀ M x, xᵀ r, xᵀ M x' with the
    partner x', whether x is independent of the model, and the index of the partner.
    """
    a, b, h = square[which], square[partner[which]], across[which]
    g, k = slope[which], slope[partner[which]]
    det = a * b - h * h
    ok = visible[which] & visible[partner[which]] & (det > 1e-3 * a * b)
    both = (b * g * g - 2 * h * g * k + a * k * k) / np.where(ok, det, 1.0)
    return np.where(ok, both, 0.0)


def keep_largest(best: list[ScreenedTerm], odds: Floats, s: int, which: Ints | None = None) -> None:
    """Add the best candidates of a site to `best`, best first."""
    least = best[-1].odds if len(best) == SHORT_LIST else -np.inf
    top = np.flatnonzero(odds > least)
    if len(top) > MOST_OF_SITE:
        top = top[np.argpartition(-odds[top], MOST_OF_SITE - 1)[:MOST_OF_SITE]]
    best += [
        ScreenedTerm(s, int(f if which is None else which[f]), float(x))
        for f, x in zip(top.tolist(), odds[top].tolist(), strict=True)
    ]
    best.sort(key=lambda x: -x.odds)
    del best[SHORT_LIST:]
