"""The arm's own repeatability, which no instrument states, as part of a reading's covariance."""

from dataclasses import replace

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import Readings
from hilcal.errors import CannotAnswerError
from hilcal.identify.registration import register
from hilcal.robot.chain import evaluate, joint_jacobian
from hilcal.types import Floats


def with_repeatability(cell: Cell, readings: Readings, joint_std: Floats) -> Readings:
    """Return the readings with the scatter of the joints added to what the instrument states.

        V = V_instrument + R J Sigma_q Jᵀ Rᵀ,   Sigma_q = diag(joint_std²)

    with J the target's nominal Jacobian in base axes and R the orientation of the base in the
    sensor's frame, estimated from the readings where it is unknown. With too few poses to
    estimate it, the readings are returned as they are; nothing can be fitted to them either.

    Args:
        cell: the cell.
        readings: N readings whose covariances are the instrument's alone.
        joint_std: (n,) standard deviations from one arrival to the next, rad.
    """
    if not np.any(joint_std):
        return readings
    try:
        registered = register(cell, readings)
    except CannotAnswerError:
        return readings
    chain = evaluate(cell.arm, readings.states.q)
    jac = joint_jacobian(chain, chain.point(registered.target[:3, 3])) * joint_std
    base = registered.registration[:3, :3]
    turned = np.concatenate([base @ jac[:, :3], base @ jac[:, 3:]], axis=1)[:, : readings.m]
    added = turned @ np.swapaxes(turned, 1, 2)
    return replace(readings, covariance=readings.covariance + added)
