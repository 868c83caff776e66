"""What a tracker's specification says about the covariance of one reading."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from hilcal.errors import InputError
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class TrackerNoise:
    """Standard deviations of a spherical instrument at distance d: a + b d.

    Attributes:
        range_std: along the beam at zero distance, m.
        range_std_per_m: its growth with distance, m/m.
        transverse_std: across the beam at zero distance, m.
        transverse_std_per_m: its growth with distance (an angle), m/m.
        orientation_std: of a small rotation about any axis, rad; 0 where only positions are read.
    """

    range_std: float
    range_std_per_m: float
    transverse_std: float
    transverse_std_per_m: float
    orientation_std: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what no instrument can have.

        Raises:
            InputError: a figure is negative or not finite, or a position has no noise at all.
        """
        for f in fields(self):
            value = getattr(self, f.name)
            if not np.isfinite(value) or value < 0:
                raise InputError(f"tracker noise {f.name} = {value}: must be a number >= 0")
        if self.range_std + self.range_std_per_m == 0:
            raise InputError("tracker noise: range_std and range_std_per_m are both 0")
        if self.transverse_std + self.transverse_std_per_m == 0:
            raise InputError("tracker noise: transverse_std and transverse_std_per_m are both 0")


def tracker_covariance(
    position: Floats, noise: TrackerNoise, station: Floats | Sequence[float] = (0.0, 0.0, 0.0)
) -> Floats:
    """Covariance of measured positions: an ellipsoid that turns with the line of sight.

    With d the distance from the station and u the beam's direction,

        Cov = J diag(σ_az², σ_el², (a + b d)²) Jᵀ = (c + e d)² (I - u uᵀ) + (a + b d)² u uᵀ

    where the angles' errors are equal across the beam: d σ_el = d cos(el) σ_az = c + e d.

    Args:
        position: (N, 3) positions in the frame of `station`, m.
        noise: the instrument's figures.
        station: (3,) where the beam starts, m.

    Returns:
        (N, 3, 3) covariances, m², exactly symmetric.

    Raises:
        InputError: a position lies at the station, where the beam has no direction.
    """
    beam = np.asarray(position, dtype=float) - np.asarray(station, dtype=float)
    distance = np.linalg.norm(beam, axis=1)
    if np.any(distance == 0):
        k = int(np.argmin(distance))
        raise InputError(f"reading {k + 1} lies at the tracker's station: no line of sight")
    u = beam / distance[:, None]
    along = (noise.range_std + noise.range_std_per_m * distance) ** 2
    across = (noise.transverse_std + noise.transverse_std_per_m * distance) ** 2
    cov: Floats = (along - across)[:, None, None] * (u[:, :, None] * u[:, None, :])
    cov += across[:, None, None] * np.eye(3)
    return cov


def tracker_pose_covariance(
    position: Floats, noise: TrackerNoise, station: Floats | Sequence[float] = (0.0, 0.0, 0.0)
) -> Floats:
    """Covariance of measured poses: that of the position, and σ_o² I for the rotation.

    Args:
        position: (N, 3) positions in the frame of `station`, m.
        noise: the instrument's figures.
        station: (3,) where the beam starts, m.

    Returns:
        (N, 6, 6) covariances, m² and rad²; position and rotation independent.

    Raises:
        InputError: `orientation_std` is 0, or a position lies at the station.
    """
    if noise.orientation_std == 0:
        raise InputError("tracker noise: orientation_std is 0, but orientations were read")
    cov = np.zeros((len(position), 6, 6))
    cov[:, :3, :3] = tracker_covariance(position, noise, station)
    cov[:, 3:, 3:] = noise.orientation_std**2 * np.eye(3)
    return cov
