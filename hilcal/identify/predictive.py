"""Covariance of predictions, also where nothing was measured.

The posterior of a fit holds the strengths of shrunk families at what the evidence chose, zero for
the groups that the readings do not need. That says nothing of joint angles that were never
visited: there the dropped harmonics of a transmission error, too, add up to its size. So

- a group of a shrunk family has at least the mean variance of its pool (of the whole family, or of
  an octave of harmonics, see `Effect.pools`) as its prior;
- a parameter without a prior has one about zero of its ordinary magnitude, or the rms of its
  effect's parameters if more, as where poses are left out (see `holdout`);

and with the whitened Jacobian A (R, P) of the fitted readings, σ² their noise factor, Λ the prior
precision,

    C = (AᵀA/σ² + Λ)⁻¹,    Cov(prediction) = κ (σ² V + J C Jᵀ)

where κ, at least 1, makes the mean variance on a pose left out, σ² tr (1 − H)⁻¹/R, H (R, R) the
leverage of its R rows, equal to the mean square that was found on poses left out: a misfit is no
noise, and repeats itself in new poses.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode, Whitening, whitening
from hilcal.identify.coordinates import coordinates_of
from hilcal.identify.gauss_newton import whitened_jacobian
from hilcal.identify.holdout import ordinary
from hilcal.identify.residual import residual
from hilcal.model import Model, Prediction
from hilcal.types import Floats, Ints

ITERATIONS = 20
"""Fixed-point iterations of the noise factor; it converges within a few."""
MOST_LEVERAGE = 0.99
"""Bound on the leverage of a row, since that of a row which alone tells something is 1."""
CHUNK = 4096
"""Measurements that are taken at once, for memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Predictive:
    """What a fit knows of readings that it has not seen.

    Attributes:
        model: the model.
        theta: (P,) its parameters.
        covariance: (P, P) C.
        noise: σ², noise factor of the fitted readings.
        factor: κ.
        leverage: (D,) largest eigenvalue of a fitted measurement's leverage: variance of the
            prediction over that of the noise.
        left_out: mean variance of the predictions of poses left out by C, in units of the noise.
    """

    model: Model
    theta: Floats
    covariance: Floats
    noise: float
    factor: float
    leverage: Floats
    left_out: float

    def of_prediction(self, prediction: Prediction, w: Whitening) -> Floats:
        """Return κ J C Jᵀ (D, m, m) of predicted measurements."""
        jacobian = w.raw(self.model.jacobian(prediction, self.theta, w.m))
        spread = np.einsum("dip,pq,djq->dij", jacobian, self.covariance, jacobian, optimize=True)
        return np.asarray(self.factor * spread)

    def of_reading(self, prediction: Prediction, w: Whitening) -> Floats:
        """Return κ (σ² V + J C Jᵀ) (D, m, m), of measured minus predicted."""
        return self.of_prediction(prediction, w) + self.factor * self.noise * w.covariance


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
    w = whitening(fitted, mode, "gc")
    prediction = model.predict(fitted.states, theta)
    white = w.whiten(residual(fitted, prediction, w)).reshape(-1)
    of = coordinates_of(model)
    std = of.prior(open_prior(model, theta, prior))
    std[np.isinf(std)] = 1.0
    a = of.columns(whitened_jacobian(model, prediction, theta, w, np.arange(model.size)))
    a *= std
    values, vectors = np.linalg.eigh(a.T @ a)
    values = np.maximum(values, 0.0)
    rss, noise = float(white @ white), 1.0
    for _ in range(ITERATIONS):
        free = max(w.rank - float(np.sum(values / (values + noise))), 1.0)
        noise = max(1.0, rss / free)
    root = vectors * np.sqrt(noise / (values + noise))
    shares = []
    for k in range(0, len(a), CHUNK * w.m):
        part = (a[k : k + CHUNK * w.m] @ root).reshape(-1, w.m, len(root))
        shares.append(np.linalg.eigvalsh(part @ np.swapaxes(part, 1, 2)) / noise)
    leverage = np.clip(np.concatenate(shares), 0.0, MOST_LEVERAGE).max(axis=1)
    left_out = _left_out(a, root, w.rows_of(fitted.pose[w.reading]), noise)
    root = of.transform(root * std[:, None])
    factor = max(1.0, left_out_sigma**2 / (noise + left_out))
    return Predictive(model, theta, root @ root.T, noise, factor, leverage, left_out)


def _left_out(a: Floats, root: Floats, pose: Ints, noise: float) -> float:
    """Mean variance of the rows (R, P) of each pose, predicted without it, beside the noise."""
    order = np.argsort(pose, kind="stable")
    total = 0.0
    for mine in np.split(order, np.flatnonzero(np.diff(pose[order])) + 1):
        part = a[mine] @ root
        small = part @ part.T if len(part) < len(root) else part.T @ part
        h = np.clip(np.linalg.eigvalsh(small) / noise, 0.0, MOST_LEVERAGE)
        total += noise * float(np.sum(h / (1 - h)))
    return total / max(len(a), 1)


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

    With it the mean variance on a pose left out is the mean square that was found there.

    Args:
        p: what a fit knows.
        left_out_sigma: rms of the whitened residual on poses left out.
    """
    return max(1.0, (left_out_sigma**2 - max(p.noise, 1.0)) / max(p.left_out, 1e-12))
