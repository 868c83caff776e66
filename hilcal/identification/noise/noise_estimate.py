"""The noise of readings that nobody states, estimated from the readings themselves.

The noise that [tracker] has by default is that of a laser tracker. Where neither a table nor the
cell states another one, the standard deviations along and across the beam, and those of
orientations, are the default's times estimated factors; the arm's scatter, one σ for all joints, is
estimated where [repeatability] does not state it:

    V = f_a² V_along + f_c² V_across + f_o² V_orientation + σ_q² R J Jᵀ Rᵀ

They are variance components, estimated by restricted maximum likelihood together with the frames
and with every effect of the catalogue as random effects (see `hilcal.mixed`), without gross errors.
Where the readings show several effects at once, few of them cannot separate noise from effects: the
default stays then, and a fit of all effects estimates the noise (`identification.background`).

The covariance of a measured reading is that of the mean of its samples, of which the default is the
prior. Errors of the instrument that change from pose to pose do not show in them. Where the
readings of a campaign contradict them, f_a, f_c and f_o are stored with it (`measured_noise`), and
the default's covariance times these takes their place when it is opened (`with_noise_factors`).
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig, Tracker
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import HilcalError, InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.mixed_fit import (
    SCATTER,
    SCATTER_RAD,
    NoisePart,
    scatter_part,
    variances_with_noise,
    with_all_effects,
)
from hilcal.identification.noise.arm_scatter import some_poses
from hilcal.identification.noise.full_covariance import with_joint_scatter, with_noise_of
from hilcal.mixed.families import KNOWN_SPREAD, LogStdPrior
from hilcal.mixed.variances import Variances, evidence
from hilcal.model.model import Model
from hilcal.readings.covariance import INSTRUMENT, INSTRUMENT_AND_ARM
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import usual_mode
from hilcal.tables.table import FROM_TRACKER, ImportResult
from hilcal.types import Floats

# Most of these are choices.
SPREAD = 3.0  # of the log of a factor: 20 either way; cameras see by a hundred times less
HARMONICS = 6  # waves of a gear that take part, for speed; finer ones act as the arm's scatter
MOST_ROWS = 900  # elements of readings, of poses chosen at random: a σ is known to some per cent
FEWEST_POSES = 10  # below which frames and effects leave nothing to estimate a noise from
MOST_ROUNDS = 3  # of an estimate after a new test for gross errors
SEVERAL_LEVEL = 0.05  # chance of finding several effects where there is one at most
SEED = 20251125  # of the poses that are chosen, and of simulated likelihood ratios
NOISE_KEY = "noise"
"""Key among the texts about an imported campaign, and kind of event of a measured one: the
estimate; absent where the noise is stated, or as the samples show it."""
STANDARD_ERRORS = 3.0  # of a factor's log, by which readings contradict covariances
LEAST_FACTOR = 1.3  # from which on the noise of readings differs from that of their samples
ALONG, ACROSS, ORIENTATION, ARM_AS_STATED = "along", "across", "orientation", "arm as stated"


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """The estimated noise of readings; standard deviations of the median reading."""

    along_m: float  # along the beam
    across_m: float  # along each axis across it
    orientation_rad: float | None  # of a rotation about any axis; None where positions were read
    distance_m: float  # length of the beam
    joint_std_rad: float | None  # the arm's scatter, of each joint; None where the cell states it
    factors: Mapping[str, float] | None = None  # f of measured readings by component; None for an
    # import, the covariances of which are stored as estimated

    def to_json(self) -> str:
        """Return the estimate as a text of a campaign."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str | None) -> "NoiseEstimate | None":
        """Return what `to_json` wrote; None where there is none."""
        return None if text is None else cls.of(json.loads(text))

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "NoiseEstimate":
        """Return the estimate of a dictionary by `asdict`, which may have further keys."""
        values: dict[str, Any] = {f.name: content.get(f.name) for f in fields(cls)}
        return cls(**values)


