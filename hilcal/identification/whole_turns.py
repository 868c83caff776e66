"""Which joints a model does not tell from themselves a whole turn on.

An arm is the same a whole turn of a joint on, and so are waves of whole turns. A law in the angle
itself, as a coupling of joints, is not; nor are cables, which no effect of the catalogue has.
"""

from dataclasses import replace

import numpy as np

from hilcal.identification.robot_frames import random_states
from hilcal.model.model import Model
from hilcal.readings.ranges import FULL_TURN
from hilcal.types import Bools, Floats

SAME = 1e-5
"""m, and of a rotation's elements: by how much a prediction may differ; a choice, what a tracker
hardly sees: a background has a coupling of joints that is smaller."""


def whole_turns(model: Model, theta: Floats) -> Bools:
    """Return whether predictions stay the same a whole turn on, for each of the n joints.

    Args:
        model: the model.
        theta: (P,) its parameters.
    """
    states, n = random_states(model.cell), model.cell.arm.n
    before = model.predict(states, theta).observation
    out = np.zeros(n, dtype=np.bool_)
    for j in range(n):
        on = states.q + FULL_TURN * np.eye(n)[j]
        after = model.predict(replace(states, q=on), theta).observation
        moved = np.abs(after.position - before.position).max()
        out[j] = max(moved, np.abs(after.rotation - before.rotation).max()) <= SAME
    return out
