"""A live viewer of a running command, in a separate process that the command never waits for.

    command ─► bounded queue ─► thread ─► pipe ─► process: serves viewers, writes the recording

A failure of viewer, recording or process does not stop the command: a full queue drops messages,
a dead process is reported once. The process ends when its pipe is closed, so that the recording is
complete however the command ends. `python -m hilcal.present.live_viewer RECORD.rrd PORT` starts
the process. It reads pickled messages from standard input and writes a JSON object per line to
standard output: "url" when it serves, "problem" with a message for people.
"""

import contextlib
import json
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from hilcal.cell import Cell
from hilcal.measuring.progress import ArmPosition
from hilcal.present.progress import Say
from hilcal.present.story import Chapter, build_story
from hilcal.robot.arm import Arm
from hilcal.store.plan import Plan, Step
from hilcal.store.run_log import RunLog
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class MeasuringStart:
    """Message: the measurement of a campaign begins or resumes."""

    name: str
    arm: Arm
    targets: Floats  # (T, 3) tracked targets, flange axes, m
    plan: Plan
    earlier_steps: tuple[tuple[float, Step], ...] = ()  # (wall time in s, step) of earlier sessions
    names: tuple[str, ...] = ()  # of the targets, if there are several


PORT = 9877  # not 9876, on which a viewer itself listens; it opens no window if that is occupied
MAX_MESSAGES = 2000  # most messages in the queue, some 500 bytes each; a choice
ARM_S = 0.2  # between two recorded arm positions: smooth motion, small files; a choice
START_S, END_S = 20.0, 10.0  # most time of the process to load its library, and to finish; choices
NICENESS = 15  # low priority, so that the arm's watchdog never waits for a picture; a choice
_ROOT = Path(__file__).resolve().parents[2]


class LiveViewer:
    """Sends events to the viewer's process; only `start` and `close` wait for the process."""

    def __init__(self, record: Path, say: Say, port: int = PORT) -> None:
        """Start nothing yet; another thread calls `say` with problems; `port` is tried first."""
        self.record = record
        self.dropped = 0  # messages that were not sent because the process did not keep up
        self.url: str | None = None  # for a viewer to open; None if nothing is served
        self._say, self._port = say, port
        self._queue: queue.Queue[tuple[float, object] | None] = queue.Queue(MAX_MESSAGES)
        self._process: subprocess.Popen[bytes] | None = None
        self._threads: list[threading.Thread] = []
        self._ready, self._closing, self._arm_sent = threading.Event(), False, 0.0

    def start(self) -> None:
        """Start the process and wait until it serves; problems go to `say`."""
        path = filter(None, (str(_ROOT), os.environ.get("PYTHONPATH")))
        variables = {"PYTHONPATH": os.pathsep.join(path), "OMP_NUM_THREADS": "1", "RUST_LOG": "off"}
        command = (sys.executable, "-P", "-m", "hilcal.present.live_viewer")
        try:
            self._process = process = subprocess.Popen(  # noqa: S603 - our interpreter and module
                [*command, str(self.record.absolute()), str(self._port)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                bufsize=0,
                env=os.environ | variables,
                start_new_session=True,  # Ctrl-C is for the command
            )
        except OSError as error:
            self._say(f"no live viewer: {error}; it goes on without")
            self._closing = True
            return
        for work, pipe in ((self._write, process.stdin), (self._listen, process.stdout)):
            thread = threading.Thread(target=work, args=(pipe,), name="live viewer", daemon=True)
            thread.start()
            self._threads.append(thread)
        if not self._ready.wait(START_S):
            self._say(f"the live viewer has not started in {START_S:.0f} s; it goes on without")

    def notify(self, event: object) -> None:
        """Send an event of `measuring.progress`; returns at once."""
        wall = time.time()
        if isinstance(event, ArmPosition):
            # Half of the queue is reserved for readings, which matter more than arm positions.
            if wall - self._arm_sent < ARM_S or self._queue.qsize() > MAX_MESSAGES // 2:
                return
            self._arm_sent = wall
        self._send(wall, event)

    def measuring(self, name: str, cell: Cell, log: RunLog) -> None:
        """Send the start of a measurement, with the steps of earlier sessions."""
        stored = (d for d in log.details() if "wall_s" in d)
        steps = tuple((float(d["wall_s"]), Step(**d["step"])) for d in stored)
        targets, names = cell.all_targets[:, :3, 3], cell.target_names
        self._send(time.time(), MeasuringStart(name, cell.arm, targets, log.plan, steps, names))

    def revised(self, chapter: Chapter) -> None:
        """Send a revision; a failure to draw it goes to `say` and is not raised."""
        try:
            self._send(time.time(), build_story([chapter]))
        except Exception as error:  # a picture must not cost the revision
            self._say(f"revision {chapter.number} is not in the live viewer: {error}")

    def close(self) -> None:
        """Let the process finish the recording, and stop it."""
        process = self._process
        if process is None or self._closing:
            return
        self._closing = True
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=END_S)
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            self._say(f"the live viewer did not end; the end of {self.record} may be missing")
        for thread in self._threads:
            thread.join(END_S)
        if self.dropped:
            self._say(f"the live viewer did not keep up: {self.dropped} messages are not recorded")

    def _send(self, wall: float, content: object) -> None:
        if self._closing or self._process is None or self._process.poll() is not None:
            return
        try:
            self._queue.put_nowait((wall, content))
        except queue.Full:
            self.dropped += 1

    def _write(self, pipe: IO[bytes]) -> None:
        """Thread: write messages to the process until it ends, or until `close`."""
        with contextlib.suppress(OSError), pipe:
            while (message := self._queue.get()) is not None:
                content = memoryview(pickle.dumps(message))
                while content:
                    content = content[pipe.write(content) :]

    def _listen(self, pipe: IO[bytes]) -> None:
        """Thread: handle the replies of the process until it ends."""
        with pipe:
            for line in pipe:
                reply: dict[str, Any] = json.loads(line)
                if "url" in reply:
                    self.url = reply["url"]
                    self._ready.set()
                if "problem" in reply:
                    self._say(reply["problem"])
        if not self._closing:
            self._say("the live viewer has ended; everything else goes on")
        self._ready.set()


def main() -> None:
    """Run the process: serve and record until standard input ends."""
    if hasattr(os, "nice"):
        os.nice(NICENESS)  # before the viewer's library starts threads, which inherit the priority
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "SIGXFSZ"):
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # OSError at the limit of file size instead
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # a library's prints go to standard error

    def reply(**fields: object) -> None:
        print(json.dumps(fields), file=replies, flush=True)

    from hilcal.present.viewer.live import follow  # loads the viewer's library

    follow(sys.stdin.buffer, reply, Path(sys.argv[1]), int(sys.argv[2]))
    os._exit(0)  # a viewer that does not answer could block a regular exit


if __name__ == "__main__":
    main()
