"""`creep`: a joint goes on giving way while the load hangs."""

import numpy as np

from hilcal.data.readings import States
from hilcal.effects.options import choice
from hilcal.effects.protocol import Columns, Effect, Parameter, Response, Situation
from hilcal.types import Floats

SECOND = 1.0
FORMS = ("common", "each")


class Creep(Effect):
    """dq_j = k c_j τ_j log10(1 + t/1 s), t the time under the present load [1 per decade].

    c_j is the joint's compliance: the model's `joint_compliance`, or where the model has
    none a typical one from the joint's rated torque.

    Options:
        form: "common", one k for all joints (default), or "each", one per joint.
    """

    name = "creep"
    summary = "dq_j = k c_j τ_j log10(1 + t/1 s): joints go on giving way under the load"
    elastic = True
    needs = ("load_time",)
    option_names = ("form",)

    def setup(self, states: States) -> None:
        """Read whether the joints share one k."""
        self.options.setdefault("form", "common")
        self.each = choice(self.name, self.options, "form", FORMS) == "each"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The share of the elastic twist that every decade of time adds."""
        if not self.each:
            return (Parameter("k", "1", 0.02, "creep of all joints per decade of time"),)
        return tuple(
            Parameter(f"j{j + 1}", "1", 0.02, f"creep of joint {j + 1} per decade of time")
            for j in range(self.cell.arm.n)
        )

    def _decades(self, s: Situation) -> Floats:
        """(N, 1) log10(1 + t/1 s)."""
        assert s.states.load_time is not None  # noqa: S101 - checked at construction
        return np.asarray(np.log10(1 + s.states.load_time / SECOND))[:, None]

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Elastic twist times decades: ∂dq_j/∂k = c_j τ_j log10(1 + t/1 s)."""
        joints = np.arange(self.cell.arm.n)
        values = s.compliance * s.torque * self._decades(s)
        return (Columns("dq", joints if self.each else 0 * joints, joints, values),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return k c_j log10(1 + t/1 s) dτ_j."""
        slope = theta * s.compliance * self._decades(s)
        return Response(dq=change[:, :, :-1, 5] * slope[:, None, :])

    def compliance_columns(self, theta: Floats, s: Situation) -> tuple[Columns, ...]:
        """Return ∂dq_j/∂c_j = k τ_j log10(1 + t/1 s)."""
        joints = np.arange(self.cell.arm.n)
        return (Columns("dq", joints, joints, theta * s.torque * self._decades(s)),)
