"""The noise of readings for which nobody states it, estimated from the readings themselves.

The noise that [tracker] has by default is that of a laser tracker. Where neither a table nor the
cell states another one, the standard deviations along and across the beam, and those of
orientations, are the default's times factors that the readings tell; so is the arm's scatter, one
σ for all joints, where [repeatability] does not state it:

    V = f_a² V_along + f_c² V_across + f_o² V_orientation + σ_q² R J Jᵀ Rᵀ

They are variance components, estimated by restricted maximum likelihood together with the frames
and with every effect of the catalogue as random effects (see `hilcal.mixed`), so that no effect
counts as noise, nor noise as an effect. Gross errors are left out.

Where the readings show several effects at once, as those of most real arms do, few of them tell
noise from effects: the default stays then, and a fit of all effects estimates the noise with them
(see `identification.background`).
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import HilcalError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.full_covariance import with_joint_scatter
from hilcal.identification.mixed_fit import (
    SCATTER,
    SCATTER_RAD,
    Part,
    scatter_part,
    variances_with_noise,
    with_all_effects,
)
from hilcal.mixed.evidence import evidence
from hilcal.mixed.families import KNOWN, LogStdPrior
from hilcal.mixed.variances import Variances
from hilcal.model.model import Model
from hilcal.readings.covariance import INSTRUMENT, WHOLE
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import usual_mode
from hilcal.tables.table import FROM_TRACKER, ImportResult
from hilcal.types import Floats

SPREAD = 3.0
"""Of the log of a factor: 20 either way; a choice. The default is a laser tracker's, and cameras
see by a hundred times less."""
HARMONICS = 6
"""Waves of a gear that take part; finer ones act as the arm's scatter. A choice, for speed."""
MOST_ROWS = 900
"""Elements of readings that are used, of poses chosen at random; a choice: of so many, a standard
deviation is known to some per cent."""
FEWEST_POSES = 10
"""Poses below which frames and effects leave nothing to estimate a noise from; a choice."""
ROUNDS = 3
"""Most estimates, each after a new test for gross errors; a choice."""
SEVERAL = 0.05
"""Chance of finding several effects where there is one at most; a choice."""
SEED = 20251125
"""Of the poses that are chosen, and of simulated likelihood ratios."""
NOISE = "noise"
"""Key among the texts about a campaign: the estimate, as JSON; absent where the noise is stated."""
ALONG, ACROSS, ORIENTATION, STATED = "along", "across", "orientation", "arm as stated"


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """The noise of readings, as they tell it.

    Attributes:
        along_m: standard deviation along the beam, m; as the next two the median of the readings.
        across_m: along each axis across it, m.
        orientation_rad: of a rotation about any axis; None where positions were read.
        distance_m: length of the beam.
        joint_std_rad: the arm's scatter, of each joint; None where the cell states it.
    """

    along_m: float
    across_m: float
    orientation_rad: float | None
    distance_m: float
    joint_std_rad: float | None

    def to_json(self) -> str:
        """Return it as a text of a campaign."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str | None) -> "NoiseEstimate | None":
        """Return what `to_json` wrote; None where there is none."""
        return None if text is None else cls(**json.loads(text))


def with_estimated_noise(
    found: ImportResult, cell: Cell, config: CellConfig
) -> tuple[ImportResult, NoiseEstimate | None]:
    """Return an import with the noise that its readings tell, where nobody states it.

    The covariance of readings of one target includes the arm's scatter then. Several targets share
    it in one arrival, so that `diagnose` estimates it.

    Args:
        found: what was imported.
        cell: the cell.
        config: its configuration.

    Returns:
        The import, and the estimate: None where the noise is stated, where the readings are fewer
        than `FEWEST_POSES` or show several effects, or where nothing can be fitted to them as they
        are described.
    """
    readings, station = found.readings, config.tracker.station_m
    if found.noise_stated or len(np.unique(readings.pose)) < FEWEST_POSES:
        return found, None
    stated = config.repeatability.per_joint(cell.arm.n)
    try:
        model = baseline(cell, _some(readings), usual_mode(readings))
        factors = _factors(model, _some(readings), station, stated)
    except HilcalError:  # what cannot be fitted is said where it is fitted
        return found, None
    if factors is None:
        return found, None
    size = {
        p.name: factors[p.name]
        * float(np.sqrt(np.median(np.trace(p.covariance, axis1=1, axis2=2))))
        for p in _instrument(readings, station)
    }
    estimate = NoiseEstimate(
        along_m=size[ALONG],
        across_m=size[ACROSS] / float(np.sqrt(2.0)),
        orientation_rad=size[ORIENTATION] / float(np.sqrt(3.0)) if ORIENTATION in size else None,
        distance_m=float(np.median(np.linalg.norm(_beam(readings, station), axis=1))),
        joint_std_rad=SCATTER_RAD * factors[SCATTER] if SCATTER in factors else None,
    )
    together = SCATTER in factors and readings.states.target is None
    if not together:
        factors.pop(SCATTER, None)
    whole = _with(readings, station, model, factors)
    covers = WHOLE if together else INSTRUMENT
    notes = tuple(n for n in found.notes if not n.startswith(FROM_TRACKER))
    return replace(found, readings=whole, covers=covers, notes=notes), estimate


def _some(readings: Readings) -> Readings:
    """All readings, or those of poses chosen at random for `MOST_ROWS`."""
    if readings.value.size <= MOST_ROWS:
        return readings
    poses = np.unique(readings.pose)
    count = max(int(MOST_ROWS / readings.value.size * len(poses)), FEWEST_POSES)
    chosen = np.random.default_rng(SEED).choice(poses, count, replace=False)
    return readings[np.isin(readings.pose, chosen)]


def _factors(
    model: Model, readings: Readings, station: Sequence[float] | None, joint_std: Floats
) -> dict[str, float] | None:
    """Standard deviations of the components, in those of the default and of `SCATTER_RAD`.

    None where the readings show effects beside the largest.
    """
    mode = usual_mode(readings)
    whole = with_all_effects(model, readings.states, HARMONICS)
    used = ~fit(model, readings, mode).outlier
    for _ in range(ROUNDS):
        kept = readings[used]
        instrument = [*_instrument(kept, station)]
        if joint_std.any():
            known = with_joint_scatter(model.cell, kept, joint_std)
            more = known.covariance - kept.covariance
            arm = Part(STATED, more, LogStdPrior(0.0, KNOWN), known.common)
        else:
            arm = scatter_part(model, kept)
        found, theta = variances_with_noise(whole, kept, mode, instrument, arm)
        if _shows_several(found):
            return None
        std = np.exp(found.log_std[-len(instrument) - 1 :])
        names = (*(p.name for p in instrument), arm.name)
        factors = dict(zip(names, std.tolist(), strict=True))
        scale = np.exp(found.log_std)
        random = np.full(whole.size, np.inf)
        for f, s in zip(found.equations.problem.families.random, scale, strict=False):
            random[f.parameters] = s * f.magnitude
        of = replace(whole, random=_by_effect(whole, random))
        noisy = _with(readings, station, model, factors)
        if joint_std.any():
            noisy = with_joint_scatter(model.cell, noisy, joint_std)
        now = ~fit(of, noisy, mode, start=theta).outlier
        if np.array_equal(now, used):
            break
        used = now
    return factors


def _shows_several(found: Variances) -> bool:
    """Whether the readings show effects beside the one that moves them most."""
    e = found.equations
    problem, moved = e.problem, e.rows[:, e.problem.flat :] * e.c[e.problem.flat :]
    families = problem.families.random
    of = {f.effect: np.isin(problem.family, [k for k, g in enumerate(families)
          if g.effect == f.effect]) for f in families}  # fmt: skip
    if len(of) < 2:
        return False
    largest = max(of, key=lambda name: float(np.sum(moved[:, of[name]].sum(axis=1) ** 2)))
    others = [k for k, f in enumerate(families) if f.effect != largest]
    rng = np.random.default_rng(SEED)
    return evidence(problem, others, rng, found.log_std).p_value < SEVERAL


def _by_effect(model: Model, std: Floats) -> dict[str, Floats]:
    """Standard deviations (P,) of the parameters by effect, without the frames."""
    pairs = zip(model.effects, model.slices(), strict=True)
    return {e.name: std[mine] for e, mine in pairs if e.role not in FRAME_ROLES}


def _with(
    readings: Readings, station: Sequence[float] | None, model: Model, factors: Mapping[str, float]
) -> Readings:
    """Return readings with the covariance that factors make of the default's."""
    parts = [*_instrument(readings, station)]
    if SCATTER in factors:
        parts.append(scatter_part(model, readings))
    total = sum((factors[p.name] ** 2 * p.covariance for p in parts), np.zeros(()))
    return replace(readings, covariance=total)


def _instrument(readings: Readings, station: Sequence[float] | None) -> Iterator[Part]:
    """Yield the instrument's covariance along the beam, across it, and of the rotations."""
    beam = _beam(readings, station)
    u = beam / np.linalg.norm(beam, axis=1)[:, None]
    line = u[:, :, None] * u[:, None, :]
    for name, of in ((ALONG, line), (ACROSS, np.eye(3) - line)):
        part = np.zeros_like(readings.covariance)
        part[:, :3, :3] = of @ readings.covariance[:, :3, :3] @ of
        yield Part(name, part, LogStdPrior(0.0, SPREAD))
    if readings.m == 6:
        part = np.zeros_like(readings.covariance)
        part[:, 3:, 3:] = readings.covariance[:, 3:, 3:]
        yield Part(ORIENTATION, part, LogStdPrior(0.0, SPREAD))


def _beam(readings: Readings, station: Sequence[float] | None) -> Floats:
    origin = np.zeros(3) if station is None else np.asarray(station, dtype=float)
    return np.asarray(readings.value[:, :3] - origin)
