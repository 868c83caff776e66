"""Whether the noise of a fit's readings is correlated along their order, and how strongly.

The law is that of `readings.readings`. A misfit looks like serial noise where neighbours in the
order are neighbours in joint space, so the noise is estimated beside all effects that could be
missing. With L the whitening of the measurements by the covariance without correlation, B the
columns of the model and y their residual,

    L y ~ N(L B θ, σ² Σ),    Σ = 1 + φ (K(τ) − K(0)) + Σ_f v_f K_f

K(τ) = A (C(τ) ⊗ 1) Aᵀ is the covariance of the serial noise, A = L D S, where D takes differences
of readings. K_f, scaled to a mean variance of 1, is the covariance of a rival:

- each effect of the catalogue that is not in the model, Z_f Z_fᵀ;
- motions of joints and target by powers of the time, since the catalogue has few laws of time;
- the arm's scatter, where nothing states it and several targets are read in one arrival;
- other misfits, A (C_f ⊗ 1) Aᵀ with the correlation C_f: a smooth field over joint angles and
  torques, and displacements of each pose.

φ, τ and v_f maximise the restricted likelihood with σ² profiled out, so the tests do not depend on
the stated size of the noise. The estimate assumes σ² = 1 unless the readings contradict it: little
else distinguishes a long correlation of large noise from a short one of small noise. All this is
computed only if the slope of ℓ by φ at white noise promises a gain, and no rival alone explains the
readings far better: that rival should enter the model first.

The serial noise is proved if it gains more than chance beside all rivals, or alone explains the
readings better than all rivals by 20 : 1. If the rivals are better by 20 : 1, they explain the
readings, as a drift does; otherwise the serial noise stays in doubt. Campaigns of more than
`MOST_ROWS` are judged by some of their runs, those of more than `MOST_READINGS` not at all.

Source: Patterson and Thompson, Biometrika 58 (1971) 545-554.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, lapack, solve_triangular

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE, candidates
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import columns_of_each
from hilcal.model.observe import motion
from hilcal.readings.covariance import instrument_root
from hilcal.readings.readings import Clock, SerialNoise
from hilcal.readings.whitening import arrival_groups, deflection_groups, runs
from hilcal.regression.schur import inverse_root
from hilcal.types import Floats, Ints

LEAST_GAIN = 8.0
"""Gain of the restricted log likelihood that is more than chance, p = 0.0002 by the mixture of χ²
with one and two degrees of freedom (Self and Liang, JASA 82 (1987) 605), on two clocks."""
CONTRADICTING_GAIN = 6.0
"""Gain of the restricted log likelihood by a free σ² that contradicts σ² = 1: that of
`noise.MISFIT_ALARM`."""
LEAST_PROMISE = 0.5 * LEAST_GAIN
"""Gain that slope and curvature at white noise must promise for the full computation; a choice: the
promise is good to a third."""
RIVAL_VARIANCES = (1.0, 10.0, 100.0)
"""Tried variances of a rival, in units of the noise's; a choice."""
RIVAL_FACTOR = 2.0
"""Factor by which the gain of a rival at one of `RIVAL_VARIANCES` must exceed that of serial noise
at `STARTS` to explain the readings far better; a choice, rough but fast to test."""
FEWEST_READINGS = 12  # readings below which nothing is estimated; a choice
MOST_READINGS = 600  # measurements above which nothing is estimated; a choice by timing
POSITION_ELEMENTS = 3
"""Elements of a reading that are used: the noise of orientation follows the position's."""
MOST_ROWS = 450
"""Rows used at most, for speed; a choice: 150 readings determine ρ to 0.05."""
RUN_LENGTH = 50  # measurements in each run that is used of a large campaign; a choice
LEAST_VARIANCE, MOST_VARIANCE = np.exp(-12.0), np.exp(12.0)
"""Bounds of v_f: none, and far more than noise."""
MOST_SHARE = 0.999  # bound of φ; with it every covariance has an inverse
ROUNDING = 1e-9
"""Least variance, in units of the noise, and least information, as a share of the mean."""
MOST_NAMED = 2  # rivals that are named
NAMED_VARIANCE = 0.01
"""Mean variance from which a rival is named, in units of the noise's; a choice."""
SHARE_STEP, LENGTH_STEP = 0.02, 0.05  # steps of φ and log τ for the curvature
STARTS = (0.3, 0.8, 0.97)  # values of ρ from which the likelihood is maximised


