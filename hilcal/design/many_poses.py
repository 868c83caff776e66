"""Many poses, read once and unloaded: what tells of a cause that depends on the pose alone."""

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.feasible import Space
from hilcal.design.next import reordered
from hilcal.design.planner import Planned, Request, Say, make
from hilcal.design.run_order import Ordering
from hilcal.errors import CannotAnswerError
from hilcal.identification.fit import Fit
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

CRITERION = "D"
"""By which the plan's efficiency is stated; its poses are not chosen by it."""
SPARE = 2
"""Candidates per pose: some are not reached from the reference. A choice."""
LEAST = 60
"""Candidates at least, so that a reference is found; a choice."""
REPEATED = 10
"""One pose of so many is arrived at twice, for the arm's repeatability. A choice."""


def measure_poses(
    cell: Cell,
    config: CellConfig,
    fit: Fit,
    poses: int,
    rng: np.random.Generator,
    say: Say = lambda words: None,
    reference: Floats | None = None,
) -> Planned:
    """Plan distinct poses spread evenly over the joint space, each read once without a load.

    An optimal design would take few poses many times, which is best for a model that is known. What
    errs from pose to pose, finer than the poses so far resolve, needs poses where nothing was read.
    The candidates' order is that of a Sobol sequence: the first ones that are reached are taken.

    Args:
        fit: what has been measured, absolute readings.
        reference: (n,) joints of the campaign's reference pose, rad; a new one where None.

    Raises:
        CannotAnswerError: the cell leaves no such poses.
    """
    count = max(SPARE * poses, LEAST)
    planning = config.planning.model_copy(update={"readings": fit.mode, "candidates": count})
    config = config.model_copy(update={"loads": [], "planning": planning})
    made = make(
        cell, config, Request(poses, readings=poses, criterion=CRITERION, effort=0), rng, fit, say
    )
    say("spreading the poses")
    of, space = made.problem, Space(cell, config)
    home = made.ordered.plan.q[0] if reference is None else reference
    usable = np.flatnonzero(made.usable)
    q = of.candidates.q[[of.what[k][0] for k in usable]]
    taken = usable[space.passable(home, q, UNLOADED)][:poses]
    if not len(taken):
        raise CannotAnswerError(
            "no pose is reached from the campaign's reference pose; start another campaign"
        )
    counts = np.zeros(len(made.usable), dtype=np.int64)
    counts[taken] = 1
    how = Ordering(repeats=max(2, len(taken) // REPEATED))
    return reordered(space, made, counts, home, rng, how)
