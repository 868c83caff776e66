"""Criteria of a plan that are smooth: volume and mean variance; the others by their names."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.errors import InputError
from hilcal.plan.criterion import (
    Criterion,
    Smooth,
    factors,
    inverse,
    require_determined,
    square,
)
from hilcal.plan.eigenvalue_criteria import E, K
from hilcal.plan.t_optimality import Pair, Separate
from hilcal.types import Bools, Floats, Ints

__all__ = ["A", "Criterion", "D", "E", "K", "Linear", "Pair", "Separate", "Smooth"]


@dataclass(frozen=True, slots=True, eq=False)
class D:
    """φ(M) = det(S)^(1/s), the inverse volume of the confidence ellipsoid.

    S is M, or with parameters of interest the Schur complement of the others: what is left
    for s parameters when the others are unknown as well (D_s). Fedorov (1972), Theory of
    Optimal Experiments; O1 of Borm & Menq (1991), Int. J. Robotics Research 10(6).

    Attributes:
        interest: indices of the parameters of interest; all by default.
    """

    interest: Ints | None = None
    name = "D"
    monotone = True
    kinked = False

    def _others(self, size: int) -> Ints:
        """Return the indices of the nuisance parameters."""
        if self.interest is None:
            return np.empty(0, dtype=np.int64)
        return np.setdiff1d(np.arange(size), _interest(self.interest, size))

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        size = m.shape[-1]
        others = self._others(size)
        log, good = _log_det(m.reshape(-1, size, size))
        if len(others):
            log -= _log_det(m.reshape(-1, size, size)[:, others[:, None], others])[0]
        found = np.where(good, np.exp(np.where(good, log, 0.0) / (size - len(others))), 0.0)
        return np.asarray(found.reshape(m.shape[:-2]))

    def gradient(self, m: Floats) -> Floats:
        """Return (P, P) φ/s (M⁻¹ − the inverse of the nuisance block)."""
        return _smooth(self(m)).above

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = log φ."""
        whole = inverse(m)
        if whole is None:
            return None
        found, log = whole
        others = self._others(len(m))
        s = len(m) - len(others)
        gradient = found
        products: tuple[tuple[float, Floats, Floats], ...] = ((-1.0 / s, found, found),)
        if len(others):
            block = inverse(m[np.ix_(others, others)])
            if block is None:
                return None
            part = np.zeros_like(m)
            part[np.ix_(others, others)] = block[0]
            log -= block[1]
            gradient = found - part
            products += ((1.0 / s, part, part),)
        gradient = gradient / s
        return Smooth(log / s, gradient, products, (), float(np.exp(log / s)) * gradient)

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = log φ, whatever the order."""
        return self

    def sure(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse a singular M."""
        require_determined(m, names)


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """φ(M) = 1 / tr(C M⁻¹), the inverse of a mean variance.

    With C the mean of VᵀV over test poses, V the Jacobian of the position there, tr(C M⁻¹) is
    the mean variance of the predicted position at these poses.

    Attributes:
        c: (P, P) positive semidefinite.
        name: name by which a configuration calls it.
    """

    c: Floats
    name: str = "test"
    monotone = True
    kinked = False

    def __post_init__(self) -> None:
        """Refuse a matrix that is no mean of squares."""
        c = square(self.c, "the matrix of the test poses")
        scale = float(np.trace(c))
        if not scale > 0.0 or np.linalg.eigvalsh(c)[0] < -1e-9 * scale:
            raise InputError("the matrix of the test poses is not positive semidefinite, or zero")

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        return _value(m, self.c)

    def gradient(self, m: Floats) -> Floats:
        """Return (P, P) φ² M⁻¹ C M⁻¹."""
        return _smooth(self(m)).above

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = log φ."""
        return _log_mean(m, self.c)

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = log φ, whatever the order."""
        return self

    def sure(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse a singular M."""
        require_determined(m, names)


@dataclass(frozen=True, slots=True, eq=False)
class A:
    """φ(M) = s / Σ (M⁻¹)_ii over s parameters, the inverse of their mean variance.

    O5 of Sun & Hollerbach (2008), IEEE ICRA, "Observability index selection for robot
    calibration".

    Attributes:
        interest: indices of the parameters; all by default.
    """

    interest: Ints | None = None
    name = "A"
    monotone = True
    kinked = False

    def _c(self, size: int) -> Floats:
        """Return (P, P) C such that tr(C M⁻¹) is the mean variance."""
        chosen = np.arange(size) if self.interest is None else _interest(self.interest, size)
        out = np.zeros((size, size))
        out[chosen, chosen] = 1.0 / len(chosen)
        return out

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        return _value(m, self._c(m.shape[-1]))

    def gradient(self, m: Floats) -> Floats:
        """Return (P, P) φ² M⁻¹ C M⁻¹."""
        return _smooth(self(m)).above

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = log φ."""
        return _log_mean(m, self._c(len(m)))

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = log φ, whatever the order."""
        return self

    def sure(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse a singular M."""
        require_determined(m, names)


def _interest(interest: Ints, size: int) -> Ints:
    """Return checked indices of parameters.

    Raises:
        InputError: none, one that is there twice, or one that does not exist.
    """
    chosen = np.asarray(interest, dtype=np.int64).reshape(-1)
    unique = np.unique(chosen)
    if not len(chosen) or len(unique) < len(chosen) or unique[0] < 0 or unique[-1] >= size:
        raise InputError(
            f"parameters of interest {chosen.tolist()}; valid: different indices from 0 to "
            f"{size - 1}, at least one"
        )
    return chosen


def _smooth(found: Smooth | None) -> Smooth:
    """Return what exists only where M is regular.

    Raises:
        InputError: M is singular.
    """
    if found is None:
        raise InputError("the information matrix is singular: the criterion has no gradient there")
    return found


def _log_mean(m: Floats, c: Floats) -> Smooth | None:
    """Return f = −log tr(C M⁻¹)."""
    whole = inverse(m)
    if whole is None:
        return None
    found = whole[0]
    inner = found @ c @ found
    q = float(np.sum(c * found))
    if not q > 0.0:
        return None
    gradient = inner / q
    return Smooth(
        -float(np.log(q)),
        gradient,
        ((-2.0 / q, inner, found),),
        ((1.0, gradient),),
        gradient / q,
    )


def _log_det(m: Floats) -> tuple[Floats, Bools]:
    """Return log det of (N, P, P) matrices, and which of them are regular."""
    factor, good = factors(m)
    return 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1), good


def _value(m: Floats, c: Floats) -> Floats:
    """Return 1 / tr(C M⁻¹) of (..., P, P) matrices; 0 where singular."""
    factor, good = factors(m.reshape(-1, *m.shape[-2:]))
    found = np.linalg.inv(factor)
    q = np.einsum("nij,nij->n", found @ c, found)
    good = good & (q > 0.0)
    return np.asarray(np.where(good, 1.0 / np.where(good, q, 1.0), 0.0).reshape(m.shape[:-2]))
