"""The 3-D views: arm, residual arrows in their noise balls, deflections."""

import numpy as np
import rerun as rr

from hilcal import numbers
from hilcal.present.story import StoryRevision
from hilcal.present.viewer import arm_shapes, style
from hilcal.present.viewer.digest import Digest, capped, deviation, quaternions_of
from hilcal.robot.body import capsules
from hilcal.types import Floats

_DEFLECTION_CAP = 0.6
_LABEL_ABOVE = np.array([0.0, 0.0, 0.3])
_DOT = 0.012  # m, half the distance of two dots of a leader
LEADER_RADIUS = rr.Radius.ui_points(0.5)


def static_scene(rec: rr.RecordingStream, d: Digest) -> None:
    """Log what never changes: the arm's shapes and the axes of the world."""
    arm = d.story.arm
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    arm_shapes.log_bodies(rec, capsules(arm))
    number = d.story.target
    seen = () if number is None else np.unique(number)
    names = [style.safe(d.story.target_names[k]) for k in seen]
    arm_shapes.log_targets(rec, arm, d.targets, style.MEASURED, names)


def revision_scene(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log one revision at the recording's current time: arrows, balls, the arm at its worst."""
    story, worst = d.story, d.worst(r)
    stand(rec, d.bodies[int(d.row[worst])])
    shown = d.shown(r)
    colors = style.LEVEL_COLORS[style.levels(r.whitened_norm2[shown])]
    rec.log(
        "world/residual/arrows",
        rr.Arrows3D(
            origins=story.anchor[shown],
            vectors=d.arrows(r.residual[shown]),
            colors=colors,
            radii=np.where(style.levels(r.whitened_norm2[shown]) > 0, 0.0055, 0.0035),
        ),
    )
    balls = d.balled(r)
    rec.log(
        "world/residual/noise",
        rr.Ellipsoids3D(
            centers=story.anchor[balls],
            half_sizes=d.half_sizes[balls],
            quaternions=d.quaternions[balls],
            colors=[(*style.NOISE, 46)],
            fill_mode="solid",
        ),
    )
    rec.log(
        "world/residual/worst",
        arm_shapes.labels(
            [story.anchor[worst] + _LABEL_ABOVE],
            [f"worst: pose {story.pose_name(worst)}, {pose_words(d, r, worst)}"],
        ),
    )
    rec.log(
        "world/residual/leader",
        rr.LineStrips3D(list(leader(d, worst)), colors=[style.LEADER], radii=LEADER_RADIUS),
    )
    _deflections(rec, d, r)


def pose_scene(rec: rr.RecordingStream, d: Digest) -> None:
    """Send the arm and the highlighted arrow of every pose, as columns on `pose`."""
    story, r = d.story, d.story.revisions[-1]
    time = rr.TimeColumn("pose", sequence=d.poses)
    for i in range(1, d.bodies.shape[1]):
        rec.send_columns(
            f"world/arm/body{i}",
            indexes=[time],
            columns=rr.Transform3D.columns(
                translation=d.bodies[:, i, :3, 3],
                quaternion=quaternions_of(d.bodies[:, i, :3, :3]),
            ),
        )
    worst = d.worst_of_poses(r)
    rec.send_columns(
        "world/residual/current",
        indexes=[time],
        columns=[
            *rr.Arrows3D.columns(
                origins=story.anchor[worst],
                vectors=d.arrows(r.residual[worst]),
                colors=style.LEVEL_COLORS[style.levels(r.whitened_norm2[worst])],
                radii=np.full(len(worst), 0.012),
            )
        ],
    )
    rec.send_columns(
        "world/residual/ball",
        indexes=[time],
        columns=rr.Ellipsoids3D.columns(
            centers=story.anchor[worst],
            half_sizes=d.half_sizes[worst],
            quaternions=d.quaternions[worst],
            colors=np.tile(np.array(style.PREDICTED, dtype=np.uint8), (len(worst), 1)),
        ),
    )
    dots = [leader(d, int(i)) for i in worst]
    rec.send_columns(
        "world/residual/leader",
        indexes=[time],
        columns=rr.LineStrips3D.columns(strips=np.concatenate(dots)).partition(
            [len(x) for x in dots]
        ),
    )
    rec.send_columns(
        "world/residual/worst",
        indexes=[time],
        columns=arm_shapes.label_columns(
            story.anchor[worst] + _LABEL_ABOVE,
            [f"pose {story.pose_name(i)}: {pose_words(d, r, i)}" for i in worst],
        ),
    )


def pose_words(d: Digest, r: StoryRevision, i: int) -> str:
    """Return a reading's residual as words: length, and in σ."""
    length = float(np.linalg.norm(r.residual[i]))
    number = d.story.target
    name = "" if number is None else f"{style.safe(d.story.target_names[number[i]])} "
    return f"{name}{numbers.length(length)} ({np.sqrt(r.whitened_norm2[i]):.1f} σ)"


def leader(d: Digest, i: int) -> Floats:
    """(K, 2, 3) dots from above a reading's noise ball to its label, m.

    Thin, dotted and grey, so that nobody takes them for a residual, which is a solid arrow.
    """
    ball = float(d.half_sizes[i].max())
    top = float(_LABEL_ABOVE[2])
    z = np.arange(min(1.1 * ball, top - _DOT), top, 2.0 * _DOT)
    ends = np.stack([z, np.minimum(z + 0.5 * _DOT, top)], 1)
    return np.asarray(d.story.anchor[i] + ends[:, :, None] * np.array([0.0, 0.0, 1.0]))


def seen(d: Digest) -> Floats:
    """(K, 3) what is to be in the picture: targets, the arm in its worst poses, labels, m."""
    worst = [d.worst(r) for r in d.story.revisions]
    stands = d.bodies[d.row[worst], :, :3, 3].reshape(-1, 3)
    return np.vstack([d.story.anchor, stands, d.story.anchor[worst] + _LABEL_ABOVE])


def center(d: Digest) -> tuple[Floats, float]:
    """Middle of everything drawn and its half size: where the eye looks, m."""
    points = np.vstack([d.story.anchor, np.zeros((1, 3))])
    lo, hi = points.min(0), points.max(0)
    return (lo + hi) / 2, max(float(np.linalg.norm(hi - lo)) / 2, 0.3 * d.story.arm.reach)


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


def _deflections(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log one pair of arrows per pose, of its largest deflection, and what parts their tips."""
    story, some = d.story, d.most_deflected(r)
    at = story.anchor[some]
    tips = []
    for name, value, color, radius in (
        ("measured", story.measured, style.MEASURED, 0.0055),
        ("predicted", r.predicted, style.PREDICTED, 0.0045),
    ):
        moved = capped(deviation(story, value)[some] * d.deflection_scale, _DEFLECTION_CAP)
        tips.append(at + moved)
        rec.log(
            f"world/deflection/{name}",
            rr.Arrows3D(origins=at, vectors=moved, colors=[color], radii=[radius]),
        )
    rec.log(
        "world/deflection/missed",
        rr.LineStrips3D(
            list(np.stack(tips, 1)),
            colors=style.LEVEL_COLORS[style.levels(r.whitened_norm2[some])],
            radii=rr.Radius.ui_points(1.6),
        ),
    )
