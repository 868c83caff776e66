"""An arm of any constant transforms as a Denavit-Hartenberg table, and its remainder.

Between two joints every transform is, with the common normal of their axes,

    L = Rz(φ) Tz(s) Tx(a) Rx(α) Tz(t) Rz(ψ)

and its parts about z add to the joints' offsets and distances d, so that the rows are exact for the
relative poses of all axes. The common normal of nearly parallel axes is far away: d of both joints
is then large, with opposite signs. Rows do not contain the pose of the first axis in the base, B,
nor that of the flange on the last axis, E:

    T_base_flange = B Π_i row_i(q_i) E

B does not end with a part about z, and E does not begin with one. A robot file has them as
`base_m_rad` and `flange_m_rad`.

Source: Craig, *Introduction to Robotics*, sections 3.3 and 3.4; Hayati, "Robot arm geometric link
parameter estimation", IEEE CDC 1983, for parallel axes.
"""

from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

import numpy as np
import tomli_w

from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.tables.write import Column, csv_of
from hilcal.types import Floats

Convention = Literal["standard", "modified"]
CONVENTIONS: tuple[Convention, ...] = ("standard", "modified")
PARALLEL = 1e-9  # rad; axes below this angle count as parallel: it moves the tool by a nanometre
CROSSED = 0.1  # rad; above this tilt the end of a chain becomes a row, as links do; a choice
EXACT = 1e-9  # m; smaller differences are not reported
TRIALS = 200


@dataclass(frozen=True, slots=True, eq=False)
class DhRows:
    """A table of n joints."""

    convention: Convention  # of the rows, see `robot.catalogue.arm_from_dh`
    a: Floats  # (n,) m
    d: Floats  # (n,) m
    alpha: Floats  # (n,) rad
    offset: Floats  # (n,) rad
    base: Floats  # (4, 4) B
    flange: Floats  # (4, 4) E
    base_moves: float = 0.0  # largest motion of the flange without B, m
    flange_moves: float = 0.0  # the same without E, m
    table_moves: float = 0.0  # the same without both, m
    disagreement: float = 0.0  # largest error of the flange with B and E, m: rounding
    slides: tuple[int, ...] = ()  # indices of joints that slide: q adds to d


def dh_rows(arm: Arm, convention: Convention = "standard") -> DhRows:
    """Return the table of an arm with "standard" (classic) or "modified" (Craig) rows."""
    if arm.coupling is not None or arm.drive is not None:
        raise InputError(f"{arm.name}: joints are coupled, which a DH table cannot hold")
    n = arm.n
    z_before, z_after = np.zeros((n + 1, 2)), np.zeros((n + 1, 2))  # angle, distance along z
    across = np.zeros((n + 1, 2))  # a, α
    for k in range(1, n):
        z_before[k], across[k], z_after[k] = _common_normal(arm.links[k])
    base, flange = np.eye(4), np.eye(4)
    first, last = arm.links[0], arm.links[n]
    if convention == "modified" and _tilt(first) > CROSSED:
        start, across[0], z_after[0] = _common_normal(first)
        base = se3.screw(2, *start)
    else:
        z_after[0] = _about_z(first), first[:3, 2] @ first[:3, 3]
        base = first @ se3.screw(2, *-z_after[0])
    if convention == "standard" and _tilt(last) > CROSSED:
        z_before[n], across[n], end = _common_normal(last)
        flange = se3.screw(2, *end)
    else:
        z_before[n] = twist_first(last)
        flange = se3.screw(2, *-z_before[n]) @ last
    along = z_after[:n] + z_before[1:]
    shift = 1 if convention == "standard" else 0
    a, alpha = across[shift : n + shift].T
    offset = along[:, 0] - 2 * np.pi * np.rint(along[:, 0] / (2 * np.pi))
    offset[np.abs(offset) < 1e-15] = 0.0  # rounding errors
    slides = tuple(np.flatnonzero(arm.slides).tolist())
    rows = DhRows(convention, a, along[:, 1], alpha, offset, base, flange, slides=slides)
    q = np.random.default_rng(20250309).uniform(-np.pi, np.pi, (TRIALS, n))
    chain, by_rows = evaluate(arm, q), flange_poses(rows, q, whole=False)

    def moves(poses: Floats) -> float:
        """Return the largest distance of the flange from that of the arm, m."""
        return float(np.linalg.norm(poses[:, :3, 3] - chain.position[-1], axis=1).max())

    return replace(
        rows,
        base_moves=moves(by_rows @ flange),
        flange_moves=moves(base @ by_rows),
        table_moves=moves(by_rows),
        disagreement=moves(base @ by_rows @ flange),
    )


def row_transforms(rows: DhRows, q: Floats) -> Floats:
    """(N, n, 4, 4) transforms of the rows at joint values (N, n), rad; m where joints slide."""
    out = np.empty((*q.shape, 4, 4))
    for k in range(q.shape[1]):
        across = se3.screw(0, rows.alpha[k], rows.a[k])
        for i, value in enumerate(q[:, k]):
            angle, travel = (0.0, value) if k in rows.slides else (value, 0.0)
            turn = se3.screw(2, angle + rows.offset[k], rows.d[k] + travel)
            out[i, k] = turn @ across if rows.convention == "standard" else across @ turn
    return out


