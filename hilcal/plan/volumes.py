"""The compromise of two volumes: of the model's parameters, and of all that could be there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.errors import InputError
from hilcal.plan.criterion import Smooth, factors, inverse, require_determined
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class Volumes:
    """φ(M) = det(M)^(1/2P) · det(M_ss)^(1/2s), a compound D-criterion.

    The mean of the logarithms of both D-efficiencies, so that neither optimum is needed: half
    of the belief is that all P parameters are unknown, half that only the first s are. Concave
    and of degree 1. Source: Atkinson, Donev and Tobias, *Optimum Experimental Designs, with SAS*
    (2007), chapter 21.

    Attributes:
        size: s, of the model, whose parameters come first.
    """

    size: int
    name = "D"
    monotone = True
    kinked = False

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        flat, half = m.reshape(-1, *m.shape[-2:]), np.zeros(int(np.prod(m.shape[:-2])))
        good = np.ones(len(half), dtype=np.bool_)
        for count in (m.shape[-1], self.size):
            root, regular = factors(flat[:, :count, :count])
            good &= regular
            half += np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1) / count
        found = np.where(good, np.exp(np.where(good, half, 0.0)), 0.0)
        return np.asarray(found.reshape(m.shape[:-2]))

    def gradient(self, m: Floats) -> Floats:
        """Return (P, P) φ/2 (M⁻¹/P + M_ss⁻¹/s).

        Raises:
            InputError: M is singular.
        """
        found = self(m)
        if found is None:
            raise InputError("the information matrix is singular: the criterion has no gradient")
        return found.above

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = log φ."""
        value, gradient = 0.0, np.zeros_like(m)
        products: list[tuple[float, Floats, Floats]] = []
        for count in (len(m), self.size):
            found = inverse(m[:count, :count])
            if found is None:
                return None
            part = np.zeros_like(m)
            part[:count, :count] = found[0]
            share = 0.5 / count
            value += share * found[1]
            gradient = gradient + share * part
            products.append((-share, part, part))
        return Smooth(value, gradient, tuple(products), (), float(np.exp(value)) * gradient)

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = log φ, whatever the order."""
        return self

    def sure(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse a singular M."""
        require_determined(m, names)
