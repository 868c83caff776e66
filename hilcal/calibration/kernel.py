"""One point at a time, compiled: the deviated chain at equilibrium, and its inverse.

The equations of `robot.chain`, `robot.statics` and `compensation`, for models whose effects
`compiled` could convert to the form

    dq_j = a_j + T_j(q_j) + Σ_i L_ji q_i + c_j · w_j + (s_j + P_j(q_j)) τ_j + G_j(τ_j)
    ξ_k = b_k + Q_k q + C_k w_k

w_k is the wrench through slot k, τ_j the torque about joint j; a, b and s may differ from point to
point. Chain, wrenches and Newton step are iterated together: every round reduces their errors about
10³ times. numba makes machine code when a process first needs it.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from hilcal.types import Floats

Arrays = tuple[Floats, ...]

ROUNDS = 40  # rounds at most; five are usual
SETTLED = 1e-12  # change of the deviations that ends the rounds, m and rad


@njit(cache=True)
def _interpolate(x: float, low: float, step: float, table: Floats) -> float:
    """Value of cubic polynomials (K, 4) on equal steps; linear outside."""
    k = min(max(math.floor((x - low) / step), 0), len(table) - 1)
    t = x - low - k * step
    inside = min(max(t, 0.0), step)
    a, b, c = table[k, 0], table[k, 1], table[k, 2]
    value = ((a * inside + b) * inside + c) * inside + table[k, 3]
    return float(value + ((3.0 * a * inside + 2.0 * b) * inside + c) * (t - inside))


@njit(cache=True)
def _product(a: Floats, b: Floats, out: Floats) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@njit(cache=True)
def _add_turned(r: Floats, v: Floats, out: Floats) -> None:
    for i in range(3):
        out[i] += r[i, 0] * v[0] + r[i, 1] * v[1] + r[i, 2] * v[2]


@njit(cache=True)
def _add_cross(a: Floats, b: Floats, out: Floats) -> None:
    out[0] += a[1] * b[2] - a[2] * b[1]
    out[1] += a[2] * b[0] - a[0] * b[2]
    out[2] += a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _exp(twist: Floats, r: Floats, v: Floats) -> None:
    """Write rotation (3, 3) and translation (3,) of exp of a twist."""
    x, y, z = twist[3], twist[4], twist[5]
    t2 = x * x + y * y + z * z
    if t2 < 1e-8:
        a, b, c = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0
    else:
        t = math.sqrt(t2)
        a, b, c = math.sin(t) / t, (1.0 - math.cos(t)) / t2, (t - math.sin(t)) / (t2 * t)
    r[0, 0], r[0, 1], r[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    r[1, 0], r[1, 1], r[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    r[2, 0], r[2, 1], r[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    u, w, q = twist[0], twist[1], twist[2]
    cx, cy, cz = y * q - z * w, z * u - x * q, x * w - y * u
    v[0] = u + b * cx + c * (y * cz - z * cy)
    v[1] = w + b * cy + c * (z * cx - x * cz)
    v[2] = q + b * cz + c * (x * cy - y * cx)


@njit(cache=True)
def _chain(
    arm: Arrays, dq: Floats, twist: Floats, q: Floats, frames: Arrays, scratch: Floats
) -> None:
    """Write frames of the slots, axes of the bodies and their centres of mass."""
    (link_r, link_p, coms), (rotation, position, body, com) = arm, frames
    n = len(q)
    step_r, frame, previous = scratch[0], scratch[1], scratch[2]
    step_p = scratch[3, 0]
    for i in range(3):
        for j in range(3):
            previous[i, j] = 1.0 if i == j else 0.0
    for k in range(n + 1):
        p = position[k]
        for i in range(3):
            p[i] = 0.0 if k == 0 else position[k - 1, i]
        _add_turned(previous, link_p[k], p)
        if twist[k].any():
            _product(previous, link_r[k], frame)
            _exp(twist[k], step_r, step_p)
            _add_turned(frame, step_p, p)
            _product(frame, step_r, rotation[k])
        else:
            _product(previous, link_r[k], rotation[k])
        if k < n:
            angle = q[k] + dq[k]
            co, si = math.cos(angle), math.sin(angle)
            r, previous = rotation[k], body[k]
            for i in range(3):
                previous[i, 0] = r[i, 0] * co + r[i, 1] * si
                previous[i, 1] = r[i, 1] * co - r[i, 0] * si
                previous[i, 2] = r[i, 2]
                com[k, i] = p[i]
            _add_turned(previous, coms[k], com[k])


@njit(cache=True)
def _add_sensed(
    gain: Floats, bias: Floats, r: Floats, applied: Floats, f: Floats, t: Floats
) -> None:
    """Add R (bias + gain Rᵀ w) to force and moment, R the flange's orientation."""
    for k in range(6):
        error = bias[k]
        for j in range(6):
            block = 3 * (j // 3)
            for i in range(3):
                error += gain[k, j] * r[i, j - block] * applied[block + i]
        for i in range(3):
            if k < 3:
                f[i] += r[i, k] * error
            else:
                t[i] += r[i, k - 3] * error


@njit(cache=True)
def _wrenches(load: Any, applied: Floats, frames: Arrays, out: Floats, scratch: Floats) -> None:
    """Write the wrench (n + 1, 6) through each slot, slot axes."""
    rotation, position, body, com = frames
    point, tool_mass, tool_com, gravity, masses, moments, gain, bias = load
    n = len(com)
    f, t, lever, weight = scratch[0, 0], scratch[0, 1], scratch[0, 2], scratch[1, 0]
    f[:] = applied[:3]
    t[:] = applied[3:]
    if len(gain) > 0:
        _add_sensed(gain, bias, rotation[n], applied, f, t)
    lever[:] = 0.0
    _add_turned(rotation[n], point, lever)
    _add_cross(lever, f, t)
    lever[:] = 0.0
    for i in range(3):
        weight[i] = tool_mass * gravity[i]
        f[i] += weight[i]
    _add_turned(rotation[n], tool_com, lever)
    _add_cross(lever, weight, t)
    for k in range(n, -1, -1):
        if k < n:
            for i in range(3):
                lever[i] = position[k + 1, i] - position[k, i]
            _add_cross(lever, f, t)
            for i in range(3):
                lever[i] = masses[k] * (com[k, i] - position[k, i])
            _add_turned(body[k], moments[k], lever)
            _add_cross(lever, gravity, t)
            for i in range(3):
                f[i] += masses[k] * gravity[i]
        r = rotation[k]
        for i in range(3):
            out[k, i] = r[0, i] * f[0] + r[1, i] * f[1] + r[2, i] * f[2]
            out[k, 3 + i] = r[0, i] * t[0] + r[1, i] * t[1] + r[2, i] * t[2]


@njit(cache=True)
def _deviations(
    laws: Arrays,
    tables: Any,
    by_point: tuple[Floats, Floats, Floats],
    q: Floats,
    wrench: Floats,
    dq: Floats,
    twist: Floats,
) -> float:
    """Write the deviations; return their largest change."""
    a, linear, by_wrench, b, compliance, by_values = laws
    point_dq, point_twist, point_compliance = by_point
    angle_low, angle_step, torque_low, torque_step = tables[0]
    by_angle, by_torque, angle_compliance = tables[1]
    n, change = len(q), 0.0
    for j in range(n):
        new = a[j] + point_dq[j] + point_compliance[j] * wrench[j, 5]
        for i in range(n):
            new += linear[j, i] * q[i]
        for e in range(6):
            new += by_wrench[j, e] * wrench[j, e]
        if len(by_angle) > 0:
            new += _interpolate(q[j], angle_low, angle_step, by_angle[j])
        if len(angle_compliance) > 0:
            new += _interpolate(q[j], angle_low, angle_step, angle_compliance[j]) * wrench[j, 5]
        if len(by_torque) > 0:
            new += _interpolate(wrench[j, 5], torque_low[j], torque_step[j], by_torque[j])
        change = max(change, abs(new - dq[j]))
        dq[j] = new
    for k in range(n + 1):
        for e in range(6):
            new = b[k, e] + point_twist[k, e]
            if len(by_values) > 0:
                for i in range(n):
                    new += by_values[k, e, i] * q[i]
            for f in range(6):
                new += compliance[k, e, f] * wrench[k, f]
            change = max(change, abs(new - twist[k, e]))
            twist[k, e] = new
    return change


@njit(cache=True)
def _solve(matrix: Floats, right: Floats) -> bool:
    """Solve a small system in place by elimination with pivots; False where it is singular."""
    n = len(right)
    for c in range(n):
        best = c + np.argmax(np.abs(matrix[c:, c]))
        if abs(matrix[best, c]) < 1e-12:
            return False
        for k in range(n):
            matrix[c, k], matrix[best, k] = matrix[best, k], matrix[c, k]
        right[c], right[best] = right[best], right[c]
        for r in range(c + 1, n):
            factor = matrix[r, c] / matrix[c, c]
            for k in range(c, n):
                matrix[r, k] -= factor * matrix[c, k]
            right[r] -= factor * right[c]
    for c in range(n - 1, -1, -1):
        for k in range(c + 1, n):
            right[c] -= matrix[c, k] * right[k]
        right[c] /= matrix[c, c]
    return True


@njit(cache=True)
def _turn(target: Floats, r: Floats, out: Floats) -> float:
    """Write the rotation vector of target rᵀ, for angles below π; return its length."""
    trace = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i] = 0.0
        for c in range(3):
            trace += target[i, c] * r[i, c]
            out[i] += 0.5 * (target[k, c] * r[j, c] - target[j, c] * r[k, c])
    s = math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    if s < 1e-9:
        return s
    angle = math.atan2(s, 0.5 * (trace - 1.0))
    for i in range(3):
        out[i] *= angle / s
    return angle


