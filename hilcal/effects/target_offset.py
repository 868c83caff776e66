"""`target_offset`: the tracked target sits elsewhere than configured."""

from typing import ClassVar

import numpy as np

from hilcal.data.readings import States
from hilcal.effects.options import PRIOR_HELP, Options, prior_of_lengths_and_turns
from hilcal.effects.protocol import Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.types import Floats


class TargetOffset(Effect):
    """Displacement of the target in flange axes [m]; with `rotation`, its rotation too [rad]."""

    name = "target_offset"
    summary = "the tracked target sits elsewhere on the flange than configured"
    option_help: ClassVar = {
        "rotation": "True where the readings are poses, so that the target's axes matter.",
        **PRIOR_HELP,
    }
    role = "target"

    def setup(self, states: States) -> None:
        """Read whether rotations take part."""
        rotation = self.options.get("rotation", False)
        if not isinstance(rotation, bool):
            raise InputError(f"effect {self.name}: rotation = {rotation!r}; valid: true, false")
        self.size = 6 if rotation else 3

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Displacement along, and with `rotation` rotation about, the flange's axes."""
        lengths = [Parameter(a, "m", 1e-3, f"offset along flange {a}") for a in "xyz"]
        turns = [Parameter(f"r{a}", "rad", 1e-3, f"turn about flange {a}") for a in "xyz"]
        return tuple((lengths + turns)[: self.size])

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit displacements of the target."""
        index = np.arange(self.size)
        return (Columns("target", index, 0 * index, np.eye(6)[None, : self.size]),)

    @classmethod
    def usual_options(cls, m: int) -> Options:
        """Return `rotation` where readings are poses."""
        return {"rotation": True} if m == 6 else {}

    def prior_std(self) -> Floats | None:
        """Prior of displacement and rotation, where given."""
        return prior_of_lengths_and_turns(self.name, self.options, self.size)