def flange_poses(rows: DhRows, q: Floats, *, whole: bool = True) -> Floats:
    """(N, 4, 4) poses of the flange by the rows, with B and E if `whole`."""
    place = reduce(np.matmul, np.moveaxis(row_transforms(rows, q), 1, 0))
    return np.asarray(rows.base @ place @ rows.flange if whole else place)


def to_csv(rows: DhRows, arm: Arm) -> str:
    """Return the rows alone, in m and rad."""
    columns: dict[str, Column] = {"joint": arm.joint_names, "a_m": rows.a, "d_m": rows.d}
    return csv_of({**columns, "alpha_rad": rows.alpha, "offset_rad": rows.offset})


def to_toml(rows: DhRows, arm: Arm, title: str) -> str:
    """Return a robot file with the rows, and masses, limits and payload of an arm."""
    com = _centres(rows, arm)
    content: dict[str, object] = {"title": escaped(title)}
    if np.isfinite(arm.payload):
        content["payload_kg"] = float(arm.payload)
    content |= {
        "source": escaped(f"{arm.source}; corrected by calibration"),
        "convention": rows.convention,
        "base_m_rad": se3.six(rows.base),
        "flange_m_rad": se3.six(rows.flange),
    }
    if arm.repeatability is not None:
        content["repeatability_m"] = arm.repeatability
    content["joints"] = [
        {
            "name": escaped(arm.joint_names[k]),
            "a_m": float(rows.a[k]),
            "d_m": float(rows.d[k]),
            "alpha_deg": float(np.degrees(rows.alpha[k])),
            "offset_deg": float(np.degrees(rows.offset[k])),
            "mass_kg": float(arm.masses[k]),
            "com_m": com[k].tolist(),
            **_ranges(arm, k),
        }
        for k in range(arm.n)
    ]
    parts = ["Rz(q + offset) Tz(d)", "Tx(a) Rx(alpha)"]
    if rows.convention == "modified":
        parts = ["Rx(alpha) Tx(a)", parts[0]]
    head = (
        f"# T_base_flange = B * product of {' '.join(parts)} * E,\n"
        "# B = base_m_rad and E = flange_m_rad: x, y, z and rotation vector, m and rad. Programs\n"
        "# that read the rows alone put the flange up to "
        f"{1e3 * rows.table_moves:.4f} mm elsewhere.\n"
    )
    return head + tomli_w.dumps(content)


def _ranges(arm: Arm, k: int) -> dict[str, object]:
    low, high, torque = (float(x[k]) for x in (arm.q_min, arm.q_max, arm.torque_max))
    if arm.slides[k]:
        out: dict[str, object] = {"type": "prismatic", "q_min_m": low, "q_max_m": high}
        return out | ({"force_max_N": torque} if np.isfinite(torque) else {})
    out = {"q_min_deg": float(np.degrees(low)), "q_max_deg": float(np.degrees(high))}
    return out | ({"torque_max_Nm": torque} if np.isfinite(torque) else {})


def _centres(rows: DhRows, arm: Arm) -> Floats:
    """(n, 3) centres of mass in DH frame i, after row i."""
    parts = row_transforms(rows, np.zeros((1, arm.n)))[0]
    body, frame, out = np.eye(4), rows.base, np.empty((arm.n, 3))
    for k in range(arm.n):
        body, frame = body @ arm.links[k], frame @ parts[k]
        point = body[:3, :3] @ arm.coms[k] + body[:3, 3]
        out[k] = frame[:3, :3].T @ (point - frame[:3, 3])
    return out


def _common_normal(link: Floats) -> tuple[Floats, Floats, Floats]:
    """(φ, s), (a, α) and (ψ, t) of a transform; |φ| ≤ π/2."""
    x, y, z = link[:3, 2]
    sine = float(np.hypot(x, y))
    p = link[:3, 3]
    if sine > PARALLEL:
        phi, alpha = np.arctan2(x, -y), np.arctan2(sine, z)
    else:
        phi = np.arctan2(p[1], p[0]) if np.hypot(p[0], p[1]) > 0 else 0.0
        alpha = 0.0 if z > 0 else np.pi
    if abs(phi) > np.pi / 2 + 1e-9:
        phi -= np.copysign(np.pi, phi)
        alpha = -alpha
    across = np.array([np.cos(phi), np.sin(phi), 0.0])
    a = float(across @ p)
    t = 0.0
    if sine > PARALLEL:
        t = float(across[1] * p[0] - across[0] * p[1]) / np.sin(alpha)
    s = float(p[2] - t * np.cos(alpha))
    turned = (se3.screw(2, phi) @ se3.screw(0, alpha))[:3, :3].T @ link[:3, :3]
    psi = np.arctan2(turned[1, 0], turned[0, 0])
    return np.array([phi, s]), np.array([a, alpha]), np.array([psi, t])


def twist_first(link: Floats) -> Floats:
    """Angle and distance of Rz Tz at the beginning of a transform."""
    return np.array([_about_z(link), link[2, 3]])


def _about_z(link: Floats) -> float:
    """Angle about z of a rotation about z followed by one about a horizontal axis."""
    from scipy.spatial.transform import Rotation  # slow to import

    z, w = Rotation.from_matrix(link[:3, :3]).as_quat()[2:]
    return float(2.0 * np.arctan2(z, w)) if np.hypot(z, w) > 1e-9 else 0.0


def _tilt(link: Floats) -> float:
    return float(np.arctan2(np.hypot(link[0, 2], link[1, 2]), abs(link[2, 2])))
