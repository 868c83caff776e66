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
from hilcal.model.observe import Observation, motion
from hilcal.readings.readings import angle_name, travel_name
from hilcal.types import Bools, Floats, Ints

ROW_ORDER = "row order"
"""Replaces the time where the readings do not state it, so that a drift shows."""
ROUNDING = 1e-9  # least variation of a variable, as a share of its largest value
HARMONICS = 4
POWERS = 4
LEAST_LOAD = 0.01  # least spread of the load, of its largest, for laws that follow its size
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
    only: str = ""  # `LawMotion.moves` of the only motion that the law describes; empty for any

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
    kind: str  # "angle", "travel", "torque", "approach", "gravity", "sight", "place" or "other"
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


def place_variables(p: Linearisation) -> Iterator[StateVariable]:
    """Yield where the target is, and the directions of gravity and of the sight in flange axes.

    The component of a direction along a flange axis is the cosine of the angle between them. The
    sight is from the origin of the sensor's axes: of a tracker, where it stands.
    """
    s = p.fit.solution.prediction
    flange, gravity = s.situation.chain.rotation[-1], s.situation.cell.gravity
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-300)
    place = s.observation.base_position
    variables = [
        *_along_flange("gravity", flange.swapaxes(1, 2) @ down),
        StateVariable("target along base x", "m", "place", place[:, 0]),
        StateVariable("target along base y", "m", "place", place[:, 1]),
        StateVariable("distance from the base axis", "m", "place", np.hypot(*place[:, :2].T)),
        StateVariable("height above the base", "m", "place", place[:, 2]),
    ]
    if (sight := _sight(s.observation)) is not None:
        axes = s.observation.axes @ flange
        distance = np.linalg.norm(s.observation.position, axis=1)
        variables += _along_flange("sight", np.einsum("nik,ni->nk", axes, sight))
        variables.append(StateVariable("distance from the sensor's origin", "m", "place", distance))
    yield from (v for v in variables if _varies(v.values))


def _along_flange(kind: str, direction: Floats) -> list[StateVariable]:
    """Return the components of a direction (N, 3)."""
    names = (f"{kind} along flange {axis}" for axis in "xyz")
    return [StateVariable(n, "", kind, x) for n, x in zip(names, direction.T, strict=True)]


def _sight(o: Observation) -> Floats | None:
    """(N, 3) unit vector from the sensor's origin to the target, sensor axes; None of several."""
    if o.sensor is not None or o.is_distance is not None:
        return None
    distance = np.linalg.norm(o.position, axis=1, keepdims=True)
    return np.asarray(o.position / np.maximum(distance, 1e-300))


def _varies(values: Floats) -> bool:
    return bool(np.ptp(values) > ROUNDING * max(float(np.abs(values).max()), 1.0))


def law_variables(p: Linearisation) -> list[RecordedVariable]:
    """Variables of all laws: every recorded variable, the place of the target, and some products.

    Products are those of the size of the load with an angle or a place, of two angles, of the side
    of approach with the torque or the angle of its joint, and, of the motion of a joint alone, of
    its torque with an angle, its temperature or the time: a compliance that these change.
    """
    readings = p.fit.readings[~p.fit.outlier]
    situation = p.fit.solution.prediction.situation
    slides = situation.cell.arm.slides
    force = np.linalg.norm(readings.states.wrench, axis=1)
    pull = force / max(float(force.max()), 1e-300)
    load = RecordedVariable("load", "", pull, pull[:, None])
    loaded = np.ptp(pull) > LEAST_LOAD
    out: list[RecordedVariable] = []
    turns: list[RecordedVariable] = []  # first waves of each angle
    changing: dict[int, list[RecordedVariable]] = {}  # what changes a compliance, by joint; −1: any

    for v in state_variables(p):
        if v.kind in ("angle", "travel"):  # laws use the phase of a travel, reports the travel
            waves = _waves(situation.angle[:, v.joint])
            out.append(RecordedVariable(v.name, v.unit, v.values, waves))
            if loaded:
                out.append(replace(out[-1], factor=load))
            turns.append(replace(out[-1], functions=waves[:, :3], factor=None))
            if v.kind == "travel" and _varies(v.values):
                out += _smooth(v, float(situation.cell.arm.usual_range[0][v.joint]))
        elif v.kind == "approach":
            sides = _sides(v.values)
            out.append(RecordedVariable(v.name, v.unit, v.values, sides))
            side = replace(out[-1], functions=sides[:, 1:])
            if not slides[v.joint]:  # what drags over the joint, as a cable
                out.append(replace(side, factor=_lever(v.joint, situation.angle)))
            # A gear's loop of hysteresis is as wide as the torque is large.
            torque = situation.torque[:, v.joint]
            if _varies(torque):
                out.append(replace(side, factor=_torque(v.joint, torque, absolute=True)))
        else:
            out += _smooth(v, 0.0 if v.kind == "torque" else float(np.median(v.values)))
            if v.kind == "other":
                changing.setdefault(v.joint if v.name.startswith("joint") else -1, []).append(
                    out[-2]
                )
    for v in place_variables(p):
        out += _smooth(v, float(np.median(v.values)))
        if loaded and v.kind == "place":
            out.append(replace(out[-2], factor=load))
        if v.kind == "gravity":  # play, which gravity takes up
            out.append(RecordedVariable(v.name, v.unit, v.values, _sides(v.values)))
    loads = np.unique(readings.load)
    if len(loads) > 1:
        member = (readings.load[:, None] == loads[:LAW_COLUMNS]).astype(float)
        names = tuple(readings.load_names[k] for k in loads)
        index = np.searchsorted(loads, readings.load).astype(float)
        out.append(RecordedVariable("load", "", index, member, None, names))
    for j, torque in enumerate(situation.torque.T):
        if _varies(torque):
            by = _torque(j, torque)
            for other in (*turns, *changing.get(j, []), *changing.get(-1, [])):
                varying = other.functions[:, 1:]  # the constant is a compliance of the model
                out.append(replace(other, functions=varying, factor=by, only=f"joint {j + 1}"))
    return out + [replace(a, factor=b) for a, b in combinations(turns, 2)]


