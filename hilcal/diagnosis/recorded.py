"""Recorded variables of the state, smooth functions of them, and what picked readings share.

A difference of picked readings from the others is a description, no test: readings that somebody
picked for their errors, or for their pose, are no random sample, so a p-value would be meaningless.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import Linearisation, linearise
from hilcal.model.observe import motion
from hilcal.readings.readings import angle_name, travel_name
from hilcal.types import Bools, Floats, Ints

ROW_ORDER = "row order"
"""Replaces the time where the readings do not state it, so that a drift shows."""
ROUNDING = 1e-9  # least variation of a variable, as a share of its largest value
HARMONICS = 4
POWERS = 4
LAW_COLUMNS = 9
"""Most columns of a law: functions of one joint, or three functions along three axes."""
BINS = 8
ORDINARY_MOTION = 1e-3
"""An ordinary motion: 1 mrad of a joint, 1 mm of the target."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedVariable:
    """A recorded variable and functions of it, of which a law is a linear combination.

    The functions of a law of two variables are the products of both variables' functions.
    """

    name: str
    unit: str
    values: Floats  # (N,)
    functions: Floats  # (N, F)
    factor: "RecordedVariable | None" = None  # second variable of the law
    labels: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables of the law."""
        return (self.name,) if self.factor is None else (self.name, self.factor.name)

    def product(self) -> Floats:
        """(N, F) functions of the law."""
        if self.factor is None:
            return self.functions
        products = self.functions[:, :, None] * self.factor.functions[:, None, :]
        return products.reshape(len(products), -1)

    def permuted(self, name: str, order: Ints) -> "RecordedVariable":
        """Return the law with the values of one variable permuted between readings."""
        factor = self.factor and self.factor.permuted(name, order)
        functions = self.functions[order] if name == self.name else self.functions
        return replace(self, functions=functions, factor=factor)


@dataclass(frozen=True, slots=True, eq=False)
class StateVariable:
    """A variable that is recorded of the state of each reading."""

    name: str  # e.g. "joint 2 angle"
    unit: str  # SI
    kind: str  # "angle", "travel", "torque", "approach" or "other"
    values: Floats  # (N,)
    joint: int = 0  # index of the joint, if the variable belongs to one
    labels: tuple[str, ...] = ()  # names of the values 0, 1, ... where they are not numbers


def state_variables(p: Linearisation) -> Iterator[StateVariable]:
    """Yield the position of each joint, and every other recorded variable that varies."""
    fit, situation = p.fit, p.fit.solution.prediction.situation
    s = fit.readings[~fit.outlier].states
    approach, temperature = (x if x is None else x.T for x in (s.approach, s.joint_temperature))
    for j, slides in enumerate(situation.cell.arm.slides.tolist()):
        if slides:
            yield StateVariable(travel_name(j), "m", "travel", situation.values[:, j], j)
        else:
            yield StateVariable(angle_name(j), "rad", "angle", situation.angle[:, j], j)
        load = ("force", "N") if slides else ("torque", "N·m")
        for quantity, unit, kind, values in (
            (*load, "torque", situation.torque[:, j]),
            ("approach", "side", "approach", None if approach is None else approach[j]),
            ("temperature", "°C", "other", None if temperature is None else temperature[j]),
        ):
            if values is not None and _varies(values):
                yield StateVariable(f"joint {j + 1} {quantity}", unit, kind, values, j)
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


def law_variables(p: Linearisation) -> list[RecordedVariable]:
    """Variables of all laws: every recorded variable, and products of some.

    Products are those of an angle with the size of the load, of two angles, and of the side of
    approach with the torque of its joint.
    """
    readings = p.fit.readings[~p.fit.outlier]
    situation = p.fit.solution.prediction.situation
    force = np.linalg.norm(readings.states.wrench, axis=1)
    pull = force / max(float(force.max()), 1e-300)
    load = RecordedVariable("load", "", pull, pull[:, None])
    out: list[RecordedVariable] = []
    turns: list[RecordedVariable] = []

    def smooth(v: StateVariable, centre: float) -> None:
        x = v.values - centre
        x = x / np.abs(x).max()
        # Higher powers are less likely.
        powers = np.stack([x**k / max(k, 1) for k in range(POWERS + 1)], axis=1)
        # The straight line by itself, too: it is simpler than a curve of another variable.
        out.extend(RecordedVariable(v.name, v.unit, v.values, f) for f in (powers, powers[:, :2]))

    for v in state_variables(p):
        ones = np.ones(len(v.values))
        if v.kind in ("angle", "travel"):  # laws use the phase of a travel, reports the travel
            angle, k = situation.angle[:, v.joint, None], np.arange(1, HARMONICS + 1)
            waves = np.stack([np.cos(angle * k) / k, np.sin(angle * k) / k], axis=2)
            waves = np.column_stack([ones, waves.reshape(len(ones), -1)])
            out.append(RecordedVariable(v.name, v.unit, v.values, waves))
            if np.ptp(pull) > 0.01:
                out.append(replace(out[-1], factor=load))
            first = np.column_stack([ones, np.cos(angle), np.sin(angle)])
            turns.append(RecordedVariable(v.name, v.unit, v.values, first))
            if v.kind == "travel" and _varies(v.values):
                smooth(v, float(situation.cell.arm.usual_range[0][v.joint]))
        elif v.kind == "approach":
            sides = np.stack([ones, v.values], axis=1)
            out.append(RecordedVariable(v.name, v.unit, v.values, sides))
            # A gear's loop of hysteresis is as wide as the torque is large.
            torque = situation.torque[:, v.joint]
            if _varies(torque):
                x = torque / np.abs(torque).max()
                name = f"joint {v.joint + 1} torque"
                wide = RecordedVariable(name, "N·m", torque, np.stack([np.abs(x), x], axis=1))
                out.append(RecordedVariable(v.name, v.unit, v.values, sides[:, 1:], wide))
        else:
            smooth(v, 0.0 if v.kind == "torque" else float(np.median(v.values)))
    loads = np.unique(readings.load)
    if len(loads) > 1:
        member = (readings.load[:, None] == loads[:LAW_COLUMNS]).astype(float)
        names = tuple(readings.load_names[k] for k in loads)
        index = np.searchsorted(loads, readings.load).astype(float)
        out.append(RecordedVariable("load", "", index, member, None, names))
    return out + [replace(a, factor=b) for a, b in combinations(turns, 2)]


def motions(p: Linearisation) -> list[Floats]:
    """(N, m, 1) motion by each joint, and (N, m, 3) of the target along base axes."""
    fit, m, s = p.fit, p.fit.whitening.m, p.fit.solution.prediction
    drives = motion(fit.model.cell, s.observation, s.situation.chain, s.deviation, m).drives
    axes = np.zeros((len(drives), m, 3))
    axes[:, :3] = s.observation.axes
    return [ORDINARY_MOTION * drives[:, :, [j]] for j in range(drives.shape[2])] + [
        ORDINARY_MOTION * axes
    ]


def law_columns(p: Linearisation, v: RecordedVariable, moves: Floats) -> Floats:
    """(R, WIDTH) whitened columns of a law with one of the `motions`, padded with zeros."""
    w = p.fit.whitening
    functions = v.product()[:, : LAW_COLUMNS // moves.shape[2]]
    raw = (moves[:, :, :, None] * functions[:, None, None, :]).reshape(*moves.shape[:2], -1)
    out = np.zeros((w.m * len(w), LAW_COLUMNS))
    out[:, : raw.shape[2]] = w.whiten(w.raw(raw)).reshape(len(out), -1)
    return out


def bins_of(v: RecordedVariable) -> tuple[Floats, Floats]:
    """Bin (N,) of each reading and mean (K,) of each bin; about as many readings in every bin."""
    distinct = np.unique(v.values)
    if v.labels or len(distinct) <= BINS:
        return np.searchsorted(distinct, v.values).astype(float), distinct
    edges = np.unique(np.quantile(v.values, np.linspace(0, 1, BINS + 1)[1:-1]))
    index = np.searchsorted(edges, v.values, side="right")
    filled = np.unique(index)
    bins = np.searchsorted(filled, index)
    return bins.astype(float), np.array([v.values[bins == k].mean() for k in range(len(filled))])


CLEAR_PROBABILITY = 0.85
"""Probability from which a difference is clear: that a random picked reading has a larger (or a
smaller) value than a random one of the others. A choice."""


@dataclass(frozen=True, slots=True)
class Difference:
    """How the picked readings differ from the others in one variable."""

    variable: str  # e.g. "joint 2 torque"; "load 5 kg" for one of several names
    unit: str  # SI; "" for a share
    picked: float  # median of the picked readings, or the share of that name among them
    others: float  # the same of the others
    larger: float  # probability that a picked reading has the larger value, ties counted half

    @property
    def clear(self) -> bool:
        """Whether the difference is worth naming, see `CLEAR_PROBABILITY`."""
        return max(self.larger, 1 - self.larger) >= CLEAR_PROBABILITY


def recorded_values(fit: Fit) -> tuple[StateVariable, ...]:
    """Return variables (N,) of all readings that vary, load and place too; NaN for outliers."""
    used, readings = ~fit.outlier, fit.readings[~fit.outlier]
    target = fit.solution.prediction.observation.base_position
    varying = list(state_variables(linearise(fit)))
    loads = np.unique(readings.load)
    if len(loads) > 1:
        names = tuple(readings.load_names[k] for k in loads)
        index = np.searchsorted(loads, readings.load).astype(float)
        varying.append(StateVariable("load", "", "other", index, labels=names))
    across = np.hypot(target[:, 0], target[:, 1])
    varying.append(StateVariable("distance from the base axis", "m", "other", across))
    varying.append(StateVariable("height above the base", "m", "other", target[:, 2]))
    of_all = np.full((len(varying), len(used)), np.nan)
    of_all[:, used] = [v.values for v in varying]
    return tuple(replace(v, values=x) for v, x in zip(varying, of_all, strict=True))


def distinguish(fit: Fit, picked: Bools) -> tuple[Difference, ...]:
    """Compare picked measurements (N,) with the others in every variable; clearest first."""
    from scipy.stats import rankdata  # slow to import

    measured = np.zeros(len(picked), dtype=bool)
    measured[np.flatnonzero(~fit.outlier)[fit.whitening.reading]] = True
    inside, outside = picked & measured, ~picked & measured
    if not (inside.any() and outside.any()):
        return ()
    differences = []
    for v in recorded_values(fit):
        members = [
            (f"{v.name} {name}", (v.values == k).astype(float)) for k, name in enumerate(v.labels)
        ]
        middle = np.mean if members else np.median
        for name, x in members or [(v.name, v.values)]:
            a, b = x[inside], x[outside]
            ranks = rankdata(np.concatenate([a, b]))[: len(a)]
            larger = float((ranks.sum() - len(a) * (len(a) + 1) / 2) / (len(a) * len(b)))
            differences.append(Difference(name, v.unit, float(middle(a)), float(middle(b)), larger))
    return tuple(sorted(differences, key=lambda d: -abs(d.larger - 0.5)))
