"""Computations for the tests of the engine; workers find them by the name of this module."""

import os
import signal
import time

import numpy as np

from hilcal.engine import open_engine


def singular_value(item, rng):
    """Takes BLAS, whose threads could change the last bits, and a while."""
    a = rng.normal(size=(120, 120))
    time.sleep(0.02)
    return float(np.linalg.svd(a @ a.T, compute_uv=False)[item % 7])


def wait(item):
    """The first is done at once."""
    os.write(2, b"computing\n")  # whole, whatever another worker writes at the same moment
    time.sleep(60 if item else 0)
    return item


def negative(item):
    return -item


def strides(item):
    return item.strides


def die_once(item, folder):
    """Items 1 and 4 kill their worker where the folder has no note that they did so before."""
    note = folder / str(item)
    if item in (1, 4) and not note.exists():
        if folder.exists():
            note.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def refuse(item):
    if item == 3:
        raise ValueError("item 3 is odd")
    return item


if __name__ == "__main__":
    with open_engine(2) as engine:
        engine.map(wait, range(1, 8))
