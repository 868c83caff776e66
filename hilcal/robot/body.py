"""The shape of an arm: capsules on its bodies.

Arms of Universal Robots have known sizes; any other arm gets a capsule per link with a radius in
proportion to the arm's reach. A capsule is all points within `radius` of a segment.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.robot.arm import Arm
from hilcal.robot.chain import Chain, evaluate
from hilcal.robot.conventions import as_drawn
from hilcal.types import Floats

BASE = "base"
_JOINTS = 6
_RIM = 0.5  # of the radius: rounded end of a housing, by which the capsule's segment is shorter
_THICK, _THIN = 0.047, 0.03  # radii of an unknown arm at base and flange, over its reach
_SHORT = 1e-6  # m
TURNED = np.array([1.0, -1.0, -1.0])  # half a turn about x


@dataclass(frozen=True, slots=True, eq=False)
class Capsule:
    """A capsule that moves with a body."""

    name: str  # for people
    body: int  # 0 is the base, i the body moved by joint i
    start: Floats  # (3,) one end of the segment in the body's frame, m
    end: Floats  # (3,) the other end, m
    radius: float  # m


@dataclass(frozen=True, slots=True)
class Figures:
    """Sizes of an arm of Universal Robots' build, m."""

    shoulder: float  # offset of the upper arm's tube along the shoulder's axis
    elbow: float  # offset of the forearm's tube along the same direction
    housings: tuple[float, float, float, float]  # radii on joints 1, 2, 3 and the wrists
    tubes: tuple[float, float]  # radii of the tubes of upper arm and forearm


# Offsets: the manufacturer's ROS 2 description package, config/*/physical_parameters.yaml,
# `offsets`. Radii of UR5e and UR10e: the collision capsules of the MuJoCo Menagerie
# (universal_robots_ur5e, universal_robots_ur10e), also for their CB3 predecessors and the UR16e,
# which have the same joints. Radii of UR3(e), UR20 and UR30: a housing of a joint of torque T has
# 78 mm (T / 330 N·m)^0.27, which gives 60 mm for the 150 N·m joint and 40 mm for the 28 N·m joint
# of those two arms within 3 mm. All radii are below half of the data sheets' footprints of 128
# (UR3e), 149 (UR5e), 190 (UR10e) and 245 mm (UR20), as they must be.
# Tubes of UR8 Long, UR15 and UR18 are not published (their `offsets` are of the meshes). Their
# radii follow from the same rule with 433, 204 and 70 N·m; the offsets of their tubes are guessed:
# as far beyond the links' centres of mass (0.193 and 0.071 m) as the mean of UR10e and UR20.
_UR5 = ((0.060, 0.060, 0.055, 0.040), (0.050, 0.038))
_UR10 = ((0.078, 0.078, 0.058, 0.050), (0.060, 0.043))
_UR3 = ((0.049, 0.049, 0.041, 0.033), (0.040, 0.030))
_UR20 = ((0.099, 0.099, 0.084, 0.060), (0.078, 0.062))
_UR15 = ((0.084, 0.084, 0.069, 0.051), (0.066, 0.050))
_FIGURES = {
    "ur3": Figures(0.1198, 0.0275, *_UR3), "ur3e": Figures(0.120, 0.027, *_UR3),
    "ur5": Figures(0.13585, 0.0165, *_UR5), "ur5e": Figures(0.138, 0.007, *_UR5),
    "ur7e": Figures(0.138, 0.007, *_UR5), "ur8long": Figures(0.227, 0.046, *_UR15),
    "ur10": Figures(0.220941, 0.049042, *_UR10), "ur10e": Figures(0.1762, 0.0393, *_UR10),
    "ur12e": Figures(0.1762, 0.0393, *_UR10), "ur15": Figures(0.227, 0.046, *_UR15),
    "ur16e": Figures(0.1762, 0.0393, *_UR10), "ur18": Figures(0.227, 0.046, *_UR15),
    "ur20": Figures(0.260, 0.043, *_UR20), "ur30": Figures(0.260, 0.043, *_UR20),
}  # fmt: skip
_GUESSED = frozenset({"ur8long", "ur15", "ur18"})


def is_known(arm: Arm) -> bool:
    """Return whether the arm's sizes are known; else they are guessed, mostly from its reach."""
    return arm.name not in _GUESSED and _has_figures(arm)


def _has_figures(arm: Arm) -> bool:
    if arm.sign is not None:
        return _has_figures(as_drawn(arm))
    parallel = arm.n == _JOINTS and min(abs(arm.links[k][2, 2]) for k in (2, 3)) > 0.99
    return arm.name in _FIGURES and bool(parallel)  # a file of the same name may be another arm


def capsules(arm: Arm) -> tuple[Capsule, ...]:
    """Return the capsules of base and bodies, in the order of the bodies.

    They contain the real housings except a rim of at most an eighth of the radius, which the
    margins of collision checks cover.
    """
    if arm.sign is None:
        return _of_ur(arm, _FIGURES[arm.name]) if _has_figures(arm) else _of_any(arm)
    # shapes of the drawn arm; bodies of opposite axes have frames turned about x
    turned = np.append(False, arm.sign < 0)
    return tuple(
        replace(c, start=TURNED * c.start, end=TURNED * c.end) if turned[c.body] else c
        for c in capsules(as_drawn(arm))
    )


