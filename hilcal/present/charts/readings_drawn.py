"""Readings as points: which of very many are drawn, their names for people, their levels."""

import html
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilcal import numbers
from hilcal.names import escaped as without_controls
from hilcal.present.charts import style
from hilcal.present.story import Story, StoryRevision, levels, worst_and_even
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

MOST = 1500
"""Readings that a chart draws; a choice by the size of the page, 8 MB."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """The readings that a chart draws of one revision.

    Attributes:
        index: (K,) readings, growing.
        of: number of all readings N.
        sigma: (K,) Mahalanobis distance, σ.
        size_m: (K,) length of the residual, m.
        level: (K,) 0 inside the noise, 1 doubtful, 2 outside.
        names: (K,) pose, load, size and distance in words.
    """

    index: Ints
    of: int
    sigma: Floats
    size_m: Floats
    level: Ints
    names: tuple[str, ...]

    @property
    def note(self) -> str:
        """What is said where not all readings are drawn; else empty."""
        if len(self.index) == self.of:
            return ""
        worst = max(1, len(self.index) // 5)
        return (
            f" Of {self.of} readings {len(self.index)} are drawn: the {worst} furthest off and an "
            "even choice of the others."
        )

    def by_level(self) -> Iterator[tuple[int, Bools]]:
        """Yield each level that occurs with its members (K,)."""
        for k in range(len(style.LEVELS)):
            mine = self.level == k
            if mine.any():
                yield k, mine

    def named(self, mine: Bools) -> list[str]:
        """Return the names of some."""
        return [self.names[i] for i in np.flatnonzero(mine)]


def drawn(story: Story, revision: StoryRevision, most: int = MOST) -> Drawn:
    """Choose at most `most` readings, and name them."""
    sigma = np.sqrt(revision.whitened_norm2)
    size = np.linalg.norm(revision.residual, axis=1)
    index = worst_and_even(revision.whitened_norm2, most)
    return Drawn(
        index=index,
        of=len(story),
        sigma=sigma[index],
        size_m=size[index],
        level=levels(revision.whitened_norm2[index]),
        names=tuple(
            f"{place(story, int(i))}: {numbers.length(float(size[i]))}, {sigma[i]:.1f} σ"
            for i in index
        ),
    )


def place(story: Story, i: int) -> str:
    """Return pose and load of a reading, and its target where there are several."""
    load = story.load_names[i]
    words = f"{story.pose_name(i)}, {'unloaded' if load == UNLOADED else load}"
    if story.target is not None and len(story.target_names) > 1:
        words += f", {story.target_names[int(story.target[i])]}"
    return escaped(words)


def escaped(words: str) -> str:
    """Return words without a meaning in the HTML that plotly takes for labels."""
    return html.escape(without_controls(words), quote=False)
