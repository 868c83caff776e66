"""A simulated task without hidden effects: an arm, training states, and states to predict."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import load_config
from hilcal.effects.catalogue import BUILT_IN
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats
from studies.random_campaigns import spread_poses
from studies.study_cases import with_study_loads

ARMS = ("ur10e", "ur5e", "xarm6", "irb120")
SIGMA = 2e-5
"""Standard deviation of the noise of one reading, each axis, m."""
FRESH = 200
"""Number of poses to predict."""
TARGET_SCATTER = 2e-3
"""Standard deviation per axis of a target from its nominal position, m."""
CANDIDATES = (
    "joint_stiffening", "joint_tilt_compliance", "base_compliance", "link_compliance",
    "tool_compliance", "periodic_joint_compliance", "backlash", "load_point", "tracker_drift",
    "wrench_bias", "wrench_gain", "sensor_misalignment", "encoder_offset", "joint_coupling",
    "transmission_error", "link_geometry", "link_mass", "tracker_scale",
)  # fmt: skip
"""Effects that may be hidden in tasks with naming."""
CONTAINED = {"link_geometry": ("encoder_offset", "tracker_scale")}
"""Effects that a hidden effect contains, so that their presence cannot be decided."""
_PASSING = 30.0  # s from one reading to the next


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """States of a task, the training rows first, rounded as in its files.

    Attributes:
        cell: the arm with its tool, target and load point.
        states: joints, wrenches and times.
        pose: name of each row's pose.
        load: name of each row's load.
        n_train: number of training rows; the others are to be predicted.
    """

    cell: Cell
    states: States
    pose: tuple[str, ...]
    load: tuple[str, ...]
    n_train: int


@dataclass(frozen=True, slots=True, eq=False)
class NoiselessTask:
    """A task without noise.

    Attributes:
        campaign: its states.
        position: (N, 3) readings of the instrument without noise, m.
        truth: the content of truth.json.
        columns: (N,) further columns by name.
        about: keys of task.json that not all tasks have.
        sigma: noise of one reading and axis, m.
    """

    campaign: Campaign
    position: Floats
    truth: dict[str, Any]
    columns: dict[str, Floats] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)
    sigma: float = SIGMA


def campaign(robot: str, poses: int, rng: np.random.Generator) -> Campaign:
    """Plan a campaign: training poses unloaded and under one load, poses to predict in one state.

    Poses are feasible and spread over the joint space. All poses are visited in random order, so
    that drifts in time are not extrapolated.
    """
    config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
    robot_config, pulls = with_study_loads(config, robot)
    cell = cell_from_config(robot_config)
    every = np.array([np.zeros(6), *(np.round(wrench, 2) for _, wrench in pulls)])
    names = ("none", *(name.replace(" ", "_") for name, _ in pulls))
    loads = len(pulls)
    q = np.vstack([spread_poses(cell, poses, every, rng), spread_poses(cell, FRESH, every, rng)])
    pose = np.concatenate([np.repeat(np.arange(poses), 2), np.arange(poses, poses + FRESH)])
    load = np.where(np.arange(2 * poses) % 2, 1 + np.arange(2 * poses) // 2 % loads, 0)
    load = np.concatenate([load, np.arange(FRESH) % (loads + 1)])
    turn = np.argsort(rng.permutation(poses + FRESH)[pose], kind="stable")
    time = np.empty(len(pose))
    time[turn] = _PASSING * np.arange(1, len(pose) + 1)
    states = States(q=np.round(q, 4)[pose], wrench=every[load], time=time)
    return Campaign(
        cell,
        states,
        tuple(f"p{k + 1}" for k in pose),
        tuple(names[k] for k in load),
        2 * poses,
    )


def named(hidden: list[str], strength: float, parameters: dict[str, Any]) -> dict[str, Any]:
    """Return the truth of a task with naming."""
    either = {name for effect in hidden for name in CONTAINED.get(effect, ())}
    return {
        "kind": ("none", "one")[len(hidden)] if len(hidden) < 2 else "several",
        "strength_sigma": strength,
        "effects": [name for name in hidden if name not in either],
        "either": sorted(either),
        "parameters": parameters,
    }


def hide_each(choice: Sequence[str], count: int, hide: Callable[[str], None]) -> list[str]:
    """Hide the first `count` effects of a choice that can be hidden, and return their names.

    Raises:
        InputError: fewer can be hidden, e.g. as a gear would become infinitely stiff.
    """
    hidden: list[str] = []
    for name in choice:
        if len(hidden) == count:
            break
        try:
            hide(name)
        except InputError:
            continue
        hidden.append(name)
    if len(hidden) < count:
        raise InputError(f"only {hidden} of {list(choice)} can be hidden; valid: {count} of them")
    return hidden


def candidates() -> list[dict[str, str]]:
    """Return the candidates with their laws, as task.json has them."""
    laws = {effect.name: effect.summary for effect in BUILT_IN}
    return [{"effect": name, "law": laws[name]} for name in CANDIDATES]
