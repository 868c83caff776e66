"""`workbench`: the page on which an operator works at a campaign."""

import os
import sys
import threading
from pathlib import Path
from typing import Annotated

from hilcal.cli.options import EffectsFrom, Json, argument, catalogue_with, option
from hilcal.cli.terminal import Terminal, terminal
from hilcal.errors import InputError
from hilcal.import_campaign import import_campaign
from hilcal.names import quoted
from hilcal.present.progress import working
from hilcal.present.registration import covariance_words
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.schema import is_campaign
from hilcal.workbench.guard import UNUSED_S
from hilcal.workbench.server import require_nicegui, serve
from hilcal.workbench.session import Session

ENDING = 8.0
"""How long the page's threads may delay the end, s."""


def workbench(
    run: Annotated[Path, argument("RUN.hilcal|TABLE", "The campaign file, or a table.")],
    config: Annotated[
        Path | None, option("--config CELL.toml", "Begin with a table, measured in this cell.")
    ] = None,
    kind: Annotated[
        str, option("--format FORMAT", "Of the table, as hilcal import takes it.")
    ] = "table",
    second: Annotated[Path | None, option("--second TABLE", "The second file of a table.")] = None,
    output: Annotated[
        Path | None, option("-o --output RUN.hilcal", "Of a table; TABLE.hilcal beside it else.")
    ] = None,
    port: Annotated[
        int | None, option("--port", "Port on this machine; 8787, or a free one, unless given.")
    ] = None,
    no_browser: Annotated[
        bool, option("--no-browser", "Do not open the page, only print its address.")
    ] = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Compare, add, remove, change the cell, measure next on one page of this machine alone."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    require_nicegui()
    if config is not None:
        table, run = run, run.with_suffix(".hilcal") if output is None else output
        _import(t, table, config, run, kind, second)
    elif kind != "table" or second is not None or output is not None:
        raise InputError("--format, --second and -o are of a table; give --config CELL.toml, too")
    elif run.is_file() and not is_campaign(run):
        raise InputError(f"{run}: no campaign; to begin with a table, give --config CELL.toml, too")
    with CampaignFile.open(run, read_only=True) as file:
        file.readings()  # a file without any is refused before a page is opened

    def told(url: str) -> None:
        t.show("Open the workbench with:")
        t.command(url)
        t.document({"url": url, "run": str(run)})
        sys.stdout.flush()
        t.notice(f"It lets one browser in, within {UNUSED_S / 60:g} minutes. Serving until Ctrl-C.")

    if not serve(Session(run, catalogue), port, told, browser=not no_browser):
        t.notice("Nobody opened it: its address is no longer valid. Start it again.")
    # A fit that is being made in a thread would hold the process up; what is stored is durable.
    guard = threading.Timer(ENDING, os._exit, (0,))
    guard.daemon = True
    guard.start()


def _import(
    t: Terminal, table: Path, config: Path, run: Path, kind: str, second: Path | None
) -> None:
    """Make the campaign file of a table; one that is there stays.

    Raises:
        InputError: there is one, or anything in table or cell cannot be right.
    """
    if run.exists():
        raise InputError(
            f"{run}: the file exists, and is left as it is; open it with hilcal workbench "
            f"{quoted(run)}, or name another one for the table with -o"
        )
    with working(t.progress) as say:
        found = import_campaign(table, config, run, kind, second, say=say)
    t.notice(
        f"{len(found.readings)} readings of {table} are in {run} now; the table is not changed."
    )
    for note in (*found.notes, covariance_words(found.parts, found.noise)):
        t.notice(note)
