"""A campaign's 3-D views: arm, residual arrows in their noise balls, deflections."""

import numpy as np
import rerun as rr

from hilcal import numbers
from hilcal.present.story import Story, StoryRevision, worst_and_even
from hilcal.present.viewer import arm_shapes, style
from hilcal.present.viewer.recording import along, fixed
from hilcal.robot.body import capsules
from hilcal.types import Floats, Ints

SIGMA_LENGTH = 0.02  # one σ is drawn this long, m
ARROW_CAP = 0.40  # longest arrow, m
DEFLECTION_LENGTH = 0.25  # a large measured deflection is drawn this long, m
_DEFLECTION_CAP = 0.6
ARROWS, BALLS, PAIRS = 150, 60, 150
"""How much is drawn at most, so that a picture stays legible and a file small."""
_LABEL_ABOVE = np.array([0.0, 0.0, 0.3])
_DOT = 0.012  # m, half the distance of two dots of a leader


def residual_scale(story: Story) -> float:
    """Return the m that are drawn per m of residual."""
    sigma = float(np.sqrt(np.median(np.trace(story.covariance, axis1=1, axis2=2)) / 3))
    return style.nice(SIGMA_LENGTH / sigma) if sigma > 0 else 1.0


def deflection_scale(story: Story) -> float:
    """Return the m that are drawn per m of deflection."""
    moved = np.linalg.norm(story.deviation(story.measured), axis=1)
    typical = float(np.quantile(moved, 0.95))
    return style.nice(DEFLECTION_LENGTH / typical) if typical > 0 else 1.0


def noise_balls(story: Story, rows: Ints) -> tuple[Floats, Floats]:
    """Half axes (K, 3), m, and quaternions (K, 4) of readings' noise balls, as they are drawn.

    C = V diag(w) Vᵀ, V a proper rotation, has half axes of sqrt(w) at one σ.
    """
    w, v = np.linalg.eigh(story.covariance[rows])
    v[:, :, 0] *= np.sign(np.linalg.det(v))[:, None]
    half = style.BALL_SIGMAS * residual_scale(story) * np.sqrt(np.maximum(w, 0.0))
    return np.maximum(half, 1e-3), arm_shapes.quaternions_of(v)


def worst(r: StoryRevision) -> int:
    """Return the reading with the largest Mahalanobis distance."""
    return int(np.argmax(r.whitened_norm2))


def balled(story: Story, r: StoryRevision) -> Ints:
    """Return the readings whose ball is drawn: of each chosen pose, its worst reading."""
    of_pose = story.last_of_poses(r.whitened_norm2)
    return np.asarray(of_pose[worst_and_even(r.whitened_norm2[of_pose], BALLS)])


def shown(story: Story, r: StoryRevision) -> Ints:
    """Return the readings whose arrows are drawn: the worst, the balled, an even rest."""
    return np.union1d(worst_and_even(r.whitened_norm2, ARROWS), balled(story, r))


