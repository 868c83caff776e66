"""Simulated arms that are measured, changed or not, and measured again with a few readings.

The world is the simulated cell with its own mechanics: links off by tenths of a millimetre, joint
zeros, compliances, transmission errors of six harmonics. Campaign A, of ordinary size, is fitted
once for each arm; the few readings of B are drawn anew for each case, with other poses, loads, time
and temperatures, and another place of the tracker where it was set up anew.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from drivers.simulated.draw import Draw, joint_compliance, typical_torque
from drivers.simulated.injected_effects import nothing_hidden
from drivers.simulated.rehearsal import measurement_noise, simulate
from drivers.simulated.world import World, stand
from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.data.readings import Readings
from hilcal.diagnose.change import Changes, find_changes
from hilcal.errors import HilcalError
from hilcal.identify.baseline import with_effects
from hilcal.identify.earlier import Earlier, earlier_fit
from hilcal.identify.fit import fit
from hilcal.identify.remeasured import setting
from hilcal.types import Floats
from studies.random_campaigns import rehearsal_states
from studies.study_cases import with_study_loads

Repair = Literal["nothing", "zero", "compliance", "zero and compliance", "gearbox"]
REPAIRS: tuple[Repair, ...] = ("zero", "compliance", "zero and compliance", "gearbox")
POSES_A = 40
READINGS_B = 15
GEOMETRY = ("link_geometry", "transmission_error", "joint_compliance")
ZERO_RAD = (0.3e-3, 5e-3)
"""How far a repair moves a joint's zero: mastered with a gauge, or to a mark; log-uniform."""


