"""The continuous optimum over some units: a primal-dual interior-point method."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg as sl

from hilcal.design.bound import prices, upper_bound
from hilcal.design.criterion import Criterion, Root, Smooth
from hilcal.types import Floats

# Choices, usual in interior-point methods (Wright 1997); none has a study of its own.
_STEPS = 80
_BACK = 0.995  # share of the way to the boundary
_CENTRAL = 1.0  # square of Newton's decrement at which μ may fall
_KEPT = 20_000_000  # elements of products that are kept, 160 MB
_CLAMP = 1e4  # how far a dual may be from μ / w


@dataclass(frozen=True, eq=False)
class BarrierProgram:
    """Maximise φ(M0 + Σ w_k A_kᵀA_k) over w with Σ w_k c_k ≤ B, 0 ≤ w_k ≤ most."""

    criterion: Criterion  # φ
    rows: Floats  # (n, R, P) A
    cost: Floats  # (n,) c
    budget: float  # B
    most: float  # bound of each weight; infinity for none
    prior: Floats  # (P, P) M0

    def information(self, weight: Floats) -> Floats:
        """Return (P, P) M."""
        return np.asarray(self.prior + self.change(weight))

    def change(self, weight: Floats) -> Floats:
        """Return (P, P) Σ w_k A_kᵀA_k; weights of either sign."""
        flat = self.rows.reshape(-1, self.rows.shape[2])
        if self._grams is None:
            return np.asarray((flat * np.repeat(weight, self.rows.shape[1])[:, None]).T @ flat)
        out = np.zeros((flat.shape[1], flat.shape[1]))
        up, across = np.triu_indices(len(out))
        out[up, across] = out[across, up] = weight @ self._grams
        return out

    @cached_property
    def _grams(self) -> Floats | None:
        """(n, P (P + 1) / 2) upper triangles of A_kᵀA_k; None where they are too large to keep."""
        up, across = np.triu_indices(self.rows.shape[2])
        if len(self.rows) * len(up) > _KEPT:
            return None
        out = np.empty((len(self.rows), len(up)))
        for k, a in enumerate(self.rows):
            out[k] = (a.T @ a)[up, across]
        return out

    def bound(self, smooth: Smooth) -> float:
        """Return the bound of φ over these units."""
        above = prices(self.rows, smooth.above)
        below = None if smooth.below is None else prices(self.rows, smooth.below)
        return upper_bound(smooth, self.prior, above, self.cost, self.budget, self.most, below)

    def curvature(self, smooth: Smooth) -> Floats:
        """Return (n, n) −∂²f/∂w_k∂w_l, positive semidefinite."""
        n, size, p = self.rows.shape
        flat = self.rows.reshape(-1, p)
        out = np.zeros((n, n))
        for c, x, y in smooth.products:
            out -= c * _product(self.rows, x, y)
        for factor, v in smooth.squares:
            if isinstance(factor, np.ndarray):
                each = np.sum((flat @ v).reshape(n, size, -1) ** 2, axis=1)
                out -= each @ factor @ each.T
            else:
                price = prices(self.rows, v)
                out -= factor * np.outer(price, price)
        return np.asarray(0.5 * (out + out.T))


def _product(rows: Floats, x: Floats | Root, y: Floats | Root) -> Floats:
    """Return (n, n) tr(X H_k Y H_l) of (n, R, P) rows, for semidefinite X and Y (P, P)."""
    n, size = rows.shape[:2]
    flat = rows.reshape(n * size, -1)
    left = flat @ _root(x)
    right = left if y is x else flat @ _root(y)
    if 2 * size * size <= min(left.shape[1], right.shape[1]):  # by the rows
        seen = left @ left.T
        seen *= seen if y is x else right @ right.T
        return np.asarray(seen.reshape(n, size, n, size).sum(axis=3).sum(axis=1))
    # By the matrices T_k = L_xᵀ H_k L_y: the sum of T_k ∘ T_l.
    t = np.matmul(left.reshape(n, size, -1).transpose(0, 2, 1), right.reshape(n, size, -1))
    if y is x:  # symmetric: half of each does
        up, across = np.triu_indices(t.shape[1])
        half = np.take(t.reshape(n, -1), up * t.shape[1] + across, axis=1)
        half *= np.where(up == across, 1.0, np.sqrt(2.0))
        return _gram(half)
    return _gram(t.reshape(n, -1))


def _gram(t: Floats) -> Floats:
    """Return T Tᵀ (n, n)."""
    upper = np.asarray(sl.blas.dsyrk(1.0, t.T, trans=1))
    return upper + np.triu(upper, 1).T


def _root(x: Floats | Root) -> Floats:
    """Return L (P, r) of a semidefinite X = L Lᵀ."""
    if isinstance(x, Root):
        return x.matrix
    size = np.sqrt(np.diag(x))
    there = np.flatnonzero(size > 0.0)
    unit = x[np.ix_(there, there)] / np.outer(size[there], size[there])
    values, vectors = np.linalg.eigh(unit)
    kept = values > 1e-15 * float(values.max(initial=0.0))
    root = np.zeros((len(x), int(kept.sum())))
    root[there] = size[there, None] * vectors[:, kept] * np.sqrt(values[kept])
    return root


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """A continuous optimum."""

    weight: Floats  # (n,) w
    smooth: Smooth  # f there, with the matrices of the bound
    value: float  # φ
    bound: float  # of φ over these units
    order: float

    @property
    def gap(self) -> float:
        """How far φ may be below the optimum, relative."""
        return self.bound / self.value - 1.0 if self.value > 0.0 else np.inf


def solve(program: BarrierProgram, start: Floats, tolerance: float, order: float = 1.0) -> Optimum:
    """Return the optimum to a relative gap.

    Newton's method on the barrier problem f(w) + μ Σ log w_k + μ Σ log(most − w_k), with the
    duals z of the bounds as variables of their own (Wright 1997, Primal-Dual Interior-Point
    Methods), μ falling to 0. Criteria with a kink have a surrogate of order μ.

    start: (n,) weights over 0, under `most`, that spend the budget; tolerance: relative gap at
    which to stop; order: μ n at the start, about the relative gap of the start.
    """
    w, n = start, len(start)
    capped = np.isfinite(program.most)
    m = program.information(w)
    mu = max(min(order, 1.0), tolerance) / n
    z = mu / w
    y = mu / (program.most - w) if capped else np.zeros(n)
    best: Optimum | None = None
    central = False
    for step in range(_STEPS):
        surrogate = program.criterion.surrogate(m, mu)
        smooth = surrogate(m)
        if smooth is None:
            break
        value = float(program.criterion.value(m))
        found = Optimum(w, smooth, value, program.bound(smooth), mu)
        if best is None or found.gap < best.gap:
            best = found
        if found.gap <= tolerance or step == _STEPS - 1:
            break
        if central:
            mu = max(0.2 * mu, 0.1 * tolerance / n)
            central, z, y = False, 0.2 * z, 0.2 * y
            surrogate = program.criterion.surrogate(m, mu)
            smooth = surrogate(m) or smooth
        slope = prices(program.rows, smooth.gradient)
        top = program.most - w if capped else np.ones(n)
        lean = slope + mu / w - (mu / top if capped else 0.0)
        move = _newton(program, program.curvature(smooth) + np.diag(z / w + y / top), lean, w)
        if move is None:
            break
        length = min(1.0, _BACK * _room(w, move))
        if capped:
            length = min(length, _BACK * _room(top, -move))
        push = float(lean @ move)
        moved = program.change(move)
        length = _search(program, surrogate, smooth, (w, m), (move, moved), length, mu, push)
        if length == 0.0 and (program.criterion.kinked or mu <= tolerance / (10 * n)):
            break
        z = _dual(z, mu / w - z - z / w * move)
        if capped:
            y = _dual(y, mu / top - y + y / top * move)
        w = w + length * move
        m = program.information(w)
        z = np.clip(z, mu / (_CLAMP * w), _CLAMP * mu / w)
        complement = float(z @ w) / n
        if capped:
            top = program.most - w
            y = np.clip(y, mu / (_CLAMP * top), _CLAMP * mu / top)
            complement = 0.5 * (complement + float(y @ top) / n)
        if program.criterion.kinked:  # μ is also the width of the kink: it falls only where central
            central = push <= _CENTRAL * mu
        else:
            fall = 0.1 if length > 0.9 else 0.3 if length > 0.5 else 0.8
            mu = max(min(fall * complement, mu), 0.05 * tolerance / n)
    if best is None:
        smooth_none = Smooth(0.0, m * 0.0, (), (), m * 0.0)
        return Optimum(w, smooth_none, 0.0, np.inf, mu)
    return best


def _newton(program: BarrierProgram, matrix: Floats, lean: Floats, w: Floats) -> Floats | None:
    """Return the step that spends the budget: K dw + λ c = lean, c·dw = B − c·w."""
    diagonal = np.diag(matrix).copy()
    for ridge in (1e-14, 1e-10, 1e-6):
        matrix[np.diag_indices_from(matrix)] = diagonal * (1.0 + ridge)
        try:
            factor = sl.cho_factor(matrix, lower=True, check_finite=False)
        except (np.linalg.LinAlgError, ValueError):
            continue
        both = sl.cho_solve(factor, np.column_stack([lean, program.cost]), check_finite=False)
        if np.isfinite(both).all():
            short = program.budget - float(program.cost @ w)
            price = (float(program.cost @ both[:, 0]) - short) / float(program.cost @ both[:, 1])
            return np.asarray(both[:, 0] - price * both[:, 1])
    return None


def _room(x: Floats, move: Floats) -> float:
    """Return how long a step may be until x reaches 0."""
    with np.errstate(divide="ignore"):
        return float(np.min(np.where(move < 0.0, -x / move, np.inf), initial=np.inf))


def _dual(z: Floats, move: Floats) -> Floats:
    """Return duals after a step that keeps them over 0."""
    return np.asarray(z + min(1.0, _BACK * _room(z, move)) * move)


def _search(
    program: BarrierProgram,
    surrogate: Callable[[Floats], Smooth | None],
    here: Smooth,
    at: tuple[Floats, Floats],
    step: tuple[Floats, Floats],
    length: float,
    mu: float,
    slope: float,
) -> float:
    """Return the length of the step: halved until the barrier problem improves; 0 if never.

    The information is linear in the weights: `at` and `step` are weights and information.
    """
    capped = np.isfinite(program.most)
    (w, m), (move, moved) = at, step

    def barrier(x: Floats) -> float:
        out = float(np.log(x).sum())
        return out + (float(np.log(program.most - x).sum()) if capped else 0.0)

    start = barrier(w)
    noise = 1e-13 * (1.0 + abs(here.value))
    for _ in range(30):
        x = w + length * move
        there = surrogate(m + length * moved)
        if there is not None:
            gain = there.value - here.value + mu * (barrier(x) - start)
            if gain >= 1e-4 * length * slope - noise:
                return length
        length *= 0.5
    return 0.0
