"""What a state and a motion of a cell must keep: one rule for planner, dry run and guard."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig, ForceSensor
from hilcal.measuring.clearance import Clearance
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.body import body_poses, is_known
from hilcal.robot.chain import Chain, evaluate
from hilcal.robot.scene import Pairs, Segment, from_axis, on_flange
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

JOINTS, WORKSPACE, ITSELF = "joint limits", "workspace", "self-collision"
OBSTACLE, HANGING, TORQUE = "obstacle", "hanging", "torque"
SENSOR, PAYLOAD, SIGHT, INCIDENCE = "force sensor", "payload", "sight", "incidence"
STATE = (JOINTS, WORKSPACE, TORQUE, SENSOR, ITSELF, OBSTACLE, HANGING)
"""What every state must keep, in motion too."""
WAY = tuple(kind for kind in STATE if kind != JOINTS)
"""What a straight motion must keep whose ends keep `STATE`: it keeps joint limits by itself."""

BETWEEN_M = 0.001
"""A motion that is allowed comes nowhere closer than its margin by more than this, m."""
BETWEEN_SHARE = 0.01
"""The same of torques and of the force sensor's moment, share of what is usable."""
_COARSE_M = 0.5  # m, the farthest that any point goes in the first parts of a motion
_SHOWN = 101  # points at which the worst of a motion is looked for, for people
_ROUNDING = 1e-9
_SIDES = tuple((axis, low) for axis in range(3) for low in (True, False))


@dataclass(frozen=True, slots=True)
class Margins:
    """What is kept beyond the limits; negative is slack."""

    joint: float = 0.0  # from `[limits] joint_margin_rad`, rad
    inside: float = 0.0  # from the sides of the workspace and from the floor, m
    clear: float = 0.005  # between arm, obstacles and what hangs, m
    itself: float = 0.005  # between parts of the arm, m
    bear: float = 1.0  # share of the usable torque and of the force sensor's moment


@dataclass(frozen=True, slots=True)
class Violation:
    """What a state or a motion does not keep."""

    kind: str  # one of `STATE`
    of: str  # which body, side or joint
    load: str  # name of the load where the finding is due to its weight or pull
    text: str  # which body, how far, and which limit, without the place

    @property
    def what(self) -> tuple[str, str, str]:
        """What tells it from others of the same place."""
        return self.kind, self.of, self.load

    def at(self, where: str) -> str:
        """Return the line for people: the place, under which load, and the text."""
        return f"{where}{'' if self.load == UNLOADED else f' under {self.load}'}: {self.text}"


