"""Closed-form start of the tracker's registration and the target's offset.

With the nominal flange poses (R_i, p_i), readings y_i obey

    y_i = R (p_i + R_i τ) + t,      M_i = R R_i R_τ  (attitude, where read)

R, t: the base in the sensor's frame; τ, R_τ: the target on the flange; of several targets, that
which reading i is of.
"""

from dataclasses import replace

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import Readings
from hilcal.errors import CannotAnswerError
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.types import Floats, Ints

ALTERNATIONS = 200
"""Most alternations between rotation and translations; a choice, no study set it."""
MIN_POSES = 4
NARROW = 1e-3
"""Rms distance from a line, m, below which positions are collinear; a choice."""


def register(cell: Cell, readings: Readings) -> Cell:
    """Return the cell with unknown registration and target offset estimated.

    Raises:
        CannotAnswerError: where the poses do not determine it (fewer than four distinct positions,
            all on one line, or no rotation).
    """
    if cell.registration_known and cell.target_known:
        return cell
    states = readings.states
    angle = states.q if states.q_actual is None else states.q_actual
    chain = chains.evaluate(cell.arm, angle)
    r, p = chain.rotation[-1], chain.position[-1]
    distinct = len(np.unique(np.round(angle, 9), axis=0))
    if distinct < MIN_POSES:
        raise CannotAnswerError(
            f"registration: {distinct} distinct poses; measure at least {MIN_POSES}, better 10, "
            "that turn the flange and do not lie on a line"
        )
    y, read = readings.value[:, :3], readings.target
    targets, registration = cell.all_targets.copy(), cell.registration.copy()
    if readings.m == 6:
        base, targets[:, :3, :3] = _attitudes(r, se3.rotation(readings.value[:, 3:]), read, cell)
        tau, t = _translations(base, r, p, y, read, cell)
    else:
        base, tau, t = _alternate(r, p, y, read, cell)
    registration[:3, :3], registration[:3, 3] = base, t
    targets[:, :3, 3] = tau
    known = np.array(cell.known_targets)
    return replace(
        cell.with_targets(np.where(known[:, None, None], cell.all_targets, targets)),
        registration=cell.registration if cell.registration_known else registration,
    )


def _nearest_rotation(m: Floats) -> Floats:
    u, _, vt = np.linalg.svd(m)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray(u @ flip @ vt)


def _attitudes(r: Floats, attitude: Floats, read: Ints, cell: Cell) -> tuple[Floats, Floats]:
    """Solve M_i R_τᵀ = R R_i for R and the R_τ (T, 3, 3): null vector of a linear system."""
    count = len(cell.all_targets)
    mine = [read == k for k in range(count)]

    def tools(base: Floats) -> Floats:
        sums = [np.einsum("nji,kj,nkl->il", r[k], base, attitude[k]) for k in mine]
        return np.stack([_nearest_rotation(s) if s.any() else np.eye(3) for s in sums])

    if cell.registration_known:
        base = cell.registration[:3, :3]
        return base, tools(base)
    # vec by rows: (M_i ⊗ I) vec(R_τᵀ) = (I ⊗ R_iᵀ) vec(R)
    eye = np.eye(3)
    left = np.einsum("nij,kl->nikjl", attitude, eye).reshape(-1, 9)
    right = np.einsum("ij,nlk->nikjl", eye, r).reshape(-1, 9)
    own = [left * np.repeat(k, 9)[:, None] for k in mine]
    gram = np.concatenate([*own, -right], axis=1)
    vector = np.linalg.eigh(gram.T @ gram)[1][:, 0]
    base = vector[-9:].reshape(3, 3)
    base = _nearest_rotation(base * np.sign(np.linalg.det(base)))
    tool = tools(base)
    base = _nearest_rotation(np.einsum("nij,nkj,nlk->il", attitude, tool[read], r))
    return base, tools(base)


def _translations(
    base: Floats, r: Floats, p: Floats, y: Floats, read: Ints, cell: Cell
) -> tuple[Floats, Floats]:
    """Solve y_i − R p_i = R R_i τ + t for the unknown of τ (T, 3) and t by least squares."""
    turned = base @ r
    tau, t = cell.all_targets[:, :3, 3].copy(), cell.registration[:3, 3]
    unknown = np.flatnonzero(~np.array(cell.known_targets))
    tau[unknown] = 0.0
    rhs = y - p @ base.T - np.einsum("nij,nj->ni", turned, tau[read])
    columns = [turned * (read == k)[:, None, None] for k in unknown]
    if cell.registration_known:
        rhs = rhs - t
    else:
        columns.append(np.broadcast_to(np.eye(3), turned.shape))
    if columns:
        a = np.concatenate(columns, axis=2).reshape(3 * len(p), -1)
        solution = np.linalg.lstsq(a, rhs.reshape(-1), rcond=1e-9)[0].reshape(-1, 3)
        tau[unknown] = solution[: len(unknown)]
        t = t if cell.registration_known else solution[-1]
    return tau, t


def _alternate(
    r: Floats, p: Floats, y: Floats, read: Ints, cell: Cell
) -> tuple[Floats, Floats, Floats]:
    """Positions only: Procrustes for R, then linear for τ (T, 3) and t, until convergence."""
    tau = cell.all_targets[:, :3, 3]
    base = cell.registration[:3, :3]
    t = cell.registration[:3, 3]
    for _ in range(ALTERNATIONS):
        previous = tau
        if not cell.registration_known:
            x = p + np.einsum("nij,nj->ni", r, tau[read])
            spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
            if spread[1] < NARROW * np.sqrt(len(x)):
                raise CannotAnswerError(
                    "registration: all positions lie in one point or on one line; measure poses "
                    "spread in space"
                )
            base = _nearest_rotation((y - y.mean(axis=0)).T @ (x - x.mean(axis=0)))
            t = y.mean(axis=0) - base @ x.mean(axis=0)
        if cell.target_known:
            break
        tau, t = _translations(base, r, p, y, read, cell)
        if np.abs(tau - previous).max() < 1e-12:
            break
    return base, tau, t
