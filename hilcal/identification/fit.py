"""A fit: parameters, their uncertainties, residuals and errors."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np

from hilcal import limits, numbers
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import CannotAnswerError, InputError, expect
from hilcal.identification.carried.drift import Conflict, chosen_drift, conflicts, of_another_arm
from hilcal.identification.folds import distinct_poses, leave_out, random_folds
from hilcal.identification.gauss_newton import Solution, solve
from hilcal.identification.outliers.data_snooping import DataSnooping, Disagreement, SnoopingResult
from hilcal.identification.outliers.least_trimmed_squares import rejection_limit
from hilcal.identification.registration.robot_frames import RobotFrames, robot_frames
from hilcal.identification.residual import ErrorBlock, WithVarianceFactor, error_block, residual
from hilcal.identification.uncertainty import Uncertainty, uncertainty
from hilcal.model.model import Model, Prediction
from hilcal.model.observe import Observation
from hilcal.optional import needed_by
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode, Scaling, Whitening, whitening, whitening_matrix
from hilcal.robot.arm import array_of
from hilcal.shown import Brief, Tabular
from hilcal.toml import suggest
from hilcal.types import Bools, Floats, Ints

if TYPE_CHECKING:
    import pandas as pd

Frame = Literal["sensor", "base"]
OUTLIER_ROUNDS = 6  # most fits without gross errors, each followed by a new test; a choice
SEED = 0  # of the random subsets of the robust start, so that equal readings give equal fits
DRIFT_ROUNDS = 2  # most choices of a carried prior's drift, which hardly moves the linearisation
READINGS = "Readings, as run.readings or of hc.read_table(table, cell)"
CONFLICT_P = 1e-3  # Bonferroni-corrected p-value of a contradiction to a carried prior; a choice
DRIFT_CHANGED = 0.1  # change of the drift, as a share of the largest, above which the fit is redone

_Solved = tuple[Whitening, Solution]


@dataclass(frozen=True, slots=True)
class Estimate:
    """One fitted parameter."""

    name: str  # effect and parameter, e.g. "joint_compliance.j2"
    value: float | None  # estimate, SI; None where the data do not determine it
    std: float | None  # standard uncertainty, SI; None where the data do not determine it
    unit: str
    identifiable: bool  # whether the data determine it

    def line(self, width: int = 0) -> str:
        """Return the parameter as a line, the name padded to a width."""
        value = "not determined"
        if self.value is not None and self.std is not None:
            value = f"{self.value: .4e} ± {self.std:.1e} {self.unit}"
        return f"  {self.name:<{width}}  {value}"


@dataclass(frozen=True, slots=True)
class Estimates(Brief, Sequence[Estimate]):
    """The fitted parameters, in the order of the model, without those of dropped groups."""

    rows: tuple[Estimate, ...]

    @classmethod
    def of(
        cls, model: Model, theta: Floats, std: Floats, identifiable: Bools, shown: Bools
    ) -> "Estimates":
        """Return the `shown` parameters (P,) of a model; an infinite `std` (P,) means unknown."""
        names = [(f"{e.name}.{p.name}", p.unit) for e in model.effects for p in e.parameters]
        rows = []
        for k in np.flatnonzero(shown).tolist():
            (name, unit), known = names[k], bool(identifiable[k])
            size = float(std[k]) if known and np.isfinite(std[k]) else None
            rows.append(Estimate(name, float(theta[k]) if known else None, size, unit, known))
        return cls(tuple(rows))

    def lines(self, most: int | None = None) -> list[str]:
        """Return a line for each parameter, or for the first `most`."""
        width = max((len(row.name) for row in self.rows), default=0)
        return [row.line(width) for row in self.rows[:most]]

    def __repr__(self) -> str:
        lines = self.lines(12)
        hidden = len(self.rows) - len(lines)
        tail = [f"  ... and {hidden} more"] * bool(hidden)
        return "\n".join(["Estimates(", *lines, *tail, ")"])

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Estimate]:
        return iter(self.rows)

    @overload
    def __getitem__(self, key: int | str) -> Estimate: ...
    @overload
    def __getitem__(self, key: slice) -> Sequence[Estimate]: ...
    def __getitem__(self, key: int | str | slice) -> Estimate | Sequence[Estimate]:
        """Return a parameter by place or by name; an unknown name is an InputError."""
        if isinstance(key, int | np.integer | slice):
            return self.rows[key]
        for row in self.rows:
            if row.name == key:
                return row
        names = tuple(row.name for row in self.rows)
        raise InputError(f"no parameter {key!r}{suggest(key, names)}; valid: {', '.join(names)}")

    def to_dicts(self) -> list[dict[str, object]]:
        """Return one dictionary per parameter, as in JSON documents."""
        return [asdict(row) for row in self.rows]

    def to_frame(self) -> "pd.DataFrame":
        """Return a pandas data frame, indexed by name; an InputError without pandas."""
        with needed_by("to_frame (to_dicts returns the same without pandas)"):
            import pandas as pd
        return pd.DataFrame(self.to_dicts()).set_index("name")


@dataclass(frozen=True, eq=False)
class Fit(WithVarianceFactor, Tabular):
    """A model fitted to readings.

    D is the number of measurements (readings or deflections), m the number of their elements, P
    the number of parameters.

    Attributes:
        model: robot and effects.
        readings: all readings.
        mode: "deflection" or "absolute".
        scaling: "none", "gu" or "gc".
        whitening: gc-scaling of the fitted readings.
        fitted: their scaling in the fit.
        solution: minimum found by Gauss-Newton.
        pose: (D,) distinct pose of each fitted measurement.
        raw: (D, m) residual.
        white: (R,) gc-whitened residual.
        outlier: (N,) readings set aside as gross errors.
        chi2: whitened sum of squares.
        dof: degrees of freedom.
        error: error block of the fit; like `holdout`, without the readings set aside.
        disagreement: readings that deviate strongly, but are fitted; None without any.

    `left_out`, `holdout` and `uncertainty`, which take long, are computed at the first access.
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
            "model": self.model.title,
            "fitted": f"{len(self.raw)} measurements ({self.mode}, scaling {self.scaling})",
            "set aside": f"{np.count_nonzero(self.outlier)} readings",
            "parameters": f"{len(self.theta)}",
            "error": f"{1e6 * self.error.rms_m:.1f} µm rms, {self.error.rms_sigma:.2f} σ",
            "chi2": f"{self.chi2:.4g} with {self.dof:.4g} degrees of freedom",
            "more": "summary(), parameters, covariance, residuals, to_frame(), predict()",
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
        """`holdout` with the gross errors; compares fits with different gross errors."""
        return error_block(*all_left_out(self))

    @cached_property
    def uncertainty(self) -> Uncertainty:
        """Standard uncertainties and identifiable parameters."""
        inliers = self.readings[~self.outlier]
        return uncertainty(
            self.model, inliers, self.fitted, self.solution, self.pose, self.chi2, self.dof
        )

    @cached_property
    def conflicts(self) -> tuple[Conflict, ...]:
        """Conflicts between a carried prior and the readings, worst first; empty without one."""
        return conflicts(self.model, self.solution, self.whitening)

    @property
    def contradictions(self) -> tuple[Conflict, ...]:
        """The conflicts beyond chance, whatever their number (Bonferroni), worst first."""
        return tuple(c for c in self.conflicts if c.p_value * len(self.conflicts) < CONFLICT_P)

    @property
    def theta(self) -> Floats:
        """(P,) parameters."""
        return self.solution.theta

    @property
    def rank(self) -> int:
        """Number of directions of the parameters that the data determine."""
        return int(self.solution.equations.basis.transform.shape[1])

    @property
    def is_saturated(self) -> bool:
        """Whether the fit has used up what the readings tell, so that its residual proves nothing.

        It has used more than half of their degrees of freedom; or more than half of the mean square
        error on poses left out comes from the parameters: further loads at the same poses add
        degrees of freedom, but tell nothing of what does not depend on the load.
        """
        return self.dof < self.whitening.rank / 2 or self.left_out_over_residual > 2.0

    @property
    def left_out_over_residual(self) -> float:
        """Mean square error on poses left out over that of the residual, by degree of freedom."""
        return self.holdout.rms_sigma**2 / max(self.variance_factor, 1.0)

    @property
    def mahalanobis2(self) -> Floats:
        """(D,) squared Mahalanobis distance of each measurement alone."""
        return mahalanobis2(self.raw, self.whitening.covariance)

    @property
    def parameters(self) -> Estimates:
        """The parameters of the named effects with their standard uncertainties.

        Parameters of dropped groups are left out.
        """
        u = self.uncertainty
        return Estimates.of(self.model, self.theta, u.std, u.identifiable, self._shown)

    @property
    def covariance(self) -> Floats:
        """(K, K) covariance of `parameters`, in their order; NaN where one is not determined."""
        from hilcal.identification.parameters_document import covariance_of  # which imports this

        return covariance_of(self)[np.ix_(self._shown, self._shown)]

    @property
    def _shown(self) -> Bools:
        shown = self.solution.estimated.copy()
        for name, rows in zip(self.model.names, self.model.slices(), strict=True):
            shown[rows] &= name not in self.model.background
        return shown

    def summary(self, details: bool = False) -> str:
        """Return the model, its errors and its parameters as plain text.

        Without `details` a family that shares a prior, and what is not determined, is in short.
        """
        fitted = f"fitted to {len(self.raw)} {self.mode} readings, scaling {self.scaling}"
        lines = [f"{self.model.title}, {fitted}"]
        for poses, e in (("fitted poses", self.error), ("poses left out", self.holdout)):
            lines.append(
                f"  error on {poses}: {1e6 * e.rms_m:.1f} µm rms, {1e6 * e.max_m:.1f} µm largest, "
                f"{e.rms_sigma:.2f} σ"
            )
        low, high = self.variance_factor_interval
        lines.append(f"  variance factor {self.variance_factor:.3g} [{low:.3g}, {high:.3g}]")
        if details:
            return "\n".join([*lines, *self.parameters.lines()])
        rows, families = list(self.parameters), []
        for effect in self.model.effects:
            family = [r for r in rows if r.name.startswith(f"{effect.name}.")]
            if family and effect.groups() is not None:
                rows = [r for r in rows if r not in family]
                top = max(family, key=lambda r: abs(r.value or 0.0))
                families.append(
                    f"  {effect.name}: {len(family)} parameters, the largest:\n{top.line()}"
                )
        lines += Estimates(tuple(r for r in rows if r.identifiable)).lines()
        unknown = [r.name for r in rows if not r.identifiable]
        families += [f"  not determined: {numbers.few(unknown, 3)}"] * bool(unknown)
        return "\n".join([*lines, *families])

    def to_dict(self) -> dict[str, object]:
        """Return the keys of `hilcal identify --json` (docs/reference/json.md), SI."""
        from hilcal.identification.fit_document import to_json  # which imports this module

        return to_json(self)

    @property
    def residuals(self) -> "Residuals":
        """Residuals, measured − predicted: `residuals()` are an array, `to_frame()` a table."""
        return Residuals(self)

    @cached_property
    def frames(self) -> RobotFrames:
        """Base and flange of the robot."""
        return robot_frames(self.model, self.theta)

    def predict(self, at: States | Readings) -> Observation:
        """Predict the readings of the sensor in N states, or in the states of readings.

        A fit to deflections does not correct the arm's geometry: its positions are those of the
        nominal arm that deflects, often a millimetre from the readings. `error_of` compares
        deflections.

        Raises:
            InputError: states without a column that an effect needs, of other joints, in degrees,
                or with values that are not finite.
            CannotAnswerError: no static equilibrium.
        """
        return self._prediction(at).observation

    def error_of(self, readings: Readings) -> ErrorBlock:
        """Error at other readings of this setup, as of poses that were not fitted.

        In the kind of readings of the fit: for deflections, that of the deflections.

        Raises:
            InputError: as of `predict`; or a deflection without its unloaded reading.
        """
        expect(readings, Readings, "readings", READINGS)
        w = whitening(readings, self.mode)
        return error_block(residual(readings, self._prediction(readings), w), w)

    def _prediction(self, at: States | Readings) -> Prediction:
        joints = "at joint values: hc.Calibration.of(fit).predict(q, wrench)"
        expect(at, (States, Readings), "at", f"{READINGS}, or States; {joints}")
        states = at.states if isinstance(at, Readings) else self._checked(at)
        for e in self.model.effects:
            if e.role not in FRAME_ROLES and not e.computable(states):
                raise InputError(f"the model has {e.name}, which needs {', '.join(e.needs)}")
        return self.model.predict(states, self.theta)

    def _checked(self, states: States) -> States:
        q = self.model.cell.arm.checked(states.q)
        wrench = array_of(states.wrench, "wrench", f"({len(q)}, 6)")
        if wrench.shape != (len(q), 6) or not np.isfinite(wrench).all():
            raise InputError(f"wrench has shape {wrench.shape}; valid: finite values ({len(q)}, 6)")
        return replace(states, q=q, wrench=wrench)


