"""The rerun web viewer as a part of the page, served behind the same guard as the rest.

rerun's own server lets in every program of this machine, and its page asks other hosts for fonts.
So a short-lived process of it, on the loopback address, is asked for the viewer's files once; they
and the recording are then served by the workbench, to the operator's browser alone.
"""

import re
import socket
import subprocess
import sys
import tempfile
import time
from http.client import HTTPConnection, HTTPException
from pathlib import Path

from hilcal.errors import HilcalError
from hilcal.present.story import Story
from hilcal.workbench.work import Say

FILES = {
    "index.html": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
}
RECORDING = "application/octet-stream"
_PATIENCE = 30.0
_ELSEWHERE = re.compile(r"<link\b[^>]*>", re.DOTALL)
_HEAD = "<head>"
# rerun asks for newer versions and sends usage statistics: both get an empty answer, and what is
# of this server is asked for with the operator's cookie. (The policy of the page forbids the rest.)
_HERE = (
    "<script>const asked = fetch; window.fetch = (to, how) => "
    "new URL(to.url || to, location).origin === location.origin "
    '? asked(to, {...how, credentials: "same-origin"}) '
    ": Promise.resolve(new Response(null, {status: 204}));</script>"
)
_SERVE = """
import os, signal, subprocess, sys, threading
def end():
    sys.stdin.read()
    os.killpg(0, signal.SIGKILL)
threading.Thread(target=end, daemon=True).start()
sys.exit(subprocess.call(sys.argv[1:], stdin=subprocess.DEVNULL))
"""
"""Runs a command until standard input ends, however the program that holds it has ended."""
_NOBODY = "rerun+http://127.0.0.1:9/proxy"
"""What the viewer would show: given something, rerun opens no port for recordings."""


class WebViewer:
    """The viewer's files and the recordings that it shows, in memory."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._files: dict[str, bytes] = {}
        self._recorded: dict[str, bytes] = {}

    def prepare(self, story: Story, count: int, say: Say) -> tuple[str, ...]:
        """Record a story, and return the names of the files by which the viewer shows it.

        The layout is a file of its own: a web viewer takes the one in a recording for a proposal.
        `count` makes the names differ from those before.

        Raises:
            HilcalError: the viewer cannot be had, or the story not be recorded.
        """
        # loads the viewer's library, which takes a while
        from hilcal.present.viewer.campaign import blueprint, save
        from hilcal.present.viewer.recording import APPLICATION

        say("recording")
        names = (f"story-{count}.rrd", f"layout-{count}.rbl")
        with tempfile.TemporaryDirectory() as folder:
            paths = [Path(folder) / name for name in names]
            save(story, paths[0])
            blueprint(story).save(APPLICATION, str(paths[1]))
            recorded = {path.name: path.read_bytes() for path in paths}
        if not self._files:
            say("preparing the viewer")
            self._files = _fetched()
        self._recorded = recorded
        return names

    def file(self, name: str) -> tuple[bytes, str] | None:
        """Return content and kind of a file; None where there is none of this name."""
        name = name or "index.html"
        if name in self._recorded:
            return self._recorded[name], RECORDING
        return (self._files[name], FILES[name]) if name in self._files else None


def _fetched() -> dict[str, bytes]:
    """Return the files of the web viewer that came with rerun-sdk."""
    from hilcal.present.viewer.recording import executable  # loads the viewer's library

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    serve = ("--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), _NOBODY)
    process = subprocess.Popen(  # noqa: S603 (our own arguments)
        [sys.executable, "-c", _SERVE, executable(), *serve],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        found = {name: _get(port, name, process) for name in FILES}
    finally:
        if process.stdin is not None:
            process.stdin.close()
        process.wait()
    page = _ELSEWHERE.sub("", found["index.html"].decode("utf-8"))
    page = page.replace(_HEAD, _HEAD + _HERE, 1)
    return {**found, "index.html": page.encode("utf-8")}


def _get(port: int, name: str, process: "subprocess.Popen[bytes]") -> bytes:
    end = time.monotonic() + _PATIENCE
    while True:
        line = HTTPConnection("127.0.0.1", port, timeout=_PATIENCE)
        try:
            line.request("GET", f"/{name}")
            answer = line.getresponse()
            content = answer.read()
            if answer.status == 200 and content:
                return content
            raise HilcalError(f"the 3-D viewer has no {name}: rerun-sdk is built without it")
        except (OSError, HTTPException) as error:
            if process.poll() is not None or time.monotonic() > end:
                raise HilcalError(f"the 3-D viewer does not start: {error}") from None
            time.sleep(0.1)
        finally:
            line.close()
