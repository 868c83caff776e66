"""Covariance of predictions, also where nothing was measured.

The posterior of a fit holds the strengths of shrunk families at what the evidence chose, zero for
the groups that the readings do not need. That says nothing of joint angles that were never
visited: there the dropped harmonics of a transmission error, too, add up to its size. So

- a group of a shrunk family has at least the mean variance of its pool (of the whole family, or of
  an octave of harmonics, see `Effect.pools`) as its prior;
- a parameter without a prior has one about zero of its ordinary magnitude, or the rms of its
  effect's parameters if more, as where poses are left out (see `holdout`);

and with the Jacobian A (R, P) of the fitted readings, whitened by W, σ² their noise factor, Λ the
prior precision,

    C = (AᵀA/σ² + Λ)⁻¹,    Cov(measured − predicted) = κ (σ² W + J C Jᵀ)

W is the stated covariance V, with more for positions or attitudes where their residual asks for it
(`excess`): a misfit has not the shape of an instrument's noise. W, C and the residual that
parameters with this W and Λ leave belong together; they are found by turns.
Where the model has a background its standard deviations are in units of the instrument's noise,
and σ is the factor of that as the mixed model estimates it, also where the arm's scatter is stated.
The uncertainty of the variances makes C larger by how far it moves the parameters (see
`mixed.variances`), and κ is at least what it makes of predictions on the whole (see
`variance_spread`). Both hold that motion, once where it acts and once as a mean: with 20, 30 and 60
poses of 30 simulated arms that have all effects, 95, 92 and 95 % of other poses are then in their
95 % band, and 93, 89 and 93 % with κ alone. Without a background σ² is from the residual, at
least 1.

κ, at least 1, makes the mean variance on poses left out, in units of V, equal to the mean square
that was found there: what repeats itself in new poses. The variance is that of the folds as they
are left out, F of rows Y, with X the same whitened by W and multiplied by the root of C: the mean
of Y (1 − XᵀX/σ²)⁻¹ Yᵀ. With few poses a fold may be all that tells of a direction; its variance is
that of the prior then.

How much wider predictions are since the variances of a background are estimated themselves.

At given variances rows that are predicted without their fold are off by e with the variance v (see
`mixed.equations.left_out`). With x = (log s, η) drawn from its posterior, by weights from the
normal approximation at its maximum x̂, the mean square is E[Σ v] + E|e − E e|². The factor is its
ratio to Σ v at x̂. Source: Kackar and Harville, *Approximations for standard errors of estimators of
fixed and random effects in mixed linear models*, JASA 79 (1984) 853.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.identification.coordinates import Coordinates, coordinates_of
from hilcal.identification.excess import Excess, excess
from hilcal.identification.folds import distinct_poses, random_folds
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.holdout import ordinary
from hilcal.identification.mixed_fit import INSTRUMENT, mixed_fit_at
from hilcal.identification.residual import residual
from hilcal.mixed.equations import equations, left_out
from hilcal.mixed.variances import Variances, log_posterior
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, Whitening, whitening
from hilcal.types import Floats, Ints

ITERATIONS = 20
"""Fixed-point iterations of the noise factor; it converges within a few."""
ROUNDS = 6
"""Most times that the covariance of the parameters is computed anew as W changes; a choice."""
MOST_LEVERAGE = 0.99
"""Bound on the leverage of a row, since that of a row which alone tells something is 1."""
ROUNDING = 1e-9
"""Least share of a direction's information that is not of one fold, for rounding."""
CHUNK = 4096
"""Measurements that are taken at once, for memory."""
MOST_ROWS = 600
"""Elements of readings beyond which the variances are taken for known: of 200 poses of a real UR10
the factor is 1.00 to 1.06, and a draw costs the cube of the rows. A choice."""
DRAWS = 30
"""Of the posterior; a choice: of 20 poses of a real UR10 the factor is 1.19 to 1.43 by the seed."""
HEAVIEST = 2.0
"""log of the largest weight of a draw over the median: the normal approximation is not exact in its
tails. A choice."""
SEED = 0
"""Of the draws, so that equal fits give equal factors."""


