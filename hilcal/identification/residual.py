"""Residuals, measured − predicted, of readings or deflections, and their error blocks."""

from dataclasses import asdict, dataclass

import numpy as np
import scipy

from hilcal.model.model import Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, measured_values, relative_rotation
from hilcal.robot import se3
from hilcal.shown import Brief
from hilcal.types import Floats

CONFIDENCE = 0.95


def residual(readings: Readings, prediction: Prediction, w: Whitening) -> Floats:
    """Measured − predicted (D, m).

    The rotation part of a pose reading is Log(R_measured R_predictedᵀ), a small rotation in
    sensor axes; of a deflection it is the difference of the relative rotations.
    """
    o = prediction.observation
    position = w.raw(readings.value[:, :3] - o.position)
    if w.m == 3:
        return position
    if w.mode == "deflection":
        turn = measured_values(readings, w)[:, 3:] - relative_rotation(o.rotation, w)
    else:
        read = se3.rotation(readings.value[:, 3:])
        turn = w.raw(se3.rotation_vector(read @ np.swapaxes(o.rotation, 1, 2)))
    return np.concatenate([position, turn], axis=1)


@dataclass(frozen=True, slots=True)
class ErrorBlock:
    """Position error per measurement, and the whitened residual."""

    rms_m: float  # root mean square of the 3-D position error, m
    mean_m: float  # its mean, m
    max_m: float  # its maximum, m
    rms_sigma: float  # root mean square of the whitened elements, pure number

    @classmethod
    def of(cls, raw: Floats, white: Floats, rank: int) -> "ErrorBlock":
        """Summarise residuals (D, m) and whitened elements, `rank` of them with information."""
        distance = np.linalg.norm(raw[:, :3], axis=1)
        return cls(
            rms_m=float(np.sqrt(np.mean(distance**2))),
            mean_m=float(distance.mean()),
            max_m=float(distance.max()),
            rms_sigma=float(np.linalg.norm(white) / np.sqrt(max(rank, 1))),
        )

    def to_json(self) -> dict[str, float]:
        """Keys and values of the contract."""
        return asdict(self)


def error_block(raw: Floats, w: Whitening) -> ErrorBlock:
    """Summarise residuals (D, m) and their whitened elements."""
    return ErrorBlock.of(raw, w.whiten(raw), w.rank)


def noise_floor(covariance: Floats) -> float:
    """Root mean square of the 3-D position error under covariances (D, m, m) alone, m."""
    return float(np.sqrt(np.mean(np.trace(covariance[:, :3, :3], axis1=1, axis2=2))))


class WithVarianceFactor(Brief):
    """Base of classes with a whitened sum of squares and its degrees of freedom."""

    __slots__ = ()

    chi2: float
    dof: float

    @property
    def variance_factor(self) -> float:
        """χ²/dof of the gc-whitened residual; 1 where model and noise are right."""
        return self.chi2 / self.dof

    @property
    def variance_factor_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the variance factor."""
        return variance_interval(self.chi2, self.dof)


def variance_interval(total: float, dof: float) -> tuple[float, float]:
    """95 % confidence interval of χ²/dof."""
    tail = (1 - CONFIDENCE) / 2
    return float(total / scipy.stats.chi2.isf(tail, dof)), float(
        total / scipy.stats.chi2.ppf(tail, dof)
    )