class Residuals(Sequence[Floats]):
    """Residuals of a fit, measured − predicted, m and rad.

    Their readings are `readings[~outlier][whitening.reading]`: for deflections the loaded readings,
    which are not in the order of the campaign. Also a sequence and an array (D, m) in sensor axes.
    """

    def __init__(self, fit: Fit) -> None:
        self._fit = fit

    def __call__(self, frame: Frame = "sensor") -> Floats:
        """Return an array (D, m) in axes of the "sensor", or of the arm's "base"."""
        raw = self._fit.raw
        if frame == "sensor":
            return raw
        if frame != "base":
            raise InputError(f"frame {frame!r} is unknown; valid: sensor, base")
        axes = sensor_axes(self._fit, self._fit.solution.prediction.observation)
        return in_base_axes(raw, axes[self._fit.whitening.reading])

    def to_frame(self) -> "pd.DataFrame":
        """Return a row for each reading: pose, load, residual, and residual without its pose."""
        return self._fit.to_frame()

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Floats:
        return np.array(self._fit.raw, dtype=dtype, copy=copy)

    def __len__(self) -> int:
        return len(self._fit.raw)

    def __getitem__(self, key: int | slice) -> Any:
        return self._fit.raw[key]

    def __repr__(self) -> str:
        rms = 1e6 * self._fit.error.rms_m
        return f"Residuals({len(self)} of {self._fit.mode} readings: {rms:.1f} µm rms)"


