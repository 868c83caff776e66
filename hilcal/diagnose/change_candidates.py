"""What a repair, a crash or wear can change on an arm: candidates, each with its columns.

A candidate is a set of directions of an effect's parameters beside the earlier fit, whether or not
the effect is in its model: a change of what it had found is a deviation of its own. Three more
kinds are no change of the arm, but look like one: the target on the tool, the instrument, and the
temperature.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import States
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.protocol import Effect
from hilcal.identify.remeasured import Moving
from hilcal.types import Floats

Kind = Literal["joint", "link", "base", "tool", "setup", "surroundings"]

HARMONICS = 4
"""Harmonics of a joint's transmission error that may have changed: two columns each. A choice: few
readings resolve no more, and finer ones act as scatter."""
SUFFIX = " changed"
"""Ends the name of an effect that stands for a change."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Something that may have changed.

    Attributes:
        name: effect and part, as "encoder_offset.j3"; "target_offset" for a whole effect.
        effect: name of the effect.
        part: what it is of: "joint 3", "link 2", "base", "tool", "target", "tracker", ...
        kind: of part.
        joint: number of the joint, from 1; 0 for none.
        parameters: (k,) names of the directions.
        units: (k,) their units.
        scale: (k,) their ordinary magnitudes, SI.
        moving: the directions, in ordinary magnitudes.
    """

    name: str
    effect: str
    part: str
    kind: Kind
    joint: int
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    scale: Floats
    moving: Moving

    @property
    def of_arm(self) -> bool:
        """Whether it is a change of the arm itself."""
        return self.kind in ("joint", "link", "base")


PER_JOINT: Mapping[str, Mapping[str, object]] = {
    "encoder_offset": {"joints": "each"},
    "joint_compliance": {"joints": "each"},
    "joint_tilt_compliance": {"joints": "each"},
    "backlash": {"joints": "each"},
    "hysteresis": {"joints": "each"},
    "transmission_error": {"joints": "each", "harmonics": HARMONICS},
}
WHOLE: Mapping[str, tuple[Kind, str]] = {
    "base_compliance": ("base", "base"),
    "tool_compliance": ("tool", "tool"),
    "load_point": ("tool", "load point"),
    "target_offset": ("setup", "target"),
    "wrench_bias": ("setup", "force sensor"),
    "wrench_gain": ("setup", "force sensor"),
    "tracker_scale": ("setup", "tracker's scale"),
    "thermal_growth": ("surroundings", "temperature"),
}
EFFECTS = (*PER_JOINT, "link_geometry", "link_mass", *WHOLE)
"""Names of the effects that a change may be of."""


def candidates(
    cell: Cell, states: States, catalogue: Catalogue, m: int, *, anew: bool
) -> tuple[Candidate, ...]:
    """Return what may have changed, as far as the readings have the columns for it.

    Args:
        cell: the cell, as registered.
        states: of the later readings.
        catalogue: has the effects; those that are not in it are left out.
        m: elements per reading.
        anew: whether the tracker was set up anew; else its place, or the base's, may have changed.
    """
    out: list[Candidate] = []

    def made(name: str, options: Mapping[str, object] | None = None) -> Effect | None:
        if name not in catalogue.names or not catalogue[name].computable(states):
            return None
        effect = catalogue.make(name, cell, states, options, m)
        effect.name = name + SUFFIX
        return effect

    for name, options in PER_JOINT.items():
        if (effect := made(name, options)) is not None:
            out += _by_part(name, effect, "joint")
    if (effect := made("link_geometry")) is not None:
        out += _by_part("link_geometry", effect, "link")
    if (effect := made("link_mass")) is not None:
        out.append(_tool_weight(effect, cell))
    for name, (kind, part) in WHOLE.items():
        if (effect := made(name)) is not None:
            out.append(_all_of(name, effect, kind, part))
    if not anew:
        for registration in catalogue.with_role("registration"):
            if (effect := made(registration.name)) is not None:
                out.append(_all_of(registration.name, effect, "setup", "tracker's place"))
    return tuple(out)


def _by_part(name: str, effect: Effect, kind: Kind) -> Iterator[Candidate]:
    """Yield a candidate for each joint or link: its parameters begin with "j3" or "link2"."""
    labels = [p.name.split(".")[0] for p in effect.parameters]
    for label in dict.fromkeys(labels):
        number = int(label.lstrip("jlink"))
        mine = [i for i, other in enumerate(labels) if other == label]
        joint = number if kind == "joint" else 0
        yield _candidate(f"{name}.{label}", name, effect, mine, kind, f"{kind} {number}", joint)


def _all_of(name: str, effect: Effect, kind: Kind, part: str) -> Candidate:
    return _candidate(name, name, effect, list(range(len(effect.parameters))), kind, part, 0)


def _candidate(
    name: str, of: str, effect: Effect, mine: list[int], kind: Kind, part: str, joint: int
) -> Candidate:
    parameters = effect.parameters
    scale = np.array([parameters[i].scale for i in mine])
    directions = np.zeros((len(parameters), len(mine)))
    directions[mine, np.arange(len(mine))] = scale
    return Candidate(
        name=name,
        effect=of,
        part=part,
        kind=kind,
        joint=joint,
        parameters=tuple(parameters[i].name for i in mine),
        units=tuple(parameters[i].unit for i in mine),
        scale=scale,
        moving=Moving(effect, directions),
    )


def _tool_weight(effect: Effect, cell: Cell) -> Candidate:
    """Mass at the flange, and first moment of the last link: a tool that is heavier, or elsewhere.

    A mass δm at the origin of slot n is carried by every link before: its first moments there are
    δm p_k, p_k (3,) the place of slot k in the axes of link k, k = 1..n.
    """
    n = cell.arm.n
    mass = cell.arm.links[1:, :3, 3].reshape(-1)
    scale = np.array([0.1, 5e-3, 5e-3, 5e-3])
    directions = np.zeros((3 * n, 4))
    directions[:, 0] = scale[0] * mass
    directions[-3:, 1:] = scale[1:] * np.eye(3)
    return Candidate(
        name="tool_weight",
        effect="link_mass",
        part="tool",
        kind="tool",
        joint=0,
        parameters=("mass", "x", "y", "z"),
        units=("kg", "kg·m", "kg·m", "kg·m"),
        scale=scale,
        moving=Moving(effect, directions),
    )
