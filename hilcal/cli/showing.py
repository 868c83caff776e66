"""`report`, `view` and `workbench`: a campaign as a page, in rerun, or to work on."""

import os
import shlex
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from hilcal.campaign.campaign import Campaign
from hilcal.cli.fitting import check_record, record_story
from hilcal.cli.options import command
from hilcal.cli.terminal import Terminal, end_signals
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import InputError
from hilcal.names import quoted
from hilcal.present.live_viewer import PORT, LiveViewer
from hilcal.present.progress import working
from hilcal.present.registration import covariance_words
from hilcal.present.story import build_story
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.schema import is_campaign
from hilcal.tables.units import parse_length


@command("""
    later | LATER.hilcal | A later campaign of the same arm: the page compares the two.
    output | -o --output F.html | The page to write; default RUN.html.
    limit | --limit LENGTH | Largest 3-D position error allowed, e.g. "0.1 mm": the page states
        PASSED or FAILED.
    validation | --validation OTHER.hilcal | A campaign that was never fitted: the page states how
        well it is predicted.
    register | --register | Fit the place of the tracker to the validation campaign first, if it has
        been moved.
    operator | --operator NAME | The person responsible for the measurement.
    appendix | --appendix | Add an appendix for experts: rejected suspects, residuals by joint,
        correlations, scalings, commands, hashes of revisions.
    """)
def report(
    t: Terminal, catalogue: Catalogue, run: Path, later: Path | None = None,
    output: Path | None = None, limit: str | None = None, validation: Path | None = None,
    register: bool = False, operator: str = "", revision: int | None = None,
    appendix: bool = False,
) -> None:  # fmt: skip
    """Write a report as one HTML page, beginning with a certificate; printed, six pages."""
    from hilcal.write_report import ReportOptions, write_report

    limit_m = None if limit is None else parse_length(limit, "--limit")
    output = run.with_suffix(".html") if output is None else output
    with ExitStack() as stack, working(t.progress) as say:

        def opened(path: Path | None) -> Campaign | None:
            if path is None:
                return None
            return stack.enter_context(Campaign.open(path, catalogue, read_only=True))

        first = stack.enter_context(Campaign.open(run, catalogue, read_only=True))
        options = ReportOptions(
            opened(later), opened(validation), limit_m, operator, revision, appendix, register
        )
        result = write_report(first, output, options, say)
    t.show(f"{result.headline}.")
    if result.limit:
        t.show(result.limit)
    t.show(f"Report: {output} ({output.stat().st_size / 1e6:.1f} MB); print it for a PDF.")
    t.document(
        report=str(output),
        bytes=output.stat().st_size,
        headline=result.headline,
        passed=result.passed,
        verdict=result.verdict,
    )


END_DELAY_S = 5.0  # Longest delay of the end of the process by a server of a page or viewer, s


@command("""
    port | --port | Port at which viewers connect.
    """)
def view(
    t: Terminal, catalogue: Catalogue, run: Path, revision: int | None = None,
    record: Path | None = None, port: int = PORT,
) -> None:  # fmt: skip
    """Show the readings and revisions of a campaign in the rerun viewer."""
    check_record(record)
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        chapters = o.chapters(say, revision)
    if record is not None:
        record_story(t, chapters, record)
        t.document({"recording": str(record), "revisions": [c.number for c in chapters]})
        return
    with working(t.progress) as say:
        say("preparing the viewer")
        from hilcal.present.viewer import serve  # loads the viewer's library, which takes a while

        story = build_story(chapters)
    guard = _end_of_process()  # an unresponsive viewer may delay the end; the campaign is closed
    try:
        with end_signals(signal.SIGINT, signal.SIGTERM) as wait, serve(story, port=port) as url:
            t.show("To open the viewer:")
            t.command(f"{viewer_command()} {url}")
            t.document({"url": url, "revisions": [c.number for c in chapters]})
            sys.stdout.flush()
            t.notice("Serving until Ctrl-C.")
            wait()
            guard.start()
    finally:
        guard.cancel()


