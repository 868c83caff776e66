"""The arm in the 3-D views: the capsules of its bodies, each in the frame of its body."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from hilcal.robot.arm import Arm
from hilcal.robot.body import Capsule
from hilcal.types import Floats

METAL = (176, 180, 188)
LIGHT = (205, 208, 214)
DARK = (92, 98, 110)
_TOOL, _TARGET = 0.0065, 0.012  # radii of the tool's rod and of the target, shares of the reach


def capsules(start: Floats, end: Floats, radius: Floats, colors: object) -> rr.Capsules3D:
    """Return capsules between ends (K, 3); rerun's lie along z from the origin."""
    way = end - start
    length = np.linalg.norm(way, axis=1)
    z = way / np.where(length > 0.0, length, 1.0)[:, None]
    # half-way turn that leads z to the way: q = (1 + z·way, z × way) normalised
    half = np.stack([-z[:, 1], z[:, 0], np.zeros(len(z)), 1.0 + z[:, 2]], 1)
    flat = np.linalg.norm(half, axis=1) < 1e-9
    half[flat] = [1.0, 0.0, 0.0, 0.0]
    half[length == 0.0] = [0.0, 0.0, 0.0, 1.0]
    return rr.Capsules3D(
        lengths=length,
        radii=radius,
        translations=start,
        quaternions=half / np.linalg.norm(half, axis=1, keepdims=True),
        colors=colors,  # type: ignore[arg-type]
        fill_mode="solid",
    )


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
            rr.Points3D(targets, labels=list(names), radii=1e-4, show_labels=True),
            static=True,
        )
