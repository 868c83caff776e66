"""`thermal_joint_drift`: the joints' zeros wander as they warm up."""

from typing import ClassVar

import numpy as np

from hilcal.effects.options import choice, number, numbers, positive
from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Columns, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats

SOURCES = ("joints", "time")
RISE_K = 10.0  # final rise of joints whose temperatures are not recorded; a choice
WARM_UP_S = 2400.0
"""Time constant of joints whose temperatures are not recorded: robots need one to two hours until
they drift no more. A choice."""


class ThermalJointDrift(PerJoint):
    """dq_j = κ_j ΔT_j, ΔT_j = T_j − T_ref,j with the joint's own temperature [rad/K].

    Where no temperatures of joints are recorded, ΔT_j = 10 K (1 − exp(−t/τ)), t the time since the
    first reading: all joints warm up alike, and κ_j stands for the drift at the end of it.
    """

    name = "thermal_joint_drift"
    unit, size, meaning = "rad/K", 5e-6, "drift of {joint} with the temperature"
    summary = "dq_j = κ_j ΔT_j: the zero of each joint wanders with its temperature"
    plausible = 20.0  # 0.1 mrad/K, 2 mrad for the 20 K that a drive warms up. A choice.
    needs = ("joint_temperature or time",)
    option_help: ClassVar = {
        **PerJoint.option_help,
        "temperature": '"joints", or "time" for a rise by 10 K that is expected of the time; '
        "unless given, joints where the readings have their temperatures.",
        "reference_degC": "T_ref, one number or a list of one per joint; unless given, each "
        "joint's temperature at the first reading in time.",
        "start_s": "with time: when the arm begins to warm up; unless given, the first reading.",
        "time_constant_s": "with time: τ; unless given, 2400.",
    }

    def setup(self, states: States) -> None:
        """Choose temperatures or time, and take what the first reading has as the reference."""
        super().setup(states)
        temperature, time = states.joint_temperature, states.time
        self.options.setdefault("temperature", SOURCES[temperature is None])
        self.source = choice(self.name, self.options, "temperature", SOURCES)
        if self.source == "joints":
            first = 0 if time is None else int(np.argmin(time))
            reference = 0.0 if temperature is None else temperature[first].tolist()
            self.options.setdefault("reference_degC", reference)
            self.reference = numbers(self.name, self.options, "reference_degC", self.cell.arm.n)
        else:
            self.options.setdefault("start_s", 0.0 if time is None else float(time.min()))
            self.options.setdefault("time_constant_s", WARM_UP_S)
            self.start = number(self.name, self.options, "start_s")
            self.time_constant = positive(self.name, self.options, "time_constant_s")
        self._rise(states)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Warming: ∂dq_j/∂κ_j = ΔT_j."""
        return (self.joint_columns("dq", self._rise(s.states)),)

    def _rise(self, states: States) -> Floats:
        """(N, n) ΔT."""
        if self.source == "joints" and states.joint_temperature is not None:
            return np.asarray(states.joint_temperature - self.reference)
        if self.source == "time" and states.time is not None:
            warm = 1.0 - np.exp(-(states.time - self.start) / self.time_constant)
            return np.repeat(RISE_K * warm[:, None], self.cell.arm.n, axis=1)
        raise InputError(
            f"effect {self.name}: temperature = {self.source!r}, which not all readings have; "
            f"valid: {SOURCES[self.source == 'joints']}"
        )
