"""Whether the noise of a fit's readings is correlated along their order, and how far.

The law is that of `readings.serial_noise`. A misfit looks alike where neighbours in the order are
neighbours in joint space, so it is estimated beside all that could be missing. With L the whitening
of the measurements by the covariance without correlation, B the columns of the model and y their
residual,

    L y ~ N(L B θ, σ² Σ),    Σ = 1 + φ (K(τ) − K(0)) + Σ_f v_f K_f

K(τ) = A (C(τ) ⊗ 1) Aᵀ that of the serial noise, A = L D S with D the differences that measurements
are of readings. K_f, scaled to a mean variance of 1, is that

- of each effect of the catalogue that is not in the model, Z_f Z_fᵀ;
- of joints and target that move as powers of the time, of which the catalogue knows few laws;
- of the arm's scatter, where nothing states it and several targets are read in one arrival: they
  have it in common, as neighbours in the order have serial noise;
- of a smooth field over joint angles and torques, and of poses, A (C_f ⊗ 1) Aᵀ, C_f their
  neighbourhood: what the catalogue lacks.

φ, τ and v_f maximise the restricted likelihood, σ² profiled: tests do not depend on a noise that is
misjudged as a whole. Little but the stated covariance tells a long correlation of large noise from
a short one of small noise: the estimate is that with σ² = 1, unless the readings speak against it.

All this is computed where the slope of ℓ by φ at white noise speaks for it, and no K_f alone
explains the readings far better: that is to be in the model first.

The serial noise is proved where it gains more than chance beside all K_f, or alone, and is then
better than all K_f by 20 : 1. Where these are better by as much, they explain the readings, as a
drift does; else it stays in doubt. Campaigns of more than `MOST_ROWS` are judged by some of their
runs, those of more than `MOST_READINGS` not at all.

Source: Patterson and Thompson, Biometrika 58 (1971) 545-554.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, lapack, solve_triangular

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE, candidates
from hilcal.identification.effect_columns import columns_of_each
from hilcal.identification.fit import Fit, fit
from hilcal.model.observe import motion
from hilcal.readings.covariance import instrument_root
from hilcal.readings.readings import Clock, SerialNoise
from hilcal.readings.whitening import arrival_groups, deflection_groups, runs
from hilcal.regression.schur import inverse_root
from hilcal.types import Floats, Ints

CHANCE = 8.0
"""Gain of the restricted log likelihood that is more than chance, p = 0.0002 by the mixture of χ²
with one and two degrees of freedom (Self and Liang, JASA 82 (1987) 605), on two clocks."""
AGAINST = 6.0
"""Gain of the restricted log likelihood by another σ² than 1 that speaks against it: that of
`noise.MISFIT_ALARM`."""
SUSPECT = 0.5 * CHANCE
"""Gain that slope and curvature at white noise must promise for more to be computed; a choice: it
is as rough as a third."""
SIZES = (1.0, 10.0, 100.0)  # variances of a rival that are tried, in that of the noise; a choice
LEAD = 2.0
"""Factor by which a rival at one of `SIZES` gains more than serial noise at `STARTS` where it
explains the readings far better; a choice, rough but for little computing."""
FEWEST = 12  # readings below which nothing is estimated; a choice
MOST_READINGS = 600  # measurements above which nothing is estimated; a choice by timing
POSITION = 3  # elements of a reading by which it is estimated: an attitude follows its position
MOST_ROWS = 450
"""Rows that are used at most, for speed; a choice: ρ of 150 readings is known to 0.05."""
PIECE = 50  # measurements in each of the runs that are used of a large campaign; a choice
LEAST, MOST = np.exp(-12.0), np.exp(12.0)  # bounds of v_f: none, and far more than noise
MOST_SHARE = 0.999  # bound of φ; with it every covariance has an inverse
ROUNDING = 1e-9
"""Least variance, in units of the noise, and least information, as a share of the mean."""
MOST_NAMED = 2  # rivals that are named
SOME = 0.01  # mean variance, in that of the noise, from which on a rival is named; a choice
SHARE_STEP, LENGTH_STEP = 0.02, 0.05  # steps of φ and log τ by which the curvature is taken
STARTS = (0.3, 0.8, 0.97)  # values of ρ from which the likelihood is climbed


def with_serial_noise(white: Fit, prior: Floats | None = None) -> Fit:
    """Return a fit with the correlation of its noise in the covariance, where there is some.

    `prior` are the standard deviations (P,) that it was given. A fit whose covariance has the
    correlation stays as it is.
    """
    noise = serial_noise(white) if white.readings.serial is None else None
    if noise is None:
        return white
    readings = white.readings.with_serial(noise)
    found = fit(white.model, readings, white.mode, white.scaling, white.theta, prior)
    a, b = white.uncertainty, found.uncertainty
    both = a.identifiable & b.identifiable & (a.formal > 0)
    ratio = b.formal[both] / a.formal[both] if both.any() else np.ones(1)
    noise = replace(noise, wider=(float(ratio.min()), float(ratio.max())))
    return replace(found, readings=readings.with_serial(noise))


def serial_noise(found: Fit) -> SerialNoise | None:
    """Estimate the serial noise of a gc-scaled fit with white noise; None where there is none.

    It is returned with `proved` False where effects explain the readings as well as it does.
    """
    if found.scaling != "gc" or not FEWEST <= len(found.raw) <= MOST_READINGS:
        return None
    by_order = _problem(found, "order")
    if by_order is None or by_order.promise() < SUSPECT:
        return None
    names, rivals = by_order.rivals()
    if by_order.outdone(rivals):
        return None
    problem, alone = by_order, by_order.climbed(by_order.none, serial=True)
    timed = None if found.readings.states.time is None else _problem(found, "time")
    if timed is not None:
        other = timed.climbed(timed.none, serial=True)
        if other.value >= alone.value:
            problem, alone = timed, other
            names, rivals = problem.rivals()
    if alone.value - problem.climbed(problem.none, serial=False).value < CHANCE:
        return None
    effects = problem.climbed(rivals, serial=False)
    both = problem.climbed(rivals, serial=True, start=effects)
    gain = both.value - effects.value
    if gain >= CHANCE or alone.value - effects.value >= SAME_EVIDENCE:
        # Variances that are not needed take some of the noise for their own.
        needed = both.value - alone.value >= SAME_EVIDENCE
        return problem.noise(*((both, rivals) if needed else (alone, problem.none)), gain)
    if effects.value - alone.value >= SAME_EVIDENCE:
        return None
    worst = np.argsort(-effects.v)[:MOST_NAMED]
    instead = tuple(names[k] for k in worst if effects.v[k] > SOME)
    return replace(problem.noise(alone, problem.none, gain), proved=False, instead=instead)


@dataclass(frozen=True, slots=True, eq=False)
class _SerialPoint:
    """φ, τ, v_f and the restricted log likelihood there."""

    share: float
    length: float
    v: Floats
    value: float


@dataclass(frozen=True, eq=False)
class _SerialProblem:
    """What the likelihood is of, R rows of N readings."""

    fit: Fit
    clock: Clock  # what t is
    rows: Ints  # (N,) readings that are used, of those that were fitted
    y: Floats  # (R,) whitened residual, at the parameters' prior mean
    columns: Floats  # (R, K) of the model, whitened
    ridge: Floats  # (K,) of their priors
    factor: Floats  # (R, N, m) A
    difference: Floats  # (R, N·m) L D
    t: Floats  # (N,) positions

    @cached_property
    def away(self) -> Floats:
        """(N, N) distances of the readings."""
        return np.abs(self.t[:, None] - self.t)

    @cached_property
    def step(self) -> float:
        """Median distance of consecutive readings."""
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
        moved = np.tensordot(self.factor, c, axes=(1, 0))  # (R, m, N)
        flat = np.swapaxes(self.factor, 1, 2).reshape(len(self.y), -1)
        return np.asarray(moved.reshape(len(self.y), -1) @ flat.T)

    @cached_property
    def own(self) -> Floats:
        """K(0)."""
        return self.correlated(np.eye(len(self.t)))

    def rivals(self) -> tuple[list[str], Floats]:
        """Names and K_f (F, R, R) of all."""
        found = [(name, k * (len(k) / t)) for name, k in self._rivals() if (t := np.trace(k)) > 0]
        return [name for name, _ in found], np.stack([k for _, k in found])

    def _rivals(self) -> Iterator[tuple[str, Floats]]:
        kept, p = self.fit.readings[~self.fit.outlier], self.fit.solution.prediction

        def of_columns(x: Floats) -> Floats:
            white = self.difference @ x[:, :POSITION].reshape(-1, x.shape[2])
            return np.asarray(white @ white.T)

        for of in columns_of_each(self.fit, candidates(self.fit)):
            yield of.effect.name, of_columns(of.of_readings[self.rows])
        time = kept.states.time
        t = np.arange(len(kept), dtype=float) if time is None else time
        scaled = 2 * (t - t.min()) / max(float(np.ptp(t)), 1e-300) - 1
        chain = p.situation.chain
        moves = motion(self.fit.model.cell, p.observation, chain, p.deviation, POSITION)
        for motions in (moves.drives, p.observation.axes):
            powers = [motions * scaled[:, None, None] ** k for k in (1, 2, 3)]
            yield "the time", of_columns(np.concatenate(powers, axis=2)[self.rows])
        arrival = kept.arrivals[self.rows]
        together = arrival[:, None] == arrival
        if not kept.scatter_stated and together.sum() > len(arrival):
            flat = moves.drives[self.rows].reshape(len(arrival) * POSITION, -1)
            each = np.ones((POSITION, POSITION))
            scatter = (flat @ flat.T) * np.kron(together, each)
            yield "the arm's scatter", self.difference @ scatter @ self.difference.T
        pose = kept.pose[self.rows]
        yield "the pose", self.correlated((pose[:, None] == pose).astype(float))
        torque = p.situation.torque
        torque = torque[self.rows] / np.maximum(np.abs(torque).max(axis=0), 1e-300)
        angle = p.situation.angle[self.rows]
        x = np.concatenate([np.cos(angle), np.sin(angle), torque], axis=1)
        square = np.sum((x[:, None] - x) ** 2, axis=2)
        yield "angles and torques", self.correlated(np.exp(-0.5 * square))

    def climbed(
        self,
        rivals: Floats,  # the K_f
        *,
        serial: bool,  # whether φ may be more than zero
        start: _SerialPoint | None = None,  # of v_f, and of φ and τ where it has serial noise
        stated: bool = False,  # whether σ² = 1
    ) -> _SerialPoint:
        """Maximise the restricted likelihood, with or without serial noise."""
        from scipy.optimize import minimize  # slow to import

        step, count = self.step, len(rivals)
        span = max(float(np.ptp(self.t)), step)

        def climb(x: Floats) -> tuple[float, Floats]:
            length, v = float(np.exp(x[1])), np.exp(x[2:])
            value, slope = self._likelihood(rivals, float(x[0]), length, v, stated)
            return -value, -slope * np.concatenate([[1.0, length], v])

        begin = [(0.0, np.log(step))]
        if start is not None and start.share > 0:
            begin = [(start.share, np.log(start.length))]
        elif serial:
            begin = [(0.5, np.log(-step / np.log(rho))) for rho in STARTS]
        v = np.full(count, -2.0) if start is None else np.log(start.v)
        x = min((np.array([*s, *v]) for s in begin), key=lambda x: climb(x)[0])
        bounds = [
            (0.0, MOST_SHARE if serial else 0.0),
            (np.log(0.2 * step), np.log(2.0 * span)),
            *[(np.log(LEAST), np.log(MOST))] * count,
        ]
        found = minimize(climb, x, jac=True, bounds=bounds, method="L-BFGS-B")
        share, length = (float(x) for x in (found.x[0], np.exp(found.x[1])))
        return _SerialPoint(share, length, np.exp(found.x[2:]), -float(found.fun))

    def _projected(self, sigma: Floats) -> tuple[Floats, Floats, float]:
        """P (R, R), P y, and log det Σ + log det H."""
        lower = np.linalg.cholesky(sigma + ROUNDING * np.eye(len(sigma)))
        half = np.tril(lapack.dpotri(lower, lower=1)[0])
        inverse = half + np.tril(half, -1).T
        b = inverse @ self.columns
        h = self.columns.T @ b + np.diag(self.ridge)
        h += ROUNDING * float(np.trace(h)) / len(h) * np.eye(len(h))
        lifted = b @ inverse_root(h).T
        p = inverse - lifted @ lifted.T
        log_det = 2 * float(np.log(np.diag(lower)).sum()) + float(np.linalg.slogdet(h)[1])
        return p, p @ self.y, log_det

    def _likelihood(
        self, rivals: Floats, share: float, length: float, v: Floats, stated: bool = False
    ) -> tuple[float, Floats]:
        """ℓ and its slope by φ, τ and v (2 + F,)."""
        c = np.exp(-self.away / length)
        sigma = np.eye(len(self.y)) + np.tensordot(v, rivals, axes=1)
        if share > 0:
            serial = self.correlated(c) - self.own
            sigma += share * serial
        p, py, log_det = self._projected(sigma)
        square = float(self.y @ py)
        noise = 1.0 if stated else square / self.free
        value = -0.5 * (self.free * np.log(noise) + square / noise + log_det)
        slope = -0.5 * (p - np.outer(py, py) / noise)
        by_share = by_length = 0.0
        if share > 0:
            by_share = float(np.vdot(slope, serial))
            by_length = float(np.vdot(slope, share * self.correlated(c * self.away / length**2)))
        by_v = np.tensordot(rivals, slope, axes=2)
        return value, np.concatenate([[by_share, by_length], by_v])

    @cached_property
    def _white(self) -> tuple[Floats, Floats, float]:
        """P (R, R) and P y of white noise, and σ² there."""
        p, py, _ = self._projected(np.eye(len(self.y)))
        return p, py, max(float(self.y @ py) / self.free, 1e-300)

    def promise(self) -> float:
        """Gain of ℓ by serial noise as its slope and curvature at white noise let expect."""
        (p, py, noise), found = self._white, 0.0
        for rho in STARTS:
            k = self.correlated(rho ** (self.away / self.step)) - self.own
            pk = p @ k
            trace = float(np.trace(pk))
            slope = 0.5 * (float(py @ k @ py) / noise - trace)
            curvature = 0.5 * (float(np.sum(pk * pk.T)) - trace**2 / self.free)
            if slope > 0 and curvature > 0:
                found = max(found, 0.5 * slope**2 / curvature)
        return found

    def outdone(self, rivals: Floats) -> bool:
        """Whether that of the rivals which ℓ rises most for explains far more than serial noise."""
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
        other = max(value(size=size) for size in SIZES)
        return other - white >= LEAD * max(serial - white, 0.0) + CHANCE + SAME_EVIDENCE

    def noise(self, free: _SerialPoint, rivals: Floats, gain: float) -> SerialNoise:
        """Return the estimate; its uncertainties are by the curvature of ℓ."""
        at = self.climbed(rivals, serial=True, start=free, stated=True)
        stated = free.value - at.value < AGAINST
        at = at if stated else free
        share = min(at.share, MOST_SHARE - SHARE_STEP)

        def slopes(a: float, b: float) -> Floats:
            length = at.length * float(np.exp(b))
            g = self._likelihood(rivals, max(share + a, 0.0), length, at.v, stated)[1]
            return np.array([g[0], g[1] * length])

        steps = (SHARE_STEP, 0.0), (0.0, LENGTH_STEP)
        h = np.stack([(slopes(-a, -b) - slopes(a, b)) / (2 * (a + b)) for a, b in steps])
        both = share == at.share and float(np.linalg.det(h)) > 0 and h[0, 0] > 0
        c = np.linalg.inv(h) if both else np.diag(1.0 / np.maximum(np.diag(h), 1.0))
        rho = float(np.exp(-self.step / at.length))
        return SerialNoise(
            clock=self.clock,
            share=at.share,
            share_error=float(min(c[0, 0] ** 0.5, 1.0)),
            length=at.length,
            rho=rho,
            rho_error=float(min(rho * self.step / at.length * c[1, 1] ** 0.5, 1.0)),
            log_likelihood_ratio=gain,
        )


def _problem(found: Fit, clock: Clock) -> _SerialProblem | None:
    """Form the likelihood's rows along a clock; None where it stands still, or V has no inverse."""
    every, m = found.readings, POSITION
    t = every.states.time if clock == "time" else np.arange(len(every), dtype=float)
    assert t is not None  # noqa: S101 - the caller's condition
    along, t = replace(every, along=t)[~found.outlier], t[~found.outlier]
    if np.ptp(t) == 0:
        return None
    groups = (deflection_groups if found.mode == "deflection" else arrival_groups)(along)
    pieces = runs(along, groups, PIECE)  # all, or as many, evenly spaced, as have `MOST_ROWS`
    share = min(MOST_ROWS / (m * sum(p[0].size for p in pieces)), 1.0)
    evenly = np.linspace(0, len(pieces) - 1, max(int(len(pieces) * share), 1))
    chosen = [pieces[k] for k in evenly.astype(int)]
    place = np.zeros(len(along), dtype=np.int64)
    place[found.whitening.reading] = np.arange(len(found.raw))
    loaded = np.concatenate([g[0][0] for g in chosen])
    rows = np.concatenate([loaded, *(g[1][0] for g in chosen)])
    weights = block_diag(*(g[2] for g in chosen))
    difference = np.kron(np.concatenate([np.eye(len(loaded)), -weights], axis=1), np.eye(m))
    some = along[rows]
    white = block_diag(*some.covariance[:, :m, :m])
    if some.common is not None:
        flat = some.common[:, :m].reshape(len(rows) * m, -1)
        together = (some.arrivals[:, None] == some.arrivals) & ~np.eye(len(rows), dtype=bool)
        white = white + (flat @ flat.T) * np.kron(together, np.ones((m, m)))
    v = difference @ white @ difference.T
    std = np.sqrt(np.diag(v))
    if not np.all(std > 0):
        return None
    try:
        lower = np.linalg.cholesky(v / std[:, None] / std)
    except np.linalg.LinAlgError:
        return None
    inverse = solve_triangular(lower, np.diag(1 / std), lower=True, check_finite=False)
    whitened = inverse @ difference
    s = found.solution
    live = np.flatnonzero(s.estimated)
    jacobian = found.model.jacobian(s.prediction, s.theta, m, live)[rows]
    columns = whitened @ (jacobian.reshape(-1, len(live)) @ s.transform[live])
    y = inverse @ found.raw[place[loaded], :m].reshape(-1) + columns @ s.coordinates()
    each = whitened.reshape(len(y), len(rows), m)
    factor = np.einsum("rni,nij->rnj", each, instrument_root(some, m))
    ridge = s.equations.basis.prior_precision
    if len(y) < 2 * np.sum(ridge == 0):
        return None
    return _SerialProblem(found, clock, rows, y, columns, ridge, factor, whitened, t[rows])
