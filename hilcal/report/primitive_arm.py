"""A drawn arm made of surfaces of revolution, from nothing but its own link transforms."""

from dataclasses import dataclass

import numpy as np

from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

METAL = (176, 180, 188)
DARK = (92, 98, 110)
_SEGMENTS = 40
_RADIUS_BY_REACH = 0.037  # a UR10e's upper arm: 65 mm of 1.78 m
_PARALLEL = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class BodyMesh:
    """Triangles of one body in its body frame, m.

    Attributes:
        vertices: (V, 3).
        normals: (V, 3), unit, outward.
        triangles: (T, 3) indices.
        colors: (V, 3) sRGB, 0..255.
    """

    vertices: Floats
    normals: Floats
    triangles: Ints
    colors: Ints


def body_poses(arm: Arm, q: Floats) -> Floats:
    """Poses of base and bodies: T_base_body0 = 1, T_base_bodyi = L_0 Rz(q_1) ... L_{i-1} Rz(q_i).

    Args:
        arm: the arm.
        q: (N, n) joint angles, rad.

    Returns:
        (N, n + 2, 4, 4): base, the n bodies, flange.
    """
    n_states, n = q.shape
    out = np.empty((n_states, n + 2, 4, 4))
    out[:, 0] = np.eye(4)
    pose = np.broadcast_to(np.eye(4), (n_states, 4, 4))
    for i in range(n):
        turn = np.zeros((n_states, 4, 4))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(q[:, i])
        turn[:, 1, 0] = np.sin(q[:, i])
        turn[:, 0, 1] = -turn[:, 1, 0]
        turn[:, 2, 2] = turn[:, 3, 3] = 1.0
        pose = pose @ arm.links[i] @ turn
        out[:, i + 1] = pose
    out[:, n + 1] = pose @ arm.links[n]
    return out


def arm_meshes(arm: Arm) -> tuple[BodyMesh, ...]:
    """Meshes of base and bodies: a capped housing on every joint axis, a tube to the next axis.

    Between parallel axes the tube is shifted along them, so that neighbouring links pass
    each other as on the real arm.

    Returns:
        n + 1 meshes: base, then the n bodies, each in its own frame.
    """
    radius = _RADIUS_BY_REACH * max(arm.reach, 0.1)
    radii = radius * np.linspace(1.1, 0.6, arm.n + 1)
    shifts = _shifts(arm, radius)
    first = arm.links[0][:3, 3]
    base = [_cylinder(np.zeros(3), np.array([0, 0, 0.5 * radius]), 1.45 * radii[0], DARK)]
    if np.linalg.norm(first) > _PARALLEL:
        base.append(_cylinder(np.zeros(3), first, radii[0], METAL))
    meshes = [_join(base)]
    attached = 0.0  # where the previous tube meets this axis
    for i in range(arm.n):
        link, r, r_next, shift = arm.links[i + 1], radii[i], radii[i + 1], shifts[i]
        lo, hi = min(attached, shift) - 1.15 * r, max(attached, shift) + 1.15 * r
        if i == 0:
            lo = 0.0
        parts = _housing(lo, hi, r)
        tube, attached = _tube(link, shift, 0.78 * min(r, r_next) / 0.9)
        parts += tube
        if i == arm.n - 1:
            parts += _flange(link, r)
        meshes.append(_join(parts))
    return tuple(meshes)


def tool_mesh(arm: Arm, offset: Floats, color: tuple[int, int, int]) -> BodyMesh:
    """Mesh of the way from flange to target, with a ball on the target; flange axes.

    Args:
        arm: sets the size.
        offset: (3,) target in flange axes, m.
        color: of the ball, sRGB.
    """
    r = _RADIUS_BY_REACH * max(arm.reach, 0.1)
    parts = [_ball(offset, 0.32 * r, color)]
    if np.linalg.norm(offset) > 0.3 * r:
        parts.append(_cylinder(np.zeros(3), offset, 0.18 * r, DARK))
    return _join(parts)


def _shifts(arm: Arm, radius: float) -> list[float]:
    """Shift of each body's tube along its axis: alternating where axes are parallel."""
    shifts, run = [], 0
    for i in range(arm.n):
        link = arm.links[i + 1]
        across = np.linalg.norm(link[:2, 3])
        if abs(link[2, 2]) > 1 - _PARALLEL and across > radius and i < arm.n - 1:
            ahead = [float(k[2, 3]) for k in arm.links[i + 1 : i + 4]]
            side = np.sign(next((d for d in ahead if abs(d) > radius), 1.0))
            shifts.append(float(2.3 * radius * side) if run % 2 == 0 else 0.0)
            run += 1
        else:
            shifts.append(0.0)
            run = 0
    return shifts


