"""The arm among obstacles: which parts touch, by Pinocchio and Coal."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from hilcal.config import Obstacle
from hilcal.robot.arm import Arm
from hilcal.robot.body import Capsule, capsules
from hilcal.robot.pinocchio_model import pinocchio_model
from hilcal.types import Bools, Floats

FLOOR = "the floor"
_SAMPLES = 256  # states that tell which pairs touch by their crude shape alone
_SHORT = 1e-12  # m, of a segment without a direction
_ALWAYS = 0.3  # share of those states from which on a pair is not checked


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """What does not move with a body, as a capsule in every one of N states, base axes.

    Attributes:
        name: what it is, for people.
        start: (N, 3) or (3,) one end, m.
        end: (N, 3) or (3,) the other end, m.
        radius: m.
        ignored: names of parts that it may touch.
    """

    name: str
    start: Floats
    end: Floats
    radius: float
    ignored: frozenset[str] = frozenset()


class Scene:
    """Parts of the arm, what it carries, and obstacles, as Coal's shapes on a Pinocchio model.

    Pairs within one body and of neighbouring bodies are not checked, nor are pairs of which
    the crude shapes touch in a large share of all states, as those about a spherical wrist.
    """

    def __init__(
        self,
        arm: Arm,
        carried: Sequence[Capsule] = (),
        obstacles: Sequence[Obstacle] = (),
        floor: float | None = None,
    ) -> None:
        """Build the shapes.

        Args:
            arm: the arm.
            carried: what the flange carries.
            obstacles: what stands around.
            floor: height that forearm and all beyond stay above, base axes, m; None for none.
        """
        self.parts = (*capsules(arm), *carried)
        self._things = [(thing.name, *_obstacle(thing)) for thing in obstacles]
        if floor is not None:
            up = pin.coal.Halfspace(np.array([0.0, 0.0, 1.0]), floor)
            self._things.append((FLOOR, up, pin.SE3.Identity()))
        self._turned, self._model = arm, pinocchio_model(arm)
        self._data = self._model.createData()
        count = len(self.parts)
        reach = [
            (a, b)
            for a in range(count)
            for b in range(a + 1, count)
            if abs(self.parts[a].body - self.parts[b].body) > 1
        ]
        around = [
            (a, count + b)
            for a in range(count)
            for b, thing in enumerate(self._things)
            if self.parts[a].body > (1 if thing[0] != FLOOR else min(2, arm.n - 1))
        ]
        own = self._not_always(arm, reach)
        self._self, self._around = self._group(own), self._group(around)
        self._own, self._arm = len(own), self._group([*own, *around])
        last = count + len(self._things)
        self._free = self._group([(a, last) for a in range(last)])

    def self_touching(self, q: Floats, margin: float) -> Bools:
        """Return (N,) in which states (N, n) parts of the arm are closer than `margin`, m."""
        return self._self.touching(q, margin)

    def obstacles_touching(self, q: Floats, margin: float) -> Bools:
        """Return (N,) in which states (N, n) the arm is closer to an obstacle than `margin`, m.

        Base and shoulder stand where the arm is mounted, and are not checked.
        """
        return self._around.touching(q, margin)

    def arm_touching(self, q: Floats, itself: float, margin: float) -> Bools:
        """Return (N,) in which states the arm touches itself or an obstacle.

        Args:
            q: (N, n) joint angles, rad.
            itself: distance below which parts of the arm touch, m.
            margin: distance below which they touch an obstacle, m.
        """
        return self._arm.touching(q, margin, first=(self._own, itself))

    def touching(self, q: Floats, segment: Segment, margin: float) -> Bools:
        """Return (N,) in which states (N, n) a segment is closer to anything than `margin`, m."""
        return self._free.touching(q, margin, segment)

    def pairs(
        self,
        q: Floats,
        margin: float,
        segments: Iterable[Segment] = (),
        *,
        itself: bool = True,
    ) -> tuple[tuple[str, str], ...]:
        """Return the names of all that touch in any of the states (N, n), each pair once.

        Args:
            q: joint angles, rad.
            margin: distance from which on things touch, m.
            segments: what is checked against everything.
            itself: whether the arm is checked against itself.
        """
        found: dict[tuple[str, str], None] = {}
        for group in (self._self, self._around) if itself else (self._around,):
            found.update(dict.fromkeys(group.named(q, margin)))
        for segment in segments:
            found.update(dict.fromkeys(self._free.named(q, margin, segment)))
        return tuple(found)

    def blocking(self, q: Floats, segment: Segment) -> tuple[str, ...]:
        """Return the names of all that a segment touches in any of the states (N, n)."""
        return tuple(dict.fromkeys(a for a, _ in self._free.named(q, 0.0, segment)))

    def distance(self, q: Floats, segment: Segment | None = None) -> float:
        """Return the least distance in one state (n,), m; negative where things overlap.

        Args:
            q: (n,) joint angles, rad.
            segment: its distance to everything; without it that within the arm and from the
                arm to obstacles.
        """
        if segment is not None:
            return self._free.distance(q, segment)
        return min(self._self.distance(q), self._around.distance(q))

    def _group(self, pairs: Iterable[tuple[int, int]]) -> "_Group":
        geometry = pin.GeometryModel()
        names = []
        for part in self.parts:
            shape, place = _capsule(part.start, part.end, part.radius)
            names.append(part.name)
            geometry.addGeometryObject(
                pin.GeometryObject(f"part {len(names)}", part.body, 0, place, shape)
            )
        for name, shape, place in self._things:
            names.append(name)
            geometry.addGeometryObject(
                pin.GeometryObject(f"thing {len(names)}", 0, 0, place, shape)
            )
        free = pin.coal.Capsule(1.0, 1.0)
        geometry.addGeometryObject(pin.GeometryObject("free", 0, 0, pin.SE3.Identity(), free))
        chosen = tuple(pairs)
        for a, b in chosen:
            geometry.addCollisionPair(pin.CollisionPair(a, b))
        parts = (*names, "free")
        return _Group(self._turned, self._model, self._data, geometry, parts, chosen)

    def _not_always(self, arm: Arm, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Leave out what touches in many states, whatever the arm does."""
        group = self._group(pairs)
        drawn = _spread(_SAMPLES, arm.n)
        low, high = np.maximum(arm.q_min, -np.pi), np.minimum(arm.q_max, np.pi)
        often = group.how_often(low + drawn * (high - low))
        return [pair for pair, share in zip(pairs, often, strict=True) if share < _ALWAYS]


