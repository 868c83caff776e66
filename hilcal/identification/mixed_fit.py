"""The mixed model of effects, fitted to readings.

Every effect of the model takes part, most often each of the catalogue that the readings allow, and
each of its families with a variance of its own (see `hilcal.mixed`). The rows are linearised at the
joint optimum: at the parameters that the mixed model predicts, again until they stay.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.effects.spec import EffectSpec
from hilcal.errors import CannotAnswerError
from hilcal.identification.full_covariance import joint_factors, whitened_blocks
from hilcal.identification.residual import residual
from hilcal.mixed.equations import Equations
from hilcal.mixed.families import Families, LogStdPrior, families_of
from hilcal.mixed.problem import MixedProblem, Noise, independent_rows, mixed_problem
from hilcal.mixed.variances import Variances, coordinates_covariance, estimate_variances
from hilcal.model.model import Model
from hilcal.readings.covariance import scatter_alone
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode, Whitening, whitening
from hilcal.types import Floats

HARMONICS = 64
"""Harmonics of a transmission error, whatever the number of poses: those that few poses cannot
resolve are there all the same, and act as scatter. A choice: teeth of strain wave gears err once a
turn of the motor, 100 and more times a turn of the joint, by less than any tracker sees."""
ROUNDS = 5
"""Most linearisations; a choice, three are usual."""
CONVERGED = 0.02
"""Change of the predicted readings, in units of their noise, at which the linearisation stays."""
HALVINGS = 6
"""Most trials of a step, each half as long as the one before; a choice."""
SCATTER_RAD = 3e-5
"""Ordinary scatter of a joint, rad: 30 µm at 1 m, as makers state it; η of it is about zero."""
INSTRUMENT, SCATTER = "instrument", "arm's scatter"
"""Names of the components of the noise."""
UNSEEN = -0.5
"""`independent_rows` gives a row that is not seen the variance -1."""
LITTLE = 1e-3
"""Share by which the arm's scatter turns rows that the instrument's parts leave alike."""
NOISE_SPREAD = 1.5
"""Of the log of the noise: a factor of 4.5 either way; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class NoisePart:
    """A part of the noise of N readings."""

    name: str  # of it
    covariance: Floats  # (N, m, m) of a part of ordinary size
    prior: LogStdPrior  # of the log of the standard deviation, in that size
    # (N, m, n) F of what readings of one arrival have in common; see `Readings.common`
    common: Floats | None = None


@dataclass(frozen=True, eq=False)
class MixedFit:
    """All effects at once, fitted to readings."""

    model: Model  # with all effects
    readings: Readings  # that it was fitted to
    theta: Floats  # (P,) parameters
    variances: Variances  # those of the families and of the noise, at the last linearisation
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


def with_all_effects(model: Model, states: States, harmonics: int = HARMONICS) -> Model:
    """Return a model with every effect of its catalogue that the states allow.

    Waves that few poses cannot resolve are there all the same; `harmonics` of them are kept.
    """
    model = with_all_harmonics(model, states, harmonics)
    for kind in model.catalogue.effects:
        if kind.name in model.names or kind.role in FRAME_ROLES:
            continue
        if not (kind.computable(states) and kind.applies(model.cell)):
            continue
        fine = {"harmonics": harmonics} if "harmonics" in kind.option_help else {}
        model = model + EffectSpec(kind.name, fine)
    return model


def with_all_harmonics(model: Model, states: States, harmonics: int = HARMONICS) -> Model:
    """Return a model whose waves have at least so many harmonics.

    Standard deviations of an effect that gets finer are not kept.
    """
    finer = tuple(
        e.with_options(states, harmonics=harmonics)
        if "harmonics" in e.options and len(getattr(e, "harmonics", ())) < harmonics
        else e
        for e in model.effects
    )
    kept = {e.name for e, old in zip(finer, model.effects, strict=True) if e is old}
    random = {name: std for name, std in model.random.items() if name in kept}
    return replace(model, effects=finer, random=random)


def mixed_fit(model: Model, readings: Readings, mode: Mode) -> MixedFit:
    """Fit all effects of the catalogue at once, beside those of a model; see `mixed_fit_of`."""
    return mixed_fit_of(with_all_effects(model, readings.states), readings, mode)


