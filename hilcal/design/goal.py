"""A goal of a campaign: how well parameters or positions are to be known."""

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.feasible import Space
from hilcal.design.nominal_model import after, nominal_model, planned_effects
from hilcal.design.predicted import positions_of, prediction_poses, rms
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.errors import HilcalError, InputError
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.full_covariance import with_joint_scatter
from hilcal.identification.priors import scales_of
from hilcal.measuring.progress import GoalStatus
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, has_unloaded
from hilcal.tables.units import METRIC
from hilcal.types import Floats

JOINTS = JointCompliance.name  # The effect that "joint" and "j3" are short for
FORMS = (
    '"joint std < 2 %"', '"j3 std < 3 %"', '"joint_compliance.j3 std < 1e-7 rad/(N·m)"',
    '"joint_tilt_compliance std < 10 %"', '"position std < 20 um"', '"deflection std < 20 um"',
)  # fmt: skip
POSITIONS = ("position", "deflection")  # predicted where the robot will work
_ANGLES = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "µrad": 1e-6, "μrad": 1e-6}
_SHAPE = re.compile(
    r"\s*(?P<what>[\w.]+)\s+std\s*(?:<=|<|≤)\s*(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*"
    r"(?P<unit>\S.*?)?\s*"
)


@dataclass(frozen=True, slots=True)
class Goal:
    """Standard uncertainties to be reached."""

    text: str  # as it was given
    what: str  # "position" or "deflection", or a parameter or an effect by name
    limit: float  # largest standard uncertainty: a share of the value, or SI
    relative: bool  # whether it is a share of the parameter's value
    unit: str  # SI unit that the limit was given in; "" for a share

    @property
    def of_position(self) -> bool:
        """Whether it is about what is predicted where the robot will work, not about parameters."""
        return self.what in POSITIONS

    def names(self, known: Mapping[str, float]) -> tuple[str, ...]:
        """Return the parameters that the goal is about, of those that are known."""
        found = tuple(n for n in known if n == self.what or n.split(".")[0] == self.what)
        if not found:
            effects = dict.fromkeys(name.split(".")[0] for name in known)
            raise InputError(
                f'goal "{self.text}": {self.what} is not in the model; valid: position, '
                f"{', '.join(effects)}, or one parameter, e.g. {next(iter(known), 'none')}"
            )
        return found

    def check(self, units: Mapping[str, str]) -> None:
        """Refuse a goal that does not fit the parameters of a model, by the SI unit of each."""
        if self.of_position or self.relative:
            if not self.of_position:
                self.names(dict.fromkeys(units, 0.0))
            return
        for name in self.names(dict.fromkeys(units, 0.0)):
            if _plain(units[name]) != self.unit:
                raise InputError(
                    f'goal "{self.text}": {name} is in {units[name]}; give that unit, or %'
                )

    def met(
        self,
        stds: Mapping[str, float],  # of each parameter, SI; infinite where not identifiable
        values: Mapping[str, float],
        position: float | None = None,  # of what is predicted, m; infinite if undetermined
        predicted: str = "",  # what that is, e.g. "deflection under 5kg at 100 poses"
    ) -> GoalStatus:
        """Judge standard uncertainties."""
        if self.of_position:
            if position is None:
                raise InputError(
                    f'goal "{self.text}": no prediction poses; give [planning] work_q_rad, or '
                    "work_min_m and work_max_m"
                )
            ratio = _ratio(float(position), self.limit)
            quantity = f"standard uncertainty (rms) of the predicted {predicted or self.what}"
            return self._status(ratio, self.what, float(position), "m", quantity)
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
        met = bool(ratio <= 1.0)
        return GoalStatus(self.text, met, worst, std, ratio, unit, quantity=quantity)


