"""The candidates beside a model and chosen terms, on all rows or some, and their odds.

A term is a site, or a few that belong together, times one amplitude or two: a periodic function
with free phase, a factor with free zero, all axes of a site, all joints with a coefficient each.
All candidates are screened; the short list is scored as families are in the diagnosis, together
with the terms that extend it. The odds of a term are its evidence less what the search costs it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hilcal.discover.screen import Screen
from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.regression.projection import Projection, projection
from hilcal.types import Bools, Floats

SHORT_LIST = 200
"""Candidates that are scored in full at each step; a choice."""
EXTENDED = 40
"""Of these, those that are extended to other axes and joints; a choice."""


LEAST_RIDGE = 1e-6
"""Least ridge of the model's directions, not all of which some rows determine; a choice."""
SPANNED = 1e-9
"""Directions of chosen columns below this share of the largest are rounding."""


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
            ridge = np.maximum(linear.projection.ridge, LEAST_RIDGE)
            self.model = projection(linear.rows[used], ridge)
            z = linear.fit.solution.coordinates()
            self.residual = self.model.residual(linear.fit.white[used], z)
        self.rss = float(self.residual @ self.residual)
        lost = (1.0 - used.mean()) * len(used)
        self.dof = max(linear.fit.dof - lost, 1.0)
        share = float(used.mean())
        self._square = share * screen.square
        self._across = share * screen.across
        # The screening uses some of these rows only where readings are many.
        self.screened = used & screen.rows
        self.seen = float(self.screened.sum() / used.sum())
        self._thin, self._thin_residual = self.model, self.residual
        if self.seen < 1.0:
            ridge = np.maximum(linear.projection.ridge, LEAST_RIDGE)
            self._thin = projection(linear.rows[self.screened], ridge)
            z = linear.fit.solution.coordinates()
            self._thin_residual = self._thin.residual(linear.fit.white[self.screened], z)

    @cached_property
    def slope(self) -> Floats:
        """(S, F) xᵀ r in the rows that are screened."""
        return self._inner(self._thin_residual)

    def _inner(self, v: Floats) -> Floats:
        """(S, F) xᵀ v, v of the rows that are screened."""
        whole = np.zeros(len(self.rows))
        whole[self.screened] = v
        return self.screen.inner(whole)

    def shadows(self, x: Floats) -> tuple[list[Floats], Floats]:
        """What columns (R', P) of chosen terms take from all candidates in the screening.

        Returns:
            (S, F) xᵀ u of orthonormal directions u beside the model, and uᵀ r.
        """
        x = x[self.screened[self.rows]]
        u = orthonormal(self._thin, x)
        return [self._inner(d) for d in u.T], u.T @ self._thin_residual

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
        self.unit = orthonormal(p.model, x)
        along = self.unit.T @ p.residual
        self.rss = max(p.rss - float(along @ along), 1e-12 * p.rss)
        self.dof = max(p.dof - self.unit.shape[1], 1.0)
        shadows, told = p.shadows(x)
        partner = p.screen.grammar.partner
        for own, size in zip(shadows, told.tolist(), strict=True):
            self.slope = self.slope - size * own
            self._square = self._square - own**2
            self._across = self._across - own * own[:, partner]
        self._square = np.where(self._square > 1e-3 * p._square, self._square, 0.0)

    def odds(self) -> tuple[Floats, Floats]:
        """(S, F) logarithm of the odds of each candidate, and with its partner (free phase)."""
        price = self.problem.screen.price
        seen = self._square > 0
        square = np.where(seen, self._square, 1.0)
        gain = np.where(seen, self.slope**2 / square, 0.0) / self.problem.seen
        single = np.where(seen, _evidence(gain, 1, self.rss, self.dof) - price, -np.inf)
        partner = self.problem.screen.grammar.partner
        both = np.full_like(single, -np.inf)
        has = np.flatnonzero(partner >= 0)
        a, b, c = square[:, has], square[:, partner[has]], self._across[:, has]
        det = a * b - c**2
        ok = seen[:, has] & seen[:, partner[has]] & (det > 1e-3 * a * b)
        g, h = self.slope[:, has], self.slope[:, partner[has]]
        gain2 = (b * g**2 - 2 * c * g * h + a * h**2) / np.where(ok, det, 1.0)
        gain2 = gain2 / self.problem.seen
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


def orthonormal(model: Projection, x: Floats) -> Floats:
    """(R, K) M X T of columns X (R, P) with Tᵀ Xᵀ M X T = 1, without what X does not span."""
    free = model.project_out(x)
    gram = x.T @ free
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    kept = values > SPANNED * values[-1]
    return np.asarray(free @ (vectors[:, kept] / np.sqrt(values[kept])))


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
