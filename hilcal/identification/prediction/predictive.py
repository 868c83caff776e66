"""Covariance of predictions, also where nothing was measured, and the posterior of an arm.

The posterior of a fit holds the strengths of shrunk families at what the evidence chose, zero for
groups that the readings do not need, which says nothing of joint angles never visited. So a group
of a shrunk family has at least the mean variance of its pool as its prior (`Effect.pools`), and a
parameter without a prior one about zero, as where poses are left out (`folds`). With the Jacobian
A (R, P) of the fitted readings, whitened by W, σ² their noise factor, Λ the prior precision,

    C = (AᵀA/σ² + Λ)⁻¹,    Cov(measured − predicted) = κ (σ² W + J C Jᵀ)

W is the stated covariance V plus the excess of the residual over it (see below): a misfit does not
have the shape of an instrument's noise, which is small along the beam. W depends on the residual of
the parameters, these on W and Λ, so that both are computed in turn until W settles. Where the model
has a background, σ is the factor of the instrument's noise in the mixed model; otherwise σ² is the
variance of the whitened residual, at least 1.

κ, at least 1, makes the mean predicted variance of poses left out, in units of V, equal to their
mean square error. With Y the rows of a fold times the root of C, and X the same rows whitened by W,
the variance of its prediction from the other folds is the mean of Y (1 − XᵀX/σ²)⁻¹ Yᵀ.

The uncertainty of the variances of random effects makes C larger by how far it moves the parameters
(`mixed.variances`), and κ is at least its mean effect on predictions (Kackar and Harville, JASA 79
(1984) 853). At given variances rows predicted without their fold are off by e with the variance v.
With x = (log s, η) drawn from its posterior, by weights from the normal approximation at its
maximum x̂, the mean square is E[Σ v] + E|e − E e|²; its ratio to Σ v at x̂ is that least κ. With
both, 92 to 95 % of the other poses of simulated arms are in their 95 % band.

The excess of a residual over the stated noise (`excess`): with r (3,) the residuals of the D
positions, W = V + s² 1, and J C Jᵀ the covariance of their predictions, C that of parameters
estimated with σ² W, s² solves (Mandel and Paule, Anal. Chem. 42 (1970) 1194)

    Σ rᵀ W⁻¹ r = 3 D − Σ tr (σ² W)⁻¹ J C Jᵀ

and the attitudes' part of V is multiplied by their χ² over its degrees of freedom; either only
where its own χ² is larger than chance allows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.errors import CannotAnswerError
from hilcal.identification.carried.carried_prior import coordinates_of, scales_of
from hilcal.identification.carried.posterior import Posterior, PosteriorEffect, Source, determined
from hilcal.identification.fit import Fit, require_gc
from hilcal.identification.folds import distinct_poses, ordinary_magnitudes, random_folds
from hilcal.identification.gauss_newton import derivative, whitened_jacobian
from hilcal.identification.mixed_fit import INSTRUMENT, mixed_fit_at
from hilcal.identification.noise.arm_scatter import with_missing_scatter
from hilcal.identification.prediction.collinear_conditions import Proxy, proxies
from hilcal.identification.prediction.other_temperatures import (
    OtherTemperatures,
    other_temperatures,
)
from hilcal.identification.residual import residual
from hilcal.mixed.equations import equations, left_out
from hilcal.mixed.families import families_of
from hilcal.mixed.variances import Variances, log_posterior
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import ArmScatter, Readings, States, ranges_of
from hilcal.readings.same_readings import prints
from hilcal.readings.whitening import Mode, Whitening, whitening
from hilcal.regression.schur import schur_complement
from hilcal.store.revision import utc_now
from hilcal.store.rows import content_hash
from hilcal.types import Floats, Ints

ITERATIONS = 20  # of the noise factor; it converges within a few
MOST_ROUNDS = 6  # most times that the covariance is computed anew as W changes; a choice
ROUNDING = 1e-9  # least share of a direction's information that is not of one fold
FRAMES_FREEDOM = 10.0
"""Prior of frames without one, in units of that of other frames; a choice: half a percent of the
motion of these is lost."""
MOST_ROWS = 600  # elements beyond which variances count as known: of 200 poses of a real UR10
# the factor is 1.00 to 1.06, and a draw costs the cube of the rows; a choice
DRAWS, SEED = 30, 0  # of the posterior; a choice: 20 poses of that UR10 give 1.19 to 1.43 by seed
# log of the largest weight of a draw over the median: tails are not normal; a choice
LARGEST_LOG_WEIGHT = 2.0
EXCESS_LEVEL = 0.0005
"""P-value of χ² below which there is an excess: that of `diagnosis.noise.MISFIT_ALARM`."""
NEGLIGIBLE_MOTION = 1e-3
"""Share of the largest motion of the parameters by the variances that is negligible; a choice."""
LEVERAGE_SAMPLE = 400  # measurements, evenly spaced, for a mean leverage, for speed; a choice
NEGLIGIBLE_CHANGE = 0.05  # relative change of s² and of the factor that is negligible; a choice


@dataclass(frozen=True, slots=True)
class Excess:
    """An addition to the stated covariance."""

    position: float = 0.0  # s² of each coordinate of a measured position, m²
    attitude: float = 1.0  # factor of the variances of the attitude

    @property
    def is_zero(self) -> bool:
        """Whether there is none."""
        return self.position == 0.0 and self.attitude == 1.0

    def is_close(self, other: "Excess") -> bool:
        """Whether the difference to another one is negligible."""
        a, b = self.position, other.position
        return (
            abs(a - b) <= NEGLIGIBLE_CHANGE * max(a, b)
            and abs(self.attitude / other.attitude - 1) <= NEGLIGIBLE_CHANGE
        )

    def widened(self, covariance: Floats, share: float = 1.0) -> Floats:
        """Return covariances (N, m, m) with the excess, of s² a share."""
        place = np.arange(covariance.shape[-1]) < 3
        root = np.sqrt(np.where(place, 1.0, self.attitude))
        extra = np.where(place, share * self.position, 0.0)
        return np.asarray(covariance * root[:, None] * root + np.diag(extra))

    def of_readings(self, readings: Readings, mode: Mode) -> Readings:
        """Return readings with the excess; a deflection, the difference of two, has s² in all."""
        share = 0.5 if mode == "deflection" else 1.0
        return replace(readings, covariance=self.widened(readings.covariance, share))


NO_EXCESS = Excess()


def excess(
    raw: Floats, stated: Whitening, used: Whitening, rows: Floats, root: Floats,
    previous: Excess = NO_EXCESS,
) -> Excess:  # fmt: skip
    """Return the excess of a residual (D, m) over the stated noise.

    V is that of `stated`. C, with the root (P, K) over its noise factor, belongs to the scaling
    `used` of the same measurements, which whitens the rows (R, P) and has the excess `previous`; a
    part with such an excess is not tested against chance again.
    """
    chosen = np.linspace(0, len(raw) - 1, min(len(raw), LEVERAGE_SAMPLE)).astype(int)
    spread = _spread(used, rows, root, chosen)
    position, attitude = 0.0, 1.0
    for part in (slice(0, 3), slice(3, 6))[: raw.shape[1] // 3]:
        values, vectors = np.linalg.eigh(stated.covariance[:, part, part])
        if values.min() <= 0.0:
            continue
        r = raw[:, part]
        share = np.linalg.solve(used.covariance[chosen, part, part], spread[:, part, part])
        free = r.size - len(raw) * float(np.trace(share, axis1=1, axis2=2).mean())
        square = np.einsum("dij,di->dj", vectors, r) ** 2
        total = float(np.sum(square / values))
        sure = previous.attitude > 1.0 if part.start else previous.position > 0.0
        if (
            free < 1.0
            or total <= free
            or (not sure and float(scipy.stats.chi2.sf(total, free)) >= EXCESS_LEVEL)
        ):
            continue
        if part.start:
            attitude = total / free
        else:
            from scipy.optimize import brentq  # slow to import

            most = float(square.sum()) / free
            position = float(
                brentq(lambda s, q=square, e=values, f=free: np.sum(q / (e + s)) - f, 0.0, most)
            )
    return Excess(position, attitude)


def _spread(w: Whitening, rows: Floats, root: Floats, measurements: Ints) -> Floats:
    """J C Jᵀ (S, m, m) of some measurements."""
    out, row, first = np.zeros((len(measurements), w.m, w.m)), 0, 0
    for b in w.buckets:
        groups, size = len(b.loaded), b.factor.shape[-1]
        count = size // w.m
        chosen = np.flatnonzero((measurements >= first) & (measurements < first + groups * count))
        group, place = np.divmod(measurements[chosen] - first, count)
        part = rows[row : row + groups * size].reshape(groups, size, -1)[group] @ root
        part = np.linalg.pinv(b.factor[group]) @ part
        part = part.reshape(len(chosen), count, w.m, -1)[np.arange(len(chosen)), place]
        out[chosen] = part @ np.swapaxes(part, 1, 2)
        row, first = row + groups * size, first + groups * count
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Predictive:
    """The predictive distribution of a fit."""

    model: Model
    theta: Floats  # (P,) its parameters
    covariance: Floats  # (P, P) C
    by_variances: Floats  # (P, K) root of the part of C by the uncertainty of the variances
    prior: Floats  # (P,) prior standard deviations, Λ = diag(prior)⁻²
    excess: Excess  # of W over V
    noise: float  # σ², noise factor of the fitted readings in units of W
    factor: float  # κ
    least_factor: float  # lower bound of κ, by the uncertainty of the variances
    pose_m2: Floats  # (D,) variance of a fitted 3-D position's prediction, by the parameters alone,
    # from the readings at other poses, m²
    scatter: float  # mean variance of the fitted readings by σ² W, in units of V
    left_out: float  # mean variance of the predictions of poses left out by C, in units of V
    scatter_m2: float  # `scatter` of a 3-D position, m²
    left_out_m2: float  # `left_out` of a 3-D position, m²
    arm_scatter: ArmScatter | None  # the arm's, estimated, which V contains
    other_temperatures: OtherTemperatures | None  # None for deflections, in which these cancel
    proxies: tuple[Proxy, ...]  # conditions that may stand for those that the model reads

    def noise_whitening(self, readings: Readings, mode: Mode) -> Whitening:
        """Return the scaling of other readings, with the arm's estimated scatter in V."""
        scattered = with_missing_scatter(self.model.cell, readings, self.arm_scatter)
        # A scatter that readings of one arrival share would change the order of measurements.
        return whitening(replace(scattered, common=readings.common), mode, "gc")

    def prediction_covariance(self, prediction: Prediction, w: Whitening) -> Floats:
        """Return κ J C Jᵀ (D, m, m) of predicted measurements, and what other conditions add."""
        jacobian = w.raw(derivative(self.model, prediction, self.theta, w.m, w.mode))
        spread = np.einsum("dip,pq,djq->dij", jacobian, self.covariance, jacobian, optimize=True)
        covariance = np.asarray(self.factor * spread)
        if self.other_temperatures is not None:
            states = prediction.situation.states[w.reading]
            covariance += self.other_temperatures.of_readings(states, w.m, self.model.cell)
        position = prediction.observation.position
        for proxy in self.proxies:
            other = proxy.applied(prediction.situation.states)
            if other is not None:
                moved = self.model.predict(other, self.theta).observation.position - position
                moved = w.raw(moved)
                covariance[:, :3, :3] += proxy.probability * moved[:, :, None] * moved[:, None]
        return covariance

    def position_m2(self, prediction: Prediction, w: Whitening) -> Floats:
        """Return tr J C Jᵀ (D,) of predicted 3-D positions, m², as `pose_m2` of the fitted ones."""
        j = w.raw(derivative(self.model, prediction, self.theta, 3, w.mode))
        return np.asarray(np.einsum("dip,pq,diq->d", j, self.covariance, j, optimize=True))

    def reading_covariance(self, prediction: Prediction, w: Whitening) -> Floats:
        """Return κ (σ² W + J C Jᵀ) (D, m, m), of measured minus predicted."""
        return self.prediction_covariance(prediction, w) + self.noise_covariance(w)

    def noise_covariance(self, w: Whitening) -> Floats:
        """Return κ σ² W (D, m, m)."""
        return self.factor * self.noise * self.excess.widened(w.covariance)


