"""What the tests of the planner's information share."""

import numpy as np

from hilcal.design.information import problem
from hilcal.design.nominal_model import nominal_model
from tests.support.campaigns import configuration, plan


def changed(config, **sections):
    """The configuration with other keys in some sections."""
    update = {name: getattr(config, name).model_copy(update=k) for name, k in sections.items()}
    return config.model_copy(update=update)


def config_of(mode="deflection", *, against=(), noise="single", **planning):
    """The demo's cell; with `noise` "single" averaging helps nothing, as in the tests' worlds."""
    acquire = {"systematic_share": 1.0} if noise == "single" else {}
    asked = {"readings": mode, "against": against, **planning}
    return changed(configuration(), planning=asked, acquire=acquire)


def problem_of(cell, q, **options):
    """The design problem of poses, before any reading."""
    return problem(nominal_model(cell), cell.configured(), q, **options)


def poses_of(count, seed=0):
    p = plan(count, seed)
    return np.array([p.states.q[np.flatnonzero(p.pose == k)[0]] for k in range(count)])


def poses_in(readings):
    """The same, of readings."""
    first = np.unique(readings.pose, return_index=True)[1]
    return readings.states.q[first]


def everything_once(problem):
    """Counts that take every reading of every pose once."""
    if problem.mode == "absolute":
        return np.ones(len(problem.units))
    most = max(len(loads) for _, loads in problem.contents)
    return np.array([float(len(loads) == most) for _, loads in problem.contents])
