"""A user's effect, hidden in the simulated world.

For every effect that ships, the world has separate mechanics, so that a diagnosis is not tested
against itself. A user's law exists only in the user's file: **this is the only case in which the
world shares a law with the model.** A model of joint compliance and this law predicts the
displacement of the target, which is added to its pose from the world's mechanics. This shows
whether a campaign reveals the law, not whether the law is coded correctly; for that, see
`hilcal.check_effect`.
"""

import hashlib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.effects.protocol import Effect
from hilcal.errors import InputError
from hilcal.model.model import Model
from hilcal.readings.readings import States
from hilcal.robot import se3
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class HiddenUserEffect:
    """An effect with its true parameters."""

    effect: Effect
    states: States  # of the campaign for which the effect was set up
    catalogue: Catalogue
    theta: Floats  # (P,) its parameters, SI

    @property
    def truth(self) -> dict[str, float]:
        """The parameters that are not zero, as "effect.part": value in SI."""
        pairs = zip(self.effect.parameters, self.theta, strict=True)
        return {f"{self.effect.name}.{p.name}": float(value) for p, value in pairs if value}

    def draw(self, rng: np.random.Generator) -> Floats:
        """Draw (P,) parameters of ordinary magnitude."""
        scale = np.array([p.scale for p in self.effect.parameters])
        return np.asarray(scale * rng.standard_normal(len(scale)))

    def displacements(
        self, cell: Cell, frame: Floats, compliance: Floats, states: States
    ) -> tuple[Floats, Floats]:
        """Return displacements (N, 3) and rotations (N, 3, 3) of N readings, sensor axes.

        `frame`: the true T_sensor_base; `compliance` (n,): of the drives, rad/(N·m).
        """
        if not self.effect.computable(states):
            needs = ", ".join(self.effect.needs)
            raise InputError(f"effect {self.effect.name} needs {needs}, which the cell lacks")
        registered = replace(cell, registration=frame)
        soft = JointCompliance(registered, states)
        without = Model(registered, (soft,), self.catalogue)
        within = Model(registered, (soft, self.effect), self.catalogue)
        base = without.predict(states, compliance).observation
        full = within.predict(states, np.concatenate([compliance, self.theta])).observation
        turn = se3.product(full.rotation, np.swapaxes(base.rotation, 1, 2))
        return full.position - base.position, turn

    def to_json(self) -> dict[str, Any]:
        """Return the law as JSON: its file, options, parameters and states."""
        file = self.catalogue.file_of(self.effect.name)
        columns = {f.name: getattr(self.states, f.name) for f in fields(States)}
        return {
            "name": self.effect.name,
            "file": None if file is None else file.path,
            "sha256": None if file is None else file.sha256,
            "options": dict(self.effect.options),
            "theta": self.theta.tolist(),
            "states": {k: np.asarray(v).tolist() for k, v in columns.items() if v is not None},
        }

    @staticmethod
    def from_json(cell: Cell, data: dict[str, Any]) -> "HiddenUserEffect":
        """Return the law of `to_json`."""
        catalogue = installed()
        if data["file"] is not None:
            check_hash(Path(data["file"]), data["sha256"])  # before its code runs
            catalogue = catalogue.with_file(Path(data["file"]))
        states = States(**{k: np.array(v) for k, v in data["states"].items()})
        effect = catalogue.make(data["name"], cell, states, data["options"])
        return HiddenUserEffect(
            effect, states, catalogue, np.array(data["theta"], dtype=np.float64)
        )


def check_hash(path: Path, sha256: str) -> None:
    """Raise InputError for a file that has changed since the world was made."""
    content = limits.read_bytes(path, limits.PROGRAM)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise InputError(f"{path}: changed since the simulated world was made")


def hidden_user_effect(
    catalogue: Catalogue, name: str, cell: Cell, states: States
) -> HiddenUserEffect:
    """Return an effect with all parameters 0, set up for the states of a campaign."""
    effect = catalogue.make(name, cell, states)
    return HiddenUserEffect(effect, states, catalogue, np.zeros(len(effect.parameters)))
