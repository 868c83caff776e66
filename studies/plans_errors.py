"""Simulated campaigns of a plan, and how far what is identified lies from the truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.information import DesignProblem, readings_of
from hilcal.design.nominal_model import nominal_states, planned_effects
from hilcal.design.predicted import rms
from hilcal.effects.catalogue import installed
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import fit
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats, Ints
from studies.plans_kinds import Chosen, Scene


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """N readings that a plan takes, as `Readings` describes them.

    Attributes:
        states: the N states.
        pose: (N,) index of the pose.
        load: (N,) index into `load_names`.
        cycle: (N,) readings of one pose and one cycle share their unloaded reading.
        load_names: names of the loads.
    """

    states: States
    pose: Ints
    load: Ints
    cycle: Ints
    load_names: tuple[str, ...]


class Arm(Protocol):
    """A simulated arm, whose truth is known."""

    @property
    def parameters(self) -> Mapping[str, Floats]:
        """True parameters by effect, SI."""

    def measure(self, asked: Asked, rng: np.random.Generator) -> Readings:
        """Return what the tracker reads of it."""

    def position(self, states: States) -> Floats:
        """Return (N, 3) true positions of the target, sensor axes, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """One campaign: true errors, and what was predicted of them.

    Attributes:
        parameter: (P,) estimate minus truth, SI.
        std: (P,) predicted standard uncertainty, SI.
        ordinary: (P,) ordinary magnitudes of the parameters, SI.
        position: RMS over the test poses of the 3-D error, m.
        position_std: predicted, m.
        readings: number of readings.
        poses: number of different poses.
    """

    parameter: Floats
    std: Floats
    ordinary: Floats
    position: float
    position_std: float
    readings: int
    poses: int


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """An arm, and how its target truly moves at the test poses.

    Attributes:
        arm: the arm.
        test: the test states; for deflections the loaded ones, then the unloaded ones.
        unloaded: (T,) rows of the unloaded state of each test pose; empty for positions.
        truth: (T, 3) true positions or deflections, sensor axes, m.
    """

    arm: Arm
    test: States
    unloaded: Ints
    truth: Floats


def subject(of: Scene, arm: Arm) -> Subject:
    """Ask for the truth once, for all plans."""
    candidates, work_load = of.exact.candidates, of.config.planning.work_load
    deflection = of.exact.mode == "deflection"
    if deflection and work_load == UNLOADED:
        loads = np.arange(1, len(candidates.loads))
    else:
        loads = np.array([candidates.loads.index(work_load)])
    q, count = of.work.q, len(of.work.q) // len(loads)
    wrench = np.repeat(candidates.wrench[loads], count, axis=0)
    unloaded = np.zeros(0, dtype=np.int64)
    if deflection:
        unloaded = len(q) + np.tile(np.arange(count), len(loads))
        q = np.vstack([q, q[:count]])
        wrench = np.vstack([wrench, np.zeros((count, 6))])
    test = nominal_states(q, wrench)
    return Subject(arm, test, unloaded, _of_interest(arm.position(test), unloaded))


def _of_interest(position: Floats, unloaded: Ints) -> Floats:
    """Positions, or deflections where there are unloaded states."""
    if not len(unloaded):
        return position
    return np.asarray(position[: len(unloaded)] - position[unloaded])


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """What a campaign needs of a plan; it travels to other processes.

    Attributes:
        asked: the readings.
        std: predicted standard uncertainties by parameter, SI.
        ordinary: ordinary magnitudes by parameter, SI.
        position: predicted RMS error over the test poses, m.
        readings: number of readings.
        poses: number of different poses.
    """

    asked: Asked
    std: Mapping[str, float]
    ordinary: Mapping[str, float]
    position: float
    readings: int
    poses: int


def prepared(chosen: Chosen) -> Prepared:
    """Return what a campaign needs of a plan."""
    told = chosen.predicted
    assert told.position is not None  # noqa: S101 - every scene has test poses
    return Prepared(
        asked=readings_asked(chosen),
        std=told.by_name(),
        ordinary={t.name: t.scale for t in chosen.problem.terms if not t.potential},
        position=told.position,
        readings=chosen.readings,
        poses=chosen.poses,
    )


def run_campaign(
    cell: Cell, config: CellConfig, plan: Prepared, subject: Subject, rng: np.random.Generator
) -> Errors:
    """Simulate a campaign of a plan, identify, and compare with the truth.

    Compared are the parameters of the planned effects; those of the frames show in the
    positions.

    Raises:
        CannotAnswerError: the readings do not determine the parameters.
    """
    mode, names = config.planning.readings, planned_effects(config, installed())
    readings = subject.arm.measure(plan.asked, rng)
    found = fit(with_effects(cell, readings, mode, names, names), readings, mode)
    at_test = found.model.predict(subject.test, found.theta).observation.position
    error = _of_interest(at_test, subject.unloaded) - subject.truth
    true = subject.arm.parameters
    off: dict[str, float] = {}
    for e, s in zip(found.model.effects, found.model.slices(), strict=True):
        if e.name in names and len(true.get(e.name, ())) == len(e.parameters):
            own = (f"{e.name}.{p.name}" for p in e.parameters)
            off |= dict(zip(own, found.theta[s] - true[e.name], strict=True))
    if not off:
        raise CannotAnswerError(f"of {', '.join(names)} the simulated arm knows no true parameters")
    if unknown := [name for name in off if not np.isfinite(plan.std.get(name, np.inf))]:
        raise CannotAnswerError(
            f"{plan.readings} readings of a plan do not determine {', '.join(unknown)}; "
            "compare plans of more readings"
        )
    return Errors(
        parameter=np.array([off[k] for k in off]),
        std=np.array([plan.std[k] for k in off]),
        ordinary=np.array([plan.ordinary[k] for k in off]),
        position=rms(np.linalg.norm(error, axis=1)),
        position_std=plan.position,
        readings=plan.readings,
        poses=plan.poses,
    )


def readings_asked(chosen: Chosen) -> Asked:
    """Return the readings that a plan takes; a unit that is taken again is a cycle of its own."""
    source: DesignProblem = chosen.problem
    mode: Mode = "deflection" if source.mode == "deflection" else "absolute"
    names = source.candidates.loads
    pose: list[int] = []
    load: list[int] = []
    cycle: list[int] = []
    seen: dict[object, int] = {}
    for k in np.flatnonzero(chosen.counts):
        at, _ = source.what[k]
        loads = readings_of(source.what[k], mode)
        for _ in range(int(chosen.counts[k])):
            # Absolute readings of one cycle are of different loads.
            key = at if mode == "deflection" else (at, loads)
            number = seen[key] = seen.get(key, -1) + 1
            pose += [at] * len(loads)
            load += [names.index(name) for name in loads]
            cycle += [number] * len(loads)
    used, index = np.unique(pose, return_inverse=True)
    of = source.candidates
    states = nominal_states(of.q[used][index], of.wrench[np.array(load)])
    return Asked(states, index, np.array(load), np.array(cycle), names)
