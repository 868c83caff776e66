"""The process of one simulated device, as its launcher sees it."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

from hilcal.errors import DeviceError

_ROOT = Path(__file__).resolve().parents[2]
_END = 2.0  # s that a process has to end by itself, and again after it was asked to


class DeviceProcess:
    """Starts, watches and ends `python -m MODULE --directory DIR ...`.

    Its standard input is a pipe held by this process, whose end it follows; its output goes
    to DIR/NAME.log; it is ready when DIR/NAME.sock appears.

    Attributes:
        name: of the device: "world", "arm", "tracker", "force".
        socket: its admin socket.
        log: the file of its output.
    """

    def __init__(self, name: str, module: str, directory: Path, arguments: tuple[str, ...]) -> None:
        """Prepare; nothing is started."""
        self.name = name
        self.socket = directory / f"{name}.sock"
        self.log = directory / f"{name}.log"
        self._command = (
            *(sys.executable, "-m", module, "--directory", str(directory)),
            *arguments,
        )
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the process, after ending one that still runs; returns at once."""
        self.kill()
        self.socket.unlink(missing_ok=True)
        path = os.environ.get("PYTHONPATH")
        environment = {
            **os.environ,
            "PYTHONPATH": str(_ROOT) if not path else f"{_ROOT}{os.pathsep}{path}",
            "OMP_NUM_THREADS": "1",
        }
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                self._command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env=environment,
                start_new_session=True,  # Ctrl-C is for the one who started it
            )

    @property
    def pid(self) -> int | None:
        """Its number while it runs."""
        return None if self._process is None or self.ended else self._process.pid

    @property
    def ended(self) -> bool:
        """Whether it has ended by itself."""
        return self._process is not None and self._process.poll() is not None

    def running_unready(self) -> bool:
        """Whether it was started and is not ready yet."""
        return self._process is not None and not self.socket.exists()

    def check(self) -> None:
        """Raise where it has ended.

        Raises:
            DeviceError: with the last line that it said.
        """
        if self._process is None or not self.ended:
            return
        words = self.log.read_text(encoding="utf-8", errors="replace").split("\n")
        last = next((line.strip() for line in reversed(words) if line.strip()), "without a word")
        raise DeviceError(
            f"simulated {self.name}: ended with exit code {self._process.returncode}: {last}"
        )

    def let_go(self) -> None:
        """Close its standard input: it ends by itself."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def end(self) -> None:
        """End it, whatever it takes."""
        if self._process is None:
            return
        self.let_go()
        for harder in (self._process.terminate, self._process.kill, lambda: None):
            try:
                self._process.wait(_END)
                break
            except subprocess.TimeoutExpired:
                harder()
        self._process = None
        self.socket.unlink(missing_ok=True)

    def kill(self) -> None:
        """End it at once, as kill -9 or a power cut does."""
        if self._process is not None:
            self._process.kill()
            self.end()
