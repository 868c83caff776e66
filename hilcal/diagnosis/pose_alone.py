"""A misfit that is the same under every load of a pose, and which effects do that.

With few poses a fine transmission error is no pattern: every pose errs by itself, and no pose
predicts another. But all readings of a pose err alike, whatever hangs on the arm. That alone says
much: what is missing depends on the pose, and on nothing else that changed within it.

The residual is split by constants of each pose, three displacements of the target. Where they leave
noise and take nearly all of the misfit, the effects are listed whose own columns are such constants
to nearly all of their square. The parameters of a family can be told apart once the poses measure
about as many elements as the family has parameters. The number of further poses that is proposed is
the smallest of the numbers tried at which the first of these effects, as large as the misfit, would
pass every test of a suspect with a probability of 0.9 (see `more_poses`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from hilcal.diagnosis.more_poses import enough
from hilcal.diagnosis.noise_verdict import MISFIT_ALARM
from hilcal.diagnosis.pose_constants import pose_constants
from hilcal.effects.protocol import Effect
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.linearisation import Linearisation

LEAST = 0.9
"""Share of the misfit that pose constants must take; a choice, they take 0.99 of a transmission
error of 2 σ."""
ALIKE = 0.98
"""Share of the square of an effect's columns that pose constants take where it depends on the pose
alone; a choice."""


@dataclass(frozen=True, slots=True)
class PoseAlone:
    """A misfit that depends on the pose alone.

    Attributes:
        share: share of the misfit that constants of each pose take, less what chance would.
        effects: those that depend on the pose alone, most parameters first.
        poses: number of poses that were measured.
        more: how many more poses, read unloaded, tell of the first of them.
        chance: that they do, where it is there with the size of the misfit; None where the model
            holds a coarser version of it.
    """

    share: float
    effects: tuple[str, ...]
    poses: int
    more: int
    chance: float | None


def pose_alone(
    p: Linearisation, effects: Sequence[Effect], level: float, least: float
) -> PoseAlone | None:
    """Return a misfit that depends on the pose alone; None where it does not, or nothing does that.

    Args:
        p: linearisation of the fit.
        effects: that are not in the model.
        level: of the test of a suspect, between 0 and 1.
        least: share of the misfit on poses left out that a suspect must explain.
    """
    found = pose_constants(p)
    if found is None:
        return None
    fit, rank = p.fit, found.rank
    rest = p.rss - found.gain
    share = p.share(found.gain - rank * rest / (fit.dof - rank))
    if share < LEAST or float(chi2.sf(rest, fit.dof - rank)) < MISFIT_ALARM:
        return None
    able, states = [], fit.readings[~fit.outlier].states
    for e in (*(e for e in fit.model.effects if e.fine(states)), *effects):
        full = e.fine(states) or e
        x = p.project_out(effect_columns(fit, full).white)
        square = float(np.sum(x**2))
        if square > 0 and found.square(x) >= ALIKE * square:
            able.append((len(full.parameters), e))
    if not able:
        return None
    able.sort(key=lambda pair: -pair[0])
    poses = int(fit.pose.max()) + 1
    about = max(int(np.ceil(able[0][0] / fit.whitening.m)) - poses, 0)
    if not about:
        return None
    names, first = tuple(e.name for _, e in able), able[0][1]
    if first.name in fit.model.names:
        return PoseAlone(share, names, poses, about, None)
    told = enough(p, first, about, level, least)
    return PoseAlone(share, names, poses, told.more, told.chance)
