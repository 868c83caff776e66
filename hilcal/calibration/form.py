"""The form of deviations that the compiled kernel evaluates, and effects brought into it.

See `compiled` for the form. An effect is asked for its deviation at random states and wrenches, and
taken where the form gives the same.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilcal.effects.protocol import Effect, Situation
from hilcal.robot.chain import Deviation
from hilcal.types import Floats

TURN = 2 * np.pi
"""Angles of the tables reach from −TURN to TURN."""
NODES = 16385
"""Nodes of a table over angles: 120 waves per turn with amplitudes of 0.1 mrad are met to 1e-11."""
TORQUE_NODES = 40001
TORQUES = 3.0
"""Tables over torques reach to so many times the joint's limit."""
TRIALS = 64
EXACT = 1e-12
"""How far the form may be off, rad and m, for an effect to count as of that form."""


@dataclass(slots=True, eq=False)
class CompiledForm:
    """The sum of the effects so far."""

    a: Floats
    linear: Floats
    by_wrench: Floats
    b: Floats
    compliance: Floats
    by_angle: Floats
    by_torque: Floats
    torque: Floats
    by_values: Floats
    soft: Floats
    gain: Floats
    bias: Floats

    @classmethod
    def empty(cls, n: int) -> "CompiledForm":
        """Return the form of an arm of n joints without any effect."""
        return cls(
            np.zeros(n), np.zeros((n, n)), np.zeros((n, 6)), np.zeros((n + 1, 6)),
            np.zeros((n + 1, 6, 6)), np.zeros((0, NODES)), np.zeros((0, TORQUE_NODES)), np.ones(n),
            np.zeros((0, 6, n)), np.zeros((0, NODES)), np.zeros((0, 6)), np.zeros(6),
        )  # fmt: skip

    def laws(self) -> tuple[Floats, ...]:
        """Return constants and compliances, as the kernel takes them."""
        return self.a, self.linear, self.by_wrench, self.b, self.compliance, self.by_values

    def tables(self) -> tuple[Any, ...]:
        """Return the tables with their slopes, as the kernel takes them."""
        angle = np.linspace(-TURN, TURN, NODES)
        steps = 2 * self.torque / (TORQUE_NODES - 1)
        slopes, soft_slopes = (
            _spline(angle, x, axis=1)(angle, 1) if len(x) else np.zeros_like(x)
            for x in (self.by_angle, self.soft)
        )
        torque_slopes = np.zeros_like(self.by_torque)
        for j, values in enumerate(self.by_torque):
            grid = np.linspace(-self.torque[j], self.torque[j], TORQUE_NODES)
            torque_slopes[j] = _spline(grid, values)(grid, 1)
        return (
            self.by_angle, packed(slopes), -TURN, float(angle[1] - angle[0]),
            self.by_torque, torque_slopes, -self.torque, steps, self.soft, packed(soft_slopes),
        )  # fmt: skip

    def take(self, e: Effect, theta: Floats, s: Situation) -> bool:
        """Add an effect; False where it has another form."""
        if e.wrench_change(theta, s) is not None:
            return self._sensed(e, theta, s)
        found = e.deviation(theta, s)
        if all(x is None for x in (found.dq, found.twist, found.base, found.target)):
            return True  # what instruments do moves no tool
        if e.needs:
            return False
        return self._elastic(e, theta, s) if e.elastic else self._rigid(e, theta, s)

    def _elastic(self, e: Effect, theta: Floats, s: Situation) -> bool:
        n = s.angle.shape[1]
        found = e.deviation(theta, s)
        if not _only(found):
            return False
        by_wrench, compliance = np.zeros((n, 6)), np.zeros((n + 1, 6, 6))
        for c in range(6):
            unit = np.zeros_like(s.wrench)
            unit[:, :, c] = 1.0
            d = e.deviation(theta, replace(s, wrench=unit))
            if d.dq is not None:
                by_wrench[:, c] = d.dq[0]
            if d.twist is not None:
                compliance[:, :, c] = d.twist[0]
        dq = np.einsum("je,nje->nj", by_wrench, s.wrench[:, :n])
        twist = np.einsum("kef,nkf->nke", compliance, s.wrench)
        if _same(found, dq, twist):
            self.by_wrench += by_wrench
            self.compliance += compliance
            return True
        if found.twist is not None or found.dq is None:
            return False
        return self._soft(e, theta, s, found.dq) or self._by_torque(e, theta, s, found)

    def _sensed(self, e: Effect, theta: Floats, s: Situation) -> bool:
        """Take what a force sensor on the flange adds: R (bias + gain Rᵀ w)."""
        change, r = e.wrench_change(theta, s), s.chain.rotation[-1]
        if change is None:
            return False
        w, y = (
            np.einsum("nij,nki->nkj", r, x.reshape(-1, 2, 3)).reshape(-1, 6)
            for x in (s.states.wrench, change)
        )
        rows = np.hstack([w, np.ones((TRIALS, 1))])
        solved = np.linalg.lstsq(rows, y, rcond=None)[0]
        if np.abs(rows @ solved - y).max() > 1e3 * EXACT * max(np.abs(y).max(), 1.0):
            return False
        self.gain = packed(solved[:-1].T + (self.gain if len(self.gain) else 0.0))
        self.bias = self.bias + solved[-1]
        return True

    def _soft(self, e: Effect, theta: Floats, s: Situation, dq: Floats) -> bool:
        """Take compliances of joints that depend on the joint's own angle."""
        angle, n = np.linspace(-TURN, TURN, NODES), s.angle.shape[1]
        unit = np.zeros_like(s.wrench)
        unit[:, :n, 5] = 1.0
        parts = np.array_split(angle, 16)
        own = np.concatenate([_at(e, theta, replace(s, wrench=unit), part) for part in parts])
        waves = _spline(angle, own)
        here = np.stack([waves(s.angle[:, j])[:, j] for j in range(n)], axis=1)
        if not _same(Deviation(dq=dq), here * s.wrench[:, :n, 5], None):
            return False
        self.soft = packed(own.T + (self.soft if len(self.soft) else 0.0))
        return True

    def _by_torque(self, e: Effect, theta: Floats, s: Situation, found: Deviation) -> bool:
        """Take displacements that depend on the joint's own torque alone."""
        n = s.angle.shape[1]
        torque = TORQUES * np.where(np.isfinite(s.cell.arm.torque_max), s.cell.arm.torque_max, 1e3)
        share = np.linspace(-1.0, 1.0, TORQUE_NODES)
        grid = repeated(s, TORQUE_NODES)
        wrench = np.zeros((TORQUE_NODES, n + 1, 6))
        wrench[:, :n, 5] = share[:, None] * torque
        values = e.deviation(theta, replace(grid, wrench=wrench)).dq
        if values is None or found.dq is None:
            return False
        splines = [_spline(share * torque[j], values[:, j]) for j in range(n)]
        dq = np.stack([splines[j](s.wrench[:, j, 5]) for j in range(n)], axis=1)
        if not _same(found, dq, None):
            return False
        self.torque = torque
        self.by_torque = values.T + (self.by_torque if len(self.by_torque) else 0.0)
        self.by_torque = packed(self.by_torque)
        return True

    def _rigid(self, e: Effect, theta: Floats, s: Situation) -> bool:
        found = e.deviation(theta, s)
        if not _only(found):
            return False
        twist = np.zeros(self.b.shape) if found.twist is None else found.twist[0]
        n = s.angle.shape[1]
        if found.dq is None and found.twist is not None:
            rows = np.hstack([s.values, np.ones((TRIALS, 1))])
            flat = np.broadcast_to(found.twist, (TRIALS, *twist.shape)).reshape(TRIALS, -1)
            solved = np.linalg.lstsq(rows, flat, rcond=None)[0]
            if np.ptp(flat, axis=0).max() <= EXACT:
                solved[:-1], solved[-1] = 0.0, flat[0]
            if np.abs(rows @ solved - flat).max() > EXACT:
                return False
            self.b += solved[-1].reshape(twist.shape)
            if solved[:-1].any():
                by_values = np.moveaxis(solved[:-1].reshape(n, *twist.shape), 0, -1)
                self.by_values = packed(
                    by_values + (self.by_values if len(self.by_values) else 0.0)
                )
            return True
        angle = np.linspace(-TURN, TURN, NODES)
        own = np.concatenate([_at(e, theta, s, part) for part in np.array_split(angle, 16)])
        waves = _spline(angle, own)
        each = np.stack([waves(s.angle[:, j])[:, j] for j in range(n)], axis=1)
        # What is left may follow other joints in proportion.
        left = found.dq - each
        rows = np.hstack([s.angle, np.ones((TRIALS, 1))])
        solved = np.linalg.lstsq(rows, left, rcond=None)[0]
        if np.abs(left).max() < EXACT:
            solved = np.zeros_like(solved)
        dq = each + rows @ solved
        if not _same(found, dq, np.broadcast_to(twist, (TRIALS, *twist.shape))):
            return False
        self.b += twist
        self.a += solved[-1]
        self.linear += solved[:-1].T
        self.by_angle = packed(own.T + (self.by_angle if len(self.by_angle) else 0.0))
        return True


