"""States of the arm, and readings of the tracker in them."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np

from hilcal.errors import InputError
from hilcal.readings.arm_scatter import ArmScatter
from hilcal.readings.serial_noise import SerialNoise
from hilcal.shown import Brief, Tabular
from hilcal.types import Bools, Floats, Ints

ObserverKind = Literal["station", "point", "gauge"]
SAME_POSE = 1e-6  # Commanded joints of one pose agree to this, rad


@dataclass(frozen=True, slots=True, eq=False)
class States(Brief):
    """N states of the arm: everything that a prediction may depend on.

    Attributes:
        q: (N, n) commanded joint angles, rad.
        wrench: (N, 6) force and moment that the load exerts on the tool at the load point,
            base axes, N and N·m; zero where unloaded.
        time: (N,) time since the campaign's start, s; None when unknown.
        load_time: (N,) time under the present load, s.
        air_temperature: (N,) °C.
        joint_temperature: (N, n) °C.
        approach: (N, n) side from which each joint arrived, -1 or +1.
        q_actual: (N, n) joint angles that the encoders reported, rad.
        torque: (N, n) static torques that the drives were measured to exert, N·m: those of load
            and weight about the drives' axes (`Situation.torque`) with the other sign; NaN in
            readings that lack them.
        target: (N,) number of the target that is read, in the order of `Cell.target_names`; None
            where the tool carries one target.
        observer: (N,) number of what observes, in the order of `Readings.observers`; None where one
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
        """Return the number of states N."""
        return len(self.q)

    def __getitem__(self, rows: Ints | Bools | slice) -> "States":
        """Return the chosen states."""
        given = {f.name: a for f in fields(self) if (a := getattr(self, f.name)) is not None}
        return replace(self, **{name: a[rows] for name, a in given.items()})

    @staticmethod
    def joined(parts: Sequence["States"]) -> "States":
        """Put states with the same columns one after the other."""
        given = [f.name for f in fields(parts[0]) if getattr(parts[0], f.name) is not None]
        columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in given}
        return replace(parts[0], **columns)


@dataclass(frozen=True, slots=True)
class ObserverName:
    """What observes the target."""

    kind: ObserverKind  # of positions or poses, of distances, or of heights over a plane
    name: str

    def __str__(self) -> str:
        """Return both."""
        return f"{self.kind} {self.name}"


@dataclass(frozen=True, slots=True, eq=False)
class Readings(Tabular):
    """N readings of the target's position (m = 3) or pose (m = 6), one per state.

    A distance or a height is one number: the first element of a reading of m = 3, whose others are
    0 and have no variance, so that whitening leaves them out (`whitening.inverse_root`).

    Attributes:
        pose: (N,) index of the commanded pose; equal numbers mean the same pose.
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
            where False, `hilcal.diagnose` may find what is left to be that scatter.
        noise_stated: whether somebody states the noise; where False, it was estimated from these
            readings, so that χ² says nothing of what is missing.
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

    def __len__(self) -> int:
        """Return the number of readings N."""
        return len(self.pose)

    def __getitem__(self, rows: Ints | Bools | slice) -> "Readings":
        """Return the chosen readings; names are kept."""
        return replace(
            self, states=self.states[rows], pose=self.pose[rows], load=self.load[rows],
            cycle=self.cycle[rows], value=self.value[rows], covariance=self.covariance[rows],
            common=None if self.common is None else self.common[rows],
            stated=None if self.stated is None else self.stated[rows],
            along=None if self.along is None else self.along[rows],
        )  # fmt: skip

    @staticmethod
    def joined(parts: Sequence["Readings"]) -> "Readings":
        """Put readings with the same names and columns one after the other."""
        if len(parts) == 1:
            return parts[0]
        return replace(
            parts[0],
            states=States.joined([p.states for p in parts]),
            pose=np.concatenate([p.pose for p in parts]),
            load=np.concatenate([p.load for p in parts]),
            cycle=np.concatenate([p.cycle for p in parts]),
            value=np.concatenate([p.value for p in parts]),
            covariance=np.concatenate([p.covariance for p in parts]),
            common=None,
            serial=None,
            along=None,
        )

    def as_stated(self) -> "Readings":
        """Return the readings without an estimated scatter of the arm."""
        if self.stated is None:
            return self
        return replace(self, covariance=self.stated, common=None, stated=None, arm_scatter=None)

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
        given = self.states.target
        return np.zeros(len(self), dtype=np.int64) if given is None else given

    @property
    def observer(self) -> Ints:
        """(N,) number of what observes; 0 where one tracker reads all."""
        given = self.states.observer
        return np.zeros(len(self), dtype=np.int64) if given is None else given

    def seen_by(self, observers: Sequence[ObserverName]) -> "Readings":
        """Return the readings with observers numbered as those of others; as they are without any.

        Raises:
            InputError: one that is not among these.
        """
        if self.states.observer is None or self.observers == tuple(observers):
            return self
        for name in self.observers:
            if name not in observers:
                known = ", ".join(map(str, observers)) or "one tracker"
                raise InputError(
                    f"{name} observed these readings, but not those that were fitted: {known}"
                )
        number = np.array([list(observers).index(name) for name in self.observers])
        states = replace(self.states, observer=number[self.observer])
        return replace(self, states=states, observers=tuple(observers))

    @property
    def scalar(self) -> Bools:
        """(N,) which readings are one number: a distance or a height."""
        one = [k for k, o in enumerate(self.observers) if o.kind != "station"]
        return np.isin(self.observer, one) & (len(one) > 0)

    @property
    def line(self) -> Ints:
        """(N,) number of the pair of target and observer, of which deflections are taken."""
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
        keys = np.stack([self.pose, self.load, self.cycle, self.line], axis=1)
        _, of = np.unique(keys, axis=0, return_inverse=True)
        of = of.reshape(-1)
        order = np.argsort(of, kind="stable")
        first = np.flatnonzero(np.diff(of[order], prepend=-1))
        visit = np.empty(len(self), dtype=np.int64)
        visit[order] = np.arange(len(self)) - np.repeat(first, np.diff(np.append(first, len(self))))
        keys[:, 3] = visit
        return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