@dataclass(frozen=True, slots=True, eq=False)
class Predictive:
    """What a fit knows of readings that it has not seen.

    Attributes:
        model: the model.
        theta: (P,) its parameters.
        covariance: (P, P) C.
        prior: (P,) prior standard deviations, Λ = diag(prior)⁻².
        excess: what W has beyond V.
        noise: σ², noise factor of the fitted readings in units of W.
        factor: κ.
        least: what κ is at least, by the uncertainty of the variances.
        leverage: (D,) largest eigenvalue of a fitted measurement's leverage: variance of the
            prediction over that of the noise.
        scatter: mean variance of the fitted readings by σ² W, in units of V.
        left_out: mean variance of the predictions of poses left out by C, in units of V.
        scatter_m2: the first of both of a 3-D position, m².
        left_out_m2: the second.
    """

    model: Model
    theta: Floats
    covariance: Floats
    prior: Floats
    excess: Excess
    noise: float
    factor: float
    least: float
    leverage: Floats
    scatter: float
    left_out: float
    scatter_m2: float
    left_out_m2: float

    def of_prediction(self, prediction: Prediction, w: Whitening) -> Floats:
        """Return κ J C Jᵀ (D, m, m) of predicted measurements."""
        jacobian = w.raw(self.model.jacobian(prediction, self.theta, w.m))
        spread = np.einsum("dip,pq,djq->dij", jacobian, self.covariance, jacobian, optimize=True)
        return np.asarray(self.factor * spread)

    def of_reading(self, prediction: Prediction, w: Whitening) -> Floats:
        """Return κ (σ² W + J C Jᵀ) (D, m, m), of measured minus predicted."""
        return self.of_prediction(prediction, w) + self.of_noise(w)

    def of_noise(self, w: Whitening) -> Floats:
        """Return κ σ² W (D, m, m)."""
        return self.factor * self.noise * self.excess.widened(w.covariance)


