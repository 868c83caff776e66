"""The doubt in `demo --ambiguous`: what a small campaign leaves open, and what would settle it."""

from dataclasses import dataclass

import numpy as np

from drivers.simulated.injected_effects import HARD_TO_SEPARATE
from drivers.simulated.rehearsal import Rehearsal
from hilcal.acquire.dry_run import dry_run
from hilcal.cli.next import plan_of, separates
from hilcal.cli.terminal import Terminal
from hilcal.data.plan import REFERENCE, Plan
from hilcal.data.records import content_hash
from hilcal.diagnose.diagnosis import Diagnosis
from hilcal.diagnose.doubt import in_doubt as left_open
from hilcal.diagnose.verdict import diagnose
from hilcal.effects.catalogue import Catalogue
from hilcal.identify.baseline import baseline
from hilcal.identify.fit import Fit, fit
from hilcal.plan.checked_plan import refuse
from hilcal.plan.next import measure_next
from hilcal.plan.planner import Request
from hilcal.report import numbers, text, text_demo
from hilcal.report.progress import working
from hilcal.report.text_next import next_report
from hilcal.report.verdict_words import message

STRENGTH = 2.0
"""Of what is hidden, in units of the noise: weaker than usual."""
FIRST = 6
"""Poses of the first campaign."""
SHARE = 0.8
"""Of `--poses`, what the second campaign takes: both together last about as long as one else."""


@dataclass(frozen=True, slots=True, eq=False)
class Doubted:
    """A first diagnosis, and the plan that would settle it.

    Attributes:
        fit: to the first readings.
        diagnosis: of it.
        hashed: hash of these readings.
        readings: how many they are.
        plan: the measurements that separate the suspects; None where nothing is in doubt.
        document: for JSON.
    """

    fit: Fit
    diagnosis: Diagnosis
    hashed: str
    readings: int
    plan: Plan | None
    document: dict[str, object]


def in_doubt(seed: int) -> str:
    """Return an effect to hide."""
    return str(np.random.default_rng([seed, 2]).choice(HARD_TO_SEPARATE))


def doubted(
    t: Terminal, r: Rehearsal, seed: int, first: Plan, poses: int, catalogue: Catalogue
) -> Doubted:
    """Diagnose a first campaign, and plan what separates the suspects where that is in doubt.

    Args:
        t: where it is told.
        r: the first campaign.
        seed: of the candidates.
        first: its plan.
        poses: as asked for, see `SHARE`.
        catalogue: the effects that a model can have.
    """
    with working(t.progress) as say:
        say("fitting and diagnosing the first readings")
        found = fit(baseline(r.cell, r.readings, r.mode, catalogue), r.readings, r.mode)
        d = diagnose(found, say=say)
    document: dict[str, object] = {"verdict": d.verdict, "message": message(d), "suspects": []}
    known = (content_hash(r.readings), len(r.readings))
    suspects = left_open(d)
    if not suspects:
        t.show("So few readings as these leave no suspects to separate; another --seed may.\n")
        return Doubted(found, d, *known, None, document)
    t.show(text_demo.step_report(1, text.model_name(found.model.names), d))
    t.show(text.heading(f"Ambiguous between {numbers.names(suspects)}: what would settle it?"))
    with working(t.progress) as say:
        place = first.joints(REFERENCE) if REFERENCE in first.pose_names else None
        rng = np.random.default_rng(seed)
        asked = Request(max(round(SHARE * poses), 1))
        chosen = measure_next(r.cell, r.config, found, suspects, asked, rng, say, place)
        plan = plan_of(chosen, suspects)
        refuse(dry_run(r.cell, r.config, plan), "the plan")
    visited = len({s.pose for s in plan.steps} - {REFERENCE})
    t.show(next_report(chosen, visited, len(plan.steps)))
    document |= {"suspects": list(suspects), **separates(chosen)}
    return Doubted(found, d, *known, plan, document)
