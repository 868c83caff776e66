"""The goal of a campaign: standard uncertainties of parameters or positions to be reached."""

import re
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.design.feasible import FeasibleSpace
from hilcal.design.nominal_model import model_after, nominal_model, planned_effects
from hilcal.design.predicted import positions_of, prediction_poses, rms
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.errors import HilcalError, InputError
from hilcal.identification.baseline import with_effects
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.fit import Fit, fit
from hilcal.identification.noise.full_covariance import with_joint_scatter
from hilcal.measuring.progress import GoalStatus
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, has_unloaded
from hilcal.tables.units import METRIC
from hilcal.types import Floats

JOINTS = JointCompliance.name  # the effect that "joint" and "j3" abbreviate
FORMS = (
    '"joint std < 2 %"', '"j3 std < 3 %"', '"joint_compliance.j3 std < 1e-7 rad/(N·m)"',
    '"joint_tilt_compliance std < 10 %"', '"position std < 20 um"', '"deflection std < 20 um"',
)  # fmt: skip
POSITIONS = ("position", "deflection")  # of predictions where the robot will work
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "µrad": 1e-6, "μrad": 1e-6}
_SHAPE = re.compile(
    r"\s*(?P<what>[\w.]+)\s+std\s*(?:<=|<|≤)\s*(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*"
    r"(?P<unit>\S.*?)?\s*"
)


@dataclass(frozen=True, slots=True)
class Goal:
    """Standard uncertainties to be reached."""

    text: str  # as the user wrote it
    quantity: str  # "position" or "deflection", or a parameter or an effect by name
    limit: float  # largest standard uncertainty: a share of the value, or SI
    relative: bool  # whether it is a share of the parameter's value
    unit: str  # SI unit of the limit; "" for a share

    @property
    def of_position(self) -> bool:
        """Whether the goal is about predictions where the robot will work, not about parameters."""
        return self.quantity in POSITIONS

    def names(self, parameters: Iterable[str]) -> tuple[str, ...]:
        """Return the parameters that the goal is about, out of `parameters`."""
        parameters = tuple(parameters)
        names = tuple(n for n in parameters if self.quantity in (n, n.split(".")[0]))
        if not names:
            effects = dict.fromkeys(name.split(".")[0] for name in parameters)
            raise InputError(
                f'goal "{self.text}": {self.quantity} is not in the model; valid: position, '
                f"{', '.join(effects)}, or one parameter, e.g. {next(iter(parameters), 'none')}"
            )
        return names

    def check(self, units: Mapping[str, str]) -> None:
        """Refuse a goal that does not fit the parameters of a model, given the SI unit of each."""
        for name in () if self.of_position else self.names(units):
            if not self.relative and _plain(units[name]) != self.unit:
                raise InputError(
                    f'goal "{self.text}": {name} is in {units[name]}; give that unit, or %'
                )

    def status(
        self,
        stds: Mapping[str, float],  # of each parameter, SI; infinite where not identifiable
        values: Mapping[str, float],
        position: float | None = None,  # of the predictions, m; infinite if undetermined
        predicted: str = "",  # their name, e.g. "deflection under 5kg at 100 poses"
    ) -> GoalStatus:
        """Judge standard uncertainties."""
        if self.of_position:
            if position is None:
                raise InputError(
                    f'goal "{self.text}": no prediction poses; give [planning] work_q_rad, or '
                    "work_min_m and work_max_m"
                )
            ratio = _ratio(float(position), self.limit)
            quantity = f"standard uncertainty (rms) of the predicted {predicted or self.quantity}"
            return self._status(ratio, self.quantity, float(position), "m", quantity)
        status, worst = GoalStatus(self.text, True), -1.0
        for name in self.names(stds):
            std = float(stds[name])
            if self.relative:
                size = abs(float(values[name]))
                std = std / size if size > 0 else float(np.inf)
            ratio = _ratio(std, self.limit)
            if ratio > worst:
                shown = (100 * std, "%") if self.relative else (std, self.unit)
                quantity = f"standard uncertainty of {name}"
                status, worst = self._status(ratio, name, *shown, quantity), ratio
        return status

    def _status(self, ratio: float, worst: str, std: float, unit: str, quantity: str) -> GoalStatus:
        return GoalStatus(self.text, bool(ratio <= 1.0), worst, std, ratio, unit, quantity=quantity)


