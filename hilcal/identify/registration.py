"""Closed-form start of the tracker's registration and the target's offset.

With the nominal flange poses (R_i, p_i), readings y_i obey

    y_i = R (p_i + R_i τ) + t,      M_i = R R_i R_τ  (attitude, where read)

R, t: the base in the sensor's frame; τ, R_τ: the target on the flange.
"""

from dataclasses import replace

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import Readings
from hilcal.errors import CannotAnswerError
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.types import Floats

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
    y = readings.value[:, :3]
    target, registration = cell.target.copy(), cell.registration.copy()
    if readings.m == 6:
        attitude = se3.rotation(readings.value[:, 3:])
        base, tool = _attitudes(r, attitude, cell)
        tau, t = _translations(base, r, p, y, cell)
        target[:3, :3] = tool
    else:
        base, tau, t = _alternate(r, p, y, cell)
    registration[:3, :3], registration[:3, 3] = base, t
    target[:3, 3] = tau
    return replace(
        cell,
        target=target if not cell.target_known or readings.m == 6 else cell.target,
        registration=cell.registration if cell.registration_known else registration,
    )


def _nearest_rotation(m: Floats) -> Floats:
    u, _, vt = np.linalg.svd(m)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return np.asarray(u @ flip @ vt)


def _attitudes(r: Floats, attitude: Floats, cell: Cell) -> tuple[Floats, Floats]:
    """Solve M_i R_τᵀ = R R_i for R and R_τ: null vector of a linear system, then refined."""
    if cell.registration_known:
        base = cell.registration[:3, :3]
    else:
        # vec by rows: (M_i ⊗ I) vec(R_τᵀ) = (I ⊗ R_iᵀ) vec(R)
        eye = np.eye(3)
        left = np.einsum("nij,kl->nikjl", attitude, eye).reshape(-1, 9)
        right = np.einsum("ij,nlk->nikjl", eye, r).reshape(-1, 9)
        gram = np.concatenate([left, -right], axis=1)
        vector = np.linalg.eigh(gram.T @ gram)[1][:, 0]
        base = vector[9:].reshape(3, 3)
        base = _nearest_rotation(base * np.sign(np.linalg.det(base)))
    tool = _nearest_rotation(np.einsum("nji,kj,nkl->il", r, base, attitude))
    if not cell.registration_known:
        base = _nearest_rotation(np.einsum("nij,kj,nlk->il", attitude, tool, r))
        tool = _nearest_rotation(np.einsum("nji,kj,nkl->il", r, base, attitude))
    return base, tool


def _translations(
    base: Floats, r: Floats, p: Floats, y: Floats, cell: Cell
) -> tuple[Floats, Floats]:
    """Solve y_i − R p_i = R R_i τ + t for τ and t by least squares."""
    count = len(p)
    turned = base @ r
    eye = np.broadcast_to(np.eye(3), (count, 3, 3))
    if cell.target_known:
        tau = cell.target[:3, 3]
        return tau, np.asarray((y - p @ base.T - turned @ tau).mean(axis=0))
    if cell.registration_known:
        t = cell.registration[:3, 3]
        rhs = (y - p @ base.T - t).reshape(-1)
        tau = np.asarray(np.linalg.lstsq(turned.reshape(-1, 3), rhs, rcond=None)[0], dtype=float)
        return tau, t
    a = np.concatenate([turned, eye], axis=2).reshape(-1, 6)
    solution = np.linalg.lstsq(a, (y - p @ base.T).reshape(-1), rcond=1e-9)[0]
    x = np.asarray(solution, dtype=float)
    return x[:3], x[3:]


def _alternate(r: Floats, p: Floats, y: Floats, cell: Cell) -> tuple[Floats, Floats, Floats]:
    """Positions only: Procrustes for R, then linear for τ and t, until convergence."""
    tau = cell.target[:3, 3]
    base = cell.registration[:3, :3]
    t = cell.registration[:3, 3]
    for _ in range(ALTERNATIONS):
        previous = tau
        if not cell.registration_known:
            x = p + r @ tau
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
        tau, t = _translations(base, r, p, y, cell)
        if np.abs(tau - previous).max() < 1e-12:
            break
    return base, tau, t