def with_serial_noise(white: Fit, prior: Floats | None = None) -> Fit:
    """Return a fit, with prior stds (P,), with the correlation of its noise in the covariance."""
    noise = serial_noise(white) if white.readings.serial is None else None
    if noise is None:
        return white
    readings = white.readings.with_serial(noise)
    fitted = fit(white.model, readings, white.mode, white.scaling, white.theta, prior)
    a, b = white.uncertainty, fitted.uncertainty
    both = a.identifiable & b.identifiable & (a.formal > 0)
    ratio = b.formal[both] / a.formal[both] if both.any() else np.ones(1)
    noise = replace(noise, wider=(float(ratio.min()), float(ratio.max())))
    return replace(fitted, readings=readings.with_serial(noise))


def serial_noise(white: Fit) -> SerialNoise | None:
    """Estimate the serial noise of a gc-scaled fit with white noise; None where there is none."""
    if white.scaling != "gc" or not FEWEST_READINGS <= len(white.raw) <= MOST_READINGS:
        return None
    by_order = _problem(white, "order")
    if by_order is None or by_order.promise() < LEAST_PROMISE:
        return None
    names, rivals = by_order.rivals()
    if by_order.outdone(rivals):
        return None
    problem, alone = by_order, by_order.maximised(by_order.none, serial=True)
    by_time = None if white.readings.states.time is None else _problem(white, "time")
    if by_time is not None:
        timed = by_time.maximised(by_time.none, serial=True)
        if timed.value >= alone.value:
            problem, alone = by_time, timed
            names, rivals = problem.rivals()
    if alone.value - problem.maximised(problem.none, serial=False).value < LEAST_GAIN:
        return None
    effects = problem.maximised(rivals, serial=False)
    both = problem.maximised(rivals, serial=True, start=effects)
    gain = both.value - effects.value
    if gain >= LEAST_GAIN or alone.value - effects.value >= SAME_EVIDENCE:
        # Variances of rivals that are not needed would absorb a part of the noise.
        needed = both.value - alone.value >= SAME_EVIDENCE
        return problem.noise(*((both, rivals) if needed else (alone, problem.none)), gain)
    if effects.value - alone.value >= SAME_EVIDENCE:
        return None
    largest = np.argsort(-effects.v)[:MOST_NAMED]
    instead = tuple(names[k] for k in largest if effects.v[k] > NAMED_VARIANCE)
    return replace(problem.noise(alone, problem.none, gain), proved=False, instead=instead)


@dataclass(frozen=True, slots=True, eq=False)
class _SerialPoint:
    """φ, τ, v_f and their restricted log likelihood."""

    share: float
    length: float
    v: Floats
    value: float


