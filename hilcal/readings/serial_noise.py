"""Noise that is correlated along the order of the readings, as of air that moves slowly.

A share φ of the stated covariance V_i of reading i is not white: with S_i S_iᵀ = V_i,

    e_i = √(1 − φ) w_i + √φ S_i z_i,    Cov(z_i, z_j) = exp(−|t_i − t_j| / τ) 1

w_i independent of covariance V_i, each element of z an Ornstein-Uhlenbeck process. So the stated
covariance holds for each reading. t is the time of a reading, or its number in the order, where
z is an AR(1) process with ρ = exp(−1/τ). S_i is the symmetric root of V_i's correlation matrix
times the standard deviations: neighbours with nearly the same V have nearly the same S, in any
units. Of V, an estimated scatter of the arm and what targets share in one arrival are left out:
these are of the arm, and new in each arrival.

Source: Gelb (ed.), *Applied Optimal Estimation* (1974), section 3.8 (exponentially correlated
noise).
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from hilcal.types import Floats

Clock = Literal["time", "order"]


@dataclass(frozen=True, slots=True)
class SerialNoise:
    """An estimate of it; see `diagnosis.serial_noise`.

    Attributes:
        clock: what t is: "time", s, or "order", the number of the reading.
        share: φ, 0 to 1.
        share_error: its standard uncertainty.
        length: τ, s or readings.
        rho: correlation of z between consecutive readings, of the median distance in time.
        rho_error: its standard uncertainty.
        log_likelihood_ratio: gain of the restricted log likelihood over white noise, with every
            effect that the readings could show beside either.
        proved: whether that is more than chance; False where effects explain the readings as well.
        instead: what explains them as well, where it is not proved.
        wider: least and largest factor by which it changes the standard uncertainties of the
            parameters.
    """

    clock: Clock
    share: float
    share_error: float
    length: float
    rho: float
    rho_error: float
    log_likelihood_ratio: float
    proved: bool = True
    instead: tuple[str, ...] = ()
    wider: tuple[float, float] = (1.0, 1.0)

    @property
    def half(self) -> float:
        """Distance after which half of the correlation is left, s or readings."""
        return self.length * float(np.log(2.0))

    def correlation(self, t: Floats) -> Floats:
        """Cov(z_i, z_j) (..., N, N) of readings at t (..., N)."""
        return np.asarray(np.exp(-np.abs(t[..., :, None] - t[..., None, :]) / self.length))

    def to_json(self) -> dict[str, object]:
        """Return the attributes by name, and `half`."""
        return {**asdict(self), "half": self.half}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "SerialNoise":
        """Return what `to_json` wrote."""
        given: dict[str, Any] = {name: x for name, x in content.items() if name != "half"}
        lists = given.keys() & {"instead", "wider"}
        return cls(**{**given, **{name: tuple(given[name]) for name in lists}})
