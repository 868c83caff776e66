"""The covariance of readings: the one place where its terms are made and added.

    V = s Σ̄ + R / K + R_sensor_base J Σ_q Jᵀ R_sensor_baseᵀ

with Σ the instrument's covariance of one sample (`tracker_covariance`), s its systematic share and
R the random covariance of the K samples of a reading (`covariance_of_mean`); Σ_q = diag(σ_q²) the
scatter of the joints from one arrival to the next, J the Jacobian of the target (`joint_scatter`).

The third term needs the registration; it is added when the readings are opened
(`identification.noise.full_covariance`), with σ_q from [repeatability]. The file states what the
stored covariances cover (`COVERS_KEY`):

- a measured campaign stores the first two terms: `INSTRUMENT`, the third is added;
- an imported campaign stores what its table states, or `tracker_covariance` where the table states
  none. Both are taken as the instrument's: `INSTRUMENT`, the third is added. Where the table's
  covariances include the arm's scatter, its column `covers` says so ("instrument+arm", which
  `hilcal export` writes), or the cell does ([repeatability] in_tables = true):
  `INSTRUMENT_AND_ARM`, and nothing is added;
- to a campaign whose file does not state it, of an older version, nothing is added.

Two readings share the scatter of an arrival, and noise that is correlated along their order; two
deflections share the error of their unloaded readings (`measurement_covariance`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from hilcal.config import Tracker
from hilcal.errors import InputError
from hilcal.readings.readings import Readings
from hilcal.robot.arm import Arm
from hilcal.robot.chain import drive_jacobian, evaluate
from hilcal.types import Bools, Floats, Ints

COVERS_KEY = "covariance"  # Key among the texts about a campaign: what the stored covariances cover
FROM_KEY = "covariance from"  # key of `TRACKER` where they were made from [tracker]
TRACKER = "tracker"
INSTRUMENT = "instrument"  # They cover the instrument alone, not the arm's repeatability
INSTRUMENT_AND_ARM = "instrument+arm"  # They include the arm's repeatability
ROUNDING = "+rounding"  # end of either word in a table, where rounding is included
PRIOR_REPEATS = 20.0  # ν0, the repeats that the stated covariance is worth; a guess


@dataclass(frozen=True, slots=True)
class TrackerNoise:
    """A specification: standard deviations a + b d of a spherical instrument at distance d."""

    range_std: float  # along the beam at zero distance, m
    range_std_per_m: float  # its growth with distance, m/m
    transverse_std: float  # across the beam at zero distance, m
    transverse_std_per_m: float  # its growth with distance (an angle), m/m
    orientation_std: float = 0.0  # of a small rotation about any axis, rad; 0 if not read

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not np.isfinite(value) or value < 0:
                raise InputError(f"tracker noise {f.name} = {value}: must be a number >= 0")
        for name in ("range_std", "transverse_std"):
            if getattr(self, name) + getattr(self, f"{name}_per_m") == 0:
                raise InputError(f"tracker noise: {name} and {name}_per_m are both 0")


def tracker_noise(section: Tracker) -> TrackerNoise:
    """Return the specification that the section [tracker] of a configuration states."""
    return TrackerNoise(
        section.range_std_m,
        section.range_std_per_m,
        section.transverse_std_m,
        section.transverse_std_per_m,
        section.orientation_std_rad,
    )


def tracker_covariance(
    position: Floats,  # (N, 3) positions in the frame of `station`, m
    noise: TrackerNoise,
    station: Floats | Sequence[float] | None = None,  # (3,) where the beam starts, m; else 0
    m: int = 3,  # 3 for positions, 6 for poses
) -> Floats:
    """Instrument covariance (N, m, m) of one sample: an ellipsoid that turns with the beam.

    With d the distance from the station and u the beam's direction,

        Cov = J diag(σ_az², σ_el², (a + b d)²) Jᵀ = (c + e d)² (I - u uᵀ) + (a + b d)² u uᵀ

    where the angles' errors are equal across the beam: d σ_el = d cos(el) σ_az = c + e d. The
    rotation of a pose (m = 6) has the covariance σ_o² I.
    """
    beam = np.asarray(position, dtype=float)
    beam = beam if station is None else beam - np.asarray(station, dtype=float)
    distance = np.linalg.norm(beam, axis=1)
    if np.any(distance == 0):
        k = int(np.argmin(distance))
        raise InputError(f"reading {k + 1} lies at the tracker's station: no line of sight")
    u = beam / distance[:, None]
    along = (noise.range_std + noise.range_std_per_m * distance) ** 2
    across = (noise.transverse_std + noise.transverse_std_per_m * distance) ** 2
    if m == 6 and noise.orientation_std == 0:
        raise InputError("tracker noise: orientation_std is 0, but orientations were read")
    cov = np.zeros((len(u), m, m))
    cov[:, :3, :3] = (along - across)[:, None, None] * (u[:, :, None] * u[:, None, :])
    cov[:, :3, :3] += across[:, None, None] * np.eye(3)
    cov[:, 3:, 3:] = noise.orientation_std**2 * np.eye(m - 3)
    return cov


def covariance_of_mean(
    stated: Floats, deviations: Floats, systematic_share: float = 0.0, factor: float = 1.0
) -> Floats:
    """Covariance (m, m) of the mean of K samples of one target at rest, r_k from their mean (K, m).

        R = (ν0 (1 - s) τ Σ̄ + Σ_k r_k r_kᵀ) / (ν0 + K - 1)        Cov = s Σ̄ + R / K

    The share s of Σ̄ is the same in all samples: averaging does not reduce it. R is the posterior
    mean of the random covariance with the stated one, times τ, as an inverse Wishart prior worth ν0
    = `PRIOR_REPEATS` repeats (Gelman et al., *Bayesian Data Analysis*, section 3.6).
    """
    count = len(deviations)
    prior = PRIOR_REPEATS * (1 - systematic_share) * factor * stated
    random = (prior + deviations.T @ deviations) / (PRIOR_REPEATS + count - 1)
    covariance = systematic_share * stated + random / count
    return np.asarray((covariance + covariance.T) / 2)


def expected_share_of_mean(samples: int, systematic_share: float) -> float:
    """Share of Σ̄ that the mean of K samples is expected to keep: s + (1 - s) / K."""
    return systematic_share + (1.0 - systematic_share) / samples


def joint_scatter(jacobian: Floats, joint_std: Floats, rotation: Floats, m: int) -> Floats:
    """Covariance (..., m, m) of a reading from the scatter of the joints: R J Σ_q Jᵀ Rᵀ."""
    factor = scatter_factor(jacobian, joint_std, rotation, m)
    return np.asarray(factor @ np.swapaxes(factor, -1, -2))


def scatter_factor(jacobian: Floats, joint_std: Floats, rotation: Floats, m: int) -> Floats:
    """Factor F = R J Σ_q^½ (..., m, n) of the scatter of the joints, σ_q (n,); J (..., 6, n).

    F_i F_jᵀ is the covariance of two readings i, j of one arrival of the arm.
    """
    moved = jacobian * joint_std
    turned = np.concatenate([rotation @ moved[..., :3, :], rotation @ moved[..., 3:, :]], axis=-2)
    return np.asarray(turned[..., :m, :])


def arrival_factors(
    arm: Arm, readings: Readings, offset: Floats, rotation: Floats, joint_std: Floats
) -> Floats:
    """Factors F (N, m, n) of the scatter of the joints at the nominal poses of the readings."""
    chain = evaluate(arm, readings.states.q)
    jac = drive_jacobian(arm, chain, chain.point(offset))
    return scatter_factor(jac, joint_std, rotation, readings.m)


def with_scatter(readings: Readings, factor: Floats) -> Readings:
    """Return the readings with a scatter of the arm, F (N, m, k), added: V + F Fᵀ."""
    total, s = readings.covariance + factor @ np.swapaxes(factor, 1, 2), readings.states
    shared = None if s.target is None and s.observer is None else factor
    return replace(readings, covariance=total, common=shared)


def scatter_alone(readings: Readings, factor: Floats) -> Readings:
    """Return the readings with the covariance of a scatter F (N, m, k) of the arm alone."""
    without = replace(readings, covariance=np.zeros_like(readings.covariance), serial=None)
    return with_scatter(without, factor)


def symmetric_root(covariance: Floats) -> Floats:
    """S (..., m, m) of covariances, see `readings.readings`."""
    std = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    per_std = 1.0 / np.where(std > 0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance * per_std[..., :, None] * per_std[..., None, :])
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    return np.asarray(std[..., :, None] * (root @ np.swapaxes(vectors, -1, -2)))


def instrument_root(readings: Readings, m: int | None = None) -> Floats:
    """(N, m, m) S of `SerialNoise`, of the first m elements: root of all but the arm's scatter."""
    v = readings.covariance if readings.stated is None else readings.stated
    if readings.stated is None and readings.common is not None:
        v = v - readings.common @ np.swapaxes(readings.common, 1, 2)
    return symmetric_root(v[:, :m, :m])


