"""Refinement of a law's free numbers, and its refit in the exact model.

The search takes the numbers in a law's functions, such as an exponent, from a coarse grid. They are
refined to the least sum of squares, with the coefficients of law and model projected out, and used
if they gain more evidence than they cost; else those of the grid stay.
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
from hilcal.identification.fit import Fit, fit_again
from hilcal.identification.linearisation import Linearisation
from hilcal.types import Floats

LEAST_GAIN = 3.0  # Gain in log likelihood that refined numbers need, beyond ½ ln ν each; 20 : 1
DIGITS = 3
SPANNED = 1e-10  # Directions of a law's columns below this share of the largest are rounding
LARGEST_FACTOR = 30.0  # Factor by which a positive number may change at most; a choice
LARGEST_SHIFT = 3.0  # Largest change of a level, in standard deviations of its quantity; a choice


def refine(screen: Screen, form: Form) -> Form:
    """Return the law with refined numbers if the readings require it, else the law."""
    from scipy.optimize import minimize  # slow to import

    linear = screen.linear
    s = linear.fit.solution.prediction.situation
    free = free_numbers(form, s)
    if not free:
        return form
    best = rss_with_law(screen, form, s)

    def numbers_at(x: Floats) -> list[float]:
        return [number.at(v) for number, v in zip(free, x.tolist(), strict=True)]

    def objective(x: Floats) -> float:
        values = numbers_at(x)
        if not np.isfinite(values).all():
            return np.inf
        return rss_with_law(screen, with_values(form, free, values), s)

    result = minimize(
        objective, np.zeros(len(free)), method="Nelder-Mead",
        options={"maxfev": 60 * len(free), "xatol": 1e-3, "fatol": 1e-3,
                 "initial_simplex": np.eye(len(free) + 1, len(free), -1) * 0.3},
    )  # fmt: skip
    values = [float(f"{v:.{DIGITS}g}") for v in numbers_at(result.x)]
    refined = with_values(form, free, values)
    after = rss_with_law(screen, refined, s)
    dof = linear.test_noise[1]
    gain = 0.5 * dof * np.log(best / max(after, 1e-300))
    return refined if gain > len(free) * (0.5 * np.log(dof)) + LEAST_GAIN else form


def rss_with_law(screen: Screen, form: Form, s: Situation) -> float:
    """Sum of squares with a law, by algebra; infinite if the law is not finite."""
    linear = screen.linear
    with np.errstate(over="ignore", invalid="ignore"):  # tried numbers may be extreme
        x = form.columns(screen, s)
    if not np.isfinite(x).all():
        return np.inf
    x = x / max(float(np.abs(x).max()), 1e-300)  # only its span matters; squares of 1e200 overflow
    return linear.test_noise[0] - float(x.T @ linear.residual @ _step(linear, x))


def _step(linear: Linearisation, x: Floats) -> Floats:
    """(P,) coefficients of columns (R, P) by algebra."""
    step = np.linalg.lstsq(linear.information(x), x.T @ linear.residual, rcond=SPANNED)[0]
    return np.asarray(step, dtype=float)


def refit_exactly(
    screen: Screen, form: Form, name: str
) -> tuple[Fit, Form, tuple[Coefficient, ...], type[Effect]]:
    """Refit the exact model with the law as an effect, after checking the effect.

    Coefficients that the model absorbs are dropped, e.g. the zero of a compliance that grows with
    time, beside a compliance of the model. Returns the fit, the law, its coefficients, and the
    class of its effect.
    """
    before = screen.linear.fit
    s = before.solution.prediction.situation
    while True:
        letters = LETTERS[: form.count]
        step = _step(screen.linear, form.columns(screen, s))  # by algebra, for the magnitudes
        values = coefficients(form, step, np.full(form.count, np.nan))
        kind = effect_class(source_of_form(form, name, values), name)
        check_effect(kind, before.model.cell)
        effect = kind(before.model.cell, s.states)
        model = replace(before.model, effects=(*before.model.effects, effect))
        start = np.concatenate([before.theta, np.zeros(form.count)])
        after = fit_again(before, model, start=start)
        rows = model.slices()[-1]
        theta, std = after.theta[rows], after.uncertainty.std[rows]
        determined = np.isfinite(std)
        if determined.all():
            break
        if not determined.any():
            raise CannotAnswerError("the readings do not determine it beside the model")
        form = with_coefficients(form, np.flatnonzero(determined).tolist())
    estimates = tuple(
        Coefficient(letter, float(theta[k]), float(std[k]), form.unit(k))
        for k, letter in enumerate(letters)
    )
    return after, form, estimates, kind


@dataclass(frozen=True, slots=True)
class FreeNumber:
    """A free number of a law."""

    places: tuple[tuple[int, int], ...]  # (part, factor) of each function with this number
    index: int  # among the function's numbers, or among the weights of its quantity
    weight: bool  # whether it is a weight
    start: float
    scale: float  # unit of its change; 0 if it changes by factors eˣ instead
    least: float = -np.inf  # lower bound

    def at(self, x: float) -> float:
        """Return the value after a change x; infinite for too large a change."""
        if abs(x) > (LARGEST_SHIFT if self.scale else np.log(LARGEST_FACTOR)):
            return float("inf")
        value = self.start + self.scale * x if self.scale else self.start * float(np.exp(x))
        return value if value >= self.least else float("inf")

    def put(self, factor: Factor, value: float) -> Factor:
        """Return a function with another value of the number."""
        if not self.weight:
            n = factor.numbers
            return replace(factor, numbers=(*n[: self.index], value, *n[self.index + 1 :]))
        terms = [*_terms(factor)]
        terms[self.index] = value, terms[self.index][1]
        return replace(factor, variable=composed(tuple(terms)))


def _terms(factor: Factor) -> tuple[tuple[float, Amplitude], ...]:
    return factor.variable.terms if isinstance(factor.variable, Composed) else ()


def free_numbers(form: Form, s: Situation) -> list[FreeNumber]:
    """Return the free numbers of a law; equal functions in several products share theirs."""
    groups: dict[tuple[str, str, tuple[float, ...]], list[tuple[int, int]]] = {}
    for k, p in enumerate(form.parts):
        for i, f in enumerate(p.amplitude.factors):
            key = f.variable.symbol, f.shape.name, f.numbers
            groups.setdefault(key, []).append((k, i))
    out = []
    for members in groups.values():
        places = tuple(members)
        f = form.parts[places[0][0]].amplitude.factors[places[0][1]]
        is_composed = isinstance(f.variable, Composed)
        # Below an exponent of 1 the slope at a bend is unbounded: there is no equilibrium.
        steep = f.shape.name.endswith("_power") and f.variable.slot is not None
        for n in f.shape.free:
            level = n in f.shape.places and (is_composed or f.numbers[n] <= 0)
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
