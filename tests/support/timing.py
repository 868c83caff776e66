"""How long work takes, where a machine has other work too: the shortest of several times."""

import time
from collections.abc import Callable


def shortest(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Return the shortest processor time of each piece of work, s; they are done in turn."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            start = time.process_time()
            work()
            times[name].append(time.process_time() - start)
    return {name: min(seconds) for name, seconds in times.items()}