def static_scene(rec: rr.RecordingStream, story: Story) -> None:
    """Log what never changes: the arm's shapes and the axes of the world."""
    fixed(rec, "world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    arm_shapes.log_bodies(rec, capsules(story.arm))
    several = () if story.target is None else np.unique(story.target)
    names = [style.safe(story.target_names[k]) for k in several]
    arm_shapes.log_targets(rec, story.arm, story.targets, names)


def revision_scene(rec: rr.RecordingStream, story: Story, r: StoryRevision) -> None:
    """Log one revision at the recording's current time: arrows, balls, the arm at its worst."""
    far, drawn, balls = worst(r), shown(story, r), balled(story, r)
    arm_shapes.stand(rec, story.bodies[story.row[far]])
    level = r.level[drawn]
    found = rr.Arrows3D(
        origins=story.anchor[drawn],
        vectors=arrows(story, r, drawn),
        colors=style.LEVEL_COLORS[level],
        radii=np.where(level > 0, 0.0055, 0.0035),
    )
    rec.log("world/residual/arrows", found)
    half, quaternions = noise_balls(story, balls)
    noise = rr.Ellipsoids3D(
        centers=story.anchor[balls],
        half_sizes=half,
        quaternions=quaternions,
        colors=[(*style.NOISE, 46)],
        fill_mode="solid",
    )
    rec.log("world/residual/noise", noise)
    at, words = story.anchor[far], f"worst: pose {story.pose_name(far)}, {_words(story, r, far)}"
    rec.log("world/residual/worst", arm_shapes.labels([at + _LABEL_ABOVE], [words]))
    dots = list(leader(at, noise_balls(story, np.array([far]))[0]))
    lines = rr.LineStrips3D(dots, colors=[style.LEADER], radii=rr.Radius.ui_points(0.5))
    rec.log("world/residual/leader", lines)
    _deflections(rec, story, r)


def pose_scene(rec: rr.RecordingStream, story: Story) -> None:
    """Send the arm and the highlighted arrow of every pose, as columns on `pose`."""
    r, time = story.revisions[-1], rr.TimeColumn("pose", sequence=story.poses)
    arm_shapes.send_stands(rec, time, story.bodies)
    far = story.last_of_poses(r.whitened_norm2)
    at, (half, quaternions) = story.anchor[far], noise_balls(story, far)
    now = rr.Arrows3D.columns(
        origins=at,
        vectors=arrows(story, r, far),
        colors=style.LEVEL_COLORS[r.level[far]],
        radii=np.full(len(far), 0.012),
    )
    along(rec, "world/residual/current", time, now)
    bright = np.tile(np.array(style.PREDICTED, dtype=np.uint8), (len(far), 1))
    ball = rr.Ellipsoids3D.columns(
        centers=at, half_sizes=half, quaternions=quaternions, colors=bright
    )
    along(rec, "world/residual/ball", time, ball)
    dots = [leader(a, h) for a, h in zip(at, half, strict=True)]
    strips = rr.LineStrips3D.columns(strips=np.concatenate(dots))
    along(rec, "world/residual/leader", time, strips.partition([len(x) for x in dots]))
    words = [f"pose {story.pose_name(i)}: {_words(story, r, i)}" for i in far.tolist()]
    along(rec, "world/residual/worst", time, arm_shapes.label_columns(at + _LABEL_ABOVE, words))


def _words(story: Story, r: StoryRevision, i: int) -> str:
    name = ""
    if story.target is not None:
        name = f"{style.safe(story.target_names[story.target[i]])} "
    return f"{name}{numbers.length(float(r.size_m[i]))} ({r.sigma[i]:.1f} σ)"


def leader(at: Floats, ball: Floats) -> Floats:
    """(K, 2, 3) dots from above a noise ball to the label of its reading, m.

    Thin, dotted and grey, so that nobody takes them for a residual, which is a solid arrow.

    Args:
        at: (3,) the ball's middle.
        ball: its half axes.
    """
    top = float(_LABEL_ABOVE[2])
    z = np.arange(min(1.1 * float(ball.max()), top - _DOT), top, 2.0 * _DOT)
    ends = np.stack([z, np.minimum(z + 0.5 * _DOT, top)], 1)
    return np.asarray(at + ends[:, :, None] * np.array([0.0, 0.0, 1.0]))


def seen(story: Story) -> Floats:
    """(K, 3) what is to be in the picture: targets, the arm in its worst poses, labels, m."""
    far = [worst(r) for r in story.revisions]
    stands = story.bodies[story.row[far], :, :3, 3].reshape(-1, 3)
    return np.vstack([story.anchor, stands, story.anchor[far] + _LABEL_ABOVE])


def arrows(story: Story, r: StoryRevision, rows: Ints) -> Floats:
    """(K, 3) residuals of readings as drawn: scaled, and capped in length, m."""
    return capped(r.residual[rows] * residual_scale(story), ARROW_CAP)


def capped(vectors: Floats, length: float) -> Floats:
    """(K, 3) vectors, those longer than `length` shortened to it."""
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, length / np.maximum(norm, 1e-300)))


def _deflections(rec: rr.RecordingStream, story: Story, r: StoryRevision) -> None:
    """Log a pair of arrows per chosen pose, of its largest deflection, and what is missed."""
    of_pose = story.last_of_poses(np.linalg.norm(story.deviation(story.measured), axis=1))
    some = of_pose[worst_and_even(r.whitened_norm2[of_pose], PAIRS)]
    at, scale, tips = story.anchor[some], deflection_scale(story), []
    for name, value, color, radius in (
        ("measured", story.measured, style.MEASURED, 0.0055),
        ("predicted", r.predicted, style.PREDICTED, 0.0045),
    ):
        moved = capped(story.deviation(value)[some] * scale, _DEFLECTION_CAP)
        tips.append(at + moved)
        drawn = rr.Arrows3D(origins=at, vectors=moved, colors=[color], radii=[radius])
        rec.log(f"world/deflection/{name}", drawn)
    colors, thin = style.LEVEL_COLORS[r.level[some]], rr.Radius.ui_points(1.6)
    missed = rr.LineStrips3D(np.stack(tips, 1), colors=colors, radii=thin)
    rec.log("world/deflection/missed", missed)