def predictive_of(fit: Fit) -> Predictive:
    """Return the predictive distribution of a gc-scaled fit."""
    inliers, sigma = fit.readings[~fit.outlier], fit.holdout.rms_sigma
    return predictive(fit.model, fit.theta, fit.solution.prior, inliers, fit.mode, sigma)


def predictive(
    model: Model, theta: Floats, prior: Floats, fitted: Readings, mode: Mode, left_out_sigma: float
) -> Predictive:
    """Return the predictive distribution of a gc-scaled fit.

    `prior` (P,) are the fit's prior standard deviations, infinite for flat parameters, zero for
    dropped groups; the prior that the model carries takes their place. `fitted` are its readings
    without gross errors, `left_out_sigma` the rms of the whitened residual on poses left out.
    """
    stated = whitening(fitted, mode, "gc")
    prediction = model.predict(fitted.states, theta)
    raw = residual(fitted, prediction, stated)
    pose = distinct_poses(fitted)[stated.reading]
    fold = random_folds(pose)
    noise_factor, least, by_variances = None, 1.0, np.zeros((model.size, 0))
    variances = _variances_of_random(model, fitted, mode, theta)
    if variances is not None:
        least = variance_spread(variances, stated.rows_of(fold))
        by_variances = _by_variances(variances, scales_of(model))
    if model.background and variances is not None:
        arm = fitted.arm_scatter  # the standard deviations are in units of its factor
        noise_factor = (variances.std(INSTRUMENT) if arm is None else arm.instrument_factor) ** 2
        prior = prior.copy()
        for effect, columns in zip(model.effects, model.slices(), strict=True):
            if effect.name in model.random:  # see `identification.background.background_model`
                prior[columns] *= np.sqrt(noise_factor)
    space = coordinates_of(model)
    chosen = space.prior(prior)
    std = space.prior(open_prior(model, theta, prior))
    std[np.isinf(std)] = 1.0
    # The pull of the fit's own prior on its parameters, in coordinates of unit prior variance.
    held = np.isfinite(chosen) & (chosen > 0)
    pull = np.where(held, space.of_theta(theta) * std / np.where(held, chosen, 1.0) ** 2, 0.0)

    def rows_in(w: Whitening) -> Floats:
        """Whitened derivatives (R, P) by coordinates of unit prior variance."""
        return space.columns(whitened_jacobian(model, prediction, theta, w, parameters)) * std

    parameters, extra, w = np.arange(model.size), Excess(), stated
    for step in range(MOST_ROUNDS + 1):
        a = rows_in(w)
        values, vectors = np.linalg.eigh(a.T @ a)
        values, white = np.maximum(values, 0.0), w.whiten(raw).reshape(-1)
        noise = 1.0 if noise_factor is None else noise_factor
        for _ in range(ITERATIONS if noise_factor is None else 0):
            free = max(w.rank - float(np.sum(values / (values + noise))), 1.0)
            noise = max(1.0, float(white @ white) / free)
        root = vectors * np.sqrt(noise / (values + noise))
        if (
            noise_factor is not None or step == MOST_ROUNDS
        ):  # with a background, which holds any misfit
            break
        # The residual of the parameters with this noise and this prior, and its leverage.
        moved = root @ (root.T @ (a.T @ white / noise - pull))
        refitted = model.predict(fitted.states, theta + space.transform(std * moved))
        new = excess(residual(fitted, refitted, stated), stated, w, a, root / np.sqrt(noise), extra)
        if new.is_close(extra):
            break
        # The geometric mean of both; half of s² where one has none.
        s2, old = new.position, extra.position
        middle = float(np.sqrt(s2 * old)) if min(s2, old) > 0 else (s2 + old) / 2
        half = Excess(middle, float(np.sqrt(new.attitude * extra.attitude)))
        extra = new if step == 0 else half
        w = whitening(extra.of_readings(fitted, mode), mode, "gc")
    scatter, b, wider = noise, a, extra.widened(stated.covariance)
    if not extra.is_zero:
        share = np.trace(np.linalg.solve(stated.covariance, wider), axis1=1, axis2=2)
        scatter = noise * float(share.mean()) / w.m
        b = rows_in(stated)
    position = w.raw(derivative(model, prediction, theta, 3, mode)).reshape(-1, model.size)
    position = space.columns(position) * std
    rows, points = w.rows_of(fold), np.repeat(fold, 3)
    left_out, left_out_m2 = (
        float(v.mean())
        for v in left_out_variances(a, rows, ((b, rows), (position, points)), root, noise)
    )
    (of_pose,) = left_out_variances(
        a, w.rows_of(pose), ((position, np.repeat(pose, 3)),), root, noise
    )
    by_pose = of_pose.reshape(-1, 3).sum(axis=1)
    scatter_m2 = noise * float(np.trace(wider[:, :3, :3], axis1=1, axis2=2).mean())
    thermal = None
    if mode == "absolute":
        thermal = other_temperatures(model, fitted, w, a, root, noise)

    def log_odds(states: States) -> float:
        """−Δ_u/2 of the model in states with the conditions of a proxy."""
        other = w.whiten(residual(fitted, model.predict(states, theta), w)).reshape(-1)
        along = root.T @ (a.T @ (other - white)) / noise
        return float(along @ along - (other @ other - white @ white) / noise) / 2

    alternatives = proxies(model, fitted.states, log_odds)
    root = space.transform(root * std[:, None])
    factor = max(least, left_out_sigma**2 / (scatter + left_out))
    return Predictive(
        model, theta, root @ root.T + by_variances @ by_variances.T, by_variances,
        open_prior(model, theta, prior), extra, noise, factor, least, by_pose, scatter, left_out,
        scatter_m2, 3 * left_out_m2, fitted.arm_scatter, thermal, alternatives,
    )  # fmt: skip


