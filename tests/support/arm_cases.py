"""Arms, states and an independent arithmetic of rigid displacements for the tests of the arm."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import scipy.linalg as sl

from hilcal.cell import STANDARD_GRAVITY, Cell
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm, robot_names

ODD, RAILS = "odd", "rails"
ARMS = (*robot_names(), ODD, RAILS)


def arm_of(name):
    """An arm of the catalogue, drawn; or one of seven joints with axes in odd directions."""
    if name not in (ODD, RAILS):
        return replace(load_arm(name), coupling=None, drive=None)
    rng = np.random.default_rng(7)
    n = 7
    slides = np.isin(np.arange(n), [0, 3, 6]) & (name == RAILS)
    ends = rng.normal(size=(n + 1, 6)) * [0.3, 0.3, 0.3, 1.5, 1.5, 1.5]
    return Arm(
        name=name,
        links=np.array([displacement(end) for end in ends]),
        masses=rng.uniform(0.5, 8.0, n),
        coms=rng.normal(size=(n, 3)) * 0.1,
        q_min=np.full(n, -np.pi),
        q_max=np.full(n, np.pi),
        torque_max=np.where(slides, 2000.0, 800.0 if name == RAILS else 200.0),
        payload=5.0,
        joint_names=tuple(f"j{i + 1}" for i in range(n)),
        source="made up",
        prismatic=slides if name == RAILS else None,
    )


def cell_of(arm, gravity=STANDARD_GRAVITY):
    """A cell in which nothing is at the origin or aligned."""
    return Cell(
        arm=arm,
        target=displacement([0.05, 0.02, 0.11, 0.4, -0.3, 0.9]),
        load_point=np.array([0.03, -0.02, 0.12]),
        tool_mass=1.3,
        tool_com=np.array([0.01, 0.03, 0.06]),
        gravity=np.array(gravity),
        registration=displacement([2.0, -1.0, 0.4, 0.2, -0.1, 2.1]),
        registration_known=False,
        target_known=False,
    )


def displacement(twist):
    """(4, 4) exponential of a twist (v, ω), by the matrix exponential of SciPy."""
    v, w = np.asarray(twist, dtype=float)[:3], np.asarray(twist, dtype=float)[3:]
    hat = np.zeros((4, 4))
    hat[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    hat[:3, 3] = v
    return np.asarray(sl.expm(hat))


def twisted(arm, twist):
    """The arm whose links end in the twists (n + 1, 6) of one state."""
    ends = [pin.exp6(pin.Motion(t)).homogeneous for t in twist]
    return replace(arm, links=arm.links @ np.array(ends))


def slots_of(arm, q):
    """(n + 1, 4, 4) slots of one state, by products of homogeneous matrices."""
    pose, out = arm.links[0], [arm.links[0]]
    for value, slides, link in zip(q, arm.slides, arm.links[1:], strict=True):
        motion = [0, 0, value, 0, 0, 0] if slides else [0, 0, 0, 0, 0, value]
        pose = pose @ displacement(motion) @ link
        out.append(pose)
    return np.array(out)


def flange_at(chain, state, pose, atol=1e-12):
    """Assert where the flange is in a state: a pose (4, 4)."""
    result = chain.rotation[-1, state], chain.position[-1, state]
    np.testing.assert_allclose(np.column_stack(result), pose[:3], rtol=0, atol=atol)


def same_flange(one, other):
    """Assert that the flange is at the same poses."""
    for of in ("position", "rotation"):
        ends = (getattr(chain, of)[-1] for chain in (one, other))
        np.testing.assert_allclose(*ends, rtol=0, atol=1e-12)


def classic_flange(rows, q):
    """Flange (4, 4) of θ, a, d, α (4, n) at angles (n,), by the closed form of a classic row."""
    pose = np.eye(4)
    for (theta, a, d, alpha), angle in zip(rows.T, q, strict=True):
        c, s, ca, sa = (f(x) for x in (angle + theta, alpha) for f in (np.cos, np.sin))
        row = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d]]
        pose = pose @ np.array([*row, [0, 0, 0, 1]])
    return pose


def slope(f, h):
    """Central difference of f at 0, of fourth order."""
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)
