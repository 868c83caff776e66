"""Campaigns with noise correlated along their order: intervals, verdicts, named effects."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers.simulated.rehearsal import simulate
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.prediction.predictive import predictive
from hilcal.identification.residual import residual
from hilcal.model.model import Model
from hilcal.readings.covariance import symmetric_root
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, whitening
from hilcal.refinement import Refinement, refine, refine_from
from studies.random_campaigns import rehearsal_states
from studies.study_cases import StudyCase, study_case, with_study_loads

NORMAL_95 = 1.959963985
STRENGTH = 2.0
"""Strength of a hidden effect, σ."""
FRESH = 20
"""Number of predicted poses, each with all loads."""


@dataclass(frozen=True, slots=True)
class SerialNoiseOutcome:
    """Result of a refinement.

    Attributes:
        verdict: of the refined model.
        added: effects that were added.
        parameters: number of true joint compliances within the stated intervals, and of all.
        predictions: the same for coordinates at fresh states.
    """

    verdict: str
    added: tuple[str, ...]
    parameters: tuple[int, int]
    predictions: tuple[int, int]


@dataclass(frozen=True, slots=True)
class SerialCase:
    """One campaign.

    Attributes:
        seed: of the campaign.
        rho: correlation of consecutive readings.
        hidden: hidden effect; empty for none.
        before: result with noise assumed white.
        after: result with serial noise.
        found: estimate of ρ; None for white noise.
        proved: whether the correlation is proved.
    """

    seed: int
    rho: float
    hidden: str
    before: SerialNoiseOutcome
    after: SerialNoiseOutcome
    found: float | None
    proved: bool


def serial_readings(case: StudyCase, rho: float, rng: np.random.Generator) -> Readings:
    """Return the readings of a campaign with their noise replaced by AR(1) noise."""
    r = case.readings
    z = rng.standard_normal((len(r), r.m))
    for k in range(1, len(z)):
        z[k] = rho * z[k - 1] + np.sqrt(1.0 - rho**2) * z[k]
    noise = np.einsum("nij,nj->ni", symmetric_root(r.covariance), z)
    return replace(r, value=r.value - case.noise + noise)


def serial_case(
    asked: tuple[int, float, str], *, config: CellConfig, robot: str, poses: int
) -> SerialCase:
    """Measure a campaign with serial noise, and fit and refine it.

    With a hidden drift readings are absolute and have times. Otherwise readings are absolute where
    half of the seed, rounded down, is even, else deflections; those of odd seeds have no times.

    Args:
        asked: seed of everything random, ρ, and the hidden effect or "".
        config: the cell; robot and loads are replaced.
        robot: name of the arm.
        poses: number of poses, each unloaded and under five loads; doubled with a hidden drift.
    """
    seed, rho, hidden = asked
    mode: Mode = "deflection" if seed // 2 % 2 and not hidden else "absolute"
    names = (hidden,) if hidden else ()
    case = study_case(
        config, robot, mode, names, STRENGTH, seed, n_poses=poses * (2 if hidden else 1)
    )
    rng = np.random.default_rng([seed, 20261124])
    readings = serial_readings(case, rho, rng)
    if seed % 2 and not hidden:
        readings = replace(readings, states=replace(readings.states, time=None))
    start = baseline(case.cell, readings, mode)
    white = refine_from(fit(start, readings, mode))
    refined = refine(start, readings, mode)
    serial = refined.fit.readings.serial
    _, loads = with_study_loads(config, robot)
    states, pose, load, cycle = rehearsal_states(case.cell, FRESH, loads, rng)
    if readings.states.time is None:
        states = replace(states, time=None)
    fresh = simulate(case.world, states, pose, load, cycle, readings.load_names, rng)
    clean = replace(fresh, value=case.world.ideal_readings(states).position)
    return SerialCase(
        seed=seed,
        rho=rho,
        hidden=hidden,
        before=_outcome(white, start, case, clean),
        after=_outcome(refined, start, case, clean),
        found=None if serial is None else serial.rho,
        proved=serial is not None and serial.proved,
    )


def _outcome(
    refined: Refinement, start: Model, case: StudyCase, clean: Readings
) -> SerialNoiseOutcome:
    return SerialNoiseOutcome(
        refined.verdict,
        tuple(n for n in refined.fit.model.names if n not in start.names),
        _parameters(refined.fit, case),
        _predicted(refined.fit, clean),
    )


def _parameters(fitted: Fit, case: StudyCase) -> tuple[int, int]:
    true = case.world.physics.joint_compliance
    inside = count = 0
    for p in fitted.parameters:
        if p.name.startswith("joint_compliance.j") and p.value is not None and p.std is not None:
            inside += bool(abs(p.value - true[int(p.name[-1]) - 1]) <= NORMAL_95 * p.std)
            count += 1
    return inside, count


def _predicted(f: Fit, clean: Readings) -> tuple[int, int]:
    """Count coordinates of measured quantities at fresh states within their intervals."""
    inliers = f.readings[~f.outlier]
    p = predictive(f.model, f.theta, f.solution.prior, inliers, f.mode, f.holdout.rms_sigma)
    w = whitening(clean, f.mode)
    prediction = f.model.predict(clean.states, f.theta)
    error = residual(clean, prediction, w)
    std = np.sqrt(np.diagonal(p.prediction_covariance(prediction, w), axis1=1, axis2=2))
    return int(np.sum(np.abs(error) <= NORMAL_95 * std)), error.size
