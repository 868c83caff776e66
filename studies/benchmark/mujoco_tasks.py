"""Track mujoco: effects hidden in the arm of springs, each of the strength that is asked for."""

from collections.abc import Sequence

import numpy as np

from hilcal.calibration.handover import urdf
from hilcal.drivers.simulated.injected_effects import Draw, joint_compliance, typical_torque
from hilcal.drivers.simulated.world import place_tracker
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats
from studies.benchmark.campaign import (
    SIGMA,
    TARGET_SCATTER,
    Campaign,
    NoiselessTask,
    hide_each,
    named,
)
from studies.benchmark.world_mujoco import Hidden, Springs

SHOWN = (
    "joint_stiffening", "joint_tilt_compliance", "base_compliance", "link_compliance",
    "tool_compliance", "periodic_joint_compliance", "load_point", "tracker_drift", "wrench_bias",
    "encoder_offset", "joint_coupling", "transmission_error", "link_geometry", "link_mass",
)  # fmt: skip
"""Effects that this arm can have."""
_START = 0.05  # first trial, as a share of the drawn size
_ROUNDS = 6
_CLOSE = 1e-3  # relative tolerance of the strength


def mujoco_task(
    c: Campaign, choice: Sequence[str], count: int, strength: float, rng: np.random.Generator
) -> NoiselessTask:
    """Hide effects of a strength, the rms motion of the training readings over the noise.

    Directions are drawn as for the other simulated arm; no mechanics are shared.

    Args:
        c: the campaign.
        choice: effects in the order in which they are tried.
        count: number of hidden effects.
        strength: of each effect.
        rng: generator.

    Raises:
        InputError: fewer of them can be hidden.
    """
    cell, train = c.cell, c.states[: c.n_train]
    soft = joint_compliance(cell.arm, rng)
    if "joint_stiffening" in choice[:count]:
        soft = 1.5 * soft  # a gear that stiffens starts softer
    hidden: dict[str, Floats] = {
        "joint_compliance": soft,
        "target_offset": TARGET_SCATTER * rng.standard_normal(3),
    }
    registration, _ = place_tracker(cell, rng)
    draw = Draw(cell.arm, soft, typical_torque(cell.arm))

    def position(further: Hidden, states: States) -> Floats:
        arm = Springs(
            urdf(cell.arm), cell.tool_mass, cell.tool_com, cell.load_point, cell.target[:3, 3],
            cell.gravity, {**hidden, **further}, registration,
        )  # fmt: skip
        try:
            return arm.read(states.q, states.wrench, np.asarray(states.time))
        except RuntimeError as error:
            raise InputError(f"no equilibrium: {error}; valid: weaker effects") from error

    def hide(name: str) -> None:
        without, value = position({}, train), _START * draw.effect(name, rng)
        for _ in range(_ROUNDS):
            size = float(np.sqrt(np.mean((position({name: value}, train) - without) ** 2)))
            if abs(size / (strength * SIGMA) - 1.0) < _CLOSE:
                hidden[name] = value
                return
            value = value * (strength * SIGMA / size)
        raise InputError(f"effect {name} cannot reach {strength:g} sigma in these states")

    names = hide_each(choice, count, hide)
    parameters = {name: np.array(v).tolist() for name, v in hidden.items()}
    return NoiselessTask(c, position({}, c.states), named(names, strength, parameters))
