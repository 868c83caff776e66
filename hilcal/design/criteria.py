"""Criteria of a plan: determinant, mean variance, eigenvalues, and separation of effects."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np

from hilcal.design.criterion import (
    CandidateSet,
    Criterion,
    Pair,
    Smooth,
    factors,
    inverse_factor,
    soft_min,
)
from hilcal.errors import CannotAnswerError
from hilcal.regression.schur import (
    DETERMINED,
    differentiable_schur_complement,
    inverse_root,
    nuisance_inverse,
    schur_complement,
)
from hilcal.types import Floats, Ints


class SmoothCriterion(Criterion):
    """A differentiable criterion: it is its own surrogate, f = log φ."""

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
    Research 10(6). With `model`, the compound criterion det(M)^(1/2P) · det(M_ss)^(1/2s).
    """

    model: int | None = None  # s, the first parameters; None: one determinant
    name = "D"

    def blocks(self, size: int) -> tuple[tuple[float, Ints], ...]:
        """Return exponents and indices of the determinants, for P = `size`."""
        if self.model is None:
            return ((1.0 / size, np.arange(size)),)
        return (0.5 / size, np.arange(size)), (0.5 / self.model, np.arange(self.model))

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        flat = m.reshape(-1, *m.shape[-2:])
        log, good = np.zeros(len(flat)), np.ones(len(flat), dtype=np.bool_)
        for c, index in self.blocks(m.shape[-1]):
            factor, regular = factors(flat[:, index[:, None], index])
            log += 2.0 * c * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
            good &= regular
        phi = np.where(good, np.exp(np.where(good, log, 0.0)), 0.0)
        return np.asarray(phi.reshape(m.shape[:-2]))

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = log φ with gradient Σ c M_bb⁻¹."""
        value, gradient = 0.0, np.zeros_like(m)
        products: list[tuple[float, Floats, Floats]] = []
        for c, index in self.blocks(len(m)):
            inverted = inverse_factor(m[np.ix_(index, index)])
            if inverted is None:
                return None
            root = np.zeros((len(m), len(index)))
            root[index] = inverted[0]
            value += c * inverted[1]
            gradient += c * root @ root.T
            products.append((-c, root, root))
        return Smooth(value, gradient, tuple(products), (), float(np.exp(value)) * gradient)


@dataclass(frozen=True, eq=False)
class MeanVariance(SmoothCriterion):
    """φ(M) = 1 / tr(C M⁻¹), the inverse of a mean variance: A- and I-optimality.

    With C = 1/s at s parameters it is O5 of Sun & Hollerbach (2008), IEEE ICRA; with C the mean of
    VᵀV over prediction poses, V the Jacobian of the position, the mean predicted variance:
    Atkinson, Donev and Tobias, *Optimum Experimental Designs, with SAS* (2007), chapter 10. With
    `model`, the compound criterion 1 / (tr(C M⁻¹) + tr(C_s M_ss⁻¹)).
    """

    c: Floats  # (P, P) C, positive semidefinite
    name: str = "I"
    model: Floats | None = None  # (s, s) C_s of the first parameters; None: no second term
    rest: float = 0.0  # mean variance beside tr(C M⁻¹) that no unit lowers; not in φ

    def std(self, m: Floats) -> float:
        """Return the RMS standard uncertainty at M (P, P), with `rest`; infinite where singular."""
        value = float(self.value(m))
        return float(np.sqrt(1.0 / value + self.rest)) if value > 0.0 else float(np.inf)

    @cached_property
    def roots(self) -> tuple[Floats, ...]:
        """Roots (b, r) of the matrices C of M_bb⁻¹, b the first parameters."""
        out = []
        for c in (self.c,) if self.model is None else (self.c, self.model):
            values, vectors = np.linalg.eigh(c)
            positive = values > 1e-15 * values[-1]
            out.append(vectors[:, positive] * np.sqrt(values[positive]))
        return tuple(out)

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices; 0 where singular."""
        flat = m.reshape(-1, *m.shape[-2:])
        q, good = np.zeros(len(flat)), np.ones(len(flat), dtype=np.bool_)
        for root in self.roots:
            factor, regular = factors(flat[:, : len(root), : len(root)])
            q += np.sum((np.linalg.inv(factor) @ root) ** 2, axis=(1, 2))
            good &= regular
        good &= q > 0.0
        return np.asarray(np.where(good, 1.0 / np.where(good, q, 1.0), 0.0).reshape(m.shape[:-2]))

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = −log q with gradient Σ M_bb⁻¹ C M_bb⁻¹ / q."""
        pairs: list[tuple[Floats, Floats]] = []  # roots of M_bb⁻¹ C M_bb⁻¹ and of M_bb⁻¹
        q = 0.0
        for c in self.roots:
            b = len(c)
            inverted = inverse_factor(m[:b, :b])
            if inverted is None:
                return None
            half = inverted[0].T @ c
            q += float(np.sum(half**2))
            unused = ((0, len(m) - b), (0, 0))
            pairs.append((np.pad(inverted[0] @ half, unused), np.pad(inverted[0], unused)))
        if not q > 0.0:
            return None
        v = np.hstack([inner for inner, _ in pairs])
        gradient = v @ v.T / q
        products = tuple((-2.0 / q, inner, root) for inner, root in pairs)
        squares = ((np.full((v.shape[1],) * 2, q**-2), v),)
        return Smooth(-float(np.log(q)), gradient, products, squares, gradient / q)


_FLOOR = 1e-14


@dataclass(frozen=True, slots=True, eq=False)
class E(Criterion):
    """φ(M) = λ_min(S): the worst-determined direction of the parameters of interest.

    O3 of Nahvi & Hollerbach (1996), IEEE ICRA; S is the Schur complement of the other parameters.
    The surrogate is the barrier of the semidefinite program max t, S ⪰ t 1: F = max over t of t + μ
    log det(S − t 1), whose gradient Z = μ (S − t 1)⁻¹ has trace 1: λ_min(N) ≤ tr(Z N).
    """

    interest: Ints | None = None  # indices of the parameters of interest; all by default
    name = "E"

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        s = m if self.interest is None else schur_complement(m, self.interest)
        return np.asarray(np.maximum(np.linalg.eigvalsh(s)[..., 0], 0.0))

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = F / λ_min(m) with μ = order · λ_min(m)."""
        values = np.linalg.eigvalsh(differentiable_schur_complement(m, self.interest).matrix)
        scale = max(float(values[0]), _FLOOR * float(values[-1]))

        def smooth(m: Floats) -> Smooth | None:
            s = differentiable_schur_complement(m, self.interest)
            values, vectors = np.linalg.eigh(s.matrix)
            part = _smooth_min(values, s.lift @ vectors, order * scale)
            if s.inverse is not None and self.interest is not None:
                nuisance = np.setdiff1d(np.arange(len(m)), self.interest)
                root = np.zeros((len(m), len(nuisance)))
                root[nuisance] = inverse_root(m[np.ix_(nuisance, nuisance)]).T
                lifted = (-2.0, part.products[0][1], root)
                part = replace(part, products=(*part.products, lifted))
            return part.scaled(1.0 / scale)

        return smooth


