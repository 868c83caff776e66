"""The pose of the tool in base axes by a model, without the instruments.

    T_base_tool = T_base_chain T_chain_flange(q, w) T_chainflange_flange T_flange_tool

`identification.robot_frames` declares base and flange. Effects of instruments (fields "station" and
"scale") do not move the tool.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.identification.robot_frames import one_of_each, robot_frames
from hilcal.model.model import Model, Prediction
from hilcal.robot import se3
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class ToolPose:
    """A tool on the flange of a fitted arm."""

    model: Model  # its target is the tool; without effects that place another target
    theta: Floats  # (P,) its parameters
    columns: Ints  # (P,) indices of these parameters in the fitted model
    nominal: Floats  # (4, 4) T_flange_tool
    pose: Floats  # (4, 4) T_chainflange_tool, the same on the flange of the fitted chain
    registered: Floats  # (4, 4) from the axes of the registration to those of the base
    base: Floats  # (4, 4) from the axes of the chain to those of the base, constant effects alone
    frames: tuple[tuple[Effect, slice], ...]
    """Effects that place the base, with the slices of their parameters."""
    moving: tuple[tuple[Effect, slice], ...]
    """Other effects that move base or target, with the slices of their parameters."""


def tool_of(model: Model, theta: Floats, pose: Floats | None) -> ToolPose:
    """Return the tracked target as fitted, or a tool with another pose T_flange_tool (4, 4)."""
    index = np.arange(model.size)
    robot = robot_frames(model, theta)
    if pose is None:
        nominal, tool_model, columns = robot.declared[0], model, index
    else:
        nominal, used = pose, [e for e in model.effects if e.role != "target"]
        parts = [index[s] for e, s in zip(model.effects, model.slices(), strict=True) if e in used]
        columns = np.concatenate([index[:0], *parts])
        cell = replace(model.cell, targets=None, target_names=(), targets_known=())
        cell = replace(cell, target=robot.flange @ pose, target_known=True)
        tool_model = replace(model, cell=cell, effects=tuple(used))
    state = one_of_each(tool_model.cell)
    if tool_model.cell.targets is not None:
        state = replace(state, target=np.zeros(1, dtype=np.int64))
    situation = tool_model.predict(state, theta[columns]).situation
    pairs = list(zip(tool_model.effects, tool_model.slices(), strict=True))
    moving = [
        (e, part)
        for e, part in pairs
        if e.role not in FRAME_ROLES
        and any(c.field in ("target", "base") for c in e.columns(situation))
    ]
    return ToolPose(
        model=tool_model,
        theta=theta[columns],
        columns=columns,
        nominal=nominal,
        pose=robot.flange @ nominal,
        registered=robot.registered,
        base=robot.chain,
        frames=tuple((e, part) for e, part in pairs if e.role == "registration"),
        moving=tuple(moving),
    )


def tool_poses(tool: ToolPose, prediction: Prediction) -> tuple[Floats, Floats]:
    """Orientation (N, 3, 3) and position (N, 3) of the tool in base axes, m."""
    chain, s = prediction.situation.chain, prediction.situation
    deviations = [e.deviation(tool.theta[part], s) for e, part in tool.moving]
    offsets = sum((d.target for d in deviations if d.target is not None), np.zeros((1, 6)))
    flange, offset = chain.rotation[-1], tool.pose[:3, 3] + offsets[:, :3]
    position = chain.point(offset if len(offsets) > 1 else offset[0])
    turned_flange = se3.product(flange, se3.rotation(offsets[:, 3:])) if offsets.any() else flange
    rotation = se3.product(turned_flange, tool.pose[:3, :3])
    if not any(d.base is not None for d in deviations):
        r, p = tool.base[:3, :3], tool.base[:3, 3]
        return se3.product(r, rotation), p + se3.apply(r, position)
    deviations += [e.deviation(tool.theta[part], s) for e, part in tool.frames]
    base = [d.base for d in deviations if d.base is not None]
    r, p = se3.exp(sum(base[1:], base[0]))
    turn = tool.registered[:3, :3]
    r, p = se3.product(turn, r), tool.registered[:3, 3] + se3.apply(turn, p)
    return se3.product(r, rotation), p + se3.apply(r, position)


def in_chain(tool: ToolPose, rotation: Floats, position: Floats) -> tuple[Floats, Floats]:
    """Convert poses (N, 3, 3) and (N, 3) from base axes to the axes of the fitted chain."""
    turn = tool.base[:3, :3].T
    return se3.product(turn, rotation), se3.apply(turn, position - tool.base[:3, 3])
