"""Prediction of readings that a model was never fitted to: errors, extrapolation, acceptance.

A model may be wrong wherever nothing was measured, however well it predicts poses left out among
those that were. A reading is outside where one of its variables exceeds the range of the fitted
readings by more than `MARGIN` of that range; angles count modulo whole turns, unless the model
distinguishes these (`whole_turns`). Joint angles inside of their ranges can be far from all fitted
ones as well; then the variance tr J C Jᵀ of a predicted position, by the parameters alone, is
large, compared with that of fitted positions, each predicted without the readings of its pose.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import scipy

from hilcal.cell import Cell
from hilcal.config.cell import Tool
from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.prediction.predictive import Predictive
from hilcal.identification.registration.registration import register, targets_as_fitted
from hilcal.identification.registration.robot_frames import whole_turns
from hilcal.identification.residual import ErrorBlock, error_block, noise_floor, residual
from hilcal.model.model import Model
from hilcal.readings.readings import Readings, ranges_of, turning_variables, variables
from hilcal.readings.whitening import Mode, Whitening, whitening, whitening_matrix
from hilcal.shown import Brief
from hilcal.types import Bools, Floats, Ints

STEPS = 10  # most Gauss-Newton steps of a registration; a choice
CONVERGED = 1e-6  # step of a registration that ends it, in σ per whitened element; a choice
# variance by the parameters alone from which a reading is outside, in units of that which one in a
# hundred of the fitted measurements exceeds; a choice
FAR = 2.0
POSITION_STD = "standard deviation of the position"
"""Name of the variable that tells points far from all fitted poses in several joints together."""
BAND = 0.95  # probability of the band that is stated, as is usual (GUM)


@dataclass(frozen=True, slots=True, eq=False)
class Validation(Brief):
    """Prediction errors of readings that a model was not fitted to."""

    readings: Readings
    whitening: Whitening  # their gc-scaling
    raw: Floats  # (D, m) residual
    error: ErrorBlock
    variance_factor: float  # whitened sum of squares by its rank, less a registration's
    registered: bool  # whether the registration was estimated anew

    @property
    def noise_floor(self) -> float:
        """Root mean square of the 3-D position error under the stated noise alone, m."""
        return noise_floor(self.whitening.covariance)


def validate(
    model: Model,
    theta: Floats,
    fitted: Readings,
    other: Readings,
    mode: Mode,
    *,
    registered: bool = False,
) -> Validation:
    """Predict other readings, which were not fitted, with a fitted model.

    `registered` says that the model's registration was fitted to them (see `set_up_anew`).

    Raises:
        InputError: an effect of the model needs a column that the other readings lack.
    """
    other = other.with_observers(fitted.observers)
    require_columns(model, other, "other")
    w = whitening(other, mode, "gc")
    raw = residual(other, model.predict(other.states, theta), w)
    white = w.whiten(raw).reshape(-1)
    factor = float(white @ white) / max(w.rank - (6 if registered else 0), 1)
    return Validation(other, w, raw, error_block(raw, w), factor, registered)


def with_tool(p: Predictive, cell: Cell, fitted: Readings) -> Predictive:
    """Return the distribution for readings with the tool of another cell: its masses and targets.

    Its targets are taken where both cells state theirs. Effects of the target's place are then left
    out, as they were estimated for the other target.
    """
    fitted_cell = p.model.cell
    tool = replace(
        fitted_cell, tool_mass=cell.tool_mass, tool_com=cell.tool_com, load_point=cell.load_point
    )
    effects = list(zip(p.model.effects, p.model.slices(), strict=True))
    if all((*fitted_cell.known_targets, *cell.known_targets)) and other_target(fitted_cell, cell):
        tool = tool.with_targets(cell.all_targets, cell.known_targets)
        effects = [(e, s) for e, s in effects if e.role != "target"]
    made = tuple(type(e)(tool, fitted.states, e.options) for e, _ in effects)
    indices = np.concatenate([np.arange(p.model.size)[s] for _, s in effects])
    return replace(
        p,
        model=replace(p.model, cell=tool, effects=made),
        theta=p.theta[indices],
        covariance=p.covariance[np.ix_(indices, indices)],
        by_variances=p.by_variances[indices],
        prior=p.prior[indices],
    )


def other_target(first: Cell, second: Cell) -> bool:
    """Whether two cells have different targets, or other places of them on the flange."""

    def targets(tool: Tool | None) -> object:
        return None if tool is None else (tool.target_m, tool.target_rotvec_rad, tool.targets)

    a, b = (targets(c.config.tool if c.config else None) for c in (first, second))
    return first.target_names != second.target_names or a != b


def require_columns(model: Model, readings: Readings, which: str) -> None:
    """Refuse readings ("other", "later") without a column that an effect of the model needs."""
    for effect in model.effects:
        if effect.role not in FRAME_ROLES and not effect.computable(readings.states):
            raise InputError(
                f"effect {effect.name} needs {', '.join(effect.needs)}, which the {which} readings "
                "do not have"
            )


def set_up_anew(p: Predictive, fitted: Readings, other: Readings, mode: Mode) -> Predictive:
    """Return the distribution for a tracker that was set up anew to take the other readings.

    Its registration, and nothing else, is fitted to them: in closed form, then by Gauss-Newton on
    `base_frame`. An error δ of the other parameters moves the registration by −F⁺ J δ, where F and
    J are whitened derivatives of the other readings by it and by δ; so what a registration absorbs
    is no error of the prediction. All covariances are then in axes of the new tracker.

    Raises:
        InputError: several observers, or an effect needs a column that the other readings lack.
        CannotAnswerError: the registration does not converge.
    """
    other = other.with_observers(fitted.observers)
    if other.states.observer is not None:
        raise InputError(
            "several observers: where they stand is told by the readings that were fitted; valid: "
            "readings by them, without a registration anew, or by one tracker"
        )
    model, theta = p.model, p.theta
    require_columns(model, other, "other")
    w = whitening(other, mode, "gc")
    targets = targets_as_fitted(model, theta)
    held = model.cell.with_targets(targets, known=(True,) * len(targets))
    registered = register(replace(held, registration_known=False), other)
    cell = replace(model.cell, registration=registered.cell.registration)
    parts = list(zip(model.effects, model.slices(), strict=True))
    retained = [(e, np.arange(model.size)[s]) for e, s in parts if e.role != "registration"]
    indices = np.concatenate([np.zeros(0, dtype=np.int64), *(s for _, s in retained)])
    effects: list[Effect] = [type(e)(cell, fitted.states, e.options) for e, _ in retained]
    frame = model.catalogue.with_role("registration")[0](cell, fitted.states)
    moved = replace(model, cell=cell, effects=(*effects, frame))
    values = np.concatenate([theta[indices], np.zeros(6)])
    for _ in range(STEPS):
        prediction = moved.predict(other.states, values)
        white = w.whiten(residual(other, prediction, w)).reshape(-1)
        rows = w.whiten(w.raw(moved.jacobian(prediction, values, w.m))).reshape(-1, moved.size)
        columns = rows[:, -6:]
        step = np.linalg.lstsq(columns, white, rcond=1e-9)[0]
        values[-6:] += step
        if float(np.linalg.norm(columns @ step)) < CONVERGED * len(white):
            break
    else:
        raise CannotAnswerError(
            "registration: does not converge on these readings; measure poses spread in space"
        )
    absorbed = np.linalg.lstsq(columns, rows[:, :-6], rcond=1e-9)[0]
    lift = np.vstack([np.eye(len(indices)), -absorbed])
    return replace(
        p,
        model=moved,
        theta=values,
        covariance=lift @ p.covariance[np.ix_(indices, indices)] @ lift.T,
        by_variances=lift @ p.by_variances[indices],
        prior=np.concatenate([p.prior[indices], np.full(6, np.inf)]),
    )


@dataclass(frozen=True, slots=True)
class ExceededRange:
    """Readings beyond the fitted range of one variable."""

    variable: str  # e.g. "joint 2 angle", "force", `POSITION_STD`
    unit: str  # SI
    low: float  # smallest fitted value
    high: float  # largest fitted value; of `POSITION_STD`, the limit
    count: int  # number of measurements beyond
    most: float  # how far the farthest is beyond


@dataclass(frozen=True, slots=True, eq=False)
class Extrapolation(Brief):
    """The stated errors of predictions of new readings, and which of these lie outside."""

    outside: Bools  # (D,) measurements that lie outside in any variable
    variables: tuple[ExceededRange, ...]  # those that are exceeded, most measurements first
    stated_m: Floats  # (D,) stated standard deviation of the 3-D position error, m
    z: Floats  # (D,) error over the stated standard deviation, rms of the elements
    z_position: Floats  # (D,) the same of the position alone
    inside_error: ErrorBlock | None  # of the measurements inside; None where there are none
    outside_error: ErrorBlock | None  # of those outside

    def to_dict(self) -> dict[str, object]:
        """Return the keys of `validate --json` on extrapolation and stated standard deviations."""
        z, errors = self.z, {"inside": self.inside_error, "outside": self.outside_error}
        members = {"inside": ~self.outside, "outside": self.outside}
        return {
            "stated_rms_m": _rms(self.stated_m),
            "z_rms": _rms(z),
            "extrapolation": {
                "n_outside": int(self.outside.sum()),
                "variables": [
                    {
                        "variable": v.variable,
                        "unit": v.unit,
                        "measured": [v.low, v.high],
                        "n_outside": v.count,
                        "beyond": v.most,
                    }
                    for v in self.variables
                ],
                **{f"error_{k}": None if e is None else e.to_json() for k, e in errors.items()},
                **{f"z_{k}": _rms(z[rows]) if rows.any() else None for k, rows in members.items()},
            },
        }


def farthest_m2(p: Predictive) -> float:
    """Return the variance of a position, by the parameters alone, from which it is outside, m²."""
    return FAR * float(np.quantile(p.pose_m2, 0.99))


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


def extrapolation(p: Predictive, fitted: Readings, validation: Validation) -> Extrapolation:
    """Compare predicted readings with those that a model was fitted to."""
    w, readings, raw = validation.whitening, validation.readings, validation.raw
    units = p.model.cell.arm.units
    prediction = p.model.predict(readings.states, p.theta)
    spread = p.prediction_covariance(prediction, w)
    noise = p.noise_covariance(p.noise_whitening(readings, w.mode))
    beyond, outside = [], np.zeros(len(w.reading), dtype=np.bool_)
    ranges = {r.variable: r for r in ranges_of(fitted.states, units)}
    turning = turning_variables(whole_turns(p.model, p.theta))
    for name, unit, values in variables(readings.states, units):
        if name not in ranges:
            continue
        r, x, turns = ranges[name], values[w.reading], name in turning
        far = r.beyond(x, turning=turns)
        if far.any():
            most = float(r.over(x[far], turning=turns).max())
            beyond.append(ExceededRange(name, unit, r.low, r.high, int(far.sum()), most))
        outside |= far
    by_parameters = np.sqrt(p.factor * p.position_m2(prediction, w))
    limit = float(np.sqrt(p.factor * farthest_m2(p)))
    far = by_parameters > max(limit, 1e-12)
    if far.any():
        most = float(by_parameters.max() - limit)
        beyond.append(ExceededRange(POSITION_STD, "m", 0.0, limit, int(far.sum()), most))
    outside |= far
    total = spread + noise

    def ratio(m: int) -> Floats:
        """Error over stated standard deviation (D,) of the first m elements."""
        square, read = _squares(total[:, :m, :m], raw[:, :m])
        return np.asarray(np.sqrt(square / np.maximum(read, 1)))

    def error(rows: Bools) -> ErrorBlock | None:
        """Errors of some measurements, each whitened by itself."""
        if not rows.any():
            return None
        squares, elements = _squares(w.covariance[rows], raw[rows])
        return ErrorBlock.of(raw[rows], np.sqrt(squares), int(elements.sum()))

    return Extrapolation(
        outside=outside,
        variables=tuple(sorted(beyond, key=lambda v: -v.count)),
        stated_m=np.sqrt(np.trace(total[:, :3, :3], axis1=1, axis2=2)),
        z=ratio(w.m),
        z_position=ratio(3),
        inside_error=error(~outside),
        outside_error=error(outside),
    )


def _squares(covariance: Floats, raw: Floats) -> tuple[Floats, Ints]:
    """Squared Mahalanobis distances (D,) of residuals (D, m), and elements that were read (D,)."""
    root = whitening_matrix(covariance)
    square = np.sum(np.einsum("dij,dj->di", root, raw) ** 2, axis=1)
    return square, np.asarray(np.count_nonzero(np.any(root != 0, axis=2), axis=1))


@dataclass(frozen=True, slots=True)
class Judged:
    """Which readings are judged."""

    number: int | None  # of the revision; None for a baseline that is not stored
    mode: Mode
    readings: int  # number of readings in the other campaign
    fitted: int  # number of these that the revision was fitted to
    sharing_unloaded: int  # further ones whose unloaded reading was fitted
    unseen: bool  # whether those that are judged were never fitted; False where all were
    scalar: bool = False  # whether some readings are one number, a distance or a height
    turns_aside: bool = False  # whether orientations are left aside, of which the model has none

    @property
    def model(self) -> str:
        """The revision, in words."""
        return "the baseline" if self.number is None else f"revision {self.number}"

    @property
    def what(self) -> str:
        """The measurements, in words."""
        if self.mode == "deflection":
            return "deflections"
        return "readings" if self.scalar else "positions"


@dataclass(frozen=True, slots=True)
class Share:
    """The measurements of one load, or of one pose."""

    name: str  # name of the load or the pose
    count: int
    rms_m: float  # root mean square of their 3-D position error, m
    max_m: float  # the largest, m
    worst: str  # load (or pose) of the largest
    stated_m: float  # rms of their stated standard deviation, m
    z: float  # rms of error over stated standard deviation, per element
    within: float  # share inside of their 95 % region, rᵀ C⁻¹ r ≤ χ²(0.95, m), C as stated

    def passes(self, limit_m: float) -> bool:
        """Whether no error is larger than a limit, m."""
        return self.max_m <= limit_m


@dataclass(frozen=True, slots=True, eq=False)
class Acceptance(Brief):
    """All measurements, by load and by pose."""

    loads: tuple[Share, ...]  # in the order of the campaign's loads
    poses: tuple[Share, ...]  # the largest error first
    everything: Share
    limit_m: float | None  # the largest error that is allowed, m; None where no limit is given
    over: int  # number of measurements over the limit
    noise_m: float  # rms that noise alone would leave, m

    @property
    def passed(self) -> bool | None:
        """Whether no error exceeds the limit; None without a limit."""
        return None if self.limit_m is None else self.over == 0

    @property
    def undecided(self) -> bool:
        """Whether the limit is exceeded, but is smaller than the noise of the readings."""
        return self.passed is False and self.limit_m is not None and self.limit_m < self.noise_m

    def to_dict(self) -> dict[str, object]:
        """Return the keys of `validate --json` on loads, poses and the limit."""
        limit = self.limit_m

        def document(s: Share, kind: str, opposite: str) -> dict[str, object]:
            d = {kind if k == "name" else k: v for k, v in asdict(s).items()}
            d[f"worst_{opposite}"] = d.pop("worst")
            return d if limit is None else {**d, "passed": s.passes(limit)}

        return {
            "within_95": self.everything.within,
            "loads": [document(s, "load", "pose") for s in self.loads],
            "poses": [document(s, "pose", "load") for s in self.poses],
            "limit": None
            if limit is None
            else {"limit_m": limit, "passed": self.passed, "n_over": self.over},
        }


@dataclass(frozen=True, slots=True, eq=False)
class CampaignValidation(Brief):
    """Readings of another campaign against a revision."""

    model: Model  # of the revision
    judged: Judged  # which of the readings are judged
    prediction: Validation  # of these
    beyond: Extrapolation  # their stated errors, and which of them lie outside
    shares: Acceptance  # errors by load and by pose, and against a limit
    tool: tuple[str, ...] = ()  # keys of [tool] that are those of the other campaign

    def _brief(self) -> dict[str, str]:
        error, noise = self.prediction.error, self.prediction.noise_floor
        return {
            "model": self.model.title,
            "readings": f"{len(self.prediction.raw)} predicted",
            "error": f"{1e6 * error.rms_m:.1f} µm rms, noise alone {1e6 * noise:.1f} µm",
            "variance factor": f"{self.prediction.variance_factor:.3g}",
            "more": "judged, prediction, beyond, shares",
        }


def acceptance(
    validation: Validation, beyond: Extrapolation, limit_m: float | None = None
) -> Acceptance:
    """Divide prediction errors by load and by pose, and compare them with a limit, m."""
    r, rows = validation.readings, validation.whitening.reading
    error = np.linalg.norm(validation.raw[:, :3], axis=1)
    variance = np.diagonal(validation.whitening.covariance, axis1=1, axis2=2)
    read = np.maximum(np.count_nonzero(variance > 0, axis=1), 1)
    inside = beyond.z**2 * read <= scipy.stats.chi2.ppf(BAND, read)
    load, pose = (r.load[rows], r.load_names), (r.pose[rows], r.pose_names)

    def share(name: str, members: Bools, opposite: tuple[Ints, Sequence[str]]) -> Share:
        worst = int(np.argmax(np.where(members, error, -1.0)))
        return Share(
            name=name,
            count=int(members.sum()),
            rms_m=_rms(error[members]),
            max_m=float(error[worst]),
            worst=opposite[1][opposite[0][worst]],
            stated_m=_rms(beyond.stated_m[members]),
            z=_rms(beyond.z[members]),
            within=float(inside[members].mean()),
        )

    loads, poses = (
        [share(groups[1][k], groups[0] == k, opposite) for k in np.unique(groups[0]).tolist()]
        for groups, opposite in ((load, pose), (pose, load))
    )
    return Acceptance(
        loads=tuple(loads),
        poses=tuple(sorted(poses, key=lambda s: -s.max_m)),
        everything=share("all", np.ones(len(rows), dtype=np.bool_), pose),
        limit_m=limit_m,
        over=0 if limit_m is None else int(np.sum(error > limit_m)),
        noise_m=validation.noise_floor,
    )
