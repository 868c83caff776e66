"""`view`, and the live viewer of the commands that measure and fit."""

import os
import shlex
import shutil
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from hilcal.campaign.campaign import Campaign
from hilcal.cli.ending import told_to_end
from hilcal.cli.files import check_record, record_story
from hilcal.cli.options import EffectsFrom, Json, Record, Revision, Run, catalogue_with, option
from hilcal.cli.terminal import Terminal, terminal
from hilcal.present.build_story import build_story
from hilcal.present.live_viewer import PORT, LiveViewer
from hilcal.present.progress import working

ENDING = 5.0


def view(
    run: Run,
    revision: Revision = None,
    record: Record = None,
    port: Annotated[int, option("--port", "Port to serve viewers on.")] = PORT,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Tell the story of the revisions in rerun."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
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
    # Ending the server can wait for a viewer that does not answer; the campaign is closed.
    guard = threading.Timer(ENDING, os._exit, (0,))
    guard.daemon = True
    try:
        with (
            told_to_end(signal.SIGINT, signal.SIGTERM) as wait,
            serve(story, port=port) as served,
        ):
            t.show("Open the viewer with:")
            t.command(f"{viewer_command()} {served.url}")
            t.document({"url": served.url, "revisions": [c.number for c in chapters]})
            sys.stdout.flush()
            t.notice("Serving until Ctrl-C.")
            wait()
            guard.start()
    finally:
        guard.cancel()


@contextmanager
def followed(t: Terminal, asked: bool, run: Path) -> Iterator[LiveViewer | None]:
    """Let a live viewer follow what the block does, where it is asked for.

    Args:
        t: where it is said how to open it, and what is wrong with it.
        asked: whether somebody wants it.
        run: the campaign; the recording goes beside it.
    """
    if not asked:
        yield None
        return
    live = LiveViewer(live_recording(run), t.notice)
    try:
        with working(t.progress) as say:
            say("starting the live viewer")
            live.start()
        if live.url is not None:
            t.show("Watch it on this machine, now or later, with:")
            t.command(f"{viewer_command()} {live.url}")
        yield live
    finally:
        live.close()
        if live.record.exists():
            t.notice(f"recorded {live.record}; open it with: {opening(live.record)}")


def live_recording(run: Path) -> Path:
    """Return where the recording of a live viewer goes: beside the campaign."""
    return run.with_name(f"{run.stem}.live.rrd")


def opening(recording: Path) -> str:
    """Return the command that opens a recording."""
    return shlex.join([viewer_command(), str(recording)])


def viewer_command() -> str:
    """Return how to start the viewer that came with the program."""
    beside = Path(sys.executable).with_name("rerun")
    if shutil.which("rerun") is None and beside.is_file():
        return str(beside)
    return "rerun"
