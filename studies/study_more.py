"""A further round in the study of the diagnosis: the plan of `next`, measured in the same world."""

from dataclasses import fields, replace
from typing import Any

import numpy as np

from hilcal.config import CellConfig
from hilcal.config.sections import CellLoad
from hilcal.design.next import plan_separating
from hilcal.design.planner import PlanRequest
from hilcal.diagnosis.diagnosis import Diagnosis, in_doubt
from hilcal.drivers.simulated.rehearsal import planned_states, simulate
from hilcal.errors import CannotAnswerError
from hilcal.readings.readings import Readings, States
from hilcal.types import Floats
from studies.study_cases import StudyCase, with_study_loads
from studies.temperatures import air, joints

POSES = 20
MOST = 3
"""Number of suspects to separate."""
CANDIDATES = 120
"""Candidate poses of a plan; few, as hundreds of plans are made."""
_PAUSE = 600.0  # s between the rounds


def measure_more(
    config: CellConfig,
    robot: str,
    case: StudyCase,
    diagnosis: Diagnosis,
    seed: int,
    poses: int = POSES,
) -> Readings | None:
    """Plan and measure readings that separate the leading suspects.

    Where no effect is significant, these are the suspects with most evidence.

    Args:
        config: the cell; robot and loads are replaced.
        robot: name of the arm.
        case: the campaign so far.
        diagnosis: of it, on the baseline.
        seed: of everything random.
        poses: number of poses; the plan has as many readings as they have under every load.

    Returns:
        All readings, those of the campaign first; None where nothing is in doubt, or where no
        measurement separates the suspects.
    """
    names = suspects(diagnosis)
    if len(names) < 2:
        return None
    rng = np.random.default_rng([seed, len(case.readings)])
    robot_config, pulls = with_study_loads(config, robot)
    loads = tuple(
        CellLoad(name=name, force_N=tuple(map(float, w[:3])), moment_Nm=tuple(map(float, w[3:])))
        for name, w in pulls
    )
    robot_config = robot_config.with_keys("planning", candidates=CANDIDATES)
    robot_config = robot_config.model_copy(update={"loads": list(loads)})
    # A limit on readings is faster than leaving out loads one by one.
    request = PlanRequest(poses, readings=poses * (1 + len(loads)))
    try:
        separating = plan_separating(
            case.cell.with_config(robot_config), diagnosis.fit, names, request, rng
        )
    except CannotAnswerError:
        return None
    before, plan = case.readings, separating.planned.ordered.plan
    start = float(np.asarray(before.states.time).max()) + _PAUSE
    visit = planned_states(case.cell.with_config(robot_config), plan, start)
    since = np.asarray(visit.states.time) - start
    states = replace(
        visit.states,
        air_temperature=air(since, rng),
        joint_temperature=joints(since, case.cell.arm.n, rng),
    )
    hung = ("none", *(load.name for load in loads))
    number = visit.pose + len(before.pose_names)
    after = simulate(case.world, states, number, visit.load, visit.cycle, hung, rng)
    return joined(before, after, tuple(f"next {name}" for name in plan.pose_names))


def suspects(d: Diagnosis) -> tuple[str, ...]:
    """Return the effects in doubt; those with most evidence where no suspect passes all tests."""
    best = tuple(s.effect for s in d.suspects)[:MOST]
    return in_doubt(d, MOST) or d.significant[:1] or best


def joined(a: Readings, b: Readings, poses: tuple[str, ...]) -> Readings:
    """Return the readings of both; quantities that only one of them has are left out."""

    def both(name: str) -> Floats | None:
        parts = [getattr(r.states, name) for r in (a, b)]
        return None if any(part is None for part in parts) else np.concatenate(parts)

    optional: dict[str, Any] = {
        f.name: both(f.name) for f in fields(States) if f.name not in ("q", "wrench")
    }
    return Readings(
        states=States(
            q=np.concatenate([a.states.q, b.states.q]),
            wrench=np.concatenate([a.states.wrench, b.states.wrench]),
            **optional,
        ),
        pose=np.concatenate([a.pose, b.pose]),
        load=np.concatenate([a.load, b.load]),
        cycle=np.concatenate([a.cycle, b.cycle]),
        value=np.concatenate([a.value, b.value]),
        covariance=np.concatenate([a.covariance, b.covariance]),
        load_names=a.load_names,
        pose_names=(*a.pose_names, *poses),
    )
