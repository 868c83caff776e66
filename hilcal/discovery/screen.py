"""All candidates at once: every site times every amplitude, whitened and projected off the model.

The column of site s and amplitude a is linear in a: x = T_s a with T_s (R, N) the whitened motion
of each reading by an ordinary motion of the site. So for all amplitudes A (F, N) of a site

    xᵀ v  = A (T_sᵀ v),        xᵀ M x = diag(A Q_s Aᵀ),    Q_s = T_sᵀ M T_s (N, N)

and no column is formed: a million candidates take seconds. Of many readings, those of some poses
are used; the short list is scored on all readings.

A function of two quantities that bends at a level, as of a hose that is taut beyond a length that
depends on two joints, is not a product of functions of each. So products φ of two quantities are
also arguments: max(φ − φ0, 0), max(φ0 − φ, 0) and tanh((φ − φ0)/w), at some levels φ0.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, variables
from hilcal.discovery.grammar import Grammar, grammar
from hilcal.discovery.shapes import Shape
from hilcal.discovery.sites import Site, site_motions
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import Linearisation
from hilcal.regression.evidence import FamilyScore
from hilcal.regression.schur import projection
from hilcal.types import Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class LawTerm:
    """Columns of a law that are chosen together."""

    parts: tuple[tuple[int, int], ...]  # (site, amplitude) of each column, by index
    price: float  # for the size of the search
    common: bool = False  # whether all columns have one coefficient
    price_alone: float = 0.0  # price as the first term

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return 1 if self.common else len(self.parts)


@dataclass(frozen=True, eq=False)
class ScoredTerm:
    """A term with its score beside chosen terms."""

    term: LawTerm
    score: FamilyScore

    @property
    def odds(self) -> float:
        """Log evidence minus the price."""
        return self.score.log_evidence - self.term.price


@dataclass(frozen=True, slots=True)
class ScreenedTerm:
    """A candidate of the screening: site, amplitude, and its odds."""

    s: int
    f: int
    odds: float


MOST_READINGS = 400  # Most readings of the screening; a choice: time grows with their square
VISIBLE = 1e-4  # Least share of a column's square beside the model, for single precision
ALIAS_COSINE = 1 - 1e-9  # Least cosine of the motions of equivalent sites; rounding
LEAST_MOTION = 1e-4  # Square of a whitened column below which it counts as zero
INDEPENDENT = 1e-3  # Least share of a column's square beside other columns; a choice
LOG2 = float(np.log(2.0))


@dataclass(frozen=True, slots=True, eq=False)
class Bends:
    """Functions of composed quantities, and their sums of squares."""

    argument: Ints  # (C,) index of the product in the grammar
    shape: tuple[Shape, ...]  # function of each
    numbers: tuple[tuple[float, ...], ...]
    values: Floats  # (C, K) at the readings of the screening, scaled to root mean square 1
    square: Floats  # (S, C) xᵀ M x; zero where a site does not allow the function
    across_constant: Floats  # (S, C) xᵀ M x' with a constant at the site


@dataclass(frozen=True, eq=False)
class Screen:
    """All candidates beside a model."""

    linear: Linearisation  # of the fit
    grammar: Grammar  # amplitudes
    sites: tuple[Site, ...]
    motion: Floats  # (N, m, S) motion of each reading by an ordinary motion of each site
    rows: Bools  # (R,) whitened rows that the screening uses
    readings: Ints  # (K,) indices of the fitted readings that it uses
    form: Floats  # (S, R', K) T_s of these rows and readings, single precision
    free: Floats  # (S, K, K) Q_s of these
    square: Floats  # (S, F) xᵀ M x; zero where the model explains a column
    across: Floats  # (S, F) xᵀ M x' with the partner of each amplitude
    across_constant: Floats  # (S, F) xᵀ M x' with a constant at the site
    across_without_factor: Floats  # (2, S, F) xᵀ M x' of a product with that without either factor

    @cached_property
    def price(self) -> Floats:
        """(F,) prices of the candidates, see `grammar`."""
        return self.grammar.price(len(self.sites))

    @cached_property
    def alias(self) -> tuple[int, ...]:
        """(S,) index of the simplest site that moves all readings the same way, up to a factor."""
        flat = self.motion.reshape(-1, len(self.sites))
        size = np.linalg.norm(flat, axis=0)
        unit = flat / np.where(size > 0, size, 1.0)
        alike = np.abs(unit.T @ unit) > ALIAS_COSINE
        takes = [(s.takes(False), s.takes(True), s.takes(False, True)) for s in self.sites]
        out = []
        for k in range(len(self.sites)):
            equivalent = [o for o in np.flatnonzero(alike[k]).tolist() if takes[o] == takes[k]]
            out.append(min([k, *equivalent], key=lambda o: (self.sites[o].rank, o)))
        return tuple(out)

    @cached_property
    def constant(self) -> int:
        """Index of the constant amplitude."""
        return self.grammar.amplitudes.index(Amplitude(()))

    def visible(self, site: int, amplitude: int) -> bool:
        """Whether a candidate is visible beside the model; True for added ones, unchecked."""
        return amplitude >= len(self.price) or bool(self.square[site, amplitude] > 0)

    def price_of(self, amplitude: int) -> float:
        """Return the price of a candidate, also of one that was added later."""
        if amplitude < len(self.price):
            return float(self.price[amplitude])
        return self.grammar.price_of(self.grammar.amplitude(amplitude), len(self.sites))

    @cached_property
    def bends(self) -> Bends:
        """Bends and steps of composed quantities."""
        grammar = self.grammar
        arguments = grammar.smooth[:MOST_ARGUMENTS].tolist()
        argument, functions, numbers, rows = [], [], [], []
        for k in arguments:
            u = grammar.values[k][self.readings].astype(float) * grammar.size[k]
            for shape, starts in _starts(u):
                parameters: list[Any] = [n[:, None] for n in starts]
                argument += [k] * len(starts[0])
                functions += [shape] * len(starts[0])
                numbers += list(zip(*(n.tolist() for n in starts), strict=True))
                rows.append(unit_rows(shape.value(u, tuple(parameters))))
        values: Floats = np.vstack([np.zeros((0, len(self.readings)), dtype=np.float32), *rows])
        elastic = np.array([grammar.amplitude(k).elastic for k in arguments], dtype=np.bool_)
        bent = np.repeat(elastic, len(values) // max(len(arguments), 1))
        square: Floats = np.empty((len(self.sites), len(values)), dtype=np.float32)
        across: Floats = np.empty_like(square)
        squares = values**2
        for s, site in enumerate(self.sites):
            lifted = values @ self.free[s]
            across[s] = lifted.sum(axis=1)
            square[s] = np.einsum("ck,ck->c", lifted, values)
            moved = squares @ np.sum(self.form[s] ** 2, axis=0)
            square[s, square[s] < VISIBLE * moved + LEAST_MOTION] = 0.0
            for kind in (False, True):
                if not site.takes(kind):
                    square[s, bent == kind] = 0.0
        index = np.array(argument, dtype=np.int_)
        return Bends(index, tuple(functions), tuple(numbers), values, square, across)

    @cached_property
    def values(self) -> Floats:
        """(K, F) amplitudes at the readings of the screening."""
        return np.ascontiguousarray(self.grammar.values[:, self.readings].T)

    @property
    def candidates(self) -> int:
        """Number of candidates that the model does not explain."""
        return int(np.count_nonzero(self.square))

    def inner(self, v: Floats) -> Floats:
        """(S, F) xᵀ v of all candidates, with v (R',) in the rows of the screening."""
        by_reading = np.einsum("srn,r->sn", self.form, v)
        return np.asarray(by_reading @ self.values)

    def columns(self, which: list[tuple[int, int]]) -> Floats:
        """(R, P) whitened columns of candidates (site, amplitude)."""
        if not which:
            return np.zeros((len(self.linear.residual), 0))
        w = self.linear.fit.whitening
        site, amplitude = np.array(which).T
        raw = self.motion[:, :, site] * self.grammar.rows(amplitude.tolist()).T[:, None, :]
        return w.whiten_readings(raw)

    def columns_of(self, term: LawTerm) -> Floats:
        """(R, P) whitened columns of a term."""
        x = self.columns(list(term.parts))
        return x.sum(axis=1, keepdims=True) if term.common else x


def screen(linear: Linearisation) -> Screen:
    """Prepare the search beside a fit."""
    fit = linear.fit
    situation = fit.solution.prediction.situation
    poses = len(np.unique(fit.pose))
    products = grammar(variables(situation), situation, poses)
    return screened(linear, products, *site_motions(fit), *_thinned(fit))


def screened(
    linear: Linearisation, products: Grammar, places: tuple[Site, ...], motion: Floats, rows: Bools,
    readings: Ints,
) -> Screen:  # fmt: skip
    """Return all candidates of some amplitudes and sites."""
    w = linear.fit.whitening
    model = projection(linear.rows[rows], linear.projection.ridge)
    form: Floats = np.empty((len(places), int(rows.sum()), len(readings)), dtype=np.float32)
    square: Floats = np.empty((len(places), len(products.size)), dtype=np.float32)
    across: Floats = np.zeros_like(square)
    across_one: Floats = np.zeros_like(square)
    across_less: Floats = np.zeros((2, *square.shape), dtype=np.float32)
    information: Floats = np.empty((len(places), len(readings), len(readings)), dtype=np.float32)
    a = products.values[:, readings]
    squares = a**2
    paired = np.flatnonzero(products.partner >= 0)
    kinds = np.array([(x.elastic, x.sensed) for x in products.amplitudes])
    distinct_kinds = {(bool(e), bool(d)) for e, d in np.unique(kinds, axis=0)}
    for k in range(len(places)):
        spread = np.zeros((len(motion), w.m, len(readings)))
        spread[readings, :, np.arange(len(readings))] = motion[readings, :, k]
        t = w.whiten_readings(spread)[rows]
        form[k] = t
        information[k] = free = model.information(t).astype(np.float32)
        lifted = a @ free
        across_one[k] = lifted.sum(axis=1)  # a constant has the value 1
        across_less[:, k] = _across_factors(products, a, lifted)
        square[k] = np.einsum("fn,fn->f", lifted, a)
        across[k, paired] = np.einsum("fn,fn->f", lifted[paired], a[products.partner[paired]])
        least = VISIBLE * (squares @ np.sum(t**2, axis=0).astype(np.float32)) + LEAST_MOTION
        square[k, square[k] < least] = 0.0
        for kind in distinct_kinds:
            if not places[k].takes(*kind):
                square[k, (kinds == kind).all(axis=1)] = 0.0
    return Screen(
        linear, products, places, motion, rows, readings, form, information, square, across,
        across_one, across_less,
    )  # fmt: skip


def _across_factors(amplitudes: Grammar, values: Floats, lifted: Floats) -> Floats:
    """(2, F) xᵀ Q x' of products with the amplitude without first, and second factor."""
    # With a product f g and Q symmetric, (f g)ᵀ Q g = fᵀ (g ∘ Q g): no product is formed.
    out: Floats = np.zeros((2, len(amplitudes.size)), dtype=np.float32)
    products = np.flatnonzero((amplitudes.without_factor >= 0).all(axis=0))
    if not len(products):
        return out
    second, first = amplitudes.without_factor[:, products]
    singles, place = np.unique(amplitudes.without_factor[:, products], return_inverse=True)
    g, f = place.reshape(2, -1)
    v = values[singles]
    both = v @ (v * lifted[singles]).T
    scale = amplitudes.size[second] * amplitudes.size[first] / amplitudes.size[products]
    out[0, products] = both[f, g] * scale
    out[1, products] = both[g, f] * scale
    return out


def _thinned(fit: Fit) -> tuple[Bools, Ints]:
    """Return rows (R,) and readings (K,) of random whole poses for the screening."""
    w, inliers = fit.whitening, fit.readings[~fit.outlier]
    if len(inliers) <= MOST_READINGS:
        return np.ones(w.m * len(w), dtype=np.bool_), np.arange(len(inliers))
    group = inliers.pose
    order = np.random.default_rng(20261122).permutation(int(group.max()) + 1)
    count = np.cumsum(np.bincount(group, minlength=len(order))[order])
    chosen = order[: max(int(np.searchsorted(count, MOST_READINGS)), 1)]
    used = np.isin(group, chosen)
    return np.repeat(used[w.reading], w.m), np.flatnonzero(used)


LEVELS = (0.2, 0.35, 0.5, 0.65, 0.8)
STEPS = (0.25, 0.5, 0.75)  # Bends, and steps, as quantiles; a choice, by time
WIDTH = 0.3  # Width of a step, in standard deviations of the argument; a choice
MOST_ARGUMENTS = 4000  # Most arguments, the simplest first; a choice, by memory


def _starts(u: Floats) -> list[tuple[Shape, tuple[Floats, ...]]]:
    levels, steps = np.quantile(u, LEVELS), np.quantile(u, STEPS)
    width = np.full(len(STEPS), max(WIDTH * float(np.std(u)), 1e-300))
    return [(shapes.ABOVE, (levels,)), (shapes.BELOW, (levels,)), (shapes.STEP, (steps, width))]


def unit_rows(values: Floats) -> Floats:
    """Rows scaled to root mean square 1, single precision; zero if not finite."""
    size = np.sqrt(np.mean(values**2, axis=-1, keepdims=True))
    good = np.isfinite(size) & (size > 0)
    return np.where(good, values / np.where(good, size, 1.0), 0.0).astype(np.float32)
