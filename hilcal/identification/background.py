"""Random effects of a model: its background, and the lines of shrunk effects.

Every arm has every effect, most of them too small to name. A model with a background has all
effects of its catalogue that the readings allow, random with a mean of zero and the standard
deviations that the mixed model estimates (see `hilcal.mixed`). Those that people see as the model
are named; the others are its background. The prediction is that of all of them.

Where no background is needed, effects of many small parameters, as the lines of a gear, are random
all the same, see `with_pooled_lines`.
"""

from collections.abc import Collection
from dataclasses import asdict, dataclass, replace

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import CannotAnswerError
from hilcal.identification.arm_scatter import with_arm_scatter
from hilcal.identification.fit import Fit, fit
from hilcal.identification.full_covariance import joint_factors
from hilcal.identification.mixed_fit import (
    INSTRUMENT,
    SCATTER,
    SCATTER_RAD,
    MixedFit,
    mixed_fit,
    mixed_fit_at,
    mixed_fit_of,
)
from hilcal.model.model import Model
from hilcal.readings.readings import ArmScatter
from hilcal.types import Floats

MOST_ROWS = 1500
"""Elements of readings up to which a background is fitted: with more, effects are named one by one
until nothing is left, and the equations cost the cube of the columns. A choice."""
MOST_ROWS_OF_LINES = 2000
"""The same up to which lines are pooled; a choice, some seconds."""
UNSURE = 2.0
"""Factor to which few readings tell a standard deviation: it may be so much more than plausible; a
choice."""

WIDTH = 1.96
"""Standard errors of log s that a 95 % interval reaches on either side."""


@dataclass(frozen=True, slots=True)
class BackgroundPart:
    """The parameters of one effect of a background that have one unit.

    Attributes:
        effect: its name.
        std: root of the mean square of their standard deviations, SI.
        unit: SI unit.
        rms_m: root of the mean square of what they move the measured positions by, m.
    """

    effect: str
    std: float
    unit: str
    rms_m: float


