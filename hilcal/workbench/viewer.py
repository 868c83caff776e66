"""The rerun web viewer as a part of the page, served behind the same guard.

rerun's own server admits every program of this machine, and its page loads fonts from other hosts.
The workbench therefore runs that server briefly, on the loopback address, to get the viewer's
files once. It then serves these files and the recording to the operator's browser only.
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
from hilcal.present.progress import Say
from hilcal.present.story import Story

FILES = {
    "index.html": "text/html; charset=utf-8",
    "re_viewer.js": "text/javascript",
    "re_viewer_bg.wasm": "application/wasm",
}
RECORDING = "application/octet-stream"
_TIMEOUT_S = 30.0
_LINKS = re.compile(r"<link\b[^>]*>", re.DOTALL)
_HEAD = "<head>"
# rerun asks for newer versions and sends usage statistics: both get an empty answer. Requests to
# this server get the operator's cookie. (The policy of the page forbids all other requests.)
_FETCH_HERE = (
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
"""Runs a command until standard input ends, which also a killed parent process causes."""
_NO_RECORDING = "rerun+http://127.0.0.1:9/proxy"
"""A dummy recording to show: with one, rerun opens no port for recordings."""


class WebViewer:
    """The viewer's files and the recording of a story, in memory."""

    def __init__(self) -> None:
        self.story: Story | None = None  # that is recorded
        self.recorded: dict[str, bytes] = {}  # recording and layout, by name
        self._files: dict[str, bytes] = {}

    def prepare(self, story: Story, count: int, say: Say) -> None:
        """Record a story.

        The layout is a separate file, since a web viewer treats one in a recording as a proposal
        only. `count` distinguishes the names from earlier ones; HilcalError without a viewer.
        """
        # slow imports of the viewer's library
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
        self.recorded, self.story = recorded, story  # the page looks at the story first

    def file(self, name: str) -> tuple[bytes, str] | None:
        """Return content and media type of a file; None for an unknown name."""
        name = name or "index.html"
        if name in self.recorded:
            return self.recorded[name], RECORDING
        return (self._files[name], FILES[name]) if name in self._files else None


def _fetched() -> dict[str, bytes]:
    from hilcal.present.viewer.recording import executable  # loads the viewer's library

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    serve = ("--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", str(port), _NO_RECORDING)
    process = subprocess.Popen(  # noqa: S603 (our own arguments)
        [sys.executable, "-c", _SERVE, executable(), *serve],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        files = {name: _get(port, name, process) for name in FILES}
    finally:
        if process.stdin is not None:
            process.stdin.close()
        process.wait()
    page = _LINKS.sub("", files["index.html"].decode("utf-8"))
    page = page.replace(_HEAD, _HEAD + _FETCH_HERE, 1)
    return {**files, "index.html": page.encode("utf-8")}


def _get(port: int, name: str, process: "subprocess.Popen[bytes]") -> bytes:
    end = time.monotonic() + _TIMEOUT_S
    while True:
        connection = HTTPConnection("127.0.0.1", port, timeout=_TIMEOUT_S)
        try:
            connection.request("GET", f"/{name}")
            answer = connection.getresponse()
            content = answer.read()
            if answer.status == 200 and content:
                return content
            raise HilcalError(f"the 3-D viewer has no {name}: rerun-sdk is built without it")
        except (OSError, HTTPException) as error:
            if process.poll() is not None or time.monotonic() > end:
                raise HilcalError(f"the 3-D viewer does not start: {error}") from None
            time.sleep(0.1)
        finally:
            connection.close()