def measurement_covariance(
    readings: Readings, loaded: Ints, reference: Ints, weights: Floats
) -> Floats:
    """(G, L·m, L·m) covariance D C Dᵀ of the measurements of each group, D = [I, −weights].

    C, the covariance of all readings of a group, has the blocks V_i, and F_i F_jᵀ for two readings
    of one arrival; where their noise is correlated, φ S_i C_ij S_jᵀ is added, see
    `readings.readings`. A group has L loaded and U unloaded rows, (G, L) and (G, U).
    """
    rows = np.concatenate([loaded, reference], axis=1)
    groups, count = rows.shape
    m = readings.m
    c = np.zeros((groups, count, m, count, m))
    if readings.common is not None and count > 1:
        f, arrival = readings.common[rows], readings.arrivals[rows]
        together = (arrival[:, :, None] == arrival[:, None, :]).astype(float)
        np.einsum("gain,gbjn,gab->gaibj", f, f, together, out=c, optimize=True)
    index = np.arange(count)
    if readings.serial is not None and readings.along is not None:
        root = instrument_root(readings)[rows]
        shared = readings.serial.share * readings.serial.correlation(readings.along[rows])
        c += np.einsum("gaik,gab,gbjk->gaibj", root, shared, root, optimize=True)
    c[:, index, :, index, :] = np.moveaxis(readings.covariance[rows], 1, 0)
    if reference.shape[1]:
        d = np.concatenate([np.eye(len(weights)), -weights], axis=1)
        c = np.einsum("pa,gaibj,qb->gpiqj", d, c, d, optimize=True)
    size = len(weights) * m
    return c.reshape(groups, size, size)