def mixed_fit_of(
    model: Model,
    readings: Readings,
    mode: Mode,
    flat: Collection[str] = (),  # effects whose parameters have no prior
    lines: Collection[str] = (),  # effects of which each group has a size of its own
) -> MixedFit:
    """Fit the effects of a model at once, to readings without gross errors.

    Raises:
        CannotAnswerError: no static equilibrium, or no likelihood.
        InputError: a deflection without its unloaded reading.
    """
    w = whitening(readings, mode, "gc")
    found, theta = _iterated(model, readings, w, families_of(model, flat, lines))
    return MixedFit(model, readings, theta, found, coordinates_covariance(found))


def mixed_fit_at(model: Model, readings: Readings, mode: Mode, theta: Floats) -> Variances:
    """Estimate the variances of a model's effects at parameters theta (P,), without moving them.

    The readings are without gross errors, with their stated covariance.
    """
    problem = linearised_problem(model, readings, mode, theta)
    return estimate_variances(problem, sizes_at(problem, model, theta))


def linearised_problem(model: Model, readings: Readings, mode: Mode, theta: Floats) -> MixedProblem:
    """Return the linear problem of a model at parameters theta (P,); arguments as above."""
    w = whitening(readings, mode, "gc")
    return _linearise(model, readings, w, theta).problem


def sizes_at(problem: MixedProblem, model: Model, theta: Floats) -> Floats:
    """Log s and η (F + N,) of a fit: of the standard deviations of its model, else of theta (P,).

    The priors' means for families that are not in it.
    """
    std = theta.copy()
    for effect, mine in zip(model.effects, model.slices(), strict=True):
        if effect.name in model.random:
            std[mine] = model.random[effect.name]
    out = problem.log_std_prior[0].copy()
    for k, f in enumerate(problem.families.random):
        size = float(np.sqrt(np.mean((std[f.parameters] / f.magnitude) ** 2)))
        if size > 0.0 and not f.known:
            out[k] = np.log(size)
    return out


def variances_with_noise(
    model: Model, readings: Readings, mode: Mode, instrument: Sequence[NoisePart], arm: NoisePart
) -> tuple[Variances, Floats]:
    """Estimate the variances of effects, of parts of the instrument's noise and of the arm's.

    The readings, without gross errors, have the covariance of the instrument, which its parts add
    up to. The parameters (P,) that the variances predict are returned with them.
    """
    return _iterated(model, readings, whitening(readings, mode, "gc"), None, (*instrument, arm))


def _iterated(
    model: Model,
    readings: Readings,
    w: Whitening,
    families: Families | None = None,
    parts: Sequence[NoisePart] = (),
) -> tuple[Variances, Floats]:
    """Estimate the variances, linearised at the parameters (P,) that they predict; and those.

    A step that makes the penalised squares larger is halved: large parameters that cancel in the
    linear model do not do so exactly.
    """
    theta, start = np.zeros(model.size), None
    here, rounds = _linearise(model, readings, w, theta, families, parts), 0
    while True:
        found = estimate_variances(here.problem, start, search=True)
        start, rounds = found.log_std, rounds + 1
        before = here.penalised(theta, found.equations)
        step = here.problem.parameters(found.equations.coordinates, model.size) - theta
        for k in range(HALVINGS):
            trial = theta + 0.5**k * step
            try:
                there = _linearise(model, readings, w, trial, families, parts)
            except CannotAnswerError:  # no equilibrium so far away
                continue
            if there.penalised(trial, found.equations) <= before:
                break
        else:
            return found, theta
        moved = float(np.sqrt(np.mean((there.white - here.white) ** 2)))
        theta, here = trial, there
        if rounds == ROUNDS or moved < CONVERGED:
            return found, theta


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """A linear problem at some parameters."""

    problem: MixedProblem  # of it
    white: Floats  # (R,) residual there, in the rows of the problem

    def penalised(self, theta: Floats, at: Equations) -> float:
        """Squares of the residual and of the parameters (P,), each in its standard deviations."""
        p = self.problem
        std = np.exp(at.log_std)
        sizes = sum(
            float(np.sum((theta[f.parameters] / (s * f.magnitude)) ** 2))
            for f, s in zip(p.families.random, std, strict=False)
        )
        return float(np.sum((self.white / at.noise_std) ** 2)) + sizes


