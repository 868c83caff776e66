"""The criterion that separates effects: the power to tell one from another."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.errors import CannotAnswerError, InputError
from hilcal.plan.criterion import DETERMINED, Smooth, soft_least
from hilcal.types import Floats, Ints

_SOUND = 1e-2  # share of the largest inverse up to which Cholesky's factor serves
_FELT = 1e-5  # weight from which a pair enters the curvature


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """An effect that is there, and the parameters that try to explain it.

    Attributes:
        effect: (E,) indices of the effect's parameters.
        beta: (E,) their values.
        nuisance: (F,) indices of the parameters of the model and of the rival effect.
        name: said where no candidate separates the two.
    """

    effect: Ints
    beta: Floats
    nuisance: Ints
    name: str = "an effect from its rival"

    def __post_init__(self) -> None:
        """Refuse indices and values that do not belong together."""
        if len(self.effect) != len(self.beta) or not np.any(self.beta):
            raise InputError(
                f"{self.name}: {len(self.beta)} values of {len(self.effect)} parameters; valid: "
                "one of each, not all zero"
            )
        if len(np.intersect1d(self.effect, self.nuisance)):
            raise InputError(f"{self.name}: a parameter is on both sides")

    def best(self, m: Floats) -> tuple[Floats, Floats]:
        """Return the part u (P,) that stays unexplained, and the inverse (P, P) it is solved by.

        u has β at the effect and −M_nn⁻¹ M_ne β at the nuisance; uᵀ M u is the least of vᵀ M v
        over all v with β at the effect. Directions without information explain nothing.
        """
        solver = _solver(m, self.nuisance)
        return self.left(m, solver), solver

    def left(self, m: Floats, solver: Floats) -> Floats:
        """Return u (P,), given the inverse of the nuisance."""
        u = np.zeros(len(m))
        u[self.effect] = self.beta
        return u - solver @ (m @ u)


def _solver(m: Floats, nuisance: Ints) -> Floats:
    """Return (P, P) the inverse of the nuisance block, of the directions with information."""
    out = np.zeros_like(m)
    part = _factor(m[None], nuisance)[0]
    out[np.ix_(nuisance, nuisance)] = part.T @ part
    return out


def _factor(m: Floats, nuisance: Ints) -> Floats:
    """Return (N, F, F) T with Tᵀ T the inverse of the nuisance blocks of (N, P, P) matrices.

    Of directions without information, zero rows.
    """
    block = m[:, nuisance[:, None], nuisance]
    root = np.sqrt(np.maximum(np.diagonal(block, axis1=1, axis2=2), 0.0))
    root[root == 0.0] = 1.0
    scaled = block / (root[:, :, None] * root[:, None, :])
    try:
        out = np.linalg.inv(np.linalg.cholesky(scaled))
        # the trace of the inverse is at least the inverse of the least eigenvalue
        sound = np.einsum("nij,nij->n", out, out) < _SOUND / DETERMINED
    except np.linalg.LinAlgError:
        out = np.zeros_like(scaled)
        sound = np.zeros(len(m), dtype=np.bool_)
    for k in np.flatnonzero(~sound):
        values, vectors = np.linalg.eigh(scaled[k])
        kept = values > DETERMINED
        inverse_root = np.where(kept, 1.0 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
        out[k] = inverse_root[:, None] * vectors.T
    return np.asarray(out / root[:, None, :])


@dataclass(frozen=True, slots=True, eq=False)
class Separate:
    """φ(M) = the least over pairs of uᵀ M u: the weakest non-centrality.

    What an effect of the size β adds to the sum of squares beyond what the model and its rival
    can explain; the power of the test between the two grows with it. Atkinson & Fedorov (1975),
    Biometrika 62(1), T-optimality, for linear rivals.

    Attributes:
        pairs: what is to be separated.
    """

    pairs: tuple[Pair, ...]
    name = "separate"
    monotone = True
    kinked = True

    def __post_init__(self) -> None:
        """Refuse an empty list."""
        if not self.pairs:
            raise InputError("no pair of effects to separate")

    def parts(self, m: Floats) -> Floats:
        """Return (..., N) the non-centrality of each pair, of (..., P, P) matrices.

        βᵀ M_ee β − |L⁻¹ M_ne β|² with M_nn = L Lᵀ.
        """
        flat = m.reshape(-1, *m.shape[-2:])
        out = np.empty((len(flat), len(self.pairs)))
        groups: dict[bytes, list[int]] = {}
        for k, pair in enumerate(self.pairs):
            groups.setdefault(pair.nuisance.tobytes(), []).append(k)
        for members in groups.values():
            nuisance = self.pairs[members[0]].nuisance
            beta = np.zeros((m.shape[-1], len(members)))
            for j, k in enumerate(members):
                beta[self.pairs[k].effect, j] = self.pairs[k].beta
            moved = flat @ beta
            explained = _factor(flat, nuisance) @ moved[:, nuisance]
            out[:, members] = np.einsum("pj,npj->nj", beta, moved)
            out[:, members] -= np.einsum("nfj,nfj->nj", explained, explained)
        return np.maximum(out, 0.0).reshape(*m.shape[:-2], len(self.pairs))

    def _solved(self, m: Floats) -> list[tuple[Pair, Floats]]:
        """Return the pairs with the inverse (P, P) of their nuisance; pairs share them."""
        known: dict[bytes, Floats] = {}
        for pair in self.pairs:
            key = pair.nuisance.tobytes()
            if key not in known:
                known[key] = _solver(m, pair.nuisance)
        return [(pair, known[pair.nuisance.tobytes()]) for pair in self.pairs]

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        return np.asarray(self.parts(m).min(axis=-1))

    def gradient(self, m: Floats) -> Floats:
        """Return (P, P) u uᵀ of the weakest pair."""
        u = self.pairs[int(np.argmin(self.parts(m)))].best(m)[0]
        return np.outer(u, u)

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = the smooth least / φ(m)."""
        parts = self.parts(m)
        scale = max(float(parts.min()), 1e-14 * float(parts.max()))
        return lambda m: self._smooth(m, order * scale, scale)

    def _smooth(self, m: Floats, width: float, scale: float) -> Smooth | None:
        """Return the smooth least of the pairs, its derivative Σ p u uᵀ."""
        found = [(pair.left(m, solver), solver) for pair, solver in self._solved(m)]
        us = np.array([u for u, _ in found])
        parts = np.einsum("ni,ij,nj->n", us, m, us)
        if not np.isfinite(parts).all() or width <= 0.0:
            return None
        value, p = soft_least(parts, width)
        gradient = (us.T * p) @ us
        # F'' = Σ p s'' − Σ p²/μ (s' − mean)(s' − mean)ᵀ, the mean weighted by p²
        share = p**2 / float(p @ p)
        mean = (us.T * share) @ us
        squares = [
            (-p_i * p_i / (width * scale), np.outer(u, u) - mean)
            for p_i, u in zip(p, us, strict=True)
            if p_i > _FELT
        ]
        products = [
            (-2.0 * p_i / scale, u, solver)
            for p_i, (u, solver) in zip(p, found, strict=True)
            if p_i > _FELT
        ]
        return Smooth(value / scale, gradient / scale, tuple(products), tuple(squares), gradient)

    def sure(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse pairs that no candidate separates."""
        for pair in self.pairs:
            u = pair.best(m)[0]
            alone = np.zeros(len(m))
            alone[pair.effect] = pair.beta
            if float(u @ m @ u) <= DETERMINED * float(alone @ m @ alone) or not np.any(m @ alone):
                raise CannotAnswerError(
                    f"no candidate separates {pair.name}; allow other poses or loads"
                )
