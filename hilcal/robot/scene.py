"""The shape of an arm, and its collisions with itself and with obstacles.

Arms of Universal Robots have known sizes; any other arm gets a capsule per link with a radius in
proportion to the arm's reach. A capsule is all points within `radius` of a segment. Pinocchio and
Coal compute the distances.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal.config import Obstacle
from hilcal.robot import se3
from hilcal.robot.arm import Arm, as_drawn
from hilcal.robot.chain import Chain, evaluate
from hilcal.types import Bools, Floats

if TYPE_CHECKING:
    import pinocchio as pin

FLANGE = "flange"
BASE = "base"
_Z = np.array([0.0, 0.0, 1.0])
_RIM = 0.5  # of the radius: rounded end of a housing, by which the capsule's segment is shorter
_THICK, _THIN = 0.047, 0.03  # radii of an unknown arm at base and flange, over its reach
_LEAST_LINK = 1e-6  # m, length of a link with a capsule
HALF_TURN = np.array([1.0, -1.0, -1.0])  # half a turn about x


@dataclass(frozen=True, slots=True, eq=False)
class Capsule:
    """A capsule that moves with a body."""

    name: str  # for people
    body: int  # 0 is the base, i the body moved by joint i
    start: Floats  # (3,) one end of the segment in the body's frame, m
    end: Floats  # (3,) the other end, m
    radius: float  # m


# Sizes of arms of Universal Robots' build, m: offsets of the tubes of upper arm and forearm along
# the shoulder's axis; radii of the housings on joints 1, 2, 3 and the wrists, and of the two tubes.
# Offsets: the manufacturer's ROS 2 description package, config/*/physical_parameters.yaml,
# `offsets`. Radii of UR5e and UR10e: the collision capsules of the MuJoCo Menagerie
# (universal_robots_ur5e, universal_robots_ur10e), also for their CB3 predecessors and the UR16e,
# which have the same joints. Radii of UR3(e), UR20 and UR30: a housing of a joint of torque T has
# 78 mm (T / 330 N·m)^0.27, which gives 60 mm for the 150 N·m joint and 40 mm for the 28 N·m joint
# of those two arms within 3 mm. All radii are below half of the data sheets' footprints of 128
# (UR3e), 149 (UR5e), 190 (UR10e) and 245 mm (UR20), as they must be.
# Tubes of UR8 Long, UR15 and UR18 are not published (their `offsets` are of the meshes). Their
# radii follow from the same rule with 433, 204 and 70 N·m; the offsets of their tubes are guessed:
# as far beyond the links' centres of mass (0.193 and 0.071 m) as the mean of UR10e and UR20.
_UR5 = ((0.060, 0.060, 0.055, 0.040), (0.050, 0.038))
_UR10 = ((0.078, 0.078, 0.058, 0.050), (0.060, 0.043))
_UR3 = ((0.049, 0.049, 0.041, 0.033), (0.040, 0.030))
_UR20 = ((0.099, 0.099, 0.084, 0.060), (0.078, 0.062))
_UR15 = ((0.084, 0.084, 0.069, 0.051), (0.066, 0.050))
_FIGURES: dict[str, tuple[float, float, tuple[float, ...], tuple[float, ...]]] = {
    "ur3": (0.1198, 0.0275, *_UR3), "ur3e": (0.120, 0.027, *_UR3),
    "ur5": (0.13585, 0.0165, *_UR5), "ur5e": (0.138, 0.007, *_UR5),
    "ur7e": (0.138, 0.007, *_UR5), "ur8long": (0.227, 0.046, *_UR15),
    "ur10": (0.220941, 0.049042, *_UR10), "ur10e": (0.1762, 0.0393, *_UR10),
    "ur12e": (0.1762, 0.0393, *_UR10), "ur15": (0.227, 0.046, *_UR15),
    "ur16e": (0.1762, 0.0393, *_UR10), "ur18": (0.227, 0.046, *_UR15),
    "ur20": (0.260, 0.043, *_UR20), "ur30": (0.260, 0.043, *_UR20),
}  # fmt: skip
_GUESSED = frozenset({"ur8long", "ur15", "ur18"})


def is_known(arm: Arm) -> bool:
    """Return whether the arm's sizes are known; else they are guessed, mostly from its reach."""
    return arm.name not in _GUESSED and _has_figures(arm)


