"""Base and target frames by the readings that agree, where others are centimetres off."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.identification.off_alike import off_alike
from hilcal.identification.outliers import limit
from hilcal.identification.reading_model import ReadingModel
from hilcal.identification.rigid_frames import (
    Frames,
    Free,
    Seen,
    derivative,
    minimise,
    misfit,
    moved,
    sizes,
)
from hilcal.identification.robust_start import MOST, robust_start, variance
from hilcal.readings.readings import Readings
from hilcal.types import Bools, Floats

SEED = 0
"""Of the random subsets, so that equal readings give equal frames."""
ROUNDS = 5
"""Most rounds in which readings join and leave; a choice."""


@dataclass(frozen=True, eq=False)
class _Linearised:
    """The linear model of the readings at some frames."""

    seen: Seen
    frames: Frames
    free: Free

    @property
    def centre(self) -> Floats:
        """(3,) the point that the base turns about, m."""
        return np.asarray(self.seen.position.mean(axis=0))

    @property
    def scale(self) -> Floats:
        """(P,) units of the columns."""
        return sizes(len(self.frames.targets))[self.free.mask]

    @property
    def linear(self) -> ReadingModel:
        """The linear model."""
        off, slope = misfit(self.seen, self.frames), derivative(self.seen, self.frames, self.centre)
        none = np.zeros(len(self.scale))
        return ReadingModel(
            residual=np.einsum("nij,nj->ni", self.seen.root, off),
            columns=self.seen.root @ slope[:, :, self.free.mask] * self.scale,
            precision=none,
            pull=none,
            root=self.seen.root,
            members=np.zeros((0, 0), dtype=np.int64),
        )

    def moved(self, delta: Floats) -> "_Linearised":
        """Return it after a step."""
        step = np.zeros(len(self.free.mask))
        step[self.free.mask] = self.scale * delta
        return replace(self, frames=moved(self.frames, step, self.centre))


def far_readings(readings: Readings, seen: Seen, at: Frames, free: Free, enough: float) -> Bools:
    """(N,) readings far off while the others fit to within `enough` m rms; none in other cases.

    Args:
        readings: N readings.
        seen: flange poses and readings.
        at: the frames of all of them.
        free: what is estimated.
        enough: misfit of readings that are right, m.
    """
    none = np.zeros(len(seen), dtype=np.bool_)
    if np.sqrt(np.mean(np.sum(misfit(seen, at)[:, :3] ** 2, axis=1))) <= enough:
        return none
    begun = _Linearised(seen, at, free)
    found, used = robust_start(begun, np.random.default_rng(SEED))
    frames = found.frames
    for _ in range(ROUNDS):
        of = _Linearised(seen, frames, free).linear
        d2, _ = of.near(np.zeros(of.columns.shape[2]))
        far = d2 > limit(seen.m, len(seen), variance(of, d2, none))
        if far.mean() > MOST:
            return none
        frames = minimise(seen[~far], frames, free).frames
        if np.array_equal(far, ~used):
            break
        used = ~far
    off = misfit(seen, frames)[:, :3]
    rows = np.flatnonzero(far)
    axes = frames.base[:3, :3] @ seen.rotation[rows] @ frames.targets[seen.target[rows], :3, :3]
    fits = np.sqrt(np.mean(np.sum(off[~far] ** 2, axis=1))) <= enough
    alike = off_alike(readings, ~none, rows, off[rows], axes)
    return far if fits and not len(alike) else none
