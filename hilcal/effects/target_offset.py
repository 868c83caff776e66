"""`target_offset`: the tracked target sits elsewhere than configured."""

from dataclasses import replace
from typing import ClassVar

import numpy as np

from hilcal.effects.options import PRIOR_HELP, Options
from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats


class TargetOffset(Effect):
    """Displacement of the target in flange axes [m]; with `rotation`, its rotation too [rad].

    Of several targets, each one of unknown offset has its own displacement; where all offsets are
    known, each target has.
    """

    name = "target_offset"
    summary = "the tracked target sits elsewhere on the flange than configured"
    change = Changeable("setup", "target", "the target's place on the tool")
    plausible = 10.0  # 10 mm, 10 mrad: a target that was mounted anew. A choice.
    of_setup = True
    option_help: ClassVar = {
        "rotation": "True where the readings are poses, so that the target's axes matter.",
        **PRIOR_HELP,
    }
    role = "target"

    def setup(self, states: States) -> None:
        """Read whether rotations are estimated."""
        rotation = self.options.get("rotation", False)
        if not isinstance(rotation, bool):
            raise InputError(f"effect {self.name}: rotation = {rotation!r}; valid: true, false")
        self.size = 6 if rotation else 3
        known = self.cell.known_targets
        self.moved = [k for k in range(len(known)) if all(known) or not known[k]]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Displacement along, and with `rotation` rotation about, the flange's axes."""
        lengths = [Parameter(a, "m", 1e-3, f"offset along flange {a}") for a in "xyz"]
        turns = [Parameter(f"r{a}", "rad", 1e-3, f"turn about flange {a}") for a in "xyz"]
        axes = (lengths + turns)[: self.size]
        if self.cell.targets is None:
            return tuple(axes)
        names = [self.cell.target_names[k] for k in self.moved]
        return tuple(
            replace(p, name=f"{name}.{p.name}", meaning=f"{name}: {p.meaning}")
            for name in names
            for p in axes
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit displacements of each target, in the readings of it."""
        index = np.arange(self.size * len(self.moved))
        unit = np.eye(6)[None, : self.size]
        if self.cell.targets is None:
            return (Columns("target", index, 0 * index, unit),)
        number = s.states.target
        read = np.zeros(len(s.angle), dtype=np.int64) if number is None else number
        parts = [(read == k)[:, None, None] * unit for k in self.moved]
        return (Columns("target", index, 0 * index, np.concatenate(parts, axis=1)),)

    def displaced(self, theta: Floats) -> Floats:
        """T_flange_target (T, 4, 4) with displacements theta (P,); turns are not applied."""
        poses = self.cell.all_targets.copy()
        poses[self.moved, :3, 3] += theta.reshape(len(self.moved), self.size)[:, :3]
        return poses

    @classmethod
    def usual_options(cls, m: int) -> Options:
        """Return `rotation` where readings are poses."""
        return {"rotation": True} if m == 6 else {}