def _has_figures(arm: Arm) -> bool:
    if arm.sign is not None:
        return _has_figures(as_drawn(arm))
    parallel = arm.n == 6 and min(abs(arm.links[k][2, 2]) for k in (2, 3)) > 0.99
    return arm.name in _FIGURES and bool(parallel)  # a file of the same name may be another arm


def capsules(arm: Arm) -> tuple[Capsule, ...]:
    """Return the capsules of base and bodies, in the order of the bodies.

    They contain the real housings except a rim of at most an eighth of the radius, which the
    margins of collision checks cover.
    """
    if arm.sign is None:
        return _of_ur(arm, *_FIGURES[arm.name]) if _has_figures(arm) else _of_any(arm)
    # shapes of the drawn arm; bodies of opposite axes have frames turned about x
    turned = np.append(False, arm.sign < 0)
    return tuple(
        replace(c, start=HALF_TURN * c.start, end=HALF_TURN * c.end) if turned[c.body] else c
        for c in capsules(as_drawn(arm))
    )


def body_poses(arm: Arm, q: Floats, chain: Chain | None = None) -> Floats:
    """Return poses T_base_body (N, n + 2, 4, 4) of base, bodies and flange at (N, n) joint values.

    T_base_body0 = 1, T_base_bodyi = L_0 M_1(θ_1) ... L_{i-1} M_i(θ_i).
    """
    chain = evaluate(arm, q) if chain is None else chain
    out = np.tile(np.eye(4), (len(q), arm.n + 2, 1, 1))
    out[:, 1:, :3, :3] = np.swapaxes(chain.rotation, 0, 1)
    out[:, 1:, :3, 3] = np.swapaxes(chain.position, 0, 1)
    turn = np.tile(np.eye(3), (len(q), arm.n, 1, 1))
    angle = arm.chain_angles(q)
    along = np.swapaxes(chain.rotation[:-1, :, :, 2], 0, 1)
    out[:, 1:-1, :3, 3] += along * (angle * arm.slides)[..., None]
    angle = angle * ~arm.slides
    turn[..., 0, 0] = turn[..., 1, 1] = np.cos(angle)
    turn[..., 1, 0] = np.sin(angle)
    turn[..., 0, 1] = -turn[..., 1, 0]
    out[:, 1:-1, :3, :3] = out[:, 1:-1, :3, :3] @ turn
    return out


def flange_capsule(arm: Arm, name: str, start: Floats, end: Floats, radius: float) -> Capsule:
    """Return a capsule fixed to the flange, between two ends (3,), flange axes, m."""
    return Capsule(name, arm.n, on_flange(arm, start), on_flange(arm, end), radius)


def _of_ur(
    arm: Arm, outer: float, inner: float, housings: tuple[float, ...], tubes: tuple[float, ...]
) -> tuple[Capsule, ...]:
    (r1, r2, r3, r4), (upper, fore) = housings, tubes
    d1, d4 = (float(arm.links[k][2, 3]) for k in (1, 4))
    x2, x3 = arm.links[2][:3, 3], arm.links[3][:3, 3]
    between = 0.5 * (inner + outer)
    lift = arm.links[1][:3, 2]  # the shoulder's axis, in the frame of body 1
    top = np.array([0.0, 0.0, d1])
    spin = arm.links[4][:3, 2]  # the second wrist's axis, in the frame of body 4
    d5 = float(arm.links[5][2, 3])
    return (
        _housing(BASE, 0, np.zeros(3), 0.0, 0.6 * d1, r1),
        Capsule("shoulder", 1, 0.6 * top, top, r1),
        Capsule("shoulder", 1, top, top + 0.5 * outer * lift, r2),
        _housing("upper arm", 2, np.zeros(3), 0.5 * outer, outer + r2, r2),
        Capsule("upper arm", 2, outer * _Z, x2 + outer * _Z, upper),
        _housing("upper arm", 2, x2, between, outer + r3, r3),
        _housing("forearm", 3, np.zeros(3), inner - r3, between, r3),
        Capsule("forearm", 3, inner * _Z, x3 + inner * _Z, fore),
        _housing("forearm", 3, x3, inner - r4, inner + r4, r4),
        _housing("wrist 1", 4, np.zeros(3), inner + r4, d4 + r4, r4),
        Capsule("wrist 1", 4, d4 * _Z, d4 * _Z + 0.4 * d5 * spin, r4),
        _housing("wrist 2", 5, np.zeros(3), 0.4 * d5, d5 + r4, r4),
        Capsule("wrist 3", 6, np.zeros(3), arm.links[6][:3, 3] - _RIM * r4 * _Z, r4),
    )


