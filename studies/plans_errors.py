"""Simulated campaigns of a plan, and the errors of the identified parameters."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hilcal.cell import Cell
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
class PlannedReadings:
    """The N readings of a plan, in the form of `Readings`.

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
    """A simulated arm with known parameters."""

    @property
    def parameters(self) -> Mapping[str, Floats]:
        """True parameters by effect, SI."""

    def measure(self, asked: PlannedReadings, rng: np.random.Generator) -> Readings:
        """Return simulated readings of the tracker."""

    def position(self, states: States) -> Floats:
        """Return (N, 3) true positions of the target, sensor axes, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """True and predicted errors of a campaign.

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
    """An arm, and the true motion of its target at the test poses.

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


def subject(scene: Scene, arm: Arm) -> Subject:
    """Compute the truth at the test poses, once for all plans."""
    candidates, work_load = scene.exact.candidates, scene.cell.configured().planning.work_load
    deflection = scene.exact.mode == "deflection"
    if deflection and work_load == UNLOADED:
        loads = np.arange(1, len(candidates.loads))
    else:
        loads = np.array([candidates.loads.index(work_load)])
    q, count = scene.work.q, len(scene.work.q) // len(loads)
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
class PreparedPlan:
    """Data of a plan for its campaigns, which is sent to other processes.

    Attributes:
        readings_planned: the readings.
        std: predicted standard uncertainties by parameter, SI.
        ordinary: ordinary magnitudes by parameter, SI.
        position: predicted RMS error over the test poses, m.
        readings: number of readings.
        poses: number of different poses.
    """

    readings_planned: PlannedReadings
    std: Mapping[str, float]
    ordinary: Mapping[str, float]
    position: float
    readings: int
    poses: int


def prepared(chosen: Chosen) -> PreparedPlan:
    """Return the data of a plan for its campaigns."""
    prediction = chosen.predicted
    assert prediction.position is not None  # noqa: S101 - every scene has test poses
    return PreparedPlan(
        readings_planned=planned_readings(chosen),
        std=prediction.by_name(),
        ordinary={t.name: t.scale for t in chosen.problem.terms if not t.potential},
        position=prediction.position,
        readings=chosen.readings,
        poses=chosen.poses,
    )


def run_campaign(
    cell: Cell, plan: PreparedPlan, subject: Subject, rng: np.random.Generator
) -> Errors:
    """Simulate a campaign of a plan, identify, and compare with the truth.

    The parameters of the planned effects are compared; errors of the frames appear in the
    positions.

    Raises:
        CannotAnswerError: the readings do not determine the parameters.
    """
    config = cell.configured()
    mode, names = config.planning.readings, planned_effects(config, installed())
    readings = subject.arm.measure(plan.readings_planned, rng)
    f = fit(with_effects(cell, readings, mode, names, names), readings, mode)
    at_test = f.model.predict(subject.test, f.theta).observation.position
    error = _of_interest(at_test, subject.unloaded) - subject.truth
    true = subject.arm.parameters
    errors: dict[str, float] = {}
    for e, s in zip(f.model.effects, f.model.slices(), strict=True):
        if e.name in names and len(true.get(e.name, ())) == len(e.parameters):
            parameters = (f"{e.name}.{p.name}" for p in e.parameters)
            errors |= dict(zip(parameters, f.theta[s] - true[e.name], strict=True))
    if not errors:
        raise CannotAnswerError(f"of {', '.join(names)} the simulated arm knows no true parameters")
    if unknown := [name for name in errors if not np.isfinite(plan.std.get(name, np.inf))]:
        raise CannotAnswerError(
            f"{plan.readings} readings of a plan do not determine {', '.join(unknown)}; "
            "compare plans of more readings"
        )
    return Errors(
        parameter=np.array(list(errors.values())),
        std=np.array([plan.std[k] for k in errors]),
        ordinary=np.array([plan.ordinary[k] for k in errors]),
        position=rms(np.linalg.norm(error, axis=1)),
        position_std=plan.position,
        readings=plan.readings,
        poses=plan.poses,
    )


def planned_readings(chosen: Chosen) -> PlannedReadings:
    """Return the readings of a plan; each repetition of a unit is a further cycle."""
    source: DesignProblem = chosen.problem
    mode: Mode = "deflection" if source.mode == "deflection" else "absolute"
    names = source.candidates.loads
    pose: list[int] = []
    load: list[int] = []
    cycle: list[int] = []
    last_cycle: dict[object, int] = {}
    for k in np.flatnonzero(chosen.counts):
        candidate, _ = source.contents[k]
        loads = readings_of(source.contents[k], mode)
        for _ in range(int(chosen.counts[k])):
            # Absolute readings of one cycle have different loads.
            key = candidate if mode == "deflection" else (candidate, loads)
            number = last_cycle[key] = last_cycle.get(key, -1) + 1
            pose += [candidate] * len(loads)
            load += [names.index(name) for name in loads]
            cycle += [number] * len(loads)
    used, index = np.unique(pose, return_inverse=True)
    candidates = source.candidates
    states = nominal_states(candidates.q[used][index], candidates.wrench[np.array(load)])
    return PlannedReadings(states, index, np.array(load), np.array(cycle), names)
