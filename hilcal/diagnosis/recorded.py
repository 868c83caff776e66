"""Recorded variables of the state as smooth functions, and the possible motions of the target."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from hilcal.identification.linearisation import Linearisation
from hilcal.model.observe import motion
from hilcal.readings.readings import angle_name, travel_name
from hilcal.types import Floats, Ints

ROW_ORDER = "row order"
"""The variable in place of the time where the readings do not state it: a drift shows by it."""
ROUNDING = 1e-9  # share of the largest value within which a variable does not vary
HARMONICS = 4
POWERS = 4
WIDTH = 9
"""Columns of a law at most: functions of one joint, or three functions along three axes."""
BINS = 8
PER_MOTION = 1e-3
"""An ordinary motion: 1 mrad of a joint, 1 mm of the target."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedVariable:
    """Values (N,) and functions (N, F) of a recorded variable; products with those of another."""

    name: str
    unit: str
    values: Floats
    functions: Floats
    other: "RecordedVariable | None" = None
    labels: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what the law depends on."""
        return (self.name,) if self.other is None else (self.name, self.other.name)

    def product(self) -> Floats:
        """(N, F) functions of the law."""
        if self.other is None:
            return self.functions
        both = self.functions[:, :, None] * self.other.functions[:, None, :]
        return both.reshape(len(both), -1)

    def exchanged(self, name: str, order: Ints) -> "RecordedVariable":
        """Return the law with the values of one variable taken from other readings."""
        out = self if self.other is None else replace(self, other=self.other.exchanged(name, order))
        return replace(out, functions=out.functions[order]) if name == self.name else out


@dataclass(frozen=True, slots=True, eq=False)
class StateVariable:
    """A number that is recorded of the state of each reading."""

    name: str  # e.g. "joint 2 angle"
    unit: str  # SI
    kind: str  # "angle", "travel", "torque", "approach" or "other"
    values: Floats  # (N,)
    joint: int = 0  # number from 0, where it is of one


def state_variables(p: Linearisation) -> Iterator[StateVariable]:
    """Yield the position of each joint, and all else that is recorded of the states and varies."""
    fit, at = p.fit, p.fit.solution.prediction.situation
    s = fit.readings[~fit.outlier].states
    approach, temperature = (x if x is None else x.T for x in (s.approach, s.joint_temperature))
    for j, slides in enumerate(at.cell.arm.slides.tolist()):
        name, joint = travel_name(j) if slides else angle_name(j), f"joint {j + 1}"
        if slides:
            yield StateVariable(name, "m", "travel", at.values[:, j], j)
        else:
            yield StateVariable(name, "rad", "angle", at.angle[:, j], j)
        load = ("force", "N") if slides else ("torque", "N·m")
        for what, unit, kind, values in (
            (*load, "torque", at.torque[:, j]),
            ("approach", "side", "approach", None if approach is None else approach[j]),
            ("temperature", "°C", "other", None if temperature is None else temperature[j]),
        ):
            if values is not None and _varies(values):
                yield StateVariable(f"{joint} {what}", unit, kind, values, j)
    rows = np.flatnonzero(~fit.outlier).astype(float)
    for name, unit, values in (
        (ROW_ORDER, "row", rows) if s.time is None else ("time", "s", s.time),
        ("time under load", "s", s.load_time),
        ("air temperature", "°C", s.air_temperature),
    ):
        if values is not None and _varies(values):
            yield StateVariable(name, unit, "other", values)


def _varies(values: Floats) -> bool:
    return bool(np.ptp(values) > ROUNDING * max(float(np.abs(values).max()), 1.0))


def recorded(p: Linearisation) -> list[RecordedVariable]:
    """Everything recorded of the state that varies."""
    readings = p.fit.readings[~p.fit.outlier]
    situation = p.fit.solution.prediction.situation
    force = np.linalg.norm(readings.states.wrench, axis=1)
    pull = force / max(float(force.max()), 1e-300)
    hung = RecordedVariable("load", "", pull, pull[:, None])
    out: list[RecordedVariable] = []
    turns: list[RecordedVariable] = []

    def smooth(v: StateVariable, centre: float) -> None:
        away = v.values - centre
        away = away / np.abs(away).max()
        # Higher powers are the less likely ones.
        powers = np.stack([away**k / max(k, 1) for k in range(POWERS + 1)], axis=1)
        # The straight line by itself, too: it is simpler than a curve of another variable.
        out.extend(RecordedVariable(v.name, v.unit, v.values, f) for f in (powers, powers[:, :2]))

    for v in state_variables(p):
        one = np.ones(len(v.values))
        if v.kind in ("angle", "travel"):  # laws go by the phase of a travel, people by the travel
            angle, k = situation.angle[:, v.joint, None], np.arange(1, HARMONICS + 1)
            waves = np.stack([np.cos(angle * k) / k, np.sin(angle * k) / k], axis=2)
            waves = np.column_stack([one, waves.reshape(len(one), -1)])
            out.append(RecordedVariable(v.name, v.unit, v.values, waves))
            if np.ptp(pull) > 0.01:
                out.append(replace(out[-1], other=hung))
            first = np.column_stack([one, np.cos(angle), np.sin(angle)])
            turns.append(RecordedVariable(v.name, v.unit, v.values, first))
            if v.kind == "travel" and _varies(v.values):
                smooth(v, float(situation.cell.arm.usual_range[0][v.joint]))
        elif v.kind == "approach":
            sides = np.stack([one, v.values], axis=1)
            out.append(RecordedVariable(v.name, v.unit, v.values, sides))
        else:
            smooth(v, 0.0 if v.kind == "torque" else float(np.median(v.values)))
    loads = np.unique(readings.load)
    if len(loads) > 1:
        member = (readings.load[:, None] == loads[:WIDTH]).astype(float)
        names = tuple(readings.load_names[k] for k in loads)
        index = np.searchsorted(loads, readings.load).astype(float)
        out.append(RecordedVariable("load", "", index, member, None, names))
    return out + [replace(a, other=b) for a, b in combinations(turns, 2)]


def motions(p: Linearisation) -> list[Floats]:
    """(N, m, 1) motion by each joint, and (N, m, 3) of the target along base axes."""
    fit, m = p.fit, p.fit.whitening.m
    prediction = fit.solution.prediction
    moves = motion(
        fit.model.cell,
        prediction.observation,
        prediction.situation.chain,
        prediction.deviation,
        m,
    ).drives
    axes = np.zeros((len(moves), m, 3))
    axes[:, :3] = prediction.observation.axes
    return [PER_MOTION * moves[:, :, [j]] for j in range(moves.shape[2])] + [PER_MOTION * axes]


def law_columns(p: Linearisation, v: RecordedVariable, way: Floats) -> Floats:
    """(R, WIDTH) whitened columns of one law, zeros where it has fewer."""
    w = p.fit.whitening
    functions = v.product()[:, : WIDTH // way.shape[2]]
    raw = (way[:, :, :, None] * functions[:, None, None, :]).reshape(*way.shape[:2], -1)
    out = np.zeros((w.m * len(w), WIDTH))
    out[:, : raw.shape[2]] = w.whiten(w.raw(raw)).reshape(len(out), -1)
    return out


def bins_of(v: RecordedVariable) -> tuple[Floats, Floats]:
    """Bin of each reading and the mean of each bin; equal numbers of readings in each."""
    distinct = np.unique(v.values)
    if v.labels or len(distinct) <= BINS:
        return np.searchsorted(distinct, v.values).astype(float), distinct
    edges = np.unique(np.quantile(v.values, np.linspace(0, 1, BINS + 1)[1:-1]))
    index = np.searchsorted(edges, v.values, side="right")
    filled = np.unique(index)
    place = np.searchsorted(filled, index)
    return place.astype(float), np.array([v.values[place == k].mean() for k in range(len(filled))])
