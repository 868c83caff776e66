"""Campaigns of several observers, measured on the mechanics' own arm."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config.sections import Point
from hilcal.drivers.simulated.injected_effects import hide_effect
from hilcal.drivers.simulated.world import World
from hilcal.readings.covariance import INSTRUMENT_AND_ARM  # noqa: F401 - for the tests
from hilcal.readings.readings import ObserverName, Readings
from hilcal.robot import se3
from tests.support.campaigns import cell_of, configuration, plan, world_of

STD = 1e-5
POINTS = {
    "A": (1.4, 0.3, -0.4),
    "B": (-0.6, 1.5, 0.1),
    "C": (-0.9, -1.1, 0.9),
    "D": (0.4, -1.6, -0.2),
}
NORMAL = np.array([0.3, -0.2, 0.93]) / np.linalg.norm([0.3, -0.2, 0.93])


@dataclass(frozen=True)
class Observed:
    """The cell as it is told, the truth, and what was read."""

    cell: Cell
    world: World
    readings: Readings


def configured(points=None, gauges=None):
    update = {"points": dict(points or {}), "gauges": dict(gauges or {})}
    return configuration().model_copy(update=update)


def observed(
    who, seed, *, poses=12, cell=None, effect=None, strength=3.0, base=False, alternate=False
):
    """Measure every state of a plan by observers: "S1", "S2" stations, "A" to "D" points, "G"."""
    cell, rng, p = cell or cell_of(), np.random.default_rng(seed), plan(poses, seed)
    world = world_of(cell, rng)
    if effect is not None:
        kept = {"pose": p.pose, "cycle": p.cycle, "world": world}
        world = hide_effect(effect, cell, p.states, strength, "absolute", rng, **kept)
    if base:
        world = replace(world, registration=np.eye(4), station=se3.matrix(np.eye(3), np.ones(3)))
    slip = world.joint_std * rng.standard_normal(p.states.q.shape)
    at = world.ideal_readings(p.states, slip).position
    parts, count = [], len(p.pose)
    names = []
    for k, name in enumerate(who):
        rows = np.flatnonzero(p.pose % len(who) == k) if alternate else np.arange(count)
        value, cov = np.zeros((len(rows), 3)), np.zeros((len(rows), 3, 3))
        if name in POINTS:
            kind, true = "point", np.linalg.norm(at[rows] - POINTS[name], axis=1)
        elif name.startswith("G"):
            kind, true = "gauge", at[rows] @ NORMAL - 0.2
        else:
            kind, true = "station", np.zeros(0)
        if kind == "station":
            turn = se3.rotation(np.array([0.1, -0.2, 1.1 * (k + 1)]))
            there = at[rows] if k == 0 else at[rows] @ turn.T + [0.4, 1.9 * k, 0.3]
            noise = world.noise.covariance(there, 3)
            value, cov = there, noise
            value = value + np.einsum(
                "nij,nj->ni", np.linalg.cholesky(cov), rng.standard_normal(there.shape)
            )
        else:
            value[:, 0] = true + STD * rng.standard_normal(len(rows))
            cov[:, 0, 0] = STD**2
        names.append(ObserverName(kind, name))
        parts.append((rows, np.full(len(rows), k), value, cov))
    rows, number, value, cov = (np.concatenate(x) for x in zip(*parts, strict=True))
    order = np.lexsort((number, rows))
    rows, number, value, cov = rows[order], number[order], value[order], cov[order]
    cov = 0.5 * (cov + np.swapaxes(cov, 1, 2))
    readings = Readings(
        states=replace(p.states[rows], observer=number),
        pose=p.pose[rows],
        load=p.load[rows],
        cycle=p.cycle[rows],
        value=value,
        covariance=cov,
        load_names=p.load_names,
        pose_names=tuple(f"p{k}" for k in range(int(p.pose.max()) + 1)),
        observers=tuple(names),
    )
    return Observed(cell, world, readings)


def base_cell(points=None, gauges=None):
    """The demo's cell with descriptions of points and gauges."""
    return replace(cell_of(), config=configured(points, gauges))


def stated(names):
    """Points whose place is stated."""
    return {name: Point(position_m=POINTS[name]) for name in names}
