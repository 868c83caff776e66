"""Random effects of a model: its background, and shrunk effects.

Every arm has every effect; most effects are too small to be proved. A model with a background has
all effects of its catalogue that the readings allow, as random effects of zero mean with the
standard deviations that the mixed model estimates (see `hilcal.mixed`). Reports show the named
effects as the model; the others are its background. All of them predict.

Without a background, the effects that a refinement adds are random, too: see
`with_shrunk_effects`.
"""

from collections.abc import Collection
from dataclasses import asdict, dataclass, replace

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import CannotAnswerError
from hilcal.identification.fit import Fit, fit
from hilcal.identification.mixed_fit import (
    INSTRUMENT,
    MOST_NOISE_ROWS,
    SCATTER,
    SCATTER_RAD,
    SEED,
    MixedFit,
    mixed_fit_at,
    mixed_fit_of,
    with_all_effects,
)
from hilcal.identification.noise.arm_scatter import some_poses, with_arm_scatter
from hilcal.identification.noise.full_covariance import joint_factors
from hilcal.identification.outliers.gross_errors import confirmed_gross_errors, find_gross_errors
from hilcal.mixed.families import IMPLAUSIBLE_FACTOR
from hilcal.model.model import Model
from hilcal.readings.readings import ArmScatter
from hilcal.types import Floats

MOST_ROWS = 10_000
"""Most elements of readings for which a background is fitted; a choice: it takes minutes."""
MOST_ROWS_OF_LINES = 2000
"""Most elements of readings for which effects with lines are shrunk; a choice: it takes some
seconds, and more readings determine each parameter (all of the UR10's series B: 65.5 for 65.6 µm,
75 s of a processor)."""
MOST_CONFIRMATIONS = 3
"""Most rounds in which gross errors of fewer effects are tested beside all effects; a choice."""

HALF_WIDTH_95 = 1.96
"""Half width of a 95 % interval, in standard errors of log s."""


@dataclass(frozen=True, slots=True)
class BackgroundPart:
    """The parameters of one effect of a background that have the same unit.

    Attributes:
        effect: name of the effect.
        std: rms of the parameters' standard deviations, SI.
        unit: SI unit.
        rms_m: rms displacement of the measured positions by the parameters, m.
    """

    effect: str
    std: float
    unit: str
    rms_m: float


@dataclass(frozen=True, slots=True)
class Background:
    """Displacement by a background; inseparable effects can cancel in the sum."""

    rms_m: float  # of all its effects together, m
    parts: tuple[BackgroundPart, ...]  # largest displacement first

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(dict.fromkeys(p.effect for p in self.parts))

    def to_json(self) -> dict[str, object]:
        """Return the key `background` of the contract."""
        return {"rms_m": self.rms_m, "effects": [asdict(p) for p in self.parts]}


def background_of(fit: Fit) -> Background:
    """Return the displacement by the background of a fit; zero where its model has none."""
    model = fit.model
    if not model.background:
        return Background(0.0, ())
    jacobian = model.jacobian(fit.solution.prediction, fit.theta, 3)
    moves, parts = fit.whitening.raw(jacobian) * fit.theta, []
    inside = np.zeros(model.size, dtype=bool)
    for effect, columns in zip(model.effects, model.slices(), strict=True):
        if effect.name not in model.background:
            continue
        inside[columns] = True
        units, std = [p.unit for p in effect.parameters], model.random[effect.name]
        for unit in dict.fromkeys(units):
            of_unit = np.array([u == unit for u in units])
            rms = float(np.sqrt(np.mean(std[of_unit] ** 2)))
            moved = _rms(moves[:, :, columns][:, :, of_unit])
            parts.append(BackgroundPart(effect.name, rms, unit, moved))
    return Background(_rms(moves[:, :, inside]), tuple(sorted(parts, key=lambda p: -p.rms_m)))


def _rms(moves: Floats) -> float:
    """Return the rms of the sum of the displacements (D, 3, q) over the columns."""
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
    ordinary: float  # std of an ordinary arm
    unit: str
    moves_m: float  # rms displacement of the measured positions by its estimated parameters, m

    def to_json(self) -> dict[str, object]:
        """Return the attributes by name, SI."""
        return asdict(self)


