"""Gross errors are found, set aside and listed; good readings and laws are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, poisson

from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.fit_document import notes, outliers
from hilcal.identification.outliers.data_snooping import (
    SITE_LEVEL,
    DataSnooping,
    along_one_site,
    linearised,
    site_columns,
)
from hilcal.identification.outliers.least_trimmed_squares import (
    FALSE_ALARMS,
    bulk_scale,
    rejection_limit,
)
from hilcal.identification.registration.misdescription import examine
from hilcal.identification.registration.registration import register
from hilcal.present.verdict import message
from hilcal.readings.whitening import MODES, whitening
from studies.gross_errors import GrossErrorCase, count, spoil
from studies.study_cases import study_case
from tests.support.campaigns import campaign, configuration
from tests.support.fit_cases import fitted_model, refined
from tests.support.rows import first

CONFIG = configuration()
C = campaign(plan_seed=0, poses=30, registration_known=True)


def twelve(mode="absolute", **given):
    return campaign(mode=mode, plan_seed=0, poses=12, **given)


def spoilt(readings, rows, size):
    value, rng = readings.value.copy(), np.random.default_rng(3)
    direction = rng.normal(size=(len(rows), readings.m))
    value[rows] += size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return replace(readings, value=value)


def shifted(readings, rows, shift):
    value = readings.value.copy()
    value[rows, :3] += shift
    return replace(readings, value=value)


@pytest.mark.parametrize("size", first(2, [3e-4, 0.5, 2e-3]))
@pytest.mark.parametrize("mode", MODES)
def test_three_gross_errors_are_set_aside_and_listed(mode, size):
    r, rows = C.readings, [7, 68, 134]
    assert not r.unloaded[rows].any()
    found = fitted_model(C.cell, spoilt(r, rows, size), mode)
    assert np.flatnonzero(found.outlier).tolist() == rows
    kept = r[np.delete(np.arange(150), rows)]
    clean = fitted_model(C.cell, kept, mode)
    assert np.abs((found.theta - clean.theta) / clean.uncertainty.formal).max() < 1e-4
    assert found.chi2 == pytest.approx(clean.chi2, rel=1e-6)
    assert found.dof == clean.dof
    listed = outliers(found)
    names = {(r.pose_names[r.pose[k]], r.load_names[r.load[k]]) for k in rows}
    assert {(o["pose"], o["load"]) for o in listed} == names
    assert min(o["sigma"] for o in listed) > 5
    # No error of the fit counts them; those by which fits are compared do.
    assert found.error.rms_m == pytest.approx(clean.error.rms_m, rel=1e-4)
    assert found.holdout_of_all.max_m > 0.9 * size > 0.9 * found.holdout.max_m


def test_a_gross_error_of_an_unloaded_reading_takes_its_deflections_along():
    assert C.readings.unloaded[45]
    found = fitted_model(C.cell, spoilt(C.readings, [45], 5e-3), "deflection")
    clean = fitted_model(C.cell, C.readings, "deflection")
    assert set(C.readings.pose[found.outlier]) == {C.readings.pose[45]}
    # Four of 120 deflections less.
    assert np.abs((found.theta - clean.theta) / clean.uncertainty.formal).max() < 1.5
    (listed,) = outliers(found)
    assert listed["load"] == "none"
    assert "its 4 deflections set aside with it" in listed["reason"]
    assert listed["sigma"] > 50


@pytest.mark.parametrize("mode", MODES)
def test_gross_errors_say_what_they_look_like(mode):
    r, value = C.readings, C.readings.value.copy()
    far, stale, bare = 7, 21, 33
    assert r.unloaded[[far, stale, bare, 30]].tolist() == [False, False, False, True]
    assert r.pose[30] == r.pose[bare]
    value[far, 2] += 2e-3
    value[stale] = value[stale - 1]
    value[bare] = value[30] + 1e-6
    found = outliers(fitted_model(C.cell, replace(r, value=value), mode))
    listed = {(o["pose"], o["load"]): o["reason"] for o in found}
    reasons = [listed[r.pose_names[r.pose[k]], r.load_names[r.load[k]]] for k in (far, stale, bare)]
    assert len(listed) == 3
    assert reasons[0].endswith("σ off in z")
    assert "equal to the reading before" in reasons[1]
    assert "was the load hung" in reasons[2]


@pytest.mark.parametrize(("m", "factor", "tried"), [(3, 1, 5000), (6, 1, 5000), (3, 4, 2000)])
def test_good_readings_are_called_gross_once_in_a_thousand_campaigns(m, factor, tried):
    """Also beside a misfit twice as wide as the noise, where it is rarer."""
    rng, alarms = np.random.default_rng(m), 0
    for _ in range(tried):
        distance2 = factor * rng.chisquare(m, 150)
        alarms += bool((distance2 > rejection_limit(m, 150, bulk_scale(distance2, m))).any())
    expected = FALSE_ALARMS * tried
    assert alarms <= poisson.isf(1e-4, expected)
    assert factor > 1 or alarms >= poisson.ppf(1e-4, expected)


def test_a_true_effect_is_not_mistaken_for_gross_errors():
    """A bias of the force sensor, too, which looks like bad unloaded readings, pose after pose."""
    cases = []
    for seed, effect in enumerate(("transmission_error", "link_geometry", "hysteresis")):
        c = campaign(effect, seed=seed, plan_seed=0, poses=20, strength=8.0)
        cases.append((c.cell, c.readings, "absolute"))
    for robot, seed in (("ur3e", 11), ("ur10e", 12)):
        of = study_case(CONFIG, robot, "deflection", ("wrench_bias",), 3.0, seed)
        cases.append((of.cell, of.readings, "deflection"))
    assert not any(fitted_model(*case).outlier.any() for case in cases)


SPOILT = [(e, m) for m in MODES for e in ("none", "joint_tilt_compliance", "base_compliance")]
SPOILT += [(e, "absolute") for e in ("hysteresis", "encoder_offset", "link_geometry")]


@pytest.mark.parametrize("m", first(1, [3, 6]))
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("share", "size"), first(2, [(0.4, 5e-3), (0.4, 1e-3), (0.2, 5e-3), (0.3, 5e-2)])
)
def test_all_of_many_gross_errors_are_found(share, size, mode, m):
    c = twelve(mode, m=m)
    r = c.readings
    readings, wrong = spoil(r, share, size, np.random.default_rng(0))
    found = fitted_model(c.cell, readings, mode)
    # The same as without them; deflections go with their unloaded reading.
    out = np.isin(np.arange(len(readings)), wrong)
    if mode == "deflection":
        out |= np.isin(r.pose, r.pose[out & r.unloaded])
        out |= ~np.isin(r.pose, r.pose[~out & ~r.unloaded])
    right = fitted_model(c.cell, r[~out], mode)
    out[np.flatnonzero(~out)[right.outlier]] = True
    np.testing.assert_array_equal(found.outlier, out)
    if m == 3:  # the target's axes, which attitudes show, are those of the registration
        assert found.variance_factor == pytest.approx(right.variance_factor, rel=0.1)


@pytest.mark.parametrize(
    ("seed", "share"), first(1, [(13, 0.4), (22, 0.4), (24, 0.4), (33, 0.4), (5, 0.2)])
)
def test_refine_finds_them_beside_an_effect_and_in_few_poses(seed, share):
    """24 to 180 readings, nothing or an unmodelled effect of 10 to 20 σ."""
    found = count(CONFIG, GrossErrorCase(share, 5e-3, seed))
    assert found.found == found.wrong
    assert found.false <= 0.01 * found.readings
    assert found.outcome != "refused"


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
def test_more_than_can_be_told_is_said(mode):
    c = twelve(mode)
    readings, _ = spoil(c.readings, 0.6, 5e-3, np.random.default_rng(0))
    found = refined(c.cell, readings, mode)
    assert found.verdict == "unknown_effect"
    assert "More than 45 % of the readings disagree" in message(found.diagnosis)
    assert not found.fit.outlier.any()


@pytest.mark.parametrize("of_tool", [False, True])
def test_a_block_off_alike_is_said_and_not_set_aside(of_tool):
    """From one reading to another the shift is the same in the sensor's, or the target's axes."""
    c, rows, shift = twelve(), slice(12, 30), np.array([5e-3, 0.0, 0.0])
    if of_tool:
        model = baseline(c.cell, c.readings, "absolute")
        axes = model.predict(c.readings.states, np.zeros(model.size)).observation.rotation
        shift = axes[rows] @ shift
    found = fitted_model(c.cell, shifted(c.readings, rows, shift), "absolute")
    assert not found.outlier.any()
    np.testing.assert_array_equal(found.disagreement.rows, np.arange(12, 30))
    assert any("are off by the same shift" in note for note in notes(found))


def test_a_registration_does_not_follow_errors_of_centimetres():
    c = twelve()
    readings, wrong = spoil(c.readings, 0.4, 5e-2, np.random.default_rng(0))
    found = register(c.cell, readings)
    np.testing.assert_array_equal(np.flatnonzero(found.far), np.sort(wrong))
    assert found.rms < 1.1 * register(c.cell, c.readings).rms + 1e-4
    finding = examine(found, readings)
    assert not finding.refused


APART = np.arange(400)


def directions(rng, *shape):
    x = rng.normal(size=shape)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def drawn(rng, number, size):
    """Shifts of a size in random directions, and those of ten sites."""
    return size * directions(rng, number, 3), directions(rng, number, 3, 10)


def test_random_errors_are_along_no_site():
    rng, tried = np.random.default_rng(0), 400
    wrong = sum(
        bool(along_one_site(*drawn(rng, number, size), APART[:number]).any())
        for number in (1, 5, 40, 80)
        for size in np.geomspace(6, 600, tried // 4)
    )
    assert binom.sf(wrong - 1, tried, SITE_LEVEL) > 1e-3


@pytest.mark.parametrize("sizes", [[100.0] * 6, [100, 50, -100, 60, 30, -80]])
def test_one_pose_is_no_law(sizes):
    """One wrong reference there, or errors along an axis of the sensor that is a site's as well."""
    rng = np.random.default_rng(2)
    columns = np.repeat(directions(rng, 1, 3, 10), 6, axis=0)
    shift = np.array(sizes)[:, None] * columns[:, :, 3] + rng.normal(size=(6, 3))
    assert along_one_site(shift, columns, np.arange(6)).all()
    assert not along_one_site(shift, columns, np.zeros(6, dtype=int)).any()


