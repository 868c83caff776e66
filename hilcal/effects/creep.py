"""`creep`: a joint yields further while the load hangs."""

from typing import ClassVar

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.options import Options, choice
from hilcal.effects.per_joint import COMMON, EACH, TorqueLaw
from hilcal.effects.protocol import Columns, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats

TIME_UNIT_S = 1.0  # Unit of time of the law, s


class Creep(TorqueLaw):
    """dq_j = k c_j τ_j log10(1 + t/1 s), t the time under the present load [1 per decade].

    c_j is the joint's compliance: the model's `joint_compliance`, or where the model has
    none a typical one from the joint's rated torque.

    `form`, "common" or "each", is an older name of `joints`.
    """

    name = "creep"
    unit, size, meaning = "1", 0.02, "creep of {joint} per decade of time"
    summary = "dq_j = k c_j τ_j log10(1 + t/1 s): joints go on giving way under the load"
    plausible = 10.0  # 20 % per decade of time: polymers; metals creep by less than 2 %. A choice.
    needs = ("load_time",)
    usual_joints = COMMON
    option_help: ClassVar = {
        "joints": 'which joints share a k: "common", all of them, "each" its own, or groups as '
        "2/3/4-6 (2+5 for joints apart); joints that are not named do not creep. Unless given, "
        "common."
    }

    def __init__(self, cell: Cell, states: States, options: Options | None = None) -> None:
        """Build the effect; raises InputError as every effect does."""
        chosen = dict(options or {})
        if "form" in chosen:
            form = choice(self.name, chosen, "form", (COMMON, EACH))
            if "joints" in chosen:
                raise InputError(f"effect {self.name}: form and joints; valid: joints alone")
            chosen = {**{k: v for k, v in chosen.items() if k != "form"}, "joints": form}
        super().__init__(cell, states, chosen)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The share of the elastic twist that every decade of time adds."""
        if self.shared.text == COMMON:
            return (Parameter("k", "1", self.size, "creep of all joints per decade of time"),)
        return super().parameters

    def _decades(self, s: Situation) -> Floats:
        assert s.states.load_time is not None  # noqa: S101 - checked at construction
        return np.asarray(np.log10(1 + s.states.load_time / TIME_UNIT_S))[:, None]

    def of_torque(self, s: Situation) -> tuple[Floats, Floats]:
        """Return c_j τ_j log10(1 + t/1 s), and c_j log10(1 + t/1 s)."""
        decades = self._decades(s)
        return s.compliance * s.torque * decades, s.compliance * decades

    def compliance_columns(self, theta: Floats, s: Situation) -> tuple[Columns, ...]:
        """Return ∂dq_j/∂c_j = k τ_j log10(1 + t/1 s)."""
        joints = np.arange(self.cell.arm.n)
        values = self.of_joints(theta) * s.torque * self._decades(s)
        return (Columns("dq", joints, joints, values),)
