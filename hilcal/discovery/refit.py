"""A law refined and refitted: free exponents and scales, then the exact model.

Numbers in the functions of a law, as an exponent or a saturation, are taken from a coarse grid by
the search. They are refined where the sum of squares that the law leaves is least, its coefficients
and the model's projected out. A refined number is kept where it gains more evidence than a number
costs, else the one of the grid, which is simpler.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.discovery.amplitudes import Amplitude, Composed, Factor, composed
from hilcal.discovery.law import (
    LETTERS,
    Coefficient,
    Form,
    coefficients,
    effect_class,
    source_of_form,
    with_coefficients,
    with_factors,
)
from hilcal.discovery.screen import Screen
from hilcal.effects.check import check_effect
from hilcal.effects.protocol import Effect, Situation
from hilcal.errors import CannotAnswerError
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import Linearisation
from hilcal.types import Floats

WORTH = 3.0  # Gain in log likelihood that a refined number needs, beside ½ ln ν; 20 : 1
DIGITS = 3
SPANNED = 1e-10  # Directions of a law's columns below this share of the largest are rounding
FACTOR = 30.0  # Factor by which a positive number may change at most; a choice
SPREADS = 3.0  # Standard deviations of its quantity by which a level may move at most; a choice


def refine(screen: Screen, form: Form) -> Form:
    """Return the law with its free numbers refined, where the readings ask for it."""
    from scipy.optimize import minimize  # slow to import

    linear = screen.linear
    s = linear.fit.solution.prediction.situation
    free = free_numbers(form, s)
    if not free:
        return form
    best = left_by(screen, form, s)

    def at(x: Floats) -> list[float]:
        return [number.at(v) for number, v in zip(free, x.tolist(), strict=True)]

    def objective(x: Floats) -> float:
        values = at(x)
        if not np.isfinite(values).all():
            return np.inf
        return left_by(screen, with_values(form, free, values), s)

    found = minimize(
        objective, np.zeros(len(free)), method="Nelder-Mead",
        options={"maxfev": 60 * len(free), "xatol": 1e-3, "fatol": 1e-3,
                 "initial_simplex": np.eye(len(free) + 1, len(free), -1) * 0.3},
    )  # fmt: skip
    values = [float(f"{v:.{DIGITS}g}") for v in at(found.x)]
    refined = with_values(form, free, values)
    after = left_by(screen, refined, s)
    dof = linear.fit.dof
    gain = 0.5 * dof * np.log(best / max(after, 1e-300))
    return refined if gain > len(free) * (0.5 * np.log(dof)) + WORTH else form


def left_by(screen: Screen, form: Form, s: Situation) -> float:
    """Sum of squares that a law leaves, by algebra; infinite where it is not finite."""
    linear = screen.linear
    x = form.columns(screen, s)
    if not np.isfinite(x).all():
        return np.inf
    return linear.rss - float(x.T @ linear.residual @ _step(linear, x))


def _step(linear: Linearisation, x: Floats) -> Floats:
    """(P,) coefficients of columns (R, P) by algebra."""
    found = np.linalg.lstsq(linear.information(x), x.T @ linear.residual, rcond=SPANNED)
    return np.asarray(found[0], dtype=float)


def at_linearisation(screen: Screen, form: Form) -> tuple[Coefficient, ...]:
    """Return the coefficients by algebra, without their uncertainties."""
    x = form.columns(screen, screen.linear.fit.solution.prediction.situation)
    return coefficients(form, _step(screen.linear, x), np.full(form.count, np.nan))


def exact(
    screen: Screen, form: Form, name: str
) -> tuple[Fit, Form, tuple[Coefficient, ...], type[Effect]]:
    """Refit the model with the law as an effect that keeps to the protocol; return both.

    A coefficient that the model absorbs is dropped, as the zero of a compliance that grows with
    time beside a compliance of the model: it is no part of what is found.
    """
    before = screen.linear.fit
    s = before.solution.prediction.situation
    while True:
        letters = LETTERS[: form.count]
        kind = effect_class(source_of_form(form, name, at_linearisation(screen, form)), name)
        check_effect(kind, before.model.cell)
        effect = kind(before.model.cell, s.states)
        model = replace(before.model, effects=(*before.model.effects, effect))
        start = np.concatenate([before.theta, np.zeros(form.count)])
        after = fit(model, before.readings, before.mode, before.scaling, start)
        rows = model.slices()[-1]
        values, std = after.theta[rows], after.uncertainty.std[rows]
        determined = np.isfinite(std)
        if determined.all():
            break
        if not determined.any():
            raise CannotAnswerError("the readings do not determine it beside the model")
        form = with_coefficients(form, np.flatnonzero(determined).tolist())
    found = tuple(
        Coefficient(letter, float(values[k]), float(std[k]), form.unit(k))
        for k, letter in enumerate(letters)
    )
    return after, form, found, kind


@dataclass(frozen=True, slots=True)
class FreeNumber:
    """A number, wherever it is in a law."""

    places: tuple[tuple[int, int], ...]  # (part, factor) of each function that has it
    index: int  # of it among the function's numbers, or among the weights of its quantity
    weight: bool  # whether it is a weight
    begin: float
    scale: float  # one unit of its change; 0 where it changes by factors instead, eˣ
    least: float = -np.inf  # value that it has at least

    def at(self, x: float) -> float:
        """Return its value after a change; infinite where that is too large."""
        if abs(x) > (SPREADS if self.scale else np.log(FACTOR)):
            return float("inf")
        value = self.begin + self.scale * x if self.scale else self.begin * float(np.exp(x))
        return value if value >= self.least else float("inf")

    def put(self, factor: Factor, value: float) -> Factor:
        """Return a function with another value of it."""
        if not self.weight:
            n = factor.numbers
            return replace(factor, numbers=(*n[: self.index], value, *n[self.index + 1 :]))
        terms = [*_terms(factor)]
        terms[self.index] = value, terms[self.index][1]
        return replace(factor, variable=composed(tuple(terms)))


def _terms(factor: Factor) -> tuple[tuple[float, Amplitude], ...]:
    return factor.variable.terms if isinstance(factor.variable, Composed) else ()


def free_numbers(form: Form, s: Situation) -> list[FreeNumber]:
    """Return the free numbers of a law; the same function in several products has one number."""
    groups: dict[tuple[str, str, tuple[float, ...]], list[tuple[int, int]]] = {}
    for k, p in enumerate(form.parts):
        for i, f in enumerate(p.amplitude.factors):
            key = f.variable.symbol, f.shape.name, f.numbers
            groups.setdefault(key, []).append((k, i))
    out = []
    for found in groups.values():
        places = tuple(found)
        f = form.parts[places[0][0]].amplitude.factors[places[0][1]]
        made = isinstance(f.variable, Composed)
        # Below an exponent of 1 the slope at a bend would have no limit, nor an equilibrium.
        steep = f.shape.name.endswith("_power") and f.variable.slot is not None
        for n in f.shape.free:
            level = n in f.shape.places and (made or f.numbers[n] <= 0)
            scale = float(np.std(f.variable.read(s))) if level else 0.0
            if scale or f.numbers[n] > 0:
                least = 1.0 if steep and n not in f.shape.places else -np.inf
                out.append(FreeNumber(places, n, False, f.numbers[n], scale, least))
        for n, (weight, _) in enumerate(_terms(f)[1:], start=1):
            if weight:
                out.append(FreeNumber(places, n, True, weight, abs(weight)))
    return out


def with_values(form: Form, free: Sequence[FreeNumber], values: Sequence[float] | Floats) -> Form:
    """Return a law with other values of its free numbers."""
    changed: dict[tuple[int, int], Factor] = {}
    for number, value in zip(free, values, strict=True):
        for k, i in number.places:
            old = changed.get((k, i), form.parts[k].amplitude.factors[i])
            changed[k, i] = number.put(old, float(value))
    return with_factors(form, changed)
