"""Laws outside of the catalogue, and their displacement of readings.

A law moves joints or the target as a function of recorded quantities that no effect of the
catalogue has: the error of a joint depends on the angle of another one, a bench rises with the air
temperature. It is added to readings to first order, r + J dq + d, at a given strength.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilcal.drivers.simulated.world import World
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Bools, Floats, Ints

ABSOLUTE, DEFLECTION = "absolute", "deflection"
_NOTHING = 1e-6  # σ of a law at size 1; rounding
Law = Callable[[States, Floats], Floats]
"""Motions (N, n + 3) of joints and target (sensor axes) from states and torques (N, n)."""


@dataclass(frozen=True, slots=True)
class UnmodelledLaw:
    """An effect outside of the catalogue.

    Attributes:
        name: short name.
        law: the law in one line.
        variables: its variables, by their names in a diagnosis.
        readings: modes of readings that show it.
        motion: the law, in any unit.
        resembles: effects of the catalogue that describe it nearly as well.
    """

    name: str
    law: str
    variables: tuple[str, ...]
    readings: tuple[str, ...]
    motion: Law
    resembles: tuple[str, ...] = ()


def _of_joint(j: int, states: States, values: Floats) -> Floats:
    """Return motions of joint j alone."""
    out = np.zeros((len(states), states.q.shape[1] + 3))
    out[:, j - 1] = values
    return out


def _upwards(states: States, values: Floats) -> Floats:
    """Return motions of the target along the third axis of the sensor."""
    out = np.zeros((len(states), states.q.shape[1] + 3))
    out[:, -1] = values
    return out


def _given(values: Floats | None, name: str) -> Floats:
    """Return a column that the law depends on.

    Raises:
        InputError: the states lack the column.
    """
    if values is None:
        raise InputError(f"states: no {name}; valid: states that tell it")
    return values


def _crossed(s: States, torque: Floats) -> Floats:
    return _of_joint(2, s, np.sin(3.0 * s.q[:, 3]))


def _settled(s: States, torque: Floats) -> Floats:
    time = _given(s.time, "time")
    return _of_joint(3, s, np.tanh((time / max(float(time.max()), 1.0) - 0.3) / 0.1))


def _swaying(s: States, torque: Floats) -> Floats:
    air = _given(s.air_temperature, "air temperature")
    return _upwards(s, air - air.mean())


def _dragged(s: States, torque: Floats) -> Floats:
    return _of_joint(5, s, _given(s.approach, "approach")[:, 2])


def _coupled(s: States, torque: Floats) -> Floats:
    return _of_joint(4, s, torque[:, 1] ** 2)


def _relaxing(s: States, torque: Floats) -> Floats:
    return _upwards(s, -np.sqrt(_given(s.load_time, "time under the load")))


def _turned(s: States, torque: Floats) -> Floats:
    pull = np.linalg.norm(s.wrench[:, :3], axis=1)
    return _of_joint(2, s, pull * np.cos(2.0 * s.q[:, 0]))


def _crosswise(s: States, torque: Floats) -> Floats:
    return _of_joint(3, s, torque[:, 1])


def _one_sided(s: States, torque: Floats) -> Floats:
    return _of_joint(2, s, np.maximum(torque[:, 1], 0.0))


def _saturating(s: States, torque: Floats) -> Floats:
    typical = float(np.median(np.abs(torque[:, 1])))
    return _of_joint(2, s, np.tanh(torque[:, 1] / max(typical, 1e-9)))


def _elsewhere(s: States, torque: Floats) -> Floats:
    return _of_joint(3, s, torque[:, 2] * np.cos(s.q[:, 3]))


def _hose(s: States, torque: Floats) -> Floats:
    """A hose from forearm to tool, whose spring the load's pull along it stretches."""
    pull = np.linalg.norm(s.wrench[:, :3], axis=1)
    return _of_joint(5, s, pull * s.q[:, 5])


