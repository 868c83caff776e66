"""Another way to tell what a state touches: own kinematics, and points along every capsule."""

from itertools import combinations

import numpy as np
from hypothesis import strategies as st

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.design.feasible import FeasibleSpace, draw_poses

POINTS = 41
ALWAYS = ({"wrist 1", "wrist 3"}, {"base", "upper arm"})
"""Parts whose crude shapes nearly touch in every state; they cannot meet on the real arm."""


def frames(arm, q):
    """(4, 4) frames of base and bodies, then of the flange."""
    out, pose = [np.eye(4)], np.eye(4)
    for link, angle in zip(arm.links, q, strict=False):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose = pose @ link @ turn
        out.append(pose)
    return [*out, pose @ arm.links[-1]]


def least_distance(pairs, q, segment=None):
    """Least distance of pairs of shapes in one state (n,), m; negative where they overlap."""
    everywhere = pairs.close_pairs(q[None], 100.0, segment)
    return min(everywhere.values(), default=np.inf)


def along(a, b):
    """(POINTS, 3) points of a segment."""
    return a + np.linspace(0.0, 1.0, POINTS)[:, None] * (b - a)


def placed(part, at):
    """(POINTS, 3) points of a capsule's segment, base axes."""
    frame = at[part.body]
    return along(part.start, part.end) @ frame[:3, :3].T + frame[:3, 3]


def reached(cell, parts, q):
    """(3,) what all that is held to a workspace reaches in states (N, n): lowest and highest, m."""
    turns = np.zeros((25, cell.arm.n))
    turns[:, 0] = np.linspace(-np.pi, np.pi, 25)
    low, high = extent([p for p in parts if p.body > 2], cell, q)
    upper = extent([p for p in parts if p.body == 2], cell, q)
    stands, rises = extent([p for p in parts if p.body < 2], cell, turns)
    low = np.where(stands > low, np.minimum(low, upper[0]), low)
    return low, np.where(rises < high, np.maximum(high, upper[1]), high)


def extent(parts, cell, q):
    """(3,) lowest and highest of capsules in states (N, n) along each axis, m."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for state in q:
        at = frames(cell.arm, state)
        for part in parts:
            ends = np.stack([part.start, part.end]) @ at[part.body][:3, :3].T
            ends = ends + at[part.body][:3, 3]
            low = np.minimum(low, ends.min(axis=0) - part.radius)
            high = np.maximum(high, ends.max(axis=0) + part.radius)
    return low, high


def gap(a, b):
    """The least distance of the points of two segments."""
    return float(np.linalg.norm(a[:, None] - b[None], axis=2).min())


def gap_to(thing, points):
    """The least distance of points to an obstacle; 0 inside."""
    if thing.center_m is not None:
        off = np.abs(points - thing.center_m) - 0.5 * np.array(thing.size_m)
    else:
        middle = np.array(thing.bottom_m) + 0.5 * thing.height_m * np.eye(3)[2]
        round_ = np.hypot(*(points - middle)[:, :2].T) - thing.radius_m
        off = np.stack([round_, np.abs((points - middle)[:, 2]) - 0.5 * thing.height_m], 1)
    return float(np.linalg.norm(np.maximum(off, 0.0), axis=1).min())


def self_gap(parts, at):
    """The least gap between parts of bodies that are not neighbours."""
    out = np.inf
    for a, b in combinations(parts, 2):
        if abs(a.body - b.body) > 1 and {a.name, b.name} not in ALWAYS:
            out = min(out, gap(placed(a, at), placed(b, at)) - a.radius - b.radius)
    return out


def hung(cell, shapes, q, load):
    """Points and radius of what hangs, and of the cable."""
    flange = frames(cell.arm, q)[-1]
    at = flange[:3, :3] @ cell.load_point + flange[:3, 3]
    known = next(x for x in shapes.config.loads if x.name == load)
    out = []
    if known.hanging_m > 0:
        down = cell.gravity / np.linalg.norm(cell.gravity)
        rim = min(known.radius_m, known.hanging_m / 2)
        ends = at + rim * down, at + (known.hanging_m - rim) * down
        out.append((along(*ends), known.radius_m))
    if known.cable_m > 0:
        pull = np.array(known.force_N) / np.linalg.norm(known.force_N)
        out.append((along(at, at + known.cable_m * pull), 0.01))
    return out


def energy(cell, q, force):
    """Potential energy of arm and tool, and of a constant force at the load point, J."""
    arm, at = cell.arm, frames(cell.arm, q)
    flange = at[-1]
    out = 0.0
    for k in range(arm.n):
        com = at[k + 1][:3, :3] @ arm.coms[k] + at[k + 1][:3, 3]
        out -= arm.masses[k] * float(cell.gravity @ com)
    com = flange[:3, :3] @ cell.tool_com + flange[:3, 3]
    out -= cell.tool_mass * float(cell.gravity @ com)
    return out - float(force @ (flange[:3, :3] @ cell.load_point + flange[:3, 3]))


def torques(cell, q, force):
    """(n,) what weights and a force at the load point exert about the joints, N·m."""
    h = 1e-4
    steps = h * np.eye(cell.arm.n)
    return np.array([(energy(cell, q - s, force) - energy(cell, q + s, force)) / (2 * h)
                     for s in steps])  # fmt: skip


def conditioning(arm, q):
    """σ_min/σ_max of the flange's Jacobian by differences, lengths in units of the reach."""
    h, columns = 1e-6, []
    flange = frames(arm, q)[-1]
    for k in range(arm.n):
        step = h * np.eye(arm.n)[k]
        more, less = frames(arm, q + step)[-1], frames(arm, q - step)[-1]
        spin = (more[:3, :3] - less[:3, :3]) @ flange[:3, :3].T / (2 * h)
        turn = [spin[2, 1], spin[0, 2], spin[1, 0]]
        columns.append([*((more - less)[:3, 3] / (2 * h) / arm.reach), *turn])
    sigma = np.linalg.svd(np.array(columns).T, compute_uv=False)
    return float(sigma[-1] / sigma[0])


TABLE = {"name": "table", "center_m": [0.0, 0.0, -0.06], "size_m": [2.0, 2.0, 0.1]}


def cell(**sections):
    """A UR10e with a weight and a pull; sections are replaced."""
    usual = {
        "robot": {"model": "ur10e"},
        "tool": {
            "target_m": [0.06, 0.02, 0.12],
            "load_point_m": [0.1, 0.0, 0.15],
            "mass_kg": 0.8,
            "com_m": [0.01, 0.0, 0.06],
        },
        "loads": [
            {"name": "5kg", "mass_kg": 5.0},
            {"name": "pull", "force_N": [60.0, 0.0, 20.0], "cable_m": 0.5},
        ],
        "planning": {"singularity": 0.03},
    }
    return CellConfig.model_validate(usual | sections)


def space_of(config):
    return FeasibleSpace(cell_from_config(config))


def drawn_of(config, count=40, seed=0, **how):
    return draw_poses(space_of(config), count, np.random.default_rng(seed), **how)


place = st.tuples(st.floats(1.0, 3.0), st.floats(-np.pi, np.pi), st.floats(-0.5, 1.5)).map(
    lambda p: [p[0] * np.cos(p[1]), p[0] * np.sin(p[1]), p[2]]
)
boxes = st.tuples(place, st.tuples(*[st.floats(0.1, 0.8)] * 3)).map(
    lambda x: {"name": "box", "center_m": [0.6 * c for c in x[0]], "size_m": list(x[1])}
)
