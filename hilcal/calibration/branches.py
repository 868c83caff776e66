"""Whether a controller takes the branch of the arm on which a waypoint was corrected.

A pose has up to eight solutions. `get_inverse_kin(pose, qnear=joints)` and `movej` to a pose take
the one nearest to given joint values, or to where the arm stands; the manual does not say by which
measure. A straight motion stays on the branch that it begins on, whatever joint values its target
is stated by. A correction is right on one branch only.
"""

from collections.abc import Sequence

import numpy as np

from hilcal.calibration.compensation import invert_nominal, nominal_pose
from hilcal.calibration.urscript import Waypoint
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Bools, Floats

STEPS = 40
"""Poses between two waypoints of a straight motion; a choice."""
LARGEST_STEP = 0.5
"""Turn of a joint from one of these to the next beyond which the motion passes a singularity, rad;
a choice."""
SAME = 1e-6
"""Joint values that are the same solution, rad: far above the residual of one, far below what is
between two."""
AS_NEAR = 0.05
"""What another solution must be farther for this one to be the nearest by any measure, rad. A
controller has its own calibrated arm: of 1,024 motions of ur3e, ur5e and ur10e the branch is wrong
in 1 at 0.02 and in none from 0.05 on, where each joint of each solution may be 10 mrad elsewhere;
17 are left uncertain at 0.05, 33 at 0.1, 62 at 0.2."""
NEAREST = "another branch of the arm is as near; joint values in place of the pose say which"
STRAIGHT = "a straight motion from the waypoint before ends on another branch of the arm; use movej"
UNKNOWN = "the branch of the waypoint before it is not known"


def doubts(
    arm: Arm, tool: Floats, waypoints: Sequence[Waypoint], q: Floats, near: Floats | None
) -> list[str]:
    """Say why the branch of a waypoint is not certain; empty where it is.

    Args:
        tool: (4, 4) T_flange_tool.
        q: (N, 6) joint values at which the nominal arm has the tool there, rad.
        near: (6,) joint values that the first waypoint is near to; None where none are given.
    """
    if not waypoints:
        return []
    before = np.concatenate([q[:1] if near is None else near[None], q[:-1]])
    stated = np.stack([before[k] if w.q is None else w.q for k, w in enumerate(waypoints)])
    led = np.array([k > 0 and w.straight and w.follows for k, w in enumerate(waypoints)])
    chosen = np.array([w.pose is not None for w in waypoints])
    chosen &= ~led | np.array([w.q is not None for w in waypoints])
    other = chosen & ~_nearest(arm, tool, stated, q)
    bent = led & ~_straight(arm, tool, before, q)
    out: list[str] = []
    for k, w in enumerate(waypoints):
        unknown = k > 0 and out[-1] and (led[k] or (w.q is None and w.pose is not None))
        out.append(UNKNOWN if unknown else NEAREST if other[k] else STRAIGHT if bent[k] else "")
    return out


def _nearest(arm: Arm, tool: Floats, near: Floats, q: Floats) -> Bools:
    """(N,) whether no other solution of the poses at q (N, 6) is as near to joint values (N, 6)."""
    rotation, position, _ = nominal_pose(arm, tool, q)
    mine = _turn(q - near)
    out = np.ones(len(q), dtype=bool)
    for start in _flipped(q):
        found = invert_nominal(arm, tool, start, rotation, position)
        other = found.solved & (np.abs(_turn(found.q - q)).max(axis=1) > SAME)
        theirs = _turn(found.q - near)
        for order in (1, 2, np.inf):
            least = np.linalg.norm(mine, order, axis=1) + AS_NEAR
            farther = np.linalg.norm(theirs, order, axis=1) > least
            out &= ~other | farther
    return out


def _flipped(q: Floats) -> list[Floats]:
    """Joint values (N, 6) from which Newton's method finds the other solutions."""
    wrist = q + np.array([0, 0, 0, np.pi, 0, np.pi])
    wrist[:, 4] = -q[:, 4]
    out = [q, wrist]
    for one in (q, wrist):
        elbow = one.copy()
        elbow[:, 2] *= -1
        elbow[:, [1, 3]] += one[:, 2:3]
        out.append(elbow)
    for one in list(out):
        shoulder = one.copy()
        shoulder[:, 0] += np.pi
        shoulder[:, 1] = -np.pi - one[:, 1]
        shoulder[:, 2:4] *= -1
        out.append(shoulder)
    return [_turn(one) for one in out[1:]]


def _straight(arm: Arm, tool: Floats, begin: Floats, q: Floats) -> Bools:
    """(N,) whether the straight motion from joint values (N, 6) to the poses at q ends at q."""
    r0, p0, _ = nominal_pose(arm, tool, begin)
    r1, p1, _ = nominal_pose(arm, tool, q)
    turn = se3.rotation_vector(se3.product(r1, np.swapaxes(r0, 1, 2)))
    at, out = begin, np.ones(len(q), dtype=bool)
    for share in np.arange(1, STEPS + 1) / STEPS:
        rotation = se3.product(se3.rotation(share * turn), r0)
        found = invert_nominal(arm, tool, at, rotation, p0 + share * (p1 - p0))
        out &= found.solved & (np.abs(found.q - at).max(axis=1) < LARGEST_STEP)
        at = found.q
    return np.asarray(out & (np.abs(_turn(at - q)).max(axis=1) < SAME))


def _turn(angle: Floats) -> Floats:
    """Angles from -π to π."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
