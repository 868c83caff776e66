"""`next`: the measurements that separate the leading suspects."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from hilcal.cli.effects_from import EffectsFrom, catalogue_with
from hilcal.cli.files import Opened, check_record, effect_names, open_run
from hilcal.cli.plan_output import (
    POSES,
    Csv,
    Output,
    Poses,
    Quick,
    Seed,
    checked,
    generator,
    write,
)
from hilcal.cli.planning import plan_json, read_cell
from hilcal.cli.terminal import Json, Record, Run, Terminal, terminal
from hilcal.data.plan import REFERENCE, Plan, read_plan
from hilcal.data.run_log import PLAN
from hilcal.diagnose.rivals import Rivals
from hilcal.diagnose.stepwise import remove
from hilcal.diagnose.verdict import diagnose
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identify.fit import Fit
from hilcal.plan.next import Next, measure_next
from hilcal.plan.planner import Request
from hilcal.plan.summary import about, summarise
from hilcal.report import numbers as words_of
from hilcal.report.progress import Say, working
from hilcal.report.text_next import next_report
from hilcal.report.text_plan import plan_report
from hilcal.revisions import chain
from hilcal.types import Floats

MOST = 4


@dataclass(frozen=True, slots=True, eq=False)
class Doubt:
    """Suspects that these readings do not tell apart, and a fit of the model without them."""

    fit: Fit
    suspects: tuple[str, ...]


def next_(
    run: Run,
    output: Output,
    poses: Poses = POSES,
    suspects: Annotated[
        str | None,
        typer.Option("--suspects", metavar="A,B", help="Tell these apart, whatever is diagnosed."),
    ] = None,
    cell: Annotated[
        Path | None,
        typer.Option("--cell", metavar="CELL.toml", help="The cell, where it has other loads now."),
    ] = None,
    seed: Seed = 0,
    quick: Quick = False,
    csv: Csv = None,
    record: Record = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Plan the measurements that separate the leading suspects; exit 4 where there is no doubt."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    check_record(record)
    rng = generator(seed)
    if poses < 1:
        raise InputError(f"--poses {poses}; valid: a whole number from 1")
    with open_run(run, catalogue) as o, working(t.progress) as say:
        config, numbers = (o.config, o.cell) if cell is None else read_cell(cell)
        doubt = doubt_of(t, o, _named(suspects, catalogue), say)
        place = reference_of(o)
        found = measure_next(
            numbers, config, doubt.fit, doubt.suspects, Request(poses), rng, say, place
        )
        summary = summarise(found.planned, config, rng, say, compare=not quick)
        say("checking every motion in a dry run")
        made = checked(numbers, config, plan_of(found, doubt.suspects), summary)
    write(t, numbers, config, made, output, csv, record)
    t.show(f"In doubt: {words_of.names(doubt.suspects, 'or')}.\n")
    t.show(next_report(found, made.summary.poses, made.summary.readings))
    t.show(plan_report(made.summary))
    t.show(f"The plan is in {output}. Measure it into the same campaign with:")
    t.show(f"  hilcal run {cell or 'CELL.toml'} -o {run} --append --plan {output}")
    t.document(
        {
            **plan_json(made),
            "plan": str(output),
            "suspects": list(doubt.suspects),
            **separates(found),
        }
    )


def separates(found: Next) -> dict[str, object]:
    """Return what a JSON document says of pairs; powers are those with the planned readings."""
    return {
        "separates": [[t.effect, t.rival, t.then] for t in found.told],
        "separates_now": [[t.effect, t.rival, t.now] for t in found.told],
        "inseparable": [[t.effect, t.rival] for t in found.told if t.not_separable],
        "difference": found.shares,
        "notes": list(found.notes),
    }


def plan_of(found: Next, suspects: tuple[str, ...]) -> Plan:
    """Return the plan with what its file says of it."""
    told = [[t.effect, t.rival, round(t.then, 4)] for t in found.told]
    more = {**about(found.planned), "suspects": list(suspects), "separates": told}
    return replace(found.planned.ordered.plan, about=more)


def doubt_of(t: Terminal, o: Opened, named: tuple[str, ...] | None, say: Say) -> Doubt:
    """Return what is to be told apart: as named, or the leading suspect and its rivals.

    Where the newest revision has none, but an effect that was added on the way could as well
    have been another, it is these.

    Raises:
        InputError: named suspects that are in the model.
        CannotAnswerError: nothing is in doubt; says what else to do.
    """
    number, newest = o.latest_fit(t, say)
    if newest.scaling != "gc":
        raise InputError(
            f"revision {number} has scaling {newest.scaling}; next needs gc: run hilcal identify "
            "again"
        )
    if named is not None:
        for name in named:
            if name in newest.model.names:
                say(f"fitting without {name}")
                newest = remove(newest, name)
        return Doubt(newest, named)
    say(f"diagnosing revision {number}")
    d = diagnose(newest)
    leading = [s for s in d.suspects if s.effect in d.significant]
    if leading and leading[0].same_as:
        return Doubt(newest, (leading[0].effect, *leading[0].same_as)[:MOST])
    if leading:
        raise CannotAnswerError(
            f"nothing to tell apart: {leading[0].effect} is the only leading suspect; add it with: "
            f"hilcal add {o.path} {leading[0].effect}"
        )
    added = {r.added for r in chain(o.campaign.revisions())}
    if doubtful := [name for name in newest.model.names if name in added]:
        say(f"reconsidering {', '.join(doubtful)}")
        others = Rivals(newest)
        for name in doubtful:
            if same := others.of(name).same_as:
                say(f"fitting without {name}")
                return Doubt(remove(newest, name), (name, *same)[:MOST])
    raise CannotAnswerError(_settled(o, d.verdict))


def _settled(o: Opened, verdict: str) -> str:
    """Say that nothing is to be told apart, and what else to do."""
    if verdict == "adequate":
        return (
            "nothing to tell apart: the model is adequate; to sharpen it, plan on with: hilcal "
            f"plan CELL.toml --after {o.path}, or tell named effects apart with --suspects A,B"
        )
    if verdict == "noise_misjudged":
        return (
            f"nothing to tell apart: the noise is misjudged, see hilcal diagnose {o.path}; repeat "
            "some readings, or state the covariance anew"
        )
    return (
        "nothing to tell apart: no effect of the catalogue explains the misfit, so there is no "
        f"suspect; see hilcal compare {o.path}, or give an effect of your own by --effects-from"
    )


def reference_of(o: Opened) -> Floats | None:
    """Return the joints (n,) of the campaign's reference pose; None where it has none."""
    text = o.campaign.about(PLAN)
    if text is None:
        return None
    plan = read_plan(text, f"{o.path}, its plan")
    return plan.joints(REFERENCE) if REFERENCE in plan.pose_names else None


def _named(text: str | None, catalogue: Catalogue) -> tuple[str, ...] | None:
    """Split and check --suspects."""
    if text is None:
        return None
    try:
        names = effect_names(text, catalogue) or ()
    except InputError as error:
        raise InputError(str(error).replace("--effects", "--suspects")) from None
    if not 2 <= len(names) <= MOST:
        raise InputError(f"--suspects has {len(names)} names; valid: 2 to {MOST}")
    return names