def sensor_axes(fit: Fit, observed: Observation) -> Floats:
    """(N, 3, 3) axes in which each of N readings is given, as rows in axes of the arm's base.

    A distance or height has one, the direction along which it is measured; the others are zero.
    """
    return np.asarray(observed.axes @ fit.frames.chain[:3, :3].T)


def in_base_axes(vectors: Floats, axes: Floats) -> Floats:
    """Turn vectors (D, m) of readings with their `sensor_axes` (D, 3, 3) into base axes."""
    parts = vectors.reshape(len(vectors), -1, 3)
    return np.asarray(np.einsum("dki,dij->dkj", parts, axes).reshape(vectors.shape))


def require_gc(fit: Fit, task: str) -> None:
    """Refuse a fit whose residual is not whitened by the full covariance."""
    if fit.scaling != "gc":
        raise InputError(f"{task} needs a fit with scaling gc, this one has {fit.scaling}")


def mahalanobis2(raw: Floats, covariance: Floats) -> Floats:
    """Squared Mahalanobis distances (D,) of residuals (D, m) with covariances (D, m, m)."""
    white = np.einsum("dij,dj->di", whitening_matrix(covariance), raw)
    return np.asarray(np.sum(white**2, axis=1))


def fit(
    model: Model,
    readings: Readings,
    mode: Mode,
    scaling: Scaling = "gc",
    start: Floats | None = None,
    prior: Floats | None = None,
    outlier: Bools | None = None,
) -> Fit:
    """Fit a model to readings.

    `start` and `prior` of a previous fit reproduce it in few steps. The drift of a carried prior is
    estimated from the readings, unless `prior` is given; where they contradict it, and are likelier
    of another arm of the type, the fit has it as such.

    Gross errors are set aside: they stay in the file and are listed, but are not fitted. They are
    sought unless `outlier` (N,) says which readings they are; whether the others disagree is tested
    all the same.

    Raises:
        CannotAnswerError: fewer measured elements than identifiable parameters.
        InputError: a deflection without its unloaded reading, or too many readings.
    """
    limits.check_fitted(len(readings), readings.m)
    fitted = _fit(model, readings, mode, scaling, start, prior, outlier)
    carried = fitted.model.prior
    if carried is None or prior is not None or carried.relation != "arm" or scaling != "gc":
        return fitted
    if not fitted.contradictions:
        return fitted
    another = replace(model, prior=carried.of_another_arm(model.catalogue))
    other = _fit(another, readings, mode, scaling, fitted.theta, None, fitted.outlier)
    same = fitted.model, fitted.solution
    if not of_another_arm(same, (other.model, other.solution), fitted.whitening):
        return fitted
    if not fitted.outlier.any():
        return other
    return _fit(another, readings, mode, scaling, other.theta, None, outlier)


