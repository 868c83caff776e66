"""Where the tool is by a model: the arm's own pose in base axes, without the instruments.

    T_base_tool = T_base_chain T_chain_flange(q, w) T_chainflange_flange T_flange_tool

Base and flange are those that `identification.robot_frames` declares. What instruments do (fields
"station" and "scale") is no motion of the tool.
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
    """What is to be put somewhere."""

    model: Model  # whose target is the tool; without effects that place another target
    theta: Floats  # (P,) its parameters
    kept: Ints  # (P,) which of the parameters of the fitted model they are
    nominal: Floats  # (4, 4) T_flange_tool
    pose: Floats  # (4, 4) T_chainflange_tool, the same on the flange of the fitted chain
    registered: Floats  # (4, 4) from the axes of the registration to those of the base
    base: Floats  # (4, 4) from the axes of the chain to those of the base, constant effects alone
    frames: tuple[tuple[Effect, slice], ...]
    """Effects that say where the base is, with their parameters."""
    moving: tuple[tuple[Effect, slice], ...]
    """Effects that move base or target and are no frames, with their parameters."""


def tool_of(model: Model, theta: Floats, pose: Floats | None) -> ToolPose:
    """Return the tracked target as fitted, or a tool with another pose T_flange_tool (4, 4)."""
    every = np.arange(model.size)
    at = robot_frames(model, theta)
    if pose is None:
        nominal, own, kept = at.declared[0], model, every
    else:
        nominal, named = pose, [e for e in model.effects if e.role != "target"]
        parts = [every[s] for e, s in zip(model.effects, model.slices(), strict=True) if e in named]
        kept = np.concatenate([every[:0], *parts])
        cell = replace(model.cell, targets=None, target_names=(), targets_known=())
        cell = replace(cell, target=at.flange @ pose, target_known=True)
        own = replace(model, cell=cell, effects=tuple(named))
    state = one_of_each(own.cell)
    if own.cell.targets is not None:
        state = replace(state, target=np.zeros(1, dtype=np.int64))
    situation = own.predict(state, theta[kept]).situation
    pairs = list(zip(own.effects, own.slices(), strict=True))
    moving = [
        (e, mine)
        for e, mine in pairs
        if e.role not in FRAME_ROLES
        and any(c.field in ("target", "base") for c in e.columns(situation))
    ]
    return ToolPose(
        model=own,
        theta=theta[kept],
        kept=kept,
        nominal=nominal,
        pose=at.flange @ nominal,
        registered=at.registered,
        base=at.chain,
        frames=tuple((e, mine) for e, mine in pairs if e.role == "registration"),
        moving=tuple(moving),
    )


def tool_poses(tool: ToolPose, prediction: Prediction) -> tuple[Floats, Floats]:
    """Orientation (N, 3, 3) and position (N, 3) of the tool in base axes, m."""
    chain, s = prediction.situation.chain, prediction.situation
    moved = [e.deviation(tool.theta[mine], s) for e, mine in tool.moving]
    own = sum((d.target for d in moved if d.target is not None), np.zeros((1, 6)))
    flange, offset = chain.rotation[-1], tool.pose[:3, 3] + own[:, :3]
    position = chain.point(offset if len(own) > 1 else offset[0])
    turned = se3.product(flange, se3.rotation(own[:, 3:])) if own.any() else flange
    rotation = se3.product(turned, tool.pose[:3, :3])
    if not any(d.base is not None for d in moved):
        r, p = tool.base[:3, :3], tool.base[:3, 3]
        return se3.product(r, rotation), p + se3.apply(r, position)
    moved += [e.deviation(tool.theta[mine], s) for e, mine in tool.frames]
    base = [d.base for d in moved if d.base is not None]
    r, p = se3.exp(sum(base[1:], base[0]))
    turn = tool.registered[:3, :3]
    r, p = se3.product(turn, r), tool.registered[:3, 3] + se3.apply(turn, p)
    return se3.product(r, rotation), p + se3.apply(r, position)


def in_chain(tool: ToolPose, rotation: Floats, position: Floats) -> tuple[Floats, Floats]:
    """Poses (N, 3, 3) and (N, 3) in the axes of the fitted chain, from those in base axes."""
    turn = tool.base[:3, :3].T
    return se3.product(turn, rotation), se3.apply(turn, position - tool.base[:3, 3])
