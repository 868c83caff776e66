"""`thermal_joint_drift`: the joints' zeros wander as they warm up."""

from typing import ClassVar

import numpy as np

from hilcal.effects.options import numbers
from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Columns, Situation
from hilcal.readings.readings import States


class ThermalJointDrift(PerJoint):
    """dq_j = κ_j ΔT_j, ΔT_j = T_j − T_ref,j with the joint's own temperature [rad/K]."""

    name = "thermal_joint_drift"
    unit, size, meaning = "rad/K", 5e-6, "drift of {joint} with the temperature"
    summary = "dq_j = κ_j ΔT_j: the zero of each joint wanders with its temperature"
    plausible = 20.0  # 0.1 mrad/K, 2 mrad for the 20 K that a drive warms up. A choice.
    needs = ("joint_temperature",)
    option_help: ClassVar = {
        **PerJoint.option_help,
        "reference_degC": "T_ref, one number or a list of one per joint; unless given, each "
        "joint's temperature at the first reading in time.",
    }

    def setup(self, states: States) -> None:
        """Take the temperatures at the first reading as the reference unless given."""
        super().setup(states)
        temperature = states.joint_temperature
        assert temperature is not None  # noqa: S101 - checked at construction
        if "reference_degC" not in self.options:
            first = 0 if states.time is None else int(np.argmin(states.time))
            self.options["reference_degC"] = temperature[first].tolist()
        self.reference = numbers(self.name, self.options, "reference_degC", self.cell.arm.n)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Warming: ∂dq_j/∂κ_j = ΔT_j."""
        assert s.states.joint_temperature is not None  # noqa: S101 - checked at construction
        return (self.joint_columns("dq", s.states.joint_temperature - self.reference),)
