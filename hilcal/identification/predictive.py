"""Covariance of predictions, also where nothing was measured, and what a fit taught of its arm.

The posterior of a fit holds the strengths of shrunk families at what the evidence chose, zero for
the groups that the readings do not need. That says nothing of joint angles that were never
visited. So a group of a shrunk family has at least the mean variance of its pool as its prior
(`Effect.pools`), and a parameter without a prior one about zero of its ordinary magnitude, or the
rms of its effect's parameters if more, as where poses are left out (`folds`). With the Jacobian
A (R, P) of the fitted readings, whitened by W, σ² their noise factor, Λ the prior precision,

    C = (AᵀA/σ² + Λ)⁻¹,    Cov(measured − predicted) = κ (σ² W + J C Jᵀ)

W is the stated covariance V, with more for positions or attitudes where their residual asks for it:
a misfit has not the shape of an instrument's noise, which is small along the beam. W, C and the
residual that parameters with this W and Λ leave belong together; they are found by turns. Where the
model has a background its standard deviations are in units of the instrument's noise, and σ is the
factor of that as the mixed model estimates it; otherwise σ² is from the residual, at least 1.

κ, at least 1, makes the mean variance on poses left out, in units of V, equal to the mean square
that was found there. The variance is that of the folds as they are left out, F of rows Y, with X
the same whitened by W and multiplied by the root of C: the mean of Y (1 − XᵀX/σ²)⁻¹ Yᵀ. With few
poses a fold may be all that tells of a direction; its variance is that of the prior then.

The uncertainty of the variances of a background makes C larger by how far it moves the parameters
(`mixed.prediction`), and κ is at least what it makes of predictions on the whole (Kackar and
Harville, JASA 79 (1984) 853). At given variances rows that are predicted without their fold are off
by e with the variance v (`mixed.prediction.left_out`). With x = (log s, η) drawn from its
posterior, by weights from the normal approximation at its maximum x̂, the mean square is
E[Σ v] + E|e − E e|²; its ratio to Σ v at x̂ is that least κ. Both hold that motion, once where it
acts and once as a mean: with 20, 30 and 60 poses of 30 simulated arms that have all effects, 95, 92
and 95 % of other poses are then in their 95 % band, and 93, 89 and 93 % with κ alone.

What a residual has beyond the stated noise (`excess`): with r (3,) the residuals of the D
positions, V their covariance, W = V + s² 1, and J C Jᵀ the covariance of their predictions, C that
of parameters estimated with σ² W, s² solves (Mandel and Paule, Anal. Chem. 42 (1970) 1194, for the
scatter between laboratories beyond what each states)

    Σ rᵀ W⁻¹ r = 3 D − Σ tr (σ² W)⁻¹ J C Jᵀ

and the attitudes' part of V is multiplied by their χ² over its degrees of freedom; either only
where its own χ² is larger than chance allows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.carried import coordinates_of
from hilcal.identification.fit import Fit
from hilcal.identification.folds import distinct_poses, ordinary, random_folds
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.mixed_fit import INSTRUMENT, mixed_fit_at
from hilcal.identification.posterior import Posterior, PosteriorEffect, Source, determined
from hilcal.identification.priors import scales_of
from hilcal.identification.residual import residual
from hilcal.mixed.equations import equations, left_out
from hilcal.mixed.variances import Variances, log_posterior
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import Readings, ranges_of
from hilcal.readings.same_readings import prints
from hilcal.readings.whitening import Mode, Whitening, whitening
from hilcal.regression.schur import schur_complement
from hilcal.store.revision import utc_now
from hilcal.store.rows import content_hash
from hilcal.types import Floats, Ints

ITERATIONS = 20  # of the noise factor; it converges within a few
ROUNDS = 6  # most times that the covariance is computed anew as W changes; a choice
MOST_LEVERAGE = 0.99  # of a row, since that of a row which alone tells something is 1
ROUNDING = 1e-9  # least share of a direction's information that is not of one fold
CHUNK = 4096  # measurements that are taken at once, for memory
MOST_ROWS = 600  # elements beyond which variances are taken for known: of 200 poses of a real UR10
# the factor is 1.00 to 1.06, and a draw costs the cube of the rows; a choice
DRAWS, SEED = 30, 0  # of the posterior; a choice: 20 poses of that UR10 give 1.19 to 1.43 by seed
# log of the largest weight of a draw over the median: tails are not normal; a choice
HEAVIEST = 2.0
CHANCE = 0.0005  # p-value of χ² below which there is an excess: that of `diagnosis.noise_verdict`
SOME = 400  # measurements, evenly spaced, from which a mean leverage is taken, for speed; a choice
SAME = 0.05  # relative change of s² and of the factor that makes no difference; a choice


@dataclass(frozen=True, slots=True)
class Excess:
    """What is added to the stated covariance."""

    position: float = 0.0  # s² of each coordinate of a measured position, m²
    attitude: float = 1.0  # factor of the variances of the attitude

    @property
    def none(self) -> bool:
        """Whether there is none."""
        return self.position == 0.0 and self.attitude == 1.0

    def near(self, other: "Excess") -> bool:
        """Whether the difference to another one does not matter."""
        a, b = self.position, other.position
        return abs(a - b) <= SAME * max(a, b) and abs(self.attitude / other.attitude - 1) <= SAME

    def halfway(self, other: "Excess") -> "Excess":
        """Return one between this and another: the geometric mean, half where one has none."""
        both = self.position, other.position
        middle = float(np.sqrt(both[0] * both[1])) if min(both) > 0 else sum(both) / 2
        return Excess(middle, float(np.sqrt(self.attitude * other.attitude)))

    def widened(self, covariance: Floats, share: float = 1.0) -> Floats:
        """Return covariances (N, m, m) with it; with a share of s²."""
        place = np.arange(covariance.shape[-1]) < 3
        root = np.sqrt(np.where(place, 1.0, self.attitude))
        more = np.where(place, share * self.position, 0.0)
        return np.asarray(covariance * root[:, None] * root + np.diag(more))

    def of_readings(self, readings: Readings, mode: Mode) -> Readings:
        """Return readings with it; a deflection, the difference of two, has s² in all."""
        share = 0.5 if mode == "deflection" else 1.0
        return replace(readings, covariance=self.widened(readings.covariance, share))


NONE = Excess()


def excess(
    raw: Floats,
    stated: Whitening,
    used: Whitening,
    rows: Floats,
    root: Floats,
    before: Excess = NONE,
) -> Excess:
    """Return what a residual (D, m) has beyond the stated noise.

    V is stated; C, of root (P, K) over its noise factor, was found with another scaling of the same
    measurements, by which rows (R, P) are whitened, and which has some excess `before` already: a
    part that has some is not asked for chance again.
    """
    spread, every = _spread(used, rows, root), _every(len(raw))
    position, attitude = 0.0, 1.0
    for part in (slice(0, 3), slice(3, 6))[: raw.shape[1] // 3]:
        values, vectors = np.linalg.eigh(stated.covariance[:, part, part])
        if values.min() <= 0.0:
            continue
        r = raw[:, part]
        share = np.linalg.solve(used.covariance[every, part, part], spread[:, part, part])
        free = r.size - len(raw) * float(np.trace(share, axis1=1, axis2=2).mean())
        square = np.einsum("dij,di->dj", vectors, r) ** 2
        total = float(np.sum(square / values))
        known = before.attitude > 1.0 if part.start else before.position > 0.0
        if free < 1.0 or total <= free or (not known and float(chi2.sf(total, free)) >= CHANCE):
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


def _every(count: int) -> Ints:
    return np.linspace(0, count - 1, min(count, SOME)).astype(int)


def _spread(w: Whitening, rows: Floats, root: Floats) -> Floats:
    """J C Jᵀ (S, m, m) of some measurements, evenly spaced."""
    every = _every(len(w.reading))
    out, at, first = np.zeros((len(every), w.m, w.m)), 0, 0
    for b in w.buckets:
        groups, size = len(b.loaded), b.factor.shape[-1]
        each = size // w.m
        chosen = np.flatnonzero((every >= first) & (every < first + groups * each))
        group, place = np.divmod(every[chosen] - first, each)
        part = rows[at : at + groups * size].reshape(groups, size, -1)[group] @ root
        part = np.linalg.pinv(b.factor[group]) @ part
        part = part.reshape(len(chosen), each, w.m, -1)[np.arange(len(chosen)), place]
        out[chosen] = part @ np.swapaxes(part, 1, 2)
        at, first = at + groups * size, first + groups * each
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Predictive:
    """What a fit knows of readings that it has not seen."""

    model: Model
    theta: Floats  # (P,) its parameters
    covariance: Floats  # (P, P) C
    prior: Floats  # (P,) prior standard deviations, Λ = diag(prior)⁻²
    excess: Excess  # what W has beyond V
    noise: float  # σ², noise factor of the fitted readings in units of W
    factor: float  # κ
    least: float  # what κ is at least, by the uncertainty of the variances
    leverage: Floats  # (D,) largest eigenvalue of the variance of a fitted measurement's prediction
    # over that of the noise
    scatter: float  # mean variance of the fitted readings by σ² W, in units of V
    left_out: float  # mean variance of the predictions of poses left out by C, in units of V
    scatter_m2: float  # the first of both of a 3-D position, m²
    left_out_m2: float  # the second

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


def predictive_of(fit: Fit) -> Predictive:
    """Return what a gc-scaled fit knows of other readings."""
    kept, sigma = fit.readings[~fit.outlier], fit.holdout.rms_sigma
    return predictive(fit.model, fit.theta, fit.solution.prior, kept, fit.mode, sigma)


def predictive(
    model: Model, theta: Floats, prior: Floats, fitted: Readings, mode: Mode, left_out_sigma: float
) -> Predictive:
    """Return what a gc-scaled fit knows of other readings.

    Prior standard deviations (P,) of the fit are infinite for flat parameters, zero for groups that
    were dropped; the prior that the model carries takes their place. The readings are those that it
    was fitted to, without gross errors, and `left_out_sigma` is the rms of the whitened residual on
    poses left out.
    """
    stated = whitening(fitted, mode, "gc")
    prediction = model.predict(fitted.states, theta)
    raw = residual(fitted, prediction, stated)
    fold = random_folds(distinct_poses(fitted)[stated.reading])
    known, least, from_variances = None, 1.0, np.zeros((model.size, model.size))
    if model.background:
        variances = mixed_fit_at(model, fitted.as_stated(), mode, theta)
        arm = fitted.arm_scatter  # whose factor the standard deviations are in units of
        known = (variances.std(INSTRUMENT) if arm is None else arm.instrument_factor) ** 2
        prior = prior * np.sqrt(known)
        least = variance_spread(variances, stated.rows_of(fold))
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

    def rows_in(w: Whitening) -> Floats:
        """Whitened derivatives (R, P) by coordinates of unit prior variance."""
        return of.columns(whitened_jacobian(model, prediction, theta, w, every)) * std

    every, more, w = np.arange(model.size), Excess(), stated
    for step in range(ROUNDS + 1):
        a = rows_in(w)
        values, vectors, noise = _spectrum(a, raw, w, known)
        root = vectors * np.sqrt(noise / (values + noise))
        if known is not None or step == ROUNDS:  # known: a misfit is in the background
            break
        # Where the parameters are with this noise and this prior: a residual and its leverage.
        moved = root @ (root.T @ (a.T @ w.whiten(raw).reshape(-1) / noise - pull))
        at = model.predict(fitted.states, theta + of.transform(std * moved))
        found = excess(residual(fitted, at, stated), stated, w, a, root / np.sqrt(noise), more)
        if found.near(more):
            break
        more = found if step == 0 else found.halfway(more)
        w = whitening(more.of_readings(fitted, mode), mode, "gc")
    shares = []
    for k in range(0, len(a), CHUNK * w.m):
        part = (a[k : k + CHUNK * w.m] @ root).reshape(-1, w.m, len(root))
        shares.append(np.linalg.eigvalsh(part @ np.swapaxes(part, 1, 2)) / noise)
    leverage = np.clip(np.concatenate(shares), 0.0, MOST_LEVERAGE).max(axis=1)
    scatter, b, wider = noise, a, more.widened(stated.covariance)
    if not more.none:
        share = np.trace(np.linalg.solve(stated.covariance, wider), axis1=1, axis2=2)
        scatter = noise * float(share.mean()) / w.m
        b = rows_in(stated)
    position = of.columns(w.raw(model.jacobian(prediction, theta, 3)).reshape(-1, model.size)) * std
    rows, points = w.rows_of(fold), np.repeat(fold, 3)
    left_out, left_out_m2 = left_out_variances(
        a, rows, ((b, rows), (position, points)), root, noise
    )
    scatter_m2 = noise * float(np.trace(wider[:, :3, :3], axis1=1, axis2=2).mean())
    root = of.transform(root * std[:, None])
    factor = max(least, left_out_sigma**2 / (scatter + left_out))
    return Predictive(
        model, theta, root @ root.T + from_variances, open_prior(model, theta, prior), more, noise,
        factor, least,
        leverage, scatter, left_out, scatter_m2, 3 * left_out_m2,
    )  # fmt: skip


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


def left_out_variances(
    a: Floats, fold: Ints, asked: Sequence[tuple[Floats, Ints]], root: Floats, noise: float
) -> list[float]:
    """Mean variance of rows of each fold, predicted without it.

    Of fitted rows (R, P) in units of W, with their folds (R,); rows (R', P) and folds are asked for
    in other units. (P, K) root of C, and σ².
    """
    total = np.zeros(len(asked))
    for f in range(int(fold.max(initial=-1)) + 1):
        x = a[fold == f] @ root
        few = len(x) < len(root)
        values, vectors = np.linalg.eigh(x @ x.T if few else x.T @ x)
        rest = np.maximum(1.0 - values / noise, ROUNDING)
        for k, (b, of) in enumerate(asked):
            y = b[of == f] @ root
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
    for effect, rows in zip(model.effects, model.slices(), strict=True):
        if effect.groups() is not None:
            pool = effect.pools()
            mean = np.bincount(pool, weights=prior[rows] ** 2) / np.maximum(np.bincount(pool), 1)
            std[rows] = np.maximum(std[rows], np.sqrt(mean)[pool])
    return std


def parameter_factor(p: Predictive, left_out_sigma: float) -> float:
    """Factor, at least 1, by which C is too small where the noise alone is right.

    With it the mean variance on poses left out is the mean square that was found there, whose root
    is `left_out_sigma`, whitened.
    """
    return max(p.least, (left_out_sigma**2 - max(p.scatter, 1.0)) / max(p.left_out, 1e-12))


def position_factor(p: Predictive, left_out_m: float) -> float:
    """Factor, at least 1, by which C is too small for positions.

    With it the mean square error of the positions left out, m², is what was found there: in metres,
    as a band about a position is stated. In units of V the directions that an instrument measures
    best would decide, in which misfits count most.
    """
    return max(p.least, (left_out_m**2 - p.scatter_m2) / max(p.left_out_m2, 1e-300))


def variance_spread(found: Variances, fold: Ints) -> float:
    """Return the factor, at least 1, of the variance of predictions, by the folds (R,) of rows."""
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


def posterior_of(fit: Fit, source: Source | None = None) -> Posterior:
    """Return what a fit taught of its arm; arguments and errors are those of `Posterior.of`."""
    if fit.scaling != "gc":
        raise InputError(f"a prior needs a fit with scaling gc, this one has {fit.scaling}")
    model, cell = fit.model, fit.model.cell
    learnt = [e for e in model.effects if of_arm(e)]
    if not learnt:
        raise CannotAnswerError(
            f"the model {' + '.join(model.names) or 'of the nominal arm'} has no effect of the "
            "arm, only of the setup: there is nothing to carry over; run hilcal refine first"
        )
    of_arms = np.concatenate([np.full(len(e.parameters), of_arm(e)) for e in model.effects])
    interest, scale = np.flatnonzero(of_arms), scales_of(model)
    whole, own = _information(fit, scale)
    found = determined(schur_complement(whole, interest))
    scale = scale[interest]
    used, source = fit.readings[~fit.outlier], source or Source(created=utc_now())
    return Posterior(
        arm=cell.arm.name,
        links=cell.arm.links,
        mode=fit.mode,
        effects=tuple(PosteriorEffect(e.name, dict(e.options)) for e in learnt),
        names=tuple(f"{e.name}.{p.name}" for e in learnt for p in e.parameters),
        units=tuple(p.unit for e in learnt for p in e.parameters),
        scale=scale,
        mean=fit.theta[interest],
        information=found / (scale[:, None] * scale),
        own_precision=own[interest] / scale**2,
        scatter=fit.readings.arm_scatter,
        ranges=ranges_of(used.states, cell.arm.units),
        prints=prints(fit.readings),
        source=replace(
            source, readings_sha256=content_hash(fit.readings), n_readings=len(fit.readings)
        ),
    )


def of_arm(effect: Effect) -> bool:
    """Whether an effect is of the arm, so that another campaign of it has it, too."""
    return not (type(effect).of_setup or effect.role in FRAME_ROLES)


def _information(fit: Fit, scale: Floats) -> tuple[Floats, Floats]:
    """M (P, P) and the part of its diagonal by the effects' own priors, in ordinary magnitudes."""
    model, s = fit.model, fit.solution
    p, w = predictive_of(fit), fit.whitening
    if not p.excess.none:
        w = whitening(p.excess.of_readings(fit.readings[~fit.outlier], fit.mode), fit.mode, "gc")
    a = whitened_jacobian(model, s.prediction, s.theta, w, np.arange(model.size))
    a *= scale
    std = np.where(np.isinf(s.prior), np.inf, p.prior) / scale
    with np.errstate(divide="ignore"):
        own = np.where(std > 0, 1.0 / std**2, np.inf)
    # Of a family of which nothing is left at all: as ordinary as it starts.
    own[np.isinf(own)] = 1.0
    kappa = parameter_factor(p, fit.holdout.rms_sigma)
    return (a.T @ a / p.noise + np.diag(own)) / kappa, own / kappa
