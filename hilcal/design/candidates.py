"""Candidate states: derivative and covariance of their readings."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.nominal_model import NominalModel, nominal_states
from hilcal.effects.protocol import Effect
from hilcal.model.model import Prediction
from hilcal.readings.covariance import (
    expected_share_of_mean,
    joint_scatter,
    scatter_factor,
    tracker_covariance,
    tracker_noise,
)
from hilcal.readings.readings import States
from hilcal.robot.chain import drive_jacobian
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

CHUNK = 4096  # States that are evaluated at once. A choice, of memory.


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """N poses, each of them unloaded and under those of the L loads that it can bear."""

    q: Floats  # (N, n) joint angles, rad
    loads: tuple[str, ...]  # 1 + L names, "none" first
    wrench: Floats  # (1 + L, 6) at the load point, base axes, N and N·m
    allowed: Bools  # (N, 1 + L) which states may be taken

    def __len__(self) -> int:
        """Return the number of poses N."""
        return len(self.q)

    def __getitem__(self, rows: slice) -> "Candidates":
        """Return the chosen poses."""
        return Candidates(self.q[rows], self.loads, self.wrench, self.allowed[rows])

    def states(self) -> States:
        """All N·(1 + L) states, pose by pose, with nominal times and sides of approach."""
        count = len(self.loads)
        return nominal_states(
            np.repeat(self.q, count, axis=0), np.tile(self.wrench, (len(self), 1))
        )


@dataclass(frozen=True, slots=True, eq=False)
class ReadingDerivatives:
    """What would be read of a chunk of N poses under 1 + L loads."""

    rows: slice
    # (N, 1 + L, m, P) derivative by the parameters, in their scales; m are the elements of all
    # targets that are read in one arrival
    jacobian: Floats
    covariance: Floats  # (N, 1 + L, m, m) of them


def candidates(
    nominal: NominalModel, config: CellConfig, q: Floats, allowed: Bools | None = None
) -> Candidates:
    """Return the states of poses under the loads of a configuration.

    q: (N, n) joint angles, rad; allowed: (N, 1 + L) which states may be taken, unloaded first; all
    by default.
    """
    gravity = nominal.cell.gravity
    names = (UNLOADED, *(load.name for load in config.loads))
    wrench = np.array([np.zeros(6), *(load.wrench(gravity) for load in config.loads)])
    if allowed is None:
        allowed = np.ones((len(q), len(names)), dtype=np.bool_)
    return Candidates(np.asarray(q, dtype=float), names, wrench, allowed)


def reading_derivatives(
    nominal: NominalModel,  # the model, whose live parameters come first
    config: CellConfig,
    of: Candidates,
    more: tuple[Effect, ...],  # effects that are not in the model
    scale: Floats,  # (P,) what one unit of each parameter is, SI
) -> Iterator[ReadingDerivatives]:
    """Yield derivatives and covariances of candidates, some poses at a time."""
    model, m, loads = nominal.model, nominal.elements, len(of.loads)
    states, each = nominal.arrivals(of.states()), nominal.each
    live = np.concatenate([nominal.live, np.arange(model.size, model.size + sizes(more))])
    step = max(CHUNK // (loads * each), 1)
    for start in range(0, len(of), step):
        rows = slice(start, min(start + step, len(of)))
        count = rows.stop - rows.start
        per_pose = loads * each
        p = model.predict(states[slice(rows.start * per_pose, rows.stop * per_pose)], nominal.theta)
        jacobian = model.jacobian_of((*model.effects, *more), p, nominal.theta, nominal.m, live)
        covariance = arrival_covariance(nominal, config, p)
        yield ReadingDerivatives(
            rows,
            (jacobian * scale).reshape(count, loads, m, len(scale)),
            covariance.reshape(count, loads, m, m),
        )


def sizes(effects: tuple[Effect, ...]) -> int:
    """Return the number of parameters of effects."""
    return sum(len(e.parameters) for e in effects)


def absolute_rows(of: ReadingDerivatives) -> Floats:
    """Whitened derivatives S⁻¹ J (N, 1 + L, m, P) of single readings, V = S Sᵀ."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(of.covariance), of.jacobian))


def deflection_rows(of: ReadingDerivatives, which: Ints, loads: tuple[int, ...]) -> Floats:
    """Whitened derivatives (N, S·m, P) of S deflections that share one unloaded reading.

    Block (i, j) of their covariance is δ_ij V_i + V_u: the unloaded reading's error is in all.

    which: poses, of those in `of`; loads: S indices of loads, 1 to L.
    """
    jacobian, v = of.jacobian[which], of.covariance[which]
    count, _, m, size = jacobian.shape
    each, taken = np.arange(len(loads)), list(loads)
    height = len(loads) * m
    change = (jacobian[:, taken] - jacobian[:, :1]).reshape(count, height, size)
    shape = (count, len(loads), m, len(loads), m)
    shared = np.broadcast_to(v[:, 0][:, None, :, None, :], shape).copy()
    shared[:, each, :, each, :] += np.moveaxis(v[:, taken], 1, 0)
    covariance = shared.reshape(count, height, height)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), change))


def arrival_covariance(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """Covariance of all that is read in one arrival of the arm: of its targets together.

    They have the arm's repeatability in common: block (i, j) is δ_ij V_instrument + F_i F_jᵀ with
    F = R J Σ_q^½ (see `reading_covariance`).

    nominal: the model, with the tracker in its place; config: `[tracker]`, `[acquire]` and
    `[repeatability]`; predicted: N·T states, the T readings of one arrival in succession.

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

    nominal: the model, with the tracker in its place; config: `[tracker]`, `[acquire]` and
    `[repeatability]`; predicted: N states.

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
