"""The arm: constant link transforms, joint axes along z, masses, limits and joint conventions.

By the conventions of its controller, the joint j of the chain moves by

    θ_j = s_j q_j + o_j + Σ_i k_ji q_i

with q the controller's values, s = ±1, o the zero offset and k the couplings (a parallelogram: the
forearm keeps its direction in space while joint 2 moves, k_32 = −1; bevel gears in a wrist).

A coupling is mechanical if the motor of joint i also turns joint j: errors δ of the drives turn the
joints by D δ, and drive i carries the torque (Dᵀ τ)_i, with D = 1 + K of the mechanical couplings.
A coupling in the controller only (a forearm angle relative to the horizontal, with the drive in the
elbow) affects θ only: each drive carries the torque of its joint.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal import limits
from hilcal.config import STANDARD_GRAVITY_M_S2
from hilcal.config.sections import Conventions
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.shown import Brief
from hilcal.types import Bools, Floats

UNKNOWN_TORQUE, UNKNOWN_FORCE = 150.0, 1500.0
PAYLOAD_SHARE = 0.1  # of the mass of an arm whose payload is unknown; a choice
LOAD_LEVER = 0.1  # of a load's centre beyond the flange, m; a choice
NO_MASSES = (
    "{} has no masses: the arm's own weight makes no torque in the model. Compliance is "
    "right from deflections (loaded minus unloaded), and from absolute readings of poses under "
    "several loads, where the weight is estimated; under one load it comes out too soft by "
    "(weight + load)/load"
)


def description_gaps(
    file: str,
    has_masses: bool,
    without_limits: Sequence[str],
    without_torque: Sequence[str],  # joints without a torque or effort
    without_force: Sequence[str] = (),  # prismatic joints without a force or effort
) -> tuple[str, ...]:
    """Return the gaps of a description and their consequences, a sentence each."""
    out = [] if has_masses else [NO_MASSES.format(file)]
    if without_limits:
        out.append(f"no limits in {file} for {', '.join(without_limits)}: ±360° is assumed")
    for joints, kind, usual in (
        (
            without_torque,
            "torque",
            f"for the weight of the stretched arm and its payload ({UNKNOWN_TORQUE:g} N·m where "
            "neither is stated)",
        ),
        (without_force, "force", f"{UNKNOWN_FORCE:g} N"),
    ):
        if joints:
            out.append(
                f"no {kind} limit in {file} for {', '.join(joints)}: plans do not limit it, and "
                f"their ordinary compliance is that of a joint rated {usual}"
            )
    return tuple(out)


LARGEST_RAD = 4.0 * np.pi
"""rad; a choice, twice the range of most joints: larger joint values are taken for degrees."""
JOINT_VALUES = "joint values, rad, as readings.states.q"


def array_of(values: object, name: str, valid: str) -> Floats:
    """Return numbers as an array; InputError for anything else."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        text = repr(values)
        if len(text) > 60 or "\n" in text:
            text = f"a {type(values).__name__}"
        raise InputError(f"{name} = {text} is not an array of numbers; valid: {valid}") from None