def left_out_variances(
    a: Floats, fold: Ints, predicted: Sequence[tuple[Floats, Ints]], root: Floats, noise: float
) -> list[Floats]:
    """Return the variances of each set of `predicted` rows (R',), each row without its own fold.

    A set is rows (R', P) with their folds (R',). `a` (R, P) are the fitted rows in units of W, and
    `fold` (R,) their folds; `root` (P, K) is the root of C, and `noise` is σ².
    """
    out, moved = [np.zeros(len(b)) for b, _ in predicted], [b @ root for b, _ in predicted]
    fitted = a @ root
    for f in range(int(fold.max(initial=-1)) + 1):
        x = fitted[fold == f]
        few = len(x) < len(root)
        values, vectors = np.linalg.eigh(x @ x.T if few else x.T @ x)
        remainder = np.maximum(1.0 - values / noise, ROUNDING)
        for k, (_, folds) in enumerate(predicted):
            chosen = folds == f
            y = moved[k][chosen]
            if few:
                along = y @ (x.T @ vectors)
                variance = np.sum(y**2, axis=1) + np.sum(along**2 / (noise * remainder), axis=1)
            else:
                variance = np.sum((y @ vectors) ** 2 / remainder, axis=1)
            out[k][chosen] = variance
    return out


def open_prior(model: Model, theta: Floats, prior: Floats) -> Floats:
    """Prior standard deviations (P,) where the readings leave parameters open.

    Frames without a prior follow those with one: where all poses have one orientation, the base
    takes up any place of the target, and must be free to.
    """
    std = np.where(np.isinf(prior), ordinary_magnitudes(model, theta), prior)
    units = np.array([p.unit for e in model.effects for p in e.parameters])
    frames = np.array(
        [e.role in FRAME_ROLES for e in model.effects for p in e.parameters], dtype=np.bool_
    )
    for unit in np.unique(units[frames]):
        held, free = (frames & (units == unit) & part for part in (std == prior, np.isinf(prior)))
        std[free] = np.maximum(std[free], FRAMES_FREEDOM * prior[held].max(initial=0.0))
    return family_prior(model, std)


