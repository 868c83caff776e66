"""Simulated campaigns for the study of the diagnosis: 30 poses, five loads, hidden effects."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated.injected_effects import (
    DEFLECTION_EFFECTS,
    EFFECTS,
    hide_effect,
    world_without_effect,
)
from hilcal.drivers.simulated.rehearsal import measurement_noise, program_config, simulate
from hilcal.drivers.simulated.world import World
from hilcal.errors import InputError
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.robot.catalogue import load_arm
from hilcal.types import Floats
from studies.random_campaigns import rehearsal_states
from studies.unmodelled_laws import LAWS, UnmodelledLaw, law_named, shift

POSES = 30
_G = 9.81  # m/s², of the pulls
_LEVER = 0.04  # of the pulls' moments, as a share of the reach: 5 cm on a UR10e
_SOFTER = 1.5  # a gear that stiffens starts softer than its mean
_LOADS: tuple[tuple[str, tuple[float, float, float], tuple[float, float, float]], ...] = (
    ("light weight", (0.0, 0.0, -0.4), (0.0, 0.0, 0.0)),
    ("weight", (0.0, 0.0, -0.85), (0.0, 0.0, 0.0)),
    ("pull along x", (0.65, 0.0, 0.0), (0.0, 1.0, 1.0)),
    ("pull along y", (0.0, 0.65, 0.0), (1.0, 0.0, 1.0)),
    ("pull aslant", (-0.4, -0.4, 0.35), (-1.0, 1.0, 0.5)),
)
"""Force in units of the payload left by the tool, moment in units of this force times the lever."""


@dataclass(frozen=True, slots=True, eq=False)
class StudyCase:
    """A campaign with its truth, which the program does not get.

    Attributes:
        cell: the cell as configured.
        world: the truth.
        readings: the measured readings.
        noise: (N, 3) noise of each reading, m.
        variables: variables of a hidden effect outside of the catalogue.
    """

    cell: Cell
    world: World
    readings: Readings
    noise: Floats
    variables: tuple[str, ...]


def with_study_loads(config: CellConfig, robot: str) -> tuple[CellConfig, list[tuple[str, Floats]]]:
    """Return the cell with another robot, and the study's loads: names and wrenches (6,).

    Raises:
        InputError: an unknown robot, or one of unknown payload.
    """
    arm = load_arm(robot)
    room = arm.payload - config.tool.mass_kg
    if not np.isfinite(room) or room <= 0.0:
        raise InputError(f"robot {robot}: a payload of {arm.payload:g} kg leaves no load to hang")
    section = config.robot.model_copy(update={"model": robot, "base_link": None, "tip_link": None})
    weight = _G * room
    lever = _LEVER * arm.reach
    loads = [
        (name, weight * np.array([*force, *(lever * np.array(moment))]))
        for name, force, moment in _LOADS
    ]
    return config.model_copy(update={"robot": section}), loads


def effects_shown(mode: Mode) -> tuple[str, ...]:
    """Return the effects that can be hidden from a baseline in readings of a kind."""
    shown = EFFECTS if mode == "absolute" else DEFLECTION_EFFECTS
    return tuple(e for e in shown if e != "joint_compliance")


def laws_shown(mode: Mode) -> tuple[str, ...]:
    """Return the laws outside of the catalogue that readings of a kind show."""
    return tuple(law.name for law in LAWS if mode in law.readings and not law.resembles)


def study_case(
    config: CellConfig,
    robot: str,
    mode: Mode,
    hidden: Sequence[str],
    strength: float,
    seed: int,
    *,
    stated: float = 1.0,
    cycles: int = 1,
    n_poses: int = POSES,
) -> StudyCase:
    """Measure a campaign that hides effects, or a law outside of the catalogue.

    Equal arguments give equal campaigns. Campaigns that differ only in strength share poses, arm
    and noise.

    Args:
        config: the cell; robot and loads are replaced.
        robot: name of the arm.
        mode: the kind of readings in which the strength holds.
        hidden: effects of `EFFECTS` or names of `LAWS`; empty hides nothing.
        strength: of each effect or law, rms in units of the noise.
        seed: of everything random.
        stated: stated over true standard deviation of the noise.
        cycles: number of times that all poses are measured.
        n_poses: number of poses.

    Raises:
        InputError: unknown names, or an effect that cannot be hidden so.
    """
    names = "+".join(hidden)
    rng = np.random.default_rng([seed, cycles, *(crc32(w.encode()) for w in (robot, mode, names))])
    robot_config, loads = with_study_loads(config, robot)
    cell = cell_from_config(
        program_config(robot_config, "base_frame" if "base_frame" in hidden else "nothing")
    )
    states, pose, load, cycle = rehearsal_states(cell, n_poses, loads, rng, cycles=cycles)
    world = world_without_effect(
        cell, rng,
        noise=measurement_noise(robot_config),
        joint_std=robot_config.repeatability.per_joint(cell.arm.n),
    )  # fmt: skip
    if "joint_stiffening" in hidden:
        softer = _SOFTER * world.physics.joint_compliance
        world = replace(world, physics=world.physics.with_effect("joint_compliance", softer))
    laws: list[UnmodelledLaw] = []
    for name in hidden:
        if name in EFFECTS:
            world = hide_effect(
                name, cell, states, strength, mode, rng, world=world, pose=pose, cycle=cycle
            )
        else:
            laws.append(law_named(name))
    load_names = ("none", *(name for name, _ in loads))
    readings = simulate(world, states, pose, load, cycle, load_names, rng)
    clean = world.ideal_readings(states).position
    beyond = sum(
        (shift(law, world, states, strength, mode, pose, cycle) for law in laws),
        np.zeros_like(clean),
    )
    return StudyCase(
        cell=cell,
        world=world,
        readings=replace(
            readings,
            value=readings.value + beyond,
            covariance=stated**2 * readings.covariance,
        ),
        noise=readings.value - clean,
        variables=tuple(v for law in laws for v in law.variables),
    )
