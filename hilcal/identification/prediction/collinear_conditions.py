"""The uncertainty of a prediction by conditions that changed together while measuring.

In a campaign the temperatures of air and joints and the time mostly rise together: an effect that
is fitted as one of the air may be one of a joint, or of heat that no thermometer shows. On another
day they go other ways. For each recorded condition u, a proxy model has every condition replaced by
its cubic in u, u being held at the ends of its measured range. A priori the model is as likely as
all K proxies together. By the readings the odds of a proxy, and its probability, are

    o_u = exp(−Δ_u/2)/K,   p_u = o_u / (1 + Σ o),
    Δ_u = (|r_u|² − |r|²)/σ² − gᵀ C g,   g = Aᵀ (r_u − r)/σ²,

r and r_u being the whitened residuals of both, A the derivatives by the parameters and C their
covariance: the least misfit of the proxy, its parameters refitted. A prediction has the further
covariance Σ p_u δ_u δ_uᵀ, with δ_u the difference of both predictions: the variance between
models of Bayesian model averaging (Hoeting et al., Stat. Sci. 14 (1999) 382) about this model's
prediction. Where the measured conditions recur, it is zero for every proxy that the readings allow.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilcal.model.model import Model
from hilcal.readings.readings import TEMPERATURES, States
from hilcal.types import Floats

CONDITIONS = ("time", *TEMPERATURES)
DEGREE = 3  # of the polynomials; a choice: a warm-up bends once over time
LEAST_PROBABILITY = 1e-3  # of a proxy that counts; a choice


@dataclass(frozen=True, slots=True, eq=False)
class Proxy:
    """A condition that may stand for all of them."""

    column: str  # of `States`
    joint: int  # column of the joints' temperatures; 0 otherwise
    low: float  # its measured range
    high: float
    polynomials: dict[str, Floats]  # (4,) or (4, n) of each column, over its range as −1 to 1
    probability: float  # p_u

    def applied(self, states: States) -> States | None:
        """Return states with all conditions by this one; None where it is not recorded."""
        values = _values(states, self.column, self.joint)
        if values is None:
            return None
        powers = _powers(values, self.low, self.high)
        columns: dict[str, Any] = {
            name: powers @ c
            for name, c in self.polynomials.items()
            if getattr(states, name) is not None
        }
        return replace(states, **columns)


def proxies(model: Model, states: States, log_odds: Callable[[States], float]) -> tuple[Proxy, ...]:
    """Return the conditions that may stand for all, by the fitted states; none for most models.

    `log_odds` states −Δ_u/2 of the fitted states with the conditions of a proxy.
    """
    columns = {c for e in model.effects for need in e.needs for c in need.split(" or ")}
    if columns.isdisjoint(CONDITIONS):
        return ()
    candidates = list(_candidates(states))
    at = (p.applied(states) for p in candidates)
    prior = np.log(max(len(candidates), 1))
    log = np.array([0.0, *(log_odds(s) - prior for s in at if s is not None)])
    odds = np.exp(log - log.max())
    probabilities = (odds / odds.sum())[1:].tolist()
    return tuple(
        replace(p, probability=x)
        for p, x in zip(candidates, probabilities, strict=True)
        if x >= LEAST_PROBABILITY
    )


def _candidates(states: States) -> Iterator[Proxy]:
    columns = {c: getattr(states, c) for c in CONDITIONS}
    present = {c: x for c, x in columns.items() if x is not None and np.isfinite(x).all()}
    for column, recorded in present.items():
        for joint in range(recorded.shape[1] if recorded.ndim > 1 else 1):
            values = recorded if recorded.ndim == 1 else recorded[:, joint]
            low, high = float(values.min()), float(values.max())
            if not high > low:
                continue
            powers = _powers(values, low, high)
            fitted = {c: np.linalg.lstsq(powers, x, rcond=None)[0] for c, x in present.items()}
            yield Proxy(column, joint, low, high, fitted, 0.0)


def _values(states: States, column: str, joint: int) -> Floats | None:
    values: Floats | None = getattr(states, column)
    return values if values is None or values.ndim == 1 else values[:, joint]


def _powers(values: Floats, low: float, high: float) -> Floats:
    within = (2.0 * np.clip(values, low, high) - low - high) / (high - low)
    return np.vander(within, DEGREE + 1, increasing=True)
