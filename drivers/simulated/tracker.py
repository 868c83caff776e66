"""A laser tracker's noise: azimuth, elevation and range, and the turning of the target."""

from dataclasses import dataclass

import numpy as np

from drivers.simulated.rigid import turned
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class SimulatedNoise:
    """Standard deviations of one reading at distance d from the station.

        sigma_range = a + b d,   sigma_transverse = c + e d

    The defaults are half of a maximum permissible error of ±15 µm + 6 µm/m across the line
    of sight, a range that is steadier than the angles, and half of ±0.01° for the target's
    orientation: the usual class of laser trackers with a six-degrees-of-freedom probe.

    Attributes:
        range_std: (a, b) in m and m/m.
        transverse_std: (c, e) in m and m/m, each of the two directions across the sight.
        orientation_std: rad, about each axis of the tracker.
    """

    range_std: tuple[float, float] = (5e-6, 0.5e-6)
    transverse_std: tuple[float, float] = (7.5e-6, 3e-6)
    orientation_std: float = 8.7e-5

    def covariance(self, position: Floats, m: int) -> Floats:
        """Return the (N, m, m) covariance at (N, 3) positions in station axes, m.

        Cov = sigma_t² I + (sigma_r² - sigma_t²) e eᵀ with e along the line of sight; the same
        as J diag(sigma_az², sigma_el², sigma_r²) Jᵀ with sigma_az = sigma_t / (d cos el).
        """
        along, across, sight = self._spread(position)
        out = np.zeros((len(position), m, m))
        out[:, :3, :3] = across[:, None, None] ** 2 * np.eye(3) + (
            (along**2 - across**2)[:, None, None] * sight[:, :, None] * sight[:, None, :]
        )
        if m == 6:
            out[:, 3:, 3:] = self.orientation_std**2 * np.eye(3)
        return out

    def observe(self, position: Floats, rng: np.random.Generator) -> Floats:
        """Return (N, 3) positions as read: noise on azimuth, elevation and range.

        The three are drawn in spherical coordinates, so a reading leaves the sphere's
        tangent plane as a real one does. Both angles are great-circle angles about the line
        of sight; near the zenith, where azimuth alone means nothing, the law still holds.
        """
        along, across, sight = self._spread(position)
        distance = np.linalg.norm(position, axis=1)
        left, up = _across(sight)
        draw = rng.standard_normal((3, len(position)))
        # turn about `up` moves the sight to the left (azimuth), about -left moves it upwards
        azimuth = up * (draw[0] * across / distance)[:, None]
        elevation = -left * (draw[1] * across / distance)[:, None]
        seen = turned(azimuth + elevation) @ sight[:, :, None]
        return np.asarray(seen[:, :, 0] * (distance + draw[2] * along)[:, None])

    def observe_turn(self, count: int, rng: np.random.Generator) -> Floats:
        """Return (count, 3) small rotations about the tracker's axes, rad."""
        return self.orientation_std * rng.standard_normal((count, 3))

    def _spread(self, position: Floats) -> tuple[Floats, Floats, Floats]:
        """Return sigma_range (N,), sigma_transverse (N,) and the line of sight (N, 3)."""
        distance = np.linalg.norm(position, axis=1)
        along = self.range_std[0] + self.range_std[1] * distance
        across = self.transverse_std[0] + self.transverse_std[1] * distance
        return along, across, position / distance[:, None]


def _across(sight: Floats) -> tuple[Floats, Floats]:
    """Return two unit vectors (N, 3) across the line of sight: to the left, and up."""
    steep = np.abs(sight[:, 2]) > 0.999
    zenith = np.where(steep[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    left = np.cross(zenith, sight)
    left /= np.linalg.norm(left, axis=1)[:, None]
    return left, np.cross(sight, left)
