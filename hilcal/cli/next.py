"""`next`: the measurements that separate the leading suspects."""

from pathlib import Path
from typing import Annotated

from hilcal import numbers as words_of
from hilcal.campaign.campaign import Campaign
from hilcal.cli.files import check_record, effect_names, fit_of
from hilcal.cli.options import (
    Csv,
    Details,
    Drift,
    EffectsFrom,
    Json,
    Output,
    Prior,
    PriorOf,
    Quick,
    Record,
    Revision,
    Run,
    Seed,
    catalogue_with,
    option,
)
from hilcal.cli.plan_output import generator, write
from hilcal.cli.planning import read_cell
from hilcal.cli.prior import PriorOptions, fitted_with
from hilcal.cli.terminal import Terminal, terminal
from hilcal.design.next import Next
from hilcal.diagnosis.doubt import MOST
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import InputError
from hilcal.identification.carried import CarriedPrior
from hilcal.names import quoted
from hilcal.present.plan import brief_plan, next_report, plan_report, poses_report
from hilcal.present.progress import Say, working
from hilcal.procedure.next_plan import doubt_to_settle, next_plan
from hilcal.procedure.separate import Doubt, without


def next_(
    run: Run,
    output: Output,
    poses: Annotated[
        int | None,
        option(
            "--poses",
            "As many readings as so many poses take under every load, 20 unless given; new "
            "poses, where a misfit depends on the pose alone.",
        ),
    ] = None,
    suspects: Annotated[
        str | None, option("--suspects A,B", "Separate these, whatever is diagnosed.")
    ] = None,
    cell: Annotated[
        Path | None, option("--cell CELL.toml", "The cell, where it has other loads now.")
    ] = None,
    seed: Seed = 0,
    quick: Quick = False,
    csv: Csv = None,
    revision: Revision = None,
    prior: Prior = None,
    prior_of: PriorOf = "arm",
    drift: Drift = None,
    record: Record = None,
    effects_from: EffectsFrom = None,
    details: Details = False,
    as_json: Json = False,
) -> None:
    """Plan the measurements that separate the leading suspects; exit 4 where none are in doubt."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    check_record(record)
    carried = PriorOptions(prior, prior_of, drift).load(catalogue)
    rng = generator(seed)
    if poses is not None and poses < 1:
        raise InputError(f"--poses {poses}; valid: a whole number from 1")
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        given = None if cell is None else read_cell(cell)
        doubt = _without_suspects(t, o, revision, _named(suspects, catalogue), say, carried)
        compare = (details or as_json) and not quick
        n = next_plan(o, doubt, poses, rng, say, cell=given, compare=compare)
        config, numbers = (o.config, o.cell) if given is None else given
    found, made, effects = n.found, n.made, doubt.suspects
    write(t, numbers, config, made, output, csv, record, found.powers)
    t.show(f"In doubt: {words_of.names(effects, 'or')}.\n")
    report = next_report if doubt.alone is None else poses_report
    t.show(report(found, made.summary.poses, made.summary.readings, details))
    t.show(plan_report(made.summary) if details else brief_plan(made.summary))
    t.show(f"The plan is in {output}. Measure it into the same campaign with:")
    t.show(
        f"  hilcal run {quoted(cell or 'CELL.toml')} -o {quoted(run)} --append "
        f"--plan {quoted(output)}"
    )
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
    t: Terminal,
    o: Campaign,
    revision: int | None,
    named: tuple[str, ...] | None,
    say: Say,
    prior: CarriedPrior | None,
) -> Doubt:
    """Return the effects to separate, and a fit whose model does not hold them.

    Raises:
        InputError: the revision is not in scaling gc; a prior that is not one of these readings.
        CannotAnswerError: nothing is in doubt; says what else to do.
    """
    number, newest = fit_of(t, o, say, revision)
    o.require_gc(number, newest.scaling, "next")
    if prior is not None:
        say("fitting with the prior")
        newest = fitted_with(prior, o, newest)
    if named is not None:
        return Doubt(without(newest, named, say), named, None)
    say("diagnosing" if number is None else f"diagnosing revision {number}")
    return doubt_to_settle(o, diagnose(newest, o.history(number), say), say)


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
