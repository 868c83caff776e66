"""Track elastic: effects hidden in the world of `hilcal.drivers.simulated` (Pinocchio statics)."""

from collections.abc import Sequence

import numpy as np

from hilcal.cell import Cell
from hilcal.drivers.simulated.injected_effects import hide_effect, softened, world_without_effect
from hilcal.drivers.simulated.world import SimulatedNoise, World
from studies.benchmark.campaign import (
    SIGMA,
    TARGET_SCATTER,
    Campaign,
    NoiselessTask,
    hide_each,
    named,
)


def bare(cell: Cell, rng: np.random.Generator) -> World:
    """Return a world with compliant joints, unknown registration and unknown target only.

    Its noise is isotropic, and the arm repeats exactly.
    """
    noise = SimulatedNoise((SIGMA, 0.0), (SIGMA, 0.0))
    world = world_without_effect(cell, rng, noise=noise, joint_std=0.0)
    physics = world.physics.with_effect("target_offset", TARGET_SCATTER * rng.standard_normal(3))
    return World(cell, physics, world.registration, world.station, noise, world.joint_std)


def elastic(
    c: Campaign, choice: Sequence[str], count: int, strength: float, rng: np.random.Generator
) -> NoiselessTask:
    """Hide effects, each of the strength that `hide_effect` defines: rms motion over the noise.

    Args:
        c: the campaign.
        choice: effects in the order in which they are tried.
        count: number of hidden effects.
        strength: rms motion of the training readings by each effect, over the noise.
        rng: generator.

    Raises:
        InputError: fewer of them can be hidden.
    """
    world = bare(c.cell, rng)
    if "joint_stiffening" in choice[:count]:
        world = softened(world, "joint_stiffening")

    def hidden(name: str) -> None:
        nonlocal world
        train = c.states[: c.n_train]
        world = hide_effect(name, c.cell, train, strength, "absolute", rng, world=world)

    names = hide_each(choice, count, hidden)
    truth = named(names, strength, {k: float(f"{v:.6g}") for k, v in world.truth.items()})
    return NoiselessTask(c, world.ideal_readings(c.states).position, truth)
