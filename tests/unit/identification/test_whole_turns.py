"""Which joints are the same whole turns on."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.identification.predictive import predictive
from hilcal.identification.robot_frames import whole_turns
from hilcal.identification.validation import extrapolation, validate
from tests.support.campaigns import campaign


@pytest.mark.parametrize(
    ("effect", "same"), [("transmission_error", True), ("joint_coupling", False)]
)
def test_waves_of_whole_turns_are_the_same_and_couplings_are_not(effect: str, same: bool) -> None:
    c = campaign()
    model = with_effects(c.cell, c.readings, "absolute", ["joint_compliance", effect])
    theta = 1e-4 * np.ones(model.size)
    assert bool(whole_turns(model, theta)[1]) is same


def test_a_joint_that_turned_on_is_validated_as_inside() -> None:
    c = campaign(poses=16)
    found = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")
    q = c.readings.states.q.copy()
    q[:, 5] += 2 * np.pi
    on = replace(c.readings, states=replace(c.readings.states, q=q))
    p = predictive(
        found.model, found.theta, found.solution.prior, c.readings, "absolute",
        found.holdout.rms_sigma,
    )  # fmt: skip
    seen = validate(found.model, found.theta, c.readings, on, "absolute")
    told = extrapolation(p, c.readings, seen)
    assert [v.variable for v in told.variables if "angle" in v.variable] == []