def predictive(
    model: Model, theta: Floats, prior: Floats, fitted: Readings, mode: Mode, left_out_sigma: float
) -> Predictive:
    """Return what a gc-scaled fit knows of other readings.

    Args:
        model: the model.
        theta: (P,) its parameters.
        prior: (P,) prior standard deviations of the fit; infinite for flat parameters, zero for
            groups that were dropped. The prior that the model carries takes their place.
        fitted: the readings that it was fitted to, without gross errors.
        mode: "deflection" or "absolute".
        left_out_sigma: rms of the whitened residual on poses left out.
    """
    stated = whitening(fitted, mode, "gc")
    prediction = model.predict(fitted.states, theta)
    raw = residual(fitted, prediction, stated)
    known, least, from_variances = None, 1.0, np.zeros((model.size, model.size))
    if model.background:
        variances = mixed_fit_at(model, fitted.as_stated(), mode, theta)
        arm = fitted.arm_scatter  # whose factor the standard deviations are in units of
        known = (variances.std(INSTRUMENT) if arm is None else arm.instrument_factor) ** 2
        prior = prior * np.sqrt(known)
        least = variance_spread(
            variances, stated.rows_of(random_folds(distinct_poses(fitted)[stated.reading]))
        )
        e = variances.equations
        by = e.problem.parameters(e.sensitivity, model.size)
        from_variances = by @ variances.covariance @ by.T
    of = coordinates_of(model)
    chosen = of.prior(prior)
    std = of.prior(open_prior(model, theta, prior))
    std[np.isinf(std)] = 1.0
    # What the fit's own prior pulls its parameters by, in coordinates of unit prior variance.
    held = np.isfinite(chosen) & (chosen > 0)
    pull = np.where(held, of.of_theta(theta) * std / np.where(held, chosen, 1.0) ** 2, 0.0)
    more, w = Excess(), stated
    for step in range(ROUNDS):
        a = _rows(model, prediction, theta, of, std, w)
        values, vectors, noise = _spectrum(a, raw, w, known)
        root = vectors * np.sqrt(noise / (values + noise))
        # Where the parameters are with this noise and this prior: a residual and its leverage.
        moved = root @ (root.T @ (a.T @ w.whiten(raw).reshape(-1) / noise - pull))
        at = model.predict(fitted.states, theta + of.transform(std * moved))
        left = residual(fitted, at, stated)
        if known is not None:  # what the misfit has more of is in the background
            break
        found = excess(left, stated, w, a, root / np.sqrt(noise), more)
        if found.near(more):
            break
        more = found if step == 0 else found.halfway(more)
        w = whitening(more.of_readings(fitted, mode), mode, "gc")
    else:
        a = _rows(model, prediction, theta, of, std, w)
        values, vectors, noise = _spectrum(a, raw, w, known)
        root = vectors * np.sqrt(noise / (values + noise))
    shares = []
    for k in range(0, len(a), CHUNK * w.m):
        part = (a[k : k + CHUNK * w.m] @ root).reshape(-1, w.m, len(root))
        shares.append(np.linalg.eigvalsh(part @ np.swapaxes(part, 1, 2)) / noise)
    leverage = np.clip(np.concatenate(shares), 0.0, MOST_LEVERAGE).max(axis=1)
    fold = random_folds(distinct_poses(fitted)[w.reading])
    scatter, b = noise, a
    wider = more.widened(stated.covariance)
    if not more.none:
        share = np.trace(np.linalg.solve(stated.covariance, wider), axis1=1, axis2=2)
        scatter = noise * float(share.mean()) / w.m
        b = _rows(model, prediction, theta, of, std, stated)
    position = of.columns(w.raw(model.jacobian(prediction, theta, 3)).reshape(-1, model.size)) * std
    rows, points = w.rows_of(fold), np.repeat(fold, 3)
    left_out, left_out_m2 = _left_out(a, rows, ((b, rows), (position, points)), root, noise)
    scatter_m2 = noise * float(np.trace(wider[:, :3, :3], axis1=1, axis2=2).mean())
    root = of.transform(root * std[:, None])
    factor = max(least, left_out_sigma**2 / (scatter + left_out))
    return Predictive(
        model, theta, root @ root.T + from_variances, open_prior(model, theta, prior), more, noise,
        factor, least,
        leverage, scatter, left_out, scatter_m2, 3 * left_out_m2,
    )  # fmt: skip


def _rows(
    model: Model,
    prediction: Prediction,
    theta: Floats,
    of: Coordinates,
    std: Floats,
    w: Whitening,
) -> Floats:
    """Whitened derivatives (R, P) by coordinates of unit prior variance."""
    a = of.columns(whitened_jacobian(model, prediction, theta, w, np.arange(model.size)))
    a *= std
    return a


def _spectrum(
    a: Floats, raw: Floats, w: Whitening, known: float | None
) -> tuple[Floats, Floats, float]:
    """Eigenvalues and eigenvectors of AᵀA, and σ², which may be known."""
    values, vectors = np.linalg.eigh(a.T @ a)
    values = np.maximum(values, 0.0)
    if known is not None:
        return values, vectors, known
    white = w.whiten(raw).reshape(-1)
    rss, noise = float(white @ white), 1.0
    for _ in range(ITERATIONS):
        free = max(w.rank - float(np.sum(values / (values + noise))), 1.0)
        noise = max(1.0, rss / free)
    return values, vectors, noise


