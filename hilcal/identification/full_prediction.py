"""Prediction of all readings of a fit, those set aside included; and the error before any fit."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.identification.fit import Fit, mahalanobis2
from hilcal.identification.gauss_newton import solve
from hilcal.identification.residual import ErrorBlock, error_block, noise_floor, residual
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, whitening
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class FullPrediction:
    """D measurements, fitted or set aside; the same ones for all fits of equal readings.

    Attributes:
        readings: all readings.
        whitening: their gc-scaling; `whitening.reading` (D,) are rows of `readings`.
        prediction: of all readings.
        raw: (D, m) residual, sensor axes.
        model: the model of the fit.
        theta: (P,) its parameters.
    """

    readings: Readings
    whitening: Whitening
    prediction: Prediction
    raw: Floats
    model: Model
    theta: Floats

    @property
    def mahalanobis2(self) -> Floats:
        """(D,) squared Mahalanobis distance of each measurement by itself."""
        return mahalanobis2(self.raw, self.whitening.covariance)

    @property
    def noise_floor(self) -> float:
        """Root mean square of the 3-D position error under the stated noise alone, m."""
        return noise_floor(self.whitening.covariance)

    def name(self, measurement: int) -> tuple[str, str]:
        """Pose and load of a measurement."""
        return names(self.readings, int(self.whitening.reading[measurement]))

    def target_name(self, measurement: int) -> str:
        """Target of a measurement; '' where there is one."""
        r = self.readings
        if r.states.target is None:
            return ""
        return str(r.target_names[int(r.target[self.whitening.reading[measurement]])])


def names(readings: Readings, row: int) -> tuple[str, str]:
    """Pose and load of a reading."""
    return readings.pose_names[readings.pose[row]], readings.load_names[readings.load[row]]


def full_prediction(fit: Fit) -> FullPrediction:
    """Predict all readings of a fit."""
    if not fit.outlier.any():
        return FullPrediction(
            fit.readings, fit.whitening, fit.solution.prediction, fit.raw, fit.model, fit.theta
        )
    w = whitening(fit.readings, fit.mode, "gc")
    prediction = fit.model.predict(fit.readings.states, fit.theta)
    raw = residual(fit.readings, prediction, w)
    return FullPrediction(fit.readings, w, prediction, raw, fit.model, fit.theta)


@lru_cache(maxsize=1)
def error_before(fit: Fit) -> ErrorBlock:
    """Return the error of the rigid nominal arm at the readings of a fit, m.

    Of deflections it is the deflection itself, which a rigid arm does not have. Of absolute
    readings it is what remains where the unknown frames (registration, target) are fitted to the
    nominal arm alone: those of a fitted model make up for its other parameters, and are wrong for
    the nominal arm by as much.
    """
    used, w = fit.readings[~fit.outlier], fit.whitening
    frames = tuple(x for x in fit.model.effects if x.role in FRAME_ROLES)
    rigid = Model(fit.model.cell, frames if fit.mode == "absolute" else (), fit.model.catalogue)
    theta = np.zeros(0)
    if rigid.effects:
        theta = solve(rigid, used, whitening(used, fit.mode, fit.scaling), None, None).theta
    return error_block(residual(used, rigid.predict(used.states, theta), w), w)
