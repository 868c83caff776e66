"""Simulated arms that are measured, changed or not, and measured again with a few readings.

The world is the simulated cell with independent mechanics: errors of links of tenths of a
millimetre, joint zeros, compliances, transmission errors of six harmonics. Campaign A, of ordinary
size, is fitted once for each arm. The few readings of B are drawn for each case: other poses,
loads, times and temperatures, and another place of the tracker where it is set up anew. Some arms
have further effects, which the readings of A add to its model, as in `compare`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.diagnosis.change import LEVEL, POWER, STATED_DOF, Changes, changing, find_changes
from hilcal.diagnosis.comparison import with_missing_effects
from hilcal.drivers.simulated.injected_effects import (
    Draw,
    joint_compliance,
    typical_torque,
    world_without_effect,
)
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.drivers.simulated.world import World, place_tracker
from hilcal.errors import HilcalError
from hilcal.identification.baseline import with_effects
from hilcal.identification.carried.later_readings import EarlierFit, earlier_fit, later_readings
from hilcal.identification.fit import fit
from hilcal.readings.readings import Readings, States
from hilcal.regression.evidence import noncentrality_of_power
from hilcal.types import Floats
from studies.random_campaigns import rehearsal_states
from studies.study_cases import with_study_loads

Repair = Literal["nothing", "zero", "compliance", "zero and compliance", "gearbox"]
REPAIRS: tuple[Repair, ...] = ("zero", "compliance", "zero and compliance", "gearbox")
POSES_A = 40
READINGS_B = 15
WARMER = 5.0
"""Increase of the temperature in some later campaigns, K."""
GEOMETRY = ("link_geometry", "transmission_error", "joint_compliance")
ZERO_RAD = (0.3e-3, 5e-3)
"""Change of a joint's zero by a repair, mastered with a gauge or to a mark; log-uniform."""


@dataclass(frozen=True, slots=True, eq=False)
class StudiedArm:
    """A simulated arm and the earlier campaign on it.

    Attributes:
        robot: name of the arm.
        cell: as configured.
        world: the truth.
        loads: names and wrenches (6,) of that campaign.
        others: further loads.
        earlier: result of the fit of that campaign.
    """

    robot: str
    cell: Cell
    world: World
    loads: Sequence[tuple[str, Floats]]
    others: Sequence[tuple[str, Floats]]
    earlier: EarlierFit


@dataclass(frozen=True, slots=True, eq=False)
class ChangeCase:
    """One comparison.

    Attributes:
        robot: name of the arm.
        repair: kind of repair.
        joint: number of the joint, from 1; 0 without a repair.
        anew: whether the tracker was set up anew.
        seed: of the case.
        size_rad: change of the joint's zero.
        factor: factor of the compliance.
        other: whether B has other loads than A and is 5 K warmer.
        moved_m: rms displacement of the target by the change in the readings of B, m.
        strength: the displacement without the part that the tracker's place and A's uncertainty
            absorb, in σ of all readings together: the root of the non-centrality of a test that
            knows its shape.
        limit: strength above which a change of one parameter is claimed in nine cases of ten.
        parts: part of the first change that the program names; empty for none.
        others: parts of further changes.
        same_as: parts that it cannot distinguish from the first.
        z: (estimated − true)/standard deviation of the zero and of the compliance, where found.
        of_arm: whether a change of the arm itself is named.
        explained: whether the residual is scatter.
        set_aside: number of readings that are called gross errors, wrongly.
        failure: reason for no answer.
    """

    robot: str
    repair: Repair
    joint: int
    anew: bool
    seed: int
    size_rad: float = 0.0
    factor: float = 1.0
    other: bool = False
    moved_m: float = 0.0
    strength: float = 0.0
    limit: float = 0.0
    parts: str = ""
    others: tuple[str, ...] = ()
    same_as: tuple[str, ...] = ()
    z: tuple[float, ...] = ()
    of_arm: bool = False
    explained: bool = True
    set_aside: int = 0
    failure: str = ""

    @property
    def found(self) -> bool:
        """Whether only the repaired joint is named."""
        return self.parts == f"joint {self.joint}" and not self.others

    @property
    def visible(self) -> bool:
        """Whether the change exceeds the program's stated limit of detection."""
        return self.strength > self.limit


def studied_arm(
    config: CellConfig, robot: str, seed: int, poses: int = POSES_A, more: Sequence[str] = ()
) -> StudiedArm:
    """Measure an arm with all its errors, and fit the model that a refinement would reach.

    Args:
        config: the cell; robot and loads are replaced.
        robot: name of the arm.
        seed: of everything random.
        poses: of the campaign, each unloaded and under three loads.
        more: further effects of the arm.
    """
    rng = np.random.default_rng([seed, 20261122])
    robot_config, loads = with_study_loads(config, robot)
    chosen = [loads[0], loads[1], loads[4]]
    cell = cell_from_config(robot_config)
    noise, joints = (
        measurement_noise(robot_config),
        robot_config.repeatability.per_joint(cell.arm.n),
    )
    world = world_without_effect(cell, rng, noise=noise, joint_std=joints)
    draw = Draw(cell.arm, world.physics.joint_compliance, typical_torque(cell.arm))
    physics = world.physics
    for name in ("link_geometry", "encoder_offset", "transmission_error", *more):
        physics = physics.with_effect(name, draw.effect(name, rng))
    world = replace(world, physics=physics)
    readings = measured(world, chosen, poses, rng)
    model = with_effects(cell, readings, "absolute", GEOMETRY)
    fitted, _ = with_missing_effects(fit(model, readings, "absolute"), changing(model.catalogue))
    return StudiedArm(robot, cell, world, chosen, loads[2:4], earlier_fit(fitted))


