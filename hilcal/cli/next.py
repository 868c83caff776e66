"""`next`: the measurements that separate the leading suspects."""

from pathlib import Path
from typing import Annotated

import typer

from hilcal.campaign import Campaign
from hilcal.cli.effects_from import EffectsFrom, catalogue_with
from hilcal.cli.files import check_record, effect_names, fit_of
from hilcal.cli.plan_output import POSES, Csv, Output, Quick, Seed, generator, write
from hilcal.cli.planning import read_cell
from hilcal.cli.terminal import Json, Record, Revision, Run, Terminal, terminal
from hilcal.data.plan import REFERENCE, read_plan
from hilcal.data.run_log import PLAN
from hilcal.diagnose.diagnosis import Diagnosis
from hilcal.diagnose.doubt import MOST, in_doubt
from hilcal.diagnose.effect_ranking import Suspect
from hilcal.diagnose.verdict import diagnose
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import CannotAnswerError, InputError
from hilcal.plan.checked_plan import checked
from hilcal.plan.next import Next
from hilcal.plan.summary import summarise
from hilcal.procedure.separate import Doubt, plan_of, separating, without
from hilcal.report import numbers as words_of
from hilcal.report.progress import Say, working
from hilcal.report.text_next import next_report, poses_report
from hilcal.report.text_plan import plan_report
from hilcal.types import Floats


def next_(
    run: Run,
    output: Output,
    poses: Annotated[
        int | None,
        typer.Option(
            "--poses",
            help="As many readings as so many poses take under every load, 20 unless given; new "
            "poses, where a misfit depends on the pose alone.",
        ),
    ] = None,
    suspects: Annotated[
        str | None,
        typer.Option("--suspects", metavar="A,B", help="Separate these, whatever is diagnosed."),
    ] = None,
    cell: Annotated[
        Path | None,
        typer.Option("--cell", metavar="CELL.toml", help="The cell, where it has other loads now."),
    ] = None,
    seed: Seed = 0,
    quick: Quick = False,
    csv: Csv = None,
    revision: Revision = None,
    record: Record = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Plan the measurements that separate the leading suspects; exit 4 where none are in doubt."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    check_record(record)
    rng = generator(seed)
    if poses is not None and poses < 1:
        raise InputError(f"--poses {poses}; valid: a whole number from 1")
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        config, numbers = (o.config, o.cell) if cell is None else read_cell(cell)
        doubt = _without_suspects(t, o, revision, _named(suspects, catalogue), say)
        effects, place = doubt.suspects, reference_of(o)
        found = separating(numbers, config, doubt, poses, rng, say, place, POSES)
        summary = summarise(found.planned, config, rng, say, compare=not quick and not doubt.alone)
        say("checking every motion in a dry run")
        made = checked(numbers, config, plan_of(found, effects), summary)
    write(t, numbers, config, made, output, csv, record, found.powers)
    t.show(f"In doubt: {words_of.names(effects, 'or')}.\n")
    report = next_report if doubt.alone is None else poses_report
    t.show(report(found, made.summary.poses, made.summary.readings))
    t.show(plan_report(made.summary))
    t.show(f"The plan is in {output}. Measure it into the same campaign with:")
    t.show(f"  hilcal run {cell or 'CELL.toml'} -o {run} --append --plan {output}")
    t.document(
        {
            **made.to_dict(),
            "plan": str(output),
            "suspects": list(effects),
            **separates(found),
        }
    )


def separates(found: Next) -> dict[str, object]:
    """Return what a JSON document says of pairs; powers are those with the planned readings."""
    return {
        "separates": [[t.effect, t.rival, t.then] for t in found.powers],
        "separates_now": [[t.effect, t.rival, t.now] for t in found.powers],
        "inseparable": [[t.effect, t.rival] for t in found.powers if t.not_separable],
        "difference": found.shares,
        "notes": list(found.notes),
    }


def _without_suspects(
    t: Terminal, o: Campaign, revision: int | None, named: tuple[str, ...] | None, say: Say
) -> Doubt:
    """Return the effects to separate, and a fit whose model does not hold them.

    Raises:
        InputError: the revision is not in scaling gc.
        CannotAnswerError: nothing is in doubt; says what else to do.
    """
    number, newest = fit_of(t, o, say, revision)
    if newest.scaling != "gc":
        raise InputError(
            f"revision {number} has scaling {newest.scaling}; next needs gc: run hilcal identify "
            "again"
        )
    suspects, alone = named, None
    if suspects is None:
        say("diagnosing" if number is None else f"diagnosing revision {number}")
        d = diagnose(newest, o.history(number), say)
        suspects = in_doubt(d)
        if not suspects:
            raise CannotAnswerError(_settled(o, d))
        finer = [s for s in d.suspects if s.coarse and s.effect in suspects]
        if finer:
            raise CannotAnswerError(f"not two effects, but one in doubt: {differ(o, finer[0])}")
        a = d.pose_alone
        alone = a if a is not None and a.chance is not None and newest.mode == "absolute" else None
    return Doubt(without(newest, suspects, say), suspects, alone)


def _settled(o: Campaign, d: Diagnosis) -> str:
    """Say that no suspects are to be separated, and what else to do."""
    head = "no suspects to separate:"
    if d.verdict == "adequate":
        return (
            f"{head} the model is adequate; to sharpen it, plan on with: hilcal plan CELL.toml "
            f"--after {o.path}, or separate named effects with --suspects A,B"
        )
    if d.verdict == "noise_misjudged":
        return (
            f"{head} the noise is misjudged, see hilcal diagnose {o.path}; repeat some readings, "
            "or state the covariance anew"
        )
    if d.verdict == "missing_effect":
        lead = d.suspects[0]
        if lead.coarse:
            return f"{head} {differ(o, lead)}"
        return (
            f"{head} {lead.effect} alone is missing; add it with: hilcal add {o.path} {lead.effect}"
        )
    why = "no effect of the catalogue explains the misfit"
    if d.reason == "insufficient_catalogue":
        why = (
            f"all effects of the catalogue together do not explain the misfit, and "
            f"{d.suspects[0].effect} may only resemble the missing effect"
        )
    return (
        f"{head} {why}; see hilcal diagnose {o.path}, or give an effect of your own by "
        "--effects-from"
    )


def differ(o: Campaign, s: Suspect) -> str:
    """Say how to let joints differ, where the readings ask for it."""
    return (
        f"the model has one {s.coarse} for several joints; let them differ, and diagnose again: "
        f'hilcal add {o.path} "{s.effect}"'
    )


def reference_of(o: Campaign) -> Floats | None:
    """Return the joints (n,) of the campaign's reference pose; None where it has none."""
    text = o.file.about(PLAN)
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
