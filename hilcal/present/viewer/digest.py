"""What the views have in common: poses, worst readings, scales; computed once per story."""

from dataclasses import dataclass

import numpy as np

from hilcal.present.story import Story, StoryRevision, worst_and_even
from hilcal.present.viewer import style
from hilcal.robot.body import body_poses
from hilcal.types import Floats, Ints

SIGMA_LENGTH = 0.02  # one σ is drawn this long, m
ARROW_CAP = 0.40  # longest arrow, m
DEFLECTION_LENGTH = 0.25  # a large measured deflection is drawn this long, m


ARROWS, BALLS, PAIRS, BARS = 150, 60, 150, 150
"""How much is drawn at most, so that a picture stays legible and a file small."""


@dataclass(frozen=True, slots=True, eq=False)
class Digest:
    """A story and what is derived from it, constant over its revisions.

    Attributes:
        story: the story.
        poses: (P,) pose numbers, growing.
        row: (N,) index into `poses` of each reading.
        first: (P,) the first reading of each pose.
        bodies: (P, n + 2, 4, 4) poses of the arm's bodies at each pose.
        targets: (T, 3) targets in flange axes, m.
        residual_scale: m drawn per m of residual.
        deflection_scale: m drawn per m of deflection.
        half_sizes: (N, 3) half axes of each reading's noise ball as drawn, m.
        quaternions: (N, 4) their orientation, x y z w.
    """

    story: Story
    poses: Ints
    row: Ints
    first: Ints
    bodies: Floats
    targets: Floats
    residual_scale: float
    deflection_scale: float
    half_sizes: Floats
    quaternions: Floats

    @property
    def poses_per_bar(self) -> int:
        """Consecutive poses that share one bar, so that bars stay wide enough to be read."""
        return -(-len(self.poses) // BARS)

    def pose_rms(self, revision: StoryRevision) -> Floats:
        """(P,) root mean square length of the residuals of each pose, m."""
        square = np.bincount(self.row, (revision.residual**2).sum(1), len(self.poses))
        return np.sqrt(square / np.bincount(self.row, minlength=len(self.poses)))

    def pose_norm2(self, revision: StoryRevision) -> Floats:
        """(P,) largest squared Mahalanobis distance of each pose."""
        worst = np.zeros(len(self.poses))
        np.maximum.at(worst, self.row, revision.whitened_norm2)
        return worst

    def worst(self, revision: StoryRevision) -> int:
        """Return the reading with the largest Mahalanobis distance."""
        return int(np.argmax(revision.whitened_norm2))

    def arrows(self, residual: Floats) -> Floats:
        """(K, 3) residuals as drawn: scaled, and capped in length, m."""
        return capped(residual * self.residual_scale, ARROW_CAP)

    def shown(self, revision: StoryRevision) -> Ints:
        """Return the readings whose arrows are drawn: the worst, the balled, an even rest."""
        some = worst_and_even(revision.whitened_norm2, ARROWS)
        return np.union1d(some, self.balled(revision))

    def worst_of_poses(self, revision: StoryRevision) -> Ints:
        """(P,) the reading of each pose with the largest Mahalanobis distance."""
        order = np.lexsort((revision.whitened_norm2, self.row))
        last = np.append(np.flatnonzero(np.diff(self.row[order])), len(order) - 1)
        return np.asarray(order[last], dtype=np.int64)

    def most_deflected(self, revision: StoryRevision) -> Ints:
        """Return of each chosen pose the reading with the largest measured deflection."""
        size = np.linalg.norm(deviation(self.story, self.story.measured), axis=1)
        order = np.lexsort((size, self.row))
        of_pose = order[np.append(np.flatnonzero(np.diff(self.row[order])), len(order) - 1)]
        chosen = worst_and_even(revision.whitened_norm2[of_pose], PAIRS)
        return np.asarray(of_pose[chosen])

    def balled(self, revision: StoryRevision) -> Ints:
        """Return the readings whose ball is drawn: of each chosen pose, its worst reading."""
        of_pose = self.worst_of_poses(revision)
        chosen = worst_and_even(revision.whitened_norm2[of_pose], BALLS)
        return np.asarray(of_pose[chosen])


def digest(story: Story) -> Digest:
    """Derive what the views need."""
    poses, first, row = np.unique(story.pose, return_index=True, return_inverse=True)
    bodies = body_poses(story.arm, story.q[first])
    flange = bodies[row.reshape(-1), -1]
    offset = np.einsum("nij,ni->nj", flange[:, :3, :3], story.anchor - flange[:, :3, 3])
    number = np.zeros(len(story), dtype=np.int64) if story.target is None else story.target
    sigma = float(np.sqrt(np.median(np.trace(story.covariance, axis1=1, axis2=2)) / 3))
    scale = style.nice(SIGMA_LENGTH / sigma) if sigma > 0 else 1.0
    moved = deviation(story, story.measured)
    typical = float(np.quantile(np.linalg.norm(moved, axis=1), 0.95))
    half_sizes, quaternions = ellipsoids(story.covariance)
    return Digest(
        story=story,
        poses=poses.astype(np.int64),
        row=row.astype(np.int64).reshape(-1),
        first=first.astype(np.int64),
        bodies=bodies,
        targets=np.array([np.median(offset[number == k], axis=0) for k in np.unique(number)]),
        residual_scale=scale,
        deflection_scale=style.nice(DEFLECTION_LENGTH / typical) if typical > 0 else 1.0,
        half_sizes=np.maximum(style.BALL_SIGMAS * scale * half_sizes, 1e-3),
        quaternions=quaternions,
    )


def deviation(story: Story, value: Floats) -> Floats:
    """Deflection of measured or predicted values: in absolute mode from the nominal position."""
    return value if story.mode == "deflection" else value - story.anchor


def ellipsoids(covariance: Floats) -> tuple[Floats, Floats]:
    """Half axes sqrt(w) and orientations of C = V diag(w) Vᵀ, V a proper rotation.

    Args:
        covariance: (N, 3, 3), m².

    Returns:
        (N, 3) half axes at one σ, m, and (N, 4) quaternions x y z w.
    """
    w, v = np.linalg.eigh(covariance)
    v[:, :, 0] *= np.sign(np.linalg.det(v))[:, None]
    return np.sqrt(np.maximum(w, 0.0)), quaternions_of(v)


def quaternions_of(rotation: Floats) -> Floats:
    """(N, 4) quaternions x y z w of (N, 3, 3) rotations, w >= 0."""
    from scipy.spatial.transform import Rotation

    q: Floats = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return q


def capped(vectors: Floats, length: float) -> Floats:
    """(K, 3) vectors, those longer than `length` shortened to it."""
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, length / np.maximum(norm, 1e-300)))
