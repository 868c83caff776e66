"""What a model fitted to the readings so far says of the last one."""

from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.data.readings import Readings
from hilcal.data.whitening import whitening
from hilcal.errors import HilcalError
from hilcal.identify.baseline import baseline
from hilcal.identify.fit import mahalanobis2
from hilcal.identify.gauss_newton import solve
from hilcal.identify.poses import distinct_poses
from hilcal.identify.repeatability import with_repeatability
from hilcal.identify.residual import residual
from hilcal.model import Model
from hilcal.types import Floats

LEAST = 8
"""Distinct poses before a registration is worth believing."""
GROWTH = 1.15
"""The model is fitted again when there are so many times as many readings."""


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """A model as fitted to the first readings of a campaign."""

    model: Model
    theta: Floats
    count: int
    loaded: bool


class LiveResidual:
    """Predicts each reading from those before it, by the frames and joint compliance.

    The residual is what this baseline model gets wrong of the newest reading, which took no
    part in its fit. It is for the eye of the operator, so the fit is renewed now and then only.
    """

    def __init__(self, cell: Cell, config: CellConfig) -> None:
        """Prepare for a cell."""
        self._cell = cell
        self._scatter = config.repeatability.per_joint(cell.arm.n)
        self._known: _Known | None = None

    def __call__(self, readings: Readings) -> tuple[float, float] | None:
        """Return the residual of the last reading in m and in sigma; None while it is unknown.

        Sigma is sqrt(rᵀ V⁻¹ r / m): about 1 where the model is right.
        """
        readings = with_repeatability(self._cell, readings, self._scatter)
        before, last = readings[:-1], readings[-1:]
        try:
            known = self._renewed(before)
            if known is None or (not known.loaded and np.any(last.states.wrench)):
                return None
            w = whitening(last, "absolute", "gc")
            off = residual(last, known.model.predict(last.states, known.theta), w)
        except HilcalError:
            return None
        sigma = float(np.sqrt(mahalanobis2(off, last.covariance)[0] / last.m))
        return float(np.linalg.norm(off[0, :3])), sigma

    def _renewed(self, readings: Readings) -> _Known | None:
        """Return the model, fitted anew where much has come since."""
        known, count = self._known, len(readings)
        loaded = bool(np.any(readings.states.wrench))
        stale = known is None or loaded != known.loaded or count > GROWTH * known.count
        if stale and len(np.unique(distinct_poses(readings))) >= LEAST:
            model = baseline(self._cell, readings, "absolute")
            found = solve(model, readings, whitening(readings, "absolute", "gc"))
            self._known = _Known(model, found.theta, count, loaded)
        return self._known