def parse_goal(text: str) -> Goal:
    """Read a goal, e.g. "joint std < 2 %"; `joint` are all joint compliances, `j3` is one."""
    match = _SHAPE.fullmatch(text)
    if match is None:
        raise _wrong(text, "not understood")
    try:
        number = float(match["number"])
    except ValueError:
        raise _wrong(text, f"{match['number']} is no number") from None
    if not (np.isfinite(number) and number > 0):
        raise _wrong(text, f"{match['number']} cannot be a standard uncertainty")
    what, unit = match["what"], _plain(match["unit"] or "")
    if not unit:
        raise _wrong(text, "the unit is missing")
    if what in POSITIONS:
        if unit not in METRIC:
            raise _wrong(text, f"a {what} is in {', '.join(list(METRIC)[:3])}, not {unit}")
        return Goal(text, what, number * METRIC[unit], False, "m")
    if what == "joint":
        what = JOINTS
    elif re.fullmatch(r"j\d+", what):
        what = f"{JOINTS}.{what}"
    if unit == "%":
        return Goal(text, what, number / 100, True, "")
    for base, prefixes in (("m", METRIC), ("rad", _ANGLES)):
        if unit in prefixes:
            return Goal(text, what, number * prefixes[unit], False, base)
    return Goal(text, what, number, False, unit)


def figures(fit: Fit) -> tuple[dict[str, float], dict[str, float]]:
    """Standard uncertainties and values of a fit's parameters by name, SI."""
    names = [f"{e.name}.{p.name}" for e in fit.model.effects for p in e.parameters]
    stds = {n: float(s) for n, s in zip(names, fit.uncertainty.std, strict=True)}
    return stds, {n: float(v) for n, v in zip(names, fit.theta, strict=True)}


def _ratio(std: float, limit: float) -> float:
    return float(np.inf) if np.isnan(std) else std / limit


def _plain(unit: str) -> str:
    """Write a unit in one way: rad/(N*m), rad/Nm and rad/(N·m) are the same."""
    text = unit.replace(" ", "").replace("*", "·").replace("Nm", "N·m").replace("^3", "³")
    return text.replace("/N·m", "/(N·m)")


def _wrong(text: str, why: str) -> InputError:
    return InputError(f'goal "{text}": {why}; valid: {", ".join(FORMS)}')


SHARE = 0.1  # Share of the time that may be spent on fits while measuring