@dataclass(frozen=True, slots=True, eq=False)
class K(Criterion):
    """φ(M) = λ_min(M) / λ_max(M), the inverse of the condition number.

    The square of O2 of Driels & Pathre (1990), J. Robotic Systems 7(2). Quasi-concave: the
    surrogate is F_min − κ F_max with the current ratio κ (Dinkelbach 1967). With
    the densities Z and Y of the extreme eigenvalues, φ(N) ≤ tr(Z N) / tr(Y N).
    """

    name = "K"
    monotone = False

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
            least = _smooth_min(values, vectors, order * scale)
            largest = _smooth_min(-values, vectors, order * most)  # F_max(M) = −F_min(−M)
            a, b = least.scaled(1.0 / scale), largest.scaled(ratio / scale)
            return Smooth(
                a.value + b.value, a.gradient - b.gradient, a.products + b.products,
                a.squares + b.squares, least.gradient, largest.gradient,
            )  # fmt: skip

        return smooth


def _smooth_min(values: Floats, vectors: Floats, width: float) -> Smooth:
    """Return the smooth least of eigenvalues (I,), with vectors (P, I) lifted to the space of M.

    With S = M − t 1, μ the width, the second derivative is

        −μ tr(S⁻¹ H_k S⁻¹ H_l) + μ tr(S⁻² H_k) tr(S⁻² H_l) / tr(S⁻²)
    """
    value, p = soft_min(values, width)
    root = vectors * np.sqrt(p)
    gradient = root @ root.T
    squares = (np.outer(p**2, p**2) / (width * float(p @ p)), vectors)
    return Smooth(value, gradient, ((-1.0 / width, root, root),), (squares,), gradient)


_LEAST_WEIGHT = 1e-5  # weight above which a pair enters the curvature


