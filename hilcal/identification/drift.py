"""How far an arm has drifted since a prior was learnt, and where prior and readings disagree.

At the linearisation of a fit, with A_g the whitened columns of the parameters of group g, S_g their
unit of drift, C the covariance of the prior and F the columns of parameters without a prior,

    y ~ N(F φ, V),    V = β 1 + A C Aᵀ + Σ_g v_g K_g,    K_g = A_g S_g² A_gᵀ

y the residual at the prior's mean; K_0 = A C Aᵀ is the doubt of the prior as a whole. The
variances v_g of the drift maximise the restricted likelihood (REML) times a half-Cauchy prior of
√v_g, whose scale is the drift that the effect may have had: without need v_g is zero, and a large
drift is not forbidden. With
P = V⁻¹ − V⁻¹ F (Fᵀ V⁻¹ F)⁻ Fᵀ V⁻¹ the fixed point is

    v_g ← v_g [yᵀ P K_g P y / (tr P K_g + 2/(s_g² + v_g))]^½

and β, at least 1, follows from P y alike. The statistic yᵀ P K_g P y at v_g = 0, the others as they
are, is a sum of weighted χ² when group g has not moved: its tail is the p-value of the group.

Sources: Patterson and Thompson, Biometrika 58 (1971) 545-554; Polson and Scott, Bayesian Analysis 7
(2012) 887-902 (half-Cauchy priors of variances).
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as sl
from scipy.stats import norm

from hilcal.identification.carried import CarriedPrior, DriftGroup
from hilcal.identification.coordinates import coordinates_of
from hilcal.identification.gauss_newton import Solution, whitened_jacobian
from hilcal.identification.priors import names_of
from hilcal.model.model import Model
from hilcal.readings.whitening import Whitening
from hilcal.regression.evidence import ratio_tail
from hilcal.regression.schur import inverse_root
from hilcal.types import Floats

ITERATIONS = 40
"""Most fixed-point iterations; a choice."""
TOLERANCE = 0.1
"""Change of the degrees of freedom v tr P K of a group at which it has converged; a choice."""
NEGLIGIBLE = 1e-6
"""Variance in units of S² that counts as none."""
MANY = 1e6
"""Dimension at which a ratio of quadratic forms is one of them: its denominator is constant."""
LEAST_P = 1e-300


@dataclass(frozen=True, slots=True)
class Conflict:
    """How far a prior and new readings disagree about a group of parameters.

    Attributes:
        group: the parameters.
        p_value: of what was found if they had not moved.
        drift: standard deviation of the drift that the fit gave them, in units of S.
    """

    group: DriftGroup
    p_value: float
    drift: float

    @property
    def moved_sigma(self) -> float:
        """Distance in standard deviations of a normal variable of that p-value, two-sided."""
        return float(norm.isf(max(self.p_value, LEAST_P) / 2))


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The linear problem, its rows reduced to those that columns act on.

    Attributes:
        y: (Q,) residual at the prior's mean.
        flat: (Q, F) columns without a prior.
        known: (Q, C) columns of unit variance: of the prior, and of other parameters' priors.
        drift: (Q, k) of the prior as a whole, and A_g S_g of each group.
        rest: number of rows that no column acts on.
        square: their sum of squares.
    """

    y: Floats
    flat: Floats
    known: Floats
    drift: tuple[Floats, ...]
    rest: int
    square: float


@dataclass(frozen=True, slots=True, eq=False)
class _Projector:
    """P, and P y."""

    matrix: Floats
    residual: Floats

    @classmethod
    def of(cls, rows: _Rows, covariance: Floats) -> "_Projector":
        """Form them for V (Q, Q)."""
        low = np.linalg.cholesky(covariance)
        inverse = np.asarray(sl.lapack.dpotri(low, lower=1)[0])
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        lifted = inverse @ rows.flat
        root = inverse_root(rows.flat.T @ lifted) @ lifted.T
        p = inverse - root.T @ root
        return cls(p, p @ rows.y)


def chosen_drift(model: Model, solution: Solution, w: Whitening) -> Floats:
    """Return δ (1 + G,): the doubt of the model's carried prior, and the drift of its groups.

    Args:
        model: with a carried prior.
        solution: its fit.
        w: the gc-scaling of the fit.
    """
    prior = _with_least(model)
    rows = _rows(model, prior, solution, w)
    scale2 = np.array([1.0, *(prior.expected.get(g.effect, 1.0) ** 2 for g in prior.groups)])
    forms = [g @ g.T for g in rows.drift]
    base, size = rows.known @ rows.known.T, len(rows.y)
    # No larger noise than stated to begin with: it would take the place of any drift.
    beta, v = 1.0, np.zeros(len(forms))
    p = _Projector.of(rows, base + beta * np.eye(size))
    squares, traces = _moments(forms, p)
    slope = (squares - traces) / 2 - 1.0 / scale2
    for k in np.flatnonzero(slope > 0):
        inner = rows.drift[k].T @ p.matrix @ rows.drift[k]
        v[k] = (squares[k] - traces[k]) / float(np.sum(inner**2))
    for _ in range(ITERATIONS):
        active = v > NEGLIGIBLE
        if not active.any():
            break
        v = np.where(active, v, 0.0)
        total = base + sum(v[k] * forms[k] for k in np.flatnonzero(active))
        total[np.diag_indices(size)] += beta
        p = _Projector.of(rows, total)
        squares, traces = _moments(forms, p)
        new = v * np.sqrt(squares / np.maximum(traces + 2.0 / (scale2 + v), 1e-300))
        beta = _noise(rows, p, beta)
        change = np.abs(new - v) * traces
        v = new
        if change.max() < TOLERANCE:
            break
    v[v <= NEGLIGIBLE] = 0.0
    return np.asarray(np.sqrt(v + least(prior) ** 2))


