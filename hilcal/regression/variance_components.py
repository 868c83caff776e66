"""Variance components of a whitened residual beside a fitted linear model, by REML.

The residual of a model with the whitened columns B and the ridge Λ of their priors is taken as

    y ~ N(B θ, Σ),    Σ = 1 + Σ_i s_i K_i,    s_i ≥ 0

with known block-diagonal matrices K_i: what a further source of scatter of unit variance would add
to the whitened noise. The s_i maximise the restricted likelihood, in which the parameters of the
model are integrated out, so that those that were fitted cost degrees of freedom:

    −2 ℓ = log det Σ + log det H + yᵀ P y,
    P = Σ⁻¹ − Σ⁻¹ B H⁻¹ Bᵀ Σ⁻¹,    H = Bᵀ Σ⁻¹ B + Λ

    ∂ℓ/∂s_i = −½ [tr(P K_i) − yᵀ P K_i P y],    AI_ij = ½ yᵀ P K_i P K_j P y

The maximum is found by Newton's method with the average information AI, steps halved until ℓ does
not fall, components at zero held there while their slope is negative. AI⁻¹ is the covariance of
the s_i. Since P enters by its diagonal blocks alone, a step costs two products of B.

Sources: Patterson and Thompson, *Recovery of inter-block information when block sizes are unequal*,
Biometrika 58 (1971) 545-554; Gilmour, Thompson and Cullis, *Average information REML*, Biometrics
51 (1995) 1440-1450; Searle, Casella and McCulloch, *Variance Components* (1992), chapter 6.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.regression.schur import inverse_root, positive_solve
from hilcal.types import Floats

STEPS = 50
"""Most Newton steps; a choice, fewer than ten are usual."""
HALVINGS = 12
"""Most halvings of a step; a choice."""
CONVERGED = 1e-6
"""Gain of ℓ that ends the iteration: the s_i are then within 0.002 of their σ; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockRows:
    """Whitened rows in blocks of one size, G blocks of S rows.

    Attributes:
        y: (G, S) residual.
        rows: (G, S, K) columns B of the model.
        components: (C, G, S, S) blocks of the K_i.
    """

    y: Floats
    rows: Floats
    components: Floats


@dataclass(frozen=True, slots=True, eq=False)
class VarianceComponents:
    """Result of the maximisation.

    Attributes:
        variance: (C,) s_i.
        covariance: (C, C) of the s_i; zero for one that is held at zero.
        log_likelihood: gain of ℓ over all s_i = 0.
    """

    variance: Floats
    covariance: Floats
    log_likelihood: float


def variance_components(blocks: Sequence[BlockRows], ridge: Floats) -> VarianceComponents:
    """Maximise the restricted likelihood.

    Args:
        ridge: (K,) Λ, zero for a column without a prior.
    """
    count = len(blocks[0].components)
    zero = _at(blocks, ridge, np.zeros(count))
    here = _at(blocks, ridge, _start(blocks, zero))
    if here.log_likelihood < zero.log_likelihood:
        here = zero
    for _ in range(STEPS):
        following = _step(blocks, ridge, here)
        gain = following.log_likelihood - here.log_likelihood
        here = following
        if gain < CONVERGED:
            break
    free = here.variance > 0
    covariance = np.zeros((count, count))
    inner = here.information[np.ix_(free, free)]
    covariance[np.ix_(free, free)] = positive_solve(inner, np.eye(len(inner)))
    gained = here.log_likelihood - zero.log_likelihood
    return VarianceComponents(here.variance, covariance, gained)


@dataclass(frozen=True, slots=True, eq=False)
class _RemlPoint:
    """The s_i, ℓ, its slope (C,) and AI (C, C)."""

    variance: Floats
    log_likelihood: float
    slope: Floats
    information: Floats