@dataclass(frozen=True, eq=False)
class Separate(Criterion):
    """φ(M) = the least over pairs of uᵀ M u: the weakest non-centrality.

    The non-centrality is the sum of squares of an effect of size β that the model and the rival do
    not explain. Atkinson & Fedorov (1975), Biometrika 62(1), T-optimality, for linear rivals.
    """

    pairs: tuple[Pair, ...]  # to be separated, one or more
    name = "separate"

    @cached_property
    def _common(self) -> Ints:
        """The nuisance parameters common to all pairs: the model."""
        return reduce(np.intersect1d, (pair.nuisance for pair in self.pairs))

    @cached_property
    def _groups(self) -> tuple[tuple[Ints, Ints], ...]:
        """Per rival effect: its parameters, and the indices of its pairs."""
        out: dict[bytes, tuple[Ints, list[int]]] = {}
        for k, pair in enumerate(self.pairs):
            rival = np.setdiff1d(pair.nuisance, self._common)
            out.setdefault(rival.tobytes(), (rival, []))[1].append(k)
        return tuple((rival, np.array(which)) for rival, which in out.values())

    @cached_property
    def _betas(self) -> Floats:
        """(N, P) β of each pair's effect, zero elsewhere."""
        out = np.zeros((len(self.pairs), 1 + max(int(p.effect.max()) for p in self.pairs)))
        for row, pair in zip(out, self.pairs, strict=True):
            row[pair.effect] = pair.beta
        return out

    def parts(self, m: Floats) -> Floats:
        """Return (..., N) the non-centrality of each pair, of (..., P, P) matrices.

        βᵀ S_ee β − |T S_fe β|² with S the Schur complement of the model, S_ff⁻ = Tᵀ T of the rival.
        """
        flat = m.reshape(-1, *m.shape[-2:])
        out = np.empty((len(flat), len(self.pairs)))
        betas = np.zeros((len(self.pairs), m.shape[-1]))
        betas[:, : self._betas.shape[1]] = self._betas
        outside = np.setdiff1d(np.arange(m.shape[-1]), self._common)
        block = flat[:, outside[:, None], outside]
        schur = block - _explained(flat, self._common, outside)
        for rival, which in self._groups:
            beta, of_rival = betas[which][:, outside].T, np.searchsorted(outside, rival)
            moved = schur @ beta
            explained = _rival_root(schur, block, of_rival) @ moved[:, of_rival]
            out[:, which] = np.einsum("pj,npj->nj", beta, moved)
            out[:, which] -= np.einsum("nfj,nfj->nj", explained, explained)
        return np.maximum(out, 0.0).reshape(*m.shape[:-2], len(self.pairs))

    def _solved(self, m: Floats) -> tuple[Floats, Floats, list[tuple[Ints, Floats]]]:
        """Return the residuals u (N, P) of the pairs, and roots of their M_nn⁻.

        M_nn⁻ = M_mm⁻ of the model + L S_ff⁻ Lᵀ of the rival, with L = (−M_mm⁻ M_mf, 1). The root of
        the first term is common; the second comes with the indices of the rival's pairs.
        """
        size, model = len(m), self._common
        model_root = np.zeros((size, len(model)))
        model_root[model] = inverse_root(m[np.ix_(model, model)]).T
        us = np.zeros((len(self.pairs), size))
        us[:, : self._betas.shape[1]] = self._betas
        us -= (us @ m @ model_root) @ model_root.T
        added = []
        for rival, which in self._groups:
            if not len(rival):
                continue
            lift = np.eye(size)[:, rival]
            lift -= model_root @ (model_root.T @ m[:, rival])
            schur, block = m[rival] @ lift, m[np.ix_(rival, rival)]
            root = lift @ _rival_root(schur[None], block[None], np.arange(len(rival)))[0].T
            us[which] -= (us[which] @ m @ root) @ root.T
            added.append((which, root))
        return us, model_root, added

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        return np.asarray(self.parts(m).min(axis=-1))

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = the smooth least / φ(m)."""
        parts = self.parts(m)
        scale = max(float(parts.min()), 1e-14 * float(parts.max()))
        return lambda m: self._smooth(m, order * scale, scale)

    def _smooth(self, m: Floats, width: float, scale: float) -> Smooth | None:
        """Return the smooth least of the pairs, with derivative Σ p u uᵀ."""
        us, model_root, added = self._solved(m)
        parts = np.einsum("ni,ij,nj->n", us, m, us)
        if not np.isfinite(parts).all() or width <= 0.0:
            return None
        value, p = soft_min(parts, width)
        gradient = (us.T * p) @ us
        # F'' = Σ p s'' − Σ p²/μ (s' − mean)(s' − mean)ᵀ, the mean weighted by p²
        counted = p > _LEAST_WEIGHT
        centred = np.eye(int(counted.sum())) - p[counted] ** 2 / float(p[counted] @ p[counted])
        curved = -(centred.T * p[counted] ** 2) @ centred / (width * scale)
        weighted = us.T * np.sqrt(np.where(counted, p, 0.0))
        products = [(-2.0 / scale, weighted[:, counted], model_root)]
        products += [
            (-2.0 / scale, weighted[:, which[counted[which]]], root)
            for which, root in added
            if counted[which].any()
        ]
        squares = ((curved, us[counted].T),)
        return Smooth(value / scale, gradient / scale, tuple(products), squares, gradient)

    def relevant(self, units: CandidateSet, prior: Floats, budget: float) -> "Separate":
        """Return φ without the pairs that the prior M0 already separates well enough.

        No plan raises the weakest pair above the least bound uᵀ M0 u + B max |A_k u|² / c_k of a
        pair, and no pair falls below its value at M0.
        """
        spread = prior + units.information(np.full(len(units), budget / float(units.cost.sum())))
        us = self._solved(spread)[0]
        effects = (units.rows.reshape(-1, units.size) @ us.T).reshape(len(units), -1, len(us))
        gain = np.sum(effects**2, axis=1) / units.cost[:, None]
        prior_parts = np.einsum("ni,ij,nj->n", us, prior, us)
        most = float(np.min(prior_parts + budget * gain.max(axis=0)))
        binding = self.parts(prior) <= most
        return Separate(tuple(p for p, bind in zip(self.pairs, binding, strict=True) if bind))

    def require(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse pairs that no candidate separates."""
        for pair in self.pairs:
            u = pair.residual(m)
            alone = np.zeros(len(m))
            alone[pair.effect] = pair.beta
            if float(u @ m @ u) <= DETERMINED * float(alone @ m @ alone) or not np.any(m @ alone):
                both = " from ".join(pair.names)
                raise CannotAnswerError(
                    f"no candidate separates {both}; allow other poses or loads"
                )


