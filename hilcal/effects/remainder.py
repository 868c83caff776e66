"""`remainder`: smooth errors that follow the pose, for which the catalogue has no effect."""

import re
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.protocol import Columns, Effect, Field, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats

HARMONICS = 4  # those of the smooth laws of a diagnosis
POWERS = 3
SIDE = 0.05  # width of the change from one side of gravity to the other, a cosine; a choice
MOTIONS: dict[str, tuple[Field, slice, str]] = {
    "base": ("base", slice(0, 3), "m"),
    "tilt": ("base", slice(3, 6), "rad"),
    "target": ("target", slice(0, 3), "m"),
}
"""Motions other than of a joint: shift and turn of the base, base axes; of the target, flange axes.
Each with the field of the deviation, its components, and their unit."""


def _gravity(axis: int) -> Callable[[Situation], Floats]:
    def along_flange(s: Situation) -> Floats:
        gravity = s.cell.gravity
        down = gravity / max(float(np.linalg.norm(gravity)), 1e-300)
        return np.asarray(s.chain.rotation[-1][:, :, axis] @ down)

    return along_flange


def _place(s: Situation) -> Floats:
    """(N, 3) target in units of the arm's reach, base axes."""
    return s.chain.point(s.cell.target[:3, 3]) / s.cell.arm.reach


VARIABLES: dict[str, Callable[[Situation], Floats]] = {
    "gravity_x": _gravity(0),
    "gravity_y": _gravity(1),
    "gravity_z": _gravity(2),
    "x": lambda s: _place(s)[:, 0],
    "y": lambda s: _place(s)[:, 1],
    "height": lambda s: _place(s)[:, 2],
    "reach": lambda s: np.hypot(*_place(s)[:, :2].T),
}
"""Variables other than joint angles: gravity's direction along the flange axes, and the target's
place in the base, in units of the arm's reach; `reach` is the distance from the base axis."""
_LAW = re.compile(
    rf"([0-9]{{1,3}}|{'|'.join(MOTIONS)}):([0-9]{{1,3}}(?:\*[0-9]{{1,3}})?|{'|'.join(VARIABLES)})"
)


