"""Several plans in one campaign: a further one is measured after what is there."""

from dataclasses import replace

import numpy as np

from hilcal.errors import InputError
from hilcal.readings.readings import SAME_POSE
from hilcal.store.plan import REFERENCE, Plan, Step


def with_new_names(plan: Plan, before: Plan, number: int) -> Plan:
    """Return a further plan with names and cycles that a campaign does not have yet.

    The reference pose becomes that of the campaign, so that the drift is measured over all of it. A
    pose of a known name at other joints gets another name; one at the same joints is the same
    pose, and its readings get new cycles, with unloaded readings of their own.

    Args:
        before: all that was planned before.
        number: of the plan in the campaign, 2 or more.

    Raises:
        InputError: another number of joints, or only one of the two has a reference pose.
    """
    if plan.q.shape[1] != before.q.shape[1]:
        raise InputError(
            f"the plan has {plan.q.shape[1]} joint angles per pose; the campaign has "
            f"{before.q.shape[1]}"
        )
    if (REFERENCE in plan.pose_names) != (REFERENCE in before.pose_names):
        has = "the plan" if REFERENCE in plan.pose_names else "the campaign"
        raise InputError(f'only {has} has a pose "{REFERENCE}"; valid: both or none')
    known = dict(zip(before.pose_names, before.q, strict=True))
    taken = {*known, *plan.pose_names}
    names, q = [], []
    for name, joints in zip(plan.pose_names, plan.q, strict=True):
        if name == REFERENCE:
            joints = known[name]
        elif name in known and np.abs(joints - known[name]).max() > SAME_POSE:
            name = _free(f"{name}-{number}", taken)
            taken.add(name)
        elif name in known:
            joints = known[name]
        names.append(name)
        q.append(joints)
    new = dict(zip(plan.pose_names, names, strict=True))
    last: dict[str, int] = {}
    for step in before.steps:
        last[step.pose] = max(last.get(step.pose, -1), step.cycle)
    steps = tuple(
        Step(new[s.pose], s.load, s.cycle + last.get(new[s.pose], -1) + 1) for s in plan.steps
    )
    return replace(plan, pose_names=tuple(names), q=np.array(q), steps=steps)


def joined(before: Plan, done: frozenset[Step], further: Plan) -> Plan:
    """Return all in one: what was measured before a further plan came, and that plan.

    What was planned before and not measured is given up.
    """
    kept = tuple(s for s in before.steps if s in done)
    used = {s.pose for s in kept} | {REFERENCE}
    more = [
        k
        for k, name in enumerate(before.pose_names)
        if name in used and name not in further.pose_names
    ]
    return Plan(
        (*further.pose_names, *(before.pose_names[k] for k in more)),
        np.vstack([further.q, before.q[more]]),
        (*kept, *further.steps),
        further.about,
    )


def _free(name: str, taken: set[str]) -> str:
    """Return a name that is not taken."""
    out, k = name, 2
    while out in taken:
        out, k = f"{name}-{k}", k + 1
    return out
