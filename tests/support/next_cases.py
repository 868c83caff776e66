"""Small campaigns that leave a doubt, and the measurements that settle it."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from hilcal.cell import cell_from_config
from hilcal.config import load_config
from hilcal.design.next import plan_separating
from hilcal.design.planner import PlanRequest, plan_readings
from hilcal.diagnosis.diagnosis import Diagnosis, in_doubt
from hilcal.diagnosis.verdict import diagnose
from hilcal.drivers.simulated.rehearsal import (
    Rehearsal,
    SimulationCase,
    case_of_plan,
    simulate_plan,
)
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.readings.readings import Readings
from hilcal.store.plan import Plan, with_new_names
from tests.support.campaigns import campaign, measured, plan
from tests.support.cli_cases import CELL
from tests.support.plan_cases import changed

_CONFIG = load_config(CELL)
STRENGTH = 2.0
FEW, SEEN = {"candidates": 120, "against": ()}, {"strength_sigma": STRENGTH}
SMALL = changed(_CONFIG, planning=FEW, simulation=SEEN)


@dataclass(frozen=True)
class Doubtful:
    secret: SimulationCase
    plan: Plan
    rehearsal: Rehearsal
    fit: Fit
    diagnosis: Diagnosis

    @property
    def suspects(self):
        """The first one that passes all tests, and those that are inseparable from it."""
        return in_doubt(self.diagnosis) or self.diagnosis.significant[:1]


@cache
def first_plan():
    """As many readings as six poses take under two of the four loads."""
    some = SMALL.model_copy(update={"loads": SMALL.loads[1::2]})
    return plan_readings(
        cell_from_config(some), PlanRequest(readings=18), np.random.default_rng(1)
    ).ordered.plan


@cache
def doubtful(effect, seed):
    """A small campaign with a weak hidden effect."""
    secret = case_of_plan(SMALL, first_plan(), effect, seed)
    r = simulate_plan(secret, first_plan(), [seed, 1])
    fitted = fit(baseline(r.cell, r.readings, r.mode), r.readings, r.mode)
    return Doubtful(secret, first_plan(), r, fitted, diagnose(fitted))


def after_further_plan(first, poses=20):
    """Plan what separates the suspects, measure it in the same world, and diagnose all."""
    cell = first.rehearsal.cell
    reference = first.plan.joints("reference")
    separating_plan = plan_separating(
        cell.with_config(SMALL), first.fit, first.suspects, PlanRequest(poses),
        np.random.default_rng(1),
        reference=reference,
    )  # fmt: skip
    further = with_new_names(separating_plan.planned.ordered.plan, first.plan, 2)
    more = simulate_plan(first.secret, further, [9, 2], 3000.0).readings
    readings = joined_readings(first.rehearsal.readings, more)
    mode = first.rehearsal.mode
    return diagnose(fit(baseline(cell, readings, mode), readings, mode)), separating_plan


def joined_readings(a, b):
    names = tuple(dict.fromkeys((*a.pose_names, *b.pose_names)))
    place = [np.array([names.index(n) for n in r.pose_names])[r.pose] for r in (a, b)]
    parts = zip((a, b), place, strict=True)
    return Readings.joined([replace(r, pose=at, pose_names=names) for r, at in parts])


def many_waves(seed=0):
    """Thirty poses with a transmission error of harmonics 1 to 21 at 2 σ."""
    return campaign(
        "transmission_error", "absolute", seed, poses=30, plan_seed=seed, strength=2.0, harmonics=21
    )


def fine_error(seed=0):
    """The same without the first two harmonics: a cell and readings."""
    c = many_waves(seed)
    waves = c.world.physics.transmission_error.copy()
    size = np.sum(waves**2)
    waves[:, :2] = 0.0
    waves *= np.sqrt(size / np.sum(waves**2))
    world = replace(c.world, physics=replace(c.world.physics, transmission_error=waves))
    return c.cell, measured(world, plan(30, seed), np.random.default_rng(seed))
