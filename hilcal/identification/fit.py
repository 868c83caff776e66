"""A fit: parameters, their uncertainties, residuals and errors."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from hilcal import limits
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.data_snooping import Disagreement, Snooping
from hilcal.identification.drift import Conflict, chosen_drift, conflicts
from hilcal.identification.estimates import Estimates, summary
from hilcal.identification.folds import distinct_poses, random_folds
from hilcal.identification.gauss_newton import Solution, solve
from hilcal.identification.holdout import leave_out
from hilcal.identification.least_trimmed_squares import limit
from hilcal.identification.residual import ErrorBlock, error_block, residual
from hilcal.identification.robot_frames import RobotFrames, robot_frames
from hilcal.identification.uncertainty import Uncertainty, uncertainty
from hilcal.identification.variance_factor import WithVarianceFactor
from hilcal.model.model import Model
from hilcal.model.observe import Observation
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode, Scaling, Whitening, inverse_root, whitening
from hilcal.shown import Tabular
from hilcal.types import Bools, Floats, Ints

Frame = Literal["sensor", "base"]
OUTLIER_ROUNDS = 6
"""Most fits without gross errors, each followed by a new test; a choice, no study set it."""
SEED = 0
"""Of the random subsets of the robust start, so that equal readings give equal fits."""

DRIFT_ROUNDS = 2
"""Most choices of the drift of a carried prior, each followed by a new fit; a choice: the first is
at a linearisation that the drift hardly changes."""
DRIFT_CHANGED = 0.1
"""Change of a drift, as a share of the largest one, that is worth another fit; a choice."""

_Solved = tuple[Whitening, Solution]
_Used = tuple[Bools, Disagreement | None, _Solved]


@dataclass(frozen=True, eq=False)
class Fit(WithVarianceFactor, Tabular):
    """A model fitted to readings.

    D is the number of measurements (readings or deflections), m their elements, P the
    number of parameters.

    Attributes:
        model: robot and effects.
        readings: all readings.
        mode: "deflection" or "absolute".
        scaling: "none", "gu" or "gc".
        whitening: gc-scaling of the readings that were fitted.
        fitted: their scaling in the fit.
        solution: the minimum that Gauss-Newton reached.
        pose: (D,) distinct pose of each fitted measurement.
        raw: (D, m) residual.
        white: (R,) gc-whitened residual.
        outlier: (N,) readings that were set aside as gross errors.
        chi2: whitened sum of squares.
        dof: degrees of freedom.
        error: error block of the fit; as `holdout`, of the readings that were not set aside.
        disagreement: readings that are far off and yet fitted; None where there are none.

    What takes long, and is of no use for a fit that is only tried, is computed when it is asked
    for: `left_out`, `holdout`, `uncertainty`.
    """

    model: Model
    readings: Readings
    mode: Mode
    scaling: Scaling
    whitening: Whitening
    fitted: Whitening
    solution: Solution
    pose: Ints
    raw: Floats
    white: Floats
    outlier: Bools
    chi2: float
    dof: float
    error: ErrorBlock
    disagreement: Disagreement | None = None

    def _brief(self) -> dict[str, str]:
        return {
            "model": " + ".join(self.model.names),
            "fitted": f"{len(self.raw)} measurements ({self.mode}, scaling {self.scaling})",
            "set aside": f"{np.count_nonzero(self.outlier)} readings",
            "parameters": f"{len(self.theta)}",
            "error": f"{1e6 * self.error.rms_m:.1f} µm rms, {self.error.rms_sigma:.2f} σ",
            "chi2": f"{self.chi2:.4g} with {self.dof:.4g} degrees of freedom",
            "more": "summary(), parameters, residuals(), to_frame(), predict()",
        }

    @cached_property
    def left_out(self) -> Floats:
        """(D, m) residual of each measurement, predicted without its pose."""
        return leave_out(self.model, self.solution, random_folds(self.pose), self.fitted)

    @cached_property
    def holdout(self) -> ErrorBlock:
        """Error block of whole poses left out."""
        return error_block(self.left_out, self.whitening)

    @cached_property
    def holdout_of_all(self) -> ErrorBlock:
        """The same with what was set aside, by which fits that set others aside are compared."""
        return error_block(*all_left_out(self))

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Standard uncertainties and identifiable parameters."""
        kept = self.readings[~self.outlier]
        return uncertainty(
            self.model, kept, self.fitted, self.solution, self.pose, self.chi2, self.dof
        )

    @cached_property
    def conflicts(self) -> tuple[Conflict, ...]:
        """How far a carried prior and the readings disagree, worst first; empty without one."""
        return conflicts(self.model, self.solution, self.whitening)

    @property
    def theta(self) -> Floats:
        """(P,) parameters."""
        return self.solution.theta

    @property
    def rank(self) -> int:
        """Number of directions of the parameters that the data determine."""
        return int(self.solution.equations.basis.transform.shape[1])

    @property
    def mahalanobis2(self) -> Floats:
        """(D,) squared Mahalanobis distance of each measurement by itself."""
        return mahalanobis2(self.raw, self.whitening.covariance)

    @property
    def parameters(self) -> Estimates:
        """The parameters of the named effects with their standard uncertainties.

        Those of dropped groups are left out.
        """
        u, kept = self.uncertainty, self.solution.estimated.copy()
        for name, mine in zip(self.model.names, self.model.slices(), strict=True):
            kept[mine] &= name not in self.model.background
        return Estimates.of(self.model, self.theta, u.std, u.identifiable, kept)

    def summary(self) -> str:
        """Return the model, its errors and its parameters as plain text."""
        return summary(
            self.model.named,
            f"{len(self.raw)} {self.mode} readings, scaling {self.scaling}",
            self.parameters,
            (self.error, self.holdout),
            self.variance_factor,
            self.variance_factor_interval,
        )

    def residuals(self, frame: Frame = "sensor") -> Floats:
        """Residuals (D, m), measured − predicted, m and rad.

        They are of `readings[~outlier][whitening.reading]`: of deflections the loaded readings,
        which are not in the order of the campaign.

        Args:
            frame: axes that they are given in: "sensor", or "base" of the arm.

        Raises:
            InputError: another frame.
        """
        if frame == "sensor":
            return self.raw
        if frame != "base":
            raise InputError(f"frame {frame!r} is unknown; valid: sensor, base")
        parts = self.raw.reshape(len(self.raw), -1, 3)
        return np.asarray((parts @ self.frames.base[:3, :3]).reshape(self.raw.shape))

    @cached_property
    def frames(self) -> RobotFrames:
        """Base and flange of the robot."""
        return robot_frames(self.model, self.theta)

    def predict(self, states: States) -> Observation:
        """Predict what the sensor reads in N states.

        Args:
            states: joints, wrenches and what else the model's effects need.

        Raises:
            CannotAnswerError: no static equilibrium.
        """
        return self.model.predict(states, self.theta).observation


