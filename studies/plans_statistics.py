"""Statistics of many simulated campaigns of a plan, with the uncertainty of the simulation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.design.predicted import rms
from hilcal.types import Floats
from studies.plans_errors import Errors


@dataclass(frozen=True, slots=True)
class MeanAndStd:
    """A figure from simulated campaigns with the standard uncertainty of the simulation."""

    value: float
    std: float


@dataclass(frozen=True, slots=True)
class Summary:
    """Campaigns of one kind of plan.

    Attributes:
        campaigns: number of campaigns.
        readings: mean number of readings.
        poses: mean number of different poses.
        parameter: predicted error, geometric mean over the parameters of RMS over campaigns,
            as a share of the ordinary value.
        parameter_real: the same of the true errors.
        spread: RMS of true over predicted error, over campaigns and parameters; 1 where the
            prediction is right.
        position: predicted RMS error at the test poses, m.
        position_real: true RMS error, m.
    """

    campaigns: int
    readings: float
    poses: float
    parameter: float
    parameter_real: MeanAndStd
    spread: MeanAndStd
    position: float
    position_real: MeanAndStd

    @property
    def position_ratio(self) -> MeanAndStd:
        """True over predicted error at the test poses."""
        real = self.position_real
        return MeanAndStd(real.value / self.position, real.std / self.position)


def summary(errors: Sequence[Errors]) -> Summary:
    """Summarise campaigns.

    The uncertainty of a root of a mean of n squares s_c is std(s) / (2 sqrt(mean(s) n)); that of
    the geometric mean follows to first order from the mean of logarithms.
    """
    square = np.array([e.parameter**2 for e in errors])
    std2 = np.array([e.std**2 for e in errors])
    ordinary = errors[0].ordinary
    real = np.sqrt(square.mean(axis=0)) / ordinary
    predicted = np.sqrt(std2.mean(axis=0)) / ordinary
    mean = float(np.exp(np.mean(np.log(real))))
    influence = 0.5 * (square / square.mean(axis=0)).mean(axis=1)
    return Summary(
        campaigns=len(errors),
        readings=float(np.mean([e.readings for e in errors])),
        poses=float(np.mean([e.poses for e in errors])),
        parameter=float(np.exp(np.mean(np.log(predicted)))),
        parameter_real=MeanAndStd(mean, mean * _of_mean(influence)),
        spread=_root((square / std2).mean(axis=1)),
        position=rms(np.array([e.position_std for e in errors])),
        position_real=_root(np.array([e.position**2 for e in errors])),
    )


def _root(squares: Floats) -> MeanAndStd:
    """Root of the mean of squares (n,), with its uncertainty."""
    value = float(np.sqrt(squares.mean()))
    return MeanAndStd(value, _of_mean(squares) / (2.0 * value))


def _of_mean(values: Floats) -> float:
    """Standard uncertainty of a mean; nan for a single value."""
    if len(values) < 2:
        return float("nan")
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))