def measured(
    world: World, loads: Sequence[tuple[str, Floats]], poses: int, rng: np.random.Generator
) -> Readings:
    """Measure every pose unloaded and under every load."""
    states, pose, load, cycle = rehearsal_states(world.cell, poses, loads, rng)
    names = ("none", *(name for name, _ in loads))
    return simulate(world, states, pose, load, cycle, names, rng)


def remeasured(
    world: World,
    loads: Sequence[tuple[str, Floats]],
    count: int,
    rng: np.random.Generator,
    warmer: float = 0.0,
) -> Readings:
    """Measure so many poses, each under one of the loads or none, drawn at random.

    Args:
        world: the truth.
        loads: names and wrenches (6,).
        count: number of readings.
        rng: generator.
        warmer: increase above the study's usual temperatures, K.
    """
    pulls = [(name, float(rng.uniform(0.5, 1.0)) * wrench) for name, wrench in loads]
    states, pose, load, cycle = rehearsal_states(world.cell, count, pulls, rng)
    chosen = np.arange(count) * (1 + len(pulls)) + rng.integers(0, 1 + len(pulls), count)
    if states.air_temperature is not None and states.joint_temperature is not None:
        states = replace(
            states,
            air_temperature=states.air_temperature + warmer,
            joint_temperature=states.joint_temperature + warmer,
        )
    names = ("none", *(name for name, _ in pulls))
    return simulate(world, states[chosen], pose[chosen], load[chosen], cycle[chosen], names, rng)


def case(
    arm: StudiedArm,
    repair: Repair,
    joint: int,
    anew: bool,
    seed: int,
    *,
    other: bool = False,
    count: int = READINGS_B,
) -> ChangeCase:
    """Repair an arm, measure it again, and compare.

    Args:
        arm: the arm and its earlier campaign.
        repair: kind of repair.
        joint: number of the joint, from 1; 0 for nothing.
        anew: whether the tracker is set up anew.
        seed: of everything random.
        other: whether B has other loads than A and is 5 K warmer.
        count: number of readings.
    """
    rng = np.random.default_rng([seed, joint, len(repair), anew])
    world, k = arm.world, joint - 1
    if anew:
        registration, station = place_tracker(arm.cell, rng)
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
        drawn = Draw(arm.cell.arm, physics.joint_compliance, typical_torque(arm.cell.arm))
        waves = physics.transmission_error.copy()
        waves[k] = drawn.effect("transmission_error", rng)[k]
        physics = physics.with_effect("transmission_error", waves)
        factor = float(joint_compliance(arm.cell.arm, rng)[k] / physics.joint_compliance[k])
    compliance = physics.joint_compliance.copy()
    compliance[k] *= factor if joint else 1.0
    change = float(compliance[k] - physics.joint_compliance[k]) if joint else 0.0
    changed = replace(world, physics=physics.with_effect("joint_compliance", compliance))
    loads, warmer = (arm.others, WARMER) if other else (arm.loads, 0.0)
    readings = remeasured(changed, loads, count, rng, warmer)

    def moved(states: States) -> Floats:
        """Return the displacement (N, 3) of the target by the repair, m."""
        before = world.ideal_readings(states).position
        return np.asarray(changed.ideal_readings(states).position - before)

    rms = float(np.sqrt(np.mean(np.sum(moved(readings.states) ** 2, axis=1))))
    repaired = ChangeCase(arm.robot, repair, joint, anew, seed, size, factor, other, rms)
    try:
        changes = find_changes(later_readings(arm.earlier, readings, anew=anew))
    except HilcalError as error:
        return replace(repaired, failure=str(error))
    of_kept = moved(changes.before.later.readings.states)
    return judged(repaired, changes, of_kept, change)


def judged(repaired: ChangeCase, changes: Changes, moved: Floats, change: float) -> ChangeCase:
    """Return the case with the answer of the program.

    Args:
        repaired: the case.
        changes: the answer.
        moved: (N, 3) displacement of the target by the change in each reading that was not set
            aside, m.
        change: of the joint's compliance, rad/(N·m).
    """
    test, first = changes.before, changes.found[0] if changes.found else None
    w = test.later.w
    x = w.whiten(w.raw(moved)[:, :, None])[:, 0] / np.sqrt(test.later.earlier.noise)
    level = LEVEL / changes.tested
    noncentrality = noncentrality_of_power(1, test.dof + STATED_DOF - 1, level, POWER)
    truth = {"encoder_offset": repaired.size_rad, "joint_compliance": change}
    z = tuple(
        (s.value - truth[c.candidate.effect]) / s.std
        for c in changes.found
        if c.candidate.effect in truth and c.candidate.joint == repaired.joint
        for s in c.sizes
    )
    return replace(
        repaired,
        strength=float(np.sqrt(max(x @ test.projection.project_out(x), 0.0))),
        limit=float(np.sqrt(noncentrality)),
        parts="" if first is None else first.candidate.part,
        others=tuple(
            c.candidate.part
            for c in changes.found[1:]
            if first is not None and c.candidate.part != first.candidate.part
        ),
        same_as=() if first is None else first.parts[1:],
        of_arm=any(c.candidate.of_arm for c in changes.found),
        z=z,
        explained=changes.explained,
        set_aside=len(changes.gross),
    )
