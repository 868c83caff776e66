"""Closed-form starts of a registration: from attitudes, from positions, from a few rotations."""

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np

from hilcal.identification.rigid_frames import BASE_M, TARGET_M, Frames, Free, Seen
from hilcal.types import Floats

ALTERNATIONS = 10
"""Steps between rotation and translations; the least squares that follow do the rest. A choice."""
HOLD = 1e-6
"""Weight of an ordinary size against a position error of 1 m in the linear starts; a choice, small
enough to shift no start, and enough to keep what the poses do not tell near what is given."""


def nearest_rotation(m: Floats) -> Floats:
    """Return the rotation (..., 3, 3) nearest to a matrix (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(m)
    flip = np.ones(m.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    return np.asarray((u * flip[..., None, :]) @ vt)


def closed_forms(seen: Seen, given: Frames, free: Free) -> Iterator[Frames]:
    """Yield base and targets from attitudes and from positions.

    Args:
        seen: flange poses and readings.
        given: base and targets as configured, or the nominal ones.
        free: what is estimated.
    """
    if not free.mask[:6].any():
        yield _with_translations(seen, given, given.base[:3, :3], free)
        return
    if seen.attitude is not None:
        base = _from_attitudes(seen, seen.attitude)
        yield _with_translations(seen, given, base, free)
    yield _alternated(seen, given, free)


def rotated(seen: Seen, given: Frames, free: Free) -> Iterator[Frames]:
    """Yield base and targets for a base that stands in each of the 24 rotations of a cube."""
    if free.mask[:6].any():
        for rotation in _CUBE:
            yield _with_translations(seen, given, rotation, free)


def _rotations_of_a_cube() -> Floats:
    """(24, 3, 3) the rotations that take a cube to itself."""
    out = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), list(order)] = signs
            if np.linalg.det(turn) > 0:
                out.append(turn)
    return np.array(out)


_CUBE = _rotations_of_a_cube()


def _from_attitudes(seen: Seen, attitude: Floats) -> Floats:
    """R of M_i R_τᵀ = R R_i, the null vector of a linear system; of the first target's readings."""
    mine = seen.target == seen.target[0]
    # vec by rows: (M_i ⊗ I) vec(R_τᵀ) = (I ⊗ R_iᵀ) vec(R)
    eye = np.eye(3)
    left = np.einsum("nij,kl->nikjl", attitude[mine], eye).reshape(-1, 9)
    right = np.einsum("ij,nlk->nikjl", eye, seen.rotation[mine]).reshape(-1, 9)
    gram = np.concatenate([left, -right], axis=1)
    base = np.linalg.eigh(gram.T @ gram)[1][9:, 0].reshape(3, 3)
    return nearest_rotation(base * (np.sign(np.linalg.det(base)) or 1.0))


def _with_translations(seen: Seen, given: Frames, rotation: Floats, free: Free) -> Frames:
    """Complete a rotation of the base by the best translations and the targets' axes."""
    count, size = len(seen), len(given.targets)
    turned = rotation @ seen.rotation
    a = np.zeros((count, 3, 3 + 3 * size))
    a[:, :, :3] = np.eye(3)
    start = [given.base[:3, 3], *given.targets[:, :3, 3]]
    for k in range(size):
        mine = seen.target == k
        a[mine, :, 3 + 3 * k : 6 + 3 * k] = turned[mine]
    live = np.repeat(np.concatenate([[free.mask[0]], free.mask[6::6]]), 3)
    x0 = np.concatenate(start)
    hold = np.concatenate([np.full(3, HOLD / BASE_M), np.full(3 * size, HOLD / TARGET_M)])
    flat = a.reshape(-1, len(x0))
    rest = (seen.value - seen.position @ rotation.T).reshape(-1) - flat @ x0
    rows = np.concatenate([flat, np.diag(hold * np.sqrt(count))])[:, live]
    x = x0.copy()
    if live.any():
        x[live] += np.linalg.lstsq(rows, np.concatenate([rest, np.zeros(len(x0))]), rcond=None)[0]
    base, targets = np.eye(4), given.targets.copy()
    base[:3, :3], base[:3, 3] = rotation, x[:3]
    targets[:, :3, 3] = x[3:].reshape(size, 3)
    if seen.attitude is not None:
        for k in range(size):
            mine = seen.target == k
            mean = np.einsum("nji,njk->ik", turned[mine], seen.attitude[mine])
            targets[k, :3, :3] = nearest_rotation(mean)
    return Frames(base, targets)


def _alternated(seen: Seen, given: Frames, free: Free) -> Frames:
    """Positions alone: Procrustes for R, then linear for τ and t, a few times."""
    out = given
    for _ in range(ALTERNATIONS):
        offset = out.targets[seen.target, :3, 3]
        x = seen.position + np.einsum("nij,nj->ni", seen.rotation, offset)
        spread = (seen.value - seen.value.mean(axis=0)).T @ (x - x.mean(axis=0))
        before, out = out, _with_translations(seen, given, nearest_rotation(spread), free)
        if np.abs(out.targets - before.targets).max() < 1e-6:
            break
    return out