class Remainder(Effect):
    """Σ_k a_k φ_k(x) along each axis of a motion, for the pairs motion:x of option `laws`.

    A motion is that of a joint, by its number; `base` moves the whole arm along the base axes [m],
    `tilt` turns it about them [rad], `target` moves the target along the flange axes [m]. x is the
    angle of a joint, by its number, with φ = cos k q, sin k q, k = 1…4; the angles of two joints,
    as 4*5, with the first waves of both and their products; or one of `VARIABLES`, with φ = x, x²,
    x³, and for gravity tanh(x / 0.05), its side. The remainder stands for an effect that the
    catalogue lacks: its standard deviation is the evidence that there is one, and it predicts the
    part of it that follows the pose until a law is known. A refinement fits it where smooth laws
    predict poses left out (`hilcal.diagnosis.unknown_law`); it is never a suspect.
    """

    name = "remainder"
    summary = "dq_j = Σ a cos k q_i + b sin k q_i: what follows other joints' angles, unexplained"
    option_help: ClassVar = {
        "laws": "what errs by what, as 2:4/base:1/target:gravity_z for joint 2 by the angle of "
        "joint 4, the whole arm by that of joint 1, and the target by gravity along flange z. "
        "Unless given, each joint by the others."
    }

    @classmethod
    def applies(cls, cell: Cell) -> bool:
        """No arm has it as such: it stands for what is unknown."""
        return False

    def setup(self, states: States) -> None:
        """Read the laws."""
        n = self.cell.arm.n
        usual = [f"{j}:{i}" for j in range(1, n + 1) for i in range(1, n + 1) if i != j]
        text = self.options.get("laws", "/".join(usual) or "base:1")
        matches = [_LAW.fullmatch(t.strip()) for t in text.split("/")] if type(text) is str else []
        laws = [(m[1], m[2]) for m in matches if m]
        numbers = [int(k) for law in laws for name in law for k in re.findall("[0-9]+", name)]
        known = len(matches) == len(laws) == len({*laws}) > 0 and all(1 <= k <= n for k in numbers)
        if not known:
            raise InputError(
                f"effect {self.name}: laws = {text!r}; valid: pairs of what errs (joints 1 to {n}, "
                f"{', '.join(MOTIONS)}) and of what it follows (joints 1 to {n}, two "
                f"of them, {', '.join(VARIABLES)}), each once, as 2:4/base:1/3:4*5"
            )
        self.laws = tuple(f"{moved}:{x}" for moved, x in laws)
        self._laws = laws

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Amplitudes of 0.1 mrad, or 0.1 mm, of the first function are ordinary, of k a k-th."""
        out = []
        for moved, x in self._laws:
            for axis, unit in self._axes(moved):
                out += [Parameter(f"{axis}.{f}", unit, 1e-4 / k) for f, k in _functions(x)]
        return tuple(out)

    def _axes(self, moved: str) -> list[tuple[str, str]]:
        """Names and units of the axes of a motion."""
        if moved in MOTIONS:
            return [(f"{moved}.{axis}", MOTIONS[moved][2]) for axis in "xyz"]
        return [(f"j{moved}", "m" if self.cell.arm.slides[int(moved) - 1] else "rad")]

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Each motion times the functions of its variable."""
        out, start = [], 0
        for moved, x in self._laws:
            values = _values(x, s)
            count = values.shape[1]
            if moved in MOTIONS:
                field, components, _ = MOTIONS[moved]
                index = start + np.arange(3 * count)
                shift = np.einsum("nf,ax->nafx", values, np.eye(6)[components])
                out.append(Columns(field, index, 0 * index, shift.reshape(-1, 3 * count, 6)))
            else:
                index = start + np.arange(count)
                out.append(Columns("dq", index, np.full(count, int(moved) - 1), values))
            start += len(index)
        return tuple(out)

    def log_std_prior(self, pool: int) -> tuple[float, float]:
        """Of any size: nothing is known of an unknown effect."""
        return 0.0, 2.0


def _functions(x: str) -> list[tuple[str, int]]:
    """Names of the functions of a variable, each with the divisor of its ordinary amplitude."""
    if x in VARIABLES:
        powers = [(f"{x}.power{k}", k) for k in range(1, POWERS + 1)]
        return powers + [(f"{x}.side", 1)] * x.startswith("gravity")
    if "*" in x:
        names = [[(1, "")] + [(2, f"q{i}.{w}") for w in ("cos1", "sin1")] for i in x.split("*")]
        pairs = [(a * b // 2, f"{p}{q}") for a, p in names[0] for b, q in names[1]]
        return [(name, k) for k, name in pairs[1:]]
    waves = ((f"q{x}.{w}{k}", k) for k in range(1, HARMONICS + 1) for w in ("cos", "sin"))
    return list(waves)


def _values(x: str, s: Situation) -> Floats:
    """(N, F) functions of a variable."""
    if x in VARIABLES:
        values = VARIABLES[x](s)
        side = [np.tanh(values / SIDE)] * x.startswith("gravity")
        return np.stack([*(values**k for k in range(1, POWERS + 1)), *side], axis=1)
    if "*" in x:
        q = s.angle[:, [int(i) - 1 for i in x.split("*")]]
        first, second = np.stack([np.ones_like(q), np.cos(q), np.sin(q)], axis=2).swapaxes(0, 1)
        return np.asarray((first[:, :, None] * second[:, None, :]).reshape(len(q), -1)[:, 1:])
    phase = s.angle[:, int(x) - 1, None] * np.arange(1, HARMONICS + 1)
    return np.asarray(np.exp(1j * phase).view(np.float64))
