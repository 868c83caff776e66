"""The order in which chosen readings are taken: little time, and time that means nothing."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.data.plan import REFERENCE, UNLOADED, Plan
from hilcal.errors import InputError
from hilcal.plan.confounding import Confounding
from hilcal.plan.ordering import Chosen, Ordering, stops_of
from hilcal.plan.passages import Passable
from hilcal.plan.run_order import Maker
from hilcal.plan.timing import Duration
from hilcal.types import Floats

__all__ = ["Chosen", "Ordered", "Ordering", "order_plan"]

_SHRINK = 0.75  # of the time given to the walks, where a draw became too long
_TRIES = 10  # draws of one order that may become too long


@dataclass(frozen=True, slots=True, eq=False)
class Ordered:
    """A plan and what its order costs and loses.

    Attributes:
        plan: the plan; `about` holds these figures too.
        duration: of the plan.
        shortest: of the shortest order with the same readings.
        confounding: of the plan.
        confounding_shortest: of the shortest order.
    """

    plan: Plan
    duration: Duration
    shortest: Duration
    confounding: Confounding
    confounding_shortest: Confounding

    @property
    def longer(self) -> float:
        """Share of time lost to the random order."""
        return self.duration.total / self.shortest.total - 1.0


def order_plan(
    cell: Cell,
    config: CellConfig,
    names: Sequence[str],
    q: Floats,
    reference: Floats,
    chosen: Sequence[Chosen],
    passable: Passable,
    rng: np.random.Generator,
    how: Ordering | None = None,
) -> Ordered:
    """Put chosen readings in order.

    Time. Every load is hung once. Under a load the arm goes along a short tour in the metric of
    the leading joint's time, cut into loops from the reference pose so that this is read every
    so many minutes, also loaded, and before and after each load; where no straight motion is
    clear it goes by the reference, which then counts as a return.

    Loss. Readings of a pose under different loads are far apart in time, so that a drift looks
    like a load, or like a pose. What is lost is stated as ρ², see `Confounding`: the share of
    its information that the parameter hit hardest loses where the drift has to be estimated as
    well; and as the error of a deflection where it is not. Three things keep it small:
    - half of the unloaded readings, drawn at random, come after the loads: lags of both signs,
      at no cost but a second tour;
    - loads in the order that is least correlated with time, which costs nothing, since every
      load begins and ends at the reference;
    - orders drawn at random among those whose campaign is at most 1 + slack times the shortest:
      walks through the orders, loops in random order and direction. Of some draws the one with
      the least ρ is taken (rerandomisation, Morgan & Rubin 2012, Ann. Statist. 40, 1263): the
      order stays random towards everything that is no regressor, such as temperatures.

    Args:
        cell: the cell.
        config: its loads, motion and acquisition.
        names: (P) names of poses.
        q: (P, n) their joint angles, rad.
        reference: (n,) joint angles of the reference pose, rad.
        chosen: what to measure.
        passable: which motions are clear.
        rng: generator.
        how: settings.

    Raises:
        InputError: nothing is chosen, or a name is unknown.
        CannotAnswerError: a pose cannot be reached from the reference under a load.
    """
    how = how or Ordering()
    _check(config, names, chosen, how)
    used = [name for name in names if any(c.pose == name for c in chosen)]
    at = np.array([names.index(name) for name in used])
    maker = Maker(cell, config, tuple(used), np.vstack([reference, q[at]]), how, rng)
    maker.prepare(stops_of(used, chosen, how.repeats, rng), passable)
    plain = maker.shortest()
    plain_time, plain_loss = maker.figures(plain)
    best = (plain_loss.correlation, plain, plain_time, plain_loss)
    spare = how.slack * plain_time.total
    for _ in range(how.draws if how.slack > 0 else 0):
        extra = spare * rng.random()
        for _ in range(_TRIES):
            plan = maker.draw(extra)
            time, loss = maker.figures(plan)
            if time.total <= plain_time.total + spare:
                if loss.correlation < best[0]:
                    best = loss.correlation, plan, time, loss
                break
            extra *= _SHRINK
    _, plan, time, loss = best
    about = {
        "duration_s": time.about(),
        "order": {
            **loss.about(),
            "reference_every_s": how.reference_every_s,
            "shortest_s": round(plain_time.total, 1),
            "longer": round(time.total / plain_time.total - 1.0, 4),
            "correlation_shortest": round(plain_loss.correlation, 4),
        },
    }
    made = Plan(plan.pose_names, plan.q, plan.steps, about)
    return Ordered(made, time, plain_time, loss, plain_loss)


def _check(
    config: CellConfig, names: Sequence[str], chosen: Sequence[Chosen], how: Ordering
) -> None:
    """Refuse what cannot be."""
    if not chosen:
        raise InputError("no reading is chosen; a plan needs at least one")
    if how.slack < 0 or how.reference_every_s <= 0 or how.repeats < 0:
        raise InputError(
            f"slack {how.slack:g}, a reference every {how.reference_every_s:g} s, {how.repeats} "
            "repeats; valid: 0 or more, over 0, 0 or more"
        )
    known = {UNLOADED, *(load.name for load in config.loads)}
    for c in chosen:
        if c.pose not in names or c.pose == REFERENCE:
            raise InputError(f"there is no pose {c.pose!r} to measure")
        if not c.loads or not set(c.loads) <= known or len(set(c.loads)) < len(c.loads):
            raise InputError(f"pose {c.pose!r}: loads {c.loads}; valid: {', '.join(sorted(known))}")
        if c.count < 1:
            raise InputError(f"pose {c.pose!r}: count {c.count}; valid: 1 or more")