def mahalanobis2(raw: Floats, covariance: Floats) -> Floats:
    """Squared Mahalanobis distances (D,) of residuals (D, m) with covariances (D, m, m)."""
    white = np.einsum("dij,dj->di", inverse_root(covariance), raw)
    return np.asarray(np.sum(white**2, axis=1))


def fit(
    model: Model,
    readings: Readings,
    mode: Mode,
    scaling: Scaling = "gc",
    start: Floats | None = None,
    prior: Floats | None = None,
) -> Fit:
    """Fit a model to readings.

    `start` and `prior` of an earlier fit reproduce it in few steps. The prior that the model
    carries gets the drift that the readings ask for; where `prior` is given it keeps its own.

    Gross errors are set aside: they stay in the file and are listed, but are not fitted.

    Raises:
        CannotAnswerError: fewer measured elements than identifiable parameters.
        InputError: from `whitening`, where a deflection lacks its unloaded reading; or too many
            readings.
    """
    limits.check_fitted(len(readings), readings.m)
    given = model.prior
    if given is not None and prior is None:
        model = replace(model, prior=given.with_drift(None))
    used, disagree, solved = _set_aside(model, readings, mode, start, prior)
    if model.prior is not None and prior is None:
        for _ in range(DRIFT_ROUNDS):
            drift = chosen_drift(model, solved[1], solved[0])
            if _same_drift(model.prior.drift, drift):
                break
            model = replace(model, prior=model.prior.with_drift(drift))
            begun = solved[1].theta
            used, disagree, solved = _set_aside(model, readings, mode, begun, None)
    if scaling != "gc":
        solved = _solve(model, readings[used], mode, scaling, start, prior)
    return replace(_assemble(model, readings, ~used, mode, scaling, *solved), disagreement=disagree)


