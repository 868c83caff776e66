"""The arm in the 3-D views: the capsules of its bodies, each in the frame of its body; labels."""

from collections.abc import Sequence

import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from hilcal.present.viewer import style
from hilcal.present.viewer.recording import along, fixed
from hilcal.robot import body
from hilcal.robot.arm import Arm
from hilcal.robot.body import Capsule
from hilcal.types import Floats

DARK = (92, 98, 110)
_TOOL, _TARGET = 0.0065, 0.012  # radii of the tool's rod and of the target, shares of the reach


def shade(body: int) -> style.Color:
    """Return the colour of a body: neighbours differ."""
    return (176, 180, 188) if body % 2 else (205, 208, 214)


def capsules(start: Floats, end: Floats, radius: Floats, colors: object) -> rr.Capsules3D:
    """Return capsules between ends (K, 3); rerun's lie along z from the origin."""
    length, quaternions = _along(end - start)
    return rr.Capsules3D(
        lengths=length,
        radii=radius,
        translations=start,
        quaternions=quaternions,
        colors=colors,  # type: ignore[arg-type]
        fill_mode="solid",
    )


def _along(way: Floats) -> tuple[Floats, Floats]:
    """(K,) lengths, and (K, 4) quaternions that lead z to the way (K, 3)."""
    length = np.linalg.norm(way, axis=1)
    z = way / np.where(length > 0.0, length, 1.0)[:, None]
    # half-way turn that leads z to the way: q = (1 + z·way, z × way) normalised
    half = np.stack([-z[:, 1], z[:, 0], np.zeros(len(z)), 1.0 + z[:, 2]], 1)
    half[np.linalg.norm(half, axis=1) < 1e-9] = [1.0, 0.0, 0.0, 0.0]
    return length, np.asarray(half / np.linalg.norm(half, axis=1, keepdims=True))


class MovingArm:
    """The arm with its targets as one entity, so that a place of it is one small message."""

    def __init__(self, rec: rr.RecordingStream, path: str, arm: Arm, targets: Floats) -> None:
        """Log what does not move; `targets` (T, 3) in flange axes, m."""
        own, count = body.capsules(arm), len(targets)
        self._rec, self._path = rec, path
        self._body = np.array([p.body for p in own] + 2 * count * [arm.n + 1], dtype=np.int64)
        self._start = np.concatenate([[p.start for p in own], np.zeros_like(targets), targets])
        self._end = np.concatenate([[p.end for p in own], targets, targets])
        tool = np.repeat([_TOOL, _TARGET], count) * max(arm.reach, 0.1)
        colors = [shade(p.body) for p in own] + count * [DARK] + count * [style.MEASURED]
        shapes = rr.Capsules3D.from_fields(
            lengths=np.linalg.norm(self._end - self._start, axis=1),
            radii=[*(p.radius for p in own), *tool],
            colors=colors,
            fill_mode="solid",
        )
        fixed(rec, path, shapes)

    def send(self, timeline: str, walls: list[float], bodies: Floats) -> None:
        """Send where the bodies (K, n + 2, 4, 4) are at times of day, s."""
        at = bodies[:, self._body]
        turn, shift = at[..., :3, :3], at[..., :3, 3]
        start, end = (np.einsum("tkij,kj->tki", turn, x) + shift for x in (self._start, self._end))
        _, quaternions = _along((end - start).reshape(-1, 3))
        placed = rr.Capsules3D.columns(
            translations=start.reshape(-1, 3), quaternions=quaternions
        ).partition([len(self._body)] * len(walls))
        along(self._rec, self._path, rr.TimeColumn(timeline, timestamp=walls), placed)


def log_bodies(
    rec: rr.RecordingStream, own: Sequence[Capsule], carried: Sequence[Capsule] = ()
) -> None:
    """Log the capsules of every body at `world/arm/bodyI`; what the arm carries is dark."""
    parts = [*((p, shade(p.body)) for p in own), *((p, DARK) for p in carried)]
    for i in sorted({p.body for p, _ in parts}):
        mine = [(p, color) for p, color in parts if p.body == i]
        start, end = (np.array([getattr(p, k) for p, _ in mine]) for k in ("start", "end"))
        radius = np.array([p.radius for p, _ in mine])
        colors = np.array([color for _, color in mine], dtype=np.uint8)
        fixed(rec, f"world/arm/body{i}", capsules(start, end, radius, colors))


def log_targets(
    rec: rr.RecordingStream, arm: Arm, targets: Floats, names: Sequence[str] = ()
) -> None:
    """Log the rods from the flange to targets (T, 3), flange axes, m, and a ball on each."""
    count, entity = len(targets), f"world/arm/body{arm.n + 1}"
    start, end = np.concatenate([0 * targets, targets]), np.concatenate([targets, targets])
    radius = np.repeat([_TOOL, _TARGET], count) * max(arm.reach, 0.1)
    colors = np.repeat(np.array([DARK, style.MEASURED], dtype=np.uint8), count, axis=0)
    fixed(rec, entity, capsules(start, end, radius, colors))
    if names:
        fixed(rec, f"{entity}/names", labels(targets, names))


def quaternions_of(rotation: Floats) -> Floats:
    """(N, 4) quaternions x y z w of (N, 3, 3) rotations, w >= 0."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))


def stand(rec: rr.RecordingStream, bodies: Floats) -> None:
    """Log where the arm's bodies (n + 2, 4, 4) are at the recording's current time."""
    quaternion = quaternions_of(bodies[:, :3, :3])
    for i in range(1, len(bodies)):
        turn = rr.Quaternion(xyzw=quaternion[i])
        rec.log(f"world/arm/body{i}", rr.Transform3D(translation=bodies[i, :3, 3], quaternion=turn))


def send_stands(rec: rr.RecordingStream, time: rr.TimeColumn, bodies: Floats) -> None:
    """Send where the arm's bodies (K, B, 4, 4) are at K times."""
    for i in range(1, bodies.shape[1]):
        at, turn = bodies[:, i, :3, 3], quaternions_of(bodies[:, i, :3, :3])
        placed = rr.Transform3D.columns(translation=at, quaternion=turn)
        along(rec, f"world/arm/body{i}", time, placed)


def labels(places: Sequence[Floats] | Floats, texts: Sequence[str]) -> rr.Points3D:
    """Return words at places (K, 3), in the colour that is legible in both themes."""
    words = [style.safe(t) for t in texts]
    return rr.Points3D(places, labels=words, colors=[style.LABEL], radii=1e-4, show_labels=True)


def label_columns(places: Floats, texts: Sequence[str]) -> rr.ComponentColumnList:
    """Return one such text for each of K times."""
    count = len(places)
    return rr.Points3D.columns(
        positions=places,
        labels=[style.safe(t) for t in texts],
        colors=np.tile(np.array(style.LABEL, dtype=np.uint8), (count, 1)),
        radii=np.full(count, 1e-4),
        show_labels=[True] * count,
    )
