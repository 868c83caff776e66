"""Where the tool is by a model: the arm's own pose in base axes, without the instruments.

    T_base_tool = exp(base) T_base_flange(q, w) T_flange_tool

The frames that were fitted along (effects of the roles "registration" and "target") describe where
base and target are; they are part of T_sensor_base and T_flange_tool, and no error of the arm. What
instruments do (fields "station" and "scale") is no motion of the tool.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import States
from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.model import Model, Prediction
from hilcal.robot import se3
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Tool:
    """What is to be put somewhere.

    Attributes:
        model: whose target is the tool; without effects that place another target.
        theta: (P,) its parameters.
        kept: (P,) which of the parameters of the fitted model they are.
        pose: (4, 4) T_flange_tool, with what the fit knows of it.
        moving: effects that move base or target and are no frames, with their parameters.
    """

    model: Model
    theta: Floats
    kept: Ints
    pose: Floats
    moving: tuple[tuple[Effect, slice], ...]


def tool_of(model: Model, theta: Floats, pose: Floats | None) -> Tool:
    """Return the tracked target as fitted, or a tool with another pose.

    Args:
        model: the fitted model.
        theta: (P,) its parameters.
        pose: (4, 4) T_flange_tool; the (first) tracked target where None.
    """
    every = np.arange(model.size)
    if pose is None:
        return Tool(model, theta, every, _fitted_target(model, theta), _moving(model, theta))
    named = [e for e in model.effects if e.role != "target"]
    parts = [every[s] for e, s in zip(model.effects, model.slices(), strict=True) if e in named]
    kept = np.concatenate([every[:0], *parts])
    cell = replace(model.cell, targets=None, target_names=(), targets_known=())
    cell = replace(cell, target=pose, target_known=True)
    own = replace(model, cell=cell, effects=tuple(named))
    return Tool(own, theta[kept], kept, pose, _moving(own, theta[kept]))


def tool_poses(tool: Tool, prediction: Prediction) -> tuple[Floats, Floats]:
    """Orientation (N, 3, 3) and position (N, 3) of the tool in base axes, m."""
    chain, s = prediction.situation.chain, prediction.situation
    moved = [e.deviation(tool.theta[mine], s) for e, mine in tool.moving]
    own = sum((d.target for d in moved if d.target is not None), np.zeros((1, 6)))
    flange, offset = chain.rotation[-1], tool.pose[:3, 3] + own[:, :3]
    position = chain.point(offset if len(own) > 1 else offset[0])
    turned = se3.product(flange, se3.rotation(own[:, 3:])) if own.any() else flange
    rotation = se3.product(turned, tool.pose[:3, :3])
    base = [d.base for d in moved if d.base is not None]
    if base:
        r, p = se3.exp(sum(base[1:], base[0]))
        rotation, position = se3.product(r, rotation), p + se3.apply(r, position)
    return rotation, position


def one_of_each(cell: Cell) -> States:
    """Return one state that has every column, for effects that are built without readings."""
    n = cell.arm.n
    one = np.zeros(1)
    return States(
        q=np.zeros((1, n)),
        wrench=np.zeros((1, 6)),
        time=one,
        load_time=one,
        air_temperature=one,
        joint_temperature=np.zeros((1, n)),
        approach=np.ones((1, n)),
    )


def _moving(model: Model, theta: Floats) -> tuple[tuple[Effect, slice], ...]:
    """Effects that move base or target and are no frames, with where their parameters are."""
    situation = model.predict(_one(model.cell), theta).situation
    return tuple(
        (e, mine)
        for e, mine in zip(model.effects, model.slices(), strict=True)
        if e.role not in FRAME_ROLES
        and any(c.field in ("target", "base") for c in e.columns(situation))
    )


def _fitted_target(model: Model, theta: Floats) -> Floats:
    """(4, 4) the (first) target with what effects of the role "target" know of it."""
    pose = model.cell.all_targets[0].copy()
    situation = model.predict(_one(model.cell), theta).situation
    for e, mine in zip(model.effects, model.slices(), strict=True):
        if e.role == "target":
            moved = e.deviation(theta[mine], situation).target
            if moved is not None:
                pose[:3, 3] += moved[0, :3]
                pose[:3, :3] = se3.rotation(moved[0, 3:]) @ pose[:3, :3]
    return np.asarray(pose)


def _one(cell: Cell) -> States:
    """Return one state of the first target."""
    first = one_of_each(cell)
    return first if cell.targets is None else replace(first, target=np.zeros(1, dtype=np.int64))
