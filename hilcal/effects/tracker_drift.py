"""`tracker_drift`: the tracker's station moves while the campaign runs."""

from typing import ClassVar

import numpy as np

from hilcal.effects.options import number, positive
from hilcal.effects.protocol import Columns, Effect, Parameter, Situation
from hilcal.readings.readings import States
from hilcal.types import Floats


class TrackerDrift(Effect):
    """Station twist that grows linearly with time, sensor axes [m/s, rad/s].

    After the last reading of the fit the station stays where it is then: how it moves further is
    not known, and a rate of a few micrometres per hour would be millimetres weeks later.
    """

    name = "tracker_drift"
    summary = "the tracker's station moves linearly in time"
    plausible = 20.0  # 4 mm, 4 mrad over the campaign: a tripod on a soft floor. A choice.
    of_setup = True
    needs = ("time",)
    option_help: ClassVar = {
        "reference_s": "the time at which the station stands as registered; unless given, the "
        "time of the first reading.",
        "span_s": "the time over which a drift of ordinary size is reached; unless given, that of "
        "the readings.",
        "until_s": "the time from which the station stays where it is; unless given, that of the "
        "last reading.",
    }

    def setup(self, states: States) -> None:
        """Take the time of the first reading as the reference unless given."""
        assert states.time is not None  # noqa: S101 - checked at construction
        self.options.setdefault("reference_s", float(states.time.min()))
        self.options.setdefault("span_s", max(float(np.ptp(states.time)), 1.0))
        self.options.setdefault("until_s", float(states.time.max()))
        self.reference = number(self.name, self.options, "reference_s")
        self.span = positive(self.name, self.options, "span_s")
        self.until = number(self.name, self.options, "until_s")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Rates of displacement and rotation; 0.2 mm and 0.2 mrad over the campaign."""
        units = (("", "m/s"), ("r", "rad/s"))
        return tuple(Parameter(f"{r}{a}", u, 2e-4 / self.span) for r, u in units for a in "xyz")

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit twists times the time since the reference, until the station stays."""
        assert s.states.time is not None  # noqa: S101 - checked at construction
        elapsed: Floats = np.minimum(s.states.time, self.until) - self.reference
        index = np.arange(6)
        return (Columns("station", index, 0 * index, elapsed[:, None, None] * np.eye(6)),)
