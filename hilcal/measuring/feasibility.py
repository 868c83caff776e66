"""Feasibility of states and motions of a cell: one rule for planner, dry run and guard."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.config import ForceSensor
from hilcal.measuring.clearance import Clearance
from hilcal.robot import se3
from hilcal.robot.chain import Chain, evaluate
from hilcal.robot.scene import Pairs, Segment, body_poses, from_axis, is_known, on_flange
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

JOINTS, WORKSPACE, ITSELF = "joint limits", "workspace", "self-collision"
OBSTACLE, HANGING, TORQUE = "obstacle", "hanging", "torque"
SENSOR, PAYLOAD, SIGHT, INCIDENCE = "force sensor", "payload", "sight", "incidence"
STATE_CHECKS = (JOINTS, WORKSPACE, TORQUE, SENSOR, ITSELF, OBSTACLE, HANGING)
"""Checks of every state, in motion too."""
MOTION_CHECKS = tuple(kind for kind in STATE_CHECKS if kind != JOINTS)
"""Checks of a straight motion between ends that pass `STATE_CHECKS`: joint limits hold between."""

BETWEEN_M = 0.001
"""Largest undershoot of a margin by an allowed motion, m."""
BETWEEN_SHARE = 0.01
"""The same for torques and the force sensor's moment, as a share of the usable value."""
_COARSE_M = 0.5  # largest motion of any point in the first parts of a motion, m
_SHOWN = 101  # points of a motion that are searched for its worst finding
_ROUNDING = 1e-9
_SIDES = tuple((axis, low) for axis in range(3) for low in (True, False))


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins beyond the limits; negative: slack."""

    joint: float = 0.0  # from `[limits] joint_margin_rad`, rad
    workspace: float = 0.0  # from the sides of the workspace and from the floor, m
    clearance: float = 0.005  # between arm, obstacles and hanging load, m
    self_collision: float = 0.005  # between parts of the arm, m
    torque_share: float = 1.0  # share of the usable torque and of the force sensor's moment


@dataclass(frozen=True, slots=True)
class Violation:
    """A limit that a state or a motion violates."""

    kind: str  # one of `STATE_CHECKS`
    subject: str  # body, side or joint
    load: str  # name of the load if its weight or pull is the cause
    text: str  # body, distance and limit, without the place

    @property
    def key(self) -> tuple[str, str, str]:
        """Key among the violations of one place."""
        return self.kind, self.subject, self.load

    def line(self, where: str) -> str:
        """Return the line for people: place, load and text."""
        return f"{where}{'' if self.load == UNLOADED else f' under {self.load}'}: {self.text}"


class Feasibility:
    """The states and straight motions that a cell allows.

    The capsules of all bodies are checked against workspace and obstacles, except base and
    shoulder, which stand where the arm is mounted. The upper arm is checked against those sides of
    the workspace that the shoulder respects at any angle. Without `workspace_min_m`, the mounting
    plane z = 0 is the floor.

    Between the samples of a motion, a gap changes by at most Σ |Δθ_i| r_i, with r_i the largest
    distance of the body from the axis of joint i (`Scene.rates`). A part of a motion passes if the
    gap in its middle is larger than that; otherwise it is halved, until the change is `BETWEEN_M`
    at most. Torques and moments are checked in the same way by their rates.
    """

    def __init__(self, cell: Cell, margins: Margins | None = None) -> None:
        """Build the shapes once."""
        config = cell.configured()
        self.cell, self.config = cell, config
        self.margins = Margins() if margins is None else margins
        self.shapes = Clearance(cell)
        self.sight = self.shapes.sight
        guess = f"the shape of {cell.arm.name} is not known: its links are guessed"
        self._guessed = "" if is_known(cell.arm) else guess
        low, high = config.limits.workspace_min_m, config.limits.workspace_max_m
        self._floor = low is None
        self._box = (low or (-np.inf, -np.inf, 0.0), high or (np.inf, np.inf, np.inf))
        self._set_bodies()
        self._set_levers()

    @property
    def remarks(self) -> tuple[str, ...]:
        """Guesses, one sentence each."""
        return (self._guessed,) if self._guessed else ()

    # states

    def passes(self, kind: str, q: Floats, load: str = UNLOADED) -> Bools:
        """Return (N,) whether states (N, n) pass a check of `STATE_CHECKS`, payload or sight."""
        if kind == SIGHT:
            return self._always(q) if self.sight is None else self.sight.unobstructed(q, load)
        if kind == INCIDENCE:
            angle = None if self.sight is None else self.sight.incidence(q)
            most = self.config.sight.incidence_max_rad
            return self._always(q) if angle is None else np.asarray(angle <= most)
        if kind in self.unbearable(load):
            return ~self._always(q)
        return self._always(q) if kind == PAYLOAD else ~self._beyond(kind, q, load)

    def allowed(
        self, q: Floats, load: str = UNLOADED, kinds: tuple[str, ...] = STATE_CHECKS
    ) -> Bools:
        """Return (N,) whether states pass the checks of some kinds under a load, made in order."""
        good = self._always(q)
        for kind in kinds:
            remaining = np.flatnonzero(good)
            if not len(remaining):
                break
            good[remaining] = self.passes(kind, q[remaining], load)
        return good

    def findings(
        self, q: Floats, load: str, kinds: tuple[str, ...] = STATE_CHECKS
    ) -> Iterator[Violation]:
        """Yield the violations of the states (N, n) under a load, each at its worst."""
        chain = evaluate(self.cell.arm, q)
        for kind in kinds:
            for part in self._parts(kind, q, chain, load):
                yield from part.findings(kind)

    def unbearable(self, load: str) -> dict[str, str]:
        """Return why arm or force sensor cannot bear a load in any state, a line per kind."""
        arm, tool, hung_load = self.cell.arm, self.cell.tool_mass, self.shapes.load(load)
        mass = tool + (0.0 if hung_load is None else hung_load.mass_kg)
        out = {}
        if mass > arm.payload + _ROUNDING:
            subject = f'load "{load}": tool and load are' if hung_load else "the tool is"
            limit = f"the payload of {arm.name} is {arm.payload:g} kg"
            out[PAYLOAD] = f"{subject} {mass:.4g} kg; {limit}"
        sensor = self.config.force_sensor
        force = float(np.linalg.norm(self._pull(load)[:3] + tool * self.cell.gravity))
        if sensor is not None and hung_load is not None and force > sensor.max_force_N:
            out[SENSOR] = (
                f'load "{load}": tool and load pull with {force:.4g} N; [force_sensor] '
                f"max_force_N is {sensor.max_force_N:g}"
            )
        return out

    # motions

    def passable(self, start: Floats, ends: Floats, load: str) -> Bools:
        """Return (M,) which straight motions to `ends` (M, n) are clear under a load."""
        good = self._always(ends)
        for kind in MOTION_CHECKS:
            remaining = np.flatnonzero(good)
            good[remaining] = self._search(kind, start, ends[remaining], load)[0]
        return good

    def findings_between(self, start: Floats, end: Floats, load: str) -> Iterator[Violation]:
        """Yield the violations of a straight motion between two states (n,), at their worst."""
        for kind in MOTION_CHECKS:
            good, bad = self._search(kind, start, end[None], load)
            if not good[0]:
                share = np.linspace(0.0, 1.0, _SHOWN)[:, None]
                yield from self.findings(
                    np.vstack([bad, start + share * (end - start)]), load, (kind,)
                )

    def _search(self, kind: str, start: Floats, ends: Floats, load: str) -> tuple[Bools, Floats]:
        """Return which motions (M,) pass a kind, and states (K, n) that violate it."""
        good = self._always(ends)
        turn = np.abs(self.cell.arm.chain_angles(ends - start))
        count = np.maximum(np.ceil((turn @ self._farthest) / _COARSE_M), 1).astype(np.int64)
        motion = np.repeat(np.arange(len(ends)), count)
        width = 1.0 / count[motion]
        share = (np.arange(len(motion)) - (np.cumsum(count) - count)[motion] + 0.5) * width
        shown = [np.empty((0, ends.shape[1]))]
        while len(motion):
            q = start + share[:, None] * (ends[motion] - start)
            close = np.flatnonzero(self._beyond(kind, q, load, 0.5 * width[:, None] * turn[motion]))
            bad = close[self._beyond(kind, q[close], load)]
            good[motion[bad]] = False
            shown.append(q[bad])
            remaining = close[good[motion[close]]]
            motion, width = np.repeat(motion[remaining], 2), 0.5 * np.repeat(width[remaining], 2)
            sides = np.tile([-1.0, 1.0], len(remaining))
            share = np.repeat(share[remaining], 2) + 0.5 * width * sides
        return good, np.vstack(shown)

    def _beyond(self, kind: str, q: Floats, load: str, turn: Floats | None = None) -> Bools:
        """Return (N,) whether states violate a kind, or may after turns of up to (N, n)."""
        out = ~self._always(q)
        if not len(q):
            return out
        for part in self._parts(kind, q, evaluate(self.cell.arm, q), load):
            remaining = np.flatnonzero(~out)
            if len(remaining):
                out[remaining] = part.beyond(remaining, None if turn is None else turn[remaining])
        return out

    # checks

    def _parts(self, kind: str, q: Floats, chain: Chain, load: str) -> Iterator["_Bounds | _Touch"]:
        scene, margins = self.shapes.scene, self.margins
        if kind == JOINTS:
            yield self._joints(q)
        elif kind == WORKSPACE:
            places = self._places(body_poses(self.cell.arm, q, chain), slice(None))
            yield self._inside(self._names, places, self._radius, self._checked_sides, self._rates)
        elif kind == TORQUE:
            yield self._torque(chain, load)
        elif kind == SENSOR and (sensor := self.config.force_sensor) is not None:
            yield self._moment(sensor, chain, load)
        elif kind == ITSELF:
            pairs = scene.self_pairs
            yield _Touch(pairs, q, margins.self_collision, pairs.rates, guessed=self._guessed)
        elif kind == OBSTACLE:
            yield _Touch(scene.obstacle_pairs, q, margins.clearance, scene.obstacle_pairs.rates)
        elif kind == HANGING:
            segments = self.shapes.segments_at(chain.point(self.cell.load_point), load)
            if segments:
                places = np.stack([np.stack([x.start, x.end], axis=1) for x in segments], axis=1)
                sides = np.ones((len(segments), len(_SIDES)), dtype=np.bool_)
                rates = np.tile(self._at_hook, (len(segments), 1))
                radius = np.array([x.radius for x in segments])
                yield self._inside([x.name for x in segments], places, radius, sides, rates)
            for segment in segments:
                yield _Touch(scene.segment_pairs, q, margins.clearance, self._load_rates, segment)

    def _joints(self, q: Floats) -> "_Bounds":
        arm, margin = self.cell.arm, self.config.limits.joint_margin_rad
        low, high = arm.q_min + margin, arm.q_max - margin
        extra = self.margins.joint

        def violation(k: int, state: int) -> Violation:
            name = arm.joint_names[k]
            text = (
                f"{name} is at {q[state, k]:.4g} {arm.unit(k)}; usable are {low[k]:.4g} to "
                f"{high[k]:.4g} (joint_margin_rad {margin:g})"
            )
            return Violation(JOINTS, name, UNLOADED, text)

        over = np.maximum(low - q, q - high) + extra
        return _Bounds(over, np.zeros((arm.n, arm.n)), np.zeros(arm.n), violation)

    def _inside(
        self, names: list[str], places: Floats, radius: Floats, sides: Bools, rates: Floats
    ) -> "_Bounds":
        """Check capsules (N, B, 2, 3) with radii (B,) against sides (B, 6) of the workspace."""
        low, high = places.min(axis=2) - radius[:, None], places.max(axis=2) + radius[:, None]
        over = np.stack([self._box[0] - low, high - self._box[1]], axis=3)
        body, side = np.nonzero(sides)
        margin = self.margins.workspace

        def violation(k: int, state: int) -> Violation:
            name, (axis, below) = names[body[k]], _SIDES[side[k]]
            far, limit = chosen[state, k] - margin, self._box[0 if below else 1][axis]
            text = f"{name} is {far:.3g} m outside the workspace, whose {'xyz'[axis]} ends at "
            text += f"{limit:g} m"
            if below and self._floor:
                text = (
                    f"{name} is {far:.3g} m below the mounting plane z = 0; where the arm may go "
                    "there, [limits] workspace_min_m says how far, e.g. [-2.0, -2.0, -1.0]"
                )
            return Violation(WORKSPACE, f"{name} {axis} {below}", UNLOADED, text)

        chosen = over.reshape(len(over), len(names), len(_SIDES))[:, body, side] + margin
        return _Bounds(chosen, rates[body], np.full(len(body), BETWEEN_M), violation)

    def _torque(self, chain: Chain, load: str) -> "_Bounds":
        cell, arm, share = self.cell, self.cell.arm, self.config.limits.torque_share
        pull = self._pull(load)
        wrench = np.broadcast_to(pull, (chain.position.shape[1], 6))
        carried = Load(wrench, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
        torque = np.abs(arm.drive_torques(arm.joint_components(slot_wrenches(arm, chain, carried))))
        usable = share * np.asarray(arm.torque_max, dtype=float)
        slides = arm.slides

        def violation(k: int, state: int) -> Violation:
            name = arm.joint_names[k]
            text = (
                f"{name} bears {torque[state, k]:.4g} {'N' if slides[k] else 'N·m'}; usable are "
                f"{usable[k]:.4g} "
                f"(torque_share {share:g} of {arm.torque_max[k]:g})"
            )
            return Violation(TORQUE, name, load, text)

        # a joint moves the points of the forces beyond it, or, before the axis, the axis itself
        gravity, joint = float(np.linalg.norm(cell.gravity)), np.arange(arm.n)
        weights = gravity * np.append(arm.masses, cell.tool_mass)
        torque_rate = self._levers @ np.append(weights, np.linalg.norm(pull[:3]))
        rates = torque_rate[np.maximum(joint[:, None], joint)]
        rates += np.linalg.norm(pull[3:]) * (joint < joint[:, None])
        # a slide shifts the points beyond it; a joint before a slide turns its travel
        force = weights.sum() + np.linalg.norm(pull[:3])
        rates = np.where(slides[:, None] | slides, force, rates)
        drive = np.eye(arm.n) if arm.drive is None else np.abs(arm.drive)
        limit = self.margins.torque_share * usable
        return _Bounds(torque - limit, drive.T @ rates, BETWEEN_SHARE * usable, violation)

    def _moment(self, sensor: ForceSensor, chain: Chain, load: str) -> "_Bounds":
        cell, pull = self.cell, self._pull(load)
        origin_on_flange = np.asarray(sensor.origin_m)
        weight, origin = cell.tool_mass * cell.gravity, chain.point(origin_on_flange)
        moment = pull[3:] + se3.cross(chain.point(cell.load_point) - origin, pull[:3])
        moment = moment + se3.cross(chain.point(cell.tool_com) - origin, weight)
        size = np.linalg.norm(moment, axis=1)[:, None]
        most = sensor.max_moment_Nm

        def violation(k: int, state: int) -> Violation:
            text = f"{size[state, k]:.4g} N·m on the force sensor; max_moment_Nm is {most:g}"
            return Violation(SENSOR, "moment", load, text)

        levers = (
            (cell.load_point - origin_on_flange, pull[:3]),
            (cell.tool_com - origin_on_flange, weight),
        )
        rate = sum(float(np.linalg.norm(a) * np.linalg.norm(f)) for a, f in levers)
        rates = np.full((1, cell.arm.n), rate)
        limit = self.margins.torque_share * most
        return _Bounds(size - limit, rates, np.array([BETWEEN_SHARE * most]), violation)

    # helpers

    def _set_bodies(self) -> None:
        """Set the capsules, the sides of the workspace to check each against, and their rates."""
        scene, arm = self.shapes.scene, self.cell.arm
        parts = scene.parts
        self._names = [part.name for part in parts]
        self._body = np.array([part.body for part in parts])
        self._ends = np.array([[part.start, part.end] for part in parts])
        self._radius = np.array([part.radius for part in parts])
        self._rates = scene.rates
        moving = self._body > min(2, arm.n - 1)
        self._checked_sides = np.repeat(moving[:, None], len(_SIDES), axis=1)
        mount = self._body < min(2, arm.n - 1)
        turns = np.zeros((64, arm.n))
        first, last = (arm.q_min[0], arm.q_max[0]) if arm.slides[0] else (-np.pi, np.pi)
        turns[:, 0] = np.linspace(first, last, len(turns))
        places = self._places(body_poses(arm, turns), mount)
        everywhere = np.ones((int(mount.sum()), len(_SIDES)), dtype=np.bool_)
        names = [self._names[k] for k in np.flatnonzero(mount)]
        fixed = self._inside(names, places, self._radius[mount], everywhere, self._rates[mount])
        outside = fixed.over.reshape(-1, len(_SIDES)) - self.margins.workspace
        respected = mount.any() & np.all(outside <= 0.0, axis=0)
        self._checked_sides |= (~moving & ~mount)[:, None] & respected
        hook = on_flange(arm, self.cell.load_point)[None]
        self._at_hook = np.array([from_axis(arm, arm.n, hook, i + 1) for i in range(arm.n)])
        self._load_rates = scene.load_rates(self.cell.load_point)
        self._farthest = np.vstack([self._rates, self._at_hook]).max(axis=0)

    def _set_levers(self) -> None:
        """Set the distances (n, n + 2), m, of weights and load point from each axis before them."""
        cell, arm = self.cell, self.cell.arm
        points = [(k + 1, com) for k, com in enumerate(arm.coms)]
        points += [(arm.n, on_flange(arm, x)) for x in (cell.tool_com, cell.load_point)]
        self._levers = np.array(
            [
                [from_axis(arm, b, x[None], i) if b >= i else 0.0 for b, x in points]
                for i in range(1, arm.n + 1)
            ]
        )

    def _places(self, poses: Floats, which: Bools | slice) -> Floats:
        """Return ends (N, B, 2, 3) of some capsules, from poses (N, n + 1, 4, 4) of all bodies."""
        bodies = poses[:, self._body[which]]
        ends = bodies[:, :, None, :3, :3] @ self._ends[which][..., None]
        return np.asarray(ends[..., 0] + bodies[:, :, None, :3, 3])

    def _always(self, q: Floats) -> Bools:
        return np.ones(len(q), dtype=np.bool_)

    def _pull(self, load: str) -> Floats:
        """Return the wrench (6,) of a load at the load point, base axes; zero unloaded."""
        hung = self.shapes.load(load)
        return np.zeros(6) if hung is None else hung.wrench(self.cell.gravity)


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    """Constraints x ≤ 0 in N states."""

    over: Floats  # (N, K) x
    rates: Floats  # (K, n) largest |∂x/∂θ| by the joints of the chain
    tolerance: Floats  # (K,) allowed x > 0 between the samples of a motion
    violation: Callable[[int, int], Violation]  # of column k in a state

    def beyond(self, rows: Ints, turn: Floats | None) -> Bools:
        """Return (R,) whether states violate a constraint, or may after turns of up to (R, n)."""
        over = self.over[rows]
        if turn is not None:
            over = over + np.maximum(turn @ self.rates.T - self.tolerance, 0.0)
        return np.asarray(~np.all(over <= _ROUNDING, axis=1))  # NaN is a violation

    def findings(self, kind: str) -> Iterator[Violation]:
        worst: dict[str, tuple[float, Violation]] = {}
        for k, state in enumerate(self.over.argmax(axis=0).tolist()):
            over = float(self.over[state, k])
            if not over <= _ROUNDING:
                broken = self.violation(k, state)
                if broken.subject not in worst or worst[broken.subject][0] < over:
                    worst[broken.subject] = over, broken
        yield from (broken for _, broken in worst.values())


@dataclass(frozen=True, slots=True, eq=False)
class _Touch:
    """Pairs of shapes that must keep a margin in N states; see `_Bounds`."""

    pairs: Pairs
    q: Floats  # (N, n) joint angles, rad
    margin: float  # m
    rates: Floats  # (K, n) largest rate of approach of each pair, m/rad
    segment: Segment | None = None  # hanging load or cable in the N states
    guessed: str = ""  # remark on guessed shapes; empty where they are known

    def beyond(self, rows: Ints, turn: Floats | None) -> Bools:
        """Return (R,) whether shapes are too close, or may be after turns of up to (R, n)."""
        if turn is None:
            return self.pairs.touching(self.q[rows], self.margin, self._segment(rows))
        out = np.zeros(len(rows), dtype=np.bool_)
        first = np.flatnonzero(np.append(True, np.any(np.diff(turn, axis=0) != 0.0, axis=1)))
        for a, b in zip(first, [*first[1:], len(rows)], strict=True):  # parts of one motion
            near = self.margin + np.maximum(self.rates @ turn[a] - BETWEEN_M, 0.0)
            states = rows[a:b]
            out[a:b] = self.pairs.touching(self.q[states], near, self._segment(states))
        return out

    def findings(self, kind: str) -> Iterator[Violation]:
        for (a, b), gap in self.pairs.close_pairs(self.q, self.margin, self.segment).items():
            if gap < 0.0:
                text = f"they overlap by {-gap:.3g} m"
            else:
                text = f"they are {gap:.3g} m apart, {self.margin:g} m are kept"
            text += f" ({self.guessed})" if self.guessed else ""
            yield Violation(kind, f"{a} and {b}", UNLOADED, f"{a} and {b} collide: {text}")

    def _segment(self, rows: Ints) -> Segment | None:
        x = self.segment
        return x and Segment(x.name, x.start[rows], x.end[rows], x.radius, x.ignored)