def _end_of_process() -> threading.Timer:
    """Return a timer that ends the process, if its threads do not end by themselves."""
    guard = threading.Timer(END_DELAY_S, os._exit, (0,))
    guard.daemon = True
    return guard


@contextmanager
def live_viewer(t: Terminal, requested: bool, run: Path) -> Iterator[LiveViewer | None]:
    """Start a live viewer for the block if requested; it records to the campaign's folder."""
    if not requested:
        yield None
        return
    live = LiveViewer(run.with_name(f"{run.stem}.live.rrd"), t.notice)
    try:
        with working(t.progress) as say:
            say("starting the live viewer")
            live.start()
        if live.url is not None:
            t.show("To watch on this machine, now or later:")
            t.command(f"{viewer_command()} {live.url}")
        yield live
    finally:
        live.close()
        if live.record.exists():
            t.notice(f"recorded {live.record}; open it with: {open_command(live.record)}")


def open_command(recording: Path) -> str:
    """Return the command that opens a recording."""
    return shlex.join([viewer_command(), str(recording)])


def viewer_command() -> str:
    """Return the command that starts the viewer."""
    installed = Path(sys.executable).with_name("rerun")
    if shutil.which("rerun") is None and installed.is_file():
        return str(installed)
    return "rerun"


@command("""
    run | RUN.hilcal|TABLE | The campaign file, or a table of readings.
    config | --config CELL.toml | Import a table that was measured in this cell.
    kind | --format FORMAT | Format of the table, see hilcal import.
    second | --second TABLE | A second file of the same readings, see hilcal import.
    output | -o --output RUN.hilcal | Campaign file for a table; default TABLE.hilcal.
    port | --port | Port on this machine; default 8787, or a free one.
    no_browser | --no-browser | Do not open the page, only print its address.
    """)
def workbench(
    t: Terminal, catalogue: Catalogue, run: Path, config: Path | None = None, kind: str = "table",
    second: Path | None = None, output: Path | None = None, port: int | None = None,
    no_browser: bool = False,
) -> None:  # fmt: skip
    """Compare, add, remove, change the cell, measure next: a browser page of this machine alone."""
    from hilcal.workbench.guard import UNUSED_S
    from hilcal.workbench.server import require_nicegui, serve
    from hilcal.workbench.session import WorkbenchSession

    require_nicegui()
    if config is not None:
        table, run = run, run.with_suffix(".hilcal") if output is None else output
        if run.exists():
            raise InputError(
                f"{run}: the file exists and is not changed; open it with hilcal workbench "
                f"{quoted(run)}, or choose another name for the table with -o"
            )
        from hilcal.library import import_campaign

        with working(t.progress) as say:
            imported = import_campaign(table, config, run, kind, second, say=say)
        t.notice(f"{len(imported.readings)} readings of {table} were written to {run}.")
        for note in (*imported.notes, covariance_words(imported.parts, imported.noise)):
            t.notice(note)
    elif kind != "table" or second is not None or output is not None:
        raise InputError("--format, --second and -o are for a table; give --config CELL.toml, too")
    elif run.is_file() and not is_campaign(run):
        raise InputError(f"{run}: no campaign; to begin with a table, give --config CELL.toml, too")
    with CampaignFile.open(run, read_only=True) as file:
        file.readings()  # refuses a file without readings before a page is opened

    def announce(url: str) -> None:
        t.show("Open the workbench with:")
        t.command(url)
        t.document({"url": url, "run": str(run)})
        sys.stdout.flush()
        t.notice(
            f"One browser can open it, within {UNUSED_S / 60:g} minutes. Serving until Ctrl-C."
        )

    if not serve(WorkbenchSession(run, catalogue), port, announce, browser=not no_browser):
        t.notice("The page was not opened in time: its address is no longer valid. Start it again.")
    _end_of_process().start()  # a fit in a thread may delay the end; stored revisions are durable