class _Group:
    """Pairs that are checked together."""

    def __init__(
        self,
        arm: Arm,
        model: Any,
        data: Any,
        geometry: Any,
        names: tuple[str, ...],
        pairs: tuple[tuple[int, int], ...],
    ) -> None:
        self._turned = arm
        self._model, self._data, self._geometry = model, data, geometry
        self._state = geometry.createData()
        self._names, self._pairs = names, pairs
        self._free = len(names) - 1

    def touching(
        self,
        q: Floats,
        margin: float,
        segment: Segment | None = None,
        first: tuple[int, float] = (0, 0.0),
    ) -> Bools:
        """(N,) whether anything touches; the first so many pairs by another margin."""
        out = np.zeros(len(q), dtype=np.bool_)
        if not self._pairs:
            return out
        self._prepare(margin, segment, first)
        lies = None if segment is None else _lies(segment, len(q))
        for i, at in enumerate(np.ascontiguousarray(q)):
            self._place(at, lies, i)
            out[i] = pin.computeCollisions(self._geometry, self._state, True)
        return out

    def named(
        self, q: Floats, margin: float, segment: Segment | None = None
    ) -> list[tuple[str, str]]:
        hit = np.flatnonzero(self.touching(q, margin, segment))
        lies = None if segment is None else _lies(segment, len(q))
        out = []
        for i in hit.tolist():
            self._place(q[i], lies, i)
            for k, (a, b) in enumerate(self._pairs):
                active = self._state.activeCollisionPairs[k]
                if active and pin.computeCollision(self._geometry, self._state, k):
                    second = self._names[b] if segment is None else segment.name
                    out.append((self._names[a], second))
        return out

    def how_often(self, q: Floats) -> Floats:
        """(P,) share of the states in which each pair touches."""
        count = np.zeros(len(self._pairs))
        for at in q:
            self._place(at)
            pin.computeCollisions(self._geometry, self._state, False)
            count += [result.isCollision() for result in self._state.collisionResults]
        return np.asarray(count / len(q))

    def distance(self, q: Floats, segment: Segment | None = None) -> float:
        if not self._pairs:
            return float("inf")
        self._prepare(0.0, segment)
        self._place(q, None if segment is None else _lies(segment, 1))
        return min(
            float(pin.computeDistance(self._geometry, self._state, k).min_distance)
            for k in range(len(self._pairs))
            if self._state.activeCollisionPairs[k]
        )

    def _prepare(
        self, margin: float, segment: Segment | None, first: tuple[int, float] = (0, 0.0)
    ) -> None:
        """Set the margin of all pairs, and which of them count."""
        for k, request in enumerate(self._state.collisionRequests):
            request.security_margin = first[1] if k < first[0] else margin
        if segment is not None:
            self._geometry.geometryObjects[self._free].geometry.radius = segment.radius
            for k, (a, _) in enumerate(self._pairs):
                self._state.activeCollisionPairs[k] = self._names[a] not in segment.ignored

    def _place(self, q: Floats, lies: "_Lies | None" = None, i: int = 0) -> None:
        """Put all shapes where they are in one state; a segment is that of state i."""
        turned = self._turned.chain_angles(q)
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._state, turned)
        if lies is not None:
            half, turn, middle = lies
            self._geometry.geometryObjects[self._free].geometry.halfLength = half[i]
            self._state.oMg[self._free] = pin.SE3(turn[i], middle[i])


