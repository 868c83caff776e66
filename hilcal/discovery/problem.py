"""The candidates beside a model and chosen terms, on all rows or some, and their odds.

A term is a site, or a few that belong together, times one amplitude or two: a periodic function
with free phase, a factor with free zero, all axes of a site, all joints with a coefficient each.
All candidates are screened; the short list is scored as families are in the diagnosis, together
with the terms that extend it. The odds of a term are its evidence less what the search costs it.
"""

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from hilcal.discovery.compose import composed_terms, grown
from hilcal.discovery.screen import LawTerm, Scored, Screen, ScreenedTerm
from hilcal.identification.linearisation import Linearisation
from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.regression.projection import Projection, projection
from hilcal.types import Bools, Floats, Ints

EXTENDED = 40  # Of these, those that are extended to other axes and joints; a choice


LEFT = 1e-3  # share of a column's square that chosen terms must leave; a choice
LOG2 = float(np.log(2.0))
LOG_ZERO = 2 * LOG2  # Price of a free zero of one of two factors: for having one, and for which
LEAST_RIDGE = 1e-6  # of the model's directions, not all of which some rows determine; a choice


def _refitted(linear: Linearisation, rows: Bools) -> tuple[Projection, Floats]:
    """Return the model's projection in some rows (R,), and the residual of a fit to these."""
    ridge = np.maximum(linear.projection.ridge, LEAST_RIDGE)
    model = projection(linear.rows[rows], ridge)
    return model, model.residual(linear.fit.white[rows], linear.fit.solution.coordinates())


class SearchProblem:
    """The search on some of the rows."""

    def __init__(self, screen: Screen, rows: Bools | None = None) -> None:
        """Refit the model to some of the rows (R,); all by default."""
        linear = screen.linear
        self.screen = screen
        self.rows = np.ones(len(linear.residual), dtype=np.bool_) if rows is None else rows
        self.model: Projection = linear.projection
        self.residual = linear.residual
        if rows is not None:
            self.model, self.residual = _refitted(linear, rows)
        self.rss = float(self.residual @ self.residual)
        self.share = float(self.rows.mean())
        self.dof = max(linear.fit.dof - (1.0 - self.share) * len(self.rows), 1.0)
        self.square = self.share * screen.square
        self.across = self.share * screen.across
        self.across_one = self.share * screen.across_one
        # The screening uses some of these rows only where readings are many.
        self.screened = self.rows & screen.rows
        self.seen = float(self.screened.sum() / self.rows.sum())
        self._thin, self._thin_residual = self.model, self.residual
        if self.seen < 1.0:
            self._thin, self._thin_residual = _refitted(linear, self.screened)
        self._scored: dict[tuple[tuple[tuple[tuple[int, int], ...], bool], ...], list[Scored]] = {}

    @cached_property
    def thin(self) -> Floats:
        """The residual in the rows of the screening (R',)."""
        return self._thinned(self._thin_residual)

    @cached_property
    def slope(self) -> Floats:
        """(S, F) xᵀ r in the rows that are screened."""
        return self.screen.inner(self.thin)

    def _thinned(self, v: Floats) -> Floats:
        """Rows of the screening (R',) of those of this problem that are screened."""
        whole = np.zeros(len(self.rows))
        whole[self.screened] = v
        return np.asarray(whole[self.screen.rows], dtype=np.float32)

    def shadows(self, x: Floats) -> tuple[list[Floats], Floats, list[Floats]]:
        """What columns (R', P) of chosen terms take: (S, F) xᵀ u of directions u, uᵀ r, and u."""
        directions = orthonormal(self._thin, x[self.screened[self.rows]])
        units = [self._thinned(u) for u in directions.T]
        return [self.screen.inner(u) for u in units], directions.T @ self._thin_residual, units

    def columns(self, term: LawTerm) -> Floats:
        """(R', P) whitened columns of a term in the rows that are used."""
        return self.screen.columns_of(term)[self.rows]

    def beside(self, chosen: Sequence[LawTerm]) -> "Beside":
        """Return the candidates beside chosen terms."""
        return Beside(self, tuple(chosen))

    def scored(self, chosen: tuple[LawTerm, ...] = ()) -> list[Scored]:
        """Return the short list beside chosen terms, the best odds first; kept once it is made."""
        key = tuple((t.parts, t.common) for t in chosen)
        if key not in self._scored:
            beside = self.beside(chosen)
            self._scored[key] = sorted(beside.score(beside.shortlist()), key=lambda c: -c.odds)
        return self._scored[key]


