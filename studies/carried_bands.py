"""Simulated arms that are measured twice in different joint ranges, the first time as prior.

A real arm is a single draw: its errors outside of the measured range have a few dozen degrees of
freedom, and so has the share of its poses within a stated band. Only many arms show whether bands
are right. Each arm has transmission errors, link and joint zero errors and joint compliance by the
mechanics of the simulated cell; every other arm has an effect that the model lacks. In campaign A
joint 2 is in one range, in campaign B in another one with hardly any overlap; tracker and target
are set up anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated.injected_effects import Draw, typical_torque, world_without_effect
from hilcal.drivers.simulated.rehearsal import measurement_noise
from hilcal.drivers.simulated.world import World, place_tracker
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried.carried_prior import carried_prior
from hilcal.identification.carried.posterior import Posterior
from hilcal.identification.fit import fit
from hilcal.identification.noise.arm_scatter import with_prior_scatter
from studies.change import GEOMETRY, measured
from studies.compensation_command import judged
from studies.study_cases import with_study_loads

POSES_A = 250
TESTED = 200
"""Number of poses of B that test a fit."""
JOINT = 1
"""Index of the joint with different ranges: joint 2, as in the IPA's series."""
RANGES = ((-2.25, 0.07), (-3.14, -1.92))
"""Ranges of A and of B, rad: of series B and C of the IPA UR10, which share a few degrees."""
LACKING = ("joint_tilt_compliance", "link_compliance")
"""Effects, one of which the model of every other arm lacks."""


@dataclass(frozen=True, slots=True)
class BandCase:
    """One fit of N poses with the prior.

    Attributes:
        seed: of the arm.
        lacking: effect that the model lacks; empty for none.
        poses: N.
        mean_m: mean 3-D error of the tested poses.
        inside: share of the tested poses in the stated 95 % band.
    """

    seed: int
    lacking: str
    poses: int
    mean_m: float
    inside: float


def band_cases(
    seed: int, *, config: CellConfig, robot: str, numbers: Sequence[int], first: int = POSES_A
) -> list[BandCase]:
    """Measure an arm twice, and fit N poses of the second campaign with the first as prior.

    Args:
        seed: of everything random.
        config: the cell; robot and loads are replaced.
        robot: name of the arm.
        numbers: N.
        first: poses of campaign A.
    """
    rng = np.random.default_rng([seed, 20261123])
    robot_config, _ = with_study_loads(config, robot)
    cell = cell_from_config(robot_config)
    noise, joints = (
        measurement_noise(robot_config),
        robot_config.repeatability.per_joint(cell.arm.n),
    )
    world = world_without_effect(cell, rng, noise=noise, joint_std=joints)
    draw = Draw(cell.arm, world.physics.joint_compliance, typical_torque(cell.arm))
    lacking = LACKING[seed // 2 % len(LACKING)] if seed % 2 else ""
    physics = world.physics
    of_arm = ("link_geometry", "encoder_offset", "transmission_error")
    for name in (*of_arm, lacking) if lacking else of_arm:
        physics = physics.with_effect(name, draw.effect(name, rng))
    world = replace(world, physics=physics)
    readings = measured(_within(world, 0), [], first, rng)
    first_fit = fit(with_effects(cell, readings, "absolute", GEOMETRY), readings, "absolute")
    prior = carried_prior(Posterior.of(first_fit))
    registration, station = place_tracker(cell, rng)
    again = _within(replace(world, registration=registration, station=station), 1)
    second = measured(again, [], max(numbers) + TESTED, rng)
    # The band of a calibration contains the arm's scatter; the tested readings add the tracker's.
    tracker = replace(again, joint_std=np.zeros(cell.arm.n))
    tracker_alone = tracker.covariance(again.ideal_readings(second.states), second.m)
    out = []
    for n in numbers:
        order = rng.permutation(len(second))
        some, rows = second[np.sort(order[:n])], np.sort(order[n:][:TESTED])
        tested = replace(second[rows], covariance=tracker_alone[rows])
        model = baseline(cell, some, "absolute", prior=prior)
        c = Calibration.of(fit(model, with_prior_scatter(model, some), "absolute"))
        errors, inside = judged(c, c.predict(tested.states.q, tested.states.wrench), tested)
        out.append(BandCase(seed, lacking, n, float(errors.mean()), float(inside.mean())))
    return out


def _within(world: World, campaign: int) -> World:
    """The world with the joint ranges of a campaign, from which poses are drawn."""
    arm = world.cell.arm
    low, high = arm.q_min.copy(), arm.q_max.copy()
    low[JOINT], high[JOINT] = RANGES[campaign]
    return replace(world, cell=replace(world.cell, arm=replace(arm, q_min=low, q_max=high)))
