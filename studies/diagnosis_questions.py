"""The cases of the study of the diagnosis: hidden effects, arms, and numbers of campaigns."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from hilcal.readings.whitening import Mode
from studies.diagnosis import DiagnosisCase, Kind

MANY = 3.0
"""Strength of two effects at once, and of one outside of the catalogue, σ."""
MISJUDGED = (0.5, 2.0)
"""Stated over true σ."""
AGAIN = 0.5
"""Strength at which a further round is measured, σ."""


@dataclass(frozen=True, slots=True)
class Extent:
    """Extent of the study.

    Attributes:
        kinds: kinds of cases.
        robots: names of the arms.
        modes: of the readings.
        effects: effects that can be hidden, by mode.
        laws: laws outside of the catalogue, by mode.
        strengths: of one hidden effect, σ.
        seeds: campaigns per effect or law, strength, arm and mode.
        nothing: campaigns that hide nothing, per mode.
        noise: campaigns of each misjudged noise, per mode.
        pairs: campaigns with two effects, per mode.
        first_seed: of the simulation.
        again: whether a further round is measured at 0.5 σ.
    """

    kinds: tuple[Kind, ...]
    robots: tuple[str, ...]
    modes: tuple[Mode, ...]
    effects: Mapping[Mode, tuple[str, ...]]
    laws: Mapping[Mode, tuple[str, ...]]
    strengths: tuple[float, ...] = (2.0, 1.0, 0.5)
    seeds: int = 20
    nothing: int = 500
    noise: int = 100
    pairs: int = 100
    first_seed: int = 0
    again: bool = False


def questions(extent: Extent) -> tuple[DiagnosisCase, ...]:
    """Return the settings of all cases, kind by kind; arms take turns where numbers are totals."""
    makers = {
        "hidden": _hidden,
        "nothing": _nothing,
        "noise": _noise,
        "pairs": _pairs,
        "outside": _outside,
    }
    return tuple(q for kind in extent.kinds for q in makers[kind](extent))


def _hidden(e: Extent) -> Iterator[DiagnosisCase]:
    # Seeds are the outer loop, so that a stopped study has cases of all effects.
    for seed, mode in product(_seeds(e, e.seeds), e.modes):
        for effect, robot, strength in product(e.effects[mode], e.robots, e.strengths):
            again = e.again and strength == AGAIN
            yield DiagnosisCase("hidden", robot, mode, (effect,), strength, seed, again=again)


def _nothing(e: Extent) -> Iterator[DiagnosisCase]:
    for seed, mode in product(_seeds(e, e.nothing), e.modes):
        yield DiagnosisCase("nothing", _turn(e.robots, seed), mode, (), 0.0, seed)


def _noise(e: Extent) -> Iterator[DiagnosisCase]:
    for seed, mode, stated in product(_seeds(e, e.noise), e.modes, MISJUDGED):
        yield DiagnosisCase("noise", _turn(e.robots, seed), mode, (), 0.0, seed, stated, cycles=2)


def _pairs(e: Extent) -> Iterator[DiagnosisCase]:
    for seed, mode in product(_seeds(e, e.pairs), e.modes):
        pairs = list(combinations(e.effects[mode], 2))
        if pairs:
            pick = np.random.default_rng([seed, len(pairs)]).integers(len(pairs))
            yield DiagnosisCase("pairs", _turn(e.robots, seed), mode, pairs[pick], MANY, seed)


def _outside(e: Extent) -> Iterator[DiagnosisCase]:
    for seed, mode in product(_seeds(e, e.seeds), e.modes):
        for law, robot in product(e.laws[mode], e.robots):
            yield DiagnosisCase("outside", robot, mode, (law,), MANY, seed)


def _seeds(e: Extent, count: int) -> range:
    return range(e.first_seed, e.first_seed + count)


def _turn(robots: Sequence[str], seed: int) -> str:
    return robots[seed % len(robots)]