def _spread(count: int, n: int) -> Floats:
    """(count, n) points that fill the unit cube evenly: frac(1/2 + k φ^-i), φ^(n+1) = φ + 1.

    Source: Roberts (2018), The unreasonable effectiveness of quasirandom sequences. SciPy has
    others, which take half a second to load.
    """
    phi = 2.0
    for _ in range(60):
        phi = (1.0 + phi) ** (1.0 / (n + 1))
    return np.asarray((0.5 + np.outer(np.arange(count), phi ** -np.arange(1.0, n + 1))) % 1.0)


_Lies = tuple[Floats, Floats, Floats]
"""Half lengths (N,), axes (N, 3, 3) and middles (N, 3) of a segment in N states."""


def _lies(segment: Segment, count: int) -> _Lies:
    """How a segment lies in every state."""
    shape = (count, 3)
    start, end = np.broadcast_to(segment.start, shape), np.broadcast_to(segment.end, shape)
    way = end - start
    return 0.5 * np.linalg.norm(way, axis=1), _turn(way), 0.5 * (start + end)


def _capsule(start: Floats, end: Floats, radius: float) -> tuple[Any, Any]:
    """Coal's capsule, which lies along z about its middle, and where it is."""
    way = end - start
    shape = pin.coal.Capsule(radius, float(np.linalg.norm(way)))
    return shape, pin.SE3(_turn(way[None])[0], 0.5 * (start + end))


def _obstacle(thing: Obstacle) -> tuple[Any, Any]:
    """Coal's shape of an obstacle, and where its middle is."""
    if thing.center_m is not None and thing.size_m is not None:
        return pin.coal.Box(*thing.size_m), pin.SE3(np.eye(3), np.array(thing.center_m))
    if thing.bottom_m is None or thing.radius_m is None or thing.height_m is None:
        raise ValueError(f"obstacle {thing.name} has no shape")  # its section refuses that
    middle = np.array(thing.bottom_m) + 0.5 * thing.height_m * np.array([0.0, 0.0, 1.0])
    return pin.coal.Cylinder(thing.radius_m, thing.height_m), pin.SE3(np.eye(3), middle)


def _turn(way: Floats) -> Floats:
    """(N, 3, 3) rotations that lead z to directions (N, 3); 1 for none."""
    length = np.linalg.norm(way, axis=1, keepdims=True)
    z = np.where(length > _SHORT, way / np.where(length > _SHORT, length, 1.0), [0.0, 0.0, 1.0])
    x = np.cross(np.eye(3)[np.argmin(np.abs(z), axis=1)], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)