def with_estimated_noise(
    imported: ImportResult, cell: Cell
) -> tuple[ImportResult, NoiseEstimate | None]:
    """Return an import with estimated noise where nobody states it, and the estimate.

    The covariance of readings of one target includes the arm's scatter then. Several targets share
    it in one arrival, so that `diagnose` estimates it. None where the noise is stated, where the
    readings are fewer than `FEWEST_POSES` or show several effects, or where nothing can be fitted
    to them as they are described.
    """
    readings, station = imported.readings, cell.configured().tracker.station_m
    components = None if imported.noise_stated else _components(readings, cell)
    if components is None:
        return imported, None
    factors, estimate = components.factors, components.estimate(readings, station)
    together = SCATTER in factors and readings.states.target is None
    used = factors if together else {k: f for k, f in factors.items() if k != SCATTER}
    estimated = _with_factors(readings, station, used, components.model)
    covers = INSTRUMENT_AND_ARM if together else INSTRUMENT
    notes = tuple(n for n in imported.notes if not n.startswith(FROM_TRACKER))
    return replace(imported, readings=estimated, covers=covers, notes=notes), estimate


def measured_noise(readings: Readings, cell: Cell) -> NoiseEstimate | None:
    """Return the noise of measured readings that contradict their samples, with its factors.

    None where the cell states it, where samples show it, or as of `with_estimated_noise`.
    """
    config = cell.configured()
    if config.tracker.states_noise:
        return None
    station = config.tracker.station_m
    try:
        default = with_noise_of(config.tracker, readings)
    except InputError:  # a reading at the station
        return None
    components = _components(default, cell)
    if components is None:
        return None
    factors = {k: f for k, f in components.factors.items() if k not in (SCATTER, ARM_AS_STATED)}
    sampled, default_sizes = _sizes(readings, station), _sizes(default, station)
    off = (
        abs(np.log(f * default_sizes[k] / sampled[k]))
        > max(np.log(LEAST_FACTOR), STANDARD_ERRORS * components.log_errors[k])
        for k, f in factors.items()
    )
    if not any(off):
        return None
    return replace(components.estimate(default, station), joint_std_rad=None, factors=factors)


def with_noise_factors(
    readings: Readings, tracker: Tracker, factors: Mapping[str, float]
) -> Readings:
    """Return readings with the default noise of [tracker], its components times their factors."""
    return _with_factors(with_noise_of(tracker, readings), tracker.station_m, factors)


def _sizes(readings: Readings, station: Sequence[float] | None) -> dict[str, float]:
    """Standard deviations of the components, m and rad: over all axes, of the median reading."""
    return {
        p.name: float(np.sqrt(np.median(np.trace(p.covariance, axis1=1, axis2=2))))
        for p in _instrument(readings, station)
    }


@dataclass(frozen=True, slots=True, eq=False)
class _Components:
    model: Model  # frames, at which the arm's scatter is evaluated
    factors: Mapping[str, float]  # standard deviations, in those of the default and `SCATTER_RAD`
    log_errors: Mapping[str, float]  # standard errors of their logs

    def estimate(self, readings: Readings, station: Sequence[float] | None) -> NoiseEstimate:
        size = {k: self.factors[k] * s for k, s in _sizes(readings, station).items()}
        turn = size.get(ORIENTATION)
        scatter = self.factors.get(SCATTER)
        return NoiseEstimate(
            along_m=size[ALONG],
            across_m=size[ACROSS] / float(np.sqrt(2.0)),
            orientation_rad=None if turn is None else turn / float(np.sqrt(3.0)),
            distance_m=float(np.median(np.linalg.norm(_beam(readings, station), axis=1))),
            joint_std_rad=None if scatter is None else SCATTER_RAD * scatter,
        )


def _components(readings: Readings, cell: Cell) -> _Components | None:
    if len(np.unique(readings.pose)) < FEWEST_POSES or readings.scalar.any():
        return None
    mode, share = usual_mode(readings), MOST_ROWS / readings.value.size
    readings = readings[some_poses(readings, share, SEED, FEWEST_POSES)]
    try:
        return _estimated(baseline(cell, readings, mode), readings, cell.configured())
    except (HilcalError, np.linalg.LinAlgError):  # the fit says why
        return None