def _fit(
    model: Model,
    readings: Readings,
    mode: Mode,
    scaling: Scaling,
    start: Floats | None,
    prior: Floats | None,
    outlier: Bools | None,
) -> Fit:
    if model.prior is not None and prior is None:
        model = replace(model, prior=model.prior.with_drift(None))
    used, disagreement, (w, solution) = _set_aside(model, readings, mode, start, prior, outlier)
    if model.prior is not None and prior is None:
        for _ in range(DRIFT_ROUNDS):
            drift, old = chosen_drift(model, solution, w), model.prior.drift
            change = np.abs(drift - (0.0 if old is None else old)).max()
            if change <= DRIFT_CHANGED * drift.max(initial=0.0):
                break
            model = replace(model, prior=model.prior.with_drift(drift))
            restart = solution.theta
            used, disagreement, (w, solution) = _set_aside(
                model, readings, mode, restart, None, outlier
            )
    inliers, fitted = readings[used], w
    if scaling != "gc":
        fitted, solution = _solve(model, inliers, mode, scaling, start, prior)
        w = whitening(inliers, mode, "gc")
    white = w.whiten(solution.raw).reshape(-1)
    return Fit(
        model=model,
        readings=readings,
        mode=mode,
        scaling=scaling,
        whitening=w,
        fitted=fitted,
        solution=solution,
        pose=distinct_poses(inliers)[w.reading],
        raw=solution.raw,
        white=white,
        outlier=~used,
        chi2=float(white @ white),
        dof=max(w.rank - solution.effective, 1.0),
        error=error_block(solution.raw, w),
        disagreement=disagreement,
    )


