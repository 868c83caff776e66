"""Follows a command while it works: serves viewers that come and go, and records."""

import contextlib
import pickle
import threading
import uuid
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import BinaryIO, Protocol

import rerun as rr

from hilcal.errors import HilcalError, InputError
from hilcal.measuring.progress import ArmAt
from hilcal.present.live_viewer import Measuring, Revised
from hilcal.present.viewer import recording
from hilcal.present.viewer.live_scene import LiveScene
from hilcal.present.viewer.recording import Sink

PORTS = 20
"""Ports that are tried, from the wanted one; a choice."""
MEMORY = "256MiB"
"""What the server keeps for viewers that come late at most; a choice, some 5000 readings."""
SHARE = 0.02
"""A file is written whenever it has grown by this share, so that it consists of few, large pieces;
what a killed process loses of it. A choice."""
_FLUSH_S = 5.0
_NEVER = timedelta(days=1)
_END_S = 8.0


class ViewerReply(Protocol):
    """Tells the command something: `url`, or a `problem` in one line."""

    def __call__(self, **told: object) -> None:
        """Tell it."""
        ...


def follow(messages: BinaryIO, reply: ViewerReply, record: Path, port: int) -> None:
    """Show what messages tell, until they end.

    Args:
        messages: pickled pairs of a time of day, s, and what happened; see `LiveScene`.
        reply: told `url` when viewers can be served (None: they cannot), and problems.
        record: the recording; a file that is there is replaced.
        port: the first to be tried, on the loopback interface only.
    """
    identifier = str(uuid.uuid4())
    name = f"recording {record}"
    outlets = [_Outlet(identifier, reply, name, lambda: rr.FileSink(str(record)), record)]
    with contextlib.suppress(OSError):
        recording.disable_analytics()
    found = next((p for p in range(port, port + PORTS) if recording.free("127.0.0.1", p)), None)
    if found is None:
        reply(problem=f"no free port from {port} to {port + PORTS - 1}: no live viewer is served")
        reply(url=None)
    else:
        sink = rr.GrpcServerSink(bind_ip="127.0.0.1", port=found, server_memory_limit=MEMORY)
        name = f"live viewer at port {found}"
        outlets.append(_Outlet(identifier, reply, name, lambda: sink))
        reply(url=f"rerun+http://127.0.0.1:{found}/proxy")
    with contextlib.suppress(EOFError, pickle.UnpicklingError):
        while True:
            wall, what = pickle.load(messages)  # noqa: S301 - of the command that started us
            for outlet in outlets:
                whole = not isinstance(what, ArmAt)  # places of the arm go on in batches
                now = isinstance(what, Measuring | Revised)
                outlet.tell(partial(LiveScene.tell, wall=wall, what=what), whole, now=now)
    guard = threading.Thread(target=lambda: list(map(_Outlet.end, outlets)), daemon=True)
    guard.start()
    guard.join(_END_S)


class _Outlet:
    """One place where the pictures go; what fails here is told once, and the others go on."""

    def __init__(
        self,
        identifier: str,
        reply: ViewerReply,
        name: str,
        sink: Callable[[], Sink],
        file: Path | None = None,
    ) -> None:
        """Open it; `file`: where it is one that is read later."""
        self._reply, self._name, self._file = reply, name, file
        self._scene: LiveScene | None = None
        self._told, self._written = 0, 0
        config = rr.ChunkBatcherConfig(flush_tick=_NEVER) if file else None
        self._rec = recording.stream(identifier, config)
        try:
            self._rec.set_sinks(sink())
            self._scene = LiveScene(self._rec, batches=file is not None)
        except (OSError, RuntimeError, ValueError) as error:
            self._fail(error)

    def tell(
        self, told: Callable[[LiveScene], None], flush: bool = True, *, now: bool = False
    ) -> None:
        """Draw something, and hand it on: now, or with what comes next."""
        if self._scene is None:
            return
        try:
            told(self._scene)
            self._told += flush
            little = self._told - self._written < max(1.0, SHARE * self._told)
            if not flush or (self._file and little and not now):
                return
            self._written = self._told
            self._scene.settle()
        except (InputError, ValueError, IndexError, KeyError) as error:
            self._reply(problem=f"{self._name}: not drawn: {error}")
        size = self._size()
        try:
            self._rec.flush(timeout_sec=_FLUSH_S)
        except (OSError, RuntimeError, ValueError, HilcalError) as error:
            if not recording.slow(error):
                self._fail(error)
            elif self._file and self._size() == size:  # rerun says no more of a write that failed
                self._fail(f"nothing was written for {_FLUSH_S:.0f} s; is the disk full?")
            # else slow; what does not fit in is dropped by the command

    def end(self) -> None:
        """End it, whole."""
        self.tell(lambda scene: scene.end(self._file is not None), now=True)
        if self._scene is not None:  # else it would wait for what cannot be written
            self._rec.disconnect()

    def _size(self) -> int:
        return self._file.stat().st_size if self._file and self._file.exists() else 0

    def _fail(self, error: Exception | str) -> None:
        self._scene = None
        self._reply(problem=f"{self._name}: cannot be written ({error}); everything else goes on")