def family_sizes(fit: Fit) -> tuple[FamilySize, ...]:
    """Return the size of each family of a fit with a background, largest displacement first.

    The sizes of all families are estimated together (see `mixed.variances`); the curvature of the
    log posterior gives the intervals.
    """
    model = fit.model
    if not model.background:
        return ()
    variances = mixed_fit_at(model, fit.readings[~fit.outlier], fit.mode, fit.theta)
    problem, log_std = variances.equations.problem, variances.log_std
    error = np.sqrt(np.diag(variances.covariance))
    jacobian = model.jacobian(fit.solution.prediction, fit.theta, 3)
    moves = fit.whitening.raw(jacobian) * fit.theta
    units = [p.unit for e in model.effects for p in e.parameters]
    roles = {e.name: e.role for e in model.effects}
    out = []
    for k, f in enumerate(problem.families.random):
        if roles[f.effect] in FRAME_ROLES:
            continue
        magnitude = float(np.sqrt(np.mean(f.magnitude**2)))
        low, middle, high = np.exp(
            log_std[k] + HALF_WIDTH_95 * error[k] * np.array([-1.0, 0.0, 1.0])
        )
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


def allows_background(fitted: Fit) -> bool:
    """Whether a background can be fitted.

    The readings must be few enough. A model with the prior of another campaign has none, as the
    prior states the sizes of its effects; nor has a model without readings, as no effect can be
    added to it by name.
    """
    model = fitted.model
    return len(fitted.white) <= MOST_ROWS and model.prior is None and model.readings is not None


def with_background(
    fitted: Fit, named: Collection[str], without: Collection[str] = ()
) -> Fit | None:
    """Fit all effects of the catalogue except `without`; None where they cannot be fitted.

    An added effect that becomes implausibly large (see `Effect.most`) stands in for one that the
    catalogue lacks, or cancels another one. The largest of them is left out, as a size that no arm
    has predicts nothing, and the others are fitted again. The effects of the model are proved:
    their size is not limited.

    The noise is that of the mixed model. The arm's scatter is added to the covariance. Instead of
    multiplying the instrument's noise by its estimated factor, the standard deviations of the
    effects are divided by this factor, which gives the same fit. Gross errors are sought beside all
    effects (`identification.outliers.gross_errors`): some show only there, others are none. The
    `named` effects do not belong to the background.

    With more than `MOST_NOISE_ROWS` elements of readings, the ratio of the arm's scatter to the
    instrument's noise is estimated from poses chosen at random; all readings then determine the
    effects and the size of the noise.
    """
    readings = fitted.readings.as_stated()
    states = readings[~fitted.outlier].states
    model = with_all_effects(fitted.model, states, without=without)
    outlier, sample = fitted.outlier.copy(), readings[~fitted.outlier]
    # A run of equal shifts is not set aside reading by reading.
    disagreement = fitted.disagreement
    alike = disagreement is not None and disagreement.kind == "alike"
    search = readings.value.size <= MOST_NOISE_ROWS and not alike
    sample = sample[some_poses(sample, MOST_NOISE_ROWS / sample.value.size, SEED)]
    try:
        mixed = mixed_fit_of(model, sample, fitted.mode)
        for _ in range(MOST_CONFIRMATIONS if search else 0):
            confirmed = confirmed_gross_errors(mixed, readings, outlier, fitted.mode)
            if np.array_equal(confirmed, outlier):
                break
            outlier, sample = confirmed, readings[~confirmed]
            mixed = mixed_fit_of(model, sample, fitted.mode)
        if search and (gross := find_gross_errors(mixed, fitted.mode)).any():
            outlier[np.flatnonzero(~outlier)[gross]] = True
            sample = readings[~outlier]
            mixed = mixed_fit_of(model, sample, fitted.mode)
        if not readings.scatter_stated:
            readings = with_arm_scatter(model.cell, readings, _scatter(mixed))
        inliers, added = readings[~outlier], set(model.names) - set(fitted.model.names)
        implausible = _implausible(mixed, added)
        if implausible is None and len(sample) < len(inliers):
            inliers = replace(inliers, scatter_stated=True)
            mixed = mixed_fit_of(model, inliers, fitted.mode, start=mixed)
            implausible = _implausible(mixed, added)
        if implausible is not None:
            return with_background(fitted, named, (*without, implausible))
        return fit(
            background_model(mixed, named), readings, fitted.mode, start=mixed.theta,
            outlier=outlier if search else None,
        )  # fmt: skip
    except CannotAnswerError:
        return None


