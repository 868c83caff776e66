"""A waypoint is corrected only on the branch on which the controller reaches it."""

import numpy as np
import pytest

from hilcal.calibration.compensation import invert
from hilcal.calibration.points import Points, on_branch
from hilcal.calibration.programs.urscript import NEAREST, NOT_STRAIGHT, UNKNOWN, doubts, waypoints
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from hilcal.robot.se3 import rotation_vector

ARM, TOOL = load_arm("ur10e"), np.eye(4)
A = np.array([0.2, -1.6, 1.6, -1.5, -1.4, 0.1])
FLIPPED = A * [1, 1, 1, 1, -1, 1] + [0, 0, 0, np.pi, 0, np.pi]
"""The same orientation of the flange, but for the arm's own calibration."""


def poses(q):
    chain = evaluate(ARM, q)
    return chain.rotation[-1], chain.point(np.zeros(3)), chain


def joints(q):
    return f"[{', '.join(f'{v:.12f}' for v in q)}]"


def pose(q):
    r, p, _ = poses(q[None])
    return f"p{joints(np.concatenate([p[0], rotation_vector(r)[0]]))}"


def branch_doubts(*lines, near=None):
    program = waypoints("\n".join(lines) + "\n")
    assert not any(w.not_corrected for w in program)
    none, nowhere = np.full(6, np.nan), np.full((4, 4), np.nan)
    points = Points(
        tuple(str(w.line) for w in program),
        np.stack([none if w.q is None else w.q for w in program]),
        np.stack([nowhere if w.pose is None else w.pose for w in program]),
    )
    q = on_branch(points, ARM, TOOL, near)
    return doubts(ARM, TOOL, program, q, near), q


def test_waypoints_as_programs_have_them_are_certain():
    b = A + np.array([0.5, 0.1, -0.2, 0.1, 0.1, 0.3])
    c = A - np.array([0.6, -0.2, -0.1, 0.3, 0, 0])
    why, q = branch_doubts(
        f"movej({joints(A)})",
        f"movel({pose(b)})",
        f"movep({joints(c)})",
        f"movej(get_inverse_kin({pose(A)}, qnear={joints(A + 0.05)}))",
        f"movej({pose(A + 0.1)})",
        f"movel(get_inverse_kin({pose(b)}, qnear={joints(b)}))",
        f"movel({joints(b + 2 * np.pi * np.eye(6)[0])})",  # the same pose
        f"movej({joints(FLIPPED)})",
    )
    assert why == [""] * 8
    np.testing.assert_allclose(q[[1, 3, 4, 5]], [b, A, A + 0.1, b], atol=1e-9)


def test_joint_values_of_another_branch_are_not_where_a_straight_motion_ends():
    assert branch_doubts(f"movej({joints(A)})", f"movel({joints(FLIPPED)})", f"movel({pose(A)})")[
        0
    ] == [
        "",
        NOT_STRAIGHT,
        UNKNOWN,
    ]
    assert branch_doubts(f"movel({joints(FLIPPED)})")[0] == [
        ""
    ]  # as they are, where nothing is known
    assert branch_doubts(f"movej({joints(A)})", f"movej({joints(FLIPPED)})")[0] == ["", ""]


def test_near_to_two_branches_is_uncertain():
    between = 0.5 * (A + FLIPPED)
    line = f"movej(get_inverse_kin({pose(A)}, qnear={joints(between)}))"
    assert branch_doubts(line)[0] == [NEAREST]
    assert branch_doubts(f"movel({pose(A)})", near=A + 0.1)[0] == [""]


@pytest.mark.long
def test_what_is_certain_is_the_nearest_of_all_solutions():
    """Of 60 such cases, Newton's method from there finds another solution in the last two."""
    cases = np.random.default_rng(0).normal(size=(60, 2, 6)) * [[0.4], [0.5]]
    starts = np.random.default_rng(1).uniform(-np.pi, np.pi, (60, 6))
    for k in (0, 1, 35, 57):
        near = A + cases[k, 0]
        goal = near + cases[k, 1]
        (why,), q = branch_doubts(f"movej(get_inverse_kin({pose(goal)}, qnear={joints(near)}))")
        r, p, _ = poses(goal[None])
        every = invert(
            ARM, lambda at, _: poses(at), starts, np.repeat(r, 60, 0), np.repeat(p, 60, 0)
        )
        turns = (every.q[every.solved] - near + np.pi) % (2 * np.pi) - np.pi
        distance = np.linalg.norm((q[0] - near + np.pi) % (2 * np.pi) - np.pi)
        assert distance <= np.linalg.norm(turns, axis=1).min() + 1e-6
        assert why == ""
