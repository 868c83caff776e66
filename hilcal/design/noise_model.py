"""The covariance of a reading that has yet to be taken."""

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.nominal_model import NominalModel
from hilcal.model.model import Prediction
from hilcal.readings.covariance import (
    expected_share_of_mean,
    joint_scatter,
    scatter_factor,
    tracker_covariance,
    tracker_noise,
)
from hilcal.robot.chain import drive_jacobian
from hilcal.types import Floats


def arrival_covariance(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """Covariance of all that is read in one arrival of the arm: of its targets together.

    They have the arm's repeatability in common: block (i, j) is δ_ij V_instrument + F_i F_jᵀ with
    F = R J Σ_q^½ (see `reading_covariance`).

    Args:
        nominal: the model, with the tracker in its place.
        config: `[tracker]`, `[acquire]` and `[repeatability]`.
        predicted: N·T states, the T readings of one arrival in succession.

    Returns:
        (N, T·m, T·m) covariances.
    """
    single = reading_covariance(nominal, config, predicted)
    count, m = nominal.each, nominal.m
    if count == 1:
        return single
    o = predicted.observation
    s = predicted.situation
    jac = drive_jacobian(s.cell.arm, s.chain, o.base_position)
    joint_std = config.repeatability.per_joint(nominal.cell.arm.n)
    factor = scatter_factor(jac, joint_std, o.axes, m).reshape(-1, count * m, jac.shape[2])
    out = (factor @ np.swapaxes(factor, 1, 2)).reshape(-1, count, m, count, m)
    each = np.arange(count)
    out[:, each, :, each, :] = np.moveaxis(single.reshape(-1, count, m, m), 1, 0)
    return out.reshape(-1, count * m, count * m)


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
    stated = _instrument(nominal, config, predicted)
    out = expected_share_of_mean(a.samples, a.systematic_share) * stated
    joint_std = config.repeatability.per_joint(nominal.cell.arm.n)
    if np.any(joint_std):
        jac = drive_jacobian(
            predicted.situation.cell.arm, predicted.situation.chain, o.base_position
        )
        out = out + joint_scatter(jac, joint_std, o.axes, m)
    unread = np.diagonal(out, axis1=1, axis2=2) == 0  # of readings of one number; any noise does
    return np.asarray(out + unread[:, :, None] * np.eye(m))


def _instrument(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """(N, m, m) covariance that the instrument states; zero in elements that are not read."""
    o, m, t = predicted.observation, nominal.m, config.tracker
    number, by = predicted.situation.states.observer, nominal.cell.observers
    if number is None or not by:
        return tracker_covariance(o.position, tracker_noise(t), nominal.station, m)
    out = np.zeros((len(o.position), m, m))
    for k, one in enumerate(by):
        mine = number == k
        if one.name.kind == "station":
            place = np.zeros(3) if k else nominal.station
            out[mine] = tracker_covariance(o.position[mine], tracker_noise(t), place, m)
            continue
        far = one.name.kind == "point"
        section = (config.points if far else config.gauges).get(one.name.name)
        std = None if section is None else section.std_m
        length = t.range_std_m + t.range_std_per_m * np.abs(o.position[mine, 0])
        out[mine, 0, 0] = np.square(length if std is None else std)
    return out
