"""Serving until somebody says that it is enough."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

POLL = 0.2
"""How long a plea to end may stay unheard where a signal does not wake the sleeper, s."""


@contextmanager
def told_to_end(*kinds: signal.Signals) -> Iterator[Callable[[], None]]:
    """Catch signals; what is yielded waits for the first of them.

    A handler runs between two instructions of the very thread that waits, so it must take no lock:
    `threading.Event.set` would wait for ever where the thread is just inside `Event.wait`.
    """
    asked: list[int] = []

    def wait() -> None:
        while not asked:
            time.sleep(POLL)

    before = [signal.signal(kind, lambda number, _: asked.append(number)) for kind in kinds]
    try:
        yield wait
    finally:
        for kind, handler in zip(kinds, before, strict=True):
            signal.signal(kind, handler)
