"""`report`: the story of a campaign, or the comparison of two, as one HTML page."""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

from hilcal.campaign.campaign import Campaign
from hilcal.cli.options import EffectsFrom, Json, Revision, Run, argument, catalogue_with, option
from hilcal.cli.terminal import terminal
from hilcal.present.progress import working
from hilcal.tables.units import parse_length


def report(
    run: Run,
    later: Annotated[
        Path | None,
        argument("[LATER.hilcal]", "A later campaign of the same arm: compare the two."),
    ] = None,
    output: Annotated[
        Path | None, option("-o --output F.html", "The page; RUN.html unless given.")
    ] = None,
    limit: Annotated[
        str | None,
        option(
            "--limit LENGTH",
            'The largest 3-D position error allowed, e.g. "0.1 mm": the page says passed or '
            "failed.",
        ),
    ] = None,
    validation: Annotated[
        Path | None,
        option(
            "--validation OTHER.hilcal",
            "A campaign that was never fitted: how well is it predicted?",
        ),
    ] = None,
    operator: Annotated[str, option("--operator NAME", "Who answers for the measurement.")] = "",
    revision: Revision = None,
    appendix: Annotated[
        bool,
        option(
            "--appendix",
            "Also what only another expert asks for: rejected suspects, each joint, "
            "correlations, scalings, commands, hashes of revisions.",
        ),
    ] = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Write the whole story as one HTML page, a certificate first; it prints on six pages."""
    from hilcal.write_report import Asked, write_report

    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    limit_m = None if limit is None else parse_length(limit, "--limit")
    output = run.with_suffix(".html") if output is None else output
    with ExitStack() as stack, working(t.progress) as say:

        def opened(path: Path | None) -> Campaign | None:
            if path is None:
                return None
            return stack.enter_context(Campaign.open(path, catalogue, read_only=True))

        first = stack.enter_context(Campaign.open(run, catalogue, read_only=True))
        asked = Asked(opened(later), opened(validation), limit_m, operator, revision, appendix)
        done = write_report(first, output, asked, say)
    t.show(f"{done.headline}.")
    if done.limit:
        t.show(done.limit)
    t.show(f"Report: {output} ({output.stat().st_size / 1e6:.1f} MB); print it for a PDF.")
    t.document(
        {
            "report": str(output),
            "bytes": output.stat().st_size,
            "headline": done.headline,
            "passed": done.passed,
            "verdict": done.verdict,
        }
    )
