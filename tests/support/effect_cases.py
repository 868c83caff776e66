"""States, situations and parameters that the tests of effects share."""

import numpy as np

from hilcal.effects.catalogue import BUILT_IN, installed
from hilcal.effects.options import typical_compliances
from hilcal.effects.protocol import Situation
from hilcal.model.model import Model
from hilcal.readings.readings import States
from hilcal.robot import chain as chains
from hilcal.robot.chain import Deviation
from hilcal.robot.statics import Load, slot_wrenches
from tests.support.arm_cases import RAILS, arm_of
from tests.support.arm_cases import cell_of as odd_cell
from tests.support.campaigns import cell_of

make = installed().make
effect_class = installed().__getitem__
ALL_NAMES = tuple(e.name for e in BUILT_IN if e.role != "observer")  # see test_observers
NAMES = tuple(e.name for e in BUILT_IN if e.applies(cell_of()) and e.role != "observer")
"""Those that an arm without slides can have."""


def some_states(cell, count=9, seed=1):
    rng = np.random.default_rng(seed)
    n = cell.arm.n
    wrench = rng.normal(size=(count, 6)) * [40, 40, 40, 6, 6, 6]
    wrench[::3] = 0.0
    return States(
        q=rng.uniform(-2.5, 2.5, (count, n)),
        wrench=wrench,
        time=np.sort(rng.uniform(0, 4e3, count)),
        approach=rng.choice([-1.0, 1.0], (count, n)),
        load_time=10 ** rng.uniform(0.5, 2.5, count),
        air_temperature=rng.uniform(14.0, 29.0, count),
        joint_temperature=rng.uniform(20.0, 45.0, (count, n)),
    )


def options_of(name, m=3):
    if name == "target_offset":
        return {"rotation": m == 6}
    known = {
        "tracker_drift": {"reference_s": 0.0},
        "transmission_error": {"harmonics": 3},
        "thermal_joint_drift": {"reference_degC": 22.0},
    }
    return known.get(name, {})


TURN = [0.3, -0.5, 1.1]
VARIANTS = (
    ("periodic_joint_compliance", {"orders": [1, 4, 2]}),
    ("backlash", {"crossing": 0.3}),
    ("creep", {"form": "each"}),
    ("thermal_growth", {"links": "each", "temperature": "joints", "reference_degC": 5.0}),
    ("thermal_joint_drift", {}),
    ("wrench_bias", {"rotvec_rad": TURN}),
    ("wrench_gain", {"rotvec_rad": TURN}),
    ("sensor_misalignment", {"rotvec_rad": TURN}),
)
"""Effects with options other than the usual ones."""


def situation(cell, seed=2):
    """A configuration that is visibly deflected, under wrenches and weight."""
    states = some_states(cell, seed=seed)
    rng = np.random.default_rng(seed)
    shape = (len(states), cell.arm.n)
    deviation = Deviation(
        dq=1e-2 * rng.normal(size=shape), twist=1e-2 * rng.normal(size=(shape[0], shape[1] + 1, 6))
    )
    chain = chains.evaluate(cell.arm, states.q, deviation)
    load = Load(states.wrench, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
    wrench = slot_wrenches(cell.arm, chain, load)
    phases = cell.arm.phases(states.q)
    return Situation(cell, states, phases, chain, wrench, load, typical_compliances(cell))


CELLS = {name: odd_cell(arm_of(name)) for name in ("odd", RAILS)} | {"ur10e": cell_of()}
UR10E = CELLS["ur10e"]


def random_theta(effects, rng, elastic=1.0):
    return np.concatenate(
        [
            (elastic if e.elastic else 1.0)
            * rng.normal(size=len(e.parameters))
            * [p.scale for p in e.parameters]
            for e in effects
        ]
    )


def numeric_slopes(model, states, theta, directions, m):
    """Central differences of the readings along each row of directions, (N, m, K)."""
    base = model.predict(states, theta).observation.rotation
    out = np.empty((len(states), m, len(directions)))
    for column, direction in enumerate(directions):

        def moved(h, direction=direction):
            o = model.predict(states, theta + h * direction).observation
            turn = o.rotation @ np.swapaxes(base, 1, 2)
            skew = 0.5 * (turn - np.swapaxes(turn, 1, 2))
            w = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
            return np.concatenate([o.position, w], axis=1)[:, :m]

        out[:, :, column] = (moved(1.0) - moved(-1.0)) / 2
    return out


def numeric_jacobian(model, states, theta, scale, m):
    """Central differences of the readings by parameters; rotations as small rotations."""
    return numeric_slopes(model, states, theta, np.diag(scale), m)


SOFT = 2e-5  # compliance of every joint in what follows, rad/(N·m)


def soft(cell, states, name, options=None):
    names = ("joint_compliance", name)
    return Model(cell, tuple(make(n, cell, states, options if n == name else {}) for n in names))


def position(model, states, *theta):
    return model.predict(states, np.concatenate(theta)).observation.position


def joints(cell):
    return np.full(cell.arm.n, SOFT)