def family_prior(model: Model, prior: Floats) -> Floats:
    """Prior standard deviations (P,), those of shrunk families at least the mean of their pool."""
    std = prior.copy()
    for effect, rows in zip(model.effects, model.slices(), strict=True):
        if effect.groups() is not None:
            pool = effect.pools()
            mean = np.bincount(pool, weights=prior[rows] ** 2) / np.maximum(np.bincount(pool), 1)
            std[rows] = np.maximum(std[rows], np.sqrt(mean)[pool])
    return std


def _variances_of_random(
    model: Model, fitted: Readings, mode: Mode, theta: Floats
) -> Variances | None:
    """Variances of a model's random effects; None without any, or where they count as known."""
    if model.background:
        return mixed_fit_at(model, fitted, mode, theta)
    lines = {e.name for e in model.effects if e.groups() is not None}
    shrunk = lines | set(model.random)
    # a carried prior states the sizes of its effects
    if not shrunk or model.prior is not None or fitted.value.size > MOST_ROWS:
        return None
    # As `with_shrunk_effects` fits them, with the arm's scatter in the covariance. Flat effects
    # have their prior in C; without it the variances would move an undetermined one at will.
    magnitude = ordinary_magnitudes(model, theta)
    parts = zip(model.effects, model.slices(), strict=True)
    known = {e.name: magnitude[rows] for e, rows in parts if e.name not in shrunk}
    families = families_of(model, lines=lines, known=known)
    return mixed_fit_at(model, replace(fitted, scatter_stated=True), mode, theta, families)


