"""The study of corrections at poses that were not fitted: what it counts, and what it calls met."""

from dataclasses import replace

import numpy as np

from studies.compensation_command import FINAL, SplitErrors, _figures, judged
from tests.support.campaigns import campaign, measured, plan
from tests.unit.calibration.test_calibration import POSES, calibrated

LEFT = SplitErrors(
    split="random half 1",
    model=FINAL,
    scatter=True,
    poses=100,
    before_m=1e-3,
    mean_m=70e-6,
    worst_m=2e-4,
    inside=0.94,
    beyond=0.0,
    beyond_mean_m=None,
    beyond_inside=None,
    near_mean_m=70e-6,
    near_inside=0.94,
    verdict="adequate",
)


def test_errors_are_counted_against_what_the_tracker_reads_elsewhere():
    c = calibrated("encoder_offset")
    world = campaign("encoder_offset", "absolute", 0, poses=POSES).world
    others = measured(world, plan(30, 7000), np.random.default_rng(5))
    p = c.predict(others.states.q, others.states.wrench)
    errors, inside = judged(c, p, others)
    assert 1e-6 < errors.mean() < 1e-4
    assert 0.85 < inside.mean() < 0.995
    further = replace(others, value=others.value + 1e-3)
    assert not judged(c, p, further)[1].any()


def test_the_worst_split_decides():
    good = list(_figures("B", [LEFT, replace(LEFT, split="random half 2", mean_m=74e-6)]))
    assert [f.met for f in good] == [True, True, None]
    bad = list(_figures("B", [LEFT, replace(LEFT, mean_m=76e-6, inside=0.89)]))
    assert [f.met for f in bad] == [False, False, None]
    assert "73.0 µm, 76.0 µm" in bad[0].measured
    far = replace(LEFT, split="first half", beyond=0.3, beyond_mean_m=3e-4, beyond_inside=1.0)
    assert "30.0 % of poses; left there 300 µm" in list(_figures("B", [far]))[2].measured
