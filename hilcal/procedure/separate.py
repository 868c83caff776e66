"""What an ambiguous diagnosis leaves open, and the measurements that would settle it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.next import Next, PairPower, measure_next, measure_poses
from hilcal.design.planner import Request
from hilcal.design.summary import about
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.doubt import in_doubt
from hilcal.diagnosis.more_poses import pose_powers
from hilcal.diagnosis.pose_alone import PoseAlone
from hilcal.diagnosis.stepwise import remove
from hilcal.identification.fit import Fit
from hilcal.store.plan import Plan
from hilcal.types import Floats

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Doubt:
    """What is to be separated.

    Attributes:
        fit: of a model without the suspects.
        suspects: the effects.
        alone: the misfit where more poses, unloaded, are what tells of it; None else.
    """

    fit: Fit
    suspects: tuple[str, ...]
    alone: PoseAlone | None = None


def doubt_of(d: Diagnosis, say: Say = lambda words: None) -> Doubt | None:
    """Return what a diagnosis leaves open; None where nothing is, or an option settles it."""
    suspects = in_doubt(d)
    if not suspects or any(s.coarse for s in d.suspects if s.effect in suspects):
        return None
    a = d.pose_alone
    alone = a if a is not None and a.chance is not None and d.fit.mode == "absolute" else None
    return Doubt(without(d.fit, suspects, say), suspects, alone)


def without(found: Fit, suspects: tuple[str, ...], say: Say = lambda words: None) -> Fit:
    """Return the fit of a model without some effects."""
    for name in suspects:
        if name in found.model.names:
            say(f"fitting without {name}")
            found = remove(found, name)
    return found


def separating(
    cell: Cell,
    config: CellConfig,
    doubt: Doubt,
    poses: int | None,
    rng: np.random.Generator,
    say: Say = lambda words: None,
    reference: Floats | None = None,
    usual: int = 20,
) -> Next:
    """Plan the measurements that separate the suspects of a doubt.

    Args:
        cell: the cell.
        config: its limits, loads and noise.
        doubt: what is to be separated.
        poses: as many readings as so many poses take; what the doubt needs, or `usual`, where None.
        rng: generator.
        say: takes progress, one line each.
        reference: (n,) joints of the campaign's reference pose, rad.
        usual: poses where the doubt does not say how many it needs.

    Raises:
        InputError: suspects that cannot be.
        CannotAnswerError: no measurement separates any two of them, or no plan can be made.
    """
    before, effects = doubt.fit, doubt.suspects
    if doubt.alone is None:
        asked = Request(usual if poses is None else poses)
        return measure_next(cell, config, before, effects, asked, rng, say, reference)
    count = doubt.alone.more if poses is None else poses
    planned = measure_poses(cell, config, before, count, rng, say, reference)
    say("predicting the powers")
    powers = tuple(PairPower(*row, False) for row in pose_powers(before, effects, count))
    return Next(planned, powers, {}, 1.0, ())


def plan_of(found: Next, suspects: tuple[str, ...]) -> Plan:
    """Return the plan with what its file says of it."""
    told = [[t.effect, t.rival, round(t.then, 4)] for t in found.powers]
    more = {**about(found.planned), "suspects": list(suspects), "separates": told}
    return replace(found.planned.ordered.plan, about=more)
