"""A simulated device ends with the process that started it, however that one ends."""

import os
import signal
import sys
import threading


def end_with_parent() -> None:
    """Exit at once when standard input closes (the parent holds its other end).

    A pipe ends with any death, also of kill -9; asynchronous and on every platform.
    """

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        os._exit(0)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who started it
    threading.Thread(target=wait, daemon=True).start()
