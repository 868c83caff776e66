"""Simulated campaigns with a known truth, for the tests of identification and diagnosis."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import load_config
from hilcal.drivers.simulated.injected_effects import (
    Draw,
    hide_effect,
    typical_torque,
    world_without_effect,
)
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode
from hilcal.robot import se3
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Ints
from studies.random_campaigns import rehearsal_states

NO_EFFECT = "none"


def configuration():
    """The cell of `hilcal demo`: a UR10e, two weights and two pulls."""
    return load_config(configs_dir() / "cells" / "demo_ur10e.toml")


@dataclass(frozen=True, slots=True, eq=False)
class CampaignPlan:
    """States of a campaign: every pose unloaded and under each load."""

    states: States
    pose: Ints
    load: Ints
    cycle: Ints
    load_names: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedCampaign:
    """A cell as the program believes it to be, the world as it is, and what was read."""

    cell: Cell
    world: World
    readings: Readings
    mode: Mode


def cell_of(*, registration_known=False, target_known=True):
    """The demo's cell; a known registration is some way off the origin and turned."""
    cell = cell_from_config(configuration())
    cell = replace(cell, registration_known=registration_known, target_known=target_known)
    if registration_known:
        turn = se3.rotation(np.array([0.02, -0.03, 2.1]))
        cell = replace(cell, registration=se3.matrix(turn, np.array([2.4, -1.6, -0.5])))
    return cell


@cache
def plan(poses=12, seed=0, cycles=1):
    """Feasible spread poses under all loads of the configuration; the same for equal arguments."""
    config, cell = configuration(), cell_of()
    pulls = [(load.name, load.wrench(cell.gravity)) for load in config.loads]
    rng = np.random.default_rng(seed)
    states, pose, load, cycle = rehearsal_states(cell, poses, pulls, rng, cycles=cycles)
    return CampaignPlan(states, pose, load, cycle, ("none", *(name for name, _ in pulls)))


def world_of(cell, rng):
    """A world with joint compliance alone, tracker and repeatability as configured."""
    config = configuration()
    t, joint_std = config.tracker, config.repeatability.per_joint(cell.arm.n)
    along, across = (t.range_std_m, t.range_std_per_m), (t.transverse_std_m, t.transverse_std_per_m)
    noise = SimulatedNoise(along, across, t.orientation_std_rad)
    return world_without_effect(cell, rng, noise=noise, joint_std=joint_std)


def world_with_gears(cell, rng):
    """The demo's arm with errors of links, zeros and gears of ordinary size, and its noise."""
    config = configuration()
    spread = config.repeatability.per_joint(cell.arm.n)
    world = world_without_effect(cell, rng, noise=measurement_noise(config), joint_std=spread)
    draw = Draw(cell.arm, world.physics.joint_compliance, typical_torque(cell.arm))
    physics = world.physics
    for name in ("link_geometry", "encoder_offset", "transmission_error"):
        physics = physics.with_effect(name, draw.effect(name, rng))
    return replace(world, physics=physics)


@cache
def campaign(
    effect=NO_EFFECT,
    mode="absolute",
    seed=0,
    *,
    poses=12,
    strength=3.0,
    registration_known=False,
    target_known=True,
    m=3,
    cycles=1,
    plan_seed=None,
    harmonics=6,
):
    """Measure a campaign in a world that hides one effect at `strength` σ."""
    cell = cell_of(registration_known=registration_known, target_known=target_known)
    p = plan(poses, 1000 + seed if plan_seed is None else plan_seed, cycles)
    rng = np.random.default_rng(seed)
    world = world_of(cell, rng)
    if effect == "joint_stiffening":  # a gear that stiffens starts softer than its mean
        softer = 1.5 * world.physics.joint_compliance
        world = replace(world, physics=world.physics.with_effect("joint_compliance", softer))
    if effect != NO_EFFECT:
        world = hide_effect(
            effect, cell, p.states, strength, mode, rng,
            world=world, m=m, pose=p.pose, cycle=p.cycle, harmonics=harmonics,
        )  # fmt: skip
    readings = measured(world, p, rng, m)
    for values in (readings.value, readings.covariance, readings.states.q, readings.states.wrench):
        values.flags.writeable = False
    return SimulatedCampaign(cell, world, readings, mode)


def measured(world, p, rng, m=3):
    """What the tracker reads of a plan."""
    return simulate(world, p.states, p.pose, p.load, p.cycle, p.load_names, rng, m)


def noiseless(world, p, m=3):
    """The same without any noise; the covariance stays."""
    readings = measured(world, p, np.random.default_rng(0), m)
    return replace(readings, value=world.ideal_readings(p.states).value(m))


def with_noise(clean, rng, factor=1.0):
    """Readings about noiseless ones, normal with `factor`² times the stated covariance."""
    root = factor * np.linalg.cholesky(clean.covariance)
    error = np.einsum("nij,nj->ni", root, rng.standard_normal(clean.value.shape))
    value = clean.value + error
    if clean.m == 6:
        turned = se3.rotation(error[:, 3:]) @ se3.rotation(clean.value[:, 3:])
        value[:, 3:] = se3.rotation_vector(turned)
    return replace(clean, value=value)


def true_parameters(world, effect, *, m=3):
    """Parameters of one effect of the program that describe the world, in its order."""
    truth = np.asarray(getattr(world.physics, effect)).reshape(-1)
    if effect == "target_offset" and m == 6:
        return np.concatenate([truth, np.zeros(3)])
    if effect == "joint_coupling":
        return truth[distal_factors(world.cell.arm)]
    return truth


def distal_factors(arm):
    """Where among n x n factors those of joints behind one another, and own ratios, are."""
    n = arm.n
    pairs = np.eye(n, k=-1) + np.diag(~arm.slides)
    pairs[n - 1, n - 3] = 1.0
    return np.flatnonzero(pairs * (arm.slides[:, None] == arm.slides))
