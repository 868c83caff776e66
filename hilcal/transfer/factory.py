"""Is an arm still what its factory measured? The answer of a few readings.

All effects of the catalogue are fitted at once from the factory's kinematics, each of a variance of
its own (see `identification.mixed_fit`), so that what the arm does under its own weight, its
backlash and its scatter are no changes. With the factory's figures nothing geometric should be
left: T, twice the gain of the restricted log likelihood by the encoders' offsets and the links'
geometry, all other variances estimated anew without them, says whether there is. With f variances
at zero T is a mixture of χ² with 0 to f degrees of freedom; its p-value is at most that of f
(Self and Liang, J. Am. Stat. Assoc. 82 (1987) 605). What moves the whole arm, as an offset of the
first joint, is not told from an unknown place of the tracker.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline
from hilcal.identification.mixed_fit import MixedFit, mixed_fit
from hilcal.identification.registration import register
from hilcal.mixed.variances import estimate_variances
from hilcal.readings.readings import Readings
from hilcal.robot.arm import Arm
from hilcal.robot.conventions import as_counted
from hilcal.robot.factory import FactoryKinematics, with_factory
from hilcal.shown import Shown
from hilcal.types import Bools

LEVEL = 1e-3
"""p-value below which the geometry is called changed; a choice."""
LEAST = 8
"""Readings: with fewer there are not enough beside the nine numbers of unknown frames; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class FactoryCheck(Shown):
    """The answer."""

    changed: bool  # whether the geometry is another one than the factory measured
    p_value: float  # of what of it is left, where nothing has changed
    moved_m: float  # rms displacement of the target by what is left, as estimated, m
    moved_std_m: float  # its standard deviation
    factory_m: float  # rms misfit of the positions with the factory's kinematics alone, m
    nominal_m: float  # the same with the maker's nominal ones
    noise_m: float  # rms of the noise that is stated for the readings, m
    readings: int


def check_factory(
    cell: Cell,
    nominal: Arm,
    factory: FactoryKinematics,
    readings: Readings,
    catalogue: Catalogue | None = None,
) -> FactoryCheck:
    """Judge readings of a few poses by the kinematics that the factory measured.

    `nominal` is the arm as its maker designed it, its joints not yet counted as the cell says.
    Raises a CannotAnswerError for too few readings, or where they do not determine the frames.
    """
    if len(readings) < LEAST:
        raise CannotAnswerError(f"{len(readings)} readings; {LEAST} or more can answer")
    robot = cell.configured().robot
    ours = replace(cell, arm=as_counted(with_factory(nominal, factory), robot))
    theirs = replace(cell, arm=as_counted(nominal, robot))
    fit = mixed_fit(baseline(ours, readings, "absolute", catalogue), readings, "absolute")
    problem = fit.problem
    known = fit.model.catalogue
    numbers = [k for k, f in enumerate(problem.families.random) if known[f.effect].kinematic]
    without = estimate_variances(
        problem.without(numbers), np.delete(fit.variances.log_std, numbers), search=True
    )
    gain = fit.variances.equations.log_likelihood - without.equations.log_likelihood
    p = float(chi2.sf(max(2.0 * gain, 0.0), len(numbers)))
    moved, std = _displacement(fit, readings, np.isin(problem.family, numbers))
    covariance = readings.covariance[:, :3, :3]
    return FactoryCheck(
        changed=p < LEVEL,
        p_value=p,
        moved_m=moved,
        moved_std_m=std,
        factory_m=register(ours, readings).rms,
        nominal_m=register(theirs, readings).rms,
        noise_m=float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)))),
        readings=len(readings),
    )


def _displacement(fit: MixedFit, readings: Readings, own: Bools) -> tuple[float, float]:
    """Return rms displacement by some columns beyond what the frames take up, and its std, m."""
    prediction = fit.model.predict(readings.states, fit.theta)
    x = fit.problem.coordinates(fit.model.jacobian(prediction, fit.theta, 3))
    rows = x.reshape(-1, x.shape[-1])
    frames, mine = rows[:, : fit.problem.flat], rows[:, fit.problem.flat :][:, own]
    mine = mine - frames @ np.linalg.lstsq(frames, mine, rcond=None)[0]
    at = fit.problem.flat + np.flatnonzero(own)
    found = mine @ fit.variances.equations.coordinates[at]
    spread = np.einsum("rk,kl,rl->r", mine, fit.covariance[np.ix_(at, at)], mine)
    n = len(readings)
    return float(np.sqrt(found @ found / n)), float(np.sqrt(spread.sum() / n))