@njit(cache=True, nogil=True)
def invert_all(
    arm: Arrays,
    load: Any,
    laws: Arrays,
    tables: Any,
    by_point: tuple[Floats, Floats, Floats],
    tool: Floats,
    reach: float,
    max_joint_step: float,
    tolerance: float,
    q: Floats,
    applied: Floats,
    rotations: Floats,
    positions: Floats,
    newton: bool,
    out_q: Floats,
    residual: Floats,
) -> None:
    """Invert N points; without `newton` write the poses at q into `rotations` and `positions`.

    Args:
        tool: (4, 4) T_flange_tool.
        by_point: displacements (N, n), twists (N, n + 1, 6) and compliances (N, n) of the points;
            one row where all points have the same.
        q: (N, n) joint values to start from, rad.
        applied: (N, 6) wrenches at the load point, base axes.
        rotations: (N, 3, 3) target orientations.
        positions: (N, 3) target positions, m.
        out_q: (N, n) solved joint values.
        residual: (N, 2) m and rad.
    """
    count, n = q.shape
    rotation, position = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    frames = rotation, position, np.empty((n, 3, 3)), np.empty((n, 3))
    wrench, dq, twist = np.empty((n + 1, 6)), np.empty(n), np.empty((n + 1, 6))
    jacobian, e, joints = np.empty((n, n)), np.empty(n), np.empty(n)
    scratch, r = np.empty((4, 3, 3)), np.empty((3, 3))
    p, lever, column = np.empty(3), np.empty(3), np.empty(3)
    for point in range(count):
        joints[:] = q[point]
        at_point = (
            by_point[0][min(point, len(by_point[0]) - 1)],
            by_point[1][min(point, len(by_point[1]) - 1)],
            by_point[2][min(point, len(by_point[2]) - 1)],
        )
        dq[:] = 0.0
        twist[:] = 0.0
        for _ in range(ROUNDS):
            _chain(arm, dq, twist, joints, frames, scratch)
            _product(rotation[n], tool[:3, :3], r)
            p[:] = position[n]
            _add_turned(rotation[n], tool[:3, 3], p)
            _wrenches(load, applied[point], frames, wrench, scratch)
            change = _deviations(laws, tables, at_point, joints, wrench, dq, twist)
            if not newton:
                rotations[point] = r
                positions[point] = p
                if change < SETTLED:
                    break
                continue
            far = 0.0
            for i in range(3):
                e[i] = positions[point, i] - p[i]
                far += e[i] * e[i]
                e[i] /= reach
            residual[point, 0] = math.sqrt(far)
            residual[point, 1] = _turn(rotations[point], r, e[3:])
            if change < SETTLED and max(residual[point, 0], residual[point, 1]) < tolerance:
                break
            for j in range(n):
                for i in range(3):
                    lever[i] = (p[i] - position[j, i]) / reach
                    jacobian[3 + i, j] = rotation[j, i, 2]
                    column[i] = 0.0
                _add_cross(rotation[j, :, 2], lever, column)
                jacobian[:3, j] = column
            if not _solve(jacobian, e):
                break
            joints += min(1.0, max_joint_step / max(np.abs(e).max(), 1e-300)) * e
        out_q[point] = joints
