"""A model with one factor for several joints, where the joints differ: the finer form is named."""

import numpy as np
import pytest

from hilcal.diagnosis.document import suspect_json
from hilcal.diagnosis.effect_ranking import candidates
from hilcal.diagnosis.evidence import StepwiseAlternatives
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.errors import InputError
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.present.diagnosis import finer
from hilcal.present.verdict import message
from hilcal.refinement import refine
from tests.support.campaigns import NOTHING, Campaign, campaign

EACH = "joint_compliance(joints=each)"


@pytest.fixture(scope="module", params=[1, 2])
def arm(request) -> Campaign:
    """An arm whose joints differ, as simulated, and nothing hidden."""
    return campaign(NOTHING, "deflection", request.param, poses=12, registration_known=True)


def fitted(c: Campaign, joints: str) -> Fit:
    options = {"joint_compliance": {"joints": joints}}
    model = with_effects(c.cell, c.readings, "deflection", options, options)
    return fit(model, c.readings, "deflection")


@pytest.mark.parametrize("joints", ["common", "1-3/4-6"])
def test_the_verdict_is_to_let_joints_differ(arm, joints):
    d = diagnose(fitted(arm, joints))
    assert d.verdict == "missing_effect"
    assert d.significant[0] == EACH
    lead = d.suspects[0]
    assert lead.share > 0.95
    assert message(d).startswith(f"let joints differ: {EACH} explains")
    assert suspect_json(lead)["finer_than"] == "joint_compliance"
    assert list(finer(d)) == [
        "Let joints differ: joint_compliance has one parameter for several joints; to give each "
        f'its own: hilcal add RUN "{EACH}".'
    ]


def test_refine_lets_them_differ_and_names_no_other_effect(arm):
    start = fitted(arm, "common")
    found = refine(start.model, arm.readings, "deflection")
    assert [s.added for s in found.steps] == [None, EACH]
    assert found.verdict == "adequate"
    assert found.fit.model.names == start.model.names
    own = found.fit.model.effects[-1]
    assert own.options["joints"] == "each"
    again = fitted(arm, "each")
    np.testing.assert_allclose(found.fit.theta, again.theta, rtol=1e-6)
    assert found.fit.chi2 == pytest.approx(again.chi2, rel=1e-8)


def test_a_model_whose_joints_differ_has_no_finer_suspect(arm):
    found = fitted(arm, "each")
    assert not any(e.coarse for e in candidates(found))


def test_a_finer_form_is_no_alternative_to_the_effect(arm):
    c = campaign("creep", "deflection", 1, poses=12, strength=3.0)
    found = add(fitted(c, "each"), "creep")
    assert "creep(joints=each)" in [e.name for e in candidates(found)]
    alternative = StepwiseAlternatives(found).of("creep")
    assert not any("creep" in name for name in (*alternative.same_as, *alternative.others))


def test_only_what_is_finer_takes_the_place_of_an_effect(arm):
    halves = fitted(arm, "1-3/4-6")
    assert add(halves, "joint_compliance(joints=1/2/3/4-6)").model.effects[-1].options == {
        "joints": "1/2/3/4-6"
    }
    for other in ("joint_compliance", "joint_compliance(joints=common)"):
        with pytest.raises(InputError, match="joint_compliance is in the model already"):
            add(halves, other)
    with pytest.raises(InputError, match="joint_compliance is in the model already"):
        add(halves, "joint_compliance", {"joints": "1-2/3-6"})


@pytest.mark.parametrize(
    ("own", "other", "finer_"),
    [
        ("each", "common", True),
        ("each", "1-3/4-6", True),
        ("2/3", "2+3", True),
        ("1/2/3", "2+3", True),
        ("1-2/3-6", "1-3/4-6", False),
        ("2/3", "common", False),
        ("common", "each", False),
        ("each", "each", False),
    ],
)
def test_finer_is_what_splits_groups_and_keeps_joints(arm, own, other, finer_):
    states = arm.readings.states
    one, two = (JointCompliance(arm.cell, states, {"joints": j}) for j in (own, other))
    assert one.refines(two) is finer_
    refined = two.refined(states)
    if refined is not None:
        assert refined.refines(two)
        assert refined.refined(states) is None
