"""A campaign as it is drawn: its readings, and one model revision after another, in base axes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy import stats

from hilcal.present.document import Block
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

Mode = Literal["deflection", "absolute"]
LEVEL_NAMES = ("inside the noise", "doubtful", "outside the noise")
LIMITS = (0.99, 0.9999)
"""Quantiles of χ²(3) from which a reading is doubtful, and outside: noise does that once in 100,
and in 10,000 readings."""
REVISION_HEADS = (
    *("rev.", "model", "poses\nfitted", "\nσ", "poses\nleft out", "\nσ"),
    *("variance\nfactor", "verdict"),
)
"""Of a table of revisions."""


def levels(norm2: Floats) -> Ints:
    """Level (N,) of squared Mahalanobis distances (N,), 3 dof, into `LEVEL_NAMES`."""
    return np.digitize(norm2, stats.chi2.ppf(LIMITS, 3)).astype(np.int64)


def worst_and_even(badness: Floats, most: int) -> Ints:
    """Return at most `most` indices, growing: the worst fifth, the others chosen evenly."""
    if len(badness) <= most:
        return np.arange(len(badness))
    worst = np.argsort(-badness, kind="stable")[: max(1, most // 5)]
    rest = np.setdiff1d(np.arange(len(badness)), worst)
    even = rest[np.linspace(0, len(rest) - 1, most - len(worst)).round().astype(np.int64)]
    return np.sort(np.concatenate([worst, np.unique(even)]))


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Something over a variable that it may follow; units as the labels name them.

    Attributes:
        title: the variable, the suspect or the law.
        says: a sentence on it.
        x: (K,) of the variable: of single readings, or centres of bins.
        y: (K,) residual, or its mean in the bin.
        x_label: the variable with its unit.
        y_label: what errs or moves, with its unit.
        error: (K,) standard uncertainty of the means; None of single readings.
        names: (K,) of the bins, where x only counts them; else empty.
        line: (2, L) the variable, and the law; None without one.
        facts: what a law is, in names and words.
    """

    title: str
    says: str
    x: Floats
    y: Floats
    x_label: str
    y_label: str
    error: Floats | None = None
    names: tuple[str, ...] = ()
    line: Floats | None = None
    facts: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class StoryRevision:
    """One fitted model revision of N readings.

    Attributes:
        revision: its number, growing along the story.
        change: what it changed, e.g. "+ hysteresis"; empty for the first.
        verdict: one of the verdicts of `diagnose`, or `UNDIAGNOSED`.
        message: the verdict in words.
        residual: (N, 3) measured - predicted, base axes, m.
        predicted: (N, 3) position in absolute mode, deflection vector in deflection mode, m.
        whitened_norm2: (N,) squared Mahalanobis distance of each reading, 3 degrees of freedom.
        error_fit: error of the fitted readings, keys "rms_m", "mean_m", "max_m", "rms_sigma".
        error_holdout: error of whole poses left out, same keys.
        cells: of its row in a table of revisions.
        panels: "verdict", "details" and "parameters" in words and tables.
        follows: what the residual follows: the variable that carries most of it, where the first
            suspect explains little of that, else the first suspect; None where there is neither.
        laws: of the model, which the catalogue does not have; one entry per curve.
    """

    revision: int
    change: str
    verdict: str
    message: str
    residual: Floats
    predicted: Floats
    whitened_norm2: Floats
    error_fit: Mapping[str, float]
    error_holdout: Mapping[str, float]
    cells: tuple[str, ...] = ()
    panels: Mapping[str, tuple[Block, ...]] = field(default_factory=dict)
    follows: Curve | None = None
    laws: tuple[Curve, ...] = ()

    @property
    def name(self) -> str:
        """What it changed, or its model where it is the first."""
        return self.change or (self.cells[1] if self.cells else "first model")


@dataclass(frozen=True, slots=True, eq=False)
class Story:
    """N readings and the revisions of the model that was fitted to them; SI, base axes.

    Attributes:
        arm: the arm.
        mode: what the readings are.
        q: (N, n) joint angles, rad.
        pose: (N,) index of the commanded pose.
        load_names: (N,) name of each reading's load.
        anchor: (N, 3) nominal position of the target, where arrows start, m.
        measured: (N, 3) deflection vector, or position in absolute mode, m.
        covariance: (N, 3, 3) covariance of the residual, m².
        noise_floor_m: rms 3-D error that noise alone would leave, m.
        revisions: the revisions, in growing order.
        target: (N,) number of the target that was read, into `target_names`; None for one.
        target_names: names of several targets.
        pose_names: (N,) name of each reading's pose; empty where its number is its name.
        time_s: (N,) time of each reading, s; None where the readings do not state it.
        growing: whether further revisions may follow.
    """

    arm: Arm
    mode: Mode
    q: Floats
    pose: Ints
    load_names: tuple[str, ...]
    anchor: Floats
    measured: Floats
    covariance: Floats
    noise_floor_m: float
    revisions: tuple[StoryRevision, ...]
    target: Ints | None = None
    target_names: tuple[str, ...] = ()
    pose_names: tuple[str, ...] = ()
    time_s: Floats | None = None
    growing: bool = False

    def pose_name(self, i: int) -> str:
        """Return the name of reading i's pose, as everywhere else."""
        return self.pose_names[i] if self.pose_names else str(self.pose[i])

    def __len__(self) -> int:
        """Return the number of readings N."""
        return len(self.pose)