class Beside:
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
    def _shadows(self) -> tuple[list[Floats], Floats, list[Floats]]:
        return self.problem.shadows(self._x) if self.chosen else ([], np.zeros(0), [])

    def taken(self) -> Iterator[tuple[float, Floats]]:
        """Yield uᵀ r and u (R',), in the rows of the screening, of what chosen terms take."""
        _, told, units = self._shadows
        yield from zip(told.tolist(), units, strict=True)

    def _screened(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Products of all candidates beside the model and the chosen terms, as in `Screen`.

        (S, F) each: xᵀ r; xᵀ M x, zero where little of a column is left; xᵀ M x' with the partner,
        and with a constant at the site.
        """
        p = self.problem
        slope, square, across, across_one = p.slope, p.square, p.across, p.across_one
        partner, one = p.screen.grammar.partner, p.screen.one
        for own, size in zip(*self._shadows[:2], strict=True):
            slope = slope - np.float32(size) * own
            square = square - own**2
            across = across - own * own[:, partner]
            across_one = across_one - own * own[:, [one]]
        if self.chosen:
            square = np.where(square > LEFT * p.square, square, np.float32(0.0))
        return slope, square, across, across_one

    @cached_property
    def _known(self) -> tuple[frozenset[int], frozenset[str]]:
        screen = self.problem.screen
        parts = [part for t in self.chosen for part in t.parts]
        names = (n for _, f in parts for n in screen.grammar.at(f).names)
        return frozenset(s for s, _ in parts), frozenset(names)

    @cached_property
    def _again(self) -> tuple[Bools, Floats]:
        """(F,) which amplitudes depend on no further quantity; price of such a term by its cost."""
        screen, (places, names) = self.problem.screen, self._known
        same = np.fromiter((d <= names for d in screen.grammar.depends), np.bool_)
        cost = screen.grammar.cost
        count = np.bincount(cost[same], minlength=int(cost.max()) + 1) * len(places)
        return same, np.log(np.maximum(count, 1)) + LOG2 * (np.arange(len(count)) + 1)

    def price(self, s: int, f: int) -> float:
        """Return the price of a candidate: less where it is of the chosen sites and quantities."""
        full = self.problem.screen.price_of(f)
        if not self.chosen:
            return full
        a = self.problem.screen.grammar.at(f)
        if s in self._known[0] and a.cost < len(self._again[1]) and {*a.names} <= self._known[1]:
            return float(self._again[1][a.cost])
        return full + LOG2

    def _prices(self, s: int) -> Floats:
        """(F,) the same of all candidates at a site."""
        price = self.problem.screen.price
        if not self.chosen:
            return price
        if s not in self._known[0]:
            return np.asarray(price + LOG2)
        same, again = self._again
        return np.where(same, again[self.problem.screen.grammar.cost], price + LOG2)

    def term(
        self, parts: tuple[tuple[int, int], ...], price: float = 0.0, common: bool = False
    ) -> LawTerm:
        """Return a term by its first part's price and what else it costs."""
        s, f = parts[0]
        return LawTerm(
            parts, self.price(s, f) + price, common, self.problem.screen.price_of(f) + price
        )

    def best(self) -> dict[str, list["ScreenedTerm"]]:
        """Return the candidates with the best odds, by what is free beside the coefficient.

        Keys: "" for nothing; "p" for the phase: with the partner; "c" for a constant at the site,
        and "pc" for both; "1" and "2" for the zero of the first and of the second factor of a
        product.
        """
        p = self.problem
        slopes, squares, across, across_one = self._screened()
        words, one = p.screen.grammar, p.screen.one
        partner = words.partner
        has = np.flatnonzero(partner >= 0)
        products = np.flatnonzero((words.less >= 0).all(axis=0))
        found: dict[str, list[ScreenedTerm]] = {k: [] for k in ("", "p", "c", "pc", "1", "2")}
        for s in range(len(p.screen.sites)):
            price = self._prices(s).astype(np.float32)
            a, g, h = squares[s], slopes[s], across[s]
            for constant in (False, True):
                own = ""
                seen = a > 0
                gain0 = 0.0
                if constant:
                    if not seen[one]:
                        break
                    own, c = "c", across_one[s]
                    gain0 = float(g[one] ** 2 / a[one])
                    h = h - c * (c[partner] / a[one])
                    g = g - c * (g[one] / a[one])
                    a = a - c * (c / a[one])
                    seen = seen & (a > LEFT * squares[s])
                safe = np.where(seen, a, 1.0)
                gain = np.where(seen, g * g / safe, 0.0)
                odds = self.evidence(gain + gain0, 1 + constant) - price - LOG2 * constant
                keep_largest(found[own], np.where(seen, odds, -np.inf), s)
                both = together(safe, g, h, seen, has, partner)
                odds = self.evidence(both + gain0, 2 + constant)
                odds = odds - price[has] - LOG2 * (1 + constant)
                keep_largest(found["p" + own], np.where(both > 0, odds, -np.inf), s, has)
            a, g = squares[s], slopes[s]
            for key, less, h in zip("12", words.less, p.screen.across_less[:, s], strict=True):
                h = np.float32(p.share) * h
                for told in (shadow[s] for shadow in self._shadows[0]):
                    h = h - told * told[less]
                both = together(np.where(a > 0, a, 1.0), g, h, a > 0, products, less)
                odds = self.evidence(both, 2) - price[products] - LOG_ZERO
                keep_largest(found[key], np.where(both > 0, odds, -np.inf), s, products)
        return found

    def evidence(self, gain: Floats, count: int) -> Floats:
        """Log evidence of columns at the best strength, by Laplace: for the short list only."""
        share = np.clip(gain / np.float32(self.problem.seen * self.rss), 0.0, 0.99999)
        share = share.astype(np.float32)
        per = np.maximum(share * np.float32(self.dof / count), np.float32(1.0))
        return np.asarray(
            np.float32(-0.5 * self.dof) * np.log(1 - share)
            - np.float32(0.5 * count) * (np.log(per) + np.float32(1.0))
        )

    def score(self, terms: Sequence[LawTerm]) -> list[Scored]:
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

    def shortlist(self) -> list[LawTerm]:
        """Return the candidates with the best odds, extended to phases, axes and joints."""
        found, one = self.best(), self.problem.screen.one
        turned = self.problem.screen.grammar.turned
        out: dict[tuple[tuple[tuple[int, int], ...], bool], LawTerm] = {}

        def add(t: LawTerm) -> None:
            out.setdefault((tuple(sorted(t.parts)), t.common), t)

        for x in found[""]:
            add(self.term(((x.s, x.f),)))
        for x in found["c"][:EXTENDED]:
            add(self.term(((x.s, x.f), (x.s, one)), LOG2))
        for key, more in (("p", ()), ("pc", (one,))):
            for x in found[key][:EXTENDED]:
                other = turned(x.f)
                if other is not None:
                    parts = ((x.s, x.f), (x.s, other), *((x.s, k) for k in more))
                    add(self.term(parts, LOG2 * (1 + len(more))))
        for key, without in (("1", 0), ("2", 1)):
            for x in found[key][:EXTENDED]:
                less = self.problem.screen.grammar.less[:, x.f].tolist()
                add(self.term(((x.s, x.f), (x.s, less[without])), LOG_ZERO))
                parts = tuple((x.s, k) for k in (x.f, *less) if self.problem.screen.visible(x.s, k))
                add(self.term(parts, LOG_ZERO + LOG2))
        firsts = found[""][:EXTENDED]
        for x in firsts:
            for t in self._extended(x.s, x.f):
                add(t)
        best = sorted(firsts + found["c"][:EXTENDED], key=lambda x: -x.odds)
        for t in (*grown(self, best), *composed_terms(self)):
            add(t)
        return list(out.values())

    def _extended(self, s: int, f: int) -> Iterator[LawTerm]:
        screen = self.problem.screen
        site, grammar = screen.sites[s], screen.grammar
        amplitude, place = grammar.at(f), grammar.place

        def visible(parts: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
            return tuple(p for p in parts if screen.visible(*p))

        same = [k for k, o in enumerate(screen.sites) if o.group == site.group]
        parts = visible([(k, f) for k in same])
        if len(parts) > 1:
            yield self.term(parts, LOG2)
        for inner in grammar.inner(f):
            # The zero of one factor is free, as that of a temperature.
            if screen.visible(s, inner):
                yield self.term(((s, f), (s, inner)), LOG_ZERO)
        if any(x.variable.vector for x in amplitude.factors):
            # A vector's components along all axes of the site.
            by_axis = []
            for k in same:
                other = amplitude.of_axis(site.axis % 3, screen.sites[k].axis % 3, grammar.known)
                at = None if other is None else place(other)
                if at is not None:
                    by_axis.append((k, at))
            yield from self._apart_and_common(visible(by_axis))
        if site.joint < 0:
            return
        by_joint = []
        for k, o in enumerate(screen.sites):
            if (o.field, o.axis) != (site.field, site.axis) or o.joint < 0:
                continue
            other = amplitude.of_joint(site.joint, o.joint, grammar.known)
            at = None if other is None else place(other)
            if at is not None:
                by_joint.append((k, at))
        yield from self._apart_and_common(visible(by_joint))

    def _apart_and_common(self, parts: tuple[tuple[int, int], ...]) -> Iterator[LawTerm]:
        if len(parts) > 1:
            yield self.term(parts, LOG2)
            yield self.term(parts, LOG2, common=True)


SHORT_LIST = 200  # Candidates that are scored in full at each step; a choice
OF_SITE = 60  # Of each site at most; a choice
SPANNED = 1e-9  # Directions of chosen columns below this share of the largest are rounding


def orthonormal(model: Projection, x: Floats) -> Floats:
    """(R, K) M X T of columns X (R, P) with Tᵀ Xᵀ M X T = 1, without what X does not span."""
    free = model.project_out(x)
    gram = x.T @ free
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    kept = values > SPANNED * values[-1]
    return np.asarray(free @ (vectors[:, kept] / np.sqrt(values[kept])))


def together(
    square: Floats, slope: Floats, across: Floats, seen: Bools, which: Ints, other: Ints
) -> Floats:
    """(H,) gain of candidates at a site with another column each; zero where they are alike.

    Of all at the site: (F,) xᵀ M x, xᵀ r, xᵀ M x', whether the model leaves something; (H,) which,
    and (F,) the other of each.
    """
    a, b, h = square[which], square[other[which]], across[which]
    g, k = slope[which], slope[other[which]]
    det = a * b - h * h
    ok = seen[which] & seen[other[which]] & (det > 1e-3 * a * b)
    both = (b * g * g - 2 * h * g * k + a * k * k) / np.where(ok, det, 1.0)
    return np.where(ok, both, 0.0)


def keep_largest(
    found: list[ScreenedTerm], odds: Floats, s: int, which: Ints | None = None
) -> None:
    """Add the best candidates of a site to those of others, best first."""
    least = found[-1].odds if len(found) == SHORT_LIST else -np.inf
    top = np.flatnonzero(odds > least)
    if len(top) > OF_SITE:
        top = top[np.argpartition(-odds[top], OF_SITE - 1)[:OF_SITE]]
    found += [
        ScreenedTerm(s, int(f if which is None else which[f]), float(x))
        for f, x in zip(top.tolist(), odds[top].tolist(), strict=True)
    ]
    found.sort(key=lambda x: -x.odds)
    del found[SHORT_LIST:]
