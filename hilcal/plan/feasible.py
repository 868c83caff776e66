"""Which states a cell allows: limits, workspace, collisions, torques, sight, hanging loads."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from hilcal.acquire import workspace
from hilcal.acquire.clearance import Clearance, clearance_of
from hilcal.acquire.sight import UNKNOWN, LineOfSight, sight_of
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.data.plan import UNLOADED
from hilcal.robot import se3
from hilcal.robot.body import is_known
from hilcal.robot.chain import Chain, evaluate, joint_jacobian
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.types import Bools, Floats, Ints

# Margins of safety: choices, no study behind them.
INSIDE = 0.01  # m, kept from every side of the workspace
MARGIN = 0.02  # m, kept between arm, obstacles, floor and what hangs
MARGIN_SELF = 0.01  # m, kept between parts of the arm
SWEEP = 0.1  # m, the most that any point of the arm goes between two sampled points of a motion
_LEVELS = (16, 4, 1)  # every so many of these points are looked at, in turn
_BELOW = 0.98  # of the usable torque, for what lies between the sampled points

REASONS = {
    "joint limits": ("keep the joint limits", "[limits] joint_margin_rad"),
    "workspace": ("keep the workspace", "[limits] workspace_min_m, workspace_max_m"),
    "self-collision": ("do not touch themselves", "the arm's shape, [tool]"),
    "obstacle": ("are clear of obstacles and floor", "[[obstacles]], [limits] workspace_min_m"),
    "singularity": ("are not singular", "[planning] singularity"),
    "torque": ("keep the joint torques", "[limits] torque_share"),
    "payload": ("keep the payload", "[tool] mass_kg, [[loads]] mass_kg"),
    "force sensor": ("keep the force sensor's range", "[force_sensor] max_force_N, max_moment_Nm"),
    "sight": ("leave the beam free", "[sight] clearance_m, [[obstacles]], the tracker's place"),
    "incidence": ("turn the target to the tracker", "[sight] incidence_max_rad, target_normal"),
    "hanging": ("let what hangs or pulls hang free", "[[loads]] hang_m, radius_m, cable_m"),
}
"""Why a state may be left out, cheap and common reasons first: what the states that stay do, and
what in the cell's configuration decides it."""
_OF_ARM = ("joint limits", "workspace", "collision")


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """The states that a plan may use.

    Attributes:
        cell: the cell.
        config: its limits, loads, obstacles and what the tracker sees.
        shapes: of arm, tool and obstacles.
        sight: the tracker's view; None where its place is not known.
    """

    cell: Cell
    config: CellConfig
    shapes: Clearance = field(init=False)
    sight: LineOfSight | None = field(init=False)
    _last: list[tuple[Floats, Chain]] = field(init=False, repr=False, default_factory=list)

    def __post_init__(self) -> None:
        """Build the shapes once; without a workspace the mounting plane is the floor."""
        low = self.config.limits.workspace_min_m
        shapes = clearance_of(self.cell, self.config, 0.0 if low is None else low[2])
        object.__setattr__(self, "shapes", shapes)
        object.__setattr__(self, "sight", sight_of(shapes))

    @property
    def low(self) -> Floats:
        """(n,) lowest usable joint angles, rad; at most half a turn."""
        return np.asarray(np.maximum(self.cell.arm.q_min, -np.pi) + self._margin)

    @property
    def high(self) -> Floats:
        """(n,) highest usable joint angles, rad; at most half a turn."""
        return np.asarray(np.minimum(self.cell.arm.q_max, np.pi) - self._margin)

    @property
    def _margin(self) -> float:
        return self.config.limits.joint_margin_rad + 1e-6

    @property
    def loads(self) -> tuple[str, ...]:
        """1 + L names of the loads, "none" first."""
        return (UNLOADED, *(load.name for load in self.config.loads))

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is not checked, or is guessed, since it is not configured."""
        out = [] if self.sight is not None else [UNKNOWN]
        if not is_known(self.cell.arm):
            out.append(f"the shape of {self.cell.arm.name} is not known; its links are guessed")
        return tuple(out)

    def reasons(self, q: Floats, load: str = UNLOADED) -> dict[str, Bools]:
        """Return by reason (N,) which states keep it; in the order of `REASONS`.

        Args:
            q: (N, n) joint angles, rad.
            load: name of a load.
        """
        return {reason: self.keeps(reason, q, load) for reason in REASONS}

    def keeps(self, reason: str, q: Floats, load: str = UNLOADED) -> Bools:
        """Return (N,) which states keep one of `REASONS` under a load."""
        checks: dict[str, Callable[[Floats, str], Bools]] = {
            "joint limits": self._limits,
            "workspace": self._workspace,
            "self-collision": self._self,
            "obstacle": self._obstacles,
            "singularity": self._regular,
            "torque": self._torque,
            "payload": self._payload,
            "force sensor": self._sensor,
            "sight": self._free_sight,
            "incidence": self._incidence,
            "hanging": self._hanging,
            "collision": self._collision,
        }
        return checks[reason](q, load)

    def allowed(
        self, q: Floats, load: str = UNLOADED, reasons: tuple[str, ...] = tuple(REASONS)
    ) -> Bools:
        """Return (N,) which states keep all of some reasons under a load; cheap ones first."""
        good = np.ones(len(q), dtype=np.bool_)
        for reason in reasons:
            left = np.flatnonzero(good)
            if not len(left):
                break
            good[left] = self.keeps(reason, q[left], load)
        return good

    def clear(self, q: Floats) -> Bools:
        """Return (N,) which states keep all but torques and sensor, under every load."""
        geometry = tuple(r for r in REASONS if r not in ("torque", "payload", "force sensor"))
        good = self.allowed(q, UNLOADED, geometry)
        for load in self.loads[1:]:
            good[good] = self.allowed(q[good], load, ("sight", "hanging"))
        return good

    def bears(self, q: Floats) -> Bools:
        """Return (N,) in which states arm and sensor bear every load."""
        good = np.ones(len(q), dtype=np.bool_)
        for load in self.loads:
            good[good] = self.allowed(q[good], load, ("payload", "torque", "force sensor"))
        return good

    def passable(self, start: Floats, ends: Floats, load: str | None = None) -> Bools:
        """Return (M,) to which of `ends` (M, n) a straight motion in joint space is clear.

        Limits, workspace, collisions, torques and what hangs are checked, sight and singularity
        only where the arm stops. Between the sampled points no point of arm and tool goes more
        than `SWEEP`, by the bound Σ |Δq_i| r_i with r_i how far arm and tool reach beyond
        joint i.

        Args:
            start: (n,) joint angles, rad.
            ends: (M, n) joint angles, rad.
            load: name of the load that hangs; by default every one in turn.
        """
        sweep = np.abs(ends - start) @ self._beyond()
        count = np.maximum(np.ceil(sweep / SWEEP).astype(np.int64), 1)
        good = np.ones(len(ends), dtype=np.bool_)
        before = 0
        for every in _LEVELS:  # most motions that are not clear show it at a few points
            for name, reasons in self._in_motion(load):
                left = np.flatnonzero(good)
                if not len(left):
                    return good
                owner, share = _samples(count[left], every, before)
                path = start + share[:, None] * (ends[left[owner]] - start)
                bad = owner[~self.allowed(path, name, reasons)]
                good[left[bad]] = False
            before = every
        return good

    def _in_motion(self, load: str | None) -> list[tuple[str, tuple[str, ...]]]:
        """What has to be checked along a motion, by load: shapes that are alike only once."""
        out: list[tuple[str, tuple[str, ...]]] = []
        seen = set()
        for name in self.loads if load is None else (load,):
            hung = self.shapes.load(name)
            shape = None if hung is None else (hung.hanging_m, hung.radius_m, hung.cable_m)
            way = None if shape is None or shape[2] == 0.0 or hung is None else hung.force_N
            reasons = _OF_ARM if not out else ()
            if (shape, way) not in seen:
                reasons = (*reasons, "hanging")
            seen.add((shape, way))
            out.append((name, ("torque", "force sensor", *reasons)))
        return out

    def _beyond(self) -> Floats:
        """(n,) how far arm and tool reach beyond each joint at most, m."""
        tool = max(np.linalg.norm(self.cell.target[:3, 3]), np.linalg.norm(self.cell.load_point))
        lengths = np.linalg.norm(self.cell.arm.links[1:, :3, 3], axis=1)
        return np.asarray(np.cumsum(lengths[::-1])[::-1] + tool)

    def _limits(self, q: Floats, load: str) -> Bools:
        return np.asarray(np.all((q >= self.low) & (q <= self.high), axis=1))

    def _chain(self, q: Floats) -> Chain:
        """The chain in N states; kept for the next reason or load that asks for the same states."""
        if not (self._last and np.array_equal(self._last[0][0], q)):
            self._last[:] = [(q.copy(), evaluate(self.cell.arm, q))]
        return self._last[0][1]

    def _workspace(self, q: Floats, load: str) -> Bools:
        good = np.ones(len(q), dtype=np.bool_)
        for _, _, over, _ in workspace.outside(self.cell, self.config, self._chain(q)):
            good &= over < -INSIDE
        return good

    def _self(self, q: Floats, load: str) -> Bools:
        return ~self.shapes.scene.self_touching(q, MARGIN_SELF)

    def _obstacles(self, q: Floats, load: str) -> Bools:
        return ~self.shapes.scene.obstacles_touching(q, MARGIN)

    def _collision(self, q: Floats, load: str) -> Bools:
        return ~self.shapes.scene.arm_touching(q, MARGIN_SELF, MARGIN)

    def _hanging(self, q: Floats, load: str) -> Bools:
        return ~self.shapes.load_touching(q, load, MARGIN)

    def _regular(self, q: Floats, load: str) -> Bools:
        """σ_min ≥ [planning] singularity · σ_max of the flange's Jacobian, lengths by the reach."""
        least = self.config.planning.singularity
        if least == 0.0 or not len(q):
            return np.ones(len(q), dtype=np.bool_)
        chain = self._chain(q)
        jacobian = np.array(joint_jacobian(chain, chain.position[-1]))
        jacobian[:, :3] /= self.cell.arm.reach
        sigma = np.linalg.svd(jacobian, compute_uv=False)
        return np.asarray(sigma[:, -1] >= least * sigma[:, 0])

    def _torque(self, q: Floats, load: str) -> Bools:
        cell, arm = self.cell, self.cell.arm
        limit = _BELOW * self.config.limits.torque_share * np.asarray(arm.torque_max, dtype=float)
        pull = np.broadcast_to(self._pull(load), (len(q), 6))
        carried = Load(pull, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
        about_axes = slot_wrenches(arm, self._chain(q), carried)[:, : arm.n, 5]
        torque = arm.drive_torques(about_axes)
        return np.asarray(np.all(np.abs(torque) <= limit, axis=1))

    def _payload(self, q: Floats, load: str) -> Bools:
        hung = self.shapes.load(load)
        mass = self.cell.tool_mass + (0.0 if hung is None else hung.mass_kg)
        return np.full(len(q), mass <= self.cell.arm.payload)

    def _sensor(self, q: Floats, load: str) -> Bools:
        """Force and moment of tool and load on the sensor, within what stops the arm."""
        sensor, cell = self.config.force_sensor, self.cell
        if sensor is None:
            return np.ones(len(q), dtype=np.bool_)
        pull, weight = self._pull(load), cell.tool_mass * cell.gravity
        if load != UNLOADED and np.linalg.norm(pull[:3] + weight) > sensor.max_force_N:
            return np.zeros(len(q), dtype=np.bool_)
        chain = self._chain(q)
        origin = chain.point(np.asarray(sensor.origin_m))
        moment = pull[3:] + se3.cross(chain.point(cell.load_point) - origin, pull[:3])
        moment = moment + se3.cross(chain.point(cell.tool_com) - origin, weight)
        return np.asarray(np.linalg.norm(moment, axis=1) <= _BELOW * sensor.max_moment_Nm)

    def _free_sight(self, q: Floats, load: str) -> Bools:
        if self.sight is None:
            return np.ones(len(q), dtype=np.bool_)
        return self.sight.free(q, load)

    def _incidence(self, q: Floats, load: str) -> Bools:
        angle = None if self.sight is None else self.sight.incidence(q)
        most = self.config.sight.incidence_max_rad
        return np.ones(len(q), dtype=np.bool_) if angle is None else np.asarray(angle <= most)

    def _pull(self, load: str) -> Floats:
        """(6,) wrench of a load at the load point, base axes."""
        hung = self.shapes.load(load)
        return np.zeros(6) if hung is None else hung.wrench(self.cell.gravity)


def _samples(count: Ints, every: int, before: int) -> tuple[Ints, Floats]:
    """Whose and where the points are that a level adds: multiples of `every`, and the end.

    Args:
        count: (M,) intervals of every motion.
        every: which points are looked at.
        before: which ones have been; 0 for none.

    Returns:
        owner (S,), share (S,) of the way.
    """
    owner, at = [], []
    for k, n in enumerate(count.tolist()):
        points = np.arange(0, n, every)
        points = points[points % before != 0] if before else np.append(points, n)
        owner.append(np.full(len(points), k))
        at.append(points / n)
    return np.concatenate(owner), np.concatenate(at)
