"""Readings with their full covariance: what the file states, and the arm's repeatability."""

from dataclasses import replace
from typing import Literal

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig, Tracker
from hilcal.errors import CannotAnswerError
from hilcal.identification.registration.registration import register
from hilcal.model.model import Model
from hilcal.readings.covariance import (
    INSTRUMENT,
    INSTRUMENT_AND_ARM,
    arrival_factors,
    tracker_covariance,
    tracker_noise,
    with_scatter,
)
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, covariance_blocks, whitening_matrix
from hilcal.tables.uncertainty import rounding_variance, with_rounding
from hilcal.types import Floats

CovarianceParts = Literal[
    "instrument", "instrument and repeatability", "instrument and arm as stated", "as imported"
]
"""What the covariance of a reading consists of, see `readings.covariance`:

- instrument: the arm's scatter is not in it;
- instrument and repeatability: J Σ_q Jᵀ of [repeatability] was added;
- instrument and arm as stated: the table, or the cell, says that the arm's scatter is in it;
- as imported: by an older version, which added nothing.
"""


def full_readings(readings: Readings, covers: str | None, cell: Cell) -> Readings:
    """Return readings as fits take them: whole columns, and the full covariance.

    See `Readings.whole` and `readings.covariance`.

    The arm's repeatability is added where the covariances of a file or a table cover the instrument
    alone; `covers` states what they cover, None for a file that does not state it.
    """
    config, readings = cell.configured(), readings.whole()
    parts = covariance_parts(covers, config)
    joint_std = config.repeatability.per_joint(cell.arm.n)
    if parts == "instrument and repeatability":
        return with_joint_scatter(cell, readings, joint_std)
    if parts == "instrument and arm as stated":
        return with_common_scatter(cell, readings, joint_std)
    return replace(readings, scatter_stated=False)


def with_noise_of(tracker: Tracker, readings: Readings) -> Readings:
    """Return readings with the instrument's covariance that [tracker] states, as imports make it.

    A reading at the tracker's station is refused.
    """
    positioned, station = ~readings.scalar, tracker.station_m or (0.0, 0.0, 0.0)
    if not positioned.any():
        return readings
    position, out = readings.value[positioned, :3], readings.covariance.copy()
    cov = tracker_covariance(position, tracker_noise(tracker), station, readings.m)
    out[positioned] = with_rounding(cov, rounding_variance(position, 1.0))[0]
    return replace(readings, covariance=out)


def covariance_parts(covers: str | None, config: CellConfig) -> CovarianceParts:
    """Return the parts of the full covariance, for stored covariances that cover `covers`."""
    if covers == INSTRUMENT_AND_ARM:
        return "instrument and arm as stated"
    if covers != INSTRUMENT:
        return "as imported"
    stated = bool(np.any(np.asarray(config.repeatability.joint_std_rad) > 0))
    return "instrument and repeatability" if stated else "instrument"


def with_joint_scatter(cell: Cell, readings: Readings, joint_std: Floats) -> Readings:
    """Return the readings with the scatter of the joints added to the instrument's covariance.

    V = V_instrument + R J Σ_q Jᵀ Rᵀ with the Jacobian of the nominal arm, R the orientation of the
    base in the sensor's frame, estimated where it is unknown, and standard deviations (n,) from one
    arrival to the next, rad. Readings with too few poses for that are returned as they are. Targets
    read in one arrival have the scatter in common (`Readings.common`).
    """
    factor = _scatter(cell, readings, joint_std)
    return readings if factor is None else with_scatter(readings, factor)


def with_common_scatter(cell: Cell, readings: Readings, joint_std: Floats) -> Readings:
    """Return readings whose covariances include the joints' scatter, with its factors `common`.

    Only readings of several targets or observers have it in common. The factor F of a reading is
    reduced where F Fᵀ exceeds its covariance.
    """
    s = readings.states
    several = s.target is not None or s.observer is not None
    factor = _scatter(cell, readings, joint_std) if several else None
    if factor is None:
        return readings
    largest = np.linalg.norm(whitening_matrix(readings.covariance) @ factor, ord=2, axis=(1, 2))
    return replace(readings, common=factor / np.maximum(largest, 1.0)[:, None, None])


def _scatter(cell: Cell, readings: Readings, joint_std: Floats) -> Floats | None:
    """Factors (N, m, n) of the joints' scatter; None for none, or an unknown registration."""
    if not np.any(joint_std):
        return None
    try:
        registered = register(cell, readings).cell
    except CannotAnswerError:
        return None
    return joint_factors(registered, readings, joint_std)


def whitened_blocks(readings: Readings, w: Whitening) -> list[Floats]:
    """Return the covariance (G, S, S) of each bucket of a scaling, whitened by it."""
    parts = zip(w.buckets, covariance_blocks(readings, w), strict=True)
    return [b.factor @ c @ np.swapaxes(b.factor, 1, 2) for b, c in parts]


def joint_factors(cell: Cell, readings: Readings, joint_std: Floats) -> Floats:
    """Factors F (N, m, n) of the joints' scatter (n,), rad, with frames as they are in the cell."""
    offset = cell.target_of(readings.states.target)[..., :3, 3]
    turn = cell.registration[:3, :3]
    if readings.states.observer is not None:
        cell = cell if cell.observers else register(cell, readings).cell
        observation = Model(cell, ()).predict(readings.states, np.zeros(0)).observation
        turn = observation.axes
    return arrival_factors(cell.arm, readings, offset, turn, joint_std)
