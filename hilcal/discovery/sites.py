"""Where a law may act: joints, bearings, links, base, target, tracker, and the force sensor.

A site is a unit motion, or a unit error of the force sensor: recorded = true + error.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilcal.effects.force_sensor import acting_columns
from hilcal.effects.protocol import Columns, Effect, Field, Parameter, Situation
from hilcal.identification.fit import Fit
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import States
from hilcal.types import Floats

ORDINARY = {"rad": 1e-4, "m": 1e-4, "1": 1e-5, "N": 1.0, "N·m": 0.1}
"""Ordinary motions by unit: 0.1 mrad, 0.1 mm, 10 ppm of the distance; and ordinary errors of a
force sensor. A choice: it only centres the range of strengths of the evidence, a factor of a
million."""
Place = Field | Literal["sensor"]
SETUP = ("target", "tracker", "force sensor")  # groups that are new in each campaign
_AXES = "xyz"


@dataclass(frozen=True, slots=True)
class Site:
    """The unit motion of one part, or a unit error of the force sensor."""

    field: Place  # of `Deviation`; "sensor" for the recorded wrench, flange axes
    element: int  # joint or slot; 0 if the field has none
    axis: int  # component of the twist; 0 for joints and the scale
    group: str  # moving part, e.g. "joint 2, tilt of its axis"
    words: str  # the same with the axis
    symbol: str  # in formulas
    latex: str  # in LaTeX formulas
    unit: str  # rad, m, 1, N or N·m
    joint: int = -1  # index of its joint; −1 for none

    @property
    def rank(self) -> int:
        """Order in which equally good sites are shown: joints, base, target, others."""
        first = self.group.split(",")[0]
        if self.field == "dq":
            return 0
        return {"base": 1, "target": 2, "tracker": 3}.get(first, 4) + (self.axis > 2)

    @property
    def of_setup(self) -> bool:
        """Whether the site belongs to the setup of a campaign, not to the arm."""
        return self.group.split(",")[0] in SETUP

    def takes(self, elastic: bool, sensed: bool = False) -> bool:
        """Whether a law may act here, by its causes.

        Transmitted wrenches (`elastic`) move only parts of the arm. They move the base by the twist
        of the frame before joint 1; other causes move it by the base's own frame. Readings of the
        force sensor (`sensed`) cause only the sensor's errors.
        """
        if self.field == "sensor" or sensed:
            return self.field == "sensor" and not elastic
        if self.field == "twist" and self.element == 0:
            return elastic
        return not elastic or self.field in ("dq", "twist")


def sites(n: int) -> tuple[Site, ...]:
    """Return all sites of an arm of n joints."""
    out = [
        Site("dq", j, 0, f"joint {j + 1}", f"joint {j + 1}", f"dq_{j + 1}",
             rf"\delta q_{j + 1}", "rad", j)
        for j in range(n)
    ]  # fmt: skip
    out += _twists(0, "base", "base", "b", (0, 1, 2))
    out += _twists(0, "base, tilt", "tilt_base", r"\beta", (3, 4))
    out += _twists(0, "base", "base", "b", (0, 1, 2), field="base")
    out += _twists(0, "base, tilt", "tilt_base", r"\beta", (3, 4), field="base")
    for j in range(1, n):
        k = j + 1
        out += _twists(j, f"joint {k}, tilt of its axis", f"tilt{k}", rf"\theta_{k}", (3, 4), j)
        out += _twists(j, f"joint {k}, play along its axis", f"axial{k}", f"a_{k}", (2,), j)
    out += _twists(n, "flange", "bend", r"\phi", (3, 4, 5))
    out += _twists(n, "target", "target", "p", (0, 1, 2))
    out += _twists(0, "tracker", "tracker", "s", (0, 1, 2), field="station")
    out += _twists(0, "tracker, turn", "turn", r"\sigma", (3, 4, 5), field="station")
    scale = "tracker, scale of its distances"
    out.append(Site("scale", 0, 0, scale, scale, "scale", r"\mu", "1"))
    for c in range(6):
        kind, way, letter = ("force", "along", "f") if c < 3 else ("moment", "about", "m")
        group, axis = f"force sensor, {kind}", _AXES[c % 3]
        out.append(
            Site(
                "sensor", 0, c, group, f"{group} {way} {axis}", f"sensor_{letter}{axis}",
                rf"h_{{{letter}{axis}}}", "N" if c < 3 else "N·m",
            )
        )  # fmt: skip
    return tuple(out)


def _twists(
    element: int, group: str, symbol: str, latex: str, axes: tuple[int, ...], joint: int = -1,
    field: Field = "twist",
) -> list[Site]:  # fmt: skip
    out = []
    for c in axes:
        axis, way = _AXES[c % 3], "along" if c < 3 else "about"
        out.append(
            Site(
                field, element, c, group, f"{group} {way} {axis}", f"{symbol}_{axis}",
                f"{latex}^{axis}", "m" if c < 3 else "rad", joint,
            )
        )  # fmt: skip
    return out


class UnitMotions(Effect):
    """A constant unit motion at every site, for its Jacobian at the equilibrium of a fit."""

    name = "unit_motions"
    summary = "a constant at every site"

    def setup(self, states: States) -> None:
        """List the sites."""
        self.sites = sites(self.cell.arm.n)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One per site."""
        return tuple(Parameter(s.words, s.unit, ORDINARY[s.unit]) for s in self.sites)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Return a unit deviation at each site."""
        out = []
        for field in dict.fromkeys(x.field for x in self.sites):
            if field == "sensor":
                continue
            indices = [k for k, site in enumerate(self.sites) if site.field == field]
            indices.sort(key=lambda k: self.sites[k].element)
            wide = field not in ("dq", "scale")
            units = np.eye(6)[None, [self.sites[k].axis for k in indices]]
            values = units if wide else np.ones((1, len(indices)))
            element = np.array([self.sites[k].element for k in indices])
            out.append(Columns(field, np.array(indices), element, values))
        return tuple(out)

    def wrench_columns(self, theta: Floats, s: Situation) -> Floats:
        """Return the change of the slot wrenches by unit errors of the force sensor."""
        errors = np.zeros((1, len(self.sites), 6))
        for k, site in enumerate(self.sites):
            if site.field == "sensor":
                errors[0, k, site.axis] = 1.0
        return acting_columns(s, errors)


def site_motions(fit: Fit) -> tuple[tuple[Site, ...], Floats]:
    """Return the sites and (N, m, S) motion of each reading by an ordinary motion of each."""
    return motions_of(fit.model, fit.solution.prediction, fit.theta, fit.whitening.m)


def motions_of(
    model: Model, prediction: Prediction, theta: Floats, m: int
) -> tuple[tuple[Site, ...], Floats]:
    """Return the same for any readings of m elements, at their prediction."""
    unit = UnitMotions(model.cell, prediction.situation.states)
    scale = np.array([p.scale for p in unit.parameters])
    return unit.sites, model.jacobian_of((unit,), prediction, theta, m) * scale
