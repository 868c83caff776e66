"""Cost of compensation against evaluating the nominal chain once for the same points."""

from timeit import repeat

import numpy as np
import pytest

from hilcal.calibration.calibration import Calibration
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.robot.chain import evaluate
from tests.support.campaigns import campaign, plan

pytestmark = pytest.mark.slow

POINTS = 10_000
ROUNDS = 5


def shortest(work, times=1):
    """Return the median of some calls, least of all rounds, s."""
    timed = [repeat(work, number=1, repeat=times) for _ in range(ROUNDS)]
    return float(np.median(timed, axis=1).min())


EFFECTS = [
    *("joint_tilt_compliance", "transmission_error", "periodic_joint_compliance"),
    *("joint_coupling", "hysteresis", "creep"),
]


@pytest.mark.parametrize("effect", EFFECTS)
def test_compensation(effect, benchmark, claim):
    c = campaign(effect, "absolute", 0, poses=24)
    model = baseline(c.cell, c.readings, "absolute")
    model = model + model.catalogue.make(effect, c.cell, c.readings.states)
    calibration = Calibration.of(fit(model, c.readings, "absolute"))
    states = plan(40, 5000).states
    rows = np.arange(POINTS) % len(states)
    q, wrench = states.q[rows], states.wrench[rows]
    columns = {k: getattr(states, k) for k in ("load_time", "approach")}
    recorded = {k: v[rows] for k, v in columns.items() if v is not None}
    first = {k: v[0] for k, v in recorded.items()}
    assert calibration.without_kernel() == ()
    compensation = calibration.compensate(
        q, wrench, recorded=recorded
    )  # the kernel is compiled here
    assert compensation.inverse.solved.mean() > 0.95
    one = shortest(lambda: calibration.compensate(q[0], wrench[0], recorded=first), 500)
    many = shortest(lambda: calibration.compensate(q, wrench, recorded=recorded))
    chain = shortest(lambda: evaluate(calibration.model.cell.arm, q))
    claim(f"one compensation, {effect}", f"{1e6 * one:.0f} µs", "200 µs")
    claim(f"{POINTS} compensations, {effect}", f"{many:.3f} s", "0.2 s")
    claim(f"the same over one evaluation of {POINTS} chains", f"{many / chain:.2f}", "no limit")
    benchmark.extra_info["over one chain"] = many / chain
    benchmark.pedantic(lambda: calibration.compensate(q, wrench, recorded=recorded), rounds=ROUNDS)
