"""Whether the tracker's readings are at rest, judged by their own trend and scatter.

The window is the last half of what has been measured since the arm stopped, at least K samples:
so a disturbance that fades is forgotten after twice the time that it took to fade, and a slow
one is looked at for longer. In the window, a line x_k = x̄ + b (t_k - t̄) + noise is fitted:

- drift: D = S b Σ̄⁻¹ bᵀ with S = Σ (t_k - t̄)² is chi² with m degrees of freedom at rest; the
  readings drift if that is less probable than `DRIFT_P` (`AFTER_DRIFT_P` once they did), unless
  the drift over the window is below half the standard deviation of the mean: then it does not
  matter.
- scatter about the line: if it cannot be the stated noise (p < `SCATTER_P`), the arm may still
  vibrate, or the instrument be worse than stated. It is taken for the instrument's once there
  are 2 K samples (2 K log10 of the excess where it is larger) and their second half does not
  scatter less than the first; drift is then judged relative to the scatter (an F test).

At rest and with the stated noise, the first full window is refused with a probability of
DRIFT_P + SCATTER_P at most. A first window that moves by less than about four sigmas of a
sample is not detected; more samples detect smaller drifts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from hilcal.measuring.average import deviations
from hilcal.measuring.devices import TrackerSample
from hilcal.readings.whitening import inverse_root
from hilcal.types import Floats

DRIFT_P = 0.04
"""False alarm rate of the drift test. The constants here are choices, traded by hand in
tests/unit/measuring/test_settle.py: time lost at rest against the bias that a decay leaves."""
AFTER_DRIFT_P = 0.3
"""The same after readings have drifted: the test is repeated at every sample, and none of the
repeated tests may miss a drift that is there."""
SCATTER_P = 0.001
SHRINKING_P = 0.05
NEGLIGIBLE = 0.5
"""Drift over the window that does not matter, as a share of the standard deviation of a mean."""
FEW = 12
"""Fewer samples than this do not estimate a scatter."""
LONGEST = 10
"""The window grows to at most so many times K samples."""


class SettleWindow:
    """Collects samples after the arm has stopped, and tests whether they are at rest."""

    def __init__(self, count: int, scale: float = 1.0) -> None:
        """Start empty.

        Args:
            count: K, the least number of samples to judge, 3 or more.
            scale: cell seconds per real second (`Clock.scale`).

        Raises:
            ValueError: fewer than 3.
        """
        if count < 3:
            raise ValueError(f"count = {count}: a trend takes at least 3 samples")
        self._count, self._scale = count, scale
        self._samples: list[TrackerSample] = []
        self._settled = self._has_drifted = False

    def add(self, sample: TrackerSample) -> None:
        """Add the next sample."""
        self._samples.append(sample)
        del self._samples[: -2 * LONGEST * self._count]
        self._settled = len(self._samples) >= self._count and self._judge()

    def clear(self) -> None:
        """Forget everything: the arm has moved, or the load has changed."""
        self._samples.clear()
        self._settled = self._has_drifted = False

    def __len__(self) -> int:
        """Number of samples since the start, as far as they are remembered."""
        return len(self._samples)

    @property
    def latest(self) -> tuple[TrackerSample, ...]:
        """The last K samples, fewer if there are not as many yet."""
        return tuple(self._samples[-self._count :])

    @property
    def drift(self) -> Floats:
        """Slope (m,) over the window, m/s and rad/s of cell time; zeros before 2 samples."""
        window = self._window()
        if len(window) < 2:
            return np.zeros(window[0].value.shape[0] if window else 3)
        return _trend(window, self._scale).slope

    def settled(self) -> bool:
        """Whether the readings are at rest; False before K samples."""
        return self._settled

    def _judge(self) -> bool:
        """Test the window after a new sample."""
        window = self._window()
        trend = _trend(window, self._scale)
        if trend.moment == 0.0:
            return False  # all at one time: no word on a trend
        noise = 1.0
        if trend.scatter_p < SCATTER_P:
            enough = max(2 * self._count, FEW) * max(1.0, np.log10(trend.scatter))
            if len(self._samples) < enough or self._shrinking():
                return False
            noise = trend.scatter
        over_window = np.linalg.norm(trend.white_slope) * trend.span
        if over_window < NEGLIGIBLE * np.sqrt(noise / len(window)):
            return True
        m, drift = len(trend.slope), trend.moment * float(np.sum(trend.white_slope**2))
        if noise == 1.0:
            p = float(stats.chi2.sf(drift, m))
        else:
            p = float(stats.f.sf(drift / (m * noise), m, trend.dof))
        self._has_drifted = self._has_drifted or p <= DRIFT_P
        return bool(p > (AFTER_DRIFT_P if self._has_drifted else DRIFT_P))

    def _window(self) -> Sequence[TrackerSample]:
        """The last half of all, at least K."""
        return self._samples[-max(self._count, len(self._samples) // 2) :]

    def _shrinking(self) -> bool:
        """Whether the second half of all samples scatters less than the first (F test)."""
        half = len(self._samples) // 2
        first = _trend(self._samples[:half], self._scale)
        second = _trend(self._samples[-half:], self._scale)
        ratio = first.scatter / max(second.scatter, np.finfo(float).tiny)
        return bool(stats.f.sf(ratio, first.dof, second.dof) < SHRINKING_P)


@dataclass(frozen=True, slots=True, eq=False)
class _Trend:
    """A line through a window.

    Attributes:
        slope: (m,) per s of cell time.
        white_slope: (m,) the same, whitened by the mean stated covariance.
        moment: Σ (t_k - t̄)², s².
        span: from the first to the last sample, s.
        scatter: mean square about the line over what is stated.
        scatter_p: how probable at least as much is.
        dof: m (K - 2).
    """

    slope: Floats
    white_slope: Floats
    moment: float
    span: float
    scatter: float
    scatter_p: float
    dof: int


def _trend(samples: Sequence[TrackerSample], scale: float) -> _Trend:
    """Least squares of a line."""
    time = np.array([s.host_ns - samples[0].host_ns for s in samples]) * 1e-9 * scale
    span = float(time[-1])
    time -= time.mean()
    moment = float(time @ time)
    residuals = deviations(np.array([s.value for s in samples]))[1]
    root = inverse_root(np.mean([s.covariance for s in samples], axis=0))
    slope = time @ residuals / moment if moment > 0 else np.zeros(residuals.shape[1])
    about = (residuals - np.outer(time, slope)) @ root.T
    dof = residuals.shape[1] * (len(samples) - 2)
    total = float(np.sum(about**2))
    scatter, p = (total / dof, float(stats.chi2.sf(total, dof))) if dof else (0.0, 1.0)
    return _Trend(slope, root @ slope, moment, span, scatter, p, dof)