def given_the_columns(e: Effect, theta: Floats, s: Situation) -> bool:
    """Whether an effect is a constant, or a compliance of joints, once its columns are known."""
    turned = np.roll(s.angle, 1, axis=0)
    other = replace(s, states=replace(s.states, q=turned), angle=turned)
    n = s.angle.shape[1]
    unit, found = np.zeros_like(s.wrench), e.deviation(theta, s)
    unit[..., 5] = 1.0
    if e.elastic:
        here, there = (e.deviation(theta, replace(x, wrench=unit)) for x in (s, other))
        if found.twist is not None or here.dq is None or there.dq is None or not _only(found):
            return False
        return _same(there, here.dq, None) and _same(found, here.dq * s.wrench[:, :n, 5], None)
    if not _only(found) or (found.dq is None and found.twist is None):
        return False
    dq = np.zeros((TRIALS, n)) if found.dq is None else found.dq
    return _same(e.deviation(theta, other), dq, found.twist)


def _spline(x: Floats, y: Floats, axis: int = 0) -> Any:
    from scipy.interpolate import CubicSpline  # slow to import

    return CubicSpline(x, y, axis=axis)


def _at(e: Effect, theta: Floats, s: Situation, angle: Floats) -> Floats:
    """(K, n) displacements with all joints at the same angles (K,)."""
    grid = repeated(s, len(angle))
    q = np.repeat(angle[:, None], s.angle.shape[1], axis=1)
    moved = replace(grid, states=replace(grid.states, q=q), angle=q)
    found = e.deviation(theta, moved).dq
    return np.zeros_like(q) if found is None else found


