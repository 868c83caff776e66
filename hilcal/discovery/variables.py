"""The recorded quantities that a law may depend on, by the names that the diagnosis gives them."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations
from typing import Literal

import numpy as np

from hilcal.effects.force_sensor import recorded
from hilcal.effects.protocol import Situation
from hilcal.types import Floats

Kind = Literal[
    "angle", "sum", "torque", "force", "load", "gravity", "temperature", "time", "hanging", "side",
    "place", "sight", "sensor", "composed",
]  # fmt: skip
VARIES = 1e-6
"""Least spread, as a share of the largest value, of a quantity that counts as varying."""
_AXES = "xyz"


@dataclass(frozen=True, slots=True, eq=False)
class Variable:
    """A recorded quantity.

    Attributes:
        kind: what functions of it are tried.
        names: what the diagnosis calls it, or those that it is a sum of.
        symbol: in formulas.
        latex: likewise.
        unit: SI; °C for temperatures, "1" for a number.
        code: how an effect reads it of its situation s.
        read: (N,) the same.
        need: column of the readings that it needs; empty for none.
        slot: slot and component of the transmitted wrench that it is; None for none.
        joint: index of the joint that it belongs to; −1 for none.
        vector: what it is a component of; empty for none.
        axis: along which; −1 for none.
    """

    kind: Kind
    names: tuple[str, ...]
    symbol: str
    latex: str
    unit: str
    code: str
    read: Callable[[Situation], Floats] = field(repr=False)
    need: str = ""
    slot: tuple[int, int] | None = None
    joint: int = -1
    vector: str = ""
    axis: int = -1

    @property
    def cost(self) -> int:
        """Complexity that it adds to a function of it."""
        return int(self.kind == "sum")

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the readings that it needs."""
        return (self.need,) if self.need else ()

    @property
    def recorded(self) -> tuple["Variable", ...]:
        """The recorded quantities that it is made of: itself."""
        return (self,)

    def slopes(self) -> tuple[tuple[tuple[int, int], str], ...]:
        """Slots and components of the transmitted wrenches, and ∂x by each as Python."""
        return () if self.slot is None else ((self.slot, ""),)


def variables(s: Situation) -> list[Variable]:
    """Return all quantities that vary over the states of a situation."""
    return [v for v in _all(s) if _varies(v.read(s))]


def _varies(x: Floats) -> bool:
    return bool(np.ptp(x) > VARIES * max(float(np.abs(x).max()), 1e-300))


def _all(s: Situation) -> list[Variable]:
    n = s.angle.shape[1]
    return [
        *_angles(s),
        *_wrenches(n),
        *_loads(),
        *_sensed(),
        *_attitude(n),
        *_temperatures(s, n),
        *_times(s),
        *_sides(s, n),
        *_places(),
    ]


def _angles(s: Situation) -> list[Variable]:
    """Angles of joints and their sums; of a joint that slides the phase of its travel, φ."""
    arm = s.cell.arm
    turning = np.flatnonzero(~arm.slides).tolist()
    n = arm.n
    phase = ["φ" if slides else "q" for slides in arm.slides]
    latex = [r"\phi" if slides else "q" for slides in arm.slides]
    out = [
        Variable(
            "angle", (f"joint {j + 1} {arm.kind(j)}",), f"{phase[j]}_{j + 1}",
            f"{latex[j]}_{j + 1}", "rad",
            f"s.angle[:, {j}]", lambda s, j=j: s.angle[:, j], joint=j,  # type: ignore[misc]
        )
        for j in range(n)
    ]  # fmt: skip
    for i, j in combinations(turning, 2):
        for sign, word in ((1.0, "+"), (-1.0, "-")):
            text = f"(q_{i + 1} {word} q_{j + 1})"
            out.append(
                Variable(
                    "sum", (f"joint {i + 1} angle", f"joint {j + 1} angle"), text, text, "rad",
                    f"(s.angle[:, {i}] {word} s.angle[:, {j}])",
                    lambda s, i=i, j=j, sign=sign: s.angle[:, i] + sign * s.angle[:, j],  # type: ignore[misc]
                )
            )  # fmt: skip
    for first, count in ((i, k) for k in range(3, n + 1) for i in range(n - k + 1)):
        # The turn of a link against another one: of consecutive joints.
        mine = range(first, first + count)
        if arm.slides[first : first + count].any():
            continue
        text = f"({' + '.join(f'q_{j + 1}' for j in mine)})"
        last = first + count
        out.append(
            Variable(
                "sum", tuple(f"joint {j + 1} angle" for j in mine), text, text, "rad",
                f"s.angle[:, {first}:{last}].sum(axis=1)",
                lambda s, a=first, b=last: s.angle[:, a:b].sum(axis=1),  # type: ignore[misc]
            )
        )  # fmt: skip
    return out