def _explained(m: Floats, model: Ints, block: Ints) -> Floats:
    """Return (N, R, R) M_rm M_mm⁻ M_mr: the part of the block r that the model m explains."""
    half = inverse_root(m[:, model[:, None], model]) @ m[:, model[:, None], block]
    return np.asarray(np.swapaxes(half, -1, -2) @ half)


def _rival_root(schur: Floats, m: Floats, rival: Ints) -> Floats:
    """Return T (N, F, F) with Tᵀ T = S_ff⁻, from the Schur complements S of the model in M."""
    block = schur[:, rival[:, None], rival].copy()
    lost = block[:, range(len(rival)), range(len(rival))] <= DETERMINED * m[:, rival, rival]
    block[lost[:, :, None] | lost[:, None, :]] = 0.0
    return inverse_root(block)


def condensed(
    units: CandidateSet, pairs: Sequence[Pair], prior: Floats
) -> tuple[CandidateSet, tuple[Pair, ...], Floats]:
    """Return the same problem in fewer parameters, in which the information is well conditioned.

    The information of all units orthogonalises the model, which is common to the nuisance of all
    pairs, and each suspect beyond the model. Directions that no unit determines are dropped. The
    non-centralities of all plans are unchanged.
    """
    model = reduce(np.intersect1d, (pair.nuisance for pair in pairs))
    m = prior + units.information(np.full(len(units), 1.0 / float(units.cost.sum())))
    blocks = {model.tobytes(): model}
    for pair in pairs:
        for block in (pair.effect, np.setdiff1d(pair.nuisance, model)):
            blocks.setdefault(block.tobytes(), block)
    beyond = np.eye(len(m)) - nuisance_inverse(m, model) @ m
    columns, to_scaled, indices, start = [], {}, {}, 0
    for key, block in blocks.items():
        lift = np.eye(len(m))[:, block] if block is model else beyond[:, block]
        scale = np.sqrt(np.maximum(np.diag(m)[block], np.finfo(float).tiny))
        values, vectors = np.linalg.eigh((lift.T @ m @ lift) / np.outer(scale, scale))
        determined = values > DETERMINED
        columns.append(lift @ (vectors[:, determined] / scale[:, None]))
        to_scaled[key] = vectors[:, determined].T * scale
        indices[key] = np.arange(start, start + int(determined.sum()))
        start += int(determined.sum())
    turn = np.hstack(columns)

    def turned(pair: Pair) -> Pair:
        effect = pair.effect.tobytes()
        rival = indices[np.setdiff1d(pair.nuisance, model).tobytes()]
        nuisance = np.concatenate([indices[model.tobytes()], rival])
        return Pair(indices[effect], to_scaled[effect] @ pair.beta, nuisance, pair.names)

    rows = np.ascontiguousarray(units.rows @ turn)
    prior = turn.T @ prior @ turn
    return CandidateSet(rows, units.cost), tuple(map(turned, pairs)), 0.5 * (prior + prior.T)
