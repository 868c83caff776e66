"""What a laser station is: its state, its optics, and the target that it holds."""

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from hilcal.drivers.simulated.admin import setter
from hilcal.drivers.simulated.blackboard import Blackboard, settled_truth
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class PolarPoint:
    """A direction and a slope distance: x = d sinV sinHz, y = d sinV cosHz, z = d cosV."""

    hz: float  # horizontal angle, 0 to 2 pi, rad
    v: float  # zenith angle, 0 to pi, rad
    distance: float  # m

    @staticmethod
    def of(point: Floats) -> "PolarPoint":
        """Return the polar coordinates of a point (3,), m."""
        x, y, z = map(float, point)
        level = float(np.hypot(x, y))
        hz, v = np.arctan2(x, y) % (2 * np.pi), np.arctan2(level, z)
        return PolarPoint(float(hz), float(v), float(np.hypot(level, z)))

    def angle_to(self, other: "PolarPoint") -> float:
        """Return the angle between two directions, rad."""
        return float(np.arccos(np.clip(self.direction() @ other.direction(), -1.0, 1.0)))

    def direction(self) -> Floats:
        """Return the unit vector (3,)."""
        level = np.sin(self.v)
        return np.array([level * np.sin(self.hz), level * np.cos(self.hz), np.cos(self.v)])


@dataclass(frozen=True, slots=True)
class Beam:
    """Noise of one measurement at the distance d.

    sigma_range = a + b d,   sigma_transverse = c + e d in each direction across the beam,
    sigma_v = sigma_transverse / d,   sigma_hz = sigma_transverse / (d sin v)
    """

    range_std: tuple[float, float]  # (a, b) in m and m/m
    transverse_std: tuple[float, float]  # (c, e) in m and m/m

    def angle_std(self, distance: float) -> float:
        """Return sigma_transverse / d, rad."""
        return self.transverse_std[0] / distance + self.transverse_std[1]

    def observe(self, true: PolarPoint, rng: np.random.Generator) -> PolarPoint:
        """Return one measurement of a target; every call draws anew."""
        across = self.angle_std(true.distance)
        draw = rng.standard_normal(3)
        # straight above the station the horizontal angle is arbitrary
        hz = true.hz + draw[0] * min(across / max(np.sin(true.v), 1e-12), np.pi)
        v = true.v + draw[1] * across
        if not 0.0 <= v <= np.pi:  # over the zenith or the nadir
            hz, v = hz + np.pi, (-v if v < 0.0 else 2 * np.pi - v)
        along = self.range_std[0] + self.range_std[1] * true.distance
        return PolarPoint(float(hz % (2 * np.pi)), float(v), float(true.distance + draw[2] * along))


WARNINGS = (0, 1283, 1284)
BEHIND_M = 0.2
"""Two reflectors are at two places."""
AIM_S = 0.3
"""World time of a search, a fine adjustment, a lock-in or a turn, s."""
FIELD_OF_VIEW = 0.026
"""Half angle in which the camera sees its target, rad (1.5°)."""
LEVEL_STD = 1e-6
"""Noise of the inclinations, rad."""


