"""What a model could miss, in general: smooth columns that keep a misfit from looking gross.

Each joint moves by smooth functions of its own angle, torque and side of approach, each link
by a constant twist and by the moments that it carries, the target with time.
"""

import numpy as np

from hilcal.data.readings import Readings
from hilcal.data.whitening import Whitening
from hilcal.model import Model, Prediction
from hilcal.observe import motion
from hilcal.types import Floats

MOST_SHARE = 0.35
"""Columns beyond this share of the whitened rows would explain anything."""
FREE = 1e3
"""Prior standard deviation of a column's whole effect, in σ of all data together."""


def generic_columns(
    model: Model, prediction: Prediction, readings: Readings, w: Whitening
) -> Floats:
    """Whitened columns (R, P), each of the length `FREE`; the simplest ones if rows are few."""
    situation, s = prediction.situation, readings.states
    moves = motion(model.cell, prediction.observation, situation.chain, prediction.deviation, w.m)
    one = np.ones_like(situation.angle)
    functions = [one, situation.torque]
    if s.approach is not None:
        functions.append(s.approach)
    functions += [np.cos(situation.angle), np.sin(situation.angle)]
    own = [moves.dq * f[:, None, :] for f in functions]
    links, loads = [], []
    for slot in range(situation.wrench.shape[1]):
        moved = moves.by_slot(slot)
        links.append(moved)
        loads.append(moved[:, :, 3:5] * situation.wrench[:, slot, None, 3:5])
    late = [] if s.time is None else [moves.by_station() * (s.time - s.time.mean())[:, None, None]]
    turns = [moves.dq * f(2 * situation.angle)[:, None, :] for f in (np.cos, np.sin)]
    room = int(MOST_SHARE * w.rank)
    columns = np.concatenate([*own, *late, *loads, *turns, *links], axis=2)[:, :, :room]
    white = w.whiten(w.raw(columns)).reshape(w.m * len(w), -1)
    length = np.linalg.norm(white, axis=0)
    seen = length > 1e-9 * length.max(initial=0.0)
    return np.asarray(white[:, seen] * (FREE / length[seen]))