class GoalRule:
    """Judges a campaign by its goal, with the fit that `hilcal identify` would make at its end.

    The goal counts as met by a fit that converged, to readings that determine what the goal is
    about. Where the residual is more than noise, the stated uncertainty is itself an estimate, and
    a check after every reading will once find it small by chance: then two fits in a row have to
    meet the goal, except at the plan's end. Fits take at most a tenth of the time (`SHARE`).
    """

    def __init__(
        self,
        text: str,  # the goal, e.g. "joint std < 2 %".
        cell: Cell,
        config: CellConfig,  # `[planning]`, loads, repeatability
        catalogue: Catalogue | None = None,  # the installed effects by default
        now: Callable[[], float] = time.monotonic,  # seconds that pass for people
    ) -> None:
        """Read a goal, and check it against the cell's model."""
        self.goal: Goal = parse_goal(text)
        self.status = GoalStatus(text)
        self._cell, self._config, self._now = cell, config, now
        self._catalogue = catalogue or installed()
        self._scatter = config.repeatability.per_joint(cell.arm.n)
        model = nominal_model(cell, config, 3, catalogue)
        effects = model.model.effects
        self.goal.check({f"{e.name}.{p.name}": p.unit for e in effects for p in e.parameters})
        self._work_q: tuple[tuple[float, ...], ...] = ()
        self._predicted = ""
        if self.goal.of_position:
            shown = "position" if config.fitted == "absolute" else "deflection"
            if self.goal.what != shown:
                raise InputError(
                    f'goal "{text}": [planning] readings = "{config.fitted}", which show the '
                    f"{shown}; valid: {shown}"
                )
            planning = config.planning
            if not planning.work_q_rad and planning.work_min_m is None:
                self.goal.met({}, {})  # raises: names the missing keys
            some = prediction_poses(
                model, config, np.zeros((0, cell.arm.n)), Space(cell, config).clear
            )
            self._work_q = tuple(dict.fromkeys(tuple(q) for q in some.q.tolist()))
            self._predicted = some.what
        self._good = False  # whether the fit before met the goal
        self._ended = self._took = -np.inf

    def __call__(self, readings: Readings, last: bool) -> GoalStatus:
        """Return the status of the goal, see `measuring.stopping_rule.StoppingRule`."""
        begun = self._now()
        if last or (begun - self._ended >= self._took / SHARE and self._news(readings)):
            found = self._fit(readings)
            if found is None:
                self.status, self._good = GoalStatus(self.goal.text), False
            else:
                status, fitted = found
                good = status.met and fitted.solution.converged
                sure = last or self._good or not fitted.uncertainty.inflated
                self.status, self._good = replace(status, met=good and sure), good
            self._ended = self._now()
            self._took = self._ended - begun
        return self.status

    def _fitted(self, readings: Readings) -> tuple[Readings, Mode]:
        """Return the readings that are judged, and how; deflections need an unloaded one."""
        if self._config.planning.readings == "absolute":
            return readings, "absolute"
        kept = readings[has_unloaded(readings)]
        return kept, "absolute" if kept.unloaded.all() else "deflection"

    def _news(self, readings: Readings) -> bool:
        """Whether the last reading is more than an unloaded one that no deflection has yet."""
        free = readings.unloaded
        if not free[-1] or self._fitted(readings)[1] == "absolute":
            return True
        same = (readings.pose == readings.pose[-1]) & (readings.cycle == readings.cycle[-1])
        return bool((same & ~free).any())

    def _fit(self, readings: Readings) -> tuple[GoalStatus, Fit] | None:
        try:
            readings, mode = self._fitted(readings)
            readings = with_joint_scatter(self._cell, readings, self._scatter)
            wanted = planned_effects(self._config, self._catalogue)
            model = with_effects(self._cell, readings, mode, wanted, wanted, self._catalogue)
            found = fit(model, readings, mode)
            std, value = figures(found)
            held = dict(zip(std, found.solution.prior == 0, strict=True))
            std = {name: s for name, s in std.items() if not held[name]}
            position = self._position(found) if self._work_q else None
            status = self.goal.met(std, value, position, self._predicted)
            return replace(status, model=found.model.named, fitted=found.mode), found
        except (HilcalError, np.linalg.LinAlgError):
            return None

    def _position(self, found: Fit) -> float:
        """RMS standard uncertainty of what is predicted where the robot will work, m.

        That of the fit's covariance T H⁻¹ Tᵀ, widened as `identify` widens the parameters'.
        Infinite where directions that the readings do not determine move it, and where there are no
        more degrees of freedom than a family has parameters that the fit holds at zero for want of
        readings.
        """
        if found.mode != self._config.planning.readings:
            return float(np.inf)
        if found.dof <= max(int((found.solution.prior == 0).sum()), 1):
            return float(np.inf)
        where = {"work_q_rad": self._work_q, "work_min_m": None, "work_max_m": None}
        planning = self._config.planning.model_copy(update=where)
        config = self._config.model_copy(update={"planning": planning})
        model = after(found, config)
        work = prediction_poses(model, config, np.zeros((0, self._cell.arm.n)))
        solution, u = found.solution, found.uncertainty
        basis, scale = solution.equations.basis, scales_of(found.model)
        least = np.sqrt(max(found.variance_factor, 1.0)) if u.inflated else 1.0
        seen = u.identifiable & (u.formal > 0)
        wider = np.full(len(scale), least)
        wider[seen] = u.std[seen] / u.formal[seen]
        root: Floats = basis.transform * (wider / scale)[:, None]
        covariance = root @ solution.equations.inverse(solution.beta) @ root.T
        live = model.live
        return rms(positions_of(work, covariance[np.ix_(live, live)], basis.null[live]))
