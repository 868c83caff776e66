"""Two campaigns of one arm as data: the error of the earlier calibration today, the changes."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from hilcal.diagnosis.change import LEVEL
from hilcal.diagnosis.change_found import Changes
from hilcal.identification.fit import Fit
from hilcal.identification.later_readings import Setting, beside_frames, frames_alone, remeasure
from hilcal.identification.posterior import Differences
from hilcal.identification.residual import error_block
from hilcal.identification.validation import Extrapolation, Validation, extrapolation
from hilcal.readings.whitening import Mode
from hilcal.shown import Shown


@dataclass(frozen=True, slots=True, eq=False)
class Today:
    """The error of the earlier calibration at the later readings.

    Attributes:
        prediction: of the later readings; nothing but the tracker's place was fitted, if that.
        beyond: what the earlier fit states of them, and which lie outside of what it measured.
        z: rms of the error over what the earlier fit states, all correlations counted: the root of
            a mean square that is 1 where nothing has changed.
        p_value: of such an error, or a larger one, without any change.
        drawing_m: rms error with the arm as drawn, before any calibration, m; None where the
            frames cannot be registered.
    """

    prediction: Validation
    beyond: Extrapolation
    z: float
    p_value: float
    drawing_m: float | None

    @property
    def stated_m(self) -> float:
        """Rms of the standard deviation of the 3-D position error as the fit states it, m."""
        return float(np.sqrt(np.mean(self.beyond.stated_m**2)))

    @property
    def better_than_drawn(self) -> bool:
        """Whether the calibration predicts the readings better than the arm as drawn."""
        return self.drawing_m is None or self.prediction.error.rms_m < self.drawing_m


@dataclass(frozen=True, slots=True, eq=False)
class Comparison(Shown):
    """An earlier campaign and a later one of the same arm; what `compare` returns.

    Attributes:
        number: of the earlier revision; None for a baseline that is not kept.
        fit: the earlier fit.
        lacked: effects that its own readings ask for beside it, added for the comparison.
        mode: kind of readings that are compared: that of the earlier fit.
        later_mode: kind of readings of the later campaign's own revision; None where it has none.
        readings: number of later readings.
        shared: how many of them the earlier revision was fitted to; they are left out.
        anew: whether the tracker was taken as set up anew.
        told: whether that was asked for, one way or the other; else it follows from the cells.
        tool: keys of [tool] that are configured otherwise.
        today: the error of the earlier calibration.
        changes: what has changed.
        differences: parameters of both fits, where the later campaign has one of its own that no
            prior ties to the earlier one; else None.
    """

    number: int | None
    fit: Fit
    lacked: tuple[str, ...]
    mode: Mode
    later_mode: Mode | None
    readings: int
    shared: int
    anew: bool
    told: bool
    tool: tuple[str, ...]
    today: Today
    changes: Changes
    differences: Differences | None = None

    @property
    def another_arm(self) -> bool:
        """Whether the later readings look as if they were of another arm of the same type."""
        return not self.changes.explained and not self.today.better_than_drawn

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI: the document of `compare --json` without its sentences."""
        t, found = self.today, self.changes
        return {
            "revision": self.number,
            "model": list(self.fit.model.names),
            "readings": self.mode,
            "n_readings": self.readings,
            "n_fitted": self.shared,
            "n_measurements": len(t.prediction.raw),
            "tracker": "anew" if self.anew else "same",
            "tool_differs": list(self.tool),
            "added_to_earlier": list(self.lacked),
            "error": t.prediction.error.to_json(),
            "expected_m": t.stated_m,
            "z": t.z,
            "p_value": t.p_value,
            "drawing_rms_m": t.drawing_m,
            "n_outside": int(t.beyond.outside.sum()),
            "outside": [v.variable for v in t.beyond.variables],
            "changed": bool(found.found) or not found.explained,
            "another_arm": self.another_arm,
            "changes": [change.to_dict() for change in found.found],
            "explained": found.explained,
            "left_p_value": found.unexplained,
            "left_over_stated": found.scatter,
            "tested": found.tested,
            "level": LEVEL,
            "would_have_been_seen": [limit.to_dict() for limit in found.limits],
            "not_to_be_seen": [h.name for h in found.hidden],
            "parameters": None if self.differences is None else self.differences.to_dict(),
        }


def error_today(at: Setting, changes: Changes, drawing: float | None) -> Today:
    """Return the error of the earlier parameters, with the tracker's place as it is now.

    Args:
        at: the later readings.
        changes: since then.
        drawing: rms error with the arm as drawn, m.
    """
    found = remeasure(frames_alone(at))
    w, raw = at.w, found.raw
    white = w.whiten(raw).reshape(-1)
    prediction = Validation(
        readings=at.readings,
        whitening=w,
        raw=raw,
        error=error_block(raw, w),
        variance_factor=float(white @ white) / max(w.rank - found.free, 1),
        registered=at.anew,
    )
    knows, lift = at.earlier.knows, beside_frames(at)
    here = replace(
        knows,
        model=found.model,
        theta=found.theta,
        covariance=lift @ lift.T / knows.factor,
    )
    fit, before = at.earlier.fit, changes.before
    ratio = before.rss / before.dof
    return Today(
        prediction=prediction,
        beyond=extrapolation(here, fit.readings[~fit.outlier], prediction),
        z=float(np.sqrt(ratio)),
        p_value=float(f_distribution.sf(ratio, before.dof, fit.dof)),
        drawing_m=drawing,
    )