class Feasibility:
    """The states and straight motions that a cell allows.

    A body is held to the workspace and to the obstacles with its capsule. Base and shoulder are
    not, which stand where the arm is mounted; the upper arm is held to those sides of the workspace
    that the shoulder keeps however it turns. Without `workspace_min_m` the mounting plane
    z = 0 is the floor.

    Between the samples of a motion a gap changes by at most Σ |Δθ_i| r_i, with r_i how far the
    body is from the axis of joint i at most (`Scene.rates`). A part of a motion is done where the
    gap in its middle is larger than that, and halved otherwise, until it is `BETWEEN_M` at most;
    torques and moments by their own rates likewise.
    """

    def __init__(self, cell: Cell, config: CellConfig, margins: Margins | None = None) -> None:
        """Build the shapes once."""
        self.cell, self.config = cell, config
        self.margins = Margins() if margins is None else margins
        self.shapes = Clearance(cell, config)
        self.sight = self.shapes.sight
        known = is_known(cell.arm)
        self._guessed = (
            "" if known else f"the shape of {cell.arm.name} is not known: its links are guessed"
        )
        low, high = config.limits.workspace_min_m, config.limits.workspace_max_m
        self._floor = low is None
        self._box = (low or (-np.inf, -np.inf, 0.0), high or (np.inf, np.inf, np.inf))
        self._set_bodies()
        self._set_levers()

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is guessed."""
        return (self._guessed,) if self._guessed else ()

    # states

    def keeps(self, kind: str, q: Floats, load: str = UNLOADED) -> Bools:
        """Return (N,) which states (N, n) keep one of `STATE`, payload, sight or incidence."""
        if kind == SIGHT:
            return self._always(q) if self.sight is None else self.sight.free(q, load)
        if kind == INCIDENCE:
            angle = None if self.sight is None else self.sight.incidence(q)
            most = self.config.sight.incidence_max_rad
            return self._always(q) if angle is None else np.asarray(angle <= most)
        if kind in self.unbearable(load):
            return ~self._always(q)
        return self._always(q) if kind == PAYLOAD else ~self._beyond(kind, q, load)

    def allowed(self, q: Floats, load: str = UNLOADED, kinds: tuple[str, ...] = STATE) -> Bools:
        """Return (N,) which states keep all of some kinds under a load, in their order."""
        good = self._always(q)
        for kind in kinds:
            left = np.flatnonzero(good)
            if not len(left):
                break
            good[left] = self.keeps(kind, q[left], load)
        return good

    def findings(self, q: Floats, load: str, kinds: tuple[str, ...] = STATE) -> Iterator[Violation]:
        """Yield what any of the states (N, n) does not keep under a load, each at its worst."""
        at = _Placed(self.cell.arm, q)
        for kind in kinds:
            for part in self._parts(kind, at, load):
                yield from part.findings(kind)

    def unbearable(self, load: str) -> dict[str, str]:
        """Return why arm or force sensor do not bear a load in any state, a line by kind."""
        arm, tool, hung = self.cell.arm, self.cell.tool_mass, self.shapes.load(load)
        mass = tool + (0.0 if hung is None else hung.mass_kg)
        out = {}
        if mass > arm.payload + _ROUNDING:
            what = f'load "{load}": tool and load are' if hung else "the tool is"
            out[PAYLOAD] = f"{what} {mass:.4g} kg; the payload of {arm.name} is {arm.payload:g} kg"
        sensor = self.config.force_sensor
        force = float(np.linalg.norm(self._pull(load)[:3] + tool * self.cell.gravity))
        if sensor is not None and hung is not None and force > sensor.max_force_N:
            out[SENSOR] = (
                f'load "{load}": tool and load pull with {force:.4g} N; [force_sensor] '
                f"max_force_N is {sensor.max_force_N:g}"
            )
        return out

    # motions

    def passable(self, start: Floats, ends: Floats, load: str) -> Bools:
        """Return (M,) to which of `ends` (M, n) a straight motion under a load is clear."""
        good = self._always(ends)
        for kind in WAY:
            left = np.flatnonzero(good)
            good[left] = self._search(kind, start, ends[left], load)[0]
        return good

    def findings_between(self, start: Floats, end: Floats, load: str) -> Iterator[Violation]:
        """Yield what a straight motion between two states (n,) does not keep, at its worst."""
        for kind in WAY:
            good, bad = self._search(kind, start, end[None], load)
            if not good[0]:
                share = np.linspace(0.0, 1.0, _SHOWN)[:, None]
                yield from self.findings(
                    np.vstack([bad, start + share * (end - start)]), load, (kind,)
                )

    def _search(self, kind: str, start: Floats, ends: Floats, load: str) -> tuple[Bools, Floats]:
        """Which motions (M,) keep a kind, and states (K, n) that show why others do not."""
        good = self._always(ends)
        turn = np.abs(self.cell.arm.chain_angles(ends - start))
        count = np.maximum(np.ceil((turn @ self._farthest) / _COARSE_M), 1).astype(np.int64)
        owner = np.repeat(np.arange(len(ends)), count)
        width = 1.0 / count[owner]
        at = (np.arange(len(owner)) - (np.cumsum(count) - count)[owner] + 0.5) * width
        shown = [np.empty((0, ends.shape[1]))]
        while len(owner):
            q = start + at[:, None] * (ends[owner] - start)
            close = np.flatnonzero(self._beyond(kind, q, load, 0.5 * width[:, None] * turn[owner]))
            bad = close[self._beyond(kind, q[close], load)]
            good[owner[bad]] = False
            shown.append(q[bad])
            left = close[good[owner[close]]]
            owner, width = np.repeat(owner[left], 2), 0.5 * np.repeat(width[left], 2)
            at = np.repeat(at[left], 2) + 0.5 * width * np.tile([-1.0, 1.0], len(left))
        return good, np.vstack(shown)

    def _beyond(self, kind: str, q: Floats, load: str, turn: Floats | None = None) -> Bools:
        """(N,) which states break a kind, or might within turns (N, n) of the chain's joints."""
        out = ~self._always(q)
        for part in self._parts(kind, _Placed(self.cell.arm, q), load):
            left = np.flatnonzero(~out)
            if len(left):
                out[left] = part.beyond(left, None if turn is None else turn[left])
        return out

    # what is checked

    def _parts(self, kind: str, at: "_Placed", load: str) -> Iterator["_Bounds | _Touch"]:
        scene, margins, q = self.shapes.scene, self.margins, at.q
        if not len(q):
            return
        if kind == JOINTS:
            yield self._joints(q)
        elif kind == WORKSPACE:
            places = self._places(body_poses(self.cell.arm, q, at.chain), slice(None))
            yield self._inside(self._names, places, self._radius, self._held, self._rates)
        elif kind == TORQUE:
            yield self._torque(at.chain, load)
        elif kind == SENSOR and (sensor := self.config.force_sensor) is not None:
            yield self._moment(sensor, at.chain, load)
        elif kind == ITSELF:
            yield _Touch(scene.itself, q, margins.itself, scene.itself.rates, guessed=self._guessed)
        elif kind == OBSTACLE:
            yield _Touch(scene.around, q, margins.clear, scene.around.rates)
        elif kind == HANGING:
            hung = self.shapes.segments_at(at.chain.point(self.cell.load_point), load)
            if hung:
                places = np.stack([np.stack([x.start, x.end], axis=1) for x in hung], axis=1)
                held = np.ones((len(hung), len(_SIDES)), dtype=np.bool_)
                rates = np.tile(self._at_hook, (len(hung), 1))
                radius = np.array([x.radius for x in hung])
                yield self._inside([x.name for x in hung], places, radius, held, rates)
            for segment in hung:
                yield _Touch(scene.free, q, margins.clear, self._towards, segment)

    def _joints(self, q: Floats) -> "_Bounds":
        arm, kept = self.cell.arm, self.config.limits.joint_margin_rad
        low, high = arm.q_min + kept, arm.q_max - kept
        more = self.margins.joint

        def violation(k: int, state: int) -> Violation:
            return Violation(
                JOINTS, arm.joint_names[k], UNLOADED,
                f"{arm.joint_names[k]} is at {q[state, k]:.4g} {arm.unit(k)}; usable are "
                f"{low[k]:.4g} to {high[k]:.4g} (joint_margin_rad {kept:g})",
            )  # fmt: skip

        over = np.maximum(low - q, q - high) + more
        return _Bounds(over, np.zeros((arm.n, arm.n)), np.zeros(arm.n), violation)

    def _inside(
        self, names: list[str], places: Floats, radius: Floats, held: Bools, rates: Floats
    ) -> "_Bounds":
        """Capsules (N, B, 2, 3) with radii (B,) within the sides that each is held to (B, 6)."""
        low, high = places.min(axis=2) - radius[:, None], places.max(axis=2) + radius[:, None]
        over = np.stack([self._box[0] - low, high - self._box[1]], axis=3)
        body, side = np.nonzero(held)
        margin = self.margins.inside

        def violation(k: int, state: int) -> Violation:
            name, (axis, below) = names[body[k]], _SIDES[side[k]]
            far, limit = chosen[state, k] - margin, self._box[0 if below else 1][axis]
            if below and self._floor:
                text = (
                    f"{name} is {far:.3g} m below the mounting plane z = 0; where the arm may go "
                    "there, [limits] workspace_min_m says how far, e.g. [-2.0, -2.0, -1.0]"
                )
            else:
                text = (
                    f"{name} is {far:.3g} m outside the workspace, whose {'xyz'[axis]} ends at "
                    f"{limit:g} m"
                )
            return Violation(WORKSPACE, f"{name} {axis} {below}", UNLOADED, text)

        chosen = over.reshape(len(over), len(names), len(_SIDES))[:, body, side] + margin
        return _Bounds(chosen, rates[body], np.full(len(body), BETWEEN_M), violation)

    def _torque(self, chain: Chain, load: str) -> "_Bounds":
        cell, arm, share = self.cell, self.cell.arm, self.config.limits.torque_share
        pull = self._pull(load)
        wrench = np.broadcast_to(pull, (chain.position.shape[1], 6))
        carried = Load(wrench, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
        torque = np.abs(arm.drive_torques(arm.along(slot_wrenches(arm, chain, carried))))
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

        # A joint turns what is beyond it, or, before the axis, the axis against the forces.
        gravity, joint = float(np.linalg.norm(cell.gravity)), np.arange(arm.n)
        weights = gravity * np.append(arm.masses, cell.tool_mass)
        beyond = self._levers @ np.append(weights, np.linalg.norm(pull[:3]))
        rates = beyond[np.maximum(joint[:, None], joint)]
        rates += np.linalg.norm(pull[3:]) * (joint < joint[:, None])
        # A slide shifts the forces beyond it; what turns it turns the forces against its travel.
        force = weights.sum() + np.linalg.norm(pull[:3])
        rates = np.where(slides[:, None] | slides, force, rates)
        drive = np.eye(arm.n) if arm.drive is None else np.abs(arm.drive)
        limit = self.margins.bear * usable
        return _Bounds(torque - limit, drive.T @ rates, BETWEEN_SHARE * usable, violation)

    def _moment(self, sensor: ForceSensor, chain: Chain, load: str) -> "_Bounds":
        cell, pull = self.cell, self._pull(load)
        at = np.asarray(sensor.origin_m)
        weight, origin = cell.tool_mass * cell.gravity, chain.point(at)
        moment = pull[3:] + se3.cross(chain.point(cell.load_point) - origin, pull[:3])
        moment = moment + se3.cross(chain.point(cell.tool_com) - origin, weight)
        size = np.linalg.norm(moment, axis=1)[:, None]
        most = sensor.max_moment_Nm

        def violation(k: int, state: int) -> Violation:
            text = f"{size[state, k]:.4g} N·m on the force sensor; max_moment_Nm is {most:g}"
            return Violation(SENSOR, "moment", load, text)

        levers = (cell.load_point - at, pull[:3]), (cell.tool_com - at, weight)
        rate = sum(float(np.linalg.norm(a) * np.linalg.norm(f)) for a, f in levers)
        rates = np.full((1, cell.arm.n), rate)
        limit = self.margins.bear * most
        return _Bounds(size - limit, rates, np.array([BETWEEN_SHARE * most]), violation)

    # helpers

    def _set_bodies(self) -> None:
        """Which capsules are held to which sides of the workspace, and how they move."""
        scene, arm = self.shapes.scene, self.cell.arm
        parts = scene.parts
        self._names = [part.name for part in parts]
        self._body = np.array([part.body for part in parts])
        self._ends = np.array([[part.start, part.end] for part in parts])
        self._radius = np.array([part.radius for part in parts])
        self._rates = scene.rates
        moving = self._body > min(2, arm.n - 1)
        self._held = np.repeat(moving[:, None], len(_SIDES), axis=1)
        mount = self._body < min(2, arm.n - 1)
        turns = np.zeros((64, arm.n))
        slides = bool(arm.slides[0])
        first = float(arm.q_min[0]) if slides else -np.pi
        last = float(arm.q_max[0]) if slides else np.pi
        turns[:, 0] = np.linspace(first, last, len(turns))
        ends = self._places(body_poses(arm, turns), mount)
        everywhere = np.ones((int(mount.sum()), len(_SIDES)), dtype=np.bool_)
        names = [self._names[k] for k in np.flatnonzero(mount)]
        fixed = self._inside(names, ends, self._radius[mount], everywhere, self._rates[mount])
        outside = fixed.over.reshape(-1, len(_SIDES)) - self.margins.inside
        kept = mount.any() & np.all(outside <= 0.0, axis=0)
        self._held |= (~moving & ~mount)[:, None] & kept
        hook = on_flange(arm, self.cell.load_point)[None]
        self._at_hook = np.array([from_axis(arm, arm.n, hook, i + 1) for i in range(arm.n)])
        self._towards = scene.towards(self.cell.load_point)
        self._farthest = np.vstack([self._rates, self._at_hook]).max(axis=0)

    def _set_levers(self) -> None:
        """(n, n + 2) how far weights and the load point are from each axis before them, m."""
        cell, arm = self.cell, self.cell.arm
        points = [(k + 1, com) for k, com in enumerate(arm.coms)]
        points += [(arm.n, on_flange(arm, at)) for at in (cell.tool_com, cell.load_point)]
        self._levers = np.array(
            [
                [from_axis(arm, b, x[None], i) if b >= i else 0.0 for b, x in points]
                for i in range(1, arm.n + 1)
            ]
        )

    def _places(self, poses: Floats, which: Bools | slice) -> Floats:
        """(N, B, 2, 3) ends of some capsules, by the poses (N, n + 1, 4, 4) of all bodies."""
        at = poses[:, self._body[which]]
        ends = at[:, :, None, :3, :3] @ self._ends[which][..., None]
        return np.asarray(ends[..., 0] + at[:, :, None, :3, 3])

    def _always(self, q: Floats) -> Bools:
        return np.ones(len(q), dtype=np.bool_)

    def _pull(self, load: str) -> Floats:
        """(6,) wrench of a load at the load point, base axes; zero unloaded."""
        hung = self.shapes.load(load)
        return np.zeros(6) if hung is None else hung.wrench(self.cell.gravity)


class _Placed:
    """An arm in N states q (N, n); where it is, is evaluated once for all checks that ask."""

    def __init__(self, arm: Arm, q: Floats) -> None:
        self.arm, self.q = arm, q

    @cached_property
    def chain(self) -> Chain:
        return evaluate(self.arm, self.q)


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    """Numbers that must not be over zero in N states."""

    over: Floats  # (N, K)
    rates: Floats  # (K, n) they change by no more than this per radian of a joint of the chain
    fine: Floats  # (K,) by how much they may be over zero between the samples of a motion
    violation: Callable[[int, int], Violation]  # of column k in a state

    def beyond(self, rows: Ints, turn: Floats | None) -> Bools:
        """(R,) whether states are over zero, or might be within turns (R, n)."""
        over = self.over[rows]
        if turn is not None:
            over = over + np.maximum(turn @ self.rates.T - self.fine, 0.0)
        return np.asarray(~np.all(over <= _ROUNDING, axis=1))  # what is not a number is beyond

    def findings(self, kind: str) -> Iterator[Violation]:
        worst: dict[str, tuple[float, Violation]] = {}
        for k, state in enumerate(self.over.argmax(axis=0).tolist()):
            over = float(self.over[state, k])
            if not over <= _ROUNDING:
                broken = self.violation(k, state)
                if broken.of not in worst or worst[broken.of][0] < over:
                    worst[broken.of] = over, broken
        yield from (broken for _, broken in worst.values())


@dataclass(frozen=True, slots=True, eq=False)
class _Touch:
    """Shapes that must not be closer than a margin in N states; `_Bounds` of their gaps."""

    pairs: Pairs
    q: Floats  # (N, n) joint angles, rad
    margin: float  # m
    rates: Floats  # (K, n) how fast each pair may near, m/rad
    segment: Segment | None = None  # what hangs in the N states, of `Scene.free`
    guessed: str = ""  # says that the shapes are; empty where they are known

    def beyond(self, rows: Ints, turn: Floats | None) -> Bools:
        """(R,) whether shapes are too close, or might come so within turns (R, n)."""
        if turn is None:
            return self.pairs.touching(self.q[rows], self.margin, self._of(rows))
        out = np.zeros(len(rows), dtype=np.bool_)
        first = np.flatnonzero(np.append(True, np.any(np.diff(turn, axis=0) != 0.0, axis=1)))
        for a, b in zip(first, [*first[1:], len(rows)], strict=True):  # parts of one motion
            near = self.margin + np.maximum(self.rates @ turn[a] - BETWEEN_M, 0.0)
            some = rows[a:b]
            out[a:b] = self.pairs.touching(self.q[some], near, self._of(some))
        return out

    def findings(self, kind: str) -> Iterator[Violation]:
        for (a, b), gap in self.pairs.named(self.q, self.margin, self.segment).items():
            if gap < 0.0:
                text = f"they overlap by {-gap:.3g} m"
            else:
                text = f"they are {gap:.3g} m apart, {self.margin:g} m are kept"
            text += f" ({self.guessed})" if self.guessed else ""
            yield Violation(kind, f"{a} and {b}", UNLOADED, f"{a} and {b} collide: {text}")

    def _of(self, rows: Ints) -> Segment | None:
        x = self.segment
        if x is None:
            return None
        return Segment(x.name, x.start[rows], x.end[rows], x.radius, x.ignored)
