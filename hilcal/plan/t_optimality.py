"""T-optimality: the criterion of plans that separate effects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.errors import CannotAnswerError, InputError
from hilcal.plan.criterion import Criterion, Smooth, soft_least
from hilcal.regression.schur import DETERMINED, inverse_root, nuisance_inverse
from hilcal.types import Floats, Ints

_FELT = 1e-5  # weight from which a pair enters the curvature


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """An effect that is there, and the parameters that are fitted in its place.

    Attributes:
        effect: (E,) indices of the effect's parameters.
        beta: (E,) their values.
        nuisance: (F,) indices of the parameters of the model and of the rival effect.
        name: for messages where no candidate separates the two.
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

    def residual(self, m: Floats, inverse: Floats | None = None) -> Floats:
        """Return the parameters u (P,) of the residual after model and rival are fitted.

        u has β at the effect and −M_nn⁻ M_ne β at the nuisance: uᵀ M u = βᵀ S β is the minimum of
        vᵀ M v over all v with β at the effect, with S the Schur complement of the nuisance.

        Args:
            m: (P, P) information M.
            inverse: (P, P) `nuisance_inverse` where it is known.
        """
        u = np.zeros(len(m))
        u[self.effect] = self.beta
        if inverse is None:
            inverse = nuisance_inverse(m, self.nuisance)
        return u - inverse @ (m @ u)


@dataclass(frozen=True, slots=True, eq=False)
class Separate(Criterion):
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
            explained = inverse_root(flat[:, nuisance[:, None], nuisance]) @ moved[:, nuisance]
            out[:, members] = np.einsum("pj,npj->nj", beta, moved)
            out[:, members] -= np.einsum("nfj,nfj->nj", explained, explained)
        return np.maximum(out, 0.0).reshape(*m.shape[:-2], len(self.pairs))

    def _solved(self, m: Floats) -> list[tuple[Pair, Floats]]:
        """Return the pairs with the inverse (P, P) of their nuisance; pairs share them."""
        known: dict[bytes, Floats] = {}
        for pair in self.pairs:
            key = pair.nuisance.tobytes()
            if key not in known:
                known[key] = nuisance_inverse(m, pair.nuisance)
        return [(pair, known[pair.nuisance.tobytes()]) for pair in self.pairs]

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        return np.asarray(self.parts(m).min(axis=-1))

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = the smooth least / φ(m)."""
        parts = self.parts(m)
        scale = max(float(parts.min()), 1e-14 * float(parts.max()))
        return lambda m: self._smooth(m, order * scale, scale)

    def _smooth(self, m: Floats, width: float, scale: float) -> Smooth | None:
        """Return the smooth least of the pairs, its derivative Σ p u uᵀ."""
        found = [(pair.residual(m, inverse), inverse) for pair, inverse in self._solved(m)]
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
            (-2.0 * p_i / scale, u, inverse)
            for p_i, (u, inverse) in zip(p, found, strict=True)
            if p_i > _FELT
        ]
        return Smooth(value / scale, gradient / scale, tuple(products), tuple(squares), gradient)

    def require(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse pairs that no candidate separates."""
        for pair in self.pairs:
            u = pair.residual(m)
            alone = np.zeros(len(m))
            alone[pair.effect] = pair.beta
            if float(u @ m @ u) <= DETERMINED * float(alone @ m @ alone) or not np.any(m @ alone):
                raise CannotAnswerError(
                    f"no candidate separates {pair.name}; allow other poses or loads"
                )
