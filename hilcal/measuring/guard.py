"""Limits that are checked at every sample, in motion and at rest."""

from dataclasses import dataclass, field

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.measuring.devices import ArmSample
from hilcal.measuring.feasibility import Feasibility, Margins
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

NORMAL = "normal"
"""The safety state of an arm where all is well."""
HOW_ON = "drive it by hand to a free place in the middle of its workspace"
SLACK_M = 0.005
"""An arm that sags at the edge of its workspace is not stopped for it, m."""
SLACK = Margins(joint=-0.01, inside=-SLACK_M, clear=0.0, itself=0.0, bear=1.02)
"""How much less is kept in motion than in a dry run: an arm sags and follows late, and a motion is
checked at samples. Nothing may touch."""


@dataclass(frozen=True, slots=True, eq=False)
class Guard:
    """The limits of a cell, checked against samples of its devices.

    Attributes:
        cell: the cell.
        config: its limits.
    """

    cell: Cell
    config: CellConfig
    _limits: Feasibility = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Build the shapes once."""
        object.__setattr__(self, "_limits", Feasibility(self.cell, self.config, SLACK))

    def check(
        self, sample: ArmSample, felt: Floats | None = None, hanging: str = UNLOADED
    ) -> str | None:
        """Return in one line what is wrong, or None.

        Args:
            sample: of the arm.
            felt: (6,) wrench on the force sensor, N and N·m; None where there is none.
            hanging: name of the load that hangs.
        """
        return (
            self.state(sample)
            or self._speed(sample)
            or self._place(sample.q, hanging)
            or self._pull(felt)
        )

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

    def _place(self, q: Floats, hanging: str) -> str | None:
        found = next(self._limits.findings(q[None], hanging), None)
        return None if found is None else f"{found.at('arm')}; {HOW_ON}"

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
