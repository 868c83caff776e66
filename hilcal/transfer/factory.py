"""Test with a few readings whether an arm's geometry is still as its factory measured it.

All effects of the catalogue are fitted together, starting from the factory's kinematics, each with
its own variance (see `identification.mixed_fit`), so that sag under the arm's weight, backlash and
scatter do not count as changes. The test statistic T is twice the gain of the restricted log
likelihood by encoder offsets and link geometry; without these, all other variances are estimated
again. With f variances at zero, T is a mixture of χ² with 0 to f degrees of freedom; its p-value is
at most that of f (Self and Liang, J. Am. Stat. Assoc. 82 (1987) 605). A displacement of the whole
arm, such as an offset of the first joint, cannot be separated from an unknown pose of the tracker.
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
from hilcal.robot.arm import Arm, as_counted
from hilcal.robot.factory import FactoryKinematics, with_factory
from hilcal.shown import Shown
from hilcal.types import Bools

LEVEL = 1e-3
"""p-value below which the geometry counts as changed; a choice."""
LEAST = 8
"""Least number of readings, in view of the nine unknowns of the frames; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class FactoryCheck(Shown):
    """Result of the test."""

    changed: bool  # whether the geometry differs from the factory's
    p_value: float  # of the geometric change, under the hypothesis of none
    moved_m: float  # rms displacement of the target by the geometric change, m
    moved_std_m: float  # its standard deviation
    factory_m: float  # rms misfit of the positions with the factory's kinematics alone, m
    nominal_m: float  # the same with the maker's nominal kinematics
    noise_m: float  # rms of the stated noise of the readings, m
    readings: int


def check_factory(
    cell: Cell,
    nominal: Arm,
    factory: FactoryKinematics,
    readings: Readings,
    catalogue: Catalogue | None = None,
) -> FactoryCheck:
    """Test readings of a few poses against the kinematics that the factory measured.

    `nominal` is the maker's design, with joints in the maker's convention, not the cell's.

    Raises:
        CannotAnswerError: too few readings, or readings that do not determine the frames.
    """
    if len(readings) < LEAST:
        raise CannotAnswerError(f"{len(readings)} readings; {LEAST} or more can answer")
    robot = cell.configured().robot
    factory_cell = replace(cell, arm=as_counted(with_factory(nominal, factory), robot))
    nominal_cell = replace(cell, arm=as_counted(nominal, robot))
    fit = mixed_fit(baseline(factory_cell, readings, "absolute", catalogue), readings, "absolute")
    problem = fit.problem
    effects = fit.model.catalogue
    kinematic = [k for k, f in enumerate(problem.families.random) if effects[f.effect].kinematic]
    without = estimate_variances(
        problem.without(kinematic), np.delete(fit.variances.log_std, kinematic), search=True
    )
    gain = fit.variances.equations.log_likelihood - without.equations.log_likelihood
    p = float(chi2.sf(max(2.0 * gain, 0.0), len(kinematic)))
    moved, std = _displacement(fit, readings, np.isin(problem.family, kinematic))
    covariance = readings.covariance[:, :3, :3]
    return FactoryCheck(
        changed=p < LEVEL,
        p_value=p,
        moved_m=moved,
        moved_std_m=std,
        factory_m=register(factory_cell, readings).rms,
        nominal_m=register(nominal_cell, readings).rms,
        noise_m=float(np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2)))),
        readings=len(readings),
    )


def _displacement(fit: MixedFit, readings: Readings, columns: Bools) -> tuple[float, float]:
    """Return rms displacement by some columns beyond the span of the frames, and its std, m."""
    prediction = fit.model.predict(readings.states, fit.theta)
    x = fit.problem.coordinates(fit.model.jacobian(prediction, fit.theta, 3))
    rows = x.reshape(-1, x.shape[-1])
    frames, selected = rows[:, : fit.problem.flat], rows[:, fit.problem.flat :][:, columns]
    selected = selected - frames @ np.linalg.lstsq(frames, selected, rcond=None)[0]
    indices = fit.problem.flat + np.flatnonzero(columns)
    displacement = selected @ fit.variances.equations.coordinates[indices]
    spread = np.einsum("rk,kl,rl->r", selected, fit.covariance[np.ix_(indices, indices)], selected)
    n = len(readings)
    return float(np.sqrt(displacement @ displacement / n)), float(np.sqrt(spread.sum() / n))