def with_shrunk_effects(fitted: Fit, flat: Collection[str]) -> Fit | None:
    """Fit the effects anew, except the `flat` ones, with parameters shrunk to estimated sizes.

    Flat parameters grow in directions that the poses hardly show, and predict other poses badly:
    the size of an effect, which all its parameters show, limits them. An ordinary fit of an effect
    of many lines, as the waves of one gear (`Effect.groups`), chooses the variance of each from
    its few parameters alone, so that it drops real lines and retains false ones by chance. With a
    prior size common to the lines of a pool (`Effect.pools`, see `mixed.families`) the error of
    simulated transmission errors at fresh poses fell to 0.9. The noise is that of the fit. Flat
    effects start at zero: a direction that the readings do not show stays where it starts, and the
    mixed model, which knows no ordinary size of a flat effect, can leave it at any value.

    Returns:
        The fit; None where all effects are flat, or the readings are too many.
    """
    model = fitted.model
    roles = {e.name: e.role for e in model.effects}
    shrunk = {n for n in set(model.names) - set(flat) if roles[n] not in FRAME_ROLES}
    lines = {e.name for e in model.effects if e.groups() is not None}
    shrunk = (shrunk | lines) - set(model.random)
    many = bool(lines) and len(fitted.white) > MOST_ROWS_OF_LINES
    if not shrunk or many or not allows_background(fitted):
        return None
    # The covariance contains the arm's scatter as the fit has it.
    inliers = replace(fitted.readings[~fitted.outlier], scatter_stated=True)
    try:
        mixed = mixed_fit_of(model, inliers, fitted.mode, set(model.names) - shrunk, lines & shrunk)
        std = mixed.prior_std() / mixed.std(INSTRUMENT)
        parts = zip(model.effects, model.slices(), strict=True)
        random, start = dict(model.random), fitted.theta.copy()
        for e, rows in parts:
            if e.name in shrunk:
                random[e.name], start[rows] = std[rows], mixed.theta[rows]
            elif roles[e.name] not in FRAME_ROLES:
                start[rows] = 0.0
        return fit(replace(model, random=random), fitted.readings, fitted.mode, start=start)
    except CannotAnswerError:
        return None


def _implausible(mixed: MixedFit, effects: Collection[str]) -> str | None:
    """Return the effect that exceeds its plausible size most; None where none does."""
    std = mixed.prior_std()
    share = {
        effect.name: float(np.max(std[rows] / (effect.most() * effect.magnitudes)))
        for effect, rows in zip(mixed.model.effects, mixed.model.slices(), strict=True)
        if effect.name in effects
    }
    largest = max(share, key=share.__getitem__, default=None)
    return largest if largest and share[largest] > IMPLAUSIBLE_FACTOR else None


def _scatter(mixed: MixedFit) -> ArmScatter:
    """Return the arm's scatter of a mixed fit."""
    noise = mixed.std(INSTRUMENT)
    k = mixed.problem.names.index(SCATTER)
    std, error = mixed.std(SCATTER) * SCATTER_RAD, mixed.variances.covariance[k, k] ** 0.5
    moved = joint_factors(mixed.model.cell, mixed.readings, np.full(mixed.model.cell.arm.n, std))
    return ArmScatter(
        kind="joints",
        std=(float(std),),
        std_error=(float(std * error),),
        size_m=float(np.sqrt(np.mean(np.sum(moved[:, :3] ** 2, axis=(1, 2))))),
        log_evidence=0.0,
        instrument_factor=float(noise),
        unit=float(noise),
    )


def background_model(mixed: MixedFit, named: Collection[str]) -> Model:
    """Return the model of a mixed fit, whose background are all effects except the named ones."""
    std = mixed.prior_std() / mixed.std(INSTRUMENT)
    random = {
        effect.name: std[rows]
        for effect, rows in zip(mixed.model.effects, mixed.model.slices(), strict=True)
        if effect.role not in FRAME_ROLES
    }
    return replace(mixed.model, random=random, background=frozenset(random) - frozenset(named))