@dataclass(frozen=True, slots=True)
class Background:
    """What a background moves; effects that the readings do not tell apart can cancel in it."""

    rms_m: float  # of all its effects together, m
    parts: tuple[BackgroundPart, ...]  # of each, what moves most first

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its effects."""
        return tuple(dict.fromkeys(p.effect for p in self.parts))

    def to_json(self) -> dict[str, object]:
        """Return the key `background` of the contract."""
        return {"rms_m": self.rms_m, "effects": [asdict(p) for p in self.parts]}


def background_of(fit: Fit) -> Background:
    """Return what the background of a fit moves; nothing where its model has none."""
    model = fit.model
    if not model.background:
        return Background(0.0, ())
    jacobian = model.jacobian(fit.solution.prediction, fit.theta, 3)
    moves, parts = fit.whitening.raw(jacobian) * fit.theta, []
    inside = np.zeros(model.size, dtype=bool)
    for effect, mine in zip(model.effects, model.slices(), strict=True):
        if effect.name not in model.background:
            continue
        inside[mine] = True
        units, std = [p.unit for p in effect.parameters], model.random[effect.name]
        for unit in dict.fromkeys(units):
            own = np.array([u == unit for u in units])
            rms = float(np.sqrt(np.mean(std[own] ** 2)))
            parts.append(BackgroundPart(effect.name, rms, unit, _rms(moves[:, :, mine][:, :, own])))
    return Background(_rms(moves[:, :, inside]), tuple(sorted(parts, key=lambda p: -p.rms_m)))


def _rms(moves: Floats) -> float:
    """Root of the mean square of the displacements that columns (D, 3, q) add up to."""
    return float(np.sqrt(np.mean(np.sum(moves.sum(axis=2) ** 2, axis=1))))


@dataclass(frozen=True, slots=True)
class FamilySize:
    """The size of a family: the standard deviation of its parameters, SI."""

    name: str  # of the family
    effect: str  # of its effect
    named: bool  # whether the readings prove the effect
    std: float  # root of the mean square over the parameters
    low: float  # lower end of its 95 % interval
    high: float  # upper end
    ordinary: float  # the same of an ordinary arm
    unit: str
    moves_m: float  # rms of what its estimated parameters move the measured positions by, m

    def to_json(self) -> dict[str, object]:
        """Return the attributes by name, SI."""
        return asdict(self)


def family_sizes(fit: Fit) -> tuple[FamilySize, ...]:
    """Return the size of each family of a fit with a background; what moves most comes first.

    It is estimated with those of all others (see `mixed.variances`); the curvature of the log
    posterior gives its interval.
    """
    model = fit.model
    if not model.background:
        return ()
    kept = fit.readings[~fit.outlier].as_stated()
    found = mixed_fit_at(model, kept, fit.mode, fit.theta)
    problem, log_std = found.equations.problem, found.log_std
    error = np.sqrt(np.diag(found.covariance))
    jacobian = model.jacobian(fit.solution.prediction, fit.theta, 3)
    moves = fit.whitening.raw(jacobian) * fit.theta
    units = [p.unit for e in model.effects for p in e.parameters]
    roles = {e.name: e.role for e in model.effects}
    out = []
    for k, f in enumerate(problem.families.random):
        if roles[f.effect] in FRAME_ROLES:
            continue
        magnitude = float(np.sqrt(np.mean(f.magnitude**2)))
        low, middle, high = np.exp(log_std[k] + WIDTH * error[k] * np.array([-1.0, 0.0, 1.0]))
        out.append(
            FamilySize(
                name=f.name,
                effect=f.effect,
                named=f.effect not in model.background,
                std=float(middle) * magnitude,
                low=float(low) * magnitude,
                high=float(high) * magnitude,
                ordinary=float(np.exp(f.prior.mean)) * magnitude,
                unit=units[int(f.parameters[0])],
                moves_m=_rms(moves[:, :, f.parameters]),
            )
        )
    return tuple(sorted(out, key=lambda s: -s.moves_m))


def allows_background(of: Fit) -> bool:
    """Whether the readings are few enough for a background, and no other campaign is the prior.

    A prior of another campaign says of its own effects how large they are. A model that was made
    without readings cannot take effects by name.
    """
    return len(of.white) <= MOST_ROWS and _alone(of)


def _alone(of: Fit) -> bool:
    return of.model.prior is None and of.model.readings is not None


def with_background(of: Fit, named: Collection[str]) -> Fit | None:
    """Fit all effects of the catalogue; None where one of them would be implausibly large.

    Such an effect (`Effect.most`) stands in for one that the catalogue lacks, and may be so large
    that the arm has no equilibrium; those of the model, which were proved, may be as large as they
    are.

    The noise is as the mixed model estimates it: the arm's scatter is in the covariance, and a
    factor of the instrument's makes the standard deviations of the effects smaller by as much,
    which is the same fit. Readings that were set aside as gross errors stay so. The `named` effects
    are not of the background.
    """
    readings = of.readings.as_stated()
    try:
        found = mixed_fit(of.model, readings[~of.outlier], of.mode)
        if _implausible(found) - set(of.model.names):
            return None
        if not readings.scatter_stated:
            readings = with_arm_scatter(found.model.cell, readings, _scatter(found))
        return fit(background_model(found, named), readings, of.mode, start=found.theta)
    except CannotAnswerError:
        return None


def with_pooled_lines(of: Fit) -> Fit | None:
    """Fit shrunk effects anew, the size of each line near that of its pool.

    A fit chooses the variance of each line (`Effect.groups`), as a wave of one gear, of its few
    parameters alone: it drops true ones by chance, and keeps false ones. With what the lines of a
    pool (`Effect.pools`) share, see `mixed.families`, simulated transmission errors were predicted
    with 0.9 of the error at fresh poses. The noise is that of the fit.

    Returns:
        The fit; None where the model has no such effect, or the readings are too many.
    """
    model = of.model
    shrunk = {e.name for e in model.effects if e.groups() is not None} - set(model.random)
    if not shrunk or not _alone(of) or len(of.white) > MOST_ROWS_OF_LINES:
        return None
    # What the fit knows of the arm's scatter is in the covariance.
    kept = replace(of.readings[~of.outlier], scatter_stated=True)
    try:
        found = mixed_fit_of(model, kept, of.mode, set(model.names) - shrunk, shrunk)
        std = found.prior_std() / found.std(INSTRUMENT)
        parts = zip(model.effects, model.slices(), strict=True)
        random = {**model.random, **{e.name: std[own] for e, own in parts if e.name in shrunk}}
        return fit(replace(model, random=random), of.readings, of.mode, start=found.theta)
    except CannotAnswerError:
        return None


def _implausible(found: MixedFit) -> set[str]:
    """Names of the effects some of whose standard deviations are larger than is plausible."""
    std = found.prior_std()
    return {
        effect.name
        for effect, mine in zip(found.model.effects, found.model.slices(), strict=True)
        if effect.role not in FRAME_ROLES
        and np.any(std[mine] > UNSURE * effect.most() * effect.magnitudes)
    }


def _scatter(found: MixedFit) -> ArmScatter:
    """Return the arm's scatter of a mixed fit, in units of the instrument's noise."""
    noise = found.std(INSTRUMENT)
    k = found.problem.names.index(SCATTER)
    std, error = found.std(SCATTER) / noise * SCATTER_RAD, found.variances.covariance[k, k] ** 0.5
    moved = joint_factors(found.model.cell, found.readings, np.full(found.model.cell.arm.n, std))
    return ArmScatter(
        kind="joints",
        std=(float(std),),
        std_error=(float(std * error),),
        size_m=float(np.sqrt(np.mean(np.sum(moved[:, :3] ** 2, axis=(1, 2))))),
        log_evidence=0.0,
        instrument_factor=float(noise),
    )


def background_model(found: MixedFit, named: Collection[str]) -> Model:
    """Return the model of a mixed fit with the effects that are not named as its background."""
    std = found.prior_std() / found.std(INSTRUMENT)
    random = {
        effect.name: std[mine]
        for effect, mine in zip(found.model.effects, found.model.slices(), strict=True)
        if effect.role not in FRAME_ROLES
    }
    return replace(found.model, random=random, background=frozenset(random) - frozenset(named))
