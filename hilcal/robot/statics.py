"""Static wrenches that load and weight transmit through each slot of the deviated arm."""

from dataclasses import dataclass

import numpy as np

from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.batch import empty, zeros
from hilcal.robot.chain import Chain
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Load:
    """What pulls at the arm beside its own weight."""

    wrench: Floats  # (N, 6) force and moment on the tool at the load point, base axes, N, N·m
    point: Floats  # (3,) or (N, 3) load point, flange axes, m
    tool_mass: float  # mass carried permanently, kg
    tool_com: Floats  # (3,) its centre of mass, flange axes, m
    gravity: Floats  # (3,) acceleration, base axes, m/s²
    # (n, 3) what the bodies' mass × centre of mass is beyond that of the arm, body axes, kg·m; None
    # for nothing
    first_moment: Floats | None = None


def slot_wrenches(arm: Arm, chain: Chain, load: Load) -> Floats:
    """Wrench (N, n + 1, 6) of everything beyond slot k, at its origin, in its axes.

        f_k = f_{k+1} + m_{k+1} g
        t_k = t_{k+1} + (p_{k+1} − p_k) × f_{k+1} + (c_{k+1} − p_k) × m_{k+1} g

    at the configuration of `chain`; a first moment s_{k+1} of body k + 1 beyond the arm's adds
    s_{k+1} × g to t_k. Element (k, 5) for k < n is the static torque τ_{k+1} that load and
    weight exert about the axis of joint k + 1, element (k, 2) the force along it (`Arm.along`).
    """
    n, count = arm.n, len(load.wrench)
    flange = chain.position[n]
    force, weight = load.wrench[:, :3], load.tool_mass * load.gravity
    f = force + weight
    t = load.wrench[:, 3:] + se3.cross(chain.point(load.point) - flange, force)
    if weight.any():
        _add_moment(t, chain.point(load.tool_com) - flange, weight)
    out = empty(count, n + 1, 6)
    for k in range(n, -1, -1):
        if k < n:
            weight = arm.masses[k] * load.gravity
            t += se3.cross(chain.position[k + 1] - chain.position[k], f)
            if weight.any():
                _add_moment(t, chain.com[k] - chain.position[k], weight)
                f += weight
            if load.first_moment is not None:
                moment = se3.apply(body_axes(arm, chain, k), load.first_moment[k])
                _add_moment(t, moment, load.gravity)
        np.einsum("nji,nj->ni", chain.rotation[k], f, out=out[:, k, :3])
        np.einsum("nji,nj->ni", chain.rotation[k], t, out=out[:, k, 3:])
    return out


def _add_moment(t: Floats, lever: Floats, force: Floats) -> None:
    """Add l × f of a force f (3,) that is the same in all states: along one axis mostly."""
    for axis in np.flatnonzero(force):
        after, before = (axis + 1) % 3, (axis + 2) % 3
        t[:, after] += lever[:, before] * force[axis]
        t[:, before] -= lever[:, after] * force[axis]


def slot_wrench_change(chain: Chain, force: Floats, moment: Floats) -> Floats:
    """Change (N, P, n + 1, 6) of the slot wrenches by changes of the wrench at the flange.

    force: (N, P, 3) change of the force, base axes, N; moment: (N, P, 3) change of the moment about
    the flange's origin, base axes, N·m.
    """
    slots, count = chain.position.shape[:2]
    out = empty(count, force.shape[1], slots, 6)
    for k in range(slots):
        lever = (chain.position[-1] - chain.position[k])[:, None, :]
        t = moment + se3.cross(lever, force)
        np.einsum("nji,npj->npi", chain.rotation[k], force, out=out[:, :, k, :3])
        np.einsum("nji,npj->npi", chain.rotation[k], t, out=out[:, :, k, 3:])
    return out


def load_wrench_change(chain: Chain, load: Load, change: Floats) -> Floats:
    """Change (N, P, n + 1, 6) of the slot wrenches by changes (N, P, 6) of the load's wrench.

    The changes are at the load point, in base axes, N and N·m.
    """
    lever = (chain.point(load.point) - chain.position[-1])[:, None, :]
    force = change[..., :3]
    return slot_wrench_change(chain, force, change[..., 3:] + se3.cross(lever, force))


def first_moment_change(arm: Arm, chain: Chain, gravity: Floats) -> Floats:
    """Change (N, 3 n, n + 1, 6) of the slot wrenches by unit first moments of the bodies.

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
    """Orientation (N, 3, 3) of body k + 1, base axes: back from slot k + 1, past its twist."""
    r = chain.rotation[k + 1]
    if chain.twist is not None and np.any(chain.twist[k + 1]):
        r = se3.product(r, se3.rotation(-chain.twist[k + 1, :, 3:]))
    return np.asarray(se3.product(r, arm.links[k + 1][:3, :3].T))
