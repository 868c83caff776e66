"""The campaign of `hilcal demo`: a cell, an effect that is hidden in it, and the readings."""

from dataclasses import dataclass, replace

import numpy as np

from drivers.simulated.campaign import rehearsal_states, simulate
from drivers.simulated.hidden import DEFLECTION_EFFECTS, EFFECTS, hide, nothing_hidden
from drivers.simulated.tracker import TrackerNoise
from drivers.simulated.world import World
from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode
from hilcal.effects.catalogue import catalogue
from hilcal.errors import InputError
from hilcal.toml import suggest

POSES = 30
NOTHING = "nothing"
RANDOM = "random"
REGISTRATION_XYZ = (2.4, -1.6, -0.5)
REGISTRATION_ROTVEC = (0.0, 0.0, 2.1)
_SOFTER = 1.5  # a gear that stiffens starts softer than its mean


@dataclass(frozen=True, slots=True, eq=False)
class Rehearsal:
    """A simulated campaign, and what was hidden in it.

    Attributes:
        config: the configuration that the program is given.
        cell: the cell of that configuration.
        mode: the kind of readings that shows the hidden effect.
        world: the truth.
        hidden: the name of the hidden effect, or "nothing".
        strength_sigma: rms of what it does to the readings, in units of their noise.
        readings: what was measured.
    """

    config: CellConfig
    cell: Cell
    mode: Mode
    world: World
    hidden: str
    strength_sigma: float
    readings: Readings


def choices() -> tuple[str, ...]:
    """Effects that can be hidden: those of the catalogue that the world knows as well."""
    return tuple(e for e in EFFECTS if e in catalogue() and e != "joint_compliance")


def rehearse(config: CellConfig, choice: str, seed: int, n_poses: int = POSES) -> Rehearsal:
    """Measure a campaign in a simulated cell: each pose unloaded, then under each load.

    A known registration is told to the program only where the error hides in it. What a
    deflection shows is measured in deflections, the rest in absolute positions; what was
    drawn at random, and nothing at all, in absolute positions, which give nothing away.

    Args:
        config: the cell; its loads are all used.
        choice: an effect of `choices()`, "random" or "nothing".
        seed: of everything random.
        n_poses: number of poses.

    Raises:
        InputError: an unknown choice; lists the valid ones. No loads in the configuration.
    """
    valid = (*choices(), RANDOM, NOTHING)
    if choice not in valid:
        raise InputError(f"hide {choice!r}{suggest(choice, valid)}; valid: {', '.join(valid)}")
    if not config.loads:
        raise InputError("the cell has no [[loads]]; a rehearsal needs at least one")
    rng = np.random.default_rng(seed)
    hidden = choice
    if choice == RANDOM:  # a wrong registration shows only where one is believed
        hidden = str(rng.choice([e for e in choices() if e != "base_frame"]))
    if hidden == "base_frame":
        known = {"base_xyz_m": REGISTRATION_XYZ, "base_rotvec_rad": REGISTRATION_ROTVEC}
        tracker = config.tracker.model_copy(update=known)
        config = config.model_copy(update={"tracker": tracker})
    mode: Mode = "deflection" if choice in DEFLECTION_EFFECTS else "absolute"
    cell = cell_from_config(config)
    pulls = [(load.name, load.wrench(cell.gravity)) for load in config.loads]
    states, pose, load, cycle = rehearsal_states(cell, n_poses, pulls, rng)
    t = config.tracker
    noise = TrackerNoise(
        (t.range_std_m, t.range_std_per_m),
        (t.transverse_std_m, t.transverse_std_per_m),
        t.orientation_std_rad,
    )
    joint_std = config.repeatability.per_joint(cell.arm.n)
    world = nothing_hidden(cell, rng, noise=noise, joint_std=joint_std)
    strength = 0.0
    if hidden != NOTHING:
        strength = config.simulation.strength_sigma
        if hidden == "joint_stiffening":
            softer = _SOFTER * world.physics.joint_compliance
            world = replace(world, physics=world.physics.with_effect("joint_compliance", softer))
        world = hide(hidden, cell, states, strength, mode, rng, world=world, pose=pose, cycle=cycle)
    names = ("none", *(name for name, _ in pulls))
    readings = simulate(world, states, pose, load, cycle, names, rng)
    return Rehearsal(config, cell, mode, world, hidden, strength, readings)