def _by_variances(variances: Variances, scale: Floats) -> Floats:
    """Root (P, K) of the parameters' covariance by the uncertainty of the variances.

    `scale` (P,) are their ordinary magnitudes, in which negligible directions are left out.
    """
    e, root = variances.equations, np.linalg.cholesky(variances.covariance)
    motion = e.problem.parameters(e.sensitivity, len(scale)) @ root / scale[:, None]
    u, s, _ = np.linalg.svd(motion, full_matrices=False)
    kept = s > NEGLIGIBLE_MOTION * max(s.max(initial=0.0), 1e-300)
    return np.asarray(scale[:, None] * u[:, kept] * s[kept])


def position_factor(p: Predictive, left_out_m: float) -> float:
    """Factor, at least 1, by which C is too small for positions.

    The stated mean square error of positions left out is then the observed one, in m². In units of
    V the directions that an instrument measures best would decide, in which misfits count most.
    """
    return max(p.least_factor, (left_out_m**2 - p.scatter_m2) / max(p.left_out_m2, 1e-300))


def variance_spread(variances: Variances, fold: Ints) -> float:
    """Return the factor, at least 1, of the variance of predictions, by the folds (R,) of rows."""
    if len(fold) > MOST_ROWS:
        return 1.0
    _, reference = left_out(variances.equations, fold)
    rng, root = np.random.default_rng(SEED), np.linalg.cholesky(variances.covariance)
    variance, off, weight = [], [], []
    for _ in range(DRAWS):
        z = rng.standard_normal(len(root))
        try:
            e = equations(variances.equations.problem, variances.log_std + root @ z)
            residual, v = left_out(e, fold)
        except np.linalg.LinAlgError:
            continue
        variance.append(float(v.sum()))
        off.append(residual)
        weight.append(log_posterior(e) + 0.5 * float(z @ z))
    if not weight:
        return 1.0
    share = np.exp(np.minimum(np.array(weight) - np.median(weight), LARGEST_LOG_WEIGHT))
    share /= share.sum()
    away = np.array(off) - share @ np.array(off)
    mean = share @ (np.array(variance) + np.sum(away**2, axis=1))
    return max(1.0, float(mean / reference.sum()))