def _housing(
    name: str, body: int, origin: Floats, low: float, high: float, radius: float
) -> Capsule:
    """Return a capsule for a housing along z through `origin`, from `low` to `high`."""
    # the segment ends half a radius inside of the housing, or in the middle of a short one
    rim = min(_RIM * radius, 0.5 * (high - low))
    return Capsule(name, body, origin + (low + rim) * _Z, origin + (high - rim) * _Z, radius)


def _of_any(arm: Arm) -> tuple[Capsule, ...]:
    """Return one capsule per link, from one joint's frame to the next."""
    reach = max(arm.reach - float(arm.travels.sum()), 0.1)
    radii = np.linspace(_THICK, _THIN, arm.n + 1) * reach
    names = (BASE, *arm.joint_names)
    return tuple(
        Capsule(names[k], k, np.zeros(3), end, float(radii[k]))
        for k, end in enumerate(arm.links[:, :3, 3])
        if float(np.linalg.norm(end)) > _LEAST_LINK
    )


def pinocchio_model(arm: Arm) -> "pin.Model":
    """Build a Pinocchio model with the same chain, masses and limits.

    Joint i turns about z or slides along z, with the placement L_{i-1} in body i - 1. Bodies are
    point masses at their centres of mass. The frame "flange" has the placement L_n in the last
    body.
    """
    import pinocchio as pin

    model = pin.Model()
    model.name = arm.name
    joint = 0
    for i in range(arm.n):
        joint = model.addJoint(
            joint, pin.JointModelPZ() if arm.slides[i] else pin.JointModelRZ(),
            pin.SE3(arm.links[i]), arm.joint_names[i], arm.torque_max[i : i + 1],
            np.array([np.inf]), arm.q_min[i : i + 1], arm.q_max[i : i + 1],
        )  # fmt: skip
        body = pin.Inertia(float(arm.masses[i]), arm.coms[i], np.zeros((3, 3)))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    model.addFrame(pin.Frame(FLANGE, joint, 0, pin.SE3(arm.links[arm.n]), pin.FrameType.OP_FRAME))
    return model


_SAMPLES = 256  # states to detect pairs that touch because their shapes are crude
_SHORT = 1e-12  # m, length of a segment without a direction
_MOST_CONTACT = 0.3  # share of states with contact above which a pair is not checked
_NEAR = 0.03  # m; guessed shapes that are closer in every state are neighbours; a choice


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """A capsule that no body carries, with its own place in each of N states, base axes."""

    name: str  # for people
    start: Floats  # (N, 3) or (3,) one end, m
    end: Floats  # (N, 3) or (3,) the other end, m
    radius: float  # m
    ignored: frozenset[str] = frozenset()  # names of parts that it may touch