def _left_out(
    a: Floats, fold: Ints, asked: Sequence[tuple[Floats, Ints]], root: Floats, noise: float
) -> list[float]:
    """Mean variance of rows of each fold, predicted without it.

    Args:
        a: (R, P) fitted rows in units of W.
        fold: (R,) of each.
        asked: (R', P) rows in the units in which the variance is asked for, and their folds.
        root: (P, K) root of C.
        noise: σ².
    """
    total = np.zeros(len(asked))
    for f in range(int(fold.max(initial=-1)) + 1):
        x = a[fold == f] @ root
        few = len(x) < len(root)
        values, vectors = np.linalg.eigh(x @ x.T if few else x.T @ x)
        rest = np.maximum(1.0 - values / noise, ROUNDING)
        for k, (b, mine) in enumerate(asked):
            y = b[mine == f] @ root
            if few:
                along = y @ (x.T @ vectors)
                total[k] += np.sum(y**2) + np.sum(along**2 / (noise * rest))
            else:
                total[k] += np.sum((y @ vectors) ** 2 / rest)
    return [float(t) / max(len(b), 1) for t, (b, _) in zip(total, asked, strict=True)]


def open_prior(model: Model, theta: Floats, prior: Floats) -> Floats:
    """Prior standard deviations (P,) where the readings leave parameters open."""
    return family_prior(model, np.where(np.isinf(prior), ordinary(model, theta), prior))


def family_prior(model: Model, prior: Floats) -> Floats:
    """Prior standard deviations (P,), those of shrunk families at least the mean of their pool."""
    std = prior.copy()
    for effect, mine in zip(model.effects, model.slices(), strict=True):
        if effect.groups() is not None:
            pool = effect.pools()
            mean = np.bincount(pool, weights=prior[mine] ** 2) / np.maximum(np.bincount(pool), 1)
            std[mine] = np.maximum(std[mine], np.sqrt(mean)[pool])
    return std


def parameter_factor(p: Predictive, left_out_sigma: float) -> float:
    """Factor, at least 1, by which C is too small where the noise alone is right.

    With it the mean variance on poses left out is the mean square that was found there.

    Args:
        p: what a fit knows.
        left_out_sigma: rms of the whitened residual on poses left out.
    """
    return max(p.least, (left_out_sigma**2 - max(p.scatter, 1.0)) / max(p.left_out, 1e-12))


def position_factor(p: Predictive, left_out_m: float) -> float:
    """Factor, at least 1, by which C is too small for positions.

    With it the mean square error of the positions left out, m², is what was found there: in metres,
    as a band about a position is stated. In units of V the directions that an instrument measures
    best would decide, in which misfits count most.

    Args:
        p: what a fit knows.
        left_out_m: rms of the 3-D position errors on poses left out.
    """
    return max(p.least, (left_out_m**2 - p.scatter_m2) / max(p.left_out_m2, 1e-300))


def variance_spread(found: Variances, fold: Ints) -> float:
    """Return the factor, at least 1, of the variance of predictions.

    Args:
        found: the variances, at the fit.
        fold: (R,) fold of each row.
    """
    if len(fold) > MOST_ROWS:
        return 1.0
    _, at = left_out(found.equations, fold)
    rng, root = np.random.default_rng(SEED), np.linalg.cholesky(found.covariance)
    variance, off, weight = [], [], []
    for _ in range(DRAWS):
        z = rng.standard_normal(len(root))
        try:
            e = equations(found.equations.problem, found.log_std + root @ z)
            residual, one = left_out(e, fold)
        except np.linalg.LinAlgError:
            continue
        variance.append(float(one.sum()))
        off.append(residual)
        weight.append(log_posterior(e) + 0.5 * float(z @ z))
    if not weight:
        return 1.0
    share = np.exp(np.minimum(np.array(weight) - np.median(weight), HEAVIEST))
    share /= share.sum()
    away = np.array(off) - share @ np.array(off)
    mean = share @ (np.array(variance) + np.sum(away**2, axis=1))
    return max(1.0, float(mean / at.sum()))