def posterior_of(fit: Fit, source: Source | None = None) -> Posterior:
    """Return the posterior of the arm after a fit; arguments and errors as of `Posterior.of`."""
    require_gc(fit, "a prior")
    model, cell = fit.model, fit.model.cell
    effects = [e for e in model.effects if belongs_to_arm(e)]
    if not effects:
        raise CannotAnswerError(
            f"the model {' + '.join(model.names) or 'of the nominal arm'} has no effect of the "
            "arm, only of the setup: there is nothing to carry over; run hilcal refine first"
        )
    of_arms = np.concatenate([np.full(len(e.parameters), belongs_to_arm(e)) for e in model.effects])
    interest, scale = np.flatnonzero(of_arms), scales_of(model)
    information, precision = _information(fit, scale)
    marginal = determined(schur_complement(information, interest))
    scale = scale[interest]
    used, source = fit.readings[~fit.outlier], source or Source(created=utc_now())
    return Posterior(
        arm=cell.arm.name,
        links=cell.arm.links,
        mode=fit.mode,
        effects=tuple(PosteriorEffect(e.name, dict(e.options)) for e in effects),
        names=tuple(f"{e.name}.{p.name}" for e in effects for p in e.parameters),
        units=tuple(p.unit for e in effects for p in e.parameters),
        scale=scale,
        mean=fit.theta[interest],
        information=marginal / (scale[:, None] * scale),
        own_precision=precision[interest] / scale**2,
        scatter=fit.readings.arm_scatter,
        ranges=ranges_of(used.states, cell.arm.units),
        prints=prints(fit.readings),
        source=replace(
            source, readings_sha256=content_hash(fit.readings), n_readings=len(fit.readings)
        ),
    )


