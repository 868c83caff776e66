"""The arm in the 3-D views: the capsules of its bodies, each in the frame of its body."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from hilcal.present.viewer import style
from hilcal.present.viewer.style import MEASURED
from hilcal.robot.arm import Arm
from hilcal.robot.body import Capsule
from hilcal.robot.body import capsules as robot_capsules
from hilcal.types import Floats

METAL = (176, 180, 188)
LIGHT = (205, 208, 214)
DARK = (92, 98, 110)
_TOOL, _TARGET = 0.0065, 0.012  # radii of the tool's rod and of the target, shares of the reach


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
    flat = np.linalg.norm(half, axis=1) < 1e-9
    half[flat] = [1.0, 0.0, 0.0, 0.0]
    half[length == 0.0] = [0.0, 0.0, 0.0, 1.0]
    return length, np.asarray(half / np.linalg.norm(half, axis=1, keepdims=True))


class MovingArm:
    """The arm with its targets as one entity, so that a place of it is one small message."""

    def __init__(self, rec: rr.RecordingStream, path: str, arm: Arm, targets: Floats) -> None:
        """Log what does not move; `targets` (T, 3) in flange axes, m."""
        own, flange = robot_capsules(arm), np.full(2 * len(targets), arm.n + 1)
        reach = max(arm.reach, 0.1)
        self._rec, self._path = rec, path
        self._body = np.concatenate([[p.body for p in own], flange]).astype(np.int64)
        self._start = np.concatenate([[p.start for p in own], np.zeros_like(targets), targets])
        self._end = np.concatenate([[p.end for p in own], targets, targets])
        radii = [p.radius for p in own]
        radii += [r * reach for r in (_TOOL, _TARGET) for _ in targets]
        colors = [METAL if p.body % 2 else LIGHT for p in own]
        colors += [c for c in (DARK, MEASURED) for _ in targets]
        fixed = rr.Capsules3D.from_fields(
            lengths=np.linalg.norm(self._end - self._start, axis=1),
            radii=radii,
            colors=colors,
            fill_mode="solid",
        )
        rec.log(path, fixed, static=True)

    def send(self, timeline: str, walls: list[float], bodies: Floats) -> None:
        """Send where the bodies (K, n + 2, 4, 4) are at times of day, s."""
        at = bodies[:, self._body]
        turn, shift = at[..., :3, :3], at[..., :3, 3]
        start, end = (np.einsum("tkij,kj->tki", turn, x) + shift for x in (self._start, self._end))
        _, quaternions = _along((end - start).reshape(-1, 3))
        placed = rr.Capsules3D.columns(
            translations=start.reshape(-1, 3), quaternions=quaternions
        ).partition([len(self._body)] * len(walls))
        time = rr.TimeColumn(timeline, timestamp=walls)
        self._rec.send_columns(self._path, indexes=[time], columns=placed)


def log_bodies(
    rec: rr.RecordingStream, own: Sequence[Capsule], carried: Sequence[Capsule] = ()
) -> None:
    """Log the capsules of every body at `world/arm/bodyI`; what the arm carries is dark."""
    for i in sorted({part.body for part in (*own, *carried)}):
        shade = METAL if i % 2 else LIGHT
        parts = [(p, shade) for p in own if p.body == i]
        parts += [(p, DARK) for p in carried if p.body == i]
        rec.log(
            f"world/arm/body{i}",
            capsules(
                np.array([p.start for p, _ in parts]),
                np.array([p.end for p, _ in parts]),
                np.array([p.radius for p, _ in parts]),
                np.array([color for _, color in parts], dtype=np.uint8),
            ),
            static=True,
        )


def log_targets(
    rec: rr.RecordingStream,
    arm: Arm,
    targets: Floats,
    color: tuple[int, int, int],
    names: Sequence[str] = (),
) -> None:
    """Log the rods from the flange to targets (T, 3) and a ball on each, flange axes, m.

    Args:
        rec: the recording.
        arm: the arm.
        targets: (T, 3) offsets.
        color: of the balls.
        names: of the targets, where there are several.
    """
    reach, count = max(arm.reach, 0.1), len(targets)
    rec.log(
        f"world/arm/body{arm.n + 1}",
        capsules(
            np.concatenate([np.zeros((count, 3)), targets]),
            np.concatenate([targets, targets]),
            np.repeat([_TOOL, _TARGET], count) * reach,
            np.repeat(np.array([DARK, color], dtype=np.uint8), count, axis=0),
        ),
        static=True,
    )
    if names:
        rec.log(
            f"world/arm/body{arm.n + 1}/names",
            labels(targets, names),
            static=True,
        )


def quaternions_of(rotation: Floats) -> Floats:
    """(N, 4) quaternions x y z w of (N, 3, 3) rotations, w >= 0."""
    from scipy.spatial.transform import Rotation

    q: Floats = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return q


def stand(rec: rr.RecordingStream, bodies: Floats) -> None:
    """Log where the arm's bodies (n + 2, 4, 4) are at the recording's current time."""
    quaternion = quaternions_of(bodies[:, :3, :3])
    for i in range(1, len(bodies)):
        rec.log(
            f"world/arm/body{i}",
            rr.Transform3D(
                translation=bodies[i, :3, 3], quaternion=rr.Quaternion(xyzw=quaternion[i])
            ),
        )


def send_stands(rec: rr.RecordingStream, time: rr.TimeColumn, bodies: Floats) -> None:
    """Send where the arm's bodies (K, B, 4, 4) are at K times."""
    for i in range(1, bodies.shape[1]):
        placed = rr.Transform3D.columns(
            translation=bodies[:, i, :3, 3], quaternion=quaternions_of(bodies[:, i, :3, :3])
        )
        rec.send_columns(f"world/arm/body{i}", indexes=[time], columns=placed)


def labels(places: Sequence[Floats] | Floats, texts: Sequence[str]) -> rr.Points3D:
    """Return words at places (K, 3), in the colour that is legible in both themes."""
    return rr.Points3D(
        places,
        labels=[style.safe(t) for t in texts],
        colors=[style.LABEL],
        radii=1e-4,
        show_labels=True,
    )


def label_columns(places: Floats, texts: Sequence[str]) -> rr.ComponentColumnList:
    """Return one such text for each of K times."""
    return rr.Points3D.columns(
        positions=places,
        labels=[style.safe(t) for t in texts],
        colors=np.tile(np.array(style.LABEL, dtype=np.uint8), (len(places), 1)),
        radii=np.full(len(places), 1e-4),
        show_labels=[True] * len(places),
    )
