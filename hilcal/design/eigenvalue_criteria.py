"""Criteria of a plan by its extreme eigenvalues."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilcal.design.criterion import Criterion, Root, Smooth, soft_least
from hilcal.regression.schur import (
    SchurComplement,
    differentiable_schur_complement,
    schur_complement,
)
from hilcal.types import Floats, Ints

_FLOOR = 1e-14


@dataclass(frozen=True, slots=True, eq=False)
class E(Criterion):
    """φ(M) = λ_min(S): the worst determined direction of the parameters of interest.

    O3 of Nahvi & Hollerbach (1996), IEEE ICRA; S is the Schur complement of the other parameters,
    M itself where all are of interest. The surrogate is the barrier of the semidefinite program
    max t, S ⪰ t 1: F = max over t of t + μ log det(S − t 1), whose gradient Z = μ (S − t 1)⁻¹ has
    trace 1: λ_min(N) ≤ tr(Z N).

    Attributes:
        interest: indices of the parameters of interest; all by default.
    """

    interest: Ints | None = None
    name = "E"
    monotone = True
    kinked = True

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        s = m if self.interest is None else schur_complement(m, self.interest)
        return np.asarray(np.maximum(np.linalg.eigvalsh(s)[..., 0], 0.0))

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = F / λ_min(m) with μ = order · λ_min(m)."""
        values = np.linalg.eigvalsh(differentiable_schur_complement(m, self.interest).matrix)
        scale = max(float(values[0]), _FLOOR * float(values[-1]))

        def smooth(m: Floats) -> Smooth | None:
            part = _least(differentiable_schur_complement(m, self.interest), order * scale)
            return Smooth(
                part.value / scale,
                part.gradient / scale,
                tuple((c / scale, x, y) for c, x, y in part.products),
                tuple((c / scale, v) for c, v in part.squares),
                part.gradient,
            )

        return smooth


@dataclass(frozen=True, slots=True, eq=False)
class K(Criterion):
    """φ(M) = λ_min(M) / λ_max(M), the inverse of the condition number.

    The square of O2 of Driels & Pathre (1990), J. Robotic Systems 7(2). Quasi-concave: the
    surrogate is F_min − κ F_max with the ratio κ reached so far (Dinkelbach 1967), and with
    the densities Z and Y of the extreme eigenvalues φ(N) ≤ tr(Z N) / tr(Y N).
    """

    name = "K"
    monotone = False
    kinked = True

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        values = np.linalg.eigvalsh(m)
        most = values[..., -1]
        safe = np.where(most > 0, most, 1.0)
        return np.asarray(np.where(most > 0, np.maximum(values[..., 0], 0.0) / safe, 0.0))

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = (F_min − κ F_max) / λ_min(m), widths in proportion to the eigenvalues."""
        values = np.linalg.eigvalsh(m)
        most = float(values[-1])
        scale = max(float(values[0]), _FLOOR * most)
        ratio = scale / most

        def smooth(m: Floats) -> Smooth | None:
            values, vectors = np.linalg.eigh(m)
            least = _part(values, vectors, order * scale)
            largest = _part(-values, vectors, order * most)  # F_max(M) = −F_min(−M)
            return Smooth(
                (least.value + ratio * largest.value) / scale,
                (least.gradient - ratio * largest.gradient) / scale,
                (
                    *((c / scale, x, y) for c, x, y in least.products),
                    *((ratio * c / scale, x, y) for c, x, y in largest.products),
                ),
                (
                    *((c / scale, v) for c, v in least.squares),
                    *((ratio * c / scale, v) for c, v in largest.squares),
                ),
                least.gradient,
                largest.gradient,
            )

        return smooth


def _least(s: SchurComplement, width: float) -> Smooth:
    """Return the smooth least eigenvalue of S as a function of M."""
    part = _part(*np.linalg.eigh(s.matrix), width)
    gradient = s.embed(part.gradient)
    products = tuple((c, _embedded(s, x), _embedded(s, y)) for c, x, y in part.products)
    if s.inverse is not None:
        products = (*products, (-2.0, gradient, s.inverse))
    squares = tuple((c, s.embed(v)) for c, v in part.squares)
    return Smooth(part.value, gradient, products, squares, gradient)


def _embedded(s: SchurComplement, x: Floats | Root) -> Floats | Root:
    return Root(s.lift @ x.matrix) if isinstance(x, Root) else s.embed(x)


def _part(values: Floats, vectors: Floats, width: float) -> Smooth:
    """Return the smooth least of the eigenvalues, with S = M − t 1.

    Its second derivative is −μ tr(S⁻¹ H_k S⁻¹ H_l) + μ tr(S⁻² H_k) tr(S⁻² H_l) / tr(S⁻²).
    """
    value, p = soft_least(values, width)
    gradient = (vectors * p) @ vectors.T
    inner = (vectors * p**2) @ vectors.T
    return Smooth(
        value,
        gradient,
        ((-1.0 / width, gradient, gradient),),
        ((1.0 / (width * float(p @ p)), inner),),
        gradient,
    )
