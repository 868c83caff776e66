"""A goal of a campaign: how well parameters or positions are to be known."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hilcal.effects.joint_compliance import JointCompliance
from hilcal.errors import InputError
from hilcal.identification.fit import Fit
from hilcal.measuring.progress import GoalStatus
from hilcal.tables.units import METRIC

JOINTS = JointCompliance.name  # The effect that "joint" and "j3" are short for
FORMS = (
    '"joint std < 2 %"',
    '"j3 std < 3 %"',
    '"joint_compliance.j3 std < 1e-7 rad/(N·m)"',
    '"joint_tilt_compliance std < 10 %"',
    '"position std < 20 um"',
    '"deflection std < 20 um"',
)
POSITIONS = ("position", "deflection")
"""What is predicted where the robot will work: by absolute readings, and by deflections."""
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
        """Refuse a goal that does not fit the parameters of a model.

        units: SI unit of each parameter by name.
        """
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
        # standard uncertainty of each parameter by name, SI; infinite where it is not identifiable
        stds: Mapping[str, float],
        values: Mapping[str, float],
        # standard uncertainty of what is predicted where the robot will work, m; infinite where the
        # readings do not determine it
        position: float | None = None,
        # what that is, e.g. "deflection under 5kg at 100 poses in the work box".
        predicted: str = "",
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
    """Return std / limit; infinite where std is not a number."""
    return float(np.inf) if np.isnan(std) else std / limit


def _plain(unit: str) -> str:
    """Write a unit in one way: rad/(N*m), rad/Nm and rad/(N·m) are the same."""
    text = unit.replace(" ", "").replace("*", "·").replace("Nm", "N·m").replace("^3", "³")
    return text.replace("/N·m", "/(N·m)")


def _wrong(text: str, why: str) -> InputError:
    return InputError(f'goal "{text}": {why}; valid: {", ".join(FORMS)}')
