"""A simulated cell with something hidden in it, behind real wires or behind none."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from drivers.simulated.cell_processes import SimulatedCell
from drivers.simulated.planned import planned_states
from drivers.simulated.rehearsal import (
    Rehearsal,
    SimulationCase,
    measurement_noise,
    simulate,
    simulation_case,
)
from hilcal.config import CellConfig
from hilcal.effects.catalogue import Catalogue
from hilcal.store.plan import UNLOADED, Plan


def case_of_plan(
    config: CellConfig, plan: Plan, choice: str, seed: int, catalogue: Catalogue | None = None
) -> SimulationCase:
    """Hide an effect in the simulated cell of a configuration.

    Its strength holds for the readings of the plan, each the mean of several measurements; the
    world's tracker has the noise of a single one.

    Args:
        config: the cell; `[simulation]` gives the strength.
        plan: what will be measured.
        choice: an effect, "random" or "nothing".
        seed: of everything random.
        catalogue: has the effects of a user's own, which can be hidden, too.

    Raises:
        InputError: an unknown choice, or a cell without loads.
    """
    rng = np.random.default_rng(seed)
    mean = measurement_noise(config, config.acquire.samples)
    secret = simulation_case(
        config, choice, rng, lambda cell: planned_states(cell, config, plan), mean, catalogue
    )
    return replace(secret, world=replace(secret.world, noise=measurement_noise(config)))


def read_plan(s: SimulationCase, plan: Plan, seed: Sequence[int], begun: float = 0.0) -> Rehearsal:
    """Draw the readings of a plan in a simulated cell that is there already.

    Args:
        s: configuration and truth of the cell.
        plan: what is measured, each reading the mean of several measurements.
        seed: of the noise.
        begun: when, in the time of the campaign, s.
    """
    config = s.config
    world = replace(s.world, noise=measurement_noise(config, config.acquire.samples))
    v = planned_states(s.cell, config, plan, begun)
    names = (UNLOADED, *(load.name for load in config.loads))
    rng = np.random.default_rng(seed)
    readings = simulate(world, v.states, v.pose, v.load, v.cycle, names, rng)
    readings = replace(readings, pose_names=plan.pose_names)
    return Rehearsal(s.config, s.cell, s.mode, world, s.hidden, s.strength_sigma, readings)


@contextmanager
def simulated_cell(
    secret: SimulationCase,
    seed: int,
    base_dir: Path,
    directory: Path | None = None,
    begun: float = 0.0,
) -> Iterator[SimulatedCell]:
    """Run the simulated devices of a cell; they end with the block.

    Args:
        secret: configuration and truth of the cell.
        seed: of the devices' noise.
        base_dir: directory that a robot's file path is relative to.
        directory: where the devices meet; a temporary one if None.
        begun: world time at the start, s.

    Raises:
        DeviceError: a device did not start.
    """
    with tempfile.TemporaryDirectory(prefix="hilcal-") as made:
        where = directory or Path(made)
        with SimulatedCell.start(
            secret.world, secret.config, where, seed, base_dir=base_dir, begun=begun
        ) as cell:
            yield cell
