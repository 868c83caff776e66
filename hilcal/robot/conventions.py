"""Joint conventions of a controller: signs, zeros, and joints that follow others.

The joint j of the chain moves by

    θ_j = s_j q_j + o_j + Σ_i k_ji q_i

with q the controller's values, s = ±1, o the zero offset and k the couplings (a parallelogram: the
forearm keeps its direction in space while joint 2 moves, k_32 = −1; bevel gears in a wrist).

A coupling is mechanical if the motor of joint i also turns joint j: errors δ of the drives turn the
joints by D δ, and drive i carries the torque (Dᵀ τ)_i, with D = 1 + K of the mechanical couplings.
A coupling in the controller only (a forearm angle relative to the horizontal, with the drive in the
elbow) affects θ only: each drive carries the torque of its joint.
"""

from dataclasses import replace

import numpy as np

from hilcal.config.sections import Conventions
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Floats

_HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # Rx(π): Rz(−θ) = Rx(π) Rz(θ) Rx(π)


def as_counted(arm: Arm, conventions: Conventions) -> Arm:
    """Return the arm with the controller's joint conventions."""
    for key in ("joint_sign", "joint_offset_deg"):
        values = getattr(conventions, key)
        if values is not None and len(values) != arm.n:
            raise InputError(
                f"{key} has {len(values)} values; {arm.name} has {arm.n} joints, one value each"
            )
    for c in conventions.joint_coupling:
        if max(c.joint, c.follows) > arm.n:
            raise InputError(
                f"joint_coupling names joint {max(c.joint, c.follows)}; {arm.name} has joints "
                f"1 to {arm.n}"
            )
        if arm.slides[c.joint - 1] != arm.slides[c.follows - 1]:
            raise InputError(
                f"joint_coupling: of joints {c.joint} and {c.follows} one slides and one turns; "
                "valid: two that slide, or two that turn"
            )
    for j in np.flatnonzero(
        arm.slides & (np.array(conventions.joint_offset_deg or (0.0,) * arm.n) != 0)
    ):
        raise InputError(
            f"joint_offset_deg of joint {j + 1}, which slides; valid: 0, with its zero in d_m or "
            "in the <origin> of the joint"
        )
    sign = np.array(conventions.joint_sign or (1,) * arm.n, dtype=float)
    offset = np.radians(conventions.joint_offset_deg or (0.0,) * arm.n)
    coupling, counted = np.zeros((2, arm.n, arm.n))
    for c in conventions.joint_coupling:
        coupling[c.joint - 1, c.follows - 1] += c.factor
        counted[c.joint - 1, c.follows - 1] += 0.0 if c.mechanical else c.factor
    return with_conventions(arm, sign, offset, coupling, counted)


def with_conventions(
    arm: Arm, sign: Floats, offset: Floats, coupling: Floats, counted: Floats | float = 0.0
) -> Arm:
    """Return the arm with the controller's joint values: (n,) s and o, (n, n) k.

    Signs and zeros enter the constant links:

        M(s q + o) = M(o) X M(q) X⁻¹,  X = Rx(π) for s = −1, else 1;  M = Rz or Tz

    Limits are unchanged, as they are those of the controller's values. Existing couplings C of the
    arm apply to the converted values: θ = C (S q + o + K q). `counted` is the part of K that is not
    mechanical.
    """
    links, coms = arm.links.copy(), arm.coms.copy()
    existing = np.eye(arm.n) if arm.coupling is None else arm.coupling
    for j, zero in enumerate(existing @ offset):
        if zero:
            links[j] = links[j] @ se3.screw(2, *((0.0, zero) if arm.slides[j] else (zero,)))
        if sign[j] < 0:
            links[j] = links[j] @ _HALF_TURN
            links[j + 1] = _HALF_TURN @ links[j + 1]
            coms[j] = _HALF_TURN[:3, :3] @ coms[j]
    # θ = C (S q + o + K q), and S θ turns the links
    combined = sign[:, None] * (existing @ (np.diag(sign) + coupling))
    existing_drive = np.eye(arm.n) if arm.drive is None else arm.drive
    drives = sign[:, None] * (existing_drive @ (np.diag(sign) + coupling - counted))
    signs = sign if arm.sign is None else sign * arm.sign
    mimic = arm.mimic
    if mimic is not None:  # v = F v + f for the drawn values v = S q + o + K q
        factors, constants = mimic[:, :-1], mimic[:, -1]
        turned = sign[:, None] * (factors @ (np.diag(sign) + coupling) - coupling)
        moved = sign * (factors @ offset + constants - offset)
        mimic = np.where(arm.own[:, None], mimic, np.column_stack([turned, moved]))
    return replace(
        arm, links=links, coms=coms, coupling=_unless_one(combined), drive=_unless_one(drives),
        mimic=mimic, sign=signs if np.any(signs < 0) else None,
    )  # fmt: skip


def as_drawn(arm: Arm) -> Arm:
    """Return the arm with all axes as drawn, for quantities independent of joint values."""
    if arm.sign is None:
        return arm
    zeros = np.zeros((arm.n, arm.n))
    return with_conventions(replace(arm, coupling=None, drive=None), arm.sign, zeros[0], zeros)


def _unless_one(matrix: Floats) -> Floats | None:
    return None if np.array_equal(matrix, np.eye(len(matrix))) else matrix


def may_follow(n: int) -> tuple[tuple[int, int], ...]:
    """Return pairs of a joint that may follow another, and the other one, counted from 1.

    Each joint may follow the previous one (parallelograms, wrists driven through one another); the
    last joint may follow the last but two (a wrist with three motors in the forearm).
    """
    return tuple((j, j - 1) for j in range(2, n + 1)) + (((n, n - 2),) if n > 2 else ())
