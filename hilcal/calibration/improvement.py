"""Position errors of the tool before and after the correction, as the tracker measured them.

The error of a point is the distance of the tool from its target position, by a reading y:

    e = (y − ŷ(x)) + p̂(x) − p_wanted

x is the recorded state of the reading, ŷ the reading that the fitted model predicts for x, p̂ the
tool's position by the same model, all in the tracker's axes. For a model whose only part of the
instruments is the registration T, e = y − T p_wanted; otherwise modelled drift and scale of the
instruments are subtracted.

Where deflections were fitted, y is a loaded reading minus the unloaded one of the same point, and
p_wanted is the position of the unloaded arm: e is then relative to the measured unloaded position.

At corrected joint values p̂(x) = p_wanted if x is the expected state, and e is the prediction error
of a reading that was not fitted: its covariance is that of the prediction, with the tracker's noise
and the arm's repeatability.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import scipy

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import BAND, ErrorSize, band, tool_of, tool_poses
from hilcal.identification.prediction.predictive import Predictive
from hilcal.identification.residual import noise_floor, residual
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode, whitening
from hilcal.types import Bools, Floats

REFUTED_P = 1e-3
"""Probability of so few points inside of their band, below which it is refuted; a choice."""


def refuted(inside: int, count: int) -> bool:
    """Whether so few of the points inside of their band refute it: P(B ≤ inside) < `REFUTED_P`.

    B is binomial of `count` and `BAND`.
    """
    return bool(scipy.stats.binom.cdf(inside, count, BAND) < REFUTED_P)


@dataclass(frozen=True, slots=True)
class ErrorReduction:
    """Errors of some points before and after the correction.

    Attributes:
        name: of the load, or "all".
        count: number of points.
        before: at the uncorrected joint values.
        after: at the corrected ones.
        noise_m: root mean square error that the tracker's noise and the arm's repeatability alone
            would leave.
        band_m: the largest predicted radius that holds `BAND` of the errors.
        inside: number of points whose error is within their radius.
        removed: share of the error beyond the noise that the correction removed,
            1 − x_after/x_before with x² = rms² − noise²; None if x_before is zero.
    """

    name: str
    count: int
    before: ErrorSize
    after: ErrorSize
    noise_m: float
    band_m: float
    inside: int
    removed: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Improvement:
    """Errors of N points before and after the correction, as measured."""

    mode: Mode  # kind of readings of the model
    poses: tuple[str, ...]  # (N,) names
    loads: tuple[str, ...]  # (N,) names of their loads
    before_m: Floats  # (N,) distance from the target position
    after_m: Floats  # (N,) the same at the corrected joint values
    band_m: Floats  # (N,) predicted radius that holds `BAND` of such errors
    noise_m: Floats
    """(N,) root mean square distance by the tracker's noise and the arm's repeatability."""
    left_out: tuple[tuple[str, str], ...] = ()
    """Points that could not be corrected or reached, with the reason."""

    @property
    def everything(self) -> ErrorReduction:
        """All points."""
        return self._part("all", np.ones(len(self.poses), dtype=np.bool_))

    @property
    def refuted(self) -> bool:
        """Whether the measured errors refute the predicted bands."""
        return refuted(self.everything.inside, self.everything.count)

    @property
    def by_load(self) -> tuple[ErrorReduction, ...]:
        """The points of each load."""
        loads = np.array(self.loads)
        return tuple(self._part(name, loads == name) for name in dict.fromkeys(self.loads))

    def over(self, limit_m: float) -> int:
        """Return the number of points whose error exceeds a limit after the correction."""
        return int(np.sum(self.after_m > limit_m))

    def _part(self, name: str, part: Bools) -> ErrorReduction:
        before, after = ErrorSize.of(self.before_m[part]), ErrorSize.of(self.after_m[part])
        noise = float(np.sqrt(np.mean(self.noise_m[part] ** 2)))
        first, last = (np.sqrt(max(s.rms_m**2 - noise**2, 0.0)) for s in (before, after))
        return ErrorReduction(
            name=name,
            count=int(part.sum()),
            before=before,
            after=after,
            noise_m=noise,
            band_m=float(self.band_m[part].max()),
            inside=int(np.sum(self.after_m[part] <= self.band_m[part])),
            removed=float(1.0 - last / first) if first > 0 else None,
        )

    def to_dict(self) -> dict[str, object]:
        """Return the improvement as JSON, SI."""
        numbers = (x.tolist() for x in (self.before_m, self.after_m, self.band_m))
        rows = zip(self.poses, self.loads, *numbers, strict=True)
        return {
            "readings": self.mode,
            "error": asdict(self.everything),
            "loads": [asdict(part) for part in self.by_load],
            "band_share": BAND,
            "refuted": self.refuted,
            "points": [
                {"pose": pose, "load": load, "before_m": before, "after_m": after, "band_m": width}
                for pose, load, before, after, width in rows
            ],
            "left_out": [{"point": name, "why": why} for name, why in self.left_out],
        }


def improvement(
    calibration: Calibration,
    p: Predictive,
    before: Readings,
    after: Readings,
    goal: States,
    left_out: Sequence[tuple[str, str]],
) -> Improvement:
    """Compare readings of the same points at uncorrected and at corrected joint values.

    Both have the same poses in the same order, for deflections with the unloaded readings of the
    points. `goal` are states of `before` at which the nominal arm has the tool at its target; not
    used for deflections.
    """
    first, _, _ = _errors(calibration, p, before, goal)
    last, covariance, noise = _errors(calibration, p, after, goal)
    rows = whitening(after, calibration.mode, "gc").reading
    return Improvement(
        mode=calibration.mode,
        poses=tuple(after.pose_names[k] for k in after.pose[rows]),
        loads=tuple(after.load_names[k] for k in after.load[rows]),
        before_m=np.linalg.norm(first, axis=1),
        after_m=np.linalg.norm(last, axis=1),
        band_m=band(covariance[:, :3, :3]),
        noise_m=np.array([noise_floor(c[None]) for c in noise]),
        left_out=tuple(left_out),
    )


def _errors(
    calibration: Calibration, p: Predictive, readings: Readings, goal: States
) -> tuple[Floats, Floats, Floats]:
    """Errors (D, 3), their predicted covariances, and the covariances of the noise (D, m, m)."""
    model, theta = calibration.model, calibration.theta
    w = whitening(readings, calibration.mode, "gc")
    prediction = model.predict(readings.states, theta)
    raw = residual(readings, prediction, w)[:, :3]
    tool = tool_of(model, theta, None)
    position = tool_poses(tool, prediction)[1]
    target = 0.0 * position
    if calibration.mode == "absolute":
        target = calibration.nominal(tool, replace(goal, target=None))[1]
    offset = (position - target) @ calibration.base_in_tracker()[:3, :3].T
    total = p.reading_covariance(prediction, p.noise_whitening(readings, calibration.mode))
    return raw + w.raw(offset), total, w.covariance
