"""Prediction of poses that are left out, and changes of the parameters by leaving them out.

Whole poses are left out, never single readings, as readings of one pose share its errors. Commanded
poses that agree in every joint within `SAME_POSE` count as one pose, whatever their names. A fold
is left out by one Gauss-Newton step from the full fit, with its rows subtracted exactly from the
normal equations. The strengths of shrunk families are chosen anew for each fold
(`regression.empirical_bayes`). Without a fold the flat parameters have a prior about zero (see
`regression.leave_out`), whose standard deviation is their ordinary magnitude, or the rms of the
effect's parameters in the full fit if that is larger.
"""

import numpy as np

from hilcal.identification.carried.carried_prior import START_STD, prior_of, scales_of
from hilcal.identification.gauss_newton import Solution, whitened_jacobian
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening
from hilcal.regression.empirical_bayes import FamilyProblem, solutions
from hilcal.regression.leave_out import ModelFolds, folds
from hilcal.types import Floats, Ints

# All of these are choices.
SAME_POSE = 2e-3  # difference of joint angles within which two poses are one, rad
FOLDS = 10  # the usual number
MOST_ELEMENTS = 5e7  # of the columns of dropped groups up to which these may enter again in a fold,
# for memory; with more readings a fold of a tenth hardly decides which groups are dropped


def distinct_poses(readings: Readings) -> Ints:
    """(N,) number of the distinct pose of each reading, in the order of first appearance."""
    _, row, name = np.unique(readings.pose, return_index=True, return_inverse=True)
    label = groups_within(readings.states.q[row], SAME_POSE)[name.reshape(-1)]
    _, index, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(index))[inverse.reshape(-1)])


def random_folds(pose: Ints, count: int = FOLDS) -> Ints:
    """Random fold of each measurement (D,) from its distinct pose (D,), from a fixed seed."""
    total = int(pose.max()) + 1
    deal = np.random.default_rng(20240607).permutation(total) % min(count, total)
    return np.asarray(deal[pose])


