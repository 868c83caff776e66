"""The covariance of a reading that has yet to be taken."""

import numpy as np

from hilcal.config import CellConfig
from hilcal.data.covariance import (
    expected_share_of_mean,
    joint_scatter,
    tracker_covariance,
    tracker_noise,
)
from hilcal.model import Prediction
from hilcal.plan.nominal_model import NominalModel
from hilcal.robot.chain import joint_jacobian
from hilcal.types import Floats


def reading_covariance(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """Covariance of the mean of K samples at predicted states, and of the arm's return to them.

        V = (s + (1 − s)/K) Σ + R J Σ_q Jᵀ Rᵀ

    with Σ what the tracker states of one sample, s its systematic share, K the samples of a
    reading (the expectation of what a run computes from its samples), and the arm's
    repeatability as identification adds it.

    Args:
        nominal: the model, with the tracker in its place.
        config: `[tracker]`, `[acquire]` and `[repeatability]`.
        predicted: N states.

    Returns:
        (N, m, m) covariances in sensor axes; m², m·rad, rad².
    """
    a, o, m = config.acquire, predicted.observation, nominal.m
    stated = tracker_covariance(o.position, tracker_noise(config.tracker), nominal.station, m)
    out = expected_share_of_mean(a.samples, a.systematic_share) * stated
    joint_std = config.repeatability.per_joint(nominal.cell.arm.n)
    if np.any(joint_std):
        jac = joint_jacobian(predicted.situation.chain, o.base_position)
        out = out + joint_scatter(jac, joint_std, o.axes, m)
    return np.asarray(out)
