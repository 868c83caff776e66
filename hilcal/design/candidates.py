"""Candidate states: derivative and covariance of their readings."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.noise_model import arrival_covariance
from hilcal.design.nominal_model import NominalModel, nominal_states
from hilcal.effects.protocol import Effect
from hilcal.readings.readings import States
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

CHUNK = 4096
"""States that are evaluated at once. A choice, of memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """N poses, each of them unloaded and under those of the L loads that it can bear.

    Attributes:
        q: (N, n) joint angles, rad.
        loads: 1 + L names, "none" first.
        wrench: (1 + L, 6) at the load point, base axes, N and N·m.
        allowed: (N, 1 + L) which states may be taken.
    """

    q: Floats
    loads: tuple[str, ...]
    wrench: Floats
    allowed: Bools

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
    """What would be read of a chunk of N poses under 1 + L loads.

    Attributes:
        rows: which poses.
        jacobian: (N, 1 + L, m, P) derivative by the parameters, in their scales; m are the elements
            of all targets that are read in one arrival.
        covariance: (N, 1 + L, m, m) of them.
    """

    rows: slice
    jacobian: Floats
    covariance: Floats


def candidates(
    nominal: NominalModel, config: CellConfig, q: Floats, allowed: Bools | None = None
) -> Candidates:
    """Return the states of poses under the loads of a configuration.

    Args:
        nominal: the model that is planned for.
        q: (N, n) joint angles, rad.
        allowed: (N, 1 + L) which states may be taken, unloaded first; all by default.
    """
    gravity = nominal.cell.gravity
    names = (UNLOADED, *(load.name for load in config.loads))
    wrench = np.array([np.zeros(6), *(load.wrench(gravity) for load in config.loads)])
    if allowed is None:
        allowed = np.ones((len(q), len(names)), dtype=np.bool_)
    return Candidates(np.asarray(q, dtype=float), names, wrench, allowed)


def reading_derivatives(
    nominal: NominalModel,
    config: CellConfig,
    of: Candidates,
    more: tuple[Effect, ...],
    scale: Floats,
) -> Iterator[ReadingDerivatives]:
    """Yield derivatives and covariances of candidates, some poses at a time.

    Args:
        nominal: the model, whose live parameters come first.
        more: effects that are not in the model.
        scale: (P,) what one unit of each parameter is, SI.
    """
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

    Args:
        which: poses, of those in `of`.
        loads: S indices of loads, 1 to L.
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
