"""T-optimality: the criterion of plans that separate effects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np

from hilcal.design.bound import total_information
from hilcal.design.candidate_set import CandidateSet
from hilcal.design.criterion import Criterion, Root, Smooth, soft_least
from hilcal.errors import CannotAnswerError, InputError
from hilcal.regression.schur import DETERMINED, inverse_root, nuisance_inverse
from hilcal.types import Floats, Ints

_FELT = 1e-5  # weight from which a pair enters the curvature


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """An effect that is there, and the parameters that are fitted in its place."""

    effect: Ints  # (E,) indices of the effect's parameters
    beta: Floats  # (E,) their values
    nuisance: Ints  # (F,) indices of the parameters of the model and of the rival effect
    name: str = "an effect from its rival"  # for messages where no candidate separates the two

    def __post_init__(self) -> None:
        """Refuse indices and values that do not belong together."""
        if len(self.effect) != len(self.beta) or not np.any(self.beta):
            raise InputError(
                f"{self.name}: {len(self.beta)} values of {len(self.effect)} parameters; valid: "
                "one of each, not all zero"
            )
        if len(np.intersect1d(self.effect, self.nuisance)):
            raise InputError(f"{self.name}: a parameter is on both sides")

    def residual(self, m: Floats) -> Floats:
        """Return the parameters u (P,) of the residual after model and rival are fitted.

        u has β at the effect and −M_nn⁻ M_ne β at the nuisance: uᵀ M u = βᵀ S β is the minimum of
        vᵀ M v over all v with β at the effect, with S the Schur complement of the nuisance.

        m: (P, P) information M.
        """
        u = np.zeros(len(m))
        u[self.effect] = self.beta
        return u - nuisance_inverse(m, self.nuisance) @ (m @ u)


@dataclass(frozen=True, eq=False)
class Separate(Criterion):
    """φ(M) = the least over pairs of uᵀ M u: the weakest non-centrality.

    What an effect of the size β adds to the sum of squares beyond what the model and its rival
    can explain; the power of the test between the two grows with it. Atkinson & Fedorov (1975),
    Biometrika 62(1), T-optimality, for linear rivals.
    """

    pairs: tuple[Pair, ...]  # what is to be separated
    name = "separate"
    monotone = True
    kinked = True

    def __post_init__(self) -> None:
        """Refuse an empty list."""
        if not self.pairs:
            raise InputError("no pair of effects to separate")

    @cached_property
    def _common(self) -> Ints:
        """The nuisance of all pairs: the model."""
        return reduce(np.intersect1d, (pair.nuisance for pair in self.pairs))

    @cached_property
    def _groups(self) -> tuple[tuple[Ints, Ints], ...]:
        """The rest of their nuisance, the rival, and which pairs have it."""
        out: dict[bytes, tuple[Ints, list[int]]] = {}
        for k, pair in enumerate(self.pairs):
            rival = np.setdiff1d(pair.nuisance, self._common)
            out.setdefault(rival.tobytes(), (rival, []))[1].append(k)
        return tuple((rival, np.array(which)) for rival, which in out.values())

    @cached_property
    def _betas(self) -> Floats:
        """(N, P) parameters of the effect of each pair, zero elsewhere."""
        out = np.zeros((len(self.pairs), 1 + max(int(p.effect.max()) for p in self.pairs)))
        for row, pair in zip(out, self.pairs, strict=True):
            row[pair.effect] = pair.beta
        return out

    def parts(self, m: Floats) -> Floats:
        """Return (..., N) the non-centrality of each pair, of (..., P, P) matrices.

        βᵀ S_ee β − |T S_fe β|² with S what is left beyond the model, S_ff⁻ = Tᵀ T of the rival.
        """
        flat = m.reshape(-1, *m.shape[-2:])
        out = np.empty((len(flat), len(self.pairs)))
        betas = np.zeros((len(self.pairs), m.shape[-1]))
        betas[:, : self._betas.shape[1]] = self._betas
        rest = np.setdiff1d(np.arange(m.shape[-1]), self._common)
        known = flat[:, rest[:, None], rest]
        left = known - _explained(flat, self._common, rest)
        for rival, which in self._groups:
            beta, own = betas[which][:, rest].T, np.searchsorted(rest, rival)
            moved = left @ beta
            explained = _rival_root(left, known, own) @ moved[:, own]
            out[:, which] = np.einsum("pj,npj->nj", beta, moved)
            out[:, which] -= np.einsum("nfj,nfj->nj", explained, explained)
        return np.maximum(out, 0.0).reshape(*m.shape[:-2], len(self.pairs))

    def _solved(self, m: Floats) -> tuple[Floats, Root, list[tuple[Ints, Root]]]:
        """Return the residuals (N, P) of the pairs, and roots of the inverse of their nuisance.

        M_nn⁻ is that of the model, the same for all, and by rival what it adds: L S_ff⁻ Lᵀ with
        L = (−M_mm⁻ M_mf, 1).
        """
        size, model = len(m), self._common
        own = np.zeros((size, len(model)))
        own[model] = inverse_root(m[np.ix_(model, model)]).T
        us = np.zeros((len(self.pairs), size))
        us[:, : self._betas.shape[1]] = self._betas
        us -= (us @ m @ own) @ own.T
        added = []
        for rival, which in self._groups:
            if not len(rival):
                continue
            lift = np.eye(size)[:, rival]
            lift -= own @ (own.T @ m[:, rival])
            left, known = m[rival] @ lift, m[np.ix_(rival, rival)]
            root = lift @ _rival_root(left[None], known[None], np.arange(len(rival)))[0].T
            us[which] -= (us[which] @ m @ root) @ root.T
            added.append((which, Root(root)))
        return us, Root(own), added

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
        us, own, added = self._solved(m)
        parts = np.einsum("ni,ij,nj->n", us, m, us)
        if not np.isfinite(parts).all() or width <= 0.0:
            return None
        value, p = soft_least(parts, width)
        gradient = (us.T * p) @ us
        # F'' = Σ p s'' − Σ p²/μ (s' − mean)(s' − mean)ᵀ, the mean weighted by p²
        felt = p > _FELT
        about = np.eye(int(felt.sum())) - p[felt] ** 2 / float(p[felt] @ p[felt])
        curved = -(about.T * p[felt] ** 2) @ about / (width * scale)
        weighted = us.T * np.sqrt(np.where(felt, p, 0.0))
        products = [(-2.0 / scale, Root(weighted[:, felt]), own)]
        products += [
            (-2.0 / scale, Root(weighted[:, which[felt[which]]]), root)
            for which, root in added
            if felt[which].any()
        ]
        squares = ((curved, us[felt].T),)
        return Smooth(value / scale, gradient / scale, tuple(products), squares, gradient)

    def relevant(self, units: CandidateSet, prior: Floats, budget: float) -> "Separate":
        """Return φ without the pairs that what is known already separates well enough.

        No plan brings the weakest pair over the least of the bounds uᵀ M0 u + B max |A_k u|² / c_k
        of single pairs (see `bound.upper_bound`), and no pair falls below its value at M0.
        """
        spread = prior + total_information(
            units, np.full(len(units), budget / float(units.cost.sum()))
        )
        us = self._solved(spread)[0]
        seen = (units.rows.reshape(-1, units.size) @ us.T).reshape(len(units), -1, len(us))
        gain = np.sum(seen**2, axis=1) / units.cost[:, None]
        known = np.einsum("ni,ij,nj->n", us, prior, us)
        most = float(np.min(known + budget * gain.max(axis=0)))
        felt = self.parts(prior) <= most
        return Separate(tuple(p for p, f in zip(self.pairs, felt, strict=True) if f))

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


def _explained(m: Floats, model: Ints, rest: Ints) -> Floats:
    """Return (N, R, R) what the model explains of the rest of matrices M: M_rm M_mm⁻ M_mr."""
    cross = m[:, model[:, None], rest]
    # one by one: of large blocks that is faster than all at once
    seen = np.stack(
        [inverse_root(b) @ c for b, c in zip(m[:, model[:, None], model], cross, strict=True)]
    )
    return np.asarray(np.swapaxes(seen, -1, -2) @ seen)


def _rival_root(left: Floats, m: Floats, rival: Ints) -> Floats:
    """Return T (N, F, F) with Tᵀ T = S_ff⁻ of what is left beyond the model of matrices M.

    A parameter of which the model leaves less than `DETERMINED` is none beside it.
    """
    block = left[:, rival[:, None], rival].copy()
    lost = block[:, range(len(rival)), range(len(rival))] <= DETERMINED * m[:, rival, rival]
    block[lost[:, :, None] | lost[:, None, :]] = 0.0
    return inverse_root(block)


def condensed(
    units: CandidateSet, pairs: Sequence[Pair], prior: Floats
) -> tuple[CandidateSet, tuple[Pair, ...], Floats]:
    """Return the same problem by fewer parameters, in which its information is well conditioned.

    The model, common to the nuisance of all pairs, is made orthogonal by the information of all
    units together, and so is each suspect beyond the model. Directions that no unit determines
    are dropped: as a nuisance they explain nothing, as an effect they show nothing. Every
    non-centrality of every plan stays what it is.

    units: what can be taken, by the P parameters; prior: (P, P) what is known before.
    """
    model = pairs[0].nuisance
    for pair in pairs:
        model = np.intersect1d(model, pair.nuisance)
    m = prior + total_information(units, np.full(len(units), 1.0 / float(units.cost.sum())))
    blocks = {model.tobytes(): model}
    for pair in pairs:
        for block in (pair.effect, np.setdiff1d(pair.nuisance, model)):
            blocks.setdefault(block.tobytes(), block)
    beyond = np.eye(len(m)) - nuisance_inverse(m, model) @ m
    columns, back, place, at = [], {}, {}, 0
    for key, block in blocks.items():
        lift = np.eye(len(m))[:, block] if block is model else beyond[:, block]
        scale = np.sqrt(np.maximum(np.diag(m)[block], np.finfo(float).tiny))
        values, vectors = np.linalg.eigh((lift.T @ m @ lift) / np.outer(scale, scale))
        kept = values > DETERMINED
        columns.append(lift @ (vectors[:, kept] / scale[:, None]))
        back[key] = vectors[:, kept].T * scale
        place[key] = np.arange(at, at + int(kept.sum()))
        at += int(kept.sum())
    turn = np.hstack(columns)

    def turned(pair: Pair) -> Pair:
        effect = pair.effect.tobytes()
        rival = place[np.setdiff1d(pair.nuisance, model).tobytes()]
        nuisance = np.concatenate([place[model.tobytes()], rival])
        return Pair(place[effect], back[effect] @ pair.beta, nuisance, pair.name)

    rows = np.ascontiguousarray(units.rows @ turn)
    known = turn.T @ prior @ turn
    return CandidateSet(rows, units.cost), tuple(map(turned, pairs)), 0.5 * (known + known.T)
