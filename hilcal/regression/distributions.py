"""Tail probabilities and quantiles of distributions, from the special functions of SciPy.

The calls are those of `scipy.stats` (sf = 1 − cdf, isf its inverse, ppf the inverse of cdf) and
give its values, but `import scipy.stats` takes a quarter of the time in which a command starts.
Arrays broadcast; a scalar gives a scalar. A χ² of no degrees of freedom gives NaN.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import special

from hilcal.types import Floats, Ints

Numbers: TypeAlias = float | np.floating | Floats | Ints | Sequence[float]


class chi2:  # noqa: N801  named as in scipy.stats
    """χ² distribution with df degrees of freedom."""

    @staticmethod
    def sf(x: Numbers, df: Numbers) -> Floats:
        """P(X > x)."""
        return _value(special.gammaincc(_half(df), _half_of_positive(x)))

    @staticmethod
    def cdf(x: Numbers, df: Numbers) -> Floats:
        """P(X ≤ x)."""
        return _value(special.gammainc(_half(df), _half_of_positive(x)))

    @staticmethod
    def logsf(x: Numbers, df: Numbers) -> Floats:
        """Natural logarithm of `sf`; −∞ where that underflows."""
        with np.errstate(divide="ignore"):
            return _value(np.log(chi2.sf(x, df)))

    @staticmethod
    def ppf(p: Numbers, df: Numbers) -> Floats:
        """Value that X does not exceed with probability p."""
        return _value(2.0 * special.gammaincinv(_half(df), p))

    @staticmethod
    def isf(p: Numbers, df: Numbers) -> Floats:
        """Value that X exceeds with probability p."""
        return _value(2.0 * special.gammainccinv(_half(df), p))

    @staticmethod
    def median(df: Numbers) -> Floats:
        """Median of X."""
        return chi2.ppf(0.5, df)


class f:  # noqa: N801
    """F distribution with dfn degrees of freedom of the numerator and dfd of the denominator."""

    @staticmethod
    def sf(x: Numbers, dfn: Numbers, dfd: Numbers) -> Floats:
        """P(X > x)."""
        return _value(special.fdtrc(dfn, dfd, np.maximum(x, 0.0)))

    @staticmethod
    def isf(p: Numbers, dfn: Numbers, dfd: Numbers) -> Floats:
        """Value that X exceeds with probability p."""
        a, b = np.asarray(dfn, dtype=float), np.asarray(dfd, dtype=float)
        with np.errstate(divide="ignore"):
            return _value(b / a * (1.0 / special.betaincinv(b / 2.0, a / 2.0, p) - 1.0))


class beta:  # noqa: N801
    """Beta distribution."""

    @staticmethod
    def cdf(x: Numbers, a: Numbers, b: Numbers) -> Floats:
        """P(X ≤ x)."""
        return _value(special.betainc(a, b, x))


class norm:  # noqa: N801
    """Normal distribution of zero mean and unit variance."""

    @staticmethod
    def sf(x: Numbers) -> Floats:
        """P(X > x)."""
        return _value(special.ndtr(np.negative(x)))

    @staticmethod
    def logsf(x: Numbers) -> Floats:
        """Natural logarithm of `sf`, also where that underflows."""
        return _value(special.log_ndtr(np.negative(x)))

    @staticmethod
    def ppf(p: Numbers) -> Floats:
        """Value that X does not exceed with probability p."""
        return _value(special.ndtri(p))

    @staticmethod
    def isf(p: Numbers) -> Floats:
        """Value that X exceeds with probability p."""
        return _value(-special.ndtri(p))

    @staticmethod
    def pdf(x: Numbers, scale: float = 1.0) -> Floats:
        """Density at x of the distribution with standard deviation `scale`."""
        z = np.asarray(x, dtype=float) / scale
        return _value(np.exp(-0.5 * z**2) / (np.sqrt(2.0 * np.pi) * scale))


class ncx2:  # noqa: N801
    """Noncentral χ² distribution: a Poisson mixture of central ones with df + 2 k degrees."""

    @staticmethod
    def sf(x: float, df: float, nc: float) -> float:
        """P(X > x), with the non-centrality nc ≥ 0: Σ_k Poisson(k; nc/2) P(χ²(df + 2 k) > x)."""
        k, weight = _poisson(nc / 2.0)
        return float(weight @ special.gammaincc(0.5 * df + k, 0.5 * max(x, 0.0)))


class ncf:  # noqa: N801
    """Noncentral F distribution: the noncentral χ² of the numerator over the χ² of the other."""

    @staticmethod
    def sf(x: float, dfn: float, dfd: float, nc: float) -> float:
        """P(X > x): Σ_k Poisson(k; nc/2) I_z(dfd/2, dfn/2 + k), z = dfd / (dfd + dfn x)."""
        k, weight = _poisson(nc / 2.0)
        z = dfd / (dfd + dfn * max(x, 0.0))
        return float(weight @ special.betainc(0.5 * dfd, 0.5 * dfn + k, z))


class t:  # noqa: N801
    """Student's t distribution with df degrees of freedom."""

    @staticmethod
    def sf(x: Numbers, df: Numbers) -> Floats:
        """P(X > x)."""
        return _value(special.stdtr(df, np.negative(x)))

    @staticmethod
    def ppf(p: Numbers, df: Numbers) -> Floats:
        """Value that X does not exceed with probability p."""
        return _value(special.stdtrit(df, p))


class binom:  # noqa: N801
    """Number of successes in n draws, each of probability p."""

    @staticmethod
    def sf(k: Numbers, n: Numbers, p: Numbers) -> Floats:
        """P(X > k): the regularised incomplete beta function I_p(k + 1, n − k)."""
        k = np.asarray(k, dtype=float)
        shape = np.maximum(k + 1.0, 1.0), np.maximum(np.asarray(n) - k, 1e-9)
        inside = special.betainc(*shape, np.asarray(p))
        return _value(np.where(k < 0, 1.0, np.where(k >= n, 0.0, inside)))


def _poisson(mean: float) -> tuple[Floats, Floats]:
    """Numbers k (K,) and their probabilities; what is left out is below 1e-16 in all."""
    away = 9.0 * np.sqrt(mean)
    k = np.arange(max(0.0, np.floor(mean - away)), np.ceil(mean + away) + 31.0)
    return k, np.exp(special.xlogy(k, mean) - mean - special.gammaln(k + 1.0))


def _half(df: Numbers) -> Floats:
    half = 0.5 * np.asarray(df, dtype=float)
    return np.where(half > 0.0, half, np.nan)


def _half_of_positive(x: Numbers) -> Floats:
    return np.asarray(0.5 * np.maximum(x, 0.0))


def _value(x: np.floating | NDArray[np.floating[Any]]) -> Floats:
    return np.asarray(x, dtype=float)[()]