def single_covariance(v: Floats, loaded: Ints, reference: Ints, weights: Floats) -> Floats:
    """(G, L, m, m) covariance of each measurement by itself, from V (N, m, m)."""
    unloaded = np.einsum("lu,guij->glij", weights**2, v[reference])
    return np.asarray(v[loaded] + unloaded)


SINGULAR = 1e-9  # eigenvalue of a correlation matrix that is zero but for rounding


def smallest_correlation(covariance: Floats) -> Floats:
    """Return the smallest eigenvalue (N,) of the correlation matrices of covariances (N, m, m).

    −∞ for a covariance without variance, a negative variance, or a correlation beyond ±1.
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    scale = 1.0 / np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = scale[:, :, None] * covariance * scale[:, None, :]
    beyond = ~(np.abs(correlation) <= 1.0 + 1e-9)
    undefined = ((variance <= 0)[:, :, None] & (covariance != 0)) | beyond
    correlation = np.where(undefined, 0.0, correlation)
    smallest = np.linalg.eigvalsh(correlation)[:, 0]
    return np.where(np.any(undefined, axis=(1, 2)), -np.inf, smallest)


def is_covariance(covariance: Floats) -> Bools:
    """Return (N,) whether matrices (N, m, m) are symmetric and positive semi-definite."""
    std = np.sqrt(np.abs(np.diagonal(covariance, axis1=1, axis2=2)))
    differs = np.abs(covariance - np.swapaxes(covariance, 1, 2))
    symmetric = np.all(differs <= 1e-9 * std[:, :, None] * std[:, None, :], axis=(1, 2))
    return np.asarray(symmetric & (smallest_correlation(covariance) >= -SINGULAR))