def body_poses(arm: Arm, q: Floats, chain: Chain | None = None) -> Floats:
    """Return poses T_base_body (N, n + 2, 4, 4) of base, bodies and flange at (N, n) joint values.

    T_base_body0 = 1, T_base_bodyi = L_0 M_1(θ_1) ... L_{i-1} M_i(θ_i).
    """
    chain = evaluate(arm, q) if chain is None else chain
    out = np.tile(np.eye(4), (len(q), arm.n + 2, 1, 1))
    out[:, 1:, :3, :3] = np.swapaxes(chain.rotation, 0, 1)
    out[:, 1:, :3, 3] = np.swapaxes(chain.position, 0, 1)
    turn = np.tile(np.eye(3), (len(q), arm.n, 1, 1))
    angle = arm.chain_angles(q)
    if arm.prismatic is not None:
        along = np.swapaxes(chain.rotation[:-1, :, :, 2], 0, 1)
        out[:, 1:-1, :3, 3] += along * (angle * arm.prismatic)[..., None]
        angle = angle * ~arm.prismatic
    turn[..., 0, 0] = turn[..., 1, 1] = np.cos(angle)
    turn[..., 1, 0] = np.sin(angle)
    turn[..., 0, 1] = -turn[..., 1, 0]
    out[:, 1:-1, :3, :3] = out[:, 1:-1, :3, :3] @ turn
    return out


def flange_capsule(arm: Arm, name: str, start: Floats, end: Floats, radius: float) -> Capsule:
    """Return a capsule fixed to the flange, between two ends (3,), flange axes, m."""
    axes, origin = arm.links[arm.n][:3, :3], arm.links[arm.n][:3, 3]
    return Capsule(name, arm.n, origin + axes @ start, origin + axes @ end, radius)


def _of_ur(arm: Arm, figures: Figures) -> tuple[Capsule, ...]:
    r1, r2, r3, r4 = figures.housings
    upper, fore = figures.tubes
    d1, d4 = (float(arm.links[k][2, 3]) for k in (1, 4))
    x2, x3 = arm.links[2][:3, 3], arm.links[3][:3, 3]
    inner, outer = figures.elbow, figures.shoulder
    between = 0.5 * (inner + outer)
    lift = arm.links[1][:3, 2]  # the shoulder's axis, in the frame of body 1
    top = np.array([0.0, 0.0, d1])
    spin = arm.links[4][:3, 2]  # the second wrist's axis, in the frame of body 4
    d5 = float(arm.links[5][2, 3])
    out = [
        _housing(BASE, 0, np.zeros(3), 0.0, 0.6 * d1, r1),
        Capsule("shoulder", 1, 0.6 * top, top, r1),
        Capsule("shoulder", 1, top, top + 0.5 * outer * lift, r2),
        _housing("upper arm", 2, np.zeros(3), 0.5 * outer, outer + r2, r2),
        Capsule("upper arm", 2, outer * _Z, x2 + outer * _Z, upper),
        _housing("upper arm", 2, x2, between, outer + r3, r3),
        _housing("forearm", 3, np.zeros(3), inner - r3, between, r3),
        Capsule("forearm", 3, inner * _Z, x3 + inner * _Z, fore),
        _housing("forearm", 3, x3, inner - r4, inner + r4, r4),
        _housing("wrist 1", 4, np.zeros(3), inner + r4, d4 + r4, r4),
        Capsule("wrist 1", 4, d4 * _Z, d4 * _Z + 0.4 * d5 * spin, r4),
        _housing("wrist 2", 5, np.zeros(3), 0.4 * d5, d5 + r4, r4),
        Capsule("wrist 3", 6, np.zeros(3), arm.links[6][:3, 3] - _RIM * r4 * _Z, r4),
    ]
    return tuple(out)


_Z = np.array([0.0, 0.0, 1.0])


def _housing(
    name: str, body: int, origin: Floats, low: float, high: float, radius: float
) -> Capsule:
    """Return a capsule for a housing about an axis along z through `origin`, from `low` to `high`.

    Its segment ends half a radius inside of the housing, or in the middle of a short one.
    """
    rim = min(_RIM * radius, 0.5 * (high - low))
    return Capsule(name, body, origin + (low + rim) * _Z, origin + (high - rim) * _Z, radius)


def _of_any(arm: Arm) -> tuple[Capsule, ...]:
    """Return one capsule per link, from one joint's frame to the next."""
    reach = max(arm.reach - float(arm.travels.sum()), 0.1)
    radii = np.linspace(_THICK, _THIN, arm.n + 1) * reach
    names = (BASE, *arm.joint_names)
    out = []
    for k, link in enumerate(arm.links):
        end = link[:3, 3]
        if float(np.linalg.norm(end)) > _SHORT:
            out.append(Capsule(names[k], k, np.zeros(3), end, float(radii[k])))
    return tuple(out)
