"""One piece of work at a time, beside the page, with what it says of its progress."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from hilcal.effects.failure import failure_of
from hilcal.errors import HilcalError

Say = Callable[[str], None]


@dataclass(slots=True)
class Work:
    """What is being done.

    Attributes:
        what: it, in words; None where nothing is.
        said: the last line of its progress.
        failure: why the last piece of work failed, one line; empty where it did not.
        begun: when it began, monotonic s.
    """

    what: str | None = None
    said: str = ""
    failure: str = ""
    begun: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self, what: str, do: Callable[[Say], object]) -> bool:
        """Begin a piece of work in a thread of its own; not while another is being done.

        What it raises is kept as one line. The thread does not outlive the program.

        Returns:
            Whether it was begun.
        """
        with self._lock:
            if self.what is not None:
                return False
            self.what, self.said, self.failure = what, "", ""
            self.begun = time.monotonic()
        threading.Thread(target=self._run, args=(do,), name="workbench", daemon=True).start()
        return True

    def _run(self, do: Callable[[Say], object]) -> None:
        failure = ""
        try:
            do(self._say)
        except HilcalError as error:
            failure = str(error)
        except Exception as error:
            told = failure_of(error)
            words = " ".join(str(error).split())
            failure = str(told or f"unexpected {type(error).__name__}: {words}; please report it")
        with self._lock:
            self.failure, self.what, self.said = failure, None, ""

    def _say(self, words: str) -> None:
        self.said = words

    @property
    def line(self) -> str:
        """What is being done, in one line; empty where nothing is."""
        what, said = self.what, self.said
        if what is None:
            return ""
        return what if said.lower() in ("", what.lower()) else f"{what}: {said}"

    def wait(self, timeout: float) -> bool:
        """Wait until nothing is being done; whether that came in time, s."""
        end = time.monotonic() + timeout
        while self.what is not None and time.monotonic() < end:
            time.sleep(0.01)
        return self.what is None
