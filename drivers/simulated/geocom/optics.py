"""What the station's angles and distance measure: the target in its own axes, with noise."""

from dataclasses import dataclass

import numpy as np

from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class PolarPoint:
    """A direction and a slope distance: x = d sinV sinHz, y = d sinV cosHz, z = d cosV.

    Attributes:
        hz: horizontal angle, 0 to 2 pi, rad.
        v: zenith angle, 0 to pi, rad.
        distance: m.
    """

    hz: float
    v: float
    distance: float

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

    Attributes:
        range_std: (a, b) in m and m/m.
        transverse_std: (c, e) in m and m/m.
    """

    range_std: tuple[float, float]
    transverse_std: tuple[float, float]

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
