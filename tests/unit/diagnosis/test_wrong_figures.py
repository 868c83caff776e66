"""A load's or the tool's mass that was entered wrongly is asked before any effect is named."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.wrong_figures import BIC_MARGIN, criterion, wrong_figures
from hilcal.effects.protocol import EffectSpec
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit_again
from hilcal.model.model import Model
from hilcal.present.verdict import message
from hilcal.robot.chain import evaluate
from studies.study_cases import study_case
from tests.support.campaigns import NO_EFFECT, campaign, configuration
from tests.support.fit_cases import refined
from tests.support.rows import first


def doubled(readings, load):
    wrench = readings.states.wrench.copy()
    wrench[readings.load == readings.load_names.index(load)] *= 2
    return replace(readings, states=replace(readings.states, wrench=wrench))


def judged(cell, readings, mode):
    return hc.diagnose(hc.fit(baseline(cell, readings, mode), readings, mode))


@pytest.mark.parametrize("mode", first(1, ["absolute", "deflection"]))
@pytest.mark.parametrize(
    ("load", "hidden", "said", "true"),
    [
        ("5kg", NO_EFFECT, "Load '5kg' seems to weigh", 5.0),
        ("10kg", "backlash", "Load '10kg' seems to weigh", 10.0),
        ("pull x", NO_EFFECT, "Load 'pull x' seems to pull with", 80.0),
    ],
)
def test_a_load_at_twice_its_weight_is_named(mode, load, hidden, said, true):
    """Also where all its readings were taken for gross errors, and beside a hidden effect."""
    c = campaign(hidden, mode, 1, poses=20)
    d = judged(c.cell, doubled(c.readings, load), mode)
    assert d.reason == "wrong_figure", message(d)
    (figure,) = d.wrong_figures
    assert figure.stated == pytest.approx((2 * true,))
    assert figure.found == pytest.approx((true,), rel=0.15)
    assert message(d).startswith(said)
    assert not d.suspects


@pytest.mark.parametrize("load", first(1, ["5kg", "pull x"]))
@pytest.mark.parametrize("factor", first(1, [0.5, 2.0]))
def test_a_single_load_is_told_by_the_weight_of_the_arm(load, factor):
    """Not of deflections: there it is a common factor of all compliances."""
    c = campaign("backlash", "absolute", 1, poses=20)
    number = c.readings.load_names.index(load)
    readings = c.readings[np.isin(c.readings.load, [0, number])]
    wrench = readings.states.wrench.copy()
    wrench[readings.load == number] *= factor
    wrong = replace(readings, states=replace(readings.states, wrench=wrench))
    (figure,) = judged(c.cell, wrong, "absolute").wrong_figures
    assert np.divide(figure.stated, figure.found) == pytest.approx(factor, rel=0.2)
    assert not judged(c.cell, readings, "absolute").wrong_figures
    assert not judged(c.cell, wrong, "deflection").wrong_figures


@pytest.mark.parametrize("at", ["refit", "derivative"])
def test_a_figure_without_an_equilibrium_explains_nothing(monkeypatch, at):
    """A trial that does not settle ends no diagnosis; a fit may be that close to the edge."""
    c = campaign(NO_EFFECT, "absolute", 1, poses=20)
    spoilt = doubled(c.readings, "5kg")
    fitted = hc.fit(baseline(c.cell, spoilt, "absolute"), spoilt, "absolute")
    tried = []

    def unsettled(*args, **more):
        tried.append(args)
        raise CannotAnswerError("no static equilibrium")

    module = sys.modules[wrong_figures.__module__]
    monkeypatch.setattr(*((module, "fit") if at == "refit" else (Model, "predict")), unsettled)
    assert wrong_figures(fitted, ()) == ()
    assert tried


@pytest.mark.long
def test_a_tool_at_twice_its_mass_is_named_and_refine_adds_nothing():
    c = campaign(NO_EFFECT, "absolute", 1, poses=20)
    cell = replace(c.cell, tool_mass=2 * c.cell.tool_mass)
    refinement = refined(cell, c.readings, "absolute")
    (step,) = refinement.steps
    assert refinement.verdict == "ambiguous"
    assert message(step.diagnosis).startswith("The tool seems to weigh 0.8")
    assert "correct [tool] mass_kg" in message(step.diagnosis)
    (figure,) = step.diagnosis.to_dict()["wrong_figures"]
    assert (figure["kind"], figure["unit"]) == ("tool_mass", "kg")


@pytest.mark.long
def test_a_tool_elsewhere_than_stated_is_named():
    c = campaign(NO_EFFECT, "absolute", 1, poses=20)
    shift = np.array([0.0, 0.3, 0.0])
    d = judged(replace(c.cell, tool_com=c.cell.tool_com + shift), c.readings, "absolute")
    assert [f.kind for f in d.wrong_figures] == ["tool_com"]
    off = np.subtract(d.wrong_figures[0].found, d.wrong_figures[0].stated)
    np.testing.assert_allclose(off, -shift, atol=0.05)


@pytest.mark.parametrize(
    "effect", first(1, ["link_mass", "wrench_gain", "load_point", "joint_stiffening"])
)
def test_effects_are_no_wrong_figures(effect):
    """Of 63 campaigns with 19 effects of 3 and 6 σ, none was one, nor on the way to the model."""
    mode = "deflection" if effect == "wrench_gain" else "absolute"
    c = campaign(effect, mode, 1, poses=16)
    d = judged(c.cell, c.readings, mode)
    assert d.suspects[0].effect == effect, message(d)


@pytest.mark.parametrize(("poses", "seed"), first(1, [(10, 0), (12, 2), (12, 13)]))
def test_an_impossible_tool_does_not_explain_few_readings(poses, seed):
    """It did, with a centre of mass metres away, in 20 of 20 such campaigns of 10 poses."""
    hidden = ("link_geometry", "transmission_error")
    c = study_case(configuration(), "ur10e", "absolute", hidden, 15.0, seed, n_poses=poses)
    r = c.readings[np.isin(c.readings.load, (0, 2))]
    model = baseline(c.cell, r, "absolute") + EffectSpec("link_geometry")
    assert hc.diagnose(hc.fit(model, r, "absolute")).wrong_figures == ()


@pytest.mark.long
def test_a_gain_of_loads_that_nothing_measured_is_one_of_their_masses():
    """Too small to be a mistake of one figure; all masses are."""
    c = campaign(NO_EFFECT, "absolute", 1, poses=20)
    weights = np.isin(c.readings.load, [0, *map(c.readings.load_names.index, ("5kg", "10kg"))])
    light = replace(c.readings.states, wrench=c.readings.states.wrench / 1.1)
    readings = replace(c.readings, states=light)
    said = r"wrench_gain may stand for masses .* by a factor of 1\.(0[6-9]|1)\d* on average"
    for chosen, hang in ((readings[weights], True), (readings, False)):  # the others pull
        fit = hc.fit(baseline(c.cell, chosen, "absolute"), chosen, "absolute")
        gained = add(fit, "wrench_gain")
        assert bool(re.search(said, message(hc.diagnose(gained)))) == hang


def test_a_figure_that_sets_readings_aside_does_not_explain_them():
    c = campaign("backlash", "deflection", 1, poses=10)
    stated = hc.fit(baseline(c.cell, c.readings, "deflection"), c.readings, "deflection")
    aside = stated.outlier | (c.readings.load == c.readings.load_names.index("5kg"))
    right = add(stated, "backlash")
    assert criterion(stated, right, 2) < -BIC_MARGIN
    assert criterion(stated, fit_again(right, outlier=aside), 2) > -BIC_MARGIN


def test_a_figure_with_which_the_other_readings_fit_worse_is_rejected():
    """Gross errors that the stated fit sets aside, and a refit that bends to them, do not count."""
    c = campaign(NO_EFFECT, "absolute", 1, poses=12)
    value = c.readings.value.copy()
    value[:6] += 2e-3 * np.random.default_rng(0).standard_normal((6, 3))
    readings = replace(c.readings, value=value)
    stated = hc.fit(baseline(c.cell, readings, "absolute"), readings, "absolute")
    assert stated.outlier[:6].all()
    bent = fit_again(stated, outlier=np.zeros(len(readings), dtype=np.bool_))
    assert bent.error.rms_m > 2 * stated.error.rms_m
    assert criterion(stated, bent, 1, least_share=0.0) is None


def mounted(c, gravity):
    """Describe a campaign under weights as if gravity were another one in base axes."""
    readings = c.readings[np.isin(c.readings.load, [0, 1, 2])]
    assert {"5kg", "10kg"} == {readings.load_names[k] for k in (1, 2)}
    wrench, g = readings.states.wrench.copy(), np.linalg.norm(c.cell.gravity)
    wrench[:, :3] = np.linalg.norm(wrench[:, :3], axis=1, keepdims=True) * np.array(gravity) / g
    return replace(c.cell, gravity=np.array(gravity)), replace(
        readings, states=replace(readings.states, wrench=wrench)
    )


@pytest.mark.parametrize("mode", first(1, ["absolute", "deflection"]))
@pytest.mark.parametrize("stated", first(1, [[0, 0, 9.80665], [9.0, 0.0, 3.8], [0, -9.80665, 0]]))
def test_gravity_elsewhere_than_stated_is_named(mode, stated):
    """An arm that hangs, or stands on a wall; of one upside down all signs change, no residual."""
    c = campaign(NO_EFFECT, mode, 1, poses=20)
    d = judged(*mounted(c, stated), mode)
    assert [f.kind for f in d.wrong_figures] == ["gravity"], message(d)
    assert d.wrong_figures[0].stated == pytest.approx(stated)
    assert d.wrong_figures[0].found == pytest.approx(c.cell.gravity, abs=0.3)
    assert "[robot] gravity_m_s2" in message(d)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axes", ["base", "flange"])
@pytest.mark.parametrize("mode", first(1, ["absolute", "deflection"]))
def test_forces_of_the_other_sign_or_in_flange_axes_are_named(mode, axes, sign):
    """Pulls alone; in absolute readings the arm's own weight tells their sign, too."""
    c = campaign(NO_EFFECT, mode, 1, poses=20)
    pulls = [k for k, name in enumerate(c.readings.load_names) if name.startswith("pull")]
    readings = c.readings[np.isin(c.readings.load, [0, *pulls])]
    wrench = sign * readings.states.wrench
    if axes == "flange":
        flange = evaluate(c.cell.arm, readings.states.q).rotation[-1]
        wrench = np.einsum("nji,nkj->nki", flange, wrench.reshape(-1, 2, 3)).reshape(-1, 6)
    readings = replace(readings, states=replace(readings.states, wrench=wrench))
    d = judged(c.cell, readings, mode)
    if (axes, sign) == ("base", 1.0):
        assert not d.wrong_figures
        return
    (figure,) = d.wrong_figures
    assert (figure.kind, figure.found) == ("forces" if axes == "base" else "force_axes", (sign,)), (
        message(d)
    )
    assert ("in flange axes" in message(d)) == (axes == "flange")
    assert ("of the other sign" in message(d)) == (sign < 0)


@pytest.mark.parametrize("mode", first(1, ["absolute", "deflection"]))
def test_gravity_as_stated_is_no_wrong_figure(mode):
    """Of a base that tilts by 3°, which effects such as `base_compliance` are alike."""
    c = campaign(NO_EFFECT, mode, 1, poses=20)
    tilted = 9.80665 * np.array([np.sin(0.05), 0.0, -np.cos(0.05)])
    for gravity in (c.cell.gravity, tilted):
        assert not judged(*mounted(c, gravity), mode).wrong_figures
