"""What the tests of the planner's information share."""

import numpy as np

from hilcal.config import CellConfig
from hilcal.readings.readings import Readings
from hilcal.types import Floats
from tests.support.campaigns import configuration, plan


def config_of(
    mode: str = "deflection", *, against: object = (), noise: str = "single", **planning: object
) -> CellConfig:
    """The demo's cell; with `noise` "single" averaging helps nothing, as in the tests' worlds."""
    config = configuration()
    asked = {"readings": mode, "against": against, **planning}
    changed = {"planning": config.planning.model_copy(update=asked)}
    if noise == "single":
        changed["acquire"] = config.acquire.model_copy(update={"systematic_share": 1.0})
    return config.model_copy(update=changed)


def poses_of(count: int, seed: int = 0) -> Floats:
    p = plan(count, seed)
    return np.array([p.states.q[np.flatnonzero(p.pose == k)[0]] for k in range(count)])


def poses_in(readings: Readings) -> Floats:
    """The same, of readings."""
    first = np.unique(readings.pose, return_index=True)[1]
    return readings.states.q[first]


def everything_once(problem) -> np.ndarray:
    """Counts that take every reading of every pose once."""
    if problem.mode == "absolute":
        return np.ones(len(problem.units))
    most = max(len(loads) for _, loads in problem.what)
    return np.array([float(len(loads) == most) for _, loads in problem.what])
