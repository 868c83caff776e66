"""Limits that are checked at every sample, in motion and at rest."""

from dataclasses import dataclass

import numpy as np

from hilcal.acquire import workspace
from hilcal.acquire.devices import ArmSample
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.robot.chain import evaluate
from hilcal.types import Floats

NORMAL = "normal"
"""The safety state of an arm where all is well."""
SLACK_M = 0.005
"""An arm that sags at the edge of its workspace is not stopped for it, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Guard:
    """The limits of a cell, checked against samples of its devices.

    Attributes:
        cell: the cell.
        config: its limits.
    """

    cell: Cell
    config: CellConfig

    def check(self, sample: ArmSample, felt: Floats | None = None) -> str | None:
        """Return in one line what is wrong, or None.

        Args:
            sample: of the arm.
            felt: (6,) wrench on the force sensor, N and N·m; None where there is none.
        """
        return self.state(sample) or self._speed(sample) or self._place(sample) or self._pull(felt)

    def state(self, sample: ArmSample) -> str | None:
        """Return in one line why a sample is not one of this arm, ready to move; or None."""
        if sample.safety != NORMAL:
            return f"arm: its safety state is {sample.safety}; put that right on the pendant"
        n = self.cell.arm.n
        if sample.q.shape != (n,) or sample.qd.shape != (n,):
            return f"arm: it reports {len(sample.q)} joints; {self.cell.arm.name} has {n}"
        if not (np.isfinite(sample.q).all() and np.isfinite(sample.qd).all()):
            return "arm: it reports joint angles that are not numbers"
        return None

    def _speed(self, sample: ArmSample) -> str | None:
        speed, limit = np.abs(sample.qd), self.config.limits.joint_speed_rad_s
        k = int(np.argmax(speed))
        if speed[k] <= limit:
            return None
        name = self.cell.arm.joint_names[k]
        return f"arm: {name} moves at {speed[k]:.3g} rad/s; joint_speed_rad_s is {limit:g}"

    def _place(self, sample: ArmSample) -> str | None:
        chain = evaluate(self.cell.arm, sample.q[None])
        for name, axis, over, limit in workspace.outside(self.cell, self.config, chain):
            if over[0] > SLACK_M:
                return (
                    f"arm: {name} is {over[0]:.3g} m outside the workspace, whose {axis} ends at "
                    f"{limit:g} m"
                )
        return None

    def _pull(self, felt: Floats | None) -> str | None:
        sensor = self.config.force_sensor
        if felt is None or sensor is None:
            return None
        force, moment = float(np.linalg.norm(felt[:3])), float(np.linalg.norm(felt[3:]))
        # negated, so that what is not a number is refused
        if not force <= sensor.max_force_N:
            return (
                f"force sensor: {force:.4g} N; max_force_N is {sensor.max_force_N:g}. Look what "
                "the arm or its load touches"
            )
        if not moment <= sensor.max_moment_Nm:
            return (
                f"force sensor: {moment:.4g} N·m; max_moment_Nm is {sensor.max_moment_Nm:g}. "
                "Look what the arm or its load touches"
            )
        return None
