"""States, situations and parameters that the tests of effects share."""

import numpy as np
from arm_cases import arm_of
from arm_cases import cell_of as odd_cell
from campaigns import cell_of

from hilcal.cell import Cell
from hilcal.data.readings import States
from hilcal.effects.catalogue import BUILT_IN
from hilcal.effects.protocol import Situation
from hilcal.robot import chain as chains
from hilcal.robot.deviation import Deviation
from hilcal.robot.statics import Load, slot_wrenches

NAMES = tuple(e.name for e in BUILT_IN)
ELASTIC = tuple(e.name for e in BUILT_IN if e.elastic)
FIELDS = ("dq", "twist", "base", "station", "target", "scale")


def some_states(cell: Cell, count: int = 9, seed: int = 1) -> States:
    rng = np.random.default_rng(seed)
    n = cell.arm.n
    wrench = rng.normal(size=(count, 6)) * [40, 40, 40, 6, 6, 6]
    wrench[::3] = 0.0
    return States(
        q=rng.uniform(-2.5, 2.5, (count, n)),
        wrench=wrench,
        time=np.sort(rng.uniform(0, 4e3, count)),
        approach=rng.choice([-1.0, 1.0], (count, n)),
    )


def options_of(name: str, m: int = 3) -> dict[str, object]:
    if name == "target_offset":
        return {"rotation": m == 6}
    return {"tracker_drift": {"reference_s": 0.0}, "transmission_error": {"harmonics": 3}}.get(
        name, {}
    )


def situation(cell: Cell, seed: int = 2) -> Situation:
    """A configuration that is visibly deflected, under wrenches and weight."""
    states = some_states(cell, seed=seed)
    rng = np.random.default_rng(seed)
    shape = (len(states), cell.arm.n)
    deviation = Deviation(
        dq=1e-2 * rng.normal(size=shape),
        twist=1e-2 * rng.normal(size=(shape[0], shape[1] + 1, 6)),
    )
    chain = chains.evaluate(cell.arm, states.q, deviation)
    load = Load(states.wrench, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
    return Situation(cell, states, states.q, chain, slot_wrenches(cell.arm, chain, load))


CELLS = {"ur10e": cell_of(), "odd": odd_cell(arm_of("odd"))}


def random_theta(effects, rng, elastic=1.0):
    return np.concatenate(
        [
            (elastic if e.elastic else 1.0)
            * rng.normal(size=len(e.parameters))
            * [p.scale for p in e.parameters]
            for e in effects
        ]
    )