@dataclass(slots=True, eq=False)
class Station:
    """A tracking station: it holds its target through jumps as long as the beam is free."""

    board: Blackboard
    beam: Beam
    rng: np.random.Generator
    meas_s: float = 0.3  # world time of one distance measurement, s
    locked: bool = True  # whether the target is held; no lock, no distance
    broken: bool = False  # whether something stands in the beam
    dist_error: bool = False  # whether distance measurements fail (1292)
    warning: int = 0  # code given instead of 0 with a good measurement, 0 is none
    busy: bool = False  # whether measurements are refused (1293)
    delays: dict[int, tuple[float, int]] = field(default_factory=dict)
    """By procedure, s of real time and how many answers are late."""
    wrong_transactions: int = 0  # so many next answers carry a wrong transaction number
    lock_enabled: bool = True  # what 9020 has set
    atr_enabled: bool = True  # what 9018 has set
    digits: int = 15  # decimals of floating-point numbers
    atmosphere: tuple[float, ...] = (658e-9, 1013.25, 20.0, 20.0)
    """Wavelength m, pressure mbar, dry and wet temperature °C."""
    settings: dict[int, str] = field(
        default_factory=lambda: {2020: "2", 17019: "0", 17021: "0", 17008: "0"}
    )
    """Values of plain settings by the procedure that sets them."""
    pointing: PolarPoint = field(default_factory=lambda: PolarPoint(0.0, np.pi / 2, 0.0))
    """Where the telescope looks."""
    distance: float = 0.0  # the last distance, m; 0 is none
    distance_ms: int = 0  # station time of it, ms
    ranging: float | None = None
    """Until when a distance measurement runs, `time.monotonic`; None is not."""
    tracking: bool = False  # whether the distance meter goes on by itself
    requests: deque[tuple[int, tuple[str, ...]]] = field(
        default_factory=lambda: deque(maxlen=10_000)
    )
    measured: int = 0
    number: int = 0  # of the target that is held, or was last
    hidden: set[int] = field(default_factory=set)  # numbers of targets that cannot be seen
    several: bool = False
    seen: PolarPoint | None = None
    stuck: PolarPoint | None = None
    """What is measured to the last digit whatever the target does; None is the target."""
    stray: PolarPoint | None = None
    """A reflector at rest that is followed instead; None is the target."""

    def faults(self) -> dict[str, Callable[..., None]]:
        """Return what can go wrong between instrument and target, by name."""
        return {
            "beam": setter(self, "broken"),
            "hide": self.hide,
            "lock_lost": lambda: setattr(self, "locked", False),
            "freeze": lambda on: setattr(self, "stuck", self.seen if on else None),
            "stray": self.follow_stray,
        }

    def hide(self, targets: Iterable[int]) -> None:
        """Cover these targets by number, and no others."""
        self.hidden = {int(k) for k in targets}
        self.locked = self.locked and self.number not in self.hidden

    def follow_stray(self, on: bool) -> None:
        """Follow a reflector at rest behind where the target is now, or the target again."""
        seen = self.target() if on else None
        self.stray = seen and replace(seen, distance=seen.distance + BEHIND_M)

    def warn(self, code: int) -> None:
        """Give a warning with every good measurement, or none (0)."""
        if code not in WARNINGS:
            raise ValueError(f"code = {code}; valid: {WARNINGS}")
        self.warning = code

    def targets(self) -> dict[int, PolarPoint]:
        """Return where the targets that can be seen truly are at this moment, by number."""
        if self.broken:
            return {}
        truth = settled_truth(self.board)
        points = truth["targets"]
        given = np.isfinite(points).all(axis=1) & points.any(axis=1)
        self.several = bool(given.any())
        if not self.several:
            points = truth["target"][None]
            given = np.isfinite(points).all(axis=1) & points.any(axis=1)  # the world has begun
        seen = (k for k in np.flatnonzero(given).tolist() if k not in self.hidden)
        return {k: PolarPoint.of(points[k]) for k in seen}

    def target(self) -> PolarPoint | None:
        """Return where its target truly is at this moment; None where it cannot be seen."""
        return self.stray or self.targets().get(self.number)

    def held(self) -> PolarPoint | None:
        """Return where the held target truly is; None without lock or sight."""
        return self.target() if self.locked else None

    def look(self) -> PolarPoint | None:
        """Measure the held target once and turn the telescope to it; None without one."""
        true = self.held()
        if true is None:
            return None
        seen = self.stuck or self.beam.observe(true, self.rng)
        self.pointing = self.seen = seen
        self.measured += 1
        return seen

    def wait(self, world_seconds: float) -> None:
        """Take so much world time."""
        time.sleep(max(0.0, world_seconds) / self.board.scale)

    def acquire(self, window: float = np.inf) -> bool:
        """Search and hold the target that is closest to where it looks: whether there is any.

        Of several targets only those within `window` of that direction count, rad.
        """
        self.wait(AIM_S)
        seen = self.targets()
        if self.several:
            seen = {k: at for k, at in seen.items() if at.angle_to(self.pointing) <= window}
        if seen:
            self.number = min(seen, key=lambda k: seen[k].angle_to(self.pointing))
        self.locked = bool(seen)
        self.look()
        return self.locked

    def start_ranging(self) -> None:
        """Start a distance measurement; it takes `meas_s` of world time."""
        self.distance, self.distance_ms = 0.0, 0
        self.ranging = time.monotonic() + self.meas_s / self.board.scale

    def finish_ranging(self, patience: float) -> None:
        """Wait for a running distance measurement, at most `patience` s of world time."""
        if self.ranging is not None:
            left = self.ranging - time.monotonic()
            time.sleep(max(0.0, min(left, patience / self.board.scale)))
            self.tick()

    def tick(self) -> None:
        """Take the distance if its time has come: where the target is at that moment."""
        if self.ranging is None or time.monotonic() < self.ranging:
            return
        self.ranging = None
        seen = self.look()
        if seen is not None and not self.dist_error:
            self.distance, self.distance_ms = seen.distance, int(self.board.time * 1e3)

    def turn(self, hz: float, v: float) -> None:
        """Point elsewhere; the lock ends unless the target is in the field of view there."""
        self.pointing = PolarPoint(hz % (2 * np.pi), v, 0.0)
        true = self.target()
        if true is None or true.angle_to(self.pointing) > FIELD_OF_VIEW:
            self.locked = False

    def inclination(self) -> tuple[float, float, float]:
        """Return cross and lengthwise inclination and their accuracy, rad: it stands level."""
        cross, length = self.rng.normal(0.0, LEVEL_STD, 2)
        return float(cross), float(length), LEVEL_STD

    def temperature(self) -> float:
        """Return the temperature inside, °C: some kelvins above the air's."""
        air = float(self.board.read("truth")["air_temperature"])
        return (air if air != 0.0 else 20.0) + 6.0
