"""Error blocks: how far the model is from the measurements."""

from dataclasses import asdict, dataclass

import numpy as np

from hilcal.readings.whitening import Whitening
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class ErrorBlock:
    """Position error per measurement, and the whitened residual.

    Attributes:
        rms_m: root mean square of the 3-D position error, m.
        mean_m: its mean, m.
        max_m: its maximum, m.
        rms_sigma: root mean square of the whitened elements, pure number.
    """

    rms_m: float
    mean_m: float
    max_m: float
    rms_sigma: float

    def to_json(self) -> dict[str, float]:
        """Keys and values of the contract."""
        return asdict(self)


def error_block(raw: Floats, w: Whitening) -> ErrorBlock:
    """Summarise residuals (D, m) and their whitened elements."""
    distance = np.linalg.norm(raw[:, :3], axis=1)
    return ErrorBlock(
        rms_m=float(np.sqrt(np.mean(distance**2))),
        mean_m=float(distance.mean()),
        max_m=float(distance.max()),
        rms_sigma=float(np.linalg.norm(w.whiten(raw)) / np.sqrt(max(w.rank, 1))),
    )


def noise_floor(covariance: Floats) -> float:
    """Root mean square of the 3-D position error under covariances (D, m, m) alone, m."""
    return float(np.sqrt(np.mean(np.trace(covariance[:, :3, :3], axis1=1, axis2=2))))
