"""Computations for the tests of the engine; workers find them by the name of this module."""

import sys
import time

import numpy as np

from hilcal.engine.engine import open_engine


def singular_value(item: int, rng: np.random.Generator) -> float:
    """Takes BLAS, whose threads could change the last bits, and a while."""
    a = rng.normal(size=(120, 120))
    time.sleep(0.02)
    return float(np.linalg.svd(a @ a.T, compute_uv=False)[item % 7])


def wait(item: int) -> int:
    time.sleep(60)
    return item


def refuse(item: int) -> int:
    if item == 3:
        raise ValueError("item 3 is odd")
    return item


if __name__ == "__main__":
    with open_engine(2) as engine:
        print("ready", file=sys.stderr, flush=True)
        engine.map(wait, range(8))