def _linearise(
    model: Model,
    readings: Readings,
    w: Whitening,
    theta: Floats,
    families: Families | None = None,
    parts: Sequence[NoisePart] = (),
) -> _Linearised:
    """Linearise at theta (P,)."""
    prediction = model.predict(readings.states, theta)
    now = w.whiten(residual(readings, prediction, w)).reshape(-1)
    jacobian = w.whiten_readings(model.jacobian(prediction, theta, w.m))
    rows = np.column_stack([now, jacobian])
    if parts:
        rows, noise = _noise_of(parts, readings, w, rows)
    else:
        rows, noise = _noise(model, readings, w, rows)
    white, jacobian = rows[:, 0], rows[:, 1:]
    problem = mixed_problem(
        white + jacobian @ theta, jacobian, families or families_of(model), noise
    )
    return _Linearised(problem, white)


def _noise(
    model: Model, readings: Readings, w: Whitening, rows: Floats
) -> tuple[Floats, list[Noise]]:
    """Whitened rows (R, ...), turned so that all noise is diagonal, and its components.

    They are the instrument's, and the arm's scatter where the readings do not state it.
    """
    prior = LogStdPrior(0.0, NOISE_SPREAD)
    seen = [np.any(b.factor != 0, axis=2) for b in w.buckets]
    if readings.scatter_stated:
        whole = np.concatenate([s.reshape(-1) for s in seen]).astype(np.float64)
        return rows, [Noise(INSTRUMENT, whole, prior)]
    of = scatter_alone(readings, _scatter_factors(model, readings))
    blocks = zip(whitened_blocks(of, w), seen, strict=True)
    bases, variances = zip(*(independent_rows(c, s) for c, s in blocks), strict=True)
    variance = np.concatenate([v.reshape(-1) for v in variances])
    instrument = Noise(INSTRUMENT, (variance > UNSEEN).astype(np.float64), prior)
    return _turned(rows, bases), [instrument, Noise(SCATTER, np.maximum(variance, 0.0), prior)]


def _noise_of(
    parts: Sequence[NoisePart], readings: Readings, w: Whitening, rows: Floats
) -> tuple[Floats, list[Noise]]:
    """Whitened rows (R, ...), turned so that the parts of the noise are diagonal, and these.

    The instrument's parts add up to what the rows are whitened by, so that they share their
    eigenvectors; of the arm's, the last one, what is correlated between two of these parts is left
    out.
    """
    of_parts = [
        whitened_blocks(replace(readings, covariance=p.covariance, common=p.common, serial=None), w)
        for p in parts
    ]
    bases = []
    variances: list[list[Floats]] = [[] for _ in parts]
    for blocks in zip(*of_parts, strict=True):
        *instrument, arm = blocks
        size = max(float(np.abs(arm).max(initial=0.0)), 1e-300)
        apart = sum((j * x for j, x in enumerate(instrument, 1)), LITTLE * arm / size)
        u = np.linalg.eigh(apart)[1]
        bases.append(u)
        for of_part, x in zip(variances, blocks, strict=True):
            of_part.append(np.einsum("gij,gik,gkj->gj", u, x, u).reshape(-1))
    return _turned(rows, bases), [
        Noise(p.name, np.maximum(np.concatenate(v), 0.0), p.prior)
        for p, v in zip(parts, variances, strict=True)
    ]


def _turned(rows: Floats, bases: Sequence[Floats]) -> Floats:
    """Rows (R, ...) by the axes U (G, S, S) of each bucket."""
    out, start = np.empty_like(rows), 0
    for u in bases:
        stop = start + u.shape[0] * u.shape[1]
        block = rows[start:stop].reshape(*u.shape[:2], -1)
        out[start:stop] = (np.swapaxes(u, 1, 2) @ block).reshape(stop - start, -1)
        start = stop
    return out


def scatter_part(model: Model, readings: Readings) -> NoisePart:
    """Return the arm's scatter, of `SCATTER_RAD` in each joint, as a part of the noise."""
    of = scatter_alone(readings, _scatter_factors(model, readings))
    return NoisePart(SCATTER, of.covariance, LogStdPrior(0.0, NOISE_SPREAD), of.common)


def _scatter_factors(model: Model, readings: Readings) -> Floats:
    """(N, m, n) F of the arm's scatter by joints of `SCATTER_RAD` each."""
    n = model.cell.arm.n
    return joint_factors(model.cell, readings, np.full(n, SCATTER_RAD))
