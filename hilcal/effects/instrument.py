"""Errors of the instrument and of frames: registration, targets, observers, drift, scale."""

from dataclasses import replace
from typing import ClassVar

import numpy as np

from hilcal.effects.options import PRIOR_HELP, Options, number, positive
from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats


class BaseFrame(Effect):
    """Twist of the base relative to its registration, base axes [m, rad]."""

    name = "base_frame"
    summary = "registration of the tracker to the arm's base is off"
    plausible = 20.0  # 20 mm, 20 mrad: a base that was surveyed by hand. A choice.
    of_setup = True
    option_help: ClassVar = PRIOR_HELP
    role = "registration"

    parameters = (
        *(Parameter(a, "m", 1e-3, f"base shift along {a}") for a in "xyz"),
        *(Parameter(f"r{a}", "rad", 1e-3, f"base turn about {a}") for a in "xyz"),
    )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit twists of the base."""
        index = np.arange(6)
        return (Columns("base", index, 0 * index, np.eye(6)[None]),)


class TargetOffset(Effect):
    """Displacement of the target in flange axes [m]; with `rotation`, its rotation too [rad].

    Of several targets, each one of unknown offset has its own displacement; where all offsets are
    known, each target has.
    """

    name = "target_offset"
    summary = "the tracked target sits elsewhere on the flange than configured"
    change = Changeable("setup", "target", "the target's place on the tool")
    plausible = 10.0  # 10 mm, 10 mrad: a target that was mounted anew. A choice.
    of_setup = True
    option_help: ClassVar = {
        "rotation": "True where the readings are poses, so that the target's axes matter.",
        **PRIOR_HELP,
    }
    role = "target"

    def setup(self, states: States) -> None:
        """Read whether rotations are estimated."""
        rotation = self.options.get("rotation", False)
        if not isinstance(rotation, bool):
            raise InputError(f"effect {self.name}: rotation = {rotation!r}; valid: true, false")
        self.size = 6 if rotation else 3
        known = self.cell.known_targets
        self.moved = [k for k in range(len(known)) if all(known) or not known[k]]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Displacement along, and with `rotation` rotation about, the flange's axes."""
        lengths = [Parameter(a, "m", 1e-3, f"offset along flange {a}") for a in "xyz"]
        turns = [Parameter(f"r{a}", "rad", 1e-3, f"turn about flange {a}") for a in "xyz"]
        axes = (lengths + turns)[: self.size]
        if self.cell.targets is None:
            return tuple(axes)
        names = [self.cell.target_names[k] for k in self.moved]
        return tuple(
            replace(p, name=f"{name}.{p.name}", meaning=f"{name}: {p.meaning}")
            for name in names
            for p in axes
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit displacements of each target, in the readings of it."""
        index = np.arange(self.size * len(self.moved))
        unit = np.eye(6)[None, : self.size]
        if self.cell.targets is None:
            return (Columns("target", index, 0 * index, unit),)
        number = s.states.target
        read = np.zeros(len(s.angle), dtype=np.int64) if number is None else number
        parts = [(read == k)[:, None, None] * unit for k in self.moved]
        return (Columns("target", index, 0 * index, np.concatenate(parts, axis=1)),)

    def displaced(self, theta: Floats) -> Floats:
        """T_flange_target (T, 4, 4) with displacements theta (P,); turns are not applied."""
        poses = self.cell.all_targets.copy()
        poses[self.moved, :3, 3] += theta.reshape(len(self.moved), self.size)[:, :3]
        return poses

    @classmethod
    def usual_options(cls, m: int) -> Options:
        """Return `rotation` where readings are poses."""
        return {"rotation": True} if m == 6 else {}


_AXES = ("x", "y", "z", "rx", "ry", "rz")


class ObserverFrame(Effect):
    """Twist of the position in the axes of an observer [m, rad], and offset of a distance [m].

    Estimated are the unknown elements of each observer's place; where all places are known, all
    elements that the readings determine. The shift of a point is that of the point itself.
    """

    name = "observer_frame"
    summary = "one of several stations, points or gauges stands elsewhere than described"
    plausible = 20.0  # 20 mm, 20 mrad, as of `base_frame`. A choice.
    of_setup = True
    option_help: ClassVar = PRIOR_HELP
    role = "observer"

    def setup(self, states: States) -> None:
        """Choose the elements that are estimated."""
        observable = {"station": range(6), "point": range(3), "gauge": (0, 4, 5)}
        unknown = any(o.free for o in self.cell.observers)
        self.free = [
            (k, element)
            for k, o in enumerate(self.cell.observers)
            for element in (o.free if unknown else observable[o.name.kind])
        ]

    @classmethod
    def computable(cls, states: States) -> bool:
        """Whether readings name their observers; a prediction without observers needs no effect."""
        return states.observer is not None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Shift, turn and offset, as far as they are unknown."""
        out = []
        for k, element in self.free:
            o, axis = self.cell.observers[k].name, _AXES[element]
            unit = "m" if element < 3 else "rad"
            meaning = f"turn about {axis[-1]}" if element > 2 else f"shift along {axis}"
            if o.kind == "point" and element == 3:
                axis, unit, meaning = "offset", "m", "offset of the distance"
            out.append(Parameter(f"{o.name}.{axis}", unit, 1e-3, f"{o}: {meaning}"))
        return tuple(out)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit twists of each observer, in its readings."""
        index = np.arange(len(self.free))
        values = np.zeros((len(s.angle), len(index), 6))
        if s.states.observer is not None:
            for p, (k, element) in enumerate(self.free):
                away = self.cell.observers[k].name.kind == "point" and element < 3
                values[s.states.observer == k, p, element] = -1.0 if away else 1.0
        return (Columns("observer", index, 0 * index, values),)


class TrackerDrift(Effect):
    """Station twist that grows linearly with time, sensor axes [m/s, rad/s]."""

    name = "tracker_drift"
    summary = "the tracker's station moves linearly in time"
    plausible = 20.0  # 4 mm, 4 mrad over the campaign: a tripod on a soft floor. A choice.
    of_setup = True
    needs = ("time",)
    option_help: ClassVar = {
        "reference_s": "the time at which the station stands as registered; unless given, the "
        "time of the first reading.",
        "span_s": "the time over which a drift of ordinary size is reached; unless given, that of "
        "the readings.",
    }

    def setup(self, states: States) -> None:
        """Take the time of the first reading as the reference unless given."""
        assert states.time is not None  # noqa: S101 - checked at construction
        self.options.setdefault("reference_s", float(states.time.min()))
        self.options.setdefault("span_s", max(float(np.ptp(states.time)), 1.0))
        self.reference = number(self.name, self.options, "reference_s")
        self.span = positive(self.name, self.options, "span_s")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Rates of displacement and rotation; 0.2 mm and 0.2 mrad over the campaign."""
        return tuple(Parameter(a, "m/s", 2e-4 / self.span) for a in "xyz") + tuple(
            Parameter(f"r{a}", "rad/s", 2e-4 / self.span) for a in "xyz"
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit twists times the time since the reference."""
        assert s.states.time is not None  # noqa: S101 - checked at construction
        elapsed: Floats = s.states.time - self.reference
        index = np.arange(6)
        return (Columns("station", index, 0 * index, elapsed[:, None, None] * np.eye(6)),)


class TrackerScale(Effect):
    """Position read = (1 + s) position, about the sensor's origin: refraction, units [1].

    In deflections alone it is the same as a common factor on all compliances.
    """

    name = "tracker_scale"
    summary = "position read = (1 + s) position: the tracker's ranges have a scale error"
    change = Changeable("setup", "tracker's scale", "the tracker's scale")
    plausible = 100.0  # 1 mm/m: photogrammetry without a bar; refraction makes 0.05. A choice.
    of_setup = True

    # 10 µm/m is ordinary: 10 °C misjudged in the air.
    parameters = (Parameter("scale", "1", 1e-5, "relative error of the tracker's ranges"),)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit scale."""
        only = np.zeros(1, dtype=np.int64)
        return (Columns("scale", only, only, np.ones((1, 1))),)
