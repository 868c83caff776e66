"""Random faults for hours: `python -m tests.soak --minutes N --seed S [--out FILE]`.

One simulated cell after the other; on each, `check`, `run`, `run --resume`, `run --append` and
`calibrate --rehearse --resume`, which meet faults of the arm, the tracker, the force sensor, their
wires and the computer at random moments, also two at once, and also while the operator goes on
after one. After each: the arm is stopped within 0.5 s of a fault that has to stop it, the program
has ended by itself with one line that names cause and mend (or has overcome the fault), no process
of it and no client of the controller is left, and no reading is lost, doubled or wrong.
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from random import Random

from tests.support.soak_actions import Soak

EVERY = 40
"""Actions on one cell; then another is built."""


def soak(seconds: float, seed: int, folder: Path, say: Callable[[str], None] = print) -> Soak:
    """Do things for so long."""
    s = Soak(Random(seed), folder)
    end, told = time.monotonic() + seconds, 0
    try:
        while time.monotonic() < end:
            s.act()
            if len(s.findings) > told:
                told = len(s.findings)
                say(f"FOUND {s.findings[-1]}")
            if sum(s.counts[w] for w in ("one_fault", "two_faults", "signal")) % EVERY == EVERY - 1:
                s.close()
    finally:
        s.close()
    return s


def main() -> int:
    """Run for some minutes and say what was found."""
    ask = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    ask.add_argument("--minutes", type=float, default=10.0)
    ask.add_argument("--seed", type=int, default=0)
    ask.add_argument("--out", type=Path, help="JSON file of counts and findings")
    asked = ask.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="hilcal-soak-"))
    try:
        s = soak(60.0 * asked.minutes, asked.seed, folder, lambda line: print(line, flush=True))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    document = {
        "minutes": asked.minutes,
        "seed": asked.seed,
        "faults": s.counts["faults"],
        "starved": s.starved,
        "findings": s.findings,
        "slowest_stop_s": s.slowest,
        "counts": dict(sorted(s.counts.items())),
    }
    if asked.out is not None:
        asked.out.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(document, indent=1))
    return int(bool(s.findings))


if __name__ == "__main__":
    sys.exit(main())
