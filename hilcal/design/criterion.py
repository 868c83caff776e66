"""The protocol of a design criterion: a concave function of information, and its surrogate."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.regression.schur import DETERMINED, nuisance_inverse
from hilcal.types import Bools, Floats, Ints

_CHUNK = 2048


@dataclass(frozen=True, slots=True, eq=False)
class CandidateSet:
    """K units; a plan takes unit k n_k times, an integer.

    A unit is one reading, or the readings of one pose unloaded and under some loads (deflections).

        M = M0 + Σ n_k A_kᵀ A_k,    cost = Σ n_k c_k
    """

    # (K, R, P) whitened Jacobians A_k by the parameters in ordinary magnitudes (pure numbers);
    # units with fewer rows are filled up with zeros
    rows: Floats
    cost: Floats  # (K,) of taking the unit once, over 0: readings, or seconds

    def __len__(self) -> int:
        """Return the number of units K."""
        return len(self.rows)

    def __getitem__(self, which: Ints | Bools) -> "CandidateSet":
        """Return a subset of the units."""
        return CandidateSet(self.rows[which], self.cost[which])

    @property
    def size(self) -> int:
        """Number of parameters P."""
        return int(self.rows.shape[2])

    def information(self, weight: Floats, which: Ints | None = None) -> Floats:
        """Return (P, P) Σ w_k A_kᵀ A_k of all units, or of those with the indices `which`."""
        rows, out = self.rows if which is None else self.rows[which], np.zeros((self.size,) * 2)
        for start in range(0, len(rows), _CHUNK):
            part = slice(start, start + _CHUNK)
            root = (rows[part] * np.sqrt(weight[part])[:, None, None]).reshape(-1, self.size)
            out += root.T @ root
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Smooth:
    """A smooth concave function f near a monotone function of the criterion φ, at one M.

    With H_k = A_kᵀ A_k, the second derivative by the weights of units k and l is the sum of

        c · tr(X H_k Y H_l) over products (c, L_x, L_y) with X = L_x L_xᵀ, Y = L_y L_yᵀ
        Σ C_ab (v_aᵀ H_k v_a) (v_bᵀ H_l v_b) over squares (C, V), v_a the columns of V
    """

    value: float  # f(M)
    gradient: Floats  # (P, P) of f
    products: tuple[tuple[float, Floats, Floats], ...]  # roots (P, r) and (P, s)
    squares: tuple[tuple[Floats, Floats], ...]  # (r, r) and (P, r)
    above: Floats  # (P, P) Z such that φ(N) ≤ tr(Z N) for every information N ⪰ 0,
    below: Floats | None = None  # or with Y (P, P): φ(N) ≤ tr(Z N) / tr(Y N)

    def scaled(self, factor: float) -> "Smooth":
        """Return a multiple of f, with the same bound."""
        products = tuple((factor * c, x, y) for c, x, y in self.products)
        squares = tuple((factor * c, v) for c, v in self.squares)
        return replace(
            self, value=factor * self.value, gradient=factor * self.gradient, products=products,
            squares=squares,
        )  # fmt: skip


class Criterion(ABC):
    """φ(M) of an information matrix M (P, P): more is better.

    Concave and positively homogeneous of degree 1, so that φ(N) ≤ tr(G(M) N) for all M, N; only the
    ratio of eigenvalues (`K`) is quasi-concave and of degree 0.
    """

    name: str  # in a configuration
    monotone = True  # whether more information is never worse
    kinked = True  # whether φ has kinks, so that the surrogate depends on its order

    @abstractmethod
    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) information matrices; 0 where they are singular."""

    @abstractmethod
    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f near φ / φ(m), or log φ, and nearer as `order` tends to 0; None if undefined."""

    def relevant(self, units: CandidateSet, prior: Floats, budget: float) -> "Criterion":
        """Return a criterion without parts that cannot bind, equal to φ near the optimum."""
        return self

    def require(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse M, the information of all candidates, if it does not determine φ.

        The message names the parameters of a singular matrix.
        """
        label = tuple(f"parameter {k + 1}" for k in range(len(m))) if names is None else names
        diagonal = np.diag(m)
        blind = np.flatnonzero(diagonal <= 0.0)
        if len(blind):
            raise CannotAnswerError(
                f"no candidate changes with {_listed([label[int(k)] for k in blind])}; allow "
                "other poses or loads, or leave it out of the model"
            )
        root = np.sqrt(diagonal)
        values, vectors = np.linalg.eigh(m / np.outer(root, root))
        if values[0] > DETERMINED:
            return
        share = np.abs(vectors[:, 0])
        inside = np.flatnonzero(share > 0.1 * share.max())
        raise CannotAnswerError(
            "no candidate separates "
            f"{_listed([label[int(k)] for k in inside[np.argsort(-share[inside])]])}; allow other "
            "poses or loads, or leave one of them out of the model"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A present effect, and the parameters that are fitted in its place."""

    effect: Ints  # (E,) indices of the effect's parameters
    beta: Floats  # (E,) their values
    nuisance: Ints  # (F,) indices of the parameters of the model and of the rival effect
    names: tuple[str, str] = ("an effect", "its rival")

    def residual(self, m: Floats) -> Floats:
        """Return the parameters u (P,) of the residual of fitting model and rival, at M.

        u is β at the effect and −M_nn⁻ M_ne β at the nuisance: uᵀ M u = βᵀ S β, S the Schur
        complement.
        """
        u = np.zeros(len(m))
        u[self.effect] = self.beta
        return u - nuisance_inverse(m, self.nuisance) @ (m @ u)


@dataclass(frozen=True, slots=True, eq=False)
class DiscriminatedPairs:
    """Pairs of effects to discriminate."""

    pairs: tuple[Pair, ...]
    # (P, P) prior information without that of potential terms, which would favour an assumed effect
    # and shrink a rival
    prior: Floats
    not_separable: tuple[tuple[str, str], ...] = ()  # names of omitted pairs


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """What a plan of counts n maximises: φ(M),  M = M0 + Σ n_k A_kᵀ A_k."""

    units: CandidateSet  # their columns by the parameters of φ
    criterion: Criterion  # φ
    prior: Floats  # (P, P) M0: prior information, or of fixed readings
    names: tuple[str, ...] | None = None  # of the parameters, for messages
    discriminated_pairs: DiscriminatedPairs | None = None
    """Of "separate", before they are condensed."""

    def among(self, which: Ints | Bools) -> "Objective":
        """Return the objective with a subset of the units."""
        return replace(self, units=self.units[which])

    def information(self, weight: Floats, which: Ints | None = None) -> Floats:
        """Return (P, P) M, of all units or of those with the indices `which`."""
        return np.asarray(self.prior + self.units.information(weight, which))


def _listed(names: Sequence[str]) -> str:
    suffix = f" and {len(names) - 6} more" if len(names) > 6 else ""
    return ", ".join(names[:6]) + suffix


def inverse_factor(m: Floats) -> tuple[Floats, float] | None:
    """Return R with M⁻¹ = R Rᵀ, and log det M; None where M is not positive definite."""
    try:
        factor = np.linalg.cholesky(m)
    except np.linalg.LinAlgError:
        return None
    root = np.linalg.inv(factor).T
    if not np.isfinite(root).all():
        return None
    return root, float(2.0 * np.log(np.diag(factor)).sum())


def factors(m: Floats) -> tuple[Floats, Bools]:
    """Return Cholesky factors of (N, P, P) matrices, and which (N,) of them are regular.

    A pivot is a parameter's information when all parameters before it are unknown; rounding turns a
    zero pivot into about 1e-16 P of the diagonal element.
    """
    try:
        factor = np.linalg.cholesky(m)
    except np.linalg.LinAlgError:
        if len(m) == 1:
            return np.eye(m.shape[-1])[None], np.zeros(1, dtype=np.bool_)
        parts = [factors(matrix[None]) for matrix in m]
        return np.concatenate([f for f, _ in parts]), np.concatenate([good for _, good in parts])
    pivots = np.diagonal(factor, axis1=1, axis2=2) ** 2
    floor = 0.1 * DETERMINED * np.diagonal(m, axis1=1, axis2=2)
    good = np.all(pivots > floor, axis=1) & np.isfinite(factor).all(axis=(1, 2))
    return np.asarray(factor, dtype=np.float64), np.asarray(good, dtype=np.bool_)


def soft_min(values: Floats, width: float) -> tuple[float, Floats]:
    """Return the smooth least F = max over t of t + μ Σ log((s_i − t) / μ) of numbers s, and p.

    Its derivatives p_i = μ / (s_i − t) sum to 1, so that min s' ≤ Σ p_i s'_i for any
    numbers s'. Σ p_i s_i exceeds min s by at most (n − 1) μ.
    """
    least = float(values.min())
    gap = values - least
    # d = least − t lies in [μ, n μ]; 1/Σ 1/(gap + d) is concave in d: Newton goes up to its root
    d = width
    for _ in range(60):
        inverse_gap = 1.0 / (gap + d)
        total = float(inverse_gap.sum())
        step = (width * total - 1.0) * total / float(inverse_gap @ inverse_gap)
        d = min(d + step, len(values) * width)
        if abs(step) <= 1e-14 * d:
            break
    p = width / (gap + d)
    value = least - d - width * float(np.log(p).sum())
    return value, np.asarray(p / p.sum())


def prices(rows: Floats, matrix: Floats) -> Floats:
    """Return (K,) tr(G A_kᵀA_k) of (K, R, P) rows, for a symmetric (P, P) matrix G.

    G = L Lᵀ where it is positive definite, else V diag(s) Vᵀ: sums of squares do not cancel.
    """
    try:
        root, minus = np.linalg.cholesky(matrix), None
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrix)
        nonzero = np.abs(values) > 1e-15 * float(np.abs(values).max(initial=0.0))
        root = vectors[:, nonzero] * np.sqrt(np.abs(values[nonzero]))
        minus = np.flatnonzero(values[nonzero] < 0.0)
    count, size = rows.shape[:2]
    out = np.empty(count)
    for start in range(0, count, _CHUNK):
        part = rows[start : start + _CHUNK].reshape(-1, rows.shape[2]) @ root
        total = np.einsum("ij,ij->i", part, part)
        if minus is not None and len(minus):
            total -= 2.0 * np.einsum("ij,ij->i", part[:, minus], part[:, minus])
        out[start : start + _CHUNK] = total.reshape(-1, size).sum(axis=1)
    return out


def upper_bound(
    smooth: Smooth,  # with Z and Y
    prior: Floats,  # (P, P) M0
    gains: Floats,  # (K,) tr(Z H_k)
    cost: Floats,  # (K,) c
    budget: float,  # B
    max_count: float,  # largest count of a unit
    below: Floats | None = None,  # (K,) tr(Y H_k)
) -> float:
    """Return an upper bound of φ of all plans within the budget, with real counts too.

    φ(M0 + Σ n_k H_k) ≤ tr(Z M0) + max of Σ n_k tr(Z H_k) over n ≥ 0, Σ n_k c_k ≤ B: the budget is
    spent on the largest gains per cost. Kiefer & Wolfowitz (1960), Canadian J. Math. 12; Pukelsheim
    (1993), Optimal Design of Experiments, ch. 7. For a ratio of eigenvalues, the largest
    tr(Z N)/tr(Y N) over the same plans (Dinkelbach 1967), at most 1.
    """
    fixed = float(np.sum(smooth.above * prior))
    if below is None or smooth.below is None:
        return fixed + float(gains @ fractional_knapsack(gains, cost, budget, max_count))
    fixed_below = float(np.sum(smooth.below * prior))
    if fixed_below <= 0.0:  # the best unit alone
        return min(1.0, float(np.max(gains / np.maximum(below, np.finfo(float).tiny))))
    ratio = fixed / fixed_below
    for _ in range(100):
        weight = fractional_knapsack(gains - ratio * below, cost, budget, max_count)
        raised = (fixed + float(gains @ weight)) / (fixed_below + float(below @ weight))
        if raised <= ratio * (1.0 + 1e-13):
            break
        ratio = raised
    return min(1.0, ratio)


def fractional_knapsack(gains: Floats, cost: Floats, budget: float, max_count: float) -> Floats:
    """Return the weights (K,) of the fractional knapsack: best gain per cost first."""
    rate = gains / cost
    # the budget reaches at most so many of the best
    best = best_first(rate, int(np.ceil(budget / (max_count * float(cost.min())))) + 1)
    spent = np.concatenate([[0.0], np.cumsum(max_count * cost[best[:-1]])])
    amount = np.clip((budget - spent) / cost[best], 0.0, max_count)
    weight = np.zeros(len(gains))
    weight[best] = np.where(rate[best] > 0.0, amount, 0.0)
    return weight


def best_first(rate: Floats, count: int) -> Ints:
    """Return the indices of the `count` largest, best first."""
    count = min(count, len(rate))
    chosen = np.argpartition(-rate, count - 1)[:count] if count < len(rate) else np.arange(count)
    return np.asarray(chosen[np.argsort(-rate[chosen], kind="stable")])
