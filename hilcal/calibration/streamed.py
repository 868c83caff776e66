"""A calibration of a fit to a stream."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.stream.fit import StreamFit


def calibration_of_stream(found: StreamFit, source: Mapping[str, Any]) -> Calibration:
    """Return the calibration: parameters and covariance of the stream, ranges of its sample.

    The limit of the standard deviation, beyond which a point is far from all fitted ones, is that
    of the sample, scaled to the number of readings of the stream.
    """
    of_sample = Calibration.of(found.sample, source)
    values, vectors = np.linalg.eigh(found.covariance)
    share = np.sqrt(len(found.sample.readings) / found.readings)
    measured = of_sample.measured
    return replace(
        of_sample,
        model=replace(found.model, readings=None, prior=None),
        theta=found.theta,
        root=vectors * np.sqrt(np.maximum(values, 0.0)),
        measured=replace(measured, most_std_m=float(share * measured.most_std_m)),
        learnt=None,
    )
