"""`tracker_scale`: the tracker's ranges are all too long or too short."""

import numpy as np

from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Situation


class TrackerScale(Effect):
    """Position read = (1 + s) position, about the sensor's origin: refraction, units [1].

    In deflections alone it is the same as a common factor on all compliances.
    """

    name = "tracker_scale"
    summary = "position read = (1 + s) position: the tracker's ranges have a scale error"
    change = Changeable(
        "setup",
        "tracker's scale",
        "the tracker's scale",
        # all links that grow by one factor look alike, but for the tool
        cause="air, instrument, or an arm that is warmer and so longer, by 10 to 30 ppm/K?",
    )
    plausible = 100.0  # 1 mm/m: photogrammetry without a bar; refraction makes 0.05. A choice.
    of_setup = True

    # 10 µm/m is ordinary: 10 °C misjudged in the air.
    parameters = (Parameter("scale", "1", 1e-5, "relative error of the tracker's ranges"),)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit scale."""
        only = np.zeros(1, dtype=np.int64)
        return (Columns("scale", only, only, np.ones((1, 1))),)
