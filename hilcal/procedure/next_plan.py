"""What a diagnosis leaves open, the measurements that would settle it, and why there are none."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.checked_plan import CheckedPlan, checked
from hilcal.design.next import Next, PairPower, measure_next, measure_poses
from hilcal.design.planner import Request
from hilcal.design.summary import about, summarise
from hilcal.diagnosis.diagnosis import Diagnosis, in_doubt
from hilcal.diagnosis.effect_ranking import Suspect
from hilcal.diagnosis.pose_alone import PoseAlone, pose_powers
from hilcal.diagnosis.stepwise import remove
from hilcal.errors import CannotAnswerError
from hilcal.identification.fit import Fit
from hilcal.names import quoted
from hilcal.present.progress import Say
from hilcal.procedure.state import reference_in
from hilcal.store.plan import Plan
from hilcal.types import Floats

POSES = 20
"""Poses where the doubt does not say how many it needs; a choice."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """What is to be separated."""

    fit: Fit  # of a model without the suspects
    suspects: tuple[str, ...]  # the effects
    alone: PoseAlone | None = None
    """The misfit where more poses, unloaded, are what tells of it; None else."""


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

    As many readings as so many poses take, as many as the doubt needs, or `usual` where neither is
    known. `reference` (n,) are the joints of the campaign's reference pose, rad.

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


@dataclass(frozen=True, slots=True, eq=False)
class NextPlan:
    """The next measurements."""

    doubt: Doubt  # what they separate
    found: Next  # how well, pair by pair
    made: CheckedPlan  # the plan, which may be run


def next_plan(
    o: Campaign,
    doubt: Doubt,
    poses: int | None,
    rng: np.random.Generator,
    say: Say,
    *,
    cell: tuple[CellConfig, Cell] | None = None,
    compare: bool = False,
) -> NextPlan:
    """Plan the measurements that settle a doubt, and check every motion in a dry run.

    As many readings as so many poses take; what the doubt needs where None. `cell` is given where
    it is not the campaign's any more. To `compare` criteria and numbers of poses takes longer.

    Raises:
        InputError: suspects that cannot be, or a plan that may not be run.
        CannotAnswerError: no measurement separates any two of them, or no plan can be made.
    """
    config, numbers = (o.config, o.cell) if cell is None else cell
    found = separating(numbers, config, doubt, poses, rng, say, reference_in(o.file), POSES)
    compare = compare and not doubt.alone
    summary = summarise(found.planned, config, rng, say, compare=compare, curve=compare)
    say("checking every motion in a dry run")
    made = checked(numbers, config, plan_of(found, doubt.suspects), summary)
    return NextPlan(doubt, found, made)


def doubt_to_settle(o: Campaign, d: Diagnosis, say: Say) -> Doubt:
    """Return what a diagnosis leaves open, and a fit whose model does not hold the suspects.

    Raises:
        CannotAnswerError: nothing is in doubt; says what else to do.
    """
    found = doubt_of(d, say)
    if found is not None:
        return found
    finer = [s for s in d.suspects if s.coarse and s.effect in in_doubt(d)]
    if finer:
        raise CannotAnswerError(f"not two effects, but one in doubt: {_differ(o, finer[0])}")
    raise CannotAnswerError(_settled(o, d))


def _settled(o: Campaign, d: Diagnosis) -> str:
    """Say that no suspects are to be separated, and what else to do."""
    head = "no suspects to separate:"
    if d.verdict == "adequate":
        return (
            f"{head} the model is adequate; to sharpen it, plan on with: hilcal plan CELL.toml "
            f"-o PLAN.json --after {quoted(o.path)}, or separate named effects with --suspects A,B"
        )
    if d.wrong_figures:
        return (
            f"{head} a figure of the cell seems to be wrong, see hilcal diagnose {quoted(o.path)}"
        )
    if d.verdict == "noise_misjudged":
        return (
            f"{head} the noise is misjudged, see hilcal diagnose {quoted(o.path)}; repeat "
            "some readings, or state the covariance anew"
        )
    if d.reason == "background":
        return (
            f"{head} effects of the background are not told apart one by one; measure more poses, "
            f"spread over all joints, with: hilcal plan CELL.toml "
            f"-o PLAN.json --after {quoted(o.path)}"
        )
    if d.verdict == "missing_effect":
        lead = d.suspects[0]
        if lead.coarse:
            return f"{head} {_differ(o, lead)}"
        return (
            f"{head} {lead.effect} alone is missing; add it with: "
            f"hilcal add {quoted(o.path)} {quoted(lead.effect)}"
        )
    why = "no effect of the catalogue explains the misfit"
    if d.reason == "insufficient_catalogue":
        why = (
            f"all effects of the catalogue together do not explain the misfit, and "
            f"{d.suspects[0].effect} may only resemble the missing effect"
        )
    return (
        f"{head} {why}; see hilcal diagnose {quoted(o.path)}, or give an effect of your own by "
        "--effects-from"
    )


def _differ(o: Campaign, s: Suspect) -> str:
    """Say how to let joints differ, where the readings ask for it."""
    return (
        f"the model has one {s.coarse} for several joints; let them differ, and diagnose again: "
        f"hilcal add {quoted(o.path)} {quoted(s.effect)}"
    )
