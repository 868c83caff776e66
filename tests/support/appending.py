"""A process that measures into a campaign while others fit it.

Its arguments are the file, a seed, and the longest pause between two readings in s. It appends
until it is killed, and prints how many readings there are.
"""

import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from subprocess import PIPE, Popen

import numpy as np

from hilcal.store.campaign_file import CampaignFile
from tests.support.paths import ROOT


def repeated_deflection(x, rng, cycle):
    """One deflection of those that are there, measured again."""
    of = np.flatnonzero((x.pose == rng.choice(x.pose)) & (x.cycle == 0))
    one = x[np.append(of[x.unloaded[of]][:1], rng.choice(of[~x.unloaded[of]]))]
    std = np.sqrt(np.diagonal(one.covariance, axis1=1, axis2=2))
    value = one.value + rng.normal(0.0, std)  # so that no noise along the order is estimated
    return replace(one, value=value, cycle=np.full(len(one), cycle))


def append(path, seed, pause):
    rng = np.random.default_rng(seed)
    with CampaignFile.open(path, read_only=True) as file:
        x = file.readings()
    first = int(x.cycle.max()) + 1
    for cycle in range(first, first + 100_000):
        with CampaignFile.open(path) as file:
            print(file.append_readings(repeated_deflection(x, rng, cycle)), flush=True)
        time.sleep(rng.uniform(0.0, pause))


@contextmanager
def appending(path, seed, pause):
    """A process that has begun to append, and is killed at the end."""
    command = [sys.executable, "-m", "tests.support.appending", str(path), str(seed), str(pause)]
    process = Popen(command, stdout=PIPE, stderr=PIPE, cwd=ROOT, text=True)
    try:
        assert int(process.stdout.readline()) > 0
        yield process
        assert process.poll() is None, process.stderr and process.stderr.read()
    finally:
        process.kill()
        process.communicate()


if __name__ == "__main__":
    append(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))
