"""`observer_frame`: one of several observers stands elsewhere than described."""

from typing import ClassVar

import numpy as np

from hilcal.effects.link_geometry import AXES
from hilcal.effects.options import PRIOR_HELP
from hilcal.effects.protocol import Columns, Effect, Parameter, Situation
from hilcal.readings.readings import States


class ObserverFrame(Effect):
    """Twist of the position in the axes of an observer [m, rad], and offset of a distance [m].

    Estimated are the unknown elements of each observer's place; where all places are known, all
    elements that the readings determine. The shift of a point is that of the point itself.
    """

    name = "observer_frame"
    summary = "one of several stations, points or gauges stands elsewhere than described"
    plausible = 20.0  # 20 mm, 20 mrad, as of `base_frame`. A choice.
    of_setup = True
    option_help: ClassVar = PRIOR_HELP
    role = "observer"

    def setup(self, states: States) -> None:
        """Choose the elements that are estimated."""
        observable = {"station": range(6), "point": range(3), "gauge": (0, 4, 5)}
        unknown = any(o.free for o in self.cell.observers)
        self.free = [
            (k, element)
            for k, o in enumerate(self.cell.observers)
            for element in (o.free if unknown else observable[o.name.kind])
        ]

    @classmethod
    def computable(cls, states: States) -> bool:
        """Whether readings name their observers; a prediction without observers needs no effect."""
        return states.observer is not None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Shift, turn and offset, as far as they are unknown."""
        out = []
        for k, element in self.free:
            o, axis = self.cell.observers[k].name, AXES[element]
            unit = "m" if element < 3 else "rad"
            meaning = f"turn about {axis[-1]}" if element > 2 else f"shift along {axis}"
            if o.kind == "point" and element == 3:
                axis, unit, meaning = "offset", "m", "offset of the distance"
            out.append(Parameter(f"{o.name}.{axis}", unit, 1e-3, f"{o}: {meaning}"))
        return tuple(out)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit twists of each observer, in its readings."""
        index = np.arange(len(self.free))
        values = np.zeros((len(s.angle), len(index), 6))
        if s.states.observer is not None:
            for p, (k, element) in enumerate(self.free):
                away = self.cell.observers[k].name.kind == "point" and element < 3
                values[s.states.observer == k, p, element] = -1.0 if away else 1.0
        return (Columns("observer", index, 0 * index, values),)
