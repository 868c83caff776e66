"""Two campaigns of one arm: the earlier fit completed, its error today, the changes since.

An effect that the arm always had, and that the earlier model lacks, would be taken for a change. So
the effects that may change are first scored on the earlier readings, and those with evidence are
added. A residual beyond the stated noise is then taken as scatter of the joints, or of the target:
a multiple of a tracker's noise, which is far smaller along the beam, would look like a change.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np
import scipy

from hilcal.diagnosis.change import LEVEL, Changes
from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.diagnosis.stepwise import add
from hilcal.errors import HilcalError
from hilcal.identification.carried.later_readings import (
    LaterReadings,
    directions_beside_frames,
    fit_later,
    with_frames_only,
)
from hilcal.identification.carried.posterior import Differences
from hilcal.identification.fit import Fit
from hilcal.identification.fit import fit as solve
from hilcal.identification.linearisation import columns_of_each, linearise
from hilcal.identification.noise.arm_scatter import estimate_arm_scatter, with_arm_scatter
from hilcal.identification.prediction.validation import Extrapolation, Validation, extrapolation
from hilcal.identification.residual import error_block
from hilcal.readings.whitening import Mode
from hilcal.shown import Brief

MOST_ADDED = 2
"""Most effects that are added. A choice: an earlier model that lacks more is no calibration."""
MISFIT_LEVEL = 0.01  # p-value of χ² below which the residual exceeds the stated noise; a choice


@dataclass(frozen=True, slots=True, eq=False)
class ErrorToday(Brief):
    """The error of the earlier calibration at the later readings.

    z is the rms of the error in units of its covariance as the earlier fit states it: its square
    has the expectation 1 where nothing has changed.
    """

    prediction: Validation  # only the tracker's place was fitted, if anything
    beyond: Extrapolation  # stated error of the prediction, and readings outside the earlier range
    z: float
    p_value: float  # probability of an error at least as large without any change
    drawing_m: float | None  # rms error with the arm as drawn, m; None without a registration

    @property
    def stated_m(self) -> float:
        """Rms of the standard deviation of the 3-D position error as the fit states it, m."""
        return float(np.sqrt(np.mean(self.beyond.stated_m**2)))


@dataclass(frozen=True, slots=True, eq=False)
class Comparison(Brief):
    """An earlier campaign and a later one of the same arm; what `compare` returns.

    Attributes:
        number: of the earlier revision; None for a baseline that no file keeps.
        fit: the earlier fit, without `lacked`.
        lacked: effects that its own readings show beside it, added for the comparison.
        mode: kind of readings that are compared: that of the earlier fit.
        later_mode: kind of readings of the later campaign's revision; None where it has none.
        readings: number of later readings.
        shared: number of later readings that the earlier revision was fitted to; they are left out.
        anew: whether the tracker counts as set up anew.
        setup_stated: whether the user stated `anew`; else it follows from the cells.
        tool: keys of [tool] that differ.
        today: the error of the earlier calibration.
        changes: the changes since.
        differences: parameters of both fits, where no prior ties the later fit to the earlier one.
    """

    number: int | None
    fit: Fit
    lacked: tuple[str, ...]
    mode: Mode
    later_mode: Mode | None
    readings: int
    shared: int
    anew: bool
    setup_stated: bool
    tool: tuple[str, ...]
    today: ErrorToday
    changes: Changes
    differences: Differences | None = None

    def _brief(self) -> dict[str, str]:
        error = self.today.prediction.error
        return {
            "readings": f"{self.readings} later ones ({self.mode})",
            "error": f"{1e6 * error.rms_m:.1f} µm rms, {1e6 * self.today.stated_m:.1f} µm stated",
            "changes": ", ".join(c.candidate.name for c in self.changes.found) or "none found",
            "error after the changes": "noise" if self.changes.explained else "more than noise",
            "more": "today, changes, differences, to_dict()",
        }

    @property
    def another_arm(self) -> bool:
        """Whether the later readings seem to be of another arm of the same type."""
        # No change explains them, and the arm as drawn predicts them as well as the calibration.
        drawing = self.today.drawing_m
        worse = drawing is not None and self.today.prediction.error.rms_m >= drawing
        return worse and not self.changes.explained

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON, SI: the document of `compare --json` without its sentences."""
        t, c = self.today, self.changes
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
            "changed": bool(c.found) or not c.explained,
            "another_arm": self.another_arm,
            "changes": [change.to_dict() for change in c.found],
            "gross_errors": [g.to_dict() for g in c.gross],
            "explained": c.explained,
            "left_p_value": c.unexplained,
            "left_over_stated": c.scatter,
            "tested": c.tested,
            "level": LEVEL,
            "would_have_been_seen": [limit.to_dict() for limit in c.limits],
            "not_to_be_seen": [h.name for h in c.hidden],
            "parameters": None if self.differences is None else self.differences.to_dict(),
        }


