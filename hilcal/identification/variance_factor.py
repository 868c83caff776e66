"""The variance factor of a fit, χ²/dof, and its confidence interval."""

from scipy.stats import chi2

from hilcal.shown import Shown

CONFIDENCE = 0.95


class WithVarianceFactor(Shown):
    """What has a whitened sum of squares and its degrees of freedom."""

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
    return float(total / chi2.isf(tail, dof)), float(total / chi2.ppf(tail, dof))
