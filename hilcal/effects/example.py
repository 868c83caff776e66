"""A cell and states to try an effect on: every column is there, every third state is unloaded."""

from dataclasses import fields, replace

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig, Robot
from hilcal.effects.options import typical_compliances
from hilcal.effects.protocol import Situation
from hilcal.readings.readings import ObserverName, States
from hilcal.robot import chain as chains
from hilcal.robot.statics import Load, slot_wrenches

ROBOT = "ur10e"


def example_cell(joints: int | None = None, *, slides: bool = False) -> Cell:
    """Return the cell of an example arm; `joints` repeats its last joint, or leaves joints out.

    With `slides` its first joint slides, by as many metres as it turns by radians.
    """
    cell = cell_from_config(CellConfig(robot=Robot(model=ROBOT)))
    arm = cell.arm
    rows = np.minimum(np.arange(arm.n if joints is None else joints), arm.n - 1)
    longer = replace(
        arm,
        links=arm.links[[*rows, arm.n]],
        masses=arm.masses[rows],
        coms=arm.coms[rows],
        q_min=arm.q_min[rows],
        q_max=arm.q_max[rows],
        torque_max=arm.torque_max[rows],
        prismatic=np.arange(len(rows)) == 0 if slides else None,
        joint_names=tuple(f"joint {k + 1}" for k in range(len(rows))),
    )
    names = [ObserverName("station", "S1"), ObserverName("station", "S2")]
    names += [ObserverName("point", "P"), ObserverName("gauge", "G")]
    longer_cell = replace(cell, arm=longer, load_point=np.array([0.02, -0.01, 0.1]))
    return longer_cell.observed_by(names)


def example_states(cell: Cell, count: int = 30) -> States:
    """Return states drawn at random, the same ones every time, in arrays that cannot be changed.

    Times in s, temperatures in °C.
    """
    rng, n = np.random.default_rng(0), cell.arm.n
    q = rng.uniform(-1.5, 1.5, (count, n))
    wrench = rng.normal(size=(count, 6)) * [60, 60, 60, 8, 8, 8]
    wrench[::3] = 0.0
    time = np.cumsum(rng.uniform(20, 60, count))
    warm = 1.0 - np.exp(-time[:, None] / 600)
    states = States(
        q=q,
        wrench=wrench,
        time=time,
        load_time=rng.uniform(5, 300, count),
        air_temperature=21.0 + rng.normal(size=count),
        joint_temperature=22.0 + rng.uniform(5, 15, n) * warm,
        approach=rng.choice([-1.0, 1.0], (count, n)),
        q_actual=q + 1e-5 * rng.normal(size=q.shape),
        observer=np.arange(count) % 4,
    )
    for field in fields(states):
        if (given := getattr(states, field.name)) is not None:
            given.flags.writeable = False
    return states


def example_situation(cell: Cell, states: States) -> Situation:
    """Return the states on the rigid arm, with what its weight and the loads transmit."""
    angle = states.q if states.q_actual is None else states.q_actual
    chain = chains.evaluate(cell.arm, angle)
    load = Load(states.wrench, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
    wrench = slot_wrenches(cell.arm, chain, load)
    wrench.flags.writeable = False
    turned = cell.arm.phases(angle)
    return Situation(cell, states, turned, chain, wrench, load, typical_compliances(cell))
