"""States of the arm, and readings of the tracker in them, with their noise and their ranges.

Noise that is correlated along the order of the readings, as of air that moves slowly: a share φ of
the stated covariance V_i of reading i is not white: with S_i S_iᵀ = V_i,

    e_i = √(1 − φ) w_i + √φ S_i z_i,    Cov(z_i, z_j) = exp(−|t_i − t_j| / τ) 1

w_i independent of covariance V_i, each element of z an Ornstein-Uhlenbeck process. So the stated
covariance holds for each reading. t is the time of a reading, or its number in the order, where
z is an AR(1) process with ρ = exp(−1/τ). S_i is the symmetric root of V_i's correlation matrix
times the standard deviations: neighbours with nearly the same V have nearly the same S, in any
units. V excludes an estimated scatter of the arm and the error that targets share in one arrival:
the arm draws these anew in each arrival.

Source: Gelb (ed.), *Applied Optimal Estimation* (1974), section 3.8 (exponentially correlated
noise).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from textwrap import shorten
from typing import Any, Literal

import numpy as np

from hilcal.errors import InputError, expect
from hilcal.robot.se3 import by_field
from hilcal.shown import WIDTH, Brief, Tabular
from hilcal.toml import suggest
from hilcal.types import Bools, Floats, Ints

ObserverKind = Literal["station", "point", "gauge"]
ScatterKind = Literal["joints", "each joint", "isotropic"]
Clock = Literal["time", "order"]
Rows = int | Ints | Bools | slice | Sequence[int]
Names = str | int | Iterable[str | int]
TEMPERATURES = ("air_temperature", "joint_temperature")
"""Columns of `States` that are NaN in readings without them; see `Readings.whole`."""
SAME_POSE = 1e-6  # Commanded joints of one pose agree to this, rad
VALID_ROWS = "valid: whole numbers, a slice, (N,) bools, as of readings.where(pose='p3')"


class Numbers(np.ndarray):
    """Numbers (N,) of things that have names; numpy would call every number unequal to a name."""

    def __eq__(self, other: object) -> Any:
        return super().__eq__(_without_names(other))

    def __ne__(self, other: object) -> Any:
        return super().__ne__(_without_names(other))

    __hash__ = None  # as of numpy's


def _without_names(other: object) -> Any:
    if np.asarray(other).dtype.kind in "UTO":
        raise InputError(
            f"poses, loads and targets are numbers here, not names as {shorten(repr(other), 40)}; "
            "valid: readings.where(pose='p3'), where(load='5kg'), or a column of to_frame()"
        )
    return other


def _checked_rows(rows: Rows) -> Ints | Bools | slice:
    """Return rows as numpy takes them, a single one as an array."""
    if isinstance(rows, slice):
        return rows
    given = np.asarray(rows)
    chosen = given.astype(int) if given.size == 0 else np.atleast_1d(given)
    if (
        chosen.dtype.kind not in "biu"
        or chosen.ndim > 1
        or (given.ndim == 0 and given.dtype == bool)
    ):
        raise InputError(f"rows {shorten(repr(rows), 60)} of readings; {VALID_ROWS}")
    return chosen


@dataclass(frozen=True, slots=True, eq=False)
class States(Brief):
    """N states of the arm: everything that a prediction may depend on.

    Attributes:
        q: (N, n) commanded joint angles, rad.
        wrench: (N, 6) force and moment that the load exerts on the tool at the load point,
            base axes, N and N·m; zero where unloaded.
        time: (N,) time since the campaign's start, s; None when unknown.
        load_time: (N,) time under the present load, s.
        air_temperature: (N,) °C; NaN in stored readings without it.
        joint_temperature: (N, n) °C; NaN in stored readings without them.
        approach: (N, n) side from which each joint arrived, -1 or +1.
        q_actual: (N, n) joint angles that the encoders reported, rad.
        torque: (N, n) measured static torques of the drives, N·m: the negative of those by load
            and weight about the drives' axes (`Situation.torque`); NaN in readings without them.
        target: (N,) number of the target that is read, in the order of `Cell.target_names`; None
            where the tool carries one target.
        observer: (N,) number of the observer, in the order of `Readings.observers`; None where one
            tracker reads all.
    """

    q: Floats
    wrench: Floats
    time: Floats | None = None
    load_time: Floats | None = None
    air_temperature: Floats | None = None
    joint_temperature: Floats | None = None
    approach: Floats | None = None
    q_actual: Floats | None = None
    torque: Floats | None = None
    target: Ints | None = None
    observer: Ints | None = None

    def __len__(self) -> int:
        return len(self.q)

    def __getitem__(self, rows: Rows) -> "States":
        chosen = _checked_rows(rows)
        return by_field([self], lambda fields: fields[0][chosen])

    @staticmethod
    def joined(parts: Sequence["States"]) -> "States":
        """Put states with the same columns one after the other."""
        return by_field(parts, np.concatenate)


@dataclass(frozen=True, slots=True)
class ObserverName:
    """What observes the target."""

    kind: ObserverKind  # of positions or poses, of distances, or of heights over a plane
    name: str

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"


@dataclass(frozen=True, slots=True)
class ArmScatter:
    """An estimate of the arm's scatter; see `identification.noise.arm_scatter`.

    Attributes:
        kind: "joints" (one σ for all of them), "each joint" (one σ per joint), or "isotropic" (of
            the target's position).
        std: σ of each, rad, or m where isotropic.
        std_error: their standard uncertainties.
        size_m: rms over the readings of the 3-D displacement of the target.
        log_evidence: log odds of this against noise of the instrument that is larger than stated.
        instrument_factor: factor of the instrument's standard deviations in that alternative.
        unit: factor of the instrument's standard deviations beside a background, where it is
            estimated, too. The covariance is in units of it: (σ / unit)² is added.
        predicted_share: share of the misfit on poses left out that recorded variables predict.
        predicted_by: the variables that predict it, at most two.
    """

    kind: ScatterKind
    std: tuple[float, ...]
    std_error: tuple[float, ...]
    size_m: float
    log_evidence: float
    instrument_factor: float
    unit: float = 1.0
    predicted_share: float = 0.0
    predicted_by: tuple[str, ...] = ()

    def to_json(self) -> dict[str, object]:
        """Return the attributes by name, SI."""
        return asdict(self)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "ArmScatter":
        """Return what `to_json` wrote."""
        return cls(**_with_tuples(content))


@dataclass(frozen=True, slots=True)
class SerialNoise:
    """An estimate of correlated noise; see `diagnosis.serial_noise`.

    Attributes:
        clock: what t is: "time", s, or "order", the number of the reading.
        share: φ, 0 to 1.
        share_error: its standard uncertainty.
        length: τ, s or readings.
        rho: correlation of z between consecutive readings, at their median distance in time.
        rho_error: its standard uncertainty.
        log_likelihood_ratio: gain of the restricted log likelihood over white noise, both with
            every effect that the readings could show.
        proved: whether that gain is significant; False where effects explain the readings as well.
        instead: what explains them as well, where it is not proved.
        wider: least and largest factor by which it changes the standard uncertainties of the
            parameters.
    """

    clock: Clock
    share: float
    share_error: float
    length: float
    rho: float
    rho_error: float
    log_likelihood_ratio: float
    proved: bool = True
    instead: tuple[str, ...] = ()
    wider: tuple[float, float] = (1.0, 1.0)

    @property
    def half(self) -> float:
        """Distance after which half of the correlation is left, s or readings."""
        return self.length * float(np.log(2.0))

    def correlation(self, t: Floats) -> Floats:
        """Cov(z_i, z_j) (..., N, N) of readings at t (..., N)."""
        return np.asarray(np.exp(-np.abs(t[..., :, None] - t[..., None, :]) / self.length))

    def to_json(self) -> dict[str, object]:
        """Return the attributes by name, and `half`."""
        return {**asdict(self), "half": self.half}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "SerialNoise":
        """Return what `to_json` wrote."""
        return cls(**_with_tuples({name: x for name, x in content.items() if name != "half"}))


def _with_tuples(content: Mapping[str, Any]) -> dict[str, Any]:
    return {name: tuple(x) if isinstance(x, list) else x for name, x in content.items()}


@dataclass(frozen=True, slots=True, eq=False)
class Readings(Tabular):
    """N readings of the target's position (m = 3) or pose (m = 6), one per state.

    A distance or a height is one number: the first element of a reading of m = 3, whose others are
    0 and have no variance, so that whitening drops them (`whitening.whitening_matrix`).

    Attributes:
        pose: (N,) index into `pose_names` of the commanded pose, which is not its name in the
            table: `where` finds poses and loads by name.
        load: (N,) index into `load_names`; the unloaded state has the name "none".
        cycle: (N,) readings of one pose and one cycle share their unloaded reading.
        value: (N, m) position in m and, for m = 6, rotation vector in rad, sensor axes.
        covariance: (N, m, m) covariance of `value`, m², m·rad, rad²; for the rotations it is
            the covariance of a small rotation about the sensor's axes.
        pose_names: names of the poses, as in the table.
        target_names: names of the targets that `states.target` numbers; empty where it is None.
        observers: what `states.observer` numbers; empty where it is None.
        common: (N, m, n) factors F of the error that all readings of one arrival have in common:
            Cov(i, j) = F_i F_jᵀ for two readings i, j of one arrival (see `arrivals`); F_i F_iᵀ
            is part of `covariance`. None where no such error is known.
        scatter_stated: whether the arm's own scatter is in the covariances, as far as it is known;
            where False, `hilcal.diagnose` may attribute the remaining misfit to it.
        noise_stated: whether the noise is stated; where False, it was estimated from these
            readings, so that χ² does not test the model.
        stated: (N, m, m) the covariance without a scatter that was estimated; None where
            `covariance` has none.
        arm_scatter: the estimate that `covariance` includes beside `stated`.
        serial: how the noise of the readings is correlated along their order, as estimated; None
            for noise that is white.
        along: (N,) t of `serial`: time, s, or number in the order of the campaign.
    """

    states: States
    pose: Ints
    load: Ints
    cycle: Ints
    value: Floats
    covariance: Floats
    load_names: tuple[str, ...]
    pose_names: tuple[str, ...]
    target_names: tuple[str, ...] = ()
    observers: tuple[ObserverName, ...] = ()
    common: Floats | None = None
    scatter_stated: bool = True
    noise_stated: bool = True
    stated: Floats | None = None
    arm_scatter: ArmScatter | None = None
    serial: SerialNoise | None = None
    along: Floats | None = None

    def __post_init__(self) -> None:
        for name in ("pose", "load"):
            object.__setattr__(self, name, np.asarray(getattr(self, name)).view(Numbers))

    def __len__(self) -> int:
        return len(self.pose)

    def __getitem__(self, rows: Rows) -> "Readings":
        chosen = _checked_rows(rows)
        part = by_field([self], lambda fields: fields[0][chosen])
        return replace(part, states=self.states[chosen])

    def where(self, *, pose: Names | None = None, load: Names | None = None) -> Bools:
        """(N,) which readings are of these poses and these loads, by the names of the table.

            test = readings.where(pose=["p3", "p7"])
            fit = hc.fit(model, readings[~test])

        Raises:
            InputError: a pose or a load that is not among `pose_names` or `load_names`.
        """
        chosen = np.ones(len(self), dtype=bool)
        if pose is not None:
            chosen &= np.isin(self.pose, _numbers(pose, self.pose_names, "pose"))
        if load is not None:
            chosen &= np.isin(self.load, _numbers(load, self.load_names, "load"))
        return chosen

    def __add__(self, other: "Readings") -> "Readings":
        """Put readings of one cell after these; equal names are the same pose, or load.

        Raises:
            InputError: columns that one of them lacks, other targets or observers, or a pose that
                has other commanded joints.
        """
        expect(other, Readings, "what is added to readings", "Readings")
        _check_columns(self, other)
        poses = tuple(dict.fromkeys((*self.pose_names, *other.pose_names)))
        loads = tuple(dict.fromkeys((*self.load_names, *other.load_names)))
        parts = [
            replace(
                r,
                pose=np.array([poses.index(n) for n in r.pose_names], dtype=np.int64)[r.pose],
                load=np.array([loads.index(n) for n in r.load_names], dtype=np.int64)[r.load],
                pose_names=poses,
                load_names=loads,
            )
            for r in (self, other)
        ]
        joined = Readings.joined(parts)
        first, which = np.unique(joined.pose, return_index=True, return_inverse=True)[1:]
        q = joined.states.q
        moved = np.abs(q - q[first][which.reshape(-1)]).max(axis=1) > SAME_POSE
        if moved.any():
            name = poses[joined.pose[np.argmax(moved)]]
            raise InputError(
                f"pose {name!r} has other commanded joints in the readings that are added; give "
                "another pose another name"
            )
        noise_stated = self.noise_stated and other.noise_stated
        scatter_stated = self.scatter_stated and other.scatter_stated
        return replace(joined, noise_stated=noise_stated, scatter_stated=scatter_stated)

    @staticmethod
    def joined(parts: Sequence["Readings"]) -> "Readings":
        """Put readings with the same names and columns one after the other."""
        if len(parts) == 1:
            return parts[0]
        states = States.joined([p.states for p in parts])
        joined = by_field(parts, np.concatenate)
        return replace(joined, states=states, common=None, serial=None, along=None)

    def _brief(self) -> dict[str, str]:
        at = np.unique(self.pose)
        poses = ", ".join(self.pose_names[k] for k in at)
        counts = zip(*np.unique(self.load, return_counts=True), strict=True)
        loads = [f"{self.load_names[k]} {count}" for k, count in counts]
        texts = {
            "readings": f"{len(self)}, of {'positions' if self.m == 3 else 'poses of the target'}",
            "poses": f"{len(at)}: {poses}",
            "loads": ", ".join(loads),
            "targets": ", ".join(self.target_names),
            "observers": ", ".join(map(str, self.observers)),
            "noise": "stated" if self.noise_stated else "estimated from these readings",
            "more": "to_frame(), where(pose=, load=), value, covariance, states",
        }
        return {name: shorten(text, WIDTH) for name, text in texts.items() if text}

    def whole(self) -> "Readings":
        """Return the readings without temperatures that some of them lack, as fits take them.

        An effect of a temperature acts in every reading, so it cannot be computed from some.
        """
        lacking: dict[str, Any] = {
            name: None
            for name in TEMPERATURES
            if (column := getattr(self.states, name)) is not None and np.isnan(column).any()
        }
        return replace(self, states=replace(self.states, **lacking)) if lacking else self

    def as_stated(self) -> "Readings":
        """Return the readings without an estimated scatter of the arm."""
        if self.stated is None:
            return self
        return replace(self, covariance=self.stated, common=None, stated=None, arm_scatter=None)

    def positions_alone(self) -> "Readings":
        """Return the readings without orientations."""
        return replace(
            self,
            value=self.value[:, :3],
            covariance=self.covariance[:, :3, :3],
            common=None if self.common is None else self.common[:, :3],
            stated=None if self.stated is None else self.stated[:, :3, :3],
        )

    def with_serial(self, noise: SerialNoise | None) -> "Readings":
        """Return all readings of a campaign with noise that is correlated along their order."""
        if noise is None:
            return replace(self, serial=None, along=None)
        order = np.arange(len(self), dtype=float)
        return replace(
            self, serial=noise, along=self.states.time if noise.clock == "time" else order
        )

    @property
    def m(self) -> int:
        """Elements per reading: 3 or 6."""
        return int(self.value.shape[1])

    @property
    def unloaded(self) -> Bools:
        """(N,) which readings were taken without a load."""
        none = [i for i, name in enumerate(self.load_names) if name == "none"]
        return np.isin(self.load, none)

    @property
    def target(self) -> Ints:
        """(N,) number of the target that is read; 0 where there is one."""
        number = self.states.target
        number = np.zeros(len(self), dtype=np.int64) if number is None else number
        return number.view(Numbers)

    @property
    def observer(self) -> Ints:
        """(N,) number of the observer; 0 where one tracker reads all."""
        number = self.states.observer
        return np.zeros(len(self), dtype=np.int64) if number is None else number

    def with_observers(self, observers: Sequence[ObserverName]) -> "Readings":
        """Return the readings with observers numbered as in `observers`; without any unchanged.

        Raises:
            InputError: an observer that is not in `observers`.
        """
        if self.states.observer is None or self.observers == tuple(observers):
            return self
        for name in self.observers:
            if name not in observers:
                valid = ", ".join(map(str, observers)) or "one tracker"
                raise InputError(
                    f"{name} observed these readings, but not those that were fitted: {valid}"
                )
        number = np.array([list(observers).index(name) for name in self.observers])
        states = replace(self.states, observer=number[self.observer])
        return replace(self, states=states, observers=tuple(observers))

    @property
    def scalar(self) -> Bools:
        """(N,) which readings are one number: a distance or a height."""
        scalar = [k for k, o in enumerate(self.observers) if o.kind != "station"]
        return np.isin(self.observer, scalar) & (len(scalar) > 0)

    @property
    def line(self) -> Ints:
        """(N,) number of the pair of target and observer; deflections are within one pair."""
        if self.states.observer is None:
            return self.target
        return self.target * max(len(self.observers), 1) + self.observer

    @property
    def arrivals(self) -> Ints:
        """(N,) number of the arrival of the arm in which each reading was taken.

        Readings of different targets, or by different observers, at one pose, under one load, in
        one cycle are of one arrival: the arm did not move between them. A target that was read
        several times there was read in as many arrivals, in the order of the readings.
        """
        where = self.pose, self.load, self.cycle
        order, first, sizes = in_groups(numbered(*where, self.line))
        visit = np.empty(len(self), dtype=np.int64)
        visit[order] = np.arange(len(self)) - np.repeat(first, sizes)
        return numbered(*where, visit)


def _numbers(wanted: Names, names: tuple[str, ...], what: str) -> list[int]:
    """Return the numbers of names; whole numbers are names of a table, too."""
    if isinstance(wanted, str) or not isinstance(wanted, Iterable):
        wanted = [wanted]
    texts = [str(name) for name in wanted]
    for name in texts:
        if name not in names:
            raise InputError(
                f"unknown {what} {name!r}{suggest(name, names)}; valid: {', '.join(names)}"
            )
    return [names.index(name) for name in texts]


def _check_columns(a: Readings, b: Readings) -> None:
    """Refuse readings that cannot be put together."""
    columns = [
        {f.name for f in fields(r.states) if getattr(r.states, f.name) is not None} for r in (a, b)
    ]
    if lacking := ", ".join(sorted(columns[0] ^ columns[1])):
        raise InputError(f"some of the readings lack {lacking}; valid: equal columns")
    if a.value.shape[1:] != b.value.shape[1:] or a.states.q.shape[1:] != b.states.q.shape[1:]:
        raise InputError("the readings are of other arms, or positions and poses; valid: the same")
    if (a.target_names, a.observers) != (b.target_names, b.observers):
        raise InputError("the readings have other targets or observers; valid: the same")
    if (a.stated is None) != (b.stated is None):
        raise InputError("some of the readings have an estimated scatter; valid: r.as_stated()")


def numbered(*keys: Ints) -> Ints:
    """Return (N,) numbers from 0, the same where all keys (N,) are the same."""
    return np.unique(np.stack(keys, axis=1), axis=0, return_inverse=True)[1].reshape(-1)


def in_groups(group: Ints, *first_by: Ints | Bools) -> tuple[Ints, Ints, Ints]:
    """Order of rows by their group, then by keys, the last first; start and size of each group."""
    order = np.lexsort((*first_by, group))
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    return order, starts, np.diff(np.append(starts, len(group)))


MARGIN = 0.02  # share of the fitted range by which values may exceed it; a choice
LEAST_MARGIN = {"K": 1.0, "rad": 0.01, "m": 0.01}
"""The least by which values may exceed it, by unit. A metre of aluminium grows by 23 µm per kelvin.
A correction moves a joint by some mrad or mm, also one that stood still while measuring. Choices.
"""
FULL_TURN = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class Range:
    """Values of one variable in the fitted readings; SI."""

    variable: str
    unit: str
    low: float
    high: float

    def over(self, values: Floats, *, turning: bool = False) -> Floats:
        """Return by how much values (N,) are outside; zero or less inside."""
        if not turning:
            return np.asarray(np.maximum(values - self.high, self.low - values))
        above = np.mod(values - self.low, FULL_TURN)
        return np.asarray(np.minimum(above - (self.high - self.low), FULL_TURN - above))

    def beyond(self, values: Floats, *, turning: bool = False) -> Bools:
        """Which values are outside, by more than `MARGIN` of the range; arguments as of `over`.

        By more than `LEAST_MARGIN`, if that is larger.
        """
        rounding = 1e-9 * max(abs(self.low), abs(self.high), 1.0)
        least = LEAST_MARGIN.get(self.unit, rounding)
        allowed = max(MARGIN * (self.high - self.low), least)
        return np.asarray(self.over(values, turning=turning) > allowed)


def angle_name(joint: int) -> str:
    """Return the variable of a joint's angle; joints count from 0."""
    return f"joint {joint + 1} angle"


def travel_name(joint: int) -> str:
    """Return the variable of the travel of a joint that slides; joints count from 0."""
    return f"joint {joint + 1} travel"


def turning_variables(turns: Bools) -> frozenset[str]:
    """Return the angle variables of the joints (n,) that are periodic in whole turns."""
    return frozenset(angle_name(j) for j in np.flatnonzero(turns).tolist())


def variables(s: States, units: Sequence[str]) -> Iterator[tuple[str, str, Floats]]:
    """Yield name, unit and values (N,) of the variables in which a prediction may extrapolate."""
    for j, unit in enumerate(units):
        yield (travel_name if unit == "m" else angle_name)(j), unit, s.q[:, j]
    for name, unit, part in (("force", "N", slice(0, 3)), ("moment", "N·m", slice(3, 6))):
        yield name, unit, np.linalg.norm(s.wrench[:, part], axis=1)
    if s.air_temperature is not None:
        yield "air temperature", "K", s.air_temperature
    if s.joint_temperature is not None:
        for j in range(s.joint_temperature.shape[1]):
            yield f"joint {j + 1} temperature", "K", s.joint_temperature[:, j]


def ranges_of(s: States, units: Sequence[str]) -> tuple[Range, ...]:
    """Return the ranges of `variables`."""
    return tuple(
        Range(name, unit, float(v.min()), float(v.max())) for name, unit, v in variables(s, units)
    )