@dataclass(frozen=True, slots=True, eq=False)
class StudiedArm:
    """A simulated arm and the earlier campaign on it.

    Attributes:
        robot: name of the arm.
        cell: as configured.
        world: the truth.
        loads: names and wrenches (6,).
        earlier: what the fit of its campaign states.
    """

    robot: str
    cell: Cell
    world: World
    loads: Sequence[tuple[str, Floats]]
    earlier: Earlier


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One comparison.

    Attributes:
        robot: name of the arm.
        repair: what was done.
        joint: number of the joint, from 1; 0 where nothing was done.
        anew: whether the tracker was set up anew.
        seed: of the case.
        size_rad: by how much the zero was moved.
        factor: what the compliance was multiplied by.
        moved_m: rms displacement of the target that the change makes in the readings of B, m.
        absorbed: share of its (whitened) effect that the tracker's new place absorbs.
        parts: what the program names: the first change; empty where none.
        others: parts of further changes.
        same_as: parts that it cannot tell from the first.
        z: (estimated − true)/standard deviation of the zero and of the compliance, where found.
        explained: whether what is left is scatter.
        failure: why there is no answer.
    """

    robot: str
    repair: Repair
    joint: int
    anew: bool
    seed: int
    size_rad: float = 0.0
    factor: float = 1.0
    moved_m: float = 0.0
    absorbed: float = 0.0
    parts: str = ""
    others: tuple[str, ...] = ()
    same_as: tuple[str, ...] = ()
    z: tuple[float, ...] = ()
    explained: bool = True
    failure: str = ""

    @property
    def found(self) -> bool:
        """Whether the joint is named, and it alone."""
        return self.parts == f"joint {self.joint}" and not self.others


def studied_arm(config: CellConfig, robot: str, seed: int, poses: int = POSES_A) -> StudiedArm:
    """Measure an arm with all its errors, and fit what a refinement would end with.

    Args:
        config: the cell; robot and loads are replaced.
        robot: name of the arm.
        seed: of everything random.
        poses: of the campaign, each unloaded and under two loads.
    """
    rng = np.random.default_rng([seed, 20261122])
    own, loads = with_study_loads(config, robot)
    chosen = [loads[0], loads[1], loads[4]]
    cell = cell_from_config(own)
    noise, joints = measurement_noise(own), own.repeatability.per_joint(cell.arm.n)
    world = nothing_hidden(cell, rng, noise=noise, joint_std=joints)
    draw = Draw(cell.arm, world.physics.joint_compliance, typical_torque(cell.arm))
    physics = world.physics
    for name in ("link_geometry", "encoder_offset", "transmission_error"):
        physics = physics.with_effect(name, draw.effect(name, rng))
    world = replace(world, physics=physics)
    readings = measured(world, chosen, poses, rng)
    model = with_effects(cell, readings, "absolute", GEOMETRY)
    found = fit(model, readings, "absolute")
    return StudiedArm(robot, cell, world, chosen, earlier_fit(found))


def measured(
    world: World, loads: Sequence[tuple[str, Floats]], poses: int, rng: np.random.Generator
) -> Readings:
    """Measure every pose unloaded and under every load."""
    states, pose, load, cycle = rehearsal_states(world.cell, poses, loads, rng)
    names = ("none", *(name for name, _ in loads))
    return simulate(world, states, pose, load, cycle, names, rng)


def remeasured(
    world: World, loads: Sequence[tuple[str, Floats]], count: int, rng: np.random.Generator
) -> Readings:
    """Measure so many poses, each under one of the loads or none, drawn at random."""
    pulls = [(name, float(rng.uniform(0.5, 1.0)) * wrench) for name, wrench in loads]
    states, pose, load, cycle = rehearsal_states(world.cell, count, pulls, rng)
    each = np.arange(count) * (1 + len(pulls)) + rng.integers(0, 1 + len(pulls), count)
    names = ("none", *(name for name, _ in pulls))
    return simulate(world, states[each], pose[each], load[each], cycle[each], names, rng)


def case(
    arm: StudiedArm, repair: Repair, joint: int, anew: bool, seed: int, count: int = READINGS_B
) -> Case:
    """Repair an arm, measure it again, and compare."""
    rng = np.random.default_rng([seed, joint, len(repair), anew])
    world, k = arm.world, joint - 1
    if anew:
        registration, station = stand(arm.cell, rng)
        world = replace(world, registration=registration, station=station)
    physics, size, factor = world.physics, 0.0, 1.0
    if repair != "nothing" and repair != "compliance":
        size = float(np.exp(rng.uniform(*np.log(ZERO_RAD))) * rng.choice([-1.0, 1.0]))
        offset = physics.encoder_offset.copy()
        offset[k] += size
        physics = physics.with_effect("encoder_offset", offset)
    if repair in ("compliance", "zero and compliance"):
        factor = float(rng.choice([0.5, 2.0]))
    if repair == "gearbox":
        other = Draw(arm.cell.arm, physics.joint_compliance, typical_torque(arm.cell.arm))
        waves = physics.transmission_error.copy()
        waves[k] = other.effect("transmission_error", rng)[k]
        physics = physics.with_effect("transmission_error", waves)
        factor = float(joint_compliance(arm.cell.arm, rng)[k] / physics.joint_compliance[k])
    compliance = physics.joint_compliance.copy()
    compliance[k] *= factor if joint else 1.0
    change = float(compliance[k] - physics.joint_compliance[k]) if joint else 0.0
    changed = replace(world, physics=physics.with_effect("joint_compliance", compliance))
    readings = remeasured(changed, arm.loads, count, rng)
    moved = changed.sight(readings.states).position - world.sight(readings.states).position
    asked = Case(
        arm.robot, repair, joint, anew, seed, size, factor,
        float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
    )  # fmt: skip
    try:
        found = find_changes(setting(arm.earlier, readings, anew=anew))
    except HilcalError as error:
        return replace(asked, failure=str(error))
    return judged(asked, found, change)


def judged(asked: Case, found: Changes, change: float) -> Case:
    """Return the case with what the program says."""
    first = found.found[0] if found.found else None
    truth = {"encoder_offset": asked.size_rad, "joint_compliance": change}
    z = tuple(
        (s.value - truth[c.candidate.effect]) / s.std
        for c in found.found
        if c.candidate.effect in truth and c.candidate.joint == asked.joint
        for s in c.sizes
    )
    return replace(
        asked,
        parts="" if first is None else first.candidate.part,
        others=tuple(
            c.candidate.part
            for c in found.found[1:]
            if first is not None and c.candidate.part != first.candidate.part
        ),
        same_as=() if first is None else first.parts[1:],
        z=z,
        explained=found.explained,
    )
