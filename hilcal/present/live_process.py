"""The process of a live viewer: `python -m hilcal.present.live_process RECORD.rrd PORT`.

It reads pickled messages from standard input, those of `live_viewer`, until that ends, and writes
a JSON object per line to standard output: "url" once it serves, "problem" for people.
"""

import json
import os
import signal
import sys
from pathlib import Path

NICE = 15
"""Behind everything else, so that the arm's watchdog never waits for a picture; a choice."""


def main() -> None:
    """Serve and record until standard input ends."""
    if hasattr(os, "nice"):
        os.nice(NICE)  # before the viewer's library starts its threads, which inherit it
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "SIGXFSZ"):
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a file that may not grow is an error
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no reply

    def reply(**told: object) -> None:
        print(json.dumps(told), file=replies, flush=True)

    from hilcal.present.viewer.live import follow  # loads the viewer's library

    follow(sys.stdin.buffer, reply, Path(sys.argv[1]), int(sys.argv[2]))
    os._exit(0)  # a viewer that does not answer could hold the end up


if __name__ == "__main__":
    main()