def _waves(angle: Floats) -> Floats:
    """(N, 1 + 2 `HARMONICS`) functions of an angle (N,); higher waves are less likely."""
    k = np.arange(1, HARMONICS + 1)
    waves = np.stack([np.cos(angle[:, None] * k) / k, np.sin(angle[:, None] * k) / k], axis=2)
    return np.column_stack([np.ones(len(angle)), waves.reshape(len(angle), -1)])


def _smooth(v: StateVariable, centre: float) -> list[RecordedVariable]:
    """Return powers of a variable; and the straight line, simpler than a curve of another one."""
    x = v.values - centre
    x = x / np.abs(x).max()
    # Higher powers are less likely.
    powers = np.stack([x**k / max(k, 1) for k in range(POWERS + 1)], axis=1)
    return [RecordedVariable(v.name, v.unit, v.values, f) for f in (powers, powers[:, :2])]


def _sides(values: Floats) -> Floats:
    """(N, 2) functions of a side: 1 and the sign of the values (N,)."""
    return np.stack([np.ones(len(values)), np.sign(values)], axis=1)


def _lever(joint: int, angle: Floats) -> RecordedVariable:
    """Return the first waves of the angle of a joint; `angle` (N, n) is of all joints, rad."""
    turn = angle[:, joint]
    waves = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return RecordedVariable(angle_name(joint), "rad", turn, waves)


def _torque(joint: int, torque: Floats, absolute: bool = False) -> RecordedVariable:
    """Return the torque (N,) of a joint, N·m, over its largest; with its absolute value, if so."""
    x = torque / np.abs(torque).max()
    functions = np.stack([np.abs(x), x] if absolute else [x], axis=1)
    return RecordedVariable(f"joint {joint + 1} torque", "N·m", torque, functions)


@dataclass(frozen=True, slots=True, eq=False)
class LawMotion:
    """A motion that a law describes: of a joint, of the base (a turn), or of the target."""

    moves: str  # "joint 2", "base" or "target"
    axes: str  # of the columns: "base", "flange", "sight"; "" for a joint
    columns: Floats  # (N, m, K) displacement of the readings by `ORDINARY_MOTION` along each axis
    unit: str  # of the motion


def motions(p: Linearisation) -> list[LawMotion]:
    """Motions by each joint; turns of the base; the target along base, flange, and sight."""
    fit, m, s = p.fit, p.fit.whitening.m, p.fit.solution.prediction
    arm, o = fit.model.cell.arm, s.observation
    drives = motion(fit.model.cell, o, s.situation.chain, s.deviation, m).drives
    turned = np.cross(np.eye(3), o.base_position[:, None]).swapaxes(1, 2)
    of_target = [
        ("base", "base", "rad", o.axes @ turned),
        ("target", "base", "m", o.axes),
        ("target", "flange", "m", o.axes @ s.situation.chain.rotation[-1]),
    ]
    if (sight := _sight(o)) is not None:
        of_target.append(("target", "sight", "m", sight[:, :, None]))
    out = [
        LawMotion(f"joint {j + 1}", "", ORDINARY_MOTION * drives[:, :, [j]], arm.unit(j))
        for j in range(arm.n)
    ]
    for moves, axes, unit, directions in of_target:
        columns = np.zeros((len(drives), m, directions.shape[2]))
        columns[:, :3] = ORDINARY_MOTION * directions
        out.append(LawMotion(moves, axes, columns, unit))
    return out


def law_columns(p: Linearisation, v: RecordedVariable, moved: LawMotion) -> Floats:
    """(R, WIDTH) whitened columns of a law with one of the `motions`, padded with zeros."""
    w, moves = p.fit.whitening, moved.columns
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
    p = linearise(fit)
    varying = list(state_variables(p))
    loads = np.unique(readings.load)
    if len(loads) > 1:
        names = tuple(readings.load_names[k] for k in loads)
        index = np.searchsorted(loads, readings.load).astype(float)
        varying.append(StateVariable("load", "", "other", index, labels=names))
    varying += place_variables(p)
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
