"""The covariance of a reading that has yet to be taken."""

import numpy as np

from hilcal.config import CellConfig
from hilcal.data.noise import TrackerNoise, tracker_covariance, tracker_pose_covariance
from hilcal.model import Prediction
from hilcal.plan.nominal_model import Assumed
from hilcal.robot import se3
from hilcal.robot.chain import joint_jacobian
from hilcal.types import Floats


def reading_covariance(assumed: Assumed, config: CellConfig, predicted: Prediction) -> Floats:
    """Covariance of the mean of K samples at predicted states, and of the arm's return to them.

        V = (s + (1 − s)/K) Σ + R J Σ_q Jᵀ Rᵀ

    with Σ what the tracker states of one sample, s its systematic share, K the samples of a
    reading (the expectation of what a run computes from its samples), and the arm's
    repeatability as identification adds it.

    Args:
        assumed: the model, with the tracker in its place.
        config: `[tracker]`, `[acquire]` and `[repeatability]`.
        predicted: N states.

    Returns:
        (N, m, m) covariances in sensor axes; m², m·rad, rad².
    """
    t, a, m = config.tracker, config.acquire, assumed.m
    noise = TrackerNoise(
        t.range_std_m,
        t.range_std_per_m,
        t.transverse_std_m,
        t.transverse_std_per_m,
        t.orientation_std_rad,
    )
    law = tracker_covariance if m == 3 else tracker_pose_covariance
    share = a.systematic_share + (1.0 - a.systematic_share) / a.samples
    out = share * law(predicted.observation.position, noise, assumed.station)
    joint_std = config.repeatability.per_joint(assumed.cell.arm.n)
    if np.any(joint_std):
        o = predicted.observation
        moved = joint_jacobian(predicted.situation.chain, o.base_position) * joint_std
        turned = [se3.product(o.axes, moved[:, rows]) for rows in (slice(0, 3), slice(3, 6))]
        jac = np.concatenate(turned, axis=1)[:, :m]
        out = out + jac @ np.swapaxes(jac, 1, 2)
    return np.asarray(out)
