"""Whether new readings agree with a carried prior: its drift, its conflicts, its effects' evidence.

At the linearisation of a fit, with A_g the whitened columns of the parameters of group g, S_g their
unit of drift, C the covariance of the prior and F the columns of parameters without a prior,

    y ~ N(F φ, V),    V = β 1 + A C Aᵀ + Σ_g v_g K_g,    K_g = A_g S_g² A_gᵀ

y the residual at the prior's mean; K_0 = A C Aᵀ is the doubt of the prior as a whole. The
variances v_g of the drift maximise the restricted likelihood (REML) times a half-Cauchy prior of
√v_g, whose scale is the drift that the effect may have had: v_g is zero unless the readings need
more, and may be large. With P = V⁻¹ − V⁻¹ F (Fᵀ V⁻¹ F)⁻ Fᵀ V⁻¹ the fixed point is

    v_g ← v_g [yᵀ P K_g P y / (tr P K_g + 2/(s_g² + v_g))]^½

and β, at least 1, follows from P y alike. The statistic yᵀ P K_g P y at v_g = 0, the others
unchanged, is a sum of weighted χ² when group g has not moved: its tail is the p-value of the group.

The log evidence of the new readings for an effect of the prior is the difference of the restricted
log likelihoods

    ℓ = −½ (log |V| + log |Fᵀ V⁻¹ F| + yᵀ P y)

with the whole prior, and with the effect held at zero while the others keep their marginal
distribution. Readings that do not depend on the effect are no evidence against it. Directions of
the prior without information have a standard deviation of one ordinary magnitude.

Many parts that have moved may be another arm. Then every part differs by what arms of one type do,
which a drift of a few parts imitates at the measured poses alone (`of_another_arm`).

Sources: Patterson and Thompson, Biometrika 58 (1971) 545-554; Polson and Scott, Bayesian Analysis 7
(2012) 887-902 (half-Cauchy priors of variances).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
import scipy.linalg as sl

from hilcal.identification.carried.carried_prior import (
    CarriedPrior,
    DriftGroup,
    coordinates_of,
    names_of,
    scales_of,
)
from hilcal.identification.gauss_newton import Solution, whitened_jacobian
from hilcal.model.model import Model
from hilcal.readings.whitening import Whitening
from hilcal.regression.evidence import ratio_tail
from hilcal.regression.normal_equations import INFORMATION
from hilcal.regression.schur import inverse_root
from hilcal.types import Floats, Ints

ITERATIONS = 40  # of the fixed point, at most; a choice
TOLERANCE = 0.1  # change of the degrees of freedom v tr P K of a group that ends them; a choice
NEGLIGIBLE = 1e-6  # variance in units of S² that counts as none
LARGE_DIMENSION = 1e6  # dimension at which a ratio of quadratic forms is one of them
LEAST_P = 1e-300
ODDS = 20.0  # odds at which a prior counts as another arm's; a choice

_Fitted = tuple[Model, Solution]  # a model with a carried prior, and its fit


@dataclass(frozen=True, slots=True)
class Conflict:
    """How far a prior and new readings disagree about a group of parameters."""

    group: DriftGroup
    p_value: float  # of the statistic if they had not moved
    drift: float  # standard deviation of their drift in the fit, in units of S

    @property
    def moved_sigma(self) -> float:
        """Distance in standard deviations of a normal variable of that p-value, two-sided."""
        return float(scipy.stats.norm.isf(max(self.p_value, LEAST_P) / 2))


@dataclass(frozen=True, slots=True, eq=False)
class _Linear:
    """A fit's linear problem, its Q rows reduced to those that columns act on."""

    y: Floats  # (Q,) residual at the prior's mean
    flat: Floats  # (Q, F) columns without a prior
    random: Floats  # (Q, C) columns of unit variance: of the prior, and of other parameters' priors
    drift: tuple[Floats, ...]  # (Q, k) of the prior as a whole, and A_g S_g of each group
    noise_rows: int  # number of rows that no column acts on
    square: float  # their sum of squares

    def covariance(self, v: Floats, beta: float) -> Floats:
        """V (Q, Q) with the variances v (1 + G,) of the drift and the noise factor β."""
        total = self.random @ self.random.T + beta * np.eye(len(self.y))
        for moved in np.flatnonzero(v > NEGLIGIBLE):
            total += v[moved] * self.drift[moved] @ self.drift[moved].T
        return np.asarray(total)

    def projected(self, covariance: Floats) -> tuple[Floats, Floats]:
        """P for V (Q, Q), and P y."""
        inverse = np.asarray(sl.lapack.dpotri(np.linalg.cholesky(covariance), lower=1)[0])
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        lifted = inverse @ self.flat
        root = inverse_root(self.flat.T @ lifted) @ lifted.T
        p = inverse - root.T @ root
        return p, p @ self.y


