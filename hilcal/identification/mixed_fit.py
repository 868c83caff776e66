"""The mixed model of effects, fitted to readings.

The model contains its effects, usually all of the catalogue that the readings allow, and each of
their families has a variance (see `hilcal.mixed`). The rows are linearised repeatedly at the
parameters that the mixed model predicts, until these converge.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES, EffectSpec
from hilcal.identification.gauss_newton import shortened, whitened_jacobian
from hilcal.identification.noise.full_covariance import joint_factors, whitened_blocks
from hilcal.identification.residual import residual
from hilcal.mixed.families import Families, LogStdPrior, families_of
from hilcal.mixed.problem import MixedProblem, Noise, independent_rows, mixed_problem
from hilcal.mixed.variances import Variances, coordinates_covariance, estimate_variances
from hilcal.model.model import Model, Prediction
from hilcal.readings.covariance import scatter_alone
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode, Whitening, whitening
from hilcal.types import Floats

HARMONICS = 64
"""Harmonics of a transmission error, whatever the number of poses: the arm also has those that few
poses cannot resolve, where they act as scatter. A choice: errors of the teeth of strain wave gears
have the period of a turn of the motor, 100 and more in a turn of the joint, and are too small for
any tracker."""
MOST_LINEARISATIONS = 5
"""Most linearisations; a choice, three are usual."""
CONVERGED = 0.02
"""Change of the predicted readings, in units of their noise, that ends the linearisations."""
HALVINGS = 6
"""Most trials of a step, each half as long as the previous one; a choice."""
SCATTER_RAD = 3e-5
"""Ordinary scatter of a joint, rad: 30 µm at 1 m, as makers state it; the prior mean of η is 0."""
INSTRUMENT, SCATTER = "instrument", "arm's scatter"
"""Names of the components of the noise."""
UNMEASURED_THRESHOLD = -0.5
"""Threshold for rows that are not measured, to which `independent_rows` gives the variance -1."""
SCATTER_WEIGHT = 1e-3
"""Weight of the arm's scatter in the matrix whose eigenvectors turn the rows: it decides where the
instrument's parts are isotropic."""
MOST_NOISE_ROWS = 1500
"""Most elements of readings whose noise is estimated with the variances of the effects. The noise
of more is estimated from poses chosen at random: equations of white noise are many times faster
(`MixedProblem.compressed`). A choice."""
SEED = 0  # of these poses
NOISE_SPREAD = 1.5
"""Spread of the log standard deviation of the noise: a factor of 4.5 either way; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class NoisePart:
    """A part of the noise of N readings."""

    name: str
    covariance: Floats  # (N, m, m) at its ordinary size
    prior: LogStdPrior  # of the log standard deviation, in ordinary sizes
    common: Floats | None = None  # (N, m, n) F of the noise of one arrival; see `Readings.common`


@dataclass(frozen=True, eq=False)
class MixedFit:
    """A mixed model fitted to readings."""

    model: Model  # with all effects
    readings: Readings  # the fitted ones
    theta: Floats  # (P,) parameters
    variances: Variances  # of the families and of the noise, at the last linearisation
    covariance: Floats  # (K, K) of the errors of the coordinates

    @property
    def problem(self) -> MixedProblem:
        """The linear problem at the last linearisation."""
        return self.variances.equations.problem

    def std(self, name: str) -> float:
        """Return the estimated standard deviation of a family or of a component of the noise."""
        return self.variances.std(name)

    def prior_std(self) -> Floats:
        """(P,) standard deviations of the parameters; infinite for frames."""
        out = np.full(self.model.size, np.inf)
        for f, log_std in zip(self.problem.families.random, self.variances.log_std, strict=False):
            out[f.parameters] = np.exp(log_std) * f.magnitude
        return out


def with_all_effects(
    model: Model, states: States, harmonics: int = HARMONICS, without: Collection[str] = ()
) -> Model:
    """Return a model with every effect of its catalogue that the states allow, except `without`.

    Effects with harmonics have at least `harmonics` of them, even if few poses cannot resolve them.
    """
    model = with_all_harmonics(model, states, harmonics)
    for kind in model.catalogue.effects:
        if kind.name in (*model.names, *without) or kind.role in FRAME_ROLES:
            continue
        if not (kind.computable(states) and kind.applies(model.cell)):
            continue
        fine = {"harmonics": harmonics} if "harmonics" in kind.option_help else {}
        model = model + EffectSpec(kind.name, fine)
    return model


def with_all_harmonics(model: Model, states: States, harmonics: int = HARMONICS) -> Model:
    """Return a model whose effects with harmonics have at least so many.

    Effects whose harmonics change lose their stated standard deviations.
    """
    finer = tuple(
        e.with_options(states, harmonics=harmonics)
        if "harmonics" in e.options and len(getattr(e, "harmonics", ())) < harmonics
        else e
        for e in model.effects
    )
    unchanged = {e.name for e, old in zip(finer, model.effects, strict=True) if e is old}
    random = {name: std for name, std in model.random.items() if name in unchanged}
    return replace(model, effects=finer, random=random)


def mixed_fit(model: Model, readings: Readings, mode: Mode) -> MixedFit:
    """Fit the effects of a model and all others of its catalogue; see `mixed_fit_of`."""
    return mixed_fit_of(with_all_effects(model, readings.states), readings, mode)


def mixed_fit_of(
    model: Model,
    readings: Readings,
    mode: Mode,
    flat: Collection[str] = (),  # effects whose parameters have no prior
    lines: Collection[str] = (),  # effects of which each group is a family
    start: MixedFit | None = None,  # of the same model
) -> MixedFit:
    """Fit the effects of a model together to readings without gross errors.

    Raises:
        CannotAnswerError: no static equilibrium, or no likelihood.
        InputError: a deflection without its unloaded reading.
    """
    w = whitening(readings, mode, "gc")
    variances, theta = _iterated(model, readings, w, families_of(model, flat, lines), start=start)
    return MixedFit(model, readings, theta, variances, coordinates_covariance(variances))


def mixed_fit_at(
    model: Model, readings: Readings, mode: Mode, theta: Floats, families: Families | None = None
) -> Variances:
    """Estimate the variances of a model's effects, linearised at fixed parameters theta (P,).

    The readings have no gross errors; see `linearised_problem`.
    """
    problem = linearised_problem(model, readings, mode, theta, families)
    return estimate_variances(problem, sizes_at(problem, model, theta))


def linearised_problem(
    model: Model, readings: Readings, mode: Mode, theta: Floats, families: Families | None = None
) -> MixedProblem:
    """Return the linear problem of a model at theta (P,), for readings without gross errors.

    The arm's scatter is a part of the noise, unless stated. If it was estimated and the readings
    are more than `MOST_NOISE_ROWS` elements, it counts as known.
    """
    many = readings.value.size > MOST_NOISE_ROWS
    if many and readings.arm_scatter is not None:
        readings = replace(readings, scatter_stated=True)
    else:
        readings = readings.as_stated()
    rows = _rows(model, readings, whitening(readings, mode, "gc"))
    problem = rows.linearised(rows.at(theta), families or families_of(model))
    return problem.compressed() if many else problem


def shift_rows(model: Model, readings: Readings, mode: Mode) -> Floats:
    """(R, N, m) rows of `linearised_problem` by a unit shift of each element of each reading.

    For at most `MOST_NOISE_ROWS` elements of readings.
    """
    readings = readings.as_stated()
    w, count = whitening(readings, mode, "gc"), readings.value.size
    shifts = np.eye(count).reshape(len(readings), readings.m, count)
    rows = _rows(model, readings, w).turned(w.whiten_readings(shifts))
    return rows.reshape(len(rows), len(readings), readings.m)


def sizes_at(problem: MixedProblem, model: Model, theta: Floats) -> Floats:
    """Log s and η (F + N,) from the standard deviations of the model, or else from theta (P,).

    For families that are zero or of known size, and for the noise, the priors' means.
    """
    std = theta.copy()
    for effect, rows in zip(model.effects, model.slices(), strict=True):
        if effect.name in model.random:
            std[rows] = model.random[effect.name]
    out = problem.log_std_prior[0].copy()
    for k, f in enumerate(problem.families.random):
        size = float(np.sqrt(np.mean((std[f.parameters] / f.magnitude) ** 2)))
        if size > 0.0 and not f.known:
            out[k] = np.log(size)
    return out


def variances_with_noise(
    model: Model, readings: Readings, mode: Mode, instrument: Sequence[NoisePart], arm: NoisePart
) -> tuple[Variances, Floats]:
    """Estimate the variances of effects, of parts of the instrument's noise, and of the arm's.

    The readings have no gross errors, and the covariance of the instrument, which is the sum of its
    parts. The parameters (P,) predicted with the variances are returned, too.
    """
    return _iterated(model, readings, whitening(readings, mode, "gc"), None, (*instrument, arm))


def _iterated(
    model: Model,
    readings: Readings,
    w: Whitening,
    families: Families | None = None,
    parts: Sequence[NoisePart] = (),
    start: MixedFit | None = None,
) -> tuple[Variances, Floats]:
    """Return the variances and the parameters (P,) predicted with them, linearised there.

    A step that increases the penalised squares is halved, as large parameters that cancel in the
    linear model do not cancel exactly.
    """
    rows = _rows(model, readings, w, parts)
    families = families or families_of(model)
    point, log_std = rows.at(np.zeros(model.size)), None
    if start is not None:
        point, count = rows.at(start.theta), len(families.random) + len(rows.noise)
        log_std = start.variances.log_std[:count]
    for _ in range(MOST_LINEARISATIONS):
        problem = rows.linearised(point, families)
        variances = estimate_variances(problem.compressed(), log_std, search=True)
        log_std, previous = variances.log_std, point
        aim = problem.parameters(variances.equations.coordinates, model.size)
        cost = partial(_penalised, problem=problem, log_std=log_std)
        along = partial(rows.along, previous)
        reached = shortened(along, aim - previous.theta, HALVINGS, cost, cost(previous))
        if reached is None:
            break
        point = reached
        if float(np.sqrt(np.mean((point.white - previous.white) ** 2))) < CONVERGED:
            break
    return variances, point.theta


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """The residual at some parameters."""

    theta: Floats  # (P,)
    prediction: Prediction
    white: Floats  # (R,) in the rows of the problem


def _penalised(point: _Point, problem: MixedProblem, log_std: Floats) -> float:
    """Squares of the residual and of the parameters, in their standard deviations."""
    random = problem.families.random
    penalty = sum(
        float(np.sum((point.theta[f.parameters] / (s * f.magnitude)) ** 2))
        for f, s in zip(random, np.exp(log_std), strict=False)
    )
    noise_std = problem.noise_std(log_std[len(random) :])
    return float(np.sum((point.white / noise_std) ** 2)) + penalty


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Whitened rows of readings, turned so that all noise is diagonal."""

    model: Model
    readings: Readings
    w: Whitening
    bases: tuple[Floats, ...]  # (G, S, S) U of each bucket of rows; empty where none is turned
    noise: tuple[Noise, ...]  # its components

    def turned(self, rows: Floats) -> Floats:
        """Uᵀ times the whitened rows (R, ...) of each bucket."""
        out, start = rows.copy(), 0
        for u in self.bases:
            block = slice(start, start + u.shape[0] * u.shape[1])
            of_bucket = rows[block].reshape(*u.shape[:2], -1)
            out[block] = (np.swapaxes(u, 1, 2) @ of_bucket).reshape(out[block].shape)
            start = block.stop
        return out

    def at(self, theta: Floats) -> _Point:
        """Return the residual at the parameters (P,)."""
        prediction = self.model.predict(self.readings.states, theta)
        white = self.w.whiten(residual(self.readings, prediction, self.w)).reshape(-1)
        return _Point(theta, prediction, self.turned(white))

    def along(self, point: _Point, step: Floats) -> _Point:
        """Return the residual at a point plus a step (P,)."""
        return self.at(point.theta + step)

    def linearised(self, point: _Point, families: Families) -> MixedProblem:
        """Return the linear problem at a point."""
        live = np.arange(self.model.size)
        columns = whitened_jacobian(self.model, point.prediction, point.theta, self.w, live)
        columns = self.turned(columns)
        return mixed_problem(point.white + columns @ point.theta, columns, families, self.noise)


