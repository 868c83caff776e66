"""`workbench`: the page on which an operator works at a campaign."""

import os
import sys
import threading
from typing import Annotated

import typer

from hilcal.cli.effects_from import EffectsFrom, catalogue_with
from hilcal.cli.terminal import Json, Run, terminal
from hilcal.data.campaign_file import CampaignFile
from hilcal.workbench.guard import UNUSED_S
from hilcal.workbench.server import require_nicegui, serve
from hilcal.workbench.session import Session

ENDING = 8.0
"""How long the page's threads may delay the end, s."""


def workbench(
    run: Run,
    port: Annotated[
        int | None,
        typer.Option("--port", help="Port on this machine; 8787, or a free one, unless given."),
    ] = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Do not open the page, only print its address.")
    ] = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Compare, add, remove, measure next on one page, which only this machine can open."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    require_nicegui()
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