def _columns(
    model: Model, solution: Solution, w: Whitening
) -> tuple[Floats, Floats, Floats, Floats]:
    """Whitened columns at a fit, by whether they have a prior, and the residual.

    (R, P) of all parameters, zero for those that are not estimated; (R, F) of those without a
    prior; (R, C) with a prior that is not carried, in its standard deviations; (R,) residual with
    every parameter with a prior at zero.
    """
    s, carried = solution, solution.space.carried(model.size)
    index = np.flatnonzero(s.estimated & ~carried)
    used, std = np.flatnonzero(s.estimated | carried), s.prior[index]
    free = np.isinf(std)
    a = np.zeros((len(s.white), model.size))
    a[:, used] = whitened_jacobian(model, s.prediction, s.theta, w, used)
    theta = np.where(s.estimated | carried, s.theta, 0.0)
    theta[index[free]] = 0.0  # flat ones may stay where they are
    flat = a[:, index[free]] * scales_of(model)[index[free]]
    return a, flat, a[:, index[~free]] * std[~free], s.white + a @ theta


def _determined(flat: Floats) -> Floats:
    """Reduce columns (R, F), by ordinary magnitudes, to the directions that a fit estimates."""
    u, values, _ = np.linalg.svd(flat, full_matrices=False)
    return np.asarray(u[:, values > INFORMATION])


def chosen_drift(model: Model, solution: Solution, w: Whitening) -> Floats:
    """Return δ (1 + G,) at a fit: the doubt of its carried prior, and the drift of its groups."""
    prior, rows = _linear(model, solution, w)
    scale2 = _drift_scale2(prior)
    forms = [g @ g.T for g in rows.drift]

    def moments(p: Floats, residual: Floats) -> tuple[Floats, Floats]:
        """YᵀP K_g P y and tr P K_g of each K_g (1 + G,), at least zero but for rounding."""
        squares = [float(residual @ k @ residual) for k in forms]
        traces = [float(np.vdot(p, k)) for k in forms]
        return np.maximum(squares, 0.0), np.maximum(traces, 0.0)

    # Start from the stated noise: a larger one would absorb the drift.
    beta, v, base = 1.0, np.zeros(len(forms)), rows.random @ rows.random.T
    p, residual = rows.projected(base + np.eye(len(base)))
    squares, traces = moments(p, residual)
    slope = (squares - traces) / 2 - 1.0 / scale2
    for k in np.flatnonzero(slope > 0):
        inner = rows.drift[k].T @ p @ rows.drift[k]
        v[k] = (squares[k] - traces[k]) / float(np.sum(inner**2))
    for _ in range(ITERATIONS):
        v = np.where(v > NEGLIGIBLE, v, 0.0)
        if not v.any():
            break
        total = base + sum(v[k] * forms[k] for k in np.flatnonzero(v))
        p, residual = rows.projected(total + beta * np.eye(len(base)))
        squares, traces = moments(p, residual)
        new = v * np.sqrt(squares / np.maximum(traces + 2.0 / (scale2 + v), 1e-300))
        square = float(residual @ residual) + rows.square / beta**2
        beta = max(1.0, beta * float(np.sqrt(square / (np.trace(p) + rows.noise_rows / beta))))
        change, v = np.abs(new - v) * traces, new
        if change.max() < TOLERANCE:
            break
    return np.asarray(np.sqrt(np.where(v > NEGLIGIBLE, v, 0.0) + prior.least_drift**2))


def conflicts(model: Model, solution: Solution, w: Whitening) -> tuple[Conflict, ...]:
    """Return how far the groups of a carried prior disagree with the readings, worst first.

    Each is tested with the drift of the others in place, since a joint that has moved makes its
    neighbours look as if they had. Groups that the readings do not depend on are left out.
    """
    if model.prior is None:
        return ()
    prior, rows = _linear(model, solution, w)
    used = prior.least_drift if model.prior.drift is None else model.prior.drift
    v = used**2 - prior.least_drift**2
    total = rows.covariance(v, solution.beta)
    common, out = rows.projected(total), []
    for k, group in enumerate(prior.groups, 1):
        x = rows.drift[k]
        p, residual = rows.projected(total - v[k] * x @ x.T) if v[k] > NEGLIGIBLE else common
        inner = x.T @ p @ x
        if not inner.size or float(np.trace(inner)) <= NEGLIGIBLE:
            continue
        values = np.maximum(np.linalg.eigvalsh(inner), 0.0)
        square = float(np.sum((x.T @ residual) ** 2))
        chance = ratio_tail(
            values[values > 0] / LARGE_DIMENSION, LARGE_DIMENSION, square / LARGE_DIMENSION**2
        )
        out.append(Conflict(group, chance, float(used[k])))
    return tuple(sorted(out, key=lambda c: c.p_value))


