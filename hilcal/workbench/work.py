"""One piece of work at a time, beside the page, with what it says of its progress."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from hilcal.effects.from_file import failure_of
from hilcal.errors import HilcalError

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of a piece of work, in words, and whether it was done."""

    words: str
    done: bool = True


@dataclass(slots=True)
class Work:
    """What is being done."""

    what: str | None = None  # in words; None where nothing is
    place: str = ""  # the part of the page where it was asked for
    said: str = ""  # the last line of its progress
    answers: dict[str, Answer] = field(default_factory=dict)  # the last at each place
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self, what: str, do: Callable[[Say], object], place: str = "file") -> bool:
        """Begin work in a thread unless some is being done; its text or error is the answer."""
        with self._lock:
            if self.what is not None:
                return False
            self.what, self.said, self.place = what, "", place
            self.answers.pop(place, None)
        threading.Thread(target=self._run, args=(do,), name="workbench", daemon=True).start()
        return True

    def _run(self, do: Callable[[Say], object]) -> None:
        try:
            result = do(lambda words: setattr(self, "said", words))
            answer = Answer(result) if isinstance(result, str) and result else None
        except HilcalError as error:
            answer = Answer(str(error), done=False)
        except Exception as error:
            words = " ".join(str(error).split())
            unexpected = f"unexpected {type(error).__name__}: {words}; please report it"
            answer = Answer(str(failure_of(error) or unexpected), done=False)
        with self._lock:
            if answer is not None:
                self.answers[self.place] = answer
            self.what, self.said = None, ""

    @property
    def line(self) -> str:
        """What is being done, in one line; empty where nothing is."""
        what, said = self.what, self.said
        if what is None:
            return ""
        return what if said.lower() in ("", what.lower()) else f"{what}: {said}"

    def failure(self, place: str = "file") -> str:
        """Why the last piece of work that was asked for at a place failed; empty otherwise."""
        answer = self.answers.get(place)
        return "" if answer is None or answer.done else answer.words

    def wait(self, timeout: float) -> bool:
        """Wait until nothing is being done; whether that came in time, s."""
        end = time.monotonic() + timeout
        while self.what is not None and time.monotonic() < end:
            time.sleep(0.01)
        return self.what is None
