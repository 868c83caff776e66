"""Which readings are the same measurements, whatever file, order, names or units they came in.

A reading is identified by what was measured: the commanded joints, the position, the attitude where
it was read, and whether a load was on. Names of poses and loads, times, covariances and the order
of the rows do not count, since a table may be imported again with others; nor does the wrench,
which changes with the configured mass of a load.

Numbers agree within `LENGTH_M`, `ANGLE_RAD` and `ATTITUDE_RAD`. A tracker's scatter is far
larger: readings that were taken again at the same pose differ by more in some element, unless the
instrument's last digit is coarser than its scatter. A digest of rounded numbers would not do: two
copies on both sides of a rounding boundary have different digests, however fine the rounding is.
"""

from collections.abc import Sequence

import numpy as np

from hilcal.readings.readings import Readings, numbered
from hilcal.types import Bools, Floats

LENGTH_M = 1e-7  # A table in mm with four decimals is off by half of that; a choice
ANGLE_RAD = 1e-5  # A table in degrees with three decimals is off by 0.9e-5; a choice
ATTITUDE_RAD = 2e-5  # Three such angles together make an attitude; a choice
SHARED = 0.1  # share of the readings that makes two campaigns of one measurement; a choice
_LOADED_OFFSET = 10.0  # Distance of loaded from unloaded readings, in units of the tolerance


def found_among(readings: Readings, reference: Readings) -> Bools:
    """(N,) which readings are among `reference`; attitudes count where both have them."""
    attitude = readings.m == reference.m == 6
    return _near(_coordinates(readings, attitude), _coordinates(reference, attitude))


def prints(readings: Readings) -> Floats:
    """(N, n + 4) what identifies a reading, to be stored: joints, position, whether loaded."""
    return _coordinates(readings, attitude=False)


def found_among_prints(readings: Readings, stored: Floats) -> Bools:
    """(N,) which readings are among those whose `prints` (M, n + 4) were stored."""
    return _near(prints(readings), stored)


def _near(points: Floats, reference: Floats) -> Bools:
    """(N,) which points (N, K) are near one of `reference` (M, K'); none where K' is not K."""
    if not len(points) or not len(reference) or points.shape[1] != reference.shape[1]:
        return np.zeros(len(points), dtype=np.bool_)
    from scipy.spatial import cKDTree  # slow to import

    distance, _ = cKDTree(reference).query(points, p=np.inf, distance_upper_bound=1.0 + 1e-9)
    return np.asarray(np.isfinite(distance))


def shared(campaigns: Sequence[Floats]) -> tuple[int, int] | None:
    """Return the numbers of two campaigns, by their `prints`, that share readings; else None."""
    from scipy.spatial import cKDTree  # slow to import

    for width in sorted({c.shape[1] for c in campaigns}):
        alike = [(k, np.unique(c, axis=0)) for k, c in enumerate(campaigns) if c.shape[1] == width]
        campaign = np.concatenate([np.full(len(rows), k) for k, rows in alike])
        rows = np.concatenate([rows for _, rows in alike])
        if len(rows) < 2:
            continue
        tree = cKDTree(rows)
        neighbours = tree.query(rows, k=2, p=np.inf, distance_upper_bound=1.0 + 1e-9)
        index, (distance, nearest) = np.arange(len(rows)), map(np.asarray, neighbours)
        second = (nearest[:, 0] == index).astype(int)  # one of the two is the reading itself
        distance, nearest = distance[index, second], nearest[index, second]
        near = np.isfinite(distance)
        partner = np.full(len(rows), -1)
        partner[near] = campaign[nearest[near]]
        for k, unique in alike:
            partners = partner[campaign == k]
            partners = partners[(partners >= 0) & (partners != k)]
            if len(partners) > SHARED * len(unique):
                return k, int(np.bincount(partners).argmax())
    return None


def never_fitted(readings: Readings, fitted: Readings, deflections: bool) -> tuple[Bools, Bools]:
    """Return (N,) which readings were fitted, and (N,) which can be predicted as unseen ones.

    A deflection is unseen if neither its loaded nor an unloaded reading of it was fitted.
    """
    repeated = found_among(readings, fitted)
    if not deflections:
        return repeated, ~repeated
    group = numbered(readings.pose, readings.cycle, readings.target)
    unseen = ~repeated & ~np.isin(group, group[repeated & readings.unloaded])
    return repeated, unseen & np.isin(group, group[unseen & ~readings.unloaded])


def _coordinates(r: Readings, attitude: bool) -> Floats:
    """(N, K) coordinates in which equal readings differ by 1 at most."""
    parts = [
        r.states.q / ANGLE_RAD,
        r.value[:, :3] / LENGTH_M,
        np.where(r.unloaded, 0.0, _LOADED_OFFSET)[:, None],
    ]
    if attitude:  # as a matrix, since the rotation vector jumps at half a turn
        from scipy.spatial.transform import Rotation  # slow to import

        parts.append(Rotation.from_rotvec(r.value[:, 3:]).as_matrix().reshape(-1, 9) / ATTITUDE_RAD)
    return np.concatenate(parts, axis=1)