def repeated(s: Situation, count: int) -> Situation:
    """Return the first state, so many times."""
    rows = np.zeros(count, dtype=np.int64)
    chain = replace(
        s.chain,
        rotation=s.chain.rotation[:, rows],
        position=s.chain.position[:, rows],
        com=s.chain.com[:, rows],
        twist=None if s.chain.twist is None else s.chain.twist[:, rows],
    )
    load = replace(s.load, wrench=s.load.wrench[rows])
    return replace(
        s, states=s.states[rows], angle=s.angle[rows], chain=chain, wrench=s.wrench[rows], load=load
    )


def _only(d: Deviation) -> bool:
    """Whether nothing but joints and slots moves."""
    return all(f is None for f in (d.base, d.station, d.target, d.scale, d.observer))


def _same(d: Deviation, dq: Floats, twist: Floats | None) -> bool:
    """Whether a deviation is what the form makes of it."""
    zero = 0.0
    a = (zero if d.dq is None else d.dq) - dq
    b = (zero if d.twist is None else d.twist) - (zero if twist is None else twist)
    size = max(np.abs(dq).max(initial=0.0), 1e-3)
    return bool(np.abs(a).max() <= 1e3 * EXACT * size and np.abs(b).max(initial=0.0) <= EXACT)


def packed(x: Floats | np.ndarray) -> Floats:
    """Return a copy of one layout: others, and those that are read-only, would be compiled anew."""
    return np.array(x, dtype=float, order="C")
