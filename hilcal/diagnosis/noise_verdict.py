"""Whether the stated noise is to blame, where no effect is.

An effect is judged against the scatter as it is (F-tests), so a noise that is misjudged as a
whole names none. What remains is a χ² that is too large or too small:

- too small: no model makes residuals smaller than the noise; the statement is too large;
- too large, and repeats scatter as much: the statement is too small;
- too large, and repeats scatter less: the model misses something;
- too large, without enough repeats: the noise only where nothing at all predicts the residual;
  it cannot be known without repeats.
"""

from dataclasses import dataclass
from typing import Literal

from scipy.stats import chi2

from hilcal.diagnosis.noise import PureError
from hilcal.identification.fit import Fit

MISFIT_ALARM = 0.0005
"""Chance of calling the variance factor wrong where it is right, each side."""
PREDICTABLE = 0.1
"""Share s of the misfit that must be predictable for the model to be to blame. The predictable part
is then a third of the rest in standard deviation, s / (1 - s) = 1/9: a standard uncertainty of less
than a third of the largest one need not be evaluated in detail (Eurachem/CITAC Guide CG 4,
*Quantifying uncertainty in analytical measurement*, 3rd ed. 2012)."""

NoiseReason = Literal["as_stated", "repeats", "too_large", "lack_of_fit", "predictable", "unknown"]
"""Why the noise is, or is not, to blame:

- as_stated: χ² is what chance allows;
- repeats: repeated readings scatter as much, or as little, as the residuals;
- too_large: the residuals are smaller than stated;
- lack_of_fit: repeated readings scatter less than the residuals;
- predictable: something predicts the residual on poses left out;
- unknown: nothing predicts it, and there are too few repeats to know.
"""


@dataclass(frozen=True, slots=True)
class NoiseVerdict:
    """Whether the stated covariance is to blame for a variance factor.

    Attributes:
        reason: what decided.
    """

    reason: NoiseReason

    @property
    def misjudged(self) -> bool:
        """Whether the stated noise is to blame."""
        return self.reason in ("repeats", "too_large", "unknown")

    @property
    def off(self) -> bool:
        """Whether the variance factor is not what chance allows."""
        return self.reason != "as_stated"


def judge_noise(fit: Fit, repeats: PureError | None, predictable: bool) -> NoiseVerdict:
    """Judge the noise of a fit in which no effect is found missing.

    Args:
        fit: the fit.
        repeats: the scatter of repeated readings.
        predictable: whether anything predicts the residual on poses left out.
    """
    high = float(chi2.sf(fit.chi2, fit.dof)) < MISFIT_ALARM
    low = float(chi2.cdf(fit.chi2, fit.dof)) < MISFIT_ALARM
    if not high and not low:
        return NoiseVerdict("as_stated")
    differ = repeats is not None and not repeats.interval[0] <= 1 <= repeats.interval[1]
    lacking = repeats is not None and repeats.lack_of_fit_p <= MISFIT_ALARM
    if differ and (low or not lacking):
        return NoiseVerdict("repeats")
    if low:
        return NoiseVerdict("too_large")
    if lacking:
        return NoiseVerdict("lack_of_fit")
    return NoiseVerdict("predictable" if predictable else "unknown")
