"""What a repair, a crash or wear can change on an arm: candidates, each with its columns.

A candidate is a set of directions of an effect's parameters beside the earlier fit, whether or not
the effect is in its model: a change of what it had found is a deviation of its own. Three more
kinds are no change of the arm, but look like one: the target on the tool, the instrument, and the
temperature.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.protocol import Changeable, Directions, Effect, Kind
from hilcal.identification.later_readings import Moving
from hilcal.readings.readings import States
from hilcal.types import Floats

PLACE = Changeable("setup", "tracker's place", "the place of the tracker, or of the base")
SUFFIX = " changed"
"""Ends the name of an effect that stands for a change."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Something that may have changed.

    Attributes:
        name: effect and part, as "encoder_offset.j3"; "target_offset" for a whole effect.
        effect: name of the effect.
        part: what it is of: "joint 3", "link 2", "base", "tool", "target", "tracker", ...
        joint: number of the joint, from 1; 0 for none.
        change: how it may change.
        parameters: (k,) names of the directions.
        units: (k,) their units.
        scale: (k,) their ordinary magnitudes, SI.
        moving: the directions, in ordinary magnitudes.
    """

    name: str
    effect: str
    part: str
    joint: int
    change: Changeable
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    scale: Floats
    moving: Moving

    @property
    def kind(self) -> Kind:
        """Of what it is."""
        return self.change.kind

    @property
    def of_arm(self) -> bool:
        """Whether it is a change of the arm itself."""
        return self.kind in ("joint", "link", "base")


def changing(catalogue: Catalogue) -> tuple[str, ...]:
    """Return the names of the effects that a change may be of."""
    return tuple(e.name for e in catalogue.effects if e.change is not None)


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

    for name in changing(catalogue):
        change = catalogue[name].change
        if change is None or (effect := made(name, change.options)) is None:
            continue
        if change.directions is not None:
            out.append(_together(name, effect, change, change.directions(effect)))
        elif change.part:
            out.append(_all_of(name, effect, change))
        else:
            out += _by_part(name, effect, change)
    if not anew:
        for registration in catalogue.with_role("registration"):
            if (effect := made(registration.name)) is not None:
                out.append(_all_of(registration.name, effect, PLACE))
    return tuple(out)


def _by_part(name: str, effect: Effect, change: Changeable) -> Iterator[Candidate]:
    """Yield a candidate for each joint or link: its parameters begin with "j3" or "link2"."""
    labels = [p.name.split(".")[0] for p in effect.parameters]
    for label in dict.fromkeys(labels):
        number = int(label.lstrip("jlink"))
        mine = [i for i, other in enumerate(labels) if other == label]
        named = replace(change, part=f"{change.kind} {number}")
        joint = number if change.kind == "joint" else 0
        directions = _each(f"{name}.{label}", effect, mine)
        yield _together(name, effect, named, directions, joint)


def _all_of(name: str, effect: Effect, change: Changeable) -> Candidate:
    return _together(name, effect, change, _each(name, effect, list(range(len(effect.parameters)))))


def _each(name: str, effect: Effect, mine: list[int]) -> Directions:
    """Some of the parameters, each by itself."""
    every = effect.parameters
    scale = np.array([every[i].scale for i in mine])
    matrix = np.zeros((len(every), len(mine)))
    matrix[mine, np.arange(len(mine))] = scale
    return Directions(
        name, tuple(every[i].name for i in mine), tuple(every[i].unit for i in mine), scale, matrix
    )


def _together(
    name: str, effect: Effect, change: Changeable, d: Directions, joint: int = 0
) -> Candidate:
    return Candidate(
        name=d.name,
        effect=name,
        part=change.part,
        joint=joint,
        change=change,
        parameters=d.parameters,
        units=d.units,
        scale=d.scale,
        moving=Moving(effect, d.matrix),
    )