def _tube(link: Floats, shift: float, r: float) -> tuple[list[BodyMesh], float]:
    """Tube to the next axis, and where it meets that axis."""
    end = link[:3, 3].copy()
    if np.linalg.norm(end) < _PARALLEL:
        return [], 0.0
    start = np.array([0.0, 0.0, shift])
    if abs(link[2, 2]) > 1 - _PARALLEL and np.linalg.norm(end[:2]) > _PARALLEL:
        attached = float((shift - end[2]) * link[2, 2])
        end[2] = shift
        return [_cylinder(start, end, r, METAL)], attached
    return [_cylinder(start, end, r, METAL)], 0.0


def _housing(lo: float, hi: float, r: float) -> list[BodyMesh]:
    """Cylinder along z with a dark cap at both ends."""
    cap = 0.16 * r
    z = np.array([0.0, 0.0, 1.0])
    return [
        _cylinder(lo * z, hi * z, r, METAL),
        _cylinder((lo - cap) * z, (lo + cap) * z, 0.9 * r, DARK),
        _cylinder((hi - cap) * z, (hi + cap) * z, 0.9 * r, DARK),
    ]


def _flange(link: Floats, r: float) -> list[BodyMesh]:
    end, axis = link[:3, 3], link[:3, 2]
    return [_cylinder(end - 0.25 * r * axis, end, 0.85 * r, DARK)]


def _cylinder(a: Floats, b: Floats, r: float, color: tuple[int, int, int]) -> BodyMesh:
    """Cylinder from a to b with rounded rims, as a surface of revolution."""
    length = float(np.linalg.norm(b - a))
    rim = min(0.18 * r, 0.3 * length)
    turn = np.linspace(0.0, np.pi / 2, 4)
    top = np.stack([r - rim + rim * np.cos(turn), length - rim + rim * np.sin(turn)], 1)
    top_n = np.stack([np.cos(turn), np.sin(turn)], 1)
    bottom, bottom_n = top[::-1] * [1, -1] + [0, length], top_n[::-1] * [1, -1]
    pole = np.array([[0.0, 1.0]])
    profile = np.vstack([[[0.0, 0.0]], bottom, top, [[0.0, length]]])
    normal = np.vstack([-pole, bottom_n, top_n, pole])
    return _revolve(profile, normal, a, (b - a) / length, color)


def _ball(center: Floats, r: float, color: tuple[int, int, int]) -> BodyMesh:
    turn = np.linspace(-np.pi / 2, np.pi / 2, 16)
    normal = np.stack([np.cos(turn), np.sin(turn)], 1)
    return _revolve(r * normal, normal, center, np.array([0.0, 0.0, 1.0]), color)


def _revolve(
    profile: Floats, normal: Floats, origin: Floats, axis: Floats, color: tuple[int, int, int]
) -> BodyMesh:
    """Surface of a profile of (radius, height) turned about an axis."""
    across = np.eye(3)[int(np.argmin(np.abs(axis)))]
    x = np.cross(across, axis)
    x /= np.linalg.norm(x)
    y = np.cross(axis, x)
    phi = np.linspace(0.0, 2 * np.pi, _SEGMENTS, endpoint=False)
    ring = np.cos(phi)[:, None] * x + np.sin(phi)[:, None] * y
    vertices = origin + profile[:, None, :1] * ring + profile[:, None, 1:] * axis
    normals = normal[:, None, :1] * ring + normal[:, None, 1:] * axis
    i = np.arange(len(profile) - 1)[:, None] * _SEGMENTS
    j = np.arange(_SEGMENTS)
    k = (j + 1) % _SEGMENTS
    quad = np.stack([i + j, i + k, i + _SEGMENTS + k, i + _SEGMENTS + j], -1).reshape(-1, 4)
    triangles = np.vstack([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    count = vertices.shape[0] * vertices.shape[1]
    return BodyMesh(
        vertices.reshape(-1, 3),
        normals.reshape(-1, 3),
        triangles.astype(np.int64),
        np.tile(np.array(color, dtype=np.int64), (count, 1)),
    )


def _join(parts: list[BodyMesh]) -> BodyMesh:
    starts = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    return BodyMesh(
        np.vstack([p.vertices for p in parts]),
        np.vstack([p.normals for p in parts]),
        np.vstack([p.triangles + s for p, s in zip(parts, starts, strict=True)]),
        np.vstack([p.colors for p in parts]),
    )