def _wrenches(n: int) -> list[Variable]:
    out = [
        Variable(
            "torque", (f"joint {j + 1} torque",), f"τ_{j + 1}", rf"\tau_{j + 1}", "N·m",
            f"s.torque[:, {j}]", lambda s, j=j: s.torque[:, j], slot=(j, 5), joint=j,  # type: ignore[misc]
        )
        for j in range(n)
    ]  # fmt: skip
    for k in range(n + 1):
        where = "flange" if k == n else f"joint {k + 1}"
        short = "F" if k == n else str(k + 1)
        for c in range(6):
            if k < n and c == 5:
                continue
            word, letter, unit = ("force", "f", "N") if c < 3 else ("moment", "m", "N·m")
            axis = _AXES[c % 3]
            out.append(
                Variable(
                    "force", (f"{where} {word} {axis}",), f"{letter}{short}_{axis}",
                    f"{letter}_{{{short},{axis}}}", unit, f"s.wrench[:, {k}, {c}]",
                    lambda s, k=k, c=c: s.wrench[:, k, c],  # type: ignore[misc]
                    slot=(k, c), joint=k if k < n else -1,
                    vector=f"{letter}{short}", axis=c % 3,
                )
            )  # fmt: skip
    return out


def _loads() -> list[Variable]:
    out = []
    for first, letter, unit in ((0, "f", "N"), (3, "m", "N·m")):
        norm = f"np.linalg.norm(s.states.wrench[:, {first}:{first + 3}], axis=1)"
        out.append(
            Variable(
                "load", ("load",), f"|{letter}|", f"|{letter}|", unit, norm,
                lambda s, a=first: np.linalg.norm(s.states.wrench[:, a : a + 3], axis=1),  # type: ignore[misc]
            )
        )  # fmt: skip
        for c, axis in enumerate(_AXES):
            out.append(
                Variable(
                    "load", ("load",), f"{letter}_{axis}", f"{letter}_{axis}", unit,
                    f"s.states.wrench[:, {first + c}]",
                    lambda s, c=first + c: s.states.wrench[:, c],  # type: ignore[misc]
                    vector=letter, axis=c,
                )
            )  # fmt: skip
    return out


def _sensed() -> list[Variable]:
    """What the force sensor reads, along its own axes: causes of its own errors."""
    out = []
    for c in range(6):
        kind, letter, unit = ("force", "f", "N") if c < 3 else ("moment", "m", "N·m")
        axis = _AXES[c % 3]
        out.append(
            Variable(
                "sensor", (f"force sensor {kind} {axis}",), f"{letter}S_{axis}",
                rf"{letter}_{{S,{axis}}}", unit, f"recorded(s)[:, {c}]",
                lambda s, c=c: recorded(s)[:, c],  # type: ignore[misc]
                vector=f"{letter}S", axis=c % 3,
            )
        )  # fmt: skip
    return out


def _attitude(n: int) -> list[Variable]:
    """Direction of gravity along the axes of the joints, and across the flange."""

    def read(s: Situation, slot: int, c: int) -> Floats:
        down = s.cell.gravity / np.linalg.norm(s.cell.gravity)
        return np.asarray(s.chain.rotation[slot][:, :, c] @ down)

    places = [(k, 2, f"axis of joint {k + 1} to gravity", f"g{k + 1}") for k in range(n)]
    places += [(n, c, "flange attitude", f"gF_{_AXES[c]}") for c in range(3)]
    return [
        Variable(
            "gravity", (name,), symbol, symbol.replace("g", "g_", 1).replace("_F_", "_"), "1",
            f"(s.chain.rotation[{k}][:, :, {c}]"
            " @ (s.cell.gravity / np.linalg.norm(s.cell.gravity)))",
            lambda s, k=k, c=c: read(s, k, c), joint=k if k < n else -1,  # type: ignore[misc]
            vector="gravity" if k == n else "", axis=c,
        )
        for k, c, name, symbol in places
    ]  # fmt: skip