@dataclass(frozen=True, slots=True, eq=False)
class Arm(Brief):
    """A serial arm of n joints, revolute or prismatic (rails, columns, gantries).

        T_base_flange(q) = L_0 M_1(q_1) L_1 M_2(q_2) ... M_n(q_n) L_n,   M = Rz or Tz

    with constant rigid transforms L_k; coupled joints move by `chain_angles`. *Slot* k (k = 0..n)
    is the frame right after L_k: for k < n its origin is a point of the axis of joint k + 1 and its
    z is that axis; slot n is the flange. Body i (i = 1..n) is moved by joint i; its frame is slot
    i - 1 moved by joint i.

    For a prismatic joint, angles (rad) are displacements (m), and torques (N·m) are forces along
    its axis (N); speeds and tolerances of the configuration have the same number in m as in rad.
    """

    name: str  # catalogue name or file stem
    links: Floats  # (n + 1, 4, 4) transforms L_k, lengths in m
    masses: Floats  # (n,) masses of the bodies, kg
    coms: Floats  # (n, 3) centres of mass in the body frames (after the joint's rotation), m
    q_min: Floats  # (n,) lower joint limits, rad
    q_max: Floats  # (n,) upper joint limits, rad
    torque_max: Floats  # (n,) joint torque limits, N·m
    payload: float  # rated payload, kg
    joint_names: tuple[str, ...]  # (n,) names
    source: str  # where the figures come from
    # (n, n) C with θ = C q: the angles of the chain from the controller's values, if joints follow
    # others (see above); None without couplings
    coupling: Floats | None = None
    # (n, n) D with dθ = D dδ: displacements of the chain's joints from those of the drives, if
    # drives turn several joints; None if each drive turns one joint
    drive: Floats | None = None
    # (n, n + 1) [F, f] with q = F q + f for the controller's values, if joints have no independent
    # value (`<mimic>` of a URDF): their rows give the value, other rows are the identity; None if
    # all values are independent
    mimic: Floats | None = None
    sign: Floats | None = None  # (n,) −1 where the axis is opposite to the drawn one
    notes: tuple[str, ...] = ()  # gaps of the description and their consequences, a sentence each
    repeatability: float | None = None  # pose repeatability RP of ISO 9283, m, as stated
    prismatic: Bools | None = None  # (n,) which joints slide; None if all turn

    @property
    def slides(self) -> Bools:
        """(n,) which joints are prismatic."""
        return np.zeros(self.n, np.bool_) if self.prismatic is None else self.prismatic

    def checked(self, q: object) -> Floats:
        """Return joint values (N, n) as an array, also of one point (n,).

        Raises:
            InputError: another shape, values that are no numbers or not finite, or degrees.
        """
        values = np.array(array_of(q, "q", JOINT_VALUES), order="C", ndmin=2)
        if values.shape[1:] != (self.n,) or not len(values):
            raise InputError(f"q has shape {values.shape}; valid: ({self.n},) or (N, {self.n})")
        if not np.isfinite(values).all():
            raise InputError("q has values that are not finite")
        size = np.where(self.slides, 0.0, np.abs(values))
        if np.any(np.sum(size > LARGEST_RAD, axis=1) > 1):  # one alone may be an endless wrist
            raise InputError(f"q has joints at {size.max():.4g} rad; valid: rad, as np.radians(q)")
        return values

    def unit(self, joint: int) -> str:
        """Return the unit of the value of a joint, counted from 0: "rad", or "m" of a slide."""
        return "m" if self.slides[joint] else "rad"

    @property
    def units(self) -> tuple[str, ...]:
        """(n,) units of the values of the joints."""
        return tuple(map(self.unit, range(self.n)))

    def kind(self, joint: int) -> str:
        """Return the name of the value of a joint, counted from 0: "angle" or "travel"."""
        return "travel" if self.slides[joint] else "angle"

    @property
    def usual_range(self) -> tuple[Floats, Floats]:
        """(n,) lowest and highest usual joint values: within half a turn, or the whole travel."""
        low, high = np.maximum(self.q_min, -np.pi), np.minimum(self.q_max, np.pi)
        slides = self.slides
        return np.where(slides, self.q_min, low), np.where(slides, self.q_max, high)

    @property
    def ratings(self) -> Floats:
        """(n,) rated torques or forces; where unknown, `weight_torques` and 1500 N."""
        rated = np.asarray(self.torque_max, dtype=float)
        known = np.isfinite(rated) & (rated > 0)
        unknown = np.where(self.slides, UNKNOWN_FORCE, self.weight_torques)
        return np.where(known, rated, unknown)

    @property
    def weight_torques(self) -> Floats:
        """(n,) torques of payload and bodies of the arm stretched out level, N·m.

            τ_j = g [m_payload (r_j + LOAD_LEVER) + Σ_{k ≥ j} m_k (r_jk + |c_k|)]

        with r_j the length of the chain from joint j to the flange, r_jk to body k, and c_k the
        body's centre of mass. A payload that is not stated counts as `PAYLOAD_SHARE` of the bodies'
        mass; without masses, 150 N·m, of a medium size. Of the 17 arms of the catalogue with stated
        torques these are 0.7 to 1.6 times as large (medians over the joints).
        """
        payload = self.payload
        if not np.isfinite(payload):
            payload = PAYLOAD_SHARE * float(self.masses.sum())
        if payload == 0.0:
            return np.full(self.n, UNKNOWN_TORQUE)
        lengths = np.linalg.norm(self.links[1:, :3, 3], axis=1) + self.travels
        end = np.cumsum(lengths)
        start, centre = end - lengths, np.linalg.norm(self.coms, axis=1)
        distance = np.maximum(start + centre - start[:, None], 0.0)  # (joint, body)
        moments = np.triu(self.masses * distance).sum(axis=1)
        moments += payload * (end[-1] - start + LOAD_LEVER)
        return np.asarray(STANDARD_GRAVITY_M_S2 * moments)

    def joint_components(self, wrench: Floats) -> Floats:
        """Return torques or forces (..., n) along the joints, from wrenches (..., n + 1, 6)."""
        return np.where(self.slides, wrench[..., :-1, 2], wrench[..., :-1, 5])

    def phases(self, q: Floats) -> Floats:
        """Return phases (..., n) for periodic laws, rad; of a slide, one turn over its travel.

        They are the angles φ of the drives: D φ = C q; q if all couplings are mechanical.
        """
        angle, slides = self.chain_angles(q), self.slides
        if self.drive is not None:
            mechanical = self.coupling is not None and np.array_equal(self.drive, self.coupling)
            angle = q if mechanical else np.asarray(angle @ np.linalg.pinv(self.drive).T)
        turn = 2 * np.pi / np.where(slides, self.q_max - self.q_min, 1.0)
        return np.where(slides, angle * turn, angle)

    def chain_angles(self, q: Floats) -> Floats:
        """Return angles (..., n) θ of the chain's joints, from the controller's values."""
        return q if self.coupling is None else q @ self.coupling.T

    def driven(self, dq: Floats) -> Floats:
        """Return displacements (..., n) of the chain's joints, from those of the drives."""
        return dq if self.drive is None else np.asarray(dq @ self.drive.T)

    def drive_torques(self, torque: Floats) -> Floats:
        """Return torques (..., n) of the drives, Dᵀ τ, from those about the joints' axes."""
        return torque if self.drive is None else np.asarray(torque @ self.drive)

    @property
    def independent(self) -> Bools:
        """(n,) which joints have an independent value."""
        if self.mimic is None:
            return np.ones(self.n, dtype=np.bool_)
        return np.asarray(np.diag(self.mimic) != 0)

    def complete(self, q: Floats) -> Floats:
        """Return joint values (..., n) with those of mimic joints computed from the others."""
        if self.mimic is None:
            return q
        independent = np.where(self.independent, q, 0.0)
        return np.asarray(independent @ self.mimic[:, :-1].T + self.mimic[:, -1])

    def __post_init__(self) -> None:
        """Refuse too many joints, and a slide without limits."""
        travel = (self.q_max - self.q_min)[self.slides]
        if not np.all(np.isfinite(travel) & (travel > 0.0)):
            raise InputError(f"{self.name}: a prismatic joint needs two limits, in m")
        if self.n > limits.JOINTS:
            raise InputError(f"{self.name}: {self.n} joints; valid: at most {limits.JOINTS}")

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.masses)

    @property
    def reach(self) -> float:
        """Sum of the lengths of all link transforms and of the travels of slides, m."""
        return float(np.linalg.norm(self.links[:, :3, 3], axis=1).sum() + self.travels.sum())

    @property
    def travels(self) -> Floats:
        """(n,) largest distances of slides from their zeros, m; 0 of revolute joints."""
        return np.where(self.slides, np.maximum(np.abs(self.q_min), np.abs(self.q_max)), 0.0)


_HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # Rx(π): Rz(−θ) = Rx(π) Rz(θ) Rx(π)


def with_controller_conventions(arm: Arm, conventions: Conventions) -> Arm:
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
    offset = np.radians(conventions.joint_offset_deg or (0.0,) * arm.n)
    for j in np.flatnonzero(arm.slides & (offset != 0)):
        raise InputError(
            f"joint_offset_deg of joint {j + 1}, which slides; valid: 0, with its zero in d_m or "
            "in the <origin> of the joint"
        )
    sign = np.array(conventions.joint_sign or (1,) * arm.n, dtype=float)
    coupling, counted = np.zeros((2, arm.n, arm.n))
    for c in conventions.joint_coupling:
        coupling[c.joint - 1, c.follows - 1] += c.factor
        counted[c.joint - 1, c.follows - 1] += 0.0 if c.mechanical else c.factor
    return with_conventions(arm, sign, offset, coupling, counted)


def with_conventions(
    arm: Arm, sign: Floats, offset: Floats, coupling: Floats, non_mechanical: Floats | float = 0.0
) -> Arm:
    """Return the arm with the controller's joint values: (n,) s and o, (n, n) k.

    Signs and zeros enter the constant links:

        M(s q + o) = M(o) X M(q) X⁻¹,  X = Rx(π) for s = −1, else 1;  M = Rz or Tz

    Limits are unchanged, as they are those of the controller's values. Existing couplings C of the
    arm apply to the converted values: θ = C (S q + o + K q). `non_mechanical` is a part of K.
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
    drives = sign[:, None] * (existing_drive @ (np.diag(sign) + coupling - non_mechanical))
    signs = sign if arm.sign is None else sign * arm.sign
    mimic = arm.mimic
    if mimic is not None:  # v = F v + f for the drawn values v = S q + o + K q
        factors, constants = mimic[:, :-1], mimic[:, -1]
        turned = sign[:, None] * (factors @ (np.diag(sign) + coupling) - coupling)
        moved = sign * (factors @ offset + constants - offset)
        mimic = np.where(arm.independent[:, None], mimic, np.column_stack([turned, moved]))
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


def possible_couplings(n: int) -> tuple[tuple[int, int], ...]:
    """Return pairs of a joint that may follow another, and the other one, counted from 1.

    Each joint may follow the previous one (parallelograms, wrists driven through one another); the
    last joint may follow the last but two (a wrist with three motors in the forearm).
    """
    return tuple((j, j - 1) for j in range(2, n + 1)) + (((n, n - 2),) if n > 2 else ())