def parse_goal(text: str) -> Goal:
    """Parse a goal, e.g. "joint std < 2 %"; `joint`: all joint compliances, `j3`: the third."""
    match = _SHAPE.fullmatch(text)
    if match is None:
        raise _wrong(text, "not understood")
    try:
        number = float(match["number"])
    except ValueError:
        raise _wrong(text, f"{match['number']} is no number") from None
    if not (np.isfinite(number) and number > 0):
        raise _wrong(text, f"{match['number']} cannot be a standard uncertainty")
    quantity, unit = match["what"], _plain(match["unit"] or "")
    if not unit:
        raise _wrong(text, "the unit is missing")
    if quantity in POSITIONS:
        if unit not in METRIC:
            raise _wrong(text, f"a {quantity} is in {', '.join(list(METRIC)[:3])}, not {unit}")
        return Goal(text, quantity, number * METRIC[unit], False, "m")
    if quantity == "joint":
        quantity = JOINTS
    elif re.fullmatch(r"j\d+", quantity):
        quantity = f"{JOINTS}.{quantity}"
    if unit == "%":
        return Goal(text, quantity, number / 100, True, "")
    for base, prefixes in (("m", METRIC), ("rad", _ANGLES)):
        if unit in prefixes:
            return Goal(text, quantity, number * prefixes[unit], False, base)
    return Goal(text, quantity, number, False, unit)


def _ratio(std: float, limit: float) -> float:
    return float(np.inf) if np.isnan(std) else std / limit


def _plain(unit: str) -> str:
    """Normalise a unit: rad/(N*m) and rad/Nm become rad/(N·m)."""
    text = unit.replace(" ", "").replace("*", "·").replace("Nm", "N·m").replace("^3", "³")
    return text.replace("/N·m", "/(N·m)")


def _wrong(text: str, why: str) -> InputError:
    return InputError(f'goal "{text}": {why}; valid: {", ".join(FORMS)}')


FIT_TIME_SHARE = 0.1  # largest share of the measuring time that fits may take


