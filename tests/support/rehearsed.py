"""Deflections of a simulated UR10e that hides nothing, under two weights, from seeded draws."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import load_config
from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.drivers.simulated.world import World
from hilcal.readings.readings import Readings
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Ints
from studies.random_campaigns import rehearsal_states


@dataclass(frozen=True, eq=False)
class Rehearsed:
    cell: Cell  # the cell
    world: World  # its truth
    readings: Readings  # (D,) deflections with their noise
    pose: Ints  # (D,) number of each reading's pose
    cycle: Ints  # (D,) number of its load cycle


def dead_weights(masses, gravity):
    """Return the wrenches of masses that hang at the load point, kg and m/s², by name."""
    return [
        (f"{mass:g}kg", np.concatenate([mass * np.asarray(gravity), np.zeros(3)]))
        for mass in masses
    ]


def rehearsed(poses, seed):
    """Simulate some poses, without temperatures, approach directions or times under load."""
    config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
    cell = cell_from_config(config)
    rng = np.random.default_rng(seed)
    loads = dead_weights((4.0, 8.0), cell.gravity)
    states, pose, load, cycle = rehearsal_states(
        cell, poses, loads, rng, approach=False, temperatures=False
    )
    states = replace(states, load_time=None)
    std = config.repeatability.per_joint(cell.arm.n)
    world = world_without_effect(cell, rng, noise=measurement_noise(config), joint_std=std)
    names = ("none", *(name for name, _ in loads))
    readings = simulate(world, states, pose, load, cycle, names, rng)
    return Rehearsed(cell, world, readings, pose, cycle)