def one_sided(model, readings, size, joint):
    """Return readings of an arm with one joint that yields to torques of one sign alone."""
    theta = np.zeros(model.size)
    p = model.predict(readings.states, theta)
    turn = site_columns(model, theta, p, readings)[:, :, 3 * joint + 2]
    torque = p.situation.torque[:, joint]
    moved = turn * np.maximum(torque - np.median(torque), 0.0)[:, None]
    moved *= size / np.sqrt(np.mean(moved**2))
    return replace(readings, value=readings.value + moved)


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_a_law_of_one_joint_is_not_set_aside(joint):
    c = twelve("deflection")
    model = baseline(c.cell, c.readings, "deflection")
    found = fit(model, one_sided(model, c.readings, 1e-3, joint), "deflection")
    assert not found.outlier.any()


def test_gross_errors_beside_such_a_law_are_found():
    c = twelve("deflection")
    model = baseline(c.cell, c.readings, "deflection")
    r, wrong = spoil(one_sided(model, c.readings, 60e-6, 1), 0.2, 5e-3, np.random.default_rng(0))
    found = fit(model, r, "deflection")
    assert found.outlier[wrong].mean() >= 0.95
    lost = np.isin(r.pose, r.pose[wrong[r.unloaded[wrong]]])  # with their unloaded reading
    assert not found.outlier[~lost & ~np.isin(np.arange(len(r)), wrong)].any()


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_a_step_of_the_linear_model_is_that_of_the_fit(mode, m):
    """At the minimum of a fit the step is zero, deflections through their offset as well."""
    c = campaign("none", mode, poses=12, m=m)
    found = fitted_model(c.cell, c.readings, mode)
    y = found.solution.y
    of = linearised(DataSnooping(found.model, c.readings, mode, found.solution, y), y).linear
    delta, covariance = of.fitted(of.tested)
    assert np.abs(delta / np.sqrt(np.diagonal(covariance))).max() < 1e-2
    left = of.residuals(of.tested)
    assert np.sum(left**2) == pytest.approx(found.chi2, rel=1e-3)
    assert len(whitening(c.readings, mode)) == np.count_nonzero(of.tested) - len(of.members)