def _temperatures(s: Situation, n: int) -> list[Variable]:
    out = []
    if s.states.air_temperature is not None:
        zero = round(float(np.median(s.states.air_temperature)), 1)
        out.append(
            Variable(
                "temperature", ("air temperature",), f"(T_air - {zero})",
                rf"(T_\mathrm{{air}} - {zero})", "°C", f"(s.states.air_temperature - {zero})",
                lambda s: np.asarray(s.states.air_temperature) - zero, need="air_temperature",
            )
        )  # fmt: skip
    if s.states.joint_temperature is not None:
        warm = round(float(np.median(s.states.joint_temperature)), 1)
        out += [
            Variable(
                "temperature", (f"joint {j + 1} temperature",), f"(T_{j + 1} - {warm})",
                f"(T_{j + 1} - {warm})", "°C", f"(s.states.joint_temperature[:, {j}] - {warm})",
                lambda s, j=j: np.asarray(s.states.joint_temperature)[:, j] - warm,  # type: ignore[misc]
                need="joint_temperature", joint=j,
            )
            for j in range(n)
        ]  # fmt: skip
    return out


def _times(s: Situation) -> list[Variable]:
    out = []
    if s.states.time is not None:
        zero = float(np.floor(s.states.time.min()))
        text = "t" if zero == 0 else f"(t - {zero:.0f})"
        out.append(
            Variable(
                "time", ("time",), text, text, "s", f"(s.states.time - {zero})",
                lambda s: np.asarray(s.states.time) - zero, need="time",
            )
        )  # fmt: skip
    if s.states.load_time is not None:
        out.append(
            Variable(
                "hanging", ("time under load",), "t_load", r"t_\mathrm{load}", "s",
                "s.states.load_time", lambda s: np.asarray(s.states.load_time), need="load_time",
            )
        )  # fmt: skip
    return out


def _sides(s: Situation, n: int) -> list[Variable]:
    if s.states.approach is None:
        return []
    return [
        Variable(
            "side", (f"joint {j + 1} approach",), f"s_{j + 1}", f"s_{j + 1}", "1",
            f"s.states.approach[:, {j}]", lambda s, j=j: np.asarray(s.states.approach)[:, j],  # type: ignore[misc]
            need="approach", joint=j,
        )
        for j in range(n)
    ]  # fmt: skip


def _places() -> list[Variable]:
    point = "s.chain.point(s.cell.target[:3, 3])"
    seen = f"({point} @ s.cell.registration[:3, :3].T + s.cell.registration[:3, 3])"

    def base(s: Situation) -> Floats:
        return s.chain.point(s.cell.target[:3, 3])

    def sight(s: Situation) -> Floats:
        frame = s.cell.registration
        return np.asarray(base(s) @ frame[:3, :3].T + frame[:3, 3])

    return [
        Variable(
            "place", ("reach",), "ρ", r"\rho", "m",
            f"np.linalg.norm({point}[:, :2], axis=1)",
            lambda s: np.asarray(np.linalg.norm(base(s)[:, :2], axis=1)),
        ),
        Variable(
            "place", ("height",), "z", "z", "m", f"{point}[:, 2]", lambda s: base(s)[:, 2],
            vector="target", axis=2,
        ),
        Variable(
            "place", ("distance",), "d", "d", "m",
            f"np.linalg.norm({seen}, axis=1)",
            lambda s: np.asarray(np.linalg.norm(sight(s), axis=1)),
        ),
        *(
            Variable(
                "place", (f"target {axis}",), axis, axis, "m", f"{point}[:, {c}]",
                lambda s, c=c: base(s)[:, c],  # type: ignore[misc]
                vector="target", axis=c,
            )
            for c, axis in ((0, "x"), (1, "y"))
        ),
        Variable(
            "sight", ("azimuth",), "az", r"\alpha", "rad",
            f"np.arctan2({seen}[:, 1], {seen}[:, 0])",
            lambda s: np.arctan2(sight(s)[:, 1], sight(s)[:, 0]),
        ),
        Variable(
            "sight", ("elevation",), "el", r"\varepsilon", "rad",
            f"np.arctan2({seen}[:, 2], np.hypot({seen}[:, 0], {seen}[:, 1]))",
            lambda s: np.arctan2(sight(s)[:, 2], np.hypot(sight(s)[:, 0], sight(s)[:, 1])),
        ),
    ]  # fmt: skip