def _start(blocks: Sequence[BlockRows], zero: _RemlPoint) -> Floats:
    """Each component alone would explain the excess of yᵀPy; all together share it."""
    reach = sum(np.einsum("cgii->c", b.components) for b in blocks)
    size = sum(b.y.size for b in blocks)
    square = sum(float(np.sum(b.y**2)) for b in blocks)
    excess = max(square - size, 0.1 * size)
    return np.asarray(excess / np.maximum(reach, 1e-300) / len(zero.variance))


def _step(blocks: Sequence[BlockRows], ridge: Floats, here: _RemlPoint) -> _RemlPoint:
    """Go up, half as far each time while ℓ falls."""
    free = (here.variance > 0) | (here.slope > 0)
    if not free.any():
        return here
    full = np.zeros_like(here.variance)
    inner = here.information[np.ix_(free, free)]
    full[free] = positive_solve(inner, here.slope[free])
    if float(full @ here.slope) <= 0:
        full = np.where(free, here.slope / np.maximum(np.diag(here.information), 1e-300), 0.0)
    for halving in range(HALVINGS):
        trial = np.maximum(here.variance + 0.5**halving * full, 0.0)
        there = _at(blocks, ridge, trial)
        if there.log_likelihood >= here.log_likelihood:
            return there
    return here


def _at(blocks: Sequence[BlockRows], ridge: Floats, variance: Floats) -> _RemlPoint:
    """Evaluate ℓ, its slope and AI."""
    inverses, log_det = [], 0.0
    h = np.diag(ridge).astype(float)
    for b in blocks:
        sigma = np.eye(b.y.shape[1]) + np.tensordot(variance, b.components, axes=1)
        low = np.linalg.cholesky(sigma)  # at least 1
        log_det += 2 * float(np.log(np.diagonal(low, axis1=1, axis2=2)).sum())
        root = np.linalg.inv(low)
        inverses.append(np.swapaxes(root, 1, 2) @ root)
        white = _flat(root @ b.rows)
        h += white.T @ white
    t = inverse_root(h)
    log_det += _log_det(t)
    weighted = [_flat(inverse @ b.rows) for inverse, b in zip(inverses, blocks, strict=True)]

    def project(x: list[Floats]) -> list[Floats]:
        """P x of columns (G, S, Q)."""
        cross = sum(w.T @ _flat(part) for w, part in zip(weighted, x, strict=True))
        step = t.T @ (t @ cross)
        parts = zip(inverses, weighted, x, strict=True)
        return [inverse @ part - (w @ step).reshape(part.shape) for inverse, w, part in parts]

    py = [part[:, :, 0] for part in project([b.y[:, :, None] for b in blocks])]
    square = sum(float(np.sum(b.y * p)) for b, p in zip(blocks, py, strict=True))
    trace = np.zeros(len(variance))
    moved = []
    for b, inverse, w, p in zip(blocks, inverses, weighted, py, strict=True):
        seen = (w @ t.T).reshape(*b.y.shape, len(t))
        own = inverse - seen @ np.swapaxes(seen, 1, 2)
        trace += np.einsum("gij,cgji->c", own, b.components)
        moved.append(np.einsum("cgij,gj->gic", b.components, p))
    turned = project(moved)
    pairs = list(zip(moved, py, strict=True))
    quadratic = sum(np.einsum("gic,gi->c", u, p) for u, p in pairs)
    information = sum(np.einsum("gic,gid->cd", u, v) for u, v in zip(moved, turned, strict=True))
    return _RemlPoint(
        variance,
        -0.5 * (log_det + square),
        np.asarray(-0.5 * (trace - quadratic)),
        np.asarray(0.25 * (information + np.transpose(information))),
    )


def _flat(x: Floats) -> Floats:
    """(G·S, Q) rows of blocks (G, S, Q)."""
    return x.reshape(-1, x.shape[2])


def _log_det(t: Floats) -> float:
    """Return log det H on its range, of T with Tᵀ T = H⁻."""
    triangular = not np.triu(t, 1).any()
    values = np.abs(np.diag(t)) if triangular else np.linalg.svd(t, compute_uv=False)
    return float(-2 * np.log(values[values > 0]).sum())
