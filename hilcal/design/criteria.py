"""Smooth criteria of a plan: determinants of information matrices, and mean variances."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilcal.design.criterion import Criterion, Root, Smooth, factors, inverse, soft_least, square
from hilcal.errors import InputError
from hilcal.regression.schur import (
    SchurComplement,
    differentiable_schur_complement,
    schur_complement,
)
from hilcal.types import Floats, Ints


class SmoothCriterion(Criterion):
    """A differentiable criterion: it is its own surrogate, f = log φ."""

    monotone = True
    kinked = False

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = log φ, whatever the order."""
        return self

    @abstractmethod
    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = log φ; None where M is singular."""


@dataclass(frozen=True, slots=True)
class D(SmoothCriterion):
    """φ(M) = det(M)^(1/P), the inverse volume of the confidence ellipsoid.

    Fedorov (1972), Theory of Optimal Experiments; O1 of Borm & Menq (1991), Int. J. Robotics
    Research 10(6). With a model that may be complete, φ(M) = det(M)^(1/2P) · det(M_ss)^(1/2s).
    """

    # s of a model whose parameters come first; None where all are taken for unknown
    model: int | None = None
    name = "D"

    def blocks(self, size: int) -> tuple[tuple[float, Ints], ...]:
        """Return exponents and indices of the determinants, for M of this size."""
        if self.model is None:
            return ((1.0 / size, np.arange(size)),)
        return (0.5 / size, np.arange(size)), (0.5 / self.model, np.arange(self.model))

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        flat = m.reshape(-1, *m.shape[-2:])
        log, good = np.zeros(len(flat)), np.ones(len(flat), dtype=np.bool_)
        for c, at in self.blocks(m.shape[-1]):
            factor, regular = factors(flat[:, at[:, None], at])
            log += 2.0 * c * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
            good &= regular
        found = np.where(good, np.exp(np.where(good, log, 0.0)), 0.0)
        return np.asarray(found.reshape(m.shape[:-2]))

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = log φ with gradient Σ c M_bb⁻¹."""
        value, gradient = 0.0, np.zeros_like(m)
        products: list[tuple[float, Floats, Floats]] = []
        for c, at in self.blocks(len(m)):
            found = inverse(m[np.ix_(at, at)])
            if found is None:
                return None
            part = np.zeros_like(m)
            part[np.ix_(at, at)] = found[0]
            value += c * found[1]
            gradient += c * part
            products.append((-c, part, part))
        return Smooth(value, gradient, tuple(products), (), float(np.exp(value)) * gradient)


@dataclass(frozen=True, slots=True, eq=False)
class MeanVariance(SmoothCriterion):
    """φ(M) = 1 / tr(C M⁻¹), the inverse of a mean variance: A- and I-optimality.

    With C = 1/s at s parameters it is their mean variance: O5 of Sun & Hollerbach (2008), IEEE
    ICRA, "Observability index selection for robot calibration". With C the mean of VᵀV over
    prediction poses, V the Jacobian of the position there, it is that of the predicted position:
    Atkinson, Donev and Tobias, *Optimum Experimental Designs, with SAS* (2007), chapter 10. With a
    model that may be complete, φ(M) = 1 / (tr(C M⁻¹) + tr(C_s M_ss⁻¹)).
    """

    c: Floats  # (P, P) C, positive semidefinite
    name: str = "I"  # name by which a configuration calls it
    # (s, s) C_s of a model whose parameters come first; None where all are unknown
    model: Floats | None = None

    def __post_init__(self) -> None:
        """Refuse a matrix that is no mean of squares."""
        c = square(self.c, "the matrix of the prediction poses")
        scale = float(np.trace(c))
        if not scale > 0.0 or np.linalg.eigvalsh(c)[0] < -1e-9 * scale:
            raise InputError(
                "the matrix of the prediction poses is not positive semidefinite, or zero"
            )

    @property
    def parts(self) -> tuple[Floats, ...]:
        """The matrices C (b, b) of M_bb⁻¹, b the first parameters."""
        return (self.c,) if self.model is None else (self.c, self.model)

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices; 0 where singular."""
        flat = m.reshape(-1, *m.shape[-2:])
        q, good = np.zeros(len(flat)), np.ones(len(flat), dtype=np.bool_)
        for c in self.parts:
            factor, regular = factors(flat[:, : len(c), : len(c)])
            found = np.linalg.inv(factor)
            q += np.einsum("nij,nij->n", found @ c, found)
            good &= regular
        good &= q > 0.0
        return np.asarray(np.where(good, 1.0 / np.where(good, q, 1.0), 0.0).reshape(m.shape[:-2]))

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = −log q with gradient Σ M_bb⁻¹ C M_bb⁻¹ / q."""
        found: list[tuple[Floats, Floats]] = []
        q = 0.0
        for c in self.parts:
            b = len(c)
            root = inverse(m[:b, :b])
            if root is None:
                return None
            inverted, inner = np.zeros_like(m), np.zeros_like(m)
            inverted[:b, :b] = root[0]
            inner[:b, :b] = root[0] @ c @ root[0]
            q += float(np.sum(c * root[0]))
            found.append((inner, inverted))
        if not q > 0.0:
            return None
        gradient = sum((inner for inner, _ in found), np.zeros_like(m)) / q
        products = tuple((-2.0 / q, inner, inverted) for inner, inverted in found)
        return Smooth(-float(np.log(q)), gradient, products, ((1.0, gradient),), gradient / q)


_FLOOR = 1e-14


@dataclass(frozen=True, slots=True, eq=False)
class E(Criterion):
    """φ(M) = λ_min(S): the worst determined direction of the parameters of interest.

    O3 of Nahvi & Hollerbach (1996), IEEE ICRA; S is the Schur complement of the other parameters,
    M itself where all are of interest. The surrogate is the barrier of the semidefinite program
    max t, S ⪰ t 1: F = max over t of t + μ log det(S − t 1), whose gradient Z = μ (S − t 1)⁻¹ has
    trace 1: λ_min(N) ≤ tr(Z N).
    """

    interest: Ints | None = None  # indices of the parameters of interest; all by default
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