def _same_drift(before: Floats | None, after: Floats) -> bool:
    """Whether two drifts (G,) make no difference; None is none at all."""
    old = np.zeros_like(after) if before is None else before
    return bool(np.abs(after - old).max() <= DRIFT_CHANGED * after.max(initial=0.0))


def _set_aside(
    model: Model, readings: Readings, mode: Mode, start: Floats | None, prior: Floats | None
) -> _Used:
    """Readings (N,) without gross errors, what they disagree in, their solution in scaling gc."""
    used = np.ones(len(readings), dtype=bool)
    solved = _solve(model, readings, mode, "gc", start, prior)
    w, solution = solved
    distance2 = mahalanobis2(solution.raw, w.covariance)
    if distance2.max() <= limit(w.m, len(distance2)):
        return used, None, solved
    y = np.zeros(model.size) if start is None else solution.space.of_theta(start)
    found = Snooping(model, readings, mode, solution, y).begin(np.random.default_rng(SEED))
    for _ in range(OUTLIER_ROUNDS):
        if np.array_equal(found.used, used):
            break
        used = found.used
        solved = _solve(model, readings[used], mode, "gc", solution.theta, prior)
        solution = solved[1]
        found = Snooping(model, readings, mode, solution, solution.y).again(found)
    return used, found.disagreement, solved


def _solve(
    model: Model,
    readings: Readings,
    mode: Mode,
    scaling: Scaling,
    start: Floats | None,
    prior: Floats | None,
) -> _Solved:
    w = whitening(readings, mode, scaling)
    solution = solve(model, readings, w, start, prior)
    free = solution.equations.basis.structural
    if w.rank <= free:
        raise CannotAnswerError(
            f"{w.rank} measured elements for {free} parameters: nothing is left to judge the model "
            f"by; measure at least {free // w.m + 2} {_what(mode)}, better {3 * free // w.m + 1}"
        )
    return w, solution


def _what(mode: Mode) -> str:
    return "loaded readings with their unloaded ones" if mode == "deflection" else "readings"


def _assemble(
    model: Model,
    readings: Readings,
    outlier: Bools,
    mode: Mode,
    scaling: Scaling,
    fitted: Whitening,
    solution: Solution,
) -> Fit:
    kept, raw = readings[~outlier], solution.raw
    w = fitted if scaling == "gc" else whitening(kept, mode, "gc")
    white = w.whiten(raw).reshape(-1)
    total = float(white @ white)
    return Fit(
        model=model,
        readings=readings,
        mode=mode,
        scaling=scaling,
        whitening=w,
        fitted=fitted,
        solution=solution,
        pose=distinct_poses(kept)[w.reading],
        raw=raw,
        white=white,
        outlier=outlier,
        chi2=total,
        dof=max(w.rank - solution.effective, 1.0),
        error=error_block(raw, w),
    )


def with_outliers(of: Fit) -> tuple[Floats, Whitening]:
    """Residual of all readings, and their gc-scaling; of the fitted ones where they are all."""
    if not of.outlier.any():
        return of.raw, of.whitening
    w = whitening(of.readings, of.mode, "gc")
    prediction = of.model.predict(of.readings.states, of.theta)
    return residual(of.readings, prediction, w), w


def all_left_out(of: Fit) -> tuple[Floats, Whitening]:
    """The same of the residual predicted without the pose of each measurement."""
    raw, w = with_outliers(of)
    if w is of.whitening:
        return of.left_out, w
    place = {int(r): i for i, r in enumerate(np.flatnonzero(~of.outlier)[of.whitening.reading])}
    raw = raw.copy()
    for i, r in enumerate(w.reading):
        if int(r) in place:
            raw[i] = of.left_out[place[int(r)]]
    return raw, w
