"""Campaigns whose noise is correlated along their order: intervals, verdicts, effects named."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers.simulated.rehearsal import simulate
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.predictive import predictive
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
"""Of an effect that is hidden, σ."""
FRESH = 20
"""Poses, with all loads, that are predicted."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a refinement came to.

    Attributes:
        verdict: of the refined model.
        added: effects that were added.
        parameters: true joint compliances within the stated intervals, and how many there are.
        predictions: the same of coordinates of fresh states.
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
        hidden: effect that is hidden in it; empty for none.
        before: with noise that is taken for white.
        after: as it is.
        found: ρ as estimated; None for white noise.
        proved: whether it is.
    """

    seed: int
    rho: float
    hidden: str
    before: Outcome
    after: Outcome
    found: float | None
    proved: bool


def serial_readings(case: StudyCase, rho: float, rng: np.random.Generator) -> Readings:
    """Return the readings of a campaign with AR(1) noise of the stated covariance instead."""
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

    Absolute readings where the seed's half is even, or where a drift is hidden; else deflections.
    Odd seeds do not tell their times, but where a drift is hidden.

    Args:
        asked: seed of everything random, ρ, and an effect that is hidden, or "".
        config: the cell; robot and loads are replaced.
        robot: name of the arm.
        poses: how many, each without a load and under five; twice as many where a drift is hidden.
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
    found = refine(start, readings, mode)
    serial = found.fit.readings.serial
    _, loads = with_study_loads(config, robot)
    states, pose, load, cycle = rehearsal_states(case.cell, FRESH, loads, rng)
    if readings.states.time is None:
        states = replace(states, time=None)
    fresh = simulate(case.world, states, pose, load, cycle, readings.load_names, rng)
    clean = replace(fresh, value=case.world.sight(states).position)
    return SerialCase(
        seed=seed,
        rho=rho,
        hidden=hidden,
        before=_outcome(white, start, case, clean),
        after=_outcome(found, start, case, clean),
        found=None if serial is None else serial.rho,
        proved=serial is not None and serial.proved,
    )


def _outcome(of: Refinement, start: Model, case: StudyCase, clean: Readings) -> Outcome:
    return Outcome(
        of.verdict,
        tuple(n for n in of.fit.model.names if n not in start.names),
        _parameters(of.fit, case),
        _predicted(of.fit, clean),
    )


def _parameters(found: Fit, case: StudyCase) -> tuple[int, int]:
    true = case.world.physics.joint_compliance
    inside = count = 0
    for p in found.parameters:
        if p.name.startswith("joint_compliance.j") and p.value is not None and p.std is not None:
            inside += bool(abs(p.value - true[int(p.name[-1]) - 1]) <= NORMAL_95 * p.std)
            count += 1
    return inside, count


def _predicted(found: Fit, clean: Readings) -> tuple[int, int]:
    """Count coordinates of measured quantities at fresh states within their intervals."""
    kept = found.readings[~found.outlier]
    of = predictive(
        found.model, found.theta, found.solution.prior, kept, found.mode, found.holdout.rms_sigma
    )
    w = whitening(clean, found.mode)
    prediction = found.model.predict(clean.states, found.theta)
    away = residual(clean, prediction, w)
    std = np.sqrt(np.diagonal(of.of_prediction(prediction, w), axis1=1, axis2=2))
    return int(np.sum(np.abs(away) <= NORMAL_95 * std)), away.size
