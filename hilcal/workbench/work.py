"""One task at a time, in a thread of its own, with its progress and its answer."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from hilcal.effects.protocol import failure_of
from hilcal.errors import HilcalError

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Answer:
    """The outcome of a task: a text, and whether the task succeeded."""

    text: str
    done: bool = True


@dataclass(slots=True)
class Work:
    """The current task and the last answers."""

    task: str | None = None  # its description; None without a task
    place: str = ""  # the part of the page that started it
    progress: str = ""  # the last line of its progress
    answers: dict[str, Answer] = field(default_factory=dict)  # the last answer at each place
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self, task: str, do: Callable[[Say], object], place: str = "file") -> bool:
        """Start a task in a thread unless one is running; its text or its error is the answer."""
        with self._lock:
            if self.task is not None:
                return False
            self.task, self.progress, self.place = task, "", place
            self.answers.pop(place, None)
        threading.Thread(target=self._run, args=(do,), name="workbench", daemon=True).start()
        return True

    def _run(self, do: Callable[[Say], object]) -> None:
        try:
            result = do(lambda text: setattr(self, "progress", text))
            answer = Answer(result) if isinstance(result, str) and result else None
        except HilcalError as error:
            answer = Answer(str(error), done=False)
        except Exception as error:
            text = " ".join(str(error).split())
            unexpected = f"unexpected {type(error).__name__}: {text}; please report it"
            answer = Answer(str(failure_of(error) or unexpected), done=False)
        with self._lock:
            if answer is not None:
                self.answers[self.place] = answer
            self.task, self.progress = None, ""

    @property
    def line(self) -> str:
        """The current task and its progress in a line; empty without a task."""
        task, progress = self.task, self.progress
        if task is None:
            return ""
        return task if progress.lower() in ("", task.lower()) else f"{task}: {progress}"

    def failure(self, place: str = "file") -> str:
        """Return the error of the last task at a place; empty if it succeeded."""
        answer = self.answers.get(place)
        return "" if answer is None or answer.done else answer.text

    def wait(self, timeout: float) -> bool:
        """Wait up to `timeout`, s, for the end of the task; return whether it has ended."""
        end = time.monotonic() + timeout
        while self.task is not None and time.monotonic() < end:
            time.sleep(0.01)
        return self.task is None
