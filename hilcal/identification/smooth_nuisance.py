"""Smooth nuisance columns, so that data snooping does not take a misfit for gross errors.

Joint displacements by smooth functions of the joint's angle, torque and side of approach; link
twists, constant and by the moments that the link carries; a drift of the target with time.
"""

import numpy as np

from hilcal.model.model import Model, Prediction
from hilcal.model.observe import motion
from hilcal.readings.readings import Readings
from hilcal.types import Floats

MOST_SHARE = 0.35
"""Most columns, as a share of the whitened rows; a choice, no study set it."""


def smooth_nuisance_columns(
    model: Model, prediction: Prediction, readings: Readings, rank: int
) -> Floats:
    """Columns (N, m, P); only the simplest ones where the `rank` of the readings is small."""
    situation, s = prediction.situation, readings.states
    moves = motion(
        model.cell, prediction.observation, situation.chain, prediction.deviation, readings.m
    )
    one = np.ones_like(situation.angle)
    functions = [one, situation.torque]
    if s.approach is not None:
        functions.append(s.approach)
    functions += [np.cos(situation.angle), np.sin(situation.angle)]
    joints = [moves.drives * f[:, None, :] for f in functions]
    links, loads = [], []
    for slot in range(situation.wrench.shape[1]):
        moved = moves.by_slot(slot)
        links.append(moved)
        loads.append(moved[:, :, 3:5] * situation.wrench[:, slot, None, 3:5])
    drift = [] if s.time is None else [moves.by_station() * (s.time - s.time.mean())[:, None, None]]
    harmonics = [moves.drives * f(2 * situation.angle)[:, None, :] for f in (np.cos, np.sin)]
    most = int(MOST_SHARE * rank)
    return np.concatenate([*joints, *drift, *loads, *harmonics, *links], axis=2)[:, :, :most]