def fit_again(
    before: Fit,
    model: Model | None = None,
    readings: Readings | None = None,
    start: Floats | None = None,
    outlier: Bools | None = None,
) -> Fit:
    """Repeat a fit with another model or other readings, by default from its parameters.

    Without `outlier`, gross errors are sought again, except for a fit with a background, whose
    gross errors were found beside all effects. Raises as `fit`.
    """
    if outlier is None and before.model.background:
        outlier = before.outlier
    return fit(
        before.model if model is None else model,
        before.readings if readings is None else readings,
        before.mode,
        before.scaling,
        before.theta if start is None else start,
        outlier=outlier,
    )


def _set_aside(
    model: Model,
    readings: Readings,
    mode: Mode,
    start: Floats | None,
    prior: Floats | None,
    outlier: Bools | None,
) -> tuple[Bools, Disagreement | None, _Solved]:
    """Readings (N,) without gross errors, their disagreement, and their gc-scaled solution."""
    if outlier is not None:
        used = ~outlier
        w, solution = _solve(model, readings[used], mode, "gc", start, prior)
        screened = _screened(model, readings[used], mode, (w, solution), start)
        disagreement = None if screened is None else screened.disagreement
        if disagreement is not None:
            rows = np.flatnonzero(used)[disagreement.rows]
            disagreement = replace(disagreement, rows=rows)
        return used, disagreement, (w, solution)
    used = np.ones(len(readings), dtype=bool)
    w, solution = _solve(model, readings, mode, "gc", start, prior)
    screened = _screened(model, readings, mode, (w, solution), start)
    if screened is None:
        return used, None, (w, solution)
    for _ in range(OUTLIER_ROUNDS):
        if np.array_equal(screened.used, used):
            break
        used = screened.used
        w, solution = _solve(model, readings[used], mode, "gc", solution.theta, prior)
        screened = DataSnooping(model, readings, mode, solution, solution.y).retest(screened)
    return used, screened.disagreement, (w, solution)


def _screened(
    model: Model, readings: Readings, mode: Mode, solved: _Solved, start: Floats | None
) -> SnoopingResult | None:
    """Test the readings of a solution for gross errors; None where none deviates strongly."""
    w, solution = solved
    distance2 = mahalanobis2(solution.raw, w.covariance)
    if distance2.max() <= rejection_limit(w.m, len(distance2)):
        return None
    y = np.zeros(model.size) if start is None else solution.space.of_theta(start)
    return DataSnooping(model, readings, mode, solution, y).test(np.random.default_rng(SEED))


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
        noun = "loaded readings with their unloaded ones" if mode == "deflection" else "readings"
        raise CannotAnswerError(
            f"{w.rank} measured elements for {free} parameters: nothing is left to judge the model "
            f"by; measure at least {free // w.m + 2} {noun}, better {3 * free // w.m + 1}"
        )
    return w, solution


def with_outliers(fitted: Fit) -> tuple[Floats, Whitening]:
    """Residual (D, m) of all readings, gross errors included, and their gc-scaling."""
    if not fitted.outlier.any():
        return fitted.raw, fitted.whitening
    w = whitening(fitted.readings, fitted.mode, "gc")
    prediction = fitted.model.predict(fitted.readings.states, fitted.theta)
    return residual(fitted.readings, prediction, w), w


def all_left_out(fitted: Fit) -> tuple[Floats, Whitening]:
    """Residual (D, m) of all readings, those fitted predicted without their pose; its scaling."""
    raw, w = with_outliers(fitted)
    if w is fitted.whitening:
        return fitted.left_out, w
    place = np.full(len(fitted.readings), -1)
    place[np.flatnonzero(~fitted.outlier)[fitted.whitening.reading]] = np.arange(len(fitted.raw))
    row = place[w.reading]
    return np.where((row >= 0)[:, None], fitted.left_out[row], raw), w