@dataclass(frozen=True, eq=False)
class _SerialProblem:
    """The restricted likelihood of R rows of N readings."""

    fit: Fit
    clock: Clock  # whether t is the time or the number of a reading
    rows: Ints  # (N,) indices of the readings used, among those fitted
    y: Floats  # (R,) whitened residual, at the parameters' prior mean
    columns: Floats  # (R, K) of the model, whitened
    ridge: Floats  # (K,) of their priors
    factor: Floats  # (R, N, m) A
    difference: Floats  # (R, N·m) L D
    t: Floats  # (N,) time or number of each reading

    @cached_property
    def distance(self) -> Floats:
        """(N, N) distances of the readings along t."""
        return np.abs(self.t[:, None] - self.t)

    @cached_property
    def step(self) -> float:
        """Median distance of consecutive readings along t."""
        gaps = np.diff(np.sort(self.t))
        return float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 1.0

    @property
    def free(self) -> int:
        """Degrees of freedom."""
        return len(self.y) - int(np.sum(self.ridge == 0))

    @property
    def none(self) -> Floats:
        """No K_f (0, R, R)."""
        return np.zeros((0, len(self.y), len(self.y)))

    def correlated(self, c: Floats) -> Floats:
        """A (C ⊗ 1) Aᵀ (R, R) of a correlation (N, N)."""
        product = np.tensordot(self.factor, c, axes=(1, 0))  # (R, m, N)
        flat = np.swapaxes(self.factor, 1, 2).reshape(len(self.y), -1)
        return np.asarray(product.reshape(len(self.y), -1) @ flat.T)

    @cached_property
    def uncorrelated(self) -> Floats:
        """K(0)."""
        return self.correlated(np.eye(len(self.t)))

    def rivals(self) -> tuple[list[str], Floats]:
        """Names and K_f (F, R, R) of all rivals; without those that cancel, as the pose's may."""
        sized = [(name, k, np.trace(k) / len(k)) for name, k in self._rivals()]
        scaled = [(name, k / size) for name, k, size in sized if size > ROUNDING]
        return [name for name, _ in scaled], np.stack([k for _, k in scaled])

    def _rivals(self) -> Iterator[tuple[str, Floats]]:
        """Yield name and unscaled K_f of each rival."""
        readings, p = self.fit.readings[~self.fit.outlier], self.fit.solution.prediction

        def of_columns(x: Floats) -> Floats:
            white = self.difference @ x[:, :POSITION_ELEMENTS].reshape(-1, x.shape[2])
            return np.asarray(white @ white.T)

        for columns in columns_of_each(self.fit, candidates(self.fit)):
            yield columns.effect.name, of_columns(columns.motion_of_readings[self.rows])
        time = readings.states.time
        t = np.arange(len(readings), dtype=float) if time is None else time
        scaled = 2 * (t - t.min()) / max(float(np.ptp(t)), 1e-300) - 1
        chain = p.situation.chain
        moves = motion(self.fit.model.cell, p.observation, chain, p.deviation, POSITION_ELEMENTS)
        for motions in (moves.drives, p.observation.axes):
            powers = [motions * scaled[:, None, None] ** k for k in (1, 2, 3)]
            yield "the time", of_columns(np.concatenate(powers, axis=2)[self.rows])
        arrival = readings.arrivals[self.rows]
        together = arrival[:, None] == arrival
        if not readings.scatter_stated and together.sum() > len(arrival):
            flat = moves.drives[self.rows].reshape(len(arrival) * POSITION_ELEMENTS, -1)
            scatter = (flat @ flat.T) * np.kron(
                together, np.ones((POSITION_ELEMENTS, POSITION_ELEMENTS))
            )
            yield "the arm's scatter", self.difference @ scatter @ self.difference.T
        pose = readings.pose[self.rows]
        yield "the pose", self.correlated((pose[:, None] == pose).astype(float))
        torque = p.situation.torque
        torque = torque[self.rows] / np.maximum(np.abs(torque).max(axis=0), 1e-300)
        angle = p.situation.angle[self.rows]
        x = np.concatenate([np.cos(angle), np.sin(angle), torque], axis=1)
        square = np.sum((x[:, None] - x) ** 2, axis=2)
        yield "angles and torques", self.correlated(np.exp(-0.5 * square))

    def maximised(
        self,
        rivals: Floats,  # the K_f
        *,
        serial: bool,  # whether φ may be more than zero
        start: _SerialPoint | None = None,  # of v_f, and of φ and τ where its φ > 0
        stated: bool = False,  # whether σ² = 1
    ) -> _SerialPoint:
        """Maximise the restricted likelihood, with or without serial noise."""
        from scipy.optimize import minimize  # slow to import

        step, count = self.step, len(rivals)
        span = max(float(np.ptp(self.t)), step)

        def objective(x: Floats) -> tuple[float, Floats]:
            length, v = float(np.exp(x[1])), np.exp(x[2:])
            value, slope = self._likelihood(rivals, float(x[0]), length, v, stated)
            return -value, -slope * np.concatenate([[1.0, length], v])

        starts = [(0.0, np.log(step))]
        if start is not None and start.share > 0:
            starts = [(start.share, np.log(start.length))]
        elif serial:
            starts = [(0.5, np.log(-step / np.log(rho))) for rho in STARTS]
        v = np.full(count, -2.0) if start is None else np.log(start.v)
        x = min((np.array([*s, *v]) for s in starts), key=lambda x: objective(x)[0])
        bounds = [
            (0.0, MOST_SHARE if serial else 0.0),
            (np.log(0.2 * step), np.log(2.0 * span)),
            *[(np.log(LEAST_VARIANCE), np.log(MOST_VARIANCE))] * count,
        ]
        best = minimize(objective, x, jac=True, bounds=bounds, method="L-BFGS-B")
        share, length = float(best.x[0]), float(np.exp(best.x[1]))
        return _SerialPoint(share, length, np.exp(best.x[2:]), -float(best.fun))

    def _projected(self, sigma: Floats) -> tuple[Floats, Floats, float]:
        """P (R, R), P y, and log det Σ + log det H."""
        lower = np.linalg.cholesky(sigma + ROUNDING * np.eye(len(sigma)))
        half = np.tril(lapack.dpotri(lower, lower=1)[0])
        inverse = half + np.tril(half, -1).T
        b = inverse @ self.columns
        h = self.columns.T @ b + np.diag(self.ridge)
        h += ROUNDING * float(np.trace(h)) / max(len(h), 1) * np.eye(len(h))
        lifted = b @ inverse_root(h).T
        p = inverse - lifted @ lifted.T
        log_det = 2 * float(np.log(np.diag(lower)).sum()) + float(np.linalg.slogdet(h)[1])
        return p, p @ self.y, log_det

    def _likelihood(
        self, rivals: Floats, share: float, length: float, v: Floats, stated: bool = False
    ) -> tuple[float, Floats]:
        """ℓ and its slope by φ, τ and v (2 + F,)."""
        c = np.exp(-self.distance / length)
        sigma = np.eye(len(self.y)) + np.tensordot(v, rivals, axes=1)
        if share > 0:
            serial = self.correlated(c) - self.uncorrelated
            sigma += share * serial
        p, py, log_det = self._projected(sigma)
        square = float(self.y @ py)
        noise = 1.0 if stated else square / self.free
        value = -0.5 * (self.free * np.log(noise) + square / noise + log_det)
        slope = -0.5 * (p - np.outer(py, py) / noise)
        by_share = by_length = 0.0
        if share > 0:
            by_share = float(np.vdot(slope, serial))
            derivative = self.correlated(c * self.distance / length**2)
            by_length = float(np.vdot(slope, share * derivative))
        by_v = np.tensordot(rivals, slope, axes=2)
        return value, np.concatenate([[by_share, by_length], by_v])

    @cached_property
    def _white(self) -> tuple[Floats, Floats, float]:
        """P (R, R), P y and σ² of white noise."""
        p, py, _ = self._projected(np.eye(len(self.y)))
        return p, py, max(float(self.y @ py) / self.free, 1e-300)

    def promise(self) -> float:
        """Gain of ℓ by serial noise as slope and curvature at white noise predict it."""
        (p, py, noise), gain = self._white, 0.0
        for rho in STARTS:
            k = self.correlated(rho ** (self.distance / self.step)) - self.uncorrelated
            pk = p @ k
            trace = float(np.trace(pk))
            slope = 0.5 * (float(py @ k @ py) / noise - trace)
            curvature = 0.5 * (float(np.sum(pk * pk.T)) - trace**2 / self.free)
            if slope > 0 and curvature > 0:
                gain = max(gain, 0.5 * slope**2 / curvature)
        return gain

    def outdone(self, rivals: Floats) -> bool:
        """Whether the rival with the largest predicted gain explains far more than serial noise."""
        p, py, noise = self._white
        trace = np.tensordot(rivals, p, axes=2)
        slope = 0.5 * (np.tensordot(rivals, np.outer(py, py), axes=2) / noise - trace)
        curvature = 0.5 * (np.sum(rivals**2, axis=(1, 2)) - trace**2 / self.free)
        k = int(np.argmax(np.maximum(slope, 0.0) ** 2 / np.maximum(curvature, ROUNDING)))

        def value(share: float = 0.0, rho: float = 0.5, size: float = 0.0) -> float:
            length = -self.step / float(np.log(rho))
            return self._likelihood(rivals[[k]], share, length, np.array([size]))[0]

        white = value()
        serial = max(value(0.5, rho) for rho in STARTS)
        rival = max(value(size=size) for size in RIVAL_VARIANCES)
        return rival - white >= RIVAL_FACTOR * max(serial - white, 0.0) + LEAST_GAIN + SAME_EVIDENCE

    def noise(self, free: _SerialPoint, rivals: Floats, gain: float) -> SerialNoise:
        """Return the estimate from the maximum with free σ²; uncertainties by curvature of ℓ."""
        point = self.maximised(rivals, serial=True, start=free, stated=True)
        stated = free.value - point.value < CONTRADICTING_GAIN
        point = point if stated else free
        share = min(point.share, MOST_SHARE - SHARE_STEP)

        def slopes(a: float, b: float) -> Floats:
            length = point.length * float(np.exp(b))
            g = self._likelihood(rivals, max(share + a, 0.0), length, point.v, stated)[1]
            return np.array([g[0], g[1] * length])

        steps = (SHARE_STEP, 0.0), (0.0, LENGTH_STEP)
        h = np.stack([(slopes(-a, -b) - slopes(a, b)) / (2 * (a + b)) for a, b in steps])
        definite = share == point.share and float(np.linalg.det(h)) > 0 and h[0, 0] > 0
        c = np.linalg.inv(h) if definite else np.diag(1.0 / np.maximum(np.diag(h), 1.0))
        rho = float(np.exp(-self.step / point.length))
        return SerialNoise(
            clock=self.clock,
            share=point.share,
            share_error=float(min(c[0, 0] ** 0.5, 1.0)),
            length=point.length,
            rho=rho,
            rho_error=float(min(rho * self.step / point.length * c[1, 1] ** 0.5, 1.0)),
            log_likelihood_ratio=gain,
        )


