"""What the guard takes of the 20 ms between two samples of a moving arm."""

from dataclasses import replace
from time import process_time

import numpy as np
import pytest

from hilcal.config import Obstacle
from hilcal.measuring.motion import POLL_S, Guard
from tests.support.fake_bench import POSES, Bench
from tests.support.space_cases import TABLE

MOST_S = 0.25 * POLL_S


@pytest.mark.benchmark(timer=process_time)  # others may be at work
def test_a_sample_with_a_load_and_obstacles(benchmark, claim):
    bench = Bench()
    config = bench.config.model_copy(update={"obstacles": (Obstacle(**TABLE),)})
    guard = Guard(bench.cell.with_config(config))
    sample = replace(bench.rig.arm.sample(), q=np.array(POSES["p1"]))
    result = benchmark(guard.check, sample, np.zeros(6), "3kg")
    assert result is None
    if benchmark.stats is not None:
        seconds = benchmark.stats.stats.median
        claim(
            "guard: processor time of one sample in motion",
            f"{1e3 * seconds:.2f} ms",
            f"at most {1e3 * MOST_S} ms",
        )
        assert seconds < MOST_S
