"""Cost of planning what separates four suspects against one fit, in one run.

Processor time of this process; nothing is asserted of times, see `test_refine_speed`.
"""

import time
from typing import Any

import numpy as np
import pytest

from hilcal.design.next import CANDIDATES, Next, measure_next
from hilcal.design.planner import Request
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.readings.whitening import Mode
from tests.benchmarks.conftest import Claim
from tests.support.campaigns import campaign
from tests.support.plan_cases import config_of

pytestmark = pytest.mark.slow

SUSPECTS = ("base_compliance", "joint_tilt_compliance", "link_compliance", "tool_compliance")


@pytest.mark.parametrize(("mode", "poses"), [("deflection", 30), ("absolute", 60)])
def test_what_separates_four_suspects(mode: Mode, poses: int, benchmark: Any, claim: Claim) -> None:
    """`ratio`: the plan and its powers over one fit of the campaign."""
    c = campaign(SUSPECTS[1], mode, poses=poses, strength=0.5)
    config = config_of(mode, candidates=CANDIDATES)

    def fitted() -> Fit:
        found = fit(baseline(c.cell, c.readings, mode), c.readings, mode)
        assert found.uncertainty.std.shape == (found.model.size,)
        assert found.holdout.rms_m > 0
        return found

    def planned(found: Fit) -> Next:
        rng = np.random.default_rng(0)
        return measure_next(c.cell, config, found, SUSPECTS, Request(20), rng)

    fitted()  # what is imported late
    start = time.process_time()
    found = fitted()
    one = time.process_time() - start
    start = time.process_time()
    made = benchmark.pedantic(planned, (found,), rounds=1)
    ratio = (time.process_time() - start) / one
    assert len(made.powers) == 12
    assert made.planned.design.efficiency > 0.9
    benchmark.extra_info.update(ratio=ratio, poses=poses)
    claim(f"{poses} poses, {mode}: next of four suspects over one fit", f"{ratio:.1f}", "no limit")
