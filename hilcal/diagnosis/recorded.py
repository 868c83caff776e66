"""Recorded variables of the state as smooth functions, and the possible motions of the target."""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from hilcal.diagnosis.misfit_breakdown import ROW_ORDER
from hilcal.identification.linearisation import Linearisation
from hilcal.model.observe import motion
from hilcal.readings.readings import angle_name, travel_name
from hilcal.types import Floats, Ints

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


def recorded(p: Linearisation) -> list[RecordedVariable]:
    """Everything recorded of the state that varies."""
    readings = p.fit.readings[~p.fit.outlier]
    s, situation = readings.states, p.fit.solution.prediction.situation
    out: list[RecordedVariable] = []

    def smooth(name: str, unit: str, values: Floats | None, centre: float | None = None) -> None:
        if values is None or np.ptp(values) <= 1e-9 * max(float(np.abs(values).max()), 1.0):
            return
        away = values - (np.median(values) if centre is None else centre)
        away = away / np.abs(away).max()
        # Higher powers are the less likely ones.
        powers = np.stack([away**k / max(k, 1) for k in range(POWERS + 1)], axis=1)
        # The straight line by itself, too: it is simpler than a curve of another variable.
        out.extend(RecordedVariable(name, unit, values, f) for f in (powers, powers[:, :2]))

    force = np.linalg.norm(s.wrench, axis=1)
    pull = force / max(float(force.max()), 1e-300)
    hung = RecordedVariable("load", "", pull, pull[:, None])
    turns: list[RecordedVariable] = []
    for j in range(situation.angle.shape[1]):
        angle = situation.angle[:, j]
        k = np.arange(1, HARMONICS + 1)
        waves = np.stack([np.cos(angle[:, None] * k) / k, np.sin(angle[:, None] * k) / k], axis=2)
        waves = np.column_stack([np.ones(len(angle)), waves.reshape(len(angle), -1)])
        # Laws go by the phase of a travel, people by the travel.
        slides = bool(situation.cell.arm.slides[j])
        name, unit = (travel_name(j), "m") if slides else (angle_name(j), "rad")
        shown = situation.values[:, j] if slides else angle
        out.append(RecordedVariable(name, unit, shown, waves))
        if np.ptp(pull) > 0.01:
            out.append(replace(out[-1], other=hung))
        first = np.stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)], axis=1)
        turns.append(RecordedVariable(name, unit, shown, first))
        if slides:
            smooth(name, unit, shown, float(situation.cell.arm.usual_range[0][j]))
        load = (f"joint {j + 1} force", "N") if slides else (f"joint {j + 1} torque", "N·m")
        smooth(*load, situation.torque[:, j], 0.0)
        if s.approach is not None and np.ptp(s.approach[:, j]) > 0:
            side = s.approach[:, j]
            sides = np.stack([np.ones(len(side)), side], axis=1)
            out.append(RecordedVariable(f"joint {j + 1} approach", "side", side, sides))
        if s.joint_temperature is not None:
            smooth(f"joint {j + 1} temperature", "°C", s.joint_temperature[:, j])
    if s.time is None:
        smooth(ROW_ORDER, "row", np.flatnonzero(~p.fit.outlier).astype(float))
    else:
        smooth("time", "s", s.time)
    smooth("time under load", "s", s.load_time)
    smooth("air temperature", "°C", s.air_temperature)
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
