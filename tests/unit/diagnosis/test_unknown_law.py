"""A law that the catalogue lacks is predicted by a remainder until it is known."""

import numpy as np
import pytest

from hilcal.diagnosis.unknown_law import REMAINDER, without_remainder
from hilcal.discovery.discovery import discover
from hilcal.identification.baseline import baseline
from hilcal.present.verdict import message
from hilcal.refinement import refine
from studies.all_effects_command import AllEffectsCase, campaign_of
from studies.discover import DiscoveryCase, error_at, simulated
from studies.few_poses_command import share_in_band
from studies.study_cases import study_case
from tests.support.campaigns import configuration

pytestmark = pytest.mark.long
POSES = 60
SMALL = 0.05  # of ordinary sizes: the law is most of the errors


def refined(law_rad):
    case = AllEffectsCase(POSES, 0, SMALL, without=False, law_rad=law_rad)
    cell, readings, fresh = campaign_of(case)
    return refine(baseline(cell, readings, "absolute"), readings, "absolute"), fresh


def errors(fit, readings):
    return readings.value - fit.model.predict(readings.states, fit.theta).observation.position


def rms(error):
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def test_a_law_that_the_catalogue_lacks_is_predicted_and_stays_unknown():
    refinement, fresh = refined(5e-4)  # joint 2 errs by 0.5 mrad sin 3 q4
    last, diagnosis = refinement.fit, refinement.steps[-1].diagnosis
    assert refinement.verdict == "unknown_effect"
    assert diagnosis.follows == ("joint 4 angle",)
    said = message(diagnosis)
    assert "it follows joint 4 angle" in said
    assert "smooth functions of the pose, the remainder, predict it" in said
    assert [e.options["laws"] for e in last.model.effects if e.name == REMAINDER] == ["2:4"]
    assert REMAINDER in last.model.background
    assert REMAINDER in {b.effect for b in diagnosis.background if b.p_value < 1e-3}
    plain = without_remainder(last)
    assert rms(errors(last, fresh)) < 0.3 * rms(errors(plain, fresh))
    assert share_in_band(last, fresh, errors(last, fresh)) > 0.9
    # The law itself is searched beside the other effects alone.
    assert "sin(3·q_4)" in discover(last).laws[0].formula


def test_an_arm_without_such_a_law_has_no_remainder():
    refinement, _ = refined(0.0)
    assert REMAINDER not in refinement.fit.model.names
    assert refinement.verdict != "unknown_effect"


def test_a_precise_arm_with_one_such_law_has_a_remainder_and_no_other_background():
    case = study_case(configuration(), "ur5e", "absolute", ("crossed gear",), 3.0, 0)
    start = baseline(case.cell, case.readings, "absolute")
    first, last = refine(start, case.readings, "absolute").steps
    assert last.added == REMAINDER
    assert last.diagnosis.verdict == "unknown_effect"
    assert last.fit.holdout.rms_m < 0.5 * first.fit.holdout.rms_m


def test_what_sinks_with_the_reach_is_predicted_and_named_for_nothing_else():
    asked = DiscoveryCase("ur5e", "absolute", "sinking bench")
    case = simulated(configuration(), asked)
    start = baseline(case.before.model.cell, case.first.readings, "absolute")
    path = refine(start, case.first.readings, "absolute")
    assert path.verdict == "unknown_effect"
    assert path.diagnosis.follows == ("distance from the base axis",)
    assert path.names == start.named  # and not joint_tilt_compliance, which resembles it
    assert error_at(path.fit, case.fresh) < 1.1 < 1.5 < error_at(case.before, case.fresh)