LAWS: tuple[UnmodelledLaw, ...] = (
    UnmodelledLaw("crossed gear", "dq_2 = a sin 3 q_4", ("joint 4 angle",), (ABSOLUTE,), _crossed),
    UnmodelledLaw("slip in time", "dq_3 = a tanh of time", ("time",), (ABSOLUTE,), _settled),
    UnmodelledLaw(
        "swaying bench", "target rises with the air", ("air temperature",), (ABSOLUTE,), _swaying
    ),
    UnmodelledLaw(
        "dragging cable",
        "dq_5 = a s_3, the side joint 3 came from",
        ("joint 3 approach",),
        (ABSOLUTE, DEFLECTION),
        _dragged,
    ),
    UnmodelledLaw(
        "coupled joint",
        "dq_4 = a tau_2²",
        ("joint 2 torque",),
        (ABSOLUTE, DEFLECTION),
        _coupled,
    ),
    UnmodelledLaw(
        "relaxing bench",
        "target sinks by a sqrt(time under the load)",
        ("time under load",),
        (DEFLECTION,),
        _relaxing,
    ),
    UnmodelledLaw(
        "base that turns",
        "dq_2 = a |f| cos 2 q_1",
        ("joint 1 angle", "load"),
        (DEFLECTION,),
        _turned,
    ),
    UnmodelledLaw(
        "crosswise compliance", "dq_3 = a tau_2", ("joint 2 torque",), (DEFLECTION,), _crosswise
    ),
    UnmodelledLaw(
        "one-sided stop", "dq_2 = a max(tau_2, 0)", ("joint 2 torque",), (DEFLECTION,), _one_sided
    ),
    UnmodelledLaw(
        "saturating gear",
        "dq_2 = a tanh tau_2",
        ("joint 2 torque",),
        (DEFLECTION,),
        _saturating,
        resembles=("joint_stiffening",),
    ),
    UnmodelledLaw(
        "compliance by another joint",
        "dq_3 = a tau_3 cos q_4",
        ("joint 4 angle", "joint 3 torque"),
        (DEFLECTION,),
        _elsewhere,
    ),
    UnmodelledLaw(
        "hose spring", "dq_5 = a |f| q_6", ("joint 6 angle", "load"), (DEFLECTION,), _hose
    ),
)
"""All laws."""


def law_named(name: str) -> UnmodelledLaw:
    """Return a law by name.

    Raises:
        InputError: lists the valid names.
    """
    for law in LAWS:
        if law.name == name:
            return law
    raise InputError(f"law {name!r}; valid: {', '.join(law.name for law in LAWS)}")


def shift(
    law: UnmodelledLaw,
    world: World,
    states: States,
    strength_sigma: float,
    mode: str,
    pose: Ints,
    cycle: Ints,
) -> Floats:
    """Return the displacement (N, 3) of the readings by the law, sensor axes, m.

    Its size is such that sqrt(mean |W d|²) = strength_sigma, see `injected_effects.hide_effect`: d
    is the change of a reading, or of a loaded minus its unloaded reading; W whitens it.

    Raises:
        InputError: a mode that does not show the law, or states that lack a variable of the law.
    """
    if mode not in law.readings:
        raise InputError(f"law {law.name!r} needs readings {' or '.join(law.readings)}, not {mode}")
    motion = law.motion(states, world.drive_torque(states))
    sight = world.ideal_readings(states)
    n = states.q.shape[1]
    moved = np.einsum("nij,nj->ni", sight.jacobian[:, :3], motion[:, :n]) + motion[:, n:]
    covariance, change = world.covariance(sight), moved
    if mode == DEFLECTION:
        loaded = np.any(states.wrench != 0.0, axis=1)
        rows, first = _pairs(loaded, pose, cycle)
        covariance = covariance[rows] + covariance[first]
        change = moved[rows] - moved[first]
    white = np.linalg.solve(np.linalg.cholesky(covariance), change[:, :, None])
    size = float(np.sqrt(np.mean(white**2)))
    if size <= _NOTHING:
        raise InputError(f"law {law.name!r} changes nothing in these states ({mode} readings)")
    return np.asarray(strength_sigma / size * moved)


def _pairs(loaded: Bools, pose: Ints, cycle: Ints) -> tuple[Ints, Ints]:
    """Return the rows of loaded readings, and those of the unloaded readings to subtract.

    Raises:
        InputError: no loaded reading, or a pose without an unloaded one.
    """
    if not loaded.any():
        raise InputError("states: no loaded reading; valid: one with a wrench that is not zero")
    first = {(int(pose[row]), int(cycle[row])): int(row) for row in np.flatnonzero(~loaded)[::-1]}
    rows = np.flatnonzero(loaded)
    keys = [(int(pose[row]), int(cycle[row])) for row in rows]
    lacking = [key for key in keys if key not in first]
    if lacking:
        raise InputError(f"pose {lacking[0][0]} has no unloaded reading; valid: one per cycle")
    return rows, np.array([first[key] for key in keys], dtype=np.int64)
