"""Measuring one reading: wait until everything has settled, average, check.

**Settling.** The trend and scatter of the tracker's samples decide whether they are at rest. The
window is the last half of the samples since the arm stopped, at least K samples: a disturbance
leaves the window after twice its duration, and a slow disturbance is watched for longer. In the
window, a line x_k = x̄ + b (t_k - t̄) + noise is fitted:

- drift: D = S b Σ̄⁻¹ bᵀ with S = Σ (t_k - t̄)² is chi² with m degrees of freedom at rest. The
  readings drift if p < `DRIFT_P` (`AFTER_DRIFT_P` after a drift). A drift over the window of less
  than half the standard deviation of the mean is negligible.
- scatter about the line: if the stated noise cannot explain it (p < `SCATTER_P`), the arm may still
  vibrate, or the instrument may be worse than stated. It is attributed to the instrument once there
  are 2 K samples (2 K log10 of the excess if that is larger) and their second half does not scatter
  less than the first; drift is then judged relative to the scatter (an F test).

At rest and with the stated noise, the first full window is refused with a probability of
DRIFT_P + SCATTER_P at most. A motion of less than about four sigmas of a sample is not detected in
the first window; more samples detect smaller drifts.

**Averaging.** Several measurements at rest become one reading with the covariance of their mean,
see `readings.averaging`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from hilcal.errors import DeviceError
from hilcal.measuring.connect import Setup
from hilcal.measuring.devices import ArmSample, TargetLostError, TrackerSample, WrenchSample
from hilcal.measuring.force import ForceMeter
from hilcal.measuring.motion import POLL_S, Mover
from hilcal.measuring.progress import Remark
from hilcal.readings.averaging import Average, deviations, mean_of_samples
from hilcal.readings.whitening import whitening_matrix
from hilcal.types import Floats

MOST_LEFT_OUT = 0.2
"""Largest share of omitted samples; one sample is always allowed. A guess."""


def average(samples: Sequence[TrackerSample], systematic_share: float = 0.0) -> Average:
    """Average at least 2 samples of one target at rest; see `readings.averaging`.

    DeviceError: more than one gross outlier, and more than one in five.
    """
    values = np.array([sample.value for sample in samples])
    stated = np.array([sample.covariance for sample in samples])
    mean, count = mean_of_samples(values, stated, systematic_share), len(samples)
    if len(mean.left_out) > max(1.0, MOST_LEFT_OUT * count):
        raise DeviceError(
            f"tracker: its readings scatter: {len(mean.left_out)} of {count} at one pose are "
            "gross outliers; is the beam disturbed, or does something move?"
        )
    warnings = [f"reading {k + 1} of {count} is a gross outlier, left out" for k in mean.left_out]
    if not mean.explained:
        warnings.append(
            f"the repeats scatter {np.sqrt(mean.scatter):.1f} times as much as the instrument's "
            f"noise (p = {mean.scatter_p:.1g}); the reading's covariance was enlarged"
        )
    used = (s for k, s in enumerate(samples) if k not in mean.left_out)
    warnings += dict.fromkeys(s.warning for s in used if s.warning)
    return replace(mean, warnings=tuple(warnings))


DRIFT_P = 0.04
"""False alarm rate of the drift test. The constants here are choices, balanced by hand in
tests/unit/measuring/test_measure.py: time spent at rest against the bias by a decaying drift."""
AFTER_DRIFT_P = 0.3
"""The same after a drift: the test is repeated at every sample, and none of the repeated tests may
miss a drift."""
SCATTER_P = 0.001
SHRINKING_P = 0.05
NEGLIGIBLE = 0.5
"""Negligible drift over the window, as a share of the standard deviation of the mean."""
MIN_SAMPLES = 12  # least number of samples to estimate a scatter
MAX_WINDOW = 10  # largest window, over K samples


class SettleWindow:
    """Collects samples after the arm has stopped, and tests whether they are at rest.

    `settled`: whether they are; False before K samples.
    """

    def __init__(self, count: int) -> None:
        """Start empty; `count` is K, at least 3 for a trend."""
        self._count = count
        self._samples: list[TrackerSample] = []
        self.settled = self._has_drifted = False

    def add(self, sample: TrackerSample) -> None:
        """Add the next sample."""
        self._samples.append(sample)
        del self._samples[: -2 * MAX_WINDOW * self._count]
        self.settled = len(self._samples) >= self._count and self._judge()

    def _judge(self) -> bool:
        window = self._samples[-max(self._count, len(self._samples) // 2) :]
        trend = _trend(window)
        if trend.moment == 0.0:
            return False  # all samples at one time: no trend
        noise = 1.0
        if trend.scatter_p < SCATTER_P:
            enough = max(2 * self._count, MIN_SAMPLES) * max(1.0, np.log10(trend.scatter))
            if len(self._samples) < enough or self._shrinking():
                return False
            noise = trend.scatter
        over_window = np.linalg.norm(trend.white_slope) * trend.span
        if over_window < NEGLIGIBLE * np.sqrt(noise / len(window)):
            return True
        m, drift = len(trend.white_slope), trend.moment * float(np.sum(trend.white_slope**2))
        if noise == 1.0:
            p = float(scipy.stats.chi2.sf(drift, m))
        else:
            p = float(scipy.stats.f.sf(drift / (m * noise), m, trend.dof))
        self._has_drifted = self._has_drifted or p <= DRIFT_P
        return bool(p > (AFTER_DRIFT_P if self._has_drifted else DRIFT_P))

    def _shrinking(self) -> bool:
        """Test whether the second half of all samples scatters less than the first (F test)."""
        half = len(self._samples) // 2
        first = _trend(self._samples[:half])
        second = _trend(self._samples[-half:])
        ratio = first.scatter / max(second.scatter, np.finfo(float).tiny)
        return bool(scipy.stats.f.sf(ratio, first.dof, second.dof) < SHRINKING_P)


@dataclass(frozen=True, slots=True, eq=False)
class _Trend:
    white_slope: Floats  # (m,) per s, whitened by the mean stated covariance
    moment: float  # Σ (t_k - t̄)², s²
    span: float  # from the first to the last sample, s
    scatter: float  # mean square about the line over the stated noise
    scatter_p: float  # its p-value
    dof: int  # m (K - 2)


def _trend(samples: Sequence[TrackerSample]) -> _Trend:
    time = np.array([s.host_ns - samples[0].host_ns for s in samples]) * 1e-9
    span = float(time[-1])
    time -= time.mean()
    moment = float(time @ time)
    residuals = deviations(np.array([s.value for s in samples]))[1]
    root = whitening_matrix(np.mean([s.covariance for s in samples], axis=0))
    slope = time @ residuals / moment if moment > 0 else np.zeros(residuals.shape[1])
    deviation = (residuals - np.outer(time, slope)) @ root.T
    dof = residuals.shape[1] * (len(samples) - 2)
    total = float(np.sum(deviation**2))
    scatter, p = (total / dof, float(scipy.stats.chi2.sf(total, dof))) if dof else (0.0, 1.0)
    return _Trend(root @ slope, moment, span, scatter, p, dof)


MAX_SEARCHES = 2  # searches of a lost target in one reading, at most
MAX_ATTEMPTS = 3  # attempts at a reading, if void: the arm moved, or the samples disagree
MAX_WINDOWS = 4  # windows of measurements after which, and after its time-out, settling fails


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredStop:
    """The measurement of one target at one stop."""

    mean: Average  # of the tracker's measurements, sensor axes
    q: Floats  # (n,) mean actual joint angles, rad
    before: ArmSample
    after: ArmSample
    tracker: tuple[TrackerSample, ...]
    force: WrenchSample | None  # mean wrench of the force sensor; None without one
    settling: float  # settling time, cell s
    end_time: float  # cell s
    remarks: tuple[str, ...]
    torque: Floats | None = None
    """(n,) mean measured torques of the drives, N·m; None where the arm does not report them."""
    target: int | None = None  # index in the cell; None where there is one target


class Measurer:
    """Measures readings with the arm standing at its goal."""

    def __init__(self, setup: Setup, meter: ForceMeter | None, mover: Mover) -> None:
        self._mover, self._tracker, self._meter = mover, setup.rig.tracker, meter
        self._config = setup.cell.configured()
        self._clock, self._watcher = setup.clock, setup.watcher

    def measure(
        self,
        name: str,
        find: Callable[[], None] | None = None,
        force: WrenchSample | None = None,
        target: int | None = None,
    ) -> MeasuredStop:
        """Measure at the pose `name`, where the arm stands.

        `find` searches a lost target; `force` is the mean wrench if it was measured already.
        """
        remarks: list[str] = []
        searches = repeats = 0
        while True:
            try:
                settling = self._settle(name)
                measured, why = self._averaged(settling, force)
            except TargetLostError as error:
                searches = self._search(error, name, searches, find or self._tracker.find_target)
                remarks.append(f"target lost and found again: {error}")
                continue
            if measured is not None:
                remarks += measured.mean.warnings
                return replace(measured, remarks=tuple(remarks), target=target)
            repeats += 1
            if repeats == MAX_ATTEMPTS:
                raise DeviceError(f"{name}: measured {MAX_ATTEMPTS} times without success: {why}")
            remarks.append(f"measured again: {why}")
            self._watcher.notify(Remark(f"{name}: {why}; measuring again"))

    def _settle(self, name: str) -> float:
        """Wait until arm and readings have settled; return the settling time, cell s."""
        acquire, clock = self._config.acquire, self._clock
        start, count = clock.now(), 0
        rest_start: float | None = None
        window = SettleWindow(acquire.samples)
        while True:
            not_at_rest = self._mover.why_not_at_rest(self._mover.checked_sample())
            if not_at_rest is not None:
                rest_start, window = None, SettleWindow(acquire.samples)
                clock.sleep(POLL_S * clock.scale)
            else:
                rest_start = clock.now() if rest_start is None else rest_start
                window.add(self._tracker.measure())
                count += 1
                if clock.now() - rest_start >= acquire.settle_s and window.settled:
                    return clock.now() - start
            late = clock.now() - start > acquire.settle_timeout_s
            if late and (rest_start is None or count >= MAX_WINDOWS * acquire.samples):
                reason = (
                    "readings drift. Look for a swinging load, a loose target, a warming tracker"
                )
                if not_at_rest is not None:
                    reason = f"arm: {not_at_rest}. Was it moved by hand, or does something push it?"
                raise DeviceError(
                    f"{name}: not settled within {acquire.settle_timeout_s:g} s: {reason}"
                )

    def _averaged(
        self, settling: float, force: WrenchSample | None
    ) -> tuple[MeasuredStop | None, str]:
        """Average over the window; None and the reason where the reading is void."""
        watch, before = self._mover.watch, self._mover.checked_sample()
        differed = 0 if watch is None else watch.differed
        tracker: list[TrackerSample] = []
        arm_samples = [before]
        for _ in range(self._config.acquire.samples):
            tracker.append(self._tracker.measure())
            arm_samples.append(self._mover.checked_sample())
        if force is None and self._meter is not None:
            force = self._meter.average()
        after = self._mover.checked_sample()
        if (why := self._mover.check_still(before, after)) is not None:
            return None, why
        if watch is not None and watch.differed != differed and not self._wrong(force, after):
            return None, (
                "for a moment the force sensor measured another force than tool and load: was the "
                "tool touched?"
            )
        if len({sample.value.tobytes() for sample in tracker}) == 1:
            return None, (
                f"tracker: {len(tracker)} measurements are the same to the last digit: it repeats "
                "an old one"
            )
        try:
            mean = average(tracker, self._config.acquire.systematic_share)
        except DeviceError as error:
            return None, str(error)
        arm_samples.append(after)
        q = np.mean([sample.q for sample in arm_samples], axis=0)
        torques = [sample.torque for sample in arm_samples[1:] if sample.torque is not None]
        torque = np.mean(torques, axis=0) if len(torques) == len(arm_samples) - 1 else None
        ended = self._clock.now()
        return MeasuredStop(
            mean, q, before, after, tuple(tracker), force, settling, ended, (), torque
        ), ""

    def _wrong(self, force: WrenchSample | None, sample: ArmSample) -> bool:
        """Whether the mean wrench differs from the load, too; such a reading is kept."""
        watch, meter = self._mover.watch, self._meter
        if watch is None or meter is None or force is None:
            return False
        return bool(watch.difference(meter.tared(force, sample.q)))

    def _search(
        self, error: TargetLostError, name: str, searches: int, find: Callable[[], None]
    ) -> int:
        """Search the target; return the number of searches so far."""
        while searches < MAX_SEARCHES:
            searches += 1
            self._watcher.notify(Remark(f"{name}: {error}; searching the target"))
            try:
                find()
            except TargetLostError as again:
                error = again
            else:
                self._mover.checked_sample()
                return searches
        raise TargetLostError(
            f"{error} (at {name}, searched {MAX_SEARCHES} times). Clear the line of sight and have "
            "the tracker see the target"
        )
