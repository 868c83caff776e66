"""`thermal_growth`: the links grow with the temperature."""

from typing import ClassVar

import numpy as np

from hilcal.effects.options import choice, number
from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats

REFERENCE_DEGC = 20.0  # Standard reference temperature of lengths, ISO 1
SOURCES = ("air", "joints")
FORMS = ("common", "each")


class ThermalGrowth(Effect):
    """The translation of every link grows by α ΔT, ΔT = T − T_ref [1/K].

    T is one temperature for the whole arm; slot k moves along L_k, by L_kᵀ p_k α ΔT in its
    own axes.
    """

    name = "thermal_growth"
    summary = "every link grows by α ΔT of its length, ΔT from 20 °C"
    change = Changeable(
        "surroundings", "temperature", "the length of the links with the temperature"
    )
    plausible = 5.0  # 60e-6 per kelvin: polymers; aluminium has 23e-6. A choice.
    needs = ("air_temperature or joint_temperature",)
    option_help: ClassVar = {
        "reference_degC": "T_ref, at which the links are as long as configured; unless given, 20.",
        "temperature": '"air", or "joints" for the mean of the joints\' temperatures; unless '
        "given, air where the readings have it.",
        "links": '"common", one α (default), or "each", one for each of L_0..L_n.',
    }

    def setup(self, states: States) -> None:
        """Choose reference and thermometer."""
        self.options.setdefault("reference_degC", REFERENCE_DEGC)
        self.options.setdefault("temperature", SOURCES[states.air_temperature is None])
        self.options.setdefault("links", "common")
        self.reference = number(self.name, self.options, "reference_degC")
        self.source = choice(self.name, self.options, "temperature", SOURCES)
        self.each = choice(self.name, self.options, "links", FORMS) == "each"
        self._temperature(states)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Coefficients of thermal expansion; that of steel is ordinary."""
        if not self.each:
            return (Parameter("alpha", "1/K", 12e-6, "thermal expansion of all links"),)
        return tuple(
            Parameter(f"link{k}", "1/K", 12e-6, f"thermal expansion of link {k}")
            for k in range(self.cell.arm.n + 1)
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Displacement of each slot along its link, per α."""
        links = self.cell.arm.links
        along = np.zeros((len(links), 6))
        along[:, :3] = np.einsum("kji,kj->ki", links[:, :3, :3], links[:, :3, 3])
        warmer = self._temperature(s.states) - self.reference
        slots = np.arange(len(links))
        values = warmer[:, None, None] * along
        return (Columns("twist", slots if self.each else 0 * slots, slots, values),)

    def _temperature(self, states: States) -> Floats:
        air, joints = states.air_temperature, states.joint_temperature
        if self.source == "air" and air is not None:
            return air
        if self.source == "joints" and joints is not None:
            return np.asarray(joints.mean(axis=1))
        raise InputError(
            f"effect {self.name}: temperature = {self.source!r}, which not all readings have; "
            f"valid: {SOURCES[self.source == 'air']}"
        )