class Scene:
    """Parts of the arm, the tool, and obstacles, as Coal's shapes on a Pinocchio model.

    Pairs within one body and of neighbouring bodies are not checked, nor are pairs whose crude
    shapes touch in a large share of all states, as about a spherical wrist.
    """

    def __init__(
        self, arm: Arm, carried: Sequence[Capsule] = (), obstacles: Sequence[Obstacle] = ()
    ) -> None:
        """Build the shapes."""
        self.arm, self.model = arm, pinocchio_model(arm)
        self.parts = (*capsules(arm), *carried)  # carried ones are on the flange
        self.obstacles = [(o.name, *_obstacle(o)) for o in obstacles]
        joints = range(1, arm.n + 1)
        ends = [(part.body, np.array([part.start, part.end])) for part in self.parts]
        far = np.array([[from_axis(arm, body, end, i) for i in joints] for body, end in ends])
        bodies = np.array([part.body for part in self.parts])
        # (P, n) largest motion of a point of a part per radian of a joint, m
        self.rates = np.where(np.arange(1, arm.n + 1) <= bodies[:, None], far, 0.0)
        count = len(self.parts)
        last = count + len(self.obstacles)
        distant = [
            (a, b)
            for a in range(count)
            for b in range(a + 1, count)
            if abs(self.parts[a].body - self.parts[b].body) > 1
        ]
        around = [  # without base and shoulder, which stand at the mounting
            (a, b) for a in range(count) if self.parts[a].body > 1 for b in range(count, last)
        ]
        checked = self._rarely_touching(distant)
        rates = [self._approach_rates(a, b, far) for a, b in checked]
        self.self_pairs = Pairs(self, checked, rates)
        self.obstacle_pairs = Pairs(self, around, [self.rates[a] for a, _ in around])
        # parts and obstacles against a segment that comes with the states
        self.segment_pairs = Pairs(self, [(a, last) for a in range(last)])

    def load_rates(self, point: Floats) -> Floats:
        """Return rates of approach (P + obstacles, n) to a load at a point of the flange, m/rad.

        The load moves with the point and does not turn. A joint that turns a part turns the point
        with it, so that their rate of approach is at most their distance per radian.
        """
        arm, n_obstacles = self.arm, len(self.obstacles)
        hook = on_flange(arm, point)
        moves = np.array([from_axis(arm, arm.n, hook[None], i) for i in range(1, arm.n + 1)])
        out = np.tile(moves, (len(self.parts) + n_obstacles, 1))
        for row, part in zip(out, self.parts, strict=False):
            ends = np.array([part.start, part.end])
            if part.body == arm.n:
                farthest = np.linalg.norm(ends - hook, axis=1).max()
            else:
                farthest = _along(arm, part.body, ends, arm.n) + np.linalg.norm(hook)
            row[: part.body] = farthest
        return out

    def _approach_rates(self, a: int, b: int, far: Floats) -> Floats:
        """Return the rates (n,) of approach of two parts by the joints between them, m/rad."""
        low, high = sorted((self.parts[a].body, self.parts[b].body))
        joint = np.arange(1, self.arm.n + 1)
        between = (joint > low) & (joint <= high)
        return np.where(between, np.minimum(far[a], far[b]), 0.0)

    def _rarely_touching(self, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return the pairs without those that touch in a large share of all states."""
        low, high = self.arm.usual_range
        q, tested = low + _spread(_SAMPLES, self.arm.n) * (high - low), Pairs(self, pairs)
        touching = tested.contact_share(q)
        near = np.zeros(len(pairs)) if is_known(self.arm) else tested.contact_share(q, _NEAR)
        checked = (touching < _MOST_CONTACT) & (near < 1.0)
        return [pair for pair, check in zip(pairs, checked, strict=True) if check]


class Pairs:
    """Pairs of shapes that are checked together; `rates` (K, n): rates of approach, m/rad."""

    def __init__(
        self, scene: Scene, pairs: Sequence[tuple[int, int]], rates: Sequence[Floats] = ()
    ) -> None:
        """Build the shapes of a scene: parts, obstacles, and a free segment."""
        import pinocchio as pin

        self._pin = pin
        self.rates = np.reshape(rates, (-1, scene.arm.n))
        self._arm, self._model, self._pairs = scene.arm, scene.model, tuple(pairs)
        self._data, self._geometry = scene.model.createData(), pin.GeometryModel()
        free = "free", pin.coal.Capsule(1.0, 1.0), pin.SE3.Identity()
        parts = ((p.name, p.body, *_capsule(p.start, p.end, p.radius)) for p in scene.parts)
        fixed = ((name, 0, shape, place) for name, shape, place in (*scene.obstacles, free))
        names = []
        for k, (name, body, shape, place) in enumerate((*parts, *fixed)):
            names.append(name)
            self._geometry.addGeometryObject(pin.GeometryObject(f"{k}", body, 0, place, shape))
        for a, b in pairs:
            self._geometry.addCollisionPair(pin.CollisionPair(a, b))
        self._state = self._geometry.createData()
        self._names, self._free = names, len(names) - 1
        self._margins: list[float] = []

    def touching(
        self, q: Floats, margin: float | Floats = 0.0, segment: Segment | None = None
    ) -> Bools:
        """Return (N,) in which states (N, n) any pair is closer than its margin, m."""
        out = np.zeros(len(q), dtype=np.bool_)
        if not self._pairs:
            return out
        self._prepare(margin, segment)
        placements = _placements(segment, len(q))
        for i, turned in enumerate(np.ascontiguousarray(self._arm.chain_angles(q))):
            self._place(turned, placements, i)
            out[i] = self._pin.computeCollisions(self._geometry, self._state, True)
        return out

    def close_pairs(
        self, q: Floats, margin: float = 0.0, segment: Segment | None = None
    ) -> dict[tuple[str, str], float]:
        """Return the pairs closer than a margin in any state (N, n), and their distance, m."""
        out: dict[tuple[str, str], float] = {}
        placements = _placements(segment, len(q))
        for i in np.flatnonzero(self.touching(q, margin, segment)).tolist():
            self._place(self._arm.chain_angles(q[i]), placements, i)
            for k, (a, b) in enumerate(self._pairs):
                active = self._state.activeCollisionPairs[k]
                if active and self._pin.computeCollision(self._geometry, self._state, k):
                    name = self._names[a], self._names[b] if segment is None else segment.name
                    gap = self._pin.computeDistance(self._geometry, self._state, k).min_distance
                    out[name] = min(out.get(name, np.inf), float(gap))
        return out

    def contact_share(self, q: Floats, margin: float = 0.0) -> Floats:
        """Return the share (K,) of the states in which each pair is closer than a margin, m."""
        count = np.zeros(len(self._pairs))
        self._prepare(margin, None)
        for turned in self._arm.chain_angles(q):
            self._place(turned)
            self._pin.computeCollisions(self._geometry, self._state, False)
            count += [result.isCollision() for result in self._state.collisionResults]
        return np.asarray(count / len(q))

    def _prepare(self, margin: float | Floats, segment: Segment | None) -> None:
        """Set the margins of all pairs, and activate the pairs to check."""
        margins = np.broadcast_to(margin, len(self._pairs)).tolist()
        if margins != self._margins:
            for request, value in zip(self._state.collisionRequests, margins, strict=True):
                request.security_margin = value
            self._margins = margins
        if segment is not None:
            self._geometry.geometryObjects[self._free].geometry.radius = segment.radius
            for k, (a, _) in enumerate(self._pairs):
                self._state.activeCollisionPairs[k] = self._names[a] not in segment.ignored

    def _place(self, turned: Floats, placements: "_Placements | None" = None, i: int = 0) -> None:
        pin = self._pin
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._state, turned)
        if placements is not None:
            half, turn, middle = placements
            self._geometry.geometryObjects[self._free].geometry.halfLength = half[i]
            self._state.oMg[self._free] = pin.SE3(turn[i], middle[i])


def from_axis(arm: Arm, body: int, points: Floats, joint: int) -> float:
    """Return a bound of the distance of points (K, 3) of a body from the axis of a joint, m.

    The bound is the largest motion per radian of the joint; 1 for a joint that slides. It is the
    length of the path along the links, |L_k| each; exact for the body moved by the joint, and for
    the body that carries it. Bodies are counted from 0, the base; joints from 1.
    """
    if arm.slides[joint - 1]:
        return 1.0
    if joint > body:
        if joint > body + 1:
            return _along(arm, body, points, joint)
        link = arm.links[body]
        offset = (points - link[:3, 3]) @ link[:3, :3]
        return float(np.hypot(offset[:, 0], offset[:, 1]).max())
    if joint == body:
        return float(np.hypot(points[:, 0], points[:, 1]).max())
    lengths = np.linalg.norm(arm.links[joint + 1 : body, :3, 3], axis=1)
    first = float(np.hypot(*arm.links[joint][:2, 3]))
    travel = arm.travels[joint:body].sum()
    return float(first + lengths.sum() + travel + np.linalg.norm(points, axis=1).max())


def on_flange(arm: Arm, point: Floats) -> Floats:
    """Convert a point (3,) from flange axes to the frame of the last body, m."""
    flange = arm.links[arm.n]
    return np.asarray(flange[:3, :3] @ point + flange[:3, 3])


def _along(arm: Arm, body: int, points: Floats, last: int) -> float:
    """Return the longest path from points of a body along the links to a later body, m."""
    lengths = np.linalg.norm(arm.links[body + 1 : last, :3, 3], axis=1).sum()
    lengths += arm.travels[body:last].sum()
    return float(np.linalg.norm(points - arm.links[body][:3, 3], axis=1).max() + lengths)


def _spread(count: int, n: int) -> Floats:
    """Return points (count, n) that fill the unit cube evenly: frac(1/2 + k φ^-i), φ^(n+1) = φ + 1.

    Source: Roberts (2018), The unreasonable effectiveness of quasirandom sequences.
    """
    phi = 2.0
    for _ in range(60):
        phi = (1.0 + phi) ** (1.0 / (n + 1))
    return np.asarray((0.5 + np.outer(np.arange(count), phi ** -np.arange(1.0, n + 1))) % 1.0)


_Placements = tuple[Floats, Floats, Floats]  # half lengths (N,), axes (N, 3, 3), middles (N, 3)


def _placements(segment: Segment | None, count: int) -> _Placements | None:
    if segment is None:
        return None
    shape = (count, 3)
    start, end = np.broadcast_to(segment.start, shape), np.broadcast_to(segment.end, shape)
    direction = end - start
    return 0.5 * np.linalg.norm(direction, axis=1), _turn(direction), 0.5 * (start + end)


def _capsule(start: Floats, end: Floats, radius: float) -> tuple[Any, Any]:
    """Return Coal's capsule, along z about its middle, and its placement."""
    import pinocchio as pin

    direction = end - start
    shape = pin.coal.Capsule(radius, float(np.linalg.norm(direction)))
    return shape, pin.SE3(_turn(direction[None])[0], 0.5 * (start + end))


def _obstacle(obstacle: Obstacle) -> tuple[Any, Any]:
    """Return Coal's shape of an obstacle, and its placement."""
    import pinocchio as pin

    if obstacle.center_m is not None and obstacle.size_m is not None:
        return pin.coal.Box(*obstacle.size_m), pin.SE3(np.eye(3), np.array(obstacle.center_m))
    if obstacle.bottom_m is None or obstacle.radius_m is None or obstacle.height_m is None:
        raise ValueError(f"obstacle {obstacle.name} has no shape")  # refused by its section
    middle = np.array(obstacle.bottom_m) + 0.5 * obstacle.height_m * _Z
    return pin.coal.Cylinder(obstacle.radius_m, obstacle.height_m), pin.SE3(np.eye(3), middle)


def _turn(direction: Floats) -> Floats:
    """Return rotations (N, 3, 3) that turn z to directions (N, 3); 1 for zero vectors."""
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    z = np.where(length > _SHORT, direction / np.where(length > _SHORT, length, 1.0), _Z)
    x = se3.cross(np.eye(3)[np.argmin(np.abs(z), axis=1)], z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, se3.cross(z, x), z], axis=2)
