"""Which joint angles a cell allows: limits, workspace, clearance, torques under every load."""

from dataclasses import dataclass

import numpy as np

from hilcal.acquire import workspace
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.robot.chain import evaluate
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.types import Bools, Floats

FLOOR = 0.06  # share of the reach that everything beyond the elbow keeps above the base's plane
COLUMN = 0.16  # share of the reach that it keeps from the base's axis
STRETCH = 0.86  # share of the reach beyond which the arm is nearly stretched out
INSIDE = 0.01  # m, kept from every side of the workspace
_BELOW = 0.98  # of the usable torque, for what lies between the sampled points
_STEP = 0.1  # rad, sampling of a motion


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """The states that a plan may use.

    Attributes:
        cell: the cell.
        config: its limits.
        pulls: (L, 6) wrenches that every pose has to bear, base axes, N and N·m.
    """

    cell: Cell
    config: CellConfig
    pulls: Floats

    @property
    def low(self) -> Floats:
        """(n,) lowest usable joint angles, rad; at most half a turn."""
        return np.asarray(np.maximum(self.cell.arm.q_min, -np.pi) + self._margin)

    @property
    def high(self) -> Floats:
        """(n,) highest usable joint angles, rad; at most half a turn."""
        return np.asarray(np.minimum(self.cell.arm.q_max, np.pi) - self._margin)

    @property
    def _margin(self) -> float:
        return self.config.limits.joint_margin_rad + 1e-6

    def clear(self, q: Floats) -> Bools:
        """Return (N,) which states keep inside joint limits and workspace, off floor and column.

        Args:
            q: (N, n) joint angles, rad.
        """
        arm = self.cell.arm
        _, place = workspace.points(self.cell, q)  # flange, target, load point, outer joints
        good = np.all((q >= self.low) & (q <= self.high), axis=1)
        good &= np.all(place[:, :, 2] > FLOOR * arm.reach, axis=1)
        beyond = np.delete(place, len(workspace.TOOL_POINTS), axis=1)  # the elbow may stand above
        good &= np.all(np.hypot(*np.moveaxis(beyond[:, :, :2], -1, 0)) > COLUMN * arm.reach, axis=1)
        for _, _, over, _ in workspace.outside(self.cell, self.config, q):
            good &= over < -INSIDE
        shoulder = arm.links[0][:3, 3]
        good &= np.linalg.norm(place[:, 0] - shoulder, axis=1) < STRETCH * arm.reach
        return np.asarray(good)

    def bears(self, q: Floats) -> Bools:
        """Return (N,) in which states every joint bears every load with the stated share."""
        cell, arm = self.cell, self.cell.arm
        chain = evaluate(arm, q)
        limit = _BELOW * self.config.limits.torque_share * np.asarray(arm.torque_max, dtype=float)
        good = np.ones(len(q), dtype=np.bool_)
        for pull in np.vstack([np.zeros(6), self.pulls]):
            load = Load(
                np.broadcast_to(pull, (len(q), 6)),
                cell.load_point,
                cell.tool_mass,
                cell.tool_com,
                cell.gravity,
            )
            torque = slot_wrenches(arm, chain, load)[:, : arm.n, 5]
            good &= np.all(np.abs(torque) <= limit, axis=1)
        return good

    def passable(self, start: Floats, ends: Floats) -> Bools:
        """Return (N,) to which of `ends` (N, n) a straight motion in joint space is clear.

        Sampled every 0.1 rad of the leading joint; torques are those of every load.
        """
        far = float(np.abs(ends - start).max(initial=0.0))
        share = np.linspace(0.0, 1.0, max(2, int(np.ceil(far / _STEP)) + 1))
        path = start + share[:, None, None] * (ends - start)
        flat = path.reshape(-1, path.shape[-1])
        good = self.clear(flat) & self.bears(flat)
        return np.asarray(good.reshape(len(share), len(ends)).all(axis=0))