def _problem(white: Fit, clock: Clock) -> _SerialProblem | None:
    """Form the rows of the likelihood; None where t, covariance or their number forbid it."""
    readings, m = white.readings, POSITION_ELEMENTS
    t = readings.states.time if clock == "time" else np.arange(len(readings), dtype=float)
    assert t is not None  # noqa: S101 - the caller's condition
    along, t = replace(readings, along=t)[~white.outlier], t[~white.outlier]
    if np.ptp(t) == 0:
        return None
    groups = (deflection_groups if white.mode == "deflection" else arrival_groups)(along)
    pieces = runs(along, groups, RUN_LENGTH)  # of these `MOST_ROWS`, evenly spaced, are used
    share = min(MOST_ROWS / (m * sum(p[0].size for p in pieces)), 1.0)
    spaced = np.linspace(0, len(pieces) - 1, max(int(len(pieces) * share), 1))
    chosen = [pieces[k] for k in spaced.astype(int)]
    place = np.zeros(len(along), dtype=np.int64)
    place[white.whitening.reading] = np.arange(len(white.raw))
    loaded = np.concatenate([g[0][0] for g in chosen])
    rows = np.concatenate([loaded, *(g[1][0] for g in chosen)])
    weights = block_diag(*(g[2] for g in chosen))
    difference = np.kron(np.concatenate([np.eye(len(loaded)), -weights], axis=1), np.eye(m))
    used = along[rows]
    covariance = block_diag(*used.covariance[:, :m, :m])
    if used.common is not None:
        flat = used.common[:, :m].reshape(len(rows) * m, -1)
        together = (used.arrivals[:, None] == used.arrivals) & ~np.eye(len(rows), dtype=bool)
        covariance = covariance + (flat @ flat.T) * np.kron(together, np.ones((m, m)))
    v = difference @ covariance @ difference.T
    std = np.sqrt(np.diag(v))
    if not np.all(std > 0):
        return None
    try:
        lower = np.linalg.cholesky(v / std[:, None] / std)
    except np.linalg.LinAlgError:
        return None
    inverse = solve_triangular(lower, np.diag(1 / std), lower=True, check_finite=False)
    whitened = inverse @ difference
    s = white.solution
    live = np.flatnonzero(s.estimated)
    jacobian = white.model.jacobian(s.prediction, s.theta, m, live)[rows]
    flat = jacobian.reshape(len(rows) * m, len(live))  # also of a model without parameters
    columns = whitened @ (flat @ s.transform[live])
    y = inverse @ white.raw[place[loaded], :m].reshape(-1) + columns @ s.coordinates()
    of_readings = whitened.reshape(len(y), len(rows), m)
    factor = np.einsum("rni,nij->rnj", of_readings, instrument_root(used, m))
    ridge = s.equations.basis.prior_precision
    if len(y) < 2 * np.sum(ridge == 0):
        return None
    return _SerialProblem(white, clock, rows, y, columns, ridge, factor, whitened, t[rows])