def conflicts(model: Model, solution: Solution, w: Whitening) -> tuple[Conflict, ...]:
    """Return how far the groups of a carried prior disagree with the readings, worst first.

    Each is tested beside the drift that the others were given, since a joint that has moved makes
    its neighbours look as if they had. Groups that the readings do not see are left out.

    Args:
        model: fitted; without a carried prior there are none.
        solution: its fit.
        w: the gc-scaling of the fit.
    """
    if model.prior is None:
        return ()
    prior = _with_least(model)
    rows = _rows(model, prior, solution, w)
    used = least(prior) if model.prior.drift is None else model.prior.drift
    v = used**2 - least(prior) ** 2
    total = rows.known @ rows.known.T + solution.beta * np.eye(len(rows.y))
    for given in np.flatnonzero(v > NEGLIGIBLE):
        total += v[given] * rows.drift[given] @ rows.drift[given].T
    common = _Projector.of(rows, total)
    found = []
    for k, group in enumerate(prior.groups, 1):
        x, p = rows.drift[k], common
        if v[k] > NEGLIGIBLE:
            p = _Projector.of(rows, total - v[k] * x @ x.T)
        inner = x.T @ p.matrix @ x
        if not inner.size or float(np.trace(inner)) <= NEGLIGIBLE:
            continue
        values = np.maximum(np.linalg.eigvalsh(inner), 0.0)
        square = float(np.sum((x.T @ p.residual) ** 2))
        chance = ratio_tail(values[values > 0] / MANY, MANY, square / MANY**2)
        found.append(Conflict(group, chance, float(used[k])))
    return tuple(sorted(found, key=lambda c: c.p_value))


def least(prior: CarriedPrior) -> Floats:
    """(1 + G,) no doubt, and the least drift of each group."""
    return np.array([0.0, *(prior.least.get(g.effect, 0.0) for g in prior.groups)])


def _with_least(model: Model) -> CarriedPrior:
    """Return the carried prior with the least drift."""
    assert model.prior is not None  # noqa: S101 - the callers' condition
    return model.prior.with_drift(least(model.prior))


def _moments(forms: list[Floats], p: _Projector) -> tuple[Floats, Floats]:
    """YᵀP K_g P y and tr P K_g of each K_g (1 + G,)."""
    squares = [float(p.residual @ k @ p.residual) for k in forms]
    traces = [float(np.vdot(p.matrix, k)) for k in forms]
    # At least zero but for rounding, as where an effect is not in the model.
    return np.maximum(squares, 0.0), np.maximum(traces, 0.0)


def _noise(rows: _Rows, p: _Projector, beta: float) -> float:
    """Fixed point of the noise factor."""
    square = float(p.residual @ p.residual) + rows.square / beta**2
    return max(1.0, beta * float(np.sqrt(square / (np.trace(p.matrix) + rows.rest / beta))))


def _rows(model: Model, prior: CarriedPrior, solution: Solution, w: Whitening) -> _Rows:
    """Form the linear problem at a fit."""
    of = coordinates_of(replace(model, prior=prior))
    index, own = prior.index_in(names_of(model))
    a = whitened_jacobian(model, solution.prediction, solution.theta, w, np.arange(model.size))
    mine = a[:, index]
    held = of.std == 1.0
    others = np.setdiff1d(np.flatnonzero(solution.estimated), index)
    std = solution.prior[others]
    free = np.isinf(std)
    flat = [a[:, others[free]], mine @ of.matrix[:, ~held]]
    known = [mine @ of.matrix[:, held], a[:, others[~free]] * std[~free]]
    group, unit = prior.group[own], prior.unit[own]
    drift = [mine @ of.matrix[:, held]]
    drift += [mine[:, group == g] * unit[group == g] for g in range(len(prior.groups))]
    y = solution.white + mine @ (solution.theta[index] - of.mean)
    y = y + a[:, others[~free]] @ solution.theta[others[~free]]
    parts = [np.hstack(flat), np.hstack(known), *drift]
    count = mine.shape[1] + sum(x.shape[1] for x in (flat[0], known[1]))
    if len(y) <= count:
        return _Rows(y, parts[0], parts[1], tuple(drift), 0, 0.0)
    # All columns are combinations of these; the rows beyond their span are noise.
    span = sl.qr(
        np.hstack([mine * prior.posterior.scale[own], flat[0], known[1]]),
        mode="economic",
        check_finite=False,
    )[0]
    inside = span.T @ y
    seen = w.rank - len(inside)
    square = max(float(y @ y - inside @ inside), 0.0)
    return _Rows(
        inside, span.T @ parts[0], span.T @ parts[1], tuple(span.T @ g for g in drift),
        max(seen, 0), square,
    )  # fmt: skip