def _rows(model: Model, readings: Readings, w: Whitening, parts: Sequence[NoisePart] = ()) -> _Rows:
    """Return the rows of readings with the `parts` of the noise, or with two.

    These are the instrument and, unless stated in the readings, the arm's scatter.
    """
    if parts:
        return _Rows(model, readings, w, *_diagonal_parts(parts, readings, w))
    prior = LogStdPrior(0.0, NOISE_SPREAD)
    measured = [np.any(b.factor != 0, axis=2) for b in w.buckets]
    if readings.scatter_stated:
        unit = np.concatenate([m.reshape(-1) for m in measured]).astype(np.float64)
        return _Rows(model, readings, w, (), (Noise(INSTRUMENT, unit, prior),))
    scatter = scatter_alone(readings, _scatter_factors(model, readings))
    blocks = zip(whitened_blocks(scatter, w), measured, strict=True)
    bases, variances = zip(*(independent_rows(c, m) for c, m in blocks), strict=True)
    variance = np.concatenate([v.reshape(-1) for v in variances])
    instrument = Noise(INSTRUMENT, (variance > UNMEASURED_THRESHOLD).astype(np.float64), prior)
    noise = instrument, Noise(SCATTER, np.maximum(variance, 0.0), prior)
    return _Rows(model, readings, w, bases, noise)