def belongs_to_arm(effect: Effect) -> bool:
    """Whether an effect is of the arm, so that another campaign of it has it, too."""
    return not (type(effect).of_setup or effect.role in FRAME_ROLES)


def _information(fit: Fit, scale: Floats) -> tuple[Floats, Floats]:
    """M (P, P) and the part of its diagonal by the effects' own priors, in ordinary magnitudes."""
    model, s = fit.model, fit.solution
    p, w = predictive_of(fit), fit.whitening
    if not p.excess.is_zero:
        w = whitening(p.excess.of_readings(fit.readings[~fit.outlier], fit.mode), fit.mode, "gc")
    a = whitened_jacobian(model, s.prediction, s.theta, w, np.arange(model.size))
    a *= scale
    std = np.where(np.isinf(s.prior), np.inf, p.prior) / scale
    with np.errstate(divide="ignore"):
        precision = np.where(std > 0, 1.0 / std**2, np.inf)
    # A family that was dropped entirely has its ordinary magnitude.
    precision[np.isinf(precision)] = 1.0
    # With κ the mean variance on poses left out is the mean square of the whitened residual there.
    square = fit.holdout.rms_sigma**2
    kappa = max(p.least_factor, (square - max(p.scatter, 1.0)) / max(p.left_out, 1e-12))
    return (a.T @ a / p.noise + np.diag(precision)) / kappa, precision / kappa