def with_missing_effects(
    fit: Fit, names: Collection[str], say: Callable[[str], None] = lambda text: None
) -> tuple[Fit, tuple[str, ...]]:
    """Add effects, and the scatter, that a gc-scaled fit's readings show; the fit, their names."""
    added: list[str] = []
    while len(added) < MOST_ADDED and (effect := _most_evident(fit, names)) is not None:
        say(f"adding {effect} to the earlier model, as its own readings ask for")
        try:
            fit = add(fit, effect)
        except HilcalError:
            break
        added.append(effect)
    if fit.readings.arm_scatter is None and scipy.stats.chi2.sf(fit.chi2, fit.dof) <= MISFIT_LEVEL:
        say("estimating the scatter of the earlier readings")
        scatter = estimate_arm_scatter(fit)
        if scatter is not None:
            readings = with_arm_scatter(fit.model.cell, fit.readings, scatter)
            say("fitting the earlier readings with it")
            fit = solve(fit.model, readings, fit.mode, start=fit.theta)
    return fit, tuple(added)


def _most_evident(fit: Fit, names: Collection[str]) -> str | None:
    """Return the effect with most evidence that is not in the model; None where none has any."""
    p, states, model = linearise(fit), fit.readings[~fit.outlier].states, fit.model
    possible = (k for k in model.catalogue.effects if k.name in names and k.name not in model.names)
    effects = [
        model.catalogue.make(kind.name, model.cell, states, m=fit.whitening.m).for_scoring(states)
        for kind in possible
        if kind.computable(states) and kind.applies(model.cell)
    ]
    scores = {x.effect.name: p.score(x.white) for x in columns_of_each(fit, effects)}
    tested = {name: score for name, score in scores.items() if score.rank}
    sure = {
        name: score.log_evidence
        for name, score in tested.items()
        if score.log_evidence > SAME_EVIDENCE and score.p_value * len(tested) < LEVEL
    }
    return max(sure, key=lambda name: sure[name], default=None)


def error_today(later: LaterReadings, changes: Changes, drawing: float | None) -> ErrorToday:
    """Return the earlier calibration's error; `drawing`: rms error with the arm as drawn, m."""
    minimum, w = fit_later(with_frames_only(later)), later.w
    white = w.whiten(minimum.raw).reshape(-1)
    prediction = Validation(
        readings=later.readings,
        whitening=w,
        raw=minimum.raw,
        error=error_block(minimum.raw, w),
        variance_factor=float(white @ white) / max(w.rank - minimum.free, 1),
        registered=later.anew,
    )
    predictive, lift = later.earlier.predictive, directions_beside_frames(later)
    covariance = lift @ lift.T / predictive.factor
    predictive = replace(
        predictive, model=minimum.model, theta=minimum.theta, covariance=covariance
    )
    fit, before = later.earlier.fit, changes.before
    ratio = before.rss / before.dof
    return ErrorToday(
        prediction=prediction,
        beyond=extrapolation(predictive, fit.readings[~fit.outlier], prediction),
        z=float(np.sqrt(ratio)),
        p_value=float(scipy.stats.f.sf(ratio, before.dof, fit.dof)),
        drawing_m=drawing,
    )
