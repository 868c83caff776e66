"""`remainder`: smooth errors that follow joint angles, for which the catalogue has no effect."""

import re
from typing import ClassVar

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.protocol import Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States

HARMONICS = 4  # those of the smooth laws of a diagnosis
BASE = "base"
_LAW = re.compile(rf"([0-9]{{1,3}}|{BASE}):([0-9]{{1,3}})")


class Remainder(Effect):
    """dq_j = Σ_k a_jik cos k q_i + b_jik sin k q_i, k = 1…4, for the pairs j:i of option `laws`.

    `base` in the place of j moves the whole arm along the three axes of the base [m]. It stands for
    an effect that the catalogue lacks: its standard deviation is the evidence that there is one,
    and it predicts the part of it that follows the joint angles until a law is known. A refinement
    fits it where smooth laws predict poses left out (`hilcal.diagnosis.unknown_law`); it is never a
    suspect.
    """

    name = "remainder"
    summary = "dq_j = Σ a cos k q_i + b sin k q_i: what follows other joints' angles, unexplained"
    option_help: ClassVar = {
        "laws": "which joint errs by which joint's angle, as 2:4/base:1 for joint 2 by the angle "
        "of joint 4 and the whole arm by that of joint 1. Unless given, each joint by the others."
    }

    @classmethod
    def applies(cls, cell: Cell) -> bool:
        """No arm has it as such: it stands for what is unknown."""
        return False

    def setup(self, states: States) -> None:
        """Read the laws."""
        n = self.cell.arm.n
        usual = [f"{j}:{i}" for j in range(1, n + 1) for i in range(1, n + 1) if i != j]
        text = self.options.get("laws", "/".join(usual) or f"{BASE}:1")
        found = [_LAW.fullmatch(t.strip()) for t in text.split("/")] if type(text) is str else []
        laws = [(m[1], int(m[2])) for m in found if m]
        valid = (moved == BASE or 1 <= int(moved) <= n for moved, _ in laws)
        if len(laws) != len({*laws}) or len(laws) != len(found) or not laws or not all(valid):
            found = []
        if not found or not all(1 <= i <= n for _, i in laws):
            raise InputError(
                f"effect {self.name}: laws = {text!r}; valid: pairs of joints 1 to {n} or {BASE}, "
                f"and joints, each once, as 2:4/{BASE}:1"
            )
        self.laws = tuple(f"{moved}:{i}" for moved, i in laws)
        self._joints = [(int(moved) - 1, i - 1) for moved, i in laws if moved != BASE]
        self._base = [i - 1 for moved, i in laws if moved == BASE]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Amplitudes of 0.1 mrad, or 0.1 mm, at the first harmonic are ordinary, of k a k-th."""
        waves = [(f"{w}{k}", k) for k in range(1, HARMONICS + 1) for w in ("cos", "sin")]
        units = ["m" if s else "rad" for s in self.cell.arm.slides]
        of_joints = (
            Parameter(f"j{j + 1}.q{i + 1}.{w}", units[j], 1e-4 / k)
            for j, i in self._joints
            for w, k in waves
        )
        of_base = (
            Parameter(f"base.{axis}.q{i + 1}.{w}", "m", 1e-4 / k)
            for i in self._base
            for axis in "xyz"
            for w, k in waves
        )
        return (*of_joints, *of_base)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Waves of the angles: ∂dq_j/∂a_jik = cos k q_i, ∂dq_j/∂b_jik = sin k q_i."""
        turns = np.exp(1j * s.angle[:, :, None] * np.arange(1, HARMONICS + 1)).view(np.float64)
        count = turns.shape[2]
        moved = [j for j, _ in self._joints]
        of_joints = turns[:, [i for _, i in self._joints]].reshape(len(turns), -1)
        shift = np.einsum("nbw,ax->nbawx", turns[:, self._base], np.eye(6)[:3])
        of_base = shift.reshape(len(turns), 3 * count * len(self._base), 6)
        index = np.arange(of_joints.shape[1] + of_base.shape[1])
        parts = (
            Columns("dq", index[: of_joints.shape[1]], np.repeat(moved, count), of_joints),
            Columns("base", index[of_joints.shape[1] :], 0 * index[of_joints.shape[1] :], of_base),
        )
        return tuple(c for c in parts if len(c.parameter))

    def log_std_prior(self, pool: int) -> tuple[float, float]:
        """Of any size: nothing is known of an unknown effect."""
        return 0.0, 2.0