def _linear(model: Model, solution: Solution, w: Whitening) -> tuple[CarriedPrior, _Linear]:
    """The carried prior with its least drift, and the linear problem."""
    assert model.prior is not None  # noqa: S101 - the callers' condition
    prior = model.prior.with_drift(model.prior.least_drift)
    space = coordinates_of(replace(model, prior=prior))
    index, place = prior.index_in(names_of(model))
    (of_all, without, others, y), held = _columns(model, solution, w), space.std == 1.0
    a = of_all[:, index]
    group, unit = prior.group[place], prior.unit[place]
    drift = [a @ space.matrix[:, held]]
    flat = _determined(np.hstack([without, a @ space.matrix[:, ~held]]))
    random = np.hstack([*drift, others])
    drift += [a[:, group == g] * unit[group == g] for g in range(len(prior.groups))]
    y = y - a @ space.mean
    if len(y) <= a.shape[1] + without.shape[1] + others.shape[1]:
        return prior, _Linear(y, flat, random, tuple(drift), 0, 0.0)
    # All columns are combinations of these; the rows beyond their span are noise.
    columns = np.hstack([a * prior.posterior.scale[place], without, others])
    span = sl.qr(columns, mode="economic", check_finite=False)[0]
    inside = span.T @ y
    noise_rows, square = max(w.rank - len(inside), 0), max(float(y @ y - inside @ inside), 0.0)
    turned = tuple(span.T @ g for g in drift)
    flat, random = np.asarray(span.T @ flat), np.asarray(span.T @ random)
    return prior, _Linear(inside, flat, random, turned, noise_rows, square)


def of_another_arm(same: _Fitted, other: _Fitted, w: Whitening) -> bool:
    """Whether readings say at `ODDS` that a prior is of another arm, and not of the same one.

    `same` and `other` are fits to the same readings by either relation, with the drift chosen. They
    are compared by ℓ and the half-Cauchy prior of their drift, at the larger noise of both.
    """
    beta = max(1.0, same[1].beta, other[1].beta)
    gain = _log_posterior(*other, w, beta) - _log_posterior(*same, w, beta)
    return gain > float(np.log(ODDS))


def _log_posterior(model: Model, solution: Solution, w: Whitening, beta: float) -> float:
    """ℓ at the drift of a fit, with its prior relative to that of no more than the least drift."""
    prior, rows = _linear(model, solution, w)
    assert model.prior is not None  # noqa: S101 - see `_linear`
    used = prior.least_drift if model.prior.drift is None else model.prior.drift
    v = used**2 - prior.least_drift**2
    total = rows.covariance(v, beta)
    noise = rows.noise_rows * np.log(beta) + rows.square / beta
    of_drift = np.log1p(np.maximum(v, 0.0) / _drift_scale2(prior)).sum()
    return _log_likelihood(total, rows.flat, rows.y) - float(noise / 2 + of_drift)


def _drift_scale2(prior: CarriedPrior) -> Floats:
    """(1 + G,) squared scales of the half-Cauchy priors of δ."""
    return np.array([1.0, *(prior.expected.get(g.effect, 1.0) ** 2 for g in prior.groups)])


def _log_likelihood(covariance: Floats, flat: Floats, y: Floats) -> float:
    """ℓ of y (Q,) with columns F (Q, F) and V (Q, Q), without constants."""
    low = np.linalg.cholesky(covariance)
    white = sl.solve_triangular(low, np.column_stack([flat, y]), lower=True, check_finite=False)
    f, r = white[:, :-1], white[:, -1]
    values, vectors = np.linalg.eigh(f.T @ f)
    determined = values > 1e-12 * values.max(initial=0.0)
    along = (f @ vectors[:, determined]).T @ r / np.sqrt(values[determined])
    log_det = 2 * float(np.log(np.diag(low)).sum()) + float(np.log(values[determined]).sum())
    return -0.5 * (log_det + float(r @ r) - float(along @ along))


def carried_effects(model: Model) -> tuple[str, ...]:
    """Effects that a model has because its carried prior has them."""
    if model.prior is None:
        return ()
    carried = {e.name for e in model.prior.posterior.effects}
    return tuple(e.name for e in model.effects if e.name in carried and e.role == "effect")


def evidence_of_carried(
    model: Model, solution: Solution, w: Whitening, effects: Sequence[str]
) -> dict[str, float]:
    """Return the log evidence of the readings for each effect, given the others of the model."""
    a, flat, random, y = _columns(model, solution, w)
    full = coordinates_of(model)
    columns = np.hstack([flat, random, a[:, full.index] @ full.matrix])
    if columns.shape[1] < len(y):
        span = sl.qr(columns, mode="economic", check_finite=False)[0]
        y, a, flat, random = span.T @ y, span.T @ a, span.T @ flat, span.T @ random

    def likelihood(reduced: Model, place: Ints) -> float:
        """ℓ with the prior of some parameters, which are at `place`."""
        space = coordinates_of(reduced)
        used = a[:, place[space.index]]
        x = np.hstack([random, used @ space.matrix])
        total = x @ x.T + solution.beta * np.eye(len(x))
        return _log_likelihood(total, flat, y - used @ space.mean)

    parameters = np.arange(model.size)
    with_all, evidence = likelihood(model, parameters), {}
    for name in effects:
        without = replace(model, effects=tuple(e for e in model.effects if e.name != name))
        place = np.delete(parameters, model.slices()[model.names.index(name)])
        evidence[name] = with_all - likelihood(without, place)
    return evidence