def _estimated(model: Model, readings: Readings, config: CellConfig) -> _Components | None:
    """Return the components; None where the readings show effects in addition to the largest."""
    mode, station = usual_mode(readings), config.tracker.station_m
    joint_std = config.repeatability.per_joint(model.cell.arm.n)
    full = with_all_effects(model, readings.states, HARMONICS)
    used = ~fit(model, readings, mode).outlier
    for _ in range(MOST_ROUNDS):
        inliers = readings[used]
        if joint_std.any():
            stated = with_joint_scatter(model.cell, inliers, joint_std)
            extra = stated.covariance - inliers.covariance
            arm = NoisePart(ARM_AS_STATED, extra, LogStdPrior(0.0, KNOWN_SPREAD), stated.common)
        else:
            arm = scatter_part(model, inliers)
        parts = [*_instrument(inliers, station), arm]
        variances, theta = variances_with_noise(full, inliers, mode, parts[:-1], arm)
        if _shows_several(variances):
            return None
        std, names = np.exp(variances.log_std), [p.name for p in parts]
        errors = np.sqrt(np.diagonal(variances.covariance)[-len(parts) :])
        factors = dict(zip(names, std[-len(parts) :].tolist(), strict=True))
        random = np.full(full.size, np.inf)
        for f, s in zip(variances.equations.problem.families.random, std, strict=False):
            random[f.parameters] = s * f.magnitude
        effects = zip(full.effects, full.slices(), strict=True)
        by_effect = {e.name: random[rows] for e, rows in effects if e.role not in FRAME_ROLES}
        noisy = _with_factors(readings, station, factors, model)
        if joint_std.any():
            noisy = with_joint_scatter(model.cell, noisy, joint_std)
        retained = ~fit(replace(full, random=by_effect), noisy, mode, start=theta).outlier
        if np.array_equal(retained, used):
            break
        used = retained
    return _Components(model, factors, dict(zip(names, errors.tolist(), strict=True)))


def _shows_several(variances: Variances) -> bool:
    """Whether the readings show effects in addition to the one that moves them most."""
    e = variances.equations
    problem, moved = e.problem, e.rows[:, e.problem.flat :] * e.solution[e.problem.flat :]
    families = problem.families.random
    columns_of = {f.effect: np.isin(problem.family, [k for k, g in enumerate(families)
          if g.effect == f.effect]) for f in families}  # fmt: skip
    if len(columns_of) < 2:
        return False
    motion = {name: moved[:, rows].sum(axis=1) for name, rows in columns_of.items()}
    largest = max(motion, key=lambda name: float(np.sum(motion[name] ** 2)))
    smaller = [k for k, f in enumerate(families) if f.effect != largest]
    rng = np.random.default_rng(SEED)
    return evidence(problem, smaller, rng, variances.log_std).p_value < SEVERAL_LEVEL


def _with_factors(
    readings: Readings,
    station: Sequence[float] | None,
    factors: Mapping[str, float],
    model: Model | None = None,
) -> Readings:
    """Return readings with the default covariance, its components times factors squared."""
    parts = [*_instrument(readings, station)]
    if model is not None and SCATTER in factors:
        parts.append(scatter_part(model, readings))
    total = sum((factors[p.name] ** 2 * p.covariance for p in parts), np.zeros(()))
    return replace(readings, covariance=total)


def _instrument(readings: Readings, station: Sequence[float] | None) -> Iterator[NoisePart]:
    """Yield the instrument's covariance along the beam, across it, and of the rotations."""
    beam = _beam(readings, station)
    u = beam / np.linalg.norm(beam, axis=1)[:, None]
    line = u[:, :, None] * u[:, None, :]
    for name, projector in ((ALONG, line), (ACROSS, np.eye(3) - line)):
        part = np.zeros_like(readings.covariance)
        part[:, :3, :3] = projector @ readings.covariance[:, :3, :3] @ projector
        yield NoisePart(name, part, LogStdPrior(0.0, SPREAD))
    if readings.m == 6:
        part = np.zeros_like(readings.covariance)
        part[:, 3:, 3:] = readings.covariance[:, 3:, 3:]
        yield NoisePart(ORIENTATION, part, LogStdPrior(0.0, SPREAD))


def _beam(readings: Readings, station: Sequence[float] | None) -> Floats:
    origin = np.zeros(3) if station is None else np.asarray(station, dtype=float)
    return np.asarray(readings.value[:, :3] - origin)
