"""Readings with their full covariance: what the file states, and the arm's repeatability."""

from dataclasses import replace
from typing import Literal

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.data.campaign_file import CampaignFile
from hilcal.data.covariance import COVERS, INSTRUMENT, WHOLE, joint_scatter
from hilcal.data.readings import Readings
from hilcal.errors import CannotAnswerError
from hilcal.identify.registration import register
from hilcal.robot.chain import evaluate, joint_jacobian
from hilcal.types import Floats

CovarianceParts = Literal[
    "instrument", "instrument and repeatability", "instrument and arm as stated", "as imported"
]
"""What the covariance of a reading consists of, see `data.covariance`:

- instrument: the arm's scatter is not in it;
- instrument and repeatability: J Σ_q Jᵀ of [repeatability] was added;
- instrument and arm as stated: the table, or the cell, says that the arm's scatter is in it;
- as imported: by an older version, which added nothing.
"""


def campaign_readings(campaign: CampaignFile, cell: Cell, config: CellConfig) -> Readings:
    """Return all readings of a campaign with their full covariance, see `data.covariance`.

    The arm's repeatability is added where the stored covariances cover the instrument alone.

    Raises:
        InputError: there are no readings yet, or they are damaged.
    """
    readings = campaign.readings()
    if covariance_parts(campaign.about(COVERS), config) != "instrument and repeatability":
        return readings
    return with_joint_scatter(cell, readings, config.repeatability.per_joint(cell.arm.n))


def covariance_parts(covers: str | None, config: CellConfig) -> CovarianceParts:
    """Return what the full covariance of a campaign's readings consists of.

    Args:
        covers: what the stored covariances cover, as the campaign's file states it.
        config: of the cell.
    """
    if covers == WHOLE:
        return "instrument and arm as stated"
    if covers != INSTRUMENT:
        return "as imported"
    stated = bool(np.any(np.asarray(config.repeatability.joint_std_rad) > 0))
    return "instrument and repeatability" if stated else "instrument"


def with_joint_scatter(cell: Cell, readings: Readings, joint_std: Floats) -> Readings:
    """Return the readings with the scatter of the joints added to the instrument's covariance.

    V = V_instrument + R J Σ_q Jᵀ Rᵀ with the Jacobian of the nominal arm and R the orientation of
    the base in the sensor's frame, estimated from the readings where it is unknown. With too few
    poses to estimate it, the readings are returned as they are; nothing can be fitted to them
    either.

    Args:
        cell: the cell.
        readings: N readings whose covariances are the instrument's alone.
        joint_std: (n,) standard deviations from one arrival to the next, rad.
    """
    if not np.any(joint_std):
        return readings
    try:
        registered = register(cell, readings).cell
    except CannotAnswerError:
        return readings
    chain = evaluate(cell.arm, readings.states.q)
    jac = joint_jacobian(chain, chain.point(registered.target[:3, 3]))
    added = joint_scatter(jac, joint_std, registered.registration[:3, :3], readings.m)
    return replace(readings, covariance=readings.covariance + added)