def _diagonal_parts(
    parts: Sequence[NoisePart], readings: Readings, w: Whitening
) -> tuple[tuple[Floats, ...], tuple[Noise, ...]]:
    """Return U (G, S, S) of each bucket, which turns the parts of the noise, and the turned parts.

    The sum of the instrument's parts whitens the rows, so that the parts share their eigenvectors.
    Of the last part, the arm's, correlations between different instrument parts are neglected.
    """
    part_blocks = [
        whitened_blocks(replace(readings, covariance=p.covariance, common=p.common, serial=None), w)
        for p in parts
    ]
    bases = []
    variances: list[list[Floats]] = [[] for _ in parts]
    for blocks in zip(*part_blocks, strict=True):
        *instrument, arm = blocks
        size = max(float(np.abs(arm).max(initial=0.0)), 1e-300)
        weighted = sum((j * x for j, x in enumerate(instrument, 1)), SCATTER_WEIGHT * arm / size)
        u = np.linalg.eigh(weighted)[1]
        bases.append(u)
        for variance, x in zip(variances, blocks, strict=True):
            variance.append(np.einsum("gij,gik,gkj->gj", u, x, u).reshape(-1))
    return tuple(bases), tuple(
        Noise(p.name, np.maximum(np.concatenate(v), 0.0), p.prior)
        for p, v in zip(parts, variances, strict=True)
    )


def scatter_part(model: Model, readings: Readings) -> NoisePart:
    """Return the arm's scatter, of `SCATTER_RAD` in each joint, as a part of the noise."""
    scatter = scatter_alone(readings, _scatter_factors(model, readings))
    prior = LogStdPrior(0.0, NOISE_SPREAD)
    return NoisePart(SCATTER, scatter.covariance, prior, scatter.common)


def _scatter_factors(model: Model, readings: Readings) -> Floats:
    """(N, m, n) F of the arm's scatter with `SCATTER_RAD` in each joint."""
    n = model.cell.arm.n
    return joint_factors(model.cell, readings, np.full(n, SCATTER_RAD))
