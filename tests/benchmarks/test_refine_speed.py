"""Cost of a whole refinement against one fit of its largest model, in one run.

A refinement makes some fits and as many judgements. The machine's speed cancels in the ratio;
processor time of this process, so that what else runs does not count. Nothing is asserted of
times; `make bench` prints the ratios at its end and stores them in `extra_info`.
"""

import time
from typing import Any

import pytest

from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.refinement import Refinement, refine
from tests.benchmarks.conftest import Claim
from tests.support.campaigns import campaign

pytestmark = pytest.mark.slow

POSES = 100
ROUNDS = 2


def refined() -> Refinement:
    """Poses with a transmission error, of which the model knows nothing yet."""
    c = campaign("transmission_error", "absolute", poses=POSES, m=6, strength=2.0)
    return refine(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")


def test_a_refinement_against_a_fit_of_its_largest_model(benchmark: Any, claim: Claim) -> None:
    """`ratio`: the whole refinement over one fit; `each`: the same for each of its steps."""
    found = benchmark.pedantic(refined, rounds=1)
    largest = max((s.fit for s in found.steps), key=lambda f: f.model.size)
    assert "transmission_error" in largest.model.names
    refinements, fits = [], []
    for _ in range(ROUNDS):
        start = time.process_time()
        refined()
        between = time.process_time()
        again = fit(largest.model, largest.readings, "absolute")
        assert again.holdout.rms_m > 0  # what a step computes, too
        assert again.uncertainty.std.shape == (largest.model.size,)
        refinements.append(between - start)
        fits.append(time.process_time() - between)
    ratio = min(refinements) / min(fits)
    steps = len(found.steps)
    benchmark.extra_info.update(ratio=ratio, steps=steps, parameters=largest.model.size)
    what = f"{len(largest.readings)} readings, {steps} steps: refinement"
    one = f"one fit of {largest.model.size} parameters"
    claim(f"{what} over {one}", f"{ratio:.1f}", "no limit")
    claim(f"{what}, each step over {one}", f"{ratio / steps:.1f}", "no limit")
