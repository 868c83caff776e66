"""The doubt in `demo --ambiguous`: what a small campaign leaves open, and what would settle it.

A hidden effect and a small campaign are drawn together until the readings leave a doubt: which
effects a few readings cannot separate depends on the poses, the loads and the effect's parameters.
"""

from dataclasses import dataclass, replace

import numpy as np

from drivers.simulated.injected_effects import HARD_TO_SEPARATE, RESEMBLING
from drivers.simulated.on_the_wire import case_of_plan, read_plan
from drivers.simulated.rehearsal import NOTHING, Rehearsal
from hilcal import numbers
from hilcal.cli.next import separates
from hilcal.cli.rehearsing import RehearsalSettings, first_plan
from hilcal.cli.terminal import Terminal
from hilcal.design.checked_plan import refuse
from hilcal.design.next import measure_next
from hilcal.design.planner import Request
from hilcal.diagnosis.diagnosis import Diagnosis, History
from hilcal.diagnosis.doubt import in_doubt as left_open
from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.evidence import Evidence
from hilcal.diagnosis.verdict import diagnose, judge
from hilcal.effects.catalogue import Catalogue
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from hilcal.measuring.dry_run import dry_run
from hilcal.present.diagnosis import step_report
from hilcal.present.document import heading
from hilcal.present.fit import model_name
from hilcal.present.plan import next_report
from hilcal.present.progress import Say, working
from hilcal.present.verdict import message
from hilcal.procedure.separate import plan_of
from hilcal.store.plan import REFERENCE, Plan
from hilcal.store.records import content_hash

STRENGTH = 4.0
"""Of what is hidden, in units of the noise: clearly there in so few readings."""
FIRST = 6
"""Poses of the first campaign."""
CANDIDATES = 60
"""Poses that it is chosen from. A choice: planning takes a second."""
ARMS = 4
"""Arms that are drawn for one plan. A choice."""
TRIES = 200
"""Arms that are drawn at most. Of 10 seeds it took 1 to 32 and once 105, and 2 to 34 s."""
DRAWS = 5
"""Draws of the noise for which a rival has to be as good. A choice."""
CAMPAIGNS = 3
"""First campaigns that are measured at most until one leaves a doubt. Without devices the first
always does; of other draws of the noise four in five do (38 of 48)."""
CLOSE = 2.0
"""Most difference in log evidence between the hidden effect and its rival in each of these draws.
A choice: it scatters by about 1.3, and `SAME_EVIDENCE` is 3."""
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


def doubtful_case(
    told: RehearsalSettings, hide: str | None, say: Say, number: int = 0
) -> tuple[RehearsalSettings, Plan, bool]:
    """Draw an effect to hide and a small campaign that leaves it in doubt.

    Both come from the seed. A case counts when for each of `DRAWS` draws of the noise a rival
    explains the readings about as well as the hidden effect, and when the diagnosis of the first
    draw names both, and says that more readings would separate them.

    Args:
        told: what the rehearsal is of.
        hide: the effect to hide; one of those that are hard to separate where None.
        say: takes progress, one line each.
        number: of the case; another number is another case.

    Returns:
        The settings with the effect and the seed of this case, the plan of its first campaign, and
        whether that leaves a doubt; it is the last case where none of `TRIES` does.
    """
    loads = told.config.loads[1::2] or told.config.loads
    quick = {"candidates": min(told.config.planning.candidates, CANDIDATES), "against": ()}
    planning = told.config.planning.model_copy(update=quick)
    few = told.config.model_copy(update={"loads": loads, "planning": planning})
    simulation = told.config.simulation.model_copy(update={"strength_sigma": STRENGTH})
    strong = told.config.model_copy(update={"simulation": simulation})
    say("drawing an arm and a small campaign that leaves its effect in doubt")
    for k in range(TRIES):
        rng = np.random.default_rng([told.seed, number, k])
        choice = hide or str(rng.choice(HARD_TO_SEPARATE))
        case = replace(told, config=strong, choice=choice, seed=int(rng.integers(2**31)))
        if k % ARMS == 0:
            plan = first_plan(case, few, FIRST, lambda words: None)
        secret = case_of_plan(strong, plan, choice, case.seed, case.world)
        drawn = [read_plan(secret, plan, [case.seed, 1 + j]) for j in range(DRAWS)]
        if choice == NOTHING or (
            all(_resembled(r, case) for r in drawn) and _left_open(drawn[0], case)
        ):
            return case, plan, choice != NOTHING
    return case, plan, False


def _fit(r: Rehearsal, case: RehearsalSettings) -> Fit:
    return fit(baseline(r.cell, r.readings, r.mode, case.catalogue), r.readings, r.mode)


def _resembled(r: Rehearsal, case: RehearsalSettings) -> bool:
    """Whether the hidden effect is clearly there, and a rival explains the readings as well."""
    p = linearise(_fit(r, case))
    effects = [e for e in candidates(p.fit) if e.name in (r.hidden, *RESEMBLING)]
    found = {s.effect: s for s in rank_suspects(p, effects)}
    own = found.pop(r.hidden, None)
    if own is None or not (own.passes or any(s.passes for s in found.values())):
        return False
    near = (abs(s.score.log_evidence - own.score.log_evidence) < CLOSE for s in found.values())
    return any(near)


def _left_open(r: Rehearsal, case: RehearsalSettings) -> bool:
    """Whether the diagnosis leaves the hidden effect and others that could be separated from it."""
    d = judge(Evidence(_fit(r, case)), History())
    return r.hidden in left_open(d) and all(rival.possible for rival in d.separability)


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
        return Doubted(found, d, *known, None, document)
    t.show(step_report(1, model_name(found.model.named), d))
    t.show(heading(f"Ambiguous between {numbers.names(suspects)}: what would settle it?"))
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
