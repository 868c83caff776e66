"""How long work takes, and waiting, where a machine has other work too."""

import time

import psutil


def shortest(works, rounds):
    """Return the shortest processor time of each piece of work, s; they are done in turn."""
    times = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            start = time.process_time()
            work()
            times[name].append(time.process_time() - start)
    return {name: min(seconds) for name, seconds in times.items()}


def runs(pid):
    """Whether a process is there, and no zombie."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def wait_until(holds, what, seconds=30.0):
    """Wait until something holds; the limit is far above what a busy machine takes."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, f"never {what}"
        time.sleep(0.01)
