"""Static wrenches through each slot of the deviated arm, and their change by its motion.

Geometric stiffness: all beyond slot j is displaced by v, at p_j, and turned by ω; forces, weights
and the load's moment m keep their directions in base axes. With f_k the force through slot k and
D_k = Σ l fᵀ − (Σ l · f) I, summed over all forces beyond slot k (l: lever from p_k), the components
in slot axes change by

    k < j:  δf_k = 0,             δt_k = v × f_j + D_j ω         (slot k stands still)
    k ≥ j:  δf_k = −ω × f_k,      δt_k = D_kᵀ ω − ω × m          (slot k moves along)

The displacement of joint j + 1 is a turn about z_j, of a prismatic joint a shift along z_j; slot j
stands still. The code computes the transpose: the gradient, by the motions, of a linear form of the
slot wrenches. Source: Chen and Kao, *Conservative congruence transformation for joint and Cartesian
stiffness matrices of robotic hands and fingers*, Int. J. Robotics Research 19 (2000) 835-847.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import Chain
from hilcal.robot.se3 import empty, zeros
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Load:
    """The load and the tool of an arm."""

    wrench: Floats  # (N, 6) force and moment on the tool at the load point, base axes, N, N·m
    point: Floats  # (3,) or (N, 3) load point, flange axes, m
    tool_mass: float  # kg
    tool_com: Floats  # (3,) centre of mass, flange axes, m
    gravity: Floats  # (3,) acceleration, base axes, m/s²
    first_moment: Floats | None = None  # (n, 3) of the bodies, added to those of the arm, kg·m


def slot_wrenches(arm: Arm, chain: Chain, load: Load) -> Floats:
    """Return the wrench (N, n + 1, 6) of all beyond slot k, at its origin, in its axes.

        f_k = f_{k+1} + m_{k+1} g
        t_k = t_{k+1} + (p_{k+1} − p_k) × f_{k+1} + (c_{k+1} − p_k) × m_{k+1} g

    at the configuration of `chain`; an additional first moment s_{k+1} of body k + 1 adds
    s_{k+1} × g to t_k. Element (k, 5) for k < n is the static torque τ_{k+1} of load and weight
    about the axis of joint k + 1, element (k, 2) the force along it (`Arm.joint_components`).
    """
    n, count = arm.n, len(load.wrench)
    weights = arm.masses[:, None] * load.gravity
    position, com = np.swapaxes(chain.position, 0, 1), np.swapaxes(chain.com, 0, 1)
    force, weight = load.wrench[:, :3], load.tool_mass * load.gravity
    f, t = empty(count, n + 1, 3), empty(count, n + 1, 3)
    f[:, n] = force + weight
    for k in range(n - 1, -1, -1):
        f[:, k] = f[:, k + 1] + weights[k]
    t[:, n] = load.wrench[:, 3:] + se3.cross(chain.point(load.point) - position[:, n], force)
    if weight.any():
        t[:, n] += se3.cross(chain.point(load.tool_com) - position[:, n], weight)
    # of all joints at once: with few states most of the time goes into calls
    by_force = se3.cross(position[:, 1:] - position[:, :n], f[:, 1:])
    by_weight = se3.cross(com - position[:, :n], weights)
    for k in range(n - 1, -1, -1):
        t[:, k] = t[:, k + 1] + by_force[:, k] + by_weight[:, k]
        if load.first_moment is not None:
            moment = se3.apply(body_axes(arm, chain, k), load.first_moment[k])
            t[:, k] += se3.cross(moment, load.gravity)
    out = empty(count, n + 1, 6)
    np.einsum("knji,nkj->nki", chain.rotation, f, out=out[..., :3])
    np.einsum("knji,nkj->nki", chain.rotation, t, out=out[..., 3:])
    return out


def slot_wrench_change(chain: Chain, force: Floats, moment: Floats) -> Floats:
    """Return the change (N, P, n + 1, 6) of slot wrenches by force and moment at the flange."""
    slots, count = chain.position.shape[:2]
    out = empty(count, force.shape[1], slots, 6)
    for k in range(slots):
        lever = (chain.position[-1] - chain.position[k])[:, None, :]
        t = moment + se3.cross(lever, force)
        np.einsum("nji,npj->npi", chain.rotation[k], force, out=out[:, :, k, :3])
        np.einsum("nji,npj->npi", chain.rotation[k], t, out=out[:, :, k, 3:])
    return out


def load_wrench_change(chain: Chain, load: Load, change: Floats) -> Floats:
    """Return the change (N, P, n + 1, 6) of slot wrenches by that of the load (N, P, 6)."""
    lever = (chain.point(load.point) - chain.position[-1])[:, None, :]
    force = change[..., :3]
    return slot_wrench_change(chain, force, change[..., 3:] + se3.cross(lever, force))


def first_moment_change(arm: Arm, chain: Chain, gravity: Floats) -> Floats:
    """Return the change (N, 3 n, n + 1, 6) of slot wrenches by unit first moments of the bodies.

    A unit along axis e of body k + 1 is a moment (R_k e) × g that slots 0..k carry.
    """
    out = zeros(chain.position.shape[1], 3 * arm.n, arm.n + 1, 6)
    for k in range(arm.n):
        moment = se3.cross(np.swapaxes(body_axes(arm, chain, k), 1, 2), gravity)
        for slot in range(k + 1):
            part = out[:, 3 * k : 3 * k + 3, slot, 3:]
            np.einsum("nji,npj->npi", chain.rotation[slot], moment, out=part)
    return out


def body_axes(arm: Arm, chain: Chain, k: int) -> Floats:
    """Return the orientation (N, 3, 3) of body k + 1, base axes, from that of slot k + 1."""
    r = chain.rotation[k + 1]
    if chain.twist is not None and np.any(chain.twist[k + 1]):
        r = se3.product(r, se3.rotation(-chain.twist[k + 1, :, 3:]))
    return np.asarray(se3.product(r, arm.links[k + 1][:3, :3].T))


@dataclass(frozen=True, slots=True, eq=False)
class GeometricStiffness:
    """The quantities of a loaded chain that its geometric stiffness depends on; base axes."""

    chain: Chain
    force: list[Floats]  # (n + 1,) list of (N, 3) f_k, N
    dyad: list[Floats]  # (n + 1,) list of (N, 3, 3) D_k, N·m
    dyad_less_moment: list[Floats]  # (n + 1,) of (N, 3, 3) D_k − [m]×, N·m, m the load's moment
    dyad_axis: list[Floats]  # (n,) list of (N, 3) D_j z_j, N·m
    load_point: Floats  # (N, 3) m
    # (N, 6, 6) change of the load's wrench by the flange's motion; None for a constant wrench
    load_stiffness: Floats | None = None

    def gradient(self, form: Mapping[tuple[int, bool], Floats]) -> "MotionGradient":
        """Return the gradient, by motions, of a linear form of forces and moments of slots.

        `form` has coefficients (N, m, 3) by slot, and by whether they are of the moment.
        """
        chain, slots = self.chain, len(self.force)
        rows = next(iter(form.values())).shape[:2]
        load, moment_sums = zeros(*rows, 3), [zeros(*rows, 3)]
        by_turn = [zeros(*rows, 3) for _ in range(slots + 1)]
        for k in range(slots):
            of = {m: form[k, m] for m in (False, True) if (k, m) in form}
            base = {m: rows_times(b, chain.rotation[k], transposed=True) for m, b in of.items()}
            moment_sums.append(moment_sums[-1])
            if (by_moment := base.get(True)) is not None:
                moment_sums[-1] = moment_sums[-1] + by_moment
                by_turn[k] += rows_times(by_moment, self.dyad_less_moment[k], transposed=True)
                if self.load_stiffness is not None:
                    load += se3.cross(by_moment, (self.load_point - chain.position[k])[:, None])
            if (by_force := base.get(False)) is not None:
                by_turn[k] += se3.cross(by_force, self.force[k][:, None])
                load += by_force
        for k in range(slots - 1, -1, -1):
            by_turn[k] += by_turn[k + 1]
        flange = None
        if self.load_stiffness is not None:
            by_wrench = np.concatenate([load, moment_sums[-1]], axis=2)
            flange = rows_times(by_wrench, self.load_stiffness)
        return MotionGradient(self, moment_sums, by_turn, flange)


@dataclass(frozen=True, slots=True, eq=False)
class MotionGradient:
    """Gradient of a linear form of the slot wrenches by motions of the chain."""

    stiffness: GeometricStiffness
    # (n + 2,) sums (N, m, 3) of the moments' coefficients over the slots i < k, base axes
    moment_sums: list[Floats]
    by_turn: list[Floats]  # (n + 2,) gradients (N, m, 3) by a turn of slots i ≥ k
    flange: Floats | None  # (N, m, 6) gradient by the flange's motion through the load's wrench

    def joint(self, j: int) -> Floats:
        """Return the gradient (N, m) by the displacement of joint j + 1."""
        s, flange, moments = self.stiffness, self.flange, self.moment_sums[j + 1]
        z = s.chain.rotation[j, :, :, 2]
        if j in s.chain.slides:
            # slot j stands still; the force through it is shifted along z relative to p_j
            out = _rows_dot(moments, se3.cross(z, s.force[j]))
            return out if flange is None else out + _rows_dot(flange[..., :3], z)
        out = _rows_dot(self.by_turn[j + 1], z) + _rows_dot(moments, s.dyad_axis[j])
        if flange is not None:
            lever = s.chain.position[-1] - s.chain.position[j]
            out += _rows_dot(flange[..., 3:], z)
            out += _rows_dot(flange[..., :3], se3.cross(z, lever))
        return out

    def displacement(self, j: int) -> Floats:
        """Return the gradient (N, m, 3) by the displacement of all beyond slot j, base axes."""
        out = se3.cross(self.stiffness.force[j][:, None], self.moment_sums[j])
        return out if self.flange is None else self.flange[..., :3] + out

    def turn(self, j: int) -> Floats:
        """Return the gradient (N, m, 3) by the turn of all beyond slot j about p_j, base axes."""
        chain, flange = self.stiffness.chain, self.flange
        out = self.by_turn[j] + rows_times(self.moment_sums[j], self.stiffness.dyad[j])
        if flange is not None:
            lever = (chain.position[-1] - chain.position[j])[:, None]
            out = out + (flange[..., 3:] + se3.cross(lever, flange[..., :3]))
        return out


def geometric_stiffness(
    arm: Arm, chain: Chain, load: Load, load_stiffness: Floats | None = None
) -> GeometricStiffness:
    """Prepare the geometric stiffness of a chain under a load."""
    n, p = arm.n, chain.position
    point, weight = chain.point(load.point), load.tool_mass * load.gravity
    force = load.wrench[:, :3] + weight
    dyad = _outer(point - p[n], load.wrench[:, :3])
    dyad += _outer(chain.point(load.tool_com) - p[n], weight)
    forces, dyads = [force], [dyad]
    for k in range(n - 1, -1, -1):
        dyad = dyad + _outer(p[k + 1] - p[k], force)
        weight = arm.masses[k] * load.gravity
        dyad += _outer(chain.com[k] - p[k], weight)
        if load.first_moment is not None:
            moment = se3.apply(body_axes(arm, chain, k), load.first_moment[k])
            dyad += _outer(moment, load.gravity)
        force = force + weight
        forces.insert(0, force)
        dyads.insert(0, dyad)
    for dyad in dyads:
        trace = dyad[:, 0, 0] + dyad[:, 1, 1] + dyad[:, 2, 2]
        for axis in range(3):
            dyad[:, axis, axis] -= trace
    moment = load.wrench[:, 3:]
    turned = se3.skew(moment) if moment.any() else None
    less_moment = dyads if turned is None else [dyad - turned for dyad in dyads]
    dyad_axis = [se3.apply(dyads[j], chain.rotation[j, :, :, 2]) for j in range(n)]
    return GeometricStiffness(chain, forces, dyads, less_moment, dyad_axis, point, load_stiffness)


def rows_times(rows: Floats, matrix: Floats, *, transposed: bool = False) -> Floats:
    """Return rows (N, m, i) times matrices (N, i, j), or their transposes."""
    out = empty(*rows.shape[:2], matrix.shape[1 if transposed else 2])
    subscripts = "nmi,nji->nmj" if transposed else "nmi,nij->nmj"
    return np.asarray(np.einsum(subscripts, rows, matrix, out=out))


def rows_times_constant(rows: Floats, matrix: Floats) -> Floats:
    """Return rows (N, m, i) times one matrix (i, j), which is mostly zero."""
    if np.array_equal(matrix, np.eye(len(matrix))):
        return rows
    out = zeros(*rows.shape[:2], matrix.shape[1])
    for i, j in zip(*np.nonzero(matrix), strict=True):
        out[..., j] += rows[..., i] * matrix[i, j]
    return out


def _rows_dot(rows: Floats, vector: Floats) -> Floats:
    """Return rows (N, m, i) times vectors (N, i)."""
    return np.einsum("nmi,ni->nm", rows, vector, out=empty(*rows.shape[:2]))


def _outer(a: Floats, b: Floats) -> Floats:
    """Return a bᵀ (N, 3, 3) of a (N, 3) and b (N, 3) or (3,)."""
    return np.multiply(a[:, :, None], b[..., None, :], out=empty(len(a), 3, 3))