class GoalRule:
    """Stopping rule of a campaign: a goal, checked with the fit of `hilcal identify`.

    The goal is met if the fit converged and the readings determine the goal's quantity. Where the
    residual exceeds the noise, the uncertainty is scaled by an estimated variance factor, which may
    be small by chance in one of many checks: then two consecutive fits have to meet the goal,
    except at the plan's end.
    """

    def __init__(
        self,
        text: str,  # the goal, e.g. "joint std < 2 %"
        cell: Cell,
        catalogue: Catalogue | None = None,  # the installed effects by default
        now: Callable[[], float] = time.monotonic,  # clock of the people, s
    ) -> None:
        """Parse a goal, and check it against the cell's model."""
        config = cell.configured()
        self.goal, self.status = parse_goal(text), GoalStatus(text)
        self._cell, self._config, self._now = cell, config, now
        self._catalogue = catalogue or installed()
        self._scatter = config.repeatability.per_joint(cell.arm.n)
        model = nominal_model(cell, 3, catalogue)
        effects = model.model.effects
        self.goal.check({f"{e.name}.{p.name}": p.unit for e in effects for p in e.parameters})
        self._work_q: tuple[tuple[float, ...], ...] = ()
        self._predicted = ""
        if self.goal.of_position:
            predicted = "position" if config.readings_mode == "absolute" else "deflection"
            if self.goal.quantity != predicted:
                raise InputError(
                    f'goal "{text}": [planning] readings = "{config.readings_mode}", which show '
                    f"the {predicted}; valid: {predicted}"
                )
            planning = config.planning
            if not planning.work_q_rad and planning.work_min_m is None:
                self.goal.status({}, {})  # raises: names the missing keys
            work = prediction_poses(
                model, config, np.zeros((0, cell.arm.n)), FeasibleSpace(cell).collision_free
            )
            self._work_q = tuple(dict.fromkeys(tuple(q) for q in work.q.tolist()))
            self._predicted = work.description
        self._last_met = False  # whether the last fit met the goal
        self._fit_end = self._fit_time = -np.inf  # of the last fit, s

    def __call__(self, readings: Readings, last: bool) -> GoalStatus:
        """Return the status of the goal after some readings; `last`: the plan ends with them."""
        start = self._now()
        if last or (
            start - self._fit_end >= self._fit_time / FIT_TIME_SHARE and self._adds_data(readings)
        ):
            try:
                status, fitted = self._fit(readings)
                good = status.met and fitted.solution.converged
                sure = last or self._last_met or not fitted.uncertainty.inflated
                self.status, self._last_met = replace(status, met=good and sure), good
            except (HilcalError, np.linalg.LinAlgError):
                self.status, self._last_met = GoalStatus(self.goal.text), False
            self._fit_end = self._now()
            self._fit_time = self._fit_end - start
        return self.status

    def _fitted(self, readings: Readings) -> tuple[Readings, Mode]:
        """Return the readings to fit, and the mode; deflections need an unloaded reading."""
        if self._config.planning.readings == "absolute":
            return readings, "absolute"
        paired = readings[has_unloaded(readings)]
        return paired, "absolute" if paired.unloaded.all() else "deflection"

    def _adds_data(self, readings: Readings) -> bool:
        """Whether the last reading adds data: loaded, or unloaded with a loaded one at its pose."""
        free = readings.unloaded
        if not free[-1] or self._fitted(readings)[1] == "absolute":
            return True
        same = (readings.pose == readings.pose[-1]) & (readings.cycle == readings.cycle[-1])
        return bool((same & ~free).any())

    def _fit(self, readings: Readings) -> tuple[GoalStatus, Fit]:
        readings, mode = self._fitted(readings)
        readings = with_joint_scatter(self._cell, readings, self._scatter)
        effects = planned_effects(self._config, self._catalogue)
        model = with_effects(self._cell, readings, mode, effects, effects, self._catalogue)
        fitted = fit(model, readings, mode)
        names = [f"{e.name}.{p.name}" for e in fitted.model.effects for p in e.parameters]
        free = zip(names, fitted.uncertainty.std.tolist(), fitted.solution.prior != 0, strict=True)
        stds = {name: std for name, std, is_free in free if is_free}
        values = dict(zip(names, fitted.theta.tolist(), strict=True))
        position = self._position(fitted) if self._work_q else None
        status = self.goal.status(stds, values, position, self._predicted)
        return replace(status, model=fitted.model.named, fitted=fitted.mode), fitted

    def _position(self, fitted: Fit) -> float:
        """Return the RMS standard uncertainty of the predictions where the robot will work, m.

        From the fit's covariance T H⁻¹ Tᵀ, inflated as `identify` inflates that of the parameters.
        Infinite where undetermined directions move the predictions, and where the degrees of
        freedom do not exceed the number of parameters that the fit holds at zero.
        """
        if fitted.mode != self._config.planning.readings:
            return float(np.inf)
        if fitted.dof <= max(int((fitted.solution.prior == 0).sum()), 1):
            return float(np.inf)
        where = {"work_q_rad": self._work_q, "work_min_m": None, "work_max_m": None}
        config = self._config.with_keys("planning", **where)
        model = model_after(fitted, config)
        work = prediction_poses(model, config, np.zeros((0, self._cell.arm.n)))
        solution, u = fitted.solution, fitted.uncertainty
        basis, scale = solution.equations.basis, scales_of(fitted.model)
        least = np.sqrt(max(fitted.variance_factor, 1.0)) if u.inflated else 1.0
        determined = u.identifiable & (u.formal > 0)
        wider = np.full(len(scale), least)
        wider[determined] = u.std[determined] / u.formal[determined]
        root: Floats = basis.transform * (wider / scale)[:, None]
        covariance = root @ solution.equations.inverse(solution.beta) @ root.T
        live = model.live
        return rms(positions_of(work, covariance[np.ix_(live, live)], basis.null[live]))
