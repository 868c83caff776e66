"""Track mujoco: effects hidden in the arm of springs, each of the strength that is asked for."""

from collections.abc import Sequence

import numpy as np

from hilcal.calibration.handover import urdf
from hilcal.readings.readings import States
from hilcal.types import Floats
from studies.benchmark.campaign import (
    SIGMA,
    TARGET_SCATTER,
    Campaign,
    Made,
    made,
    named,
)
from studies.benchmark.world_mujoco import Hidden, Springs

SHOWN = (
    "joint_stiffening", "joint_tilt_compliance", "base_compliance", "link_compliance",
    "tool_compliance", "periodic_joint_compliance", "load_point", "tracker_drift", "wrench_bias",
    "encoder_offset", "joint_coupling", "transmission_error", "link_geometry", "link_mass",
)  # fmt: skip
"""Effects that this arm can have."""


def mujoco_task(
    c: Campaign, choice: Sequence[str], count: int, strength: float, rng: np.random.Generator
) -> Made:
    """Hide the first `count` effects of a choice in a campaign, each of the strength that is asked.

    What an effect moves the trained readings by, rms over their axes, is `strength` times the
    noise. Every gear gives 1.4 to 2.6 mrad at its torque limit (100 N·m where that is not known);
    the directions of the effects are drawn, their sizes follow from the strength.
    """
    arm, cell = c.cell.arm, c.cell
    limit = np.where(np.isfinite(arm.torque_max), arm.torque_max, 100.0)
    soft = 2e-3 / limit * rng.uniform(0.7, 1.3, 6)
    hidden: dict[str, Floats] = {
        "joint_compliance": soft * (1.5 if "joint_stiffening" in choice[:count] else 1.0),
        "target_offset": TARGET_SCATTER * rng.standard_normal(3),
    }
    turn, side = rng.uniform(0.0, 2.0 * np.pi, 2)
    registration = np.eye(4)
    registration[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    registration[:3, 3] = 3.0 * np.cos(side), 3.0 * np.sin(side), rng.uniform(-0.8, 0.2)
    train = c.states[: c.n_train]
    drawn = _directions(soft, limit, rng)

    def springs(more: Hidden) -> Springs:
        return Springs(
            urdf(arm), cell.tool_mass, cell.tool_com, cell.load_point, cell.target[:3, 3],
            cell.gravity, {**hidden, **more}, registration,
        )  # fmt: skip

    def seen(more: Hidden, states: States = train) -> Floats:
        return springs(more).read(states.q, states.wrench, np.asarray(states.time))

    for name in choice[:count]:
        before, factor = seen({}), 1.0
        for _ in range(4):  # nearly linear: each round gains some digits
            moved = seen({name: factor * drawn[name]}) - before
            factor *= strength * SIGMA / float(np.sqrt(np.mean(moved**2)))
        hidden[name] = factor * drawn[name]
    parameters = {name: np.array(v).tolist() for name, v in hidden.items()}
    return made(c, seen({}, c.states), named(list(choice[:count]), strength, parameters))


def _directions(soft: Floats, limit: Floats, rng: np.random.Generator) -> dict[str, Floats]:
    """Draw a direction of each effect, of about the size that moves readings by some noise."""
    even, normal = rng.uniform, rng.standard_normal
    waves = 1.0 / np.arange(1, 7)[:, None]
    return {
        "joint_stiffening": -0.01 * soft / limit**2 * even(0.7, 1.0, 6),
        "joint_tilt_compliance": 0.1 * soft * even(0.3, 1.0, 6),
        "base_compliance": 0.1 * soft[0] * even(0.3, 1.0, 3),
        "link_compliance": 0.1 * soft[:2].mean() * np.array([1.0, 1.3]) * even(0.5, 1.5, (2, 2)),
        "tool_compliance": 0.1 * soft[5] * even(0.5, 1.0, 2),
        "periodic_joint_compliance": 0.1 * soft[:, None] * normal((6, 2)),
        "load_point": 1e-3 * normal(3),
        "tracker_drift": np.repeat([1e-8, 3e-9], 3) * normal(6),
        "wrench_bias": np.repeat([1.0, 0.1], 3) * normal(6),
        "encoder_offset": 1e-4 * normal(6),
        "joint_coupling": 1e-4 * np.diag(normal(5), -1),
        "transmission_error": 1e-4 * waves * normal((6, 6, 2)),
        "link_geometry": 1e-4 * normal((7, 6)),
        "link_mass": 0.01 * normal((6, 3)),
    }
