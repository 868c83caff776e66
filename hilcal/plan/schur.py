"""What is left of an information matrix for some parameters, the others unknown as well.

    S = M_ss − M_sn M_nn⁻¹ M_ns = the least of Uᵀ M U over all U that are 1 at the s of interest

S is concave in M: with H_k the information of unit k and U = (1, −M_nn⁻¹ M_ns) at the least,

    ∂S/∂w_k = Uᵀ H_k U,    ∂²S/∂w_k∂w_l = −Uᵀ (H_k Y H_l + H_l Y H_k) U,

Y being M_nn⁻¹ at the others and zero elsewhere. Source: Pukelsheim, *Optimal Design of
Experiments* (1993), chapter 3.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Left:
    """S at one M.

    Attributes:
        s: (s, s) S.
        lift: (P, s) U.
        others: (P, P) Y; None where there are no others.
    """

    s: Floats
    lift: Floats
    others: Floats | None

    def whole(self, inner: Floats) -> Floats:
        """Return (P, P) U G Uᵀ of G (s, s)."""
        return np.asarray(self.lift @ inner @ self.lift.T)


def left_for(m: Floats, interest: Ints | None) -> Left:
    """Return what is left of M (P, P); of all parameters where no interest is given."""
    size = len(m)
    if interest is None or len(interest) == size:
        return Left(m, np.eye(size), None)
    rest = np.setdiff1d(np.arange(size), interest)
    inverse = np.linalg.pinv(m[np.ix_(rest, rest)], hermitian=True)
    slope = inverse @ m[np.ix_(rest, interest)]
    s = m[np.ix_(interest, interest)] - m[np.ix_(interest, rest)] @ slope
    lift = np.zeros((size, len(interest)))
    lift[interest], lift[rest] = np.eye(len(interest)), -slope
    others = np.zeros_like(m)
    others[np.ix_(rest, rest)] = inverse
    return Left((s + s.T) / 2, lift, others)


def values_left(m: Floats, interest: Ints | None) -> Floats:
    """Return S (..., s, s) of (..., P, P) matrices."""
    if interest is None or len(interest) == m.shape[-1]:
        return m
    flat = m.reshape(-1, *m.shape[-2:])
    found = np.stack([left_for(one, interest).s for one in flat])
    return np.asarray(found.reshape(*m.shape[:-2], *found.shape[1:]))