def block_folds(pose: Ints) -> Ints:
    """Fold of each measurement (D,): consecutive poses are in one fold."""
    total = int(pose.max()) + 1
    return np.asarray(np.arange(total) * min(FOLDS, total) // total)[pose]


def region_folds(angle: Floats, pose: Ints) -> Ints:
    """Fold of each measurement (D,): poses close to each other in joint space are in one fold.

    The largest group of poses is halved, repeatedly, across the first principal component of its
    joint angles (D, n).
    """
    total = int(pose.max()) + 1
    q = np.zeros((total, angle.shape[1]))
    q[pose] = angle
    regions = [np.arange(total)]
    while len(regions) < min(FOLDS, total):
        regions.sort(key=len)
        rows = regions.pop()
        spread = q[rows] - q[rows].mean(axis=0)
        along = spread @ np.linalg.svd(spread, full_matrices=False)[2][0]
        order = rows[np.argsort(along, kind="stable")]
        regions += [order[: len(order) // 2], order[len(order) // 2 :]]
    fold = np.empty(total, dtype=np.int64)
    for number, rows in enumerate(regions):
        fold[rows] = number
    return fold[pose]


def folds_of(model: Model, solution: Solution, fold: Ints) -> ModelFolds:
    """Return the normal equations of a fit without each fold; `fold` (R,) numbers them by row."""
    s, magnitude = solution, ordinary_magnitudes_of_y(model, solution)
    return folds(s.projection(), s.white, s.equations, s.y, s.prior, magnitude, s.beta, fold)


def ordinary_magnitudes(model: Model, theta: Floats) -> Floats:
    """Magnitude (P,) of each parameter: the ordinary one, or the rms over its effect if larger."""
    out = scales_of(model)
    for rows in model.slices():
        out[rows] *= max(1.0, float(np.sqrt(np.mean((theta[rows] / out[rows]) ** 2))))
    return out


def ordinary_magnitudes_of_y(model: Model, solution: Solution) -> Floats:
    """`ordinary_magnitudes` (P,) of the coordinates y of a solution."""
    return solution.space.scales(ordinary_magnitudes(model, solution.theta))


def parameter_changes(model: Model, solution: Solution, fold: Ints, w: Whitening) -> Floats:
    """Return the parameters without each fold (D,) minus those with it (F, P)."""
    steps = [f.step() for f in folds_of(model, solution, w.rows_of(fold)).folds]
    return np.asarray(np.array(steps) @ solution.transform.T)


def leave_out(model: Model, solution: Solution, fold: Ints, w: Whitening) -> Floats:
    """Return the residual (D, m) of each measurement, predicted without its fold (D,)."""
    groups = prior_of(model)[1]
    if w.scaling != "none" and bool((groups >= 0).any()):
        change = _with_families(model, solution, fold, w, groups)
    else:
        change = parameter_changes(model, solution, fold, w)
    moved = np.flatnonzero(np.any(change != 0, axis=0))
    columns = w.raw(model.jacobian(solution.prediction, solution.theta, w.m, moved))
    predicted = solution.raw.copy()
    for f, step in enumerate(change[:, moved]):
        predicted[fold == f] -= columns[fold == f] @ step
    return predicted


def _with_families(
    model: Model, solution: Solution, fold: Ints, w: Whitening, groups: Ints
) -> Floats:
    """`parameter_changes` for a model with shrunk families, with strengths chosen for each fold."""
    s, basis = solution, solution.equations.basis
    flat, count = len(basis.singular), len(basis.prior_precision)
    dropped = np.flatnonzero((groups >= 0) & (s.prior == 0))
    if len(dropped) * s.raw.size > MOST_ELEMENTS:
        dropped = dropped[:0]
    guess = START_STD * scales_of(model)[dropped]
    dropped_columns = whitened_jacobian(model, s.prediction, s.theta, w, dropped)
    in_family = groups[basis.with_prior] >= 0
    shrunk = flat + np.flatnonzero(in_family)
    unshrunk = np.concatenate([np.arange(flat), flat + np.flatnonzero(~in_family)])
    family = np.concatenate([groups[basis.with_prior[in_family]], groups[dropped]])
    coordinates, order = s.coordinates(), np.concatenate([unshrunk, shrunk])
    # Flat parameters have the prior about zero of `folds_of`; other unshrunk ones have their prior.
    magnitude = ordinary_magnitudes_of_y(model, s)
    per_magnitude = basis.transform[:, :flat] / magnitude[:, None]
    fitted = np.where(basis.flat, s.y / magnitude, 0.0)
    ridge = s.beta * np.eye(len(unshrunk))
    ridge[:flat, :flat] = s.beta * per_magnitude.T @ per_magnitude
    pull = np.zeros(len(unshrunk))
    pull[:flat] = -s.beta * per_magnitude.T @ fitted
    rows = s.rows  # copied only if necessary: it may take a gigabyte
    if len(dropped) or np.any(np.diff(order) != 1):
        rows = np.hstack([rows[:, order], dropped_columns * guess])
    u = solutions(
        FamilyProblem(
            rows=rows,
            target=s.white + s.rows @ coordinates,
            ridge=ridge,
            pull=pull,
            groups=np.unique(family, return_inverse=True)[1],
            std=np.concatenate([np.ones(len(shrunk)), np.zeros(len(dropped))]),
            beta=s.beta,
        ),
        w.rows_of(fold),
    )
    z = np.empty((len(u), count))
    z[:, order] = u[:, :count]
    change = (z - coordinates) @ s.transform.T
    change[:, dropped] = u[:, count:] * guess
    return np.asarray(change)


def connected_groups(a: Ints, b: Ints, count: int) -> Ints:
    """Return the group number (count,) of each of `count` items; items a[k] and b[k] are joined.

    Groups are numbered in the order of their first items.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def groups_within(points: Floats, distance: float) -> Ints:
    """Return the group number (N,) of each point (N, D).

    Two points are joined where they differ by at most `distance` in every coordinate. Points in one
    cell of half the distance are joined in a chain; two cells that are not yet joined, by one near
    pair, if there is any: near pairs may be too many to be listed.
    """
    from scipy.spatial import cKDTree  # slow to import

    if not points.size:
        return np.arange(len(points))
    place = np.floor(points / (distance / 2)) if distance else points
    cells, cell = np.unique(place, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    order = np.argsort(cell, kind="stable")
    joined = [np.stack([order[:-1], order[1:]], axis=1)[np.diff(cell[order]) == 0]]
    # Of equal points one is used: a tree does not divide them.
    first = np.sort(np.unique(points, axis=0, return_index=True)[1])
    if 2 * len(cells) > len(first):  # hardly any cell holds several
        joined.append(first[cKDTree(points[first]).query_pairs(distance, np.inf, 0, "ndarray")])
        a, b = np.concatenate(joined).T
        return connected_groups(a, b, len(points))
    order = np.argsort(cell[first], kind="stable")
    members = np.split(first[order], np.flatnonzero(np.diff(cell[first][order])) + 1)
    tree, up = cKDTree(cells), np.arange(len(cells))

    def group(k: Ints) -> Ints:
        while np.any(up[k] != k):
            up[k] = k = up[up[k]]
        return k

    for i in range(len(cells)):
        near = np.array(tree.query_ball_point(cells[i], 3.0 if distance else 0.0, p=np.inf))
        for j in near[group(near) != group(np.array([i]))].tolist():
            low, high = sorted(group(np.array([i, j])).tolist())
            if low == high:
                continue
            few, many = sorted((members[i], members[j]), key=len)
            nearest = cKDTree(points[many]).query(
                points[few], p=np.inf, distance_upper_bound=float(np.nextafter(distance, np.inf))
            )
            separation, index = (np.atleast_1d(x) for x in nearest)
            k = int(np.argmin(separation))
            if separation[k] <= distance:
                joined.append(np.array([[few[k], many[index[k]]]]))
                up[high] = low
    a, b = np.concatenate(joined).T
    return connected_groups(a, b, len(points))
