"""Gross errors are found, set aside and listed; good readings and laws are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, poisson

from hilcal.diagnosis.verdict import diagnose
from hilcal.errors import InputError
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
    ReadingModel,
    bulk_scale,
    rejection_limit,
)
from hilcal.identification.registration.misdescription import examine
from hilcal.identification.registration.registration import register
from hilcal.present.verdict import message
from hilcal.readings.whitening import MODES, whitening, whitening_matrix
from studies.gross_errors import GrossErrorCase, count, spoil
from studies.study_cases import study_case
from tests.support.campaigns import campaign, configuration, noiseless, plan, with_noise
from tests.support.fit_cases import fitted_model, refined
from tests.support.reflector_cases import reflectors
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


@pytest.mark.parametrize("size", first(1, [3e-4, 0.5, 2e-3]))
@pytest.mark.parametrize("mode", MODES)
def test_three_gross_errors_are_set_aside_and_listed(mode, size):
    r, rows = C.readings, [7, 68, 134]
    assert not r.unloaded[rows].any()
    fitted = fitted_model(C.cell, spoilt(r, rows, size), mode)
    assert np.flatnonzero(fitted.outlier).tolist() == rows
    kept = r[np.delete(np.arange(150), rows)]
    clean = fitted_model(C.cell, kept, mode)
    assert np.abs((fitted.theta - clean.theta) / clean.uncertainty.formal).max() < 1e-4
    assert fitted.chi2 == pytest.approx(clean.chi2, rel=1e-6)
    assert fitted.dof == clean.dof
    listed = outliers(fitted)
    names = {(r.pose_names[r.pose[k]], r.load_names[r.load[k]]) for k in rows}
    assert {(o["pose"], o["load"]) for o in listed} == names
    assert min(o["sigma"] for o in listed) > 5
    # No error of the fit counts them; those by which fits are compared do.
    assert fitted.error.rms_m == pytest.approx(clean.error.rms_m, rel=1e-4)
    assert fitted.holdout_of_all.max_m > 0.9 * size > 0.9 * fitted.holdout.max_m


def test_a_gross_error_of_an_unloaded_reading_takes_its_deflections_along():
    assert C.readings.unloaded[45]
    fitted = fitted_model(C.cell, spoilt(C.readings, [45], 5e-3), "deflection")
    clean = fitted_model(C.cell, C.readings, "deflection")
    assert set(C.readings.pose[fitted.outlier]) == {C.readings.pose[45]}
    # Four of 120 deflections less.
    assert np.abs((fitted.theta - clean.theta) / clean.uncertainty.formal).max() < 1.5
    (listed,) = outliers(fitted)
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
    set_aside = outliers(fitted_model(C.cell, replace(r, value=value), mode))
    listed = {(o["pose"], o["load"]): o["reason"] for o in set_aside}
    reasons = [listed[r.pose_names[r.pose[k]], r.load_names[r.load[k]]] for k in (far, stale, bare)]
    assert len(listed) == 3
    assert reasons[0].endswith("σ off in z")
    assert "equal to the reading before" in reasons[1]
    assert "was the load hung" in reasons[2]


@pytest.mark.long
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


@pytest.mark.parametrize(
    "tried", [pytest.param(50, marks=pytest.mark.long), pytest.param(200, marks=pytest.mark.slow)]
)
def test_clean_campaigns_keep_all_their_readings(tried):
    c, rng = campaign(plan_seed=0, registration_known=True), np.random.default_rng(1)
    model, clean = baseline(c.cell, c.readings, "absolute"), noiseless(c.world, plan())
    start = np.zeros(model.size)
    fits = (fit(model, with_noise(clean, rng), "absolute", start=start) for _ in range(tried))
    assert sum(bool(f.outlier.any()) for f in fits) <= poisson.isf(1e-3, FALSE_ALARMS * tried)


def test_the_limit_moves_away_gradually_as_the_bulk_grows_beyond_chance():
    far = [rejection_limit(3, 150, scale) for scale in (1.0, 1.2, 1.31, 1.4, 1.5, 2.0)]
    assert far == sorted(far)
    assert far[2] < 2.1 * far[0]
    for k, factor in ((1, 1.2), (4, 1.5 * 2.5**2), (5, 2.0 * 2.5**2)):
        assert far[k] == pytest.approx(factor * far[0])


@pytest.mark.long
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


def gross(r, rng, share=0.05):
    """Far off by 10 to 1000 σ, the load not hung, or the reading before once more."""
    value, what = r.value.copy(), {}
    for row in np.sort(rng.choice(np.arange(1, len(r)), int(share * len(r)), replace=False)):
        kind = rng.choice(["far", "far" if r.unloaded[row] else "not hung", "stale"])
        if kind == "far":
            direction = rng.normal(size=3)
            std = np.sqrt(np.trace(r.covariance[row, :3, :3]) / 3)
            size = std * 10 ** rng.uniform(1, 3)
            value[row, :3] += size * direction / np.linalg.norm(direction)
        elif kind == "not hung":
            same = (r.pose == r.pose[row]) & (r.cycle == r.cycle[row]) & r.unloaded
            error = np.linalg.cholesky(r.covariance[row]) @ rng.normal(size=r.m)
            value[row] = r.value[np.flatnonzero(same)[0]] + error
        else:
            value[row] = r.value[row - 1]
        what[int(row)] = str(kind)
    return replace(r, value=value), what


def check_verdict(effect, mode, seed):
    c = campaign(effect, mode, seed, poses=30)
    r = c.readings

    def judged(readings):
        d = diagnose(fitted_model(c.cell, readings, mode))
        return d.verdict, d.significant[:1]

    wrong, what = gross(r, np.random.default_rng(1000 + seed))
    verdict = judged(wrong)
    if verdict != judged(r):
        # Near a limit, what remains may say less, or more, than all: not because of the errors.
        lost = np.isin(np.arange(len(r)), list(what))
        if mode == "deflection":  # they go with their unloaded reading
            lost |= np.isin(r.pose, r.pose[lost & r.unloaded])
        assert verdict == judged(r[~lost]), what


SPOILT = [(e, m) for m in MODES for e in ("none", "joint_tilt_compliance", "base_compliance")]
SPOILT += [(e, "absolute") for e in ("hysteresis", "encoder_offset", "link_geometry")]
FAST = (
    *(("base_compliance", "absolute"), ("hysteresis", "absolute"), ("link_geometry", "absolute")),
    *(("none", "deflection"), ("joint_tilt_compliance", "deflection")),
)
"""One of each kind every time; all of them over many seeds in the slow suite."""


@pytest.mark.parametrize(
    ("effect", "mode", "seeds"),
    [
        *first(2, [(*each, 1) for each in FAST]),
        *(pytest.param(*each, 15, marks=pytest.mark.slow) for each in SPOILT),
    ],
)
def test_a_twentieth_of_gross_errors_changes_no_verdict(effect, mode, seeds):
    for seed in range(seeds):
        check_verdict(effect, mode, seed)


@pytest.mark.parametrize("m", first(1, [3, 6]))
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("share", "size"), first(1, [(0.4, 5e-3), (0.4, 1e-3), (0.2, 5e-3), (0.3, 5e-2)])
)
def test_all_of_many_gross_errors_are_found(share, size, mode, m):
    c = twelve(mode, m=m)
    r = c.readings
    readings, wrong = spoil(r, share, size, np.random.default_rng(0))
    fitted = fitted_model(c.cell, readings, mode)
    # The same as without them; deflections go with their unloaded reading.
    out = np.isin(np.arange(len(readings)), wrong)
    if mode == "deflection":
        out |= np.isin(r.pose, r.pose[out & r.unloaded])
        out |= ~np.isin(r.pose, r.pose[~out & ~r.unloaded])
    right = fitted_model(c.cell, r[~out], mode)
    out[np.flatnonzero(~out)[right.outlier]] = True
    np.testing.assert_array_equal(fitted.outlier, out)
    if m == 3:  # the target's axes, which attitudes show, are those of the registration
        assert fitted.variance_factor == pytest.approx(right.variance_factor, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "share"), [(13, 0.4), (22, 0.4), (24, 0.4), (33, 0.4), (5, 0.2)])
def test_refine_finds_them_beside_an_effect_and_in_few_poses(seed, share):
    """24 to 180 readings, nothing or an unmodelled effect of 10 to 20 σ."""
    counts = count(CONFIG, GrossErrorCase(share, 5e-3, seed))
    assert counts.found == counts.wrong
    assert counts.false <= 0.01 * counts.readings
    assert counts.outcome != "refused"


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
def test_more_than_can_be_told_is_said(mode):
    c = twelve(mode)
    readings, _ = spoil(c.readings, 0.6, 5e-3, np.random.default_rng(0))
    refinement = refined(c.cell, readings, mode)
    assert refinement.verdict == "unknown_effect"
    assert "More than 45 % of the readings disagree" in message(refinement.diagnosis)
    assert not refinement.fit.outlier.any()


@pytest.mark.parametrize(
    ("kind", "size", "angle", "every"),
    [("many", 5e-3, lambda q: np.sin(2 * q[:, 0]), False),
     pytest.param("alike", 1e-3, lambda q: np.maximum(np.sin(q[:, 1]), 0.0), True,
                  marks=pytest.mark.long)],
)  # fmt: skip
def test_readings_that_follow_the_state_are_not_called_wrong(kind, size, angle, every):
    """A law of one angle, which every reading of a pose has in common."""
    r = C.readings[C.readings.pose < 20] if every else C.readings[C.readings.unloaded]
    value = r.value.copy()
    value[:, 1] += size * angle(r.states.q)
    fitted = fitted_model(C.cell, replace(r, value=value), "absolute")
    assert fitted.disagreement.kind == kind
    d = diagnose(fitted)
    assert (d.verdict, d.reason) == ("unknown_effect", "no_suspect")
    assert d.follows[0] in message(d)


@pytest.mark.parametrize("of_tool", [False, True])
def test_a_block_off_alike_is_said_and_not_set_aside(of_tool):
    """From one reading to another the shift is the same in the sensor's, or the target's axes."""
    c, rows, shift = twelve(), slice(12, 30), np.array([5e-3, 0.0, 0.0])
    if of_tool:
        model = baseline(c.cell, c.readings, "absolute")
        axes = model.predict(c.readings.states, np.zeros(model.size)).observation.rotation
        shift = axes[rows] @ shift
    fitted = fitted_model(c.cell, shifted(c.readings, rows, shift), "absolute")
    assert not fitted.outlier.any()
    np.testing.assert_array_equal(fitted.disagreement.rows, np.arange(12, 30))
    assert any("are off by the same shift" in note for note in notes(fitted))


def test_a_block_is_not_taken_for_random_errors_among_such():
    c = twelve()
    readings, wrong = spoil(c.readings, 0.1, 5e-3, np.random.default_rng(1))
    fitted = fitted_model(
        c.cell, shifted(readings, slice(20, 32), np.array([0, 0, -8e-3])), "absolute"
    )
    inside = (wrong >= 20) & (wrong < 32)
    assert fitted.outlier[wrong[~inside]].all()
    assert fitted.disagreement is not None
    assert fitted.outlier[20:32].sum() <= inside.sum()


def test_an_unloaded_reading_that_several_deflections_share():
    c = twelve("deflection")
    rows, value = np.flatnonzero(c.readings.unloaded)[::4], c.readings.value.copy()
    value[rows] += 5e-3 * np.random.default_rng(0).normal(size=(len(rows), 3))
    fitted = fitted_model(c.cell, replace(c.readings, value=value), "deflection")
    expected = np.isin(c.readings.pose, c.readings.pose[rows])
    np.testing.assert_array_equal(fitted.outlier, expected)


@pytest.mark.parametrize("mode", first(1, MODES))
def test_readings_of_several_targets(mode):
    c = reflectors(poses=10)
    readings, wrong = spoil(c.readings, 0.3, 5e-3, np.random.default_rng(0))
    assert fitted_model(c.cell, readings, mode).outlier[wrong].all()


def test_a_registration_does_not_follow_errors_of_centimetres():
    c = twelve()
    readings, wrong = spoil(c.readings, 0.4, 5e-2, np.random.default_rng(0))
    registered = register(c.cell, readings)
    np.testing.assert_array_equal(np.flatnonzero(registered.far), np.sort(wrong))
    assert registered.rms < 1.1 * register(c.cell, c.readings).rms + 1e-4
    finding = examine(registered, readings)
    assert not finding.refused


@pytest.mark.long
def test_a_block_off_by_centimetres_is_refused():
    readings = shifted(twelve().readings, slice(12, 30), np.array([0.05, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"rows do not fit|Nothing that was tried"):
        baseline(twelve().cell, readings, "absolute")


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


@pytest.mark.parametrize("joint", first(1, [1, 2, 3]))
def test_a_law_of_one_joint_is_not_set_aside(joint):
    c = twelve("deflection")
    model = baseline(c.cell, c.readings, "deflection")
    fitted = fit(model, one_sided(model, c.readings, 1e-3, joint), "deflection")
    assert not fitted.outlier.any()


def test_gross_errors_beside_such_a_law_are_found():
    c = twelve("deflection")
    model = baseline(c.cell, c.readings, "deflection")
    r, wrong = spoil(one_sided(model, c.readings, 60e-6, 1), 0.2, 5e-3, np.random.default_rng(0))
    fitted = fit(model, r, "deflection")
    assert fitted.outlier[wrong].mean() >= 0.95
    lost = np.isin(r.pose, r.pose[wrong[r.unloaded[wrong]]])  # with their unloaded reading
    assert not fitted.outlier[~lost & ~np.isin(np.arange(len(r)), wrong)].any()


def random_model(mode, rng):
    """30 readings; as deflections in groups of an unloaded and four or five loaded ones."""
    n, m, k = 30, 3, 4
    covariance = rng.normal(size=(n, m, m))
    root = whitening_matrix(covariance @ covariance.swapaxes(1, 2) + 0.1 * np.eye(m))
    members = np.arange(n).reshape(5, 6)
    members[2, 5] = -1
    return ReadingModel(
        residual=(root @ rng.normal(size=(n, m, 1)))[:, :, 0],
        columns=root @ rng.normal(size=(n, m, k)),
        precision=np.array([0.0, 0.0, 0.0, 2.0]),
        pull=np.array([0.0, 0.0, 0.0, 0.7]),
        root=root,
        members=members if mode == "deflection" else np.zeros((0, 0), dtype=np.int64),
    )


@pytest.mark.parametrize("mode", MODES)
def test_distances_are_those_of_least_squares_without_the_reading(mode):
    rng = np.random.default_rng(1)
    of = random_model(mode, rng)
    used = of.tested & (rng.random(len(of)) < 0.7)
    distances, groups = of.distances(used), len(of.members)
    offsets = np.zeros((len(of), 3, 3 * groups))
    for k in np.flatnonzero(of.group >= 0):
        offsets[k, :, 3 * of.group[k] : 3 * of.group[k] + 3] = of.root[k]
    b = np.concatenate([of.columns, offsets], axis=2)
    prior, pull = (np.append(x, np.zeros(3 * groups)) for x in (of.precision, of.pull))
    for k in np.flatnonzero(of.tested):
        rest = used.copy()
        rest[k] = False
        rows = b[rest].reshape(-1, b.shape[2])
        c = np.linalg.inv(rows.T @ rows + np.diag(prior))
        delta = c @ (rows.T @ of.residual[rest].reshape(-1) - pull)
        off = of.residual[k] - b[k] @ delta
        exact = off @ np.linalg.solve(np.eye(3) + b[k] @ c @ b[k].T, off)
        assert distances[k] == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_a_step_of_the_linear_model_is_that_of_the_fit(mode, m):
    """At the minimum of a fit the step is zero, deflections through their offset as well."""
    c = campaign("none", mode, poses=12, m=m)
    fitted = fitted_model(c.cell, c.readings, mode)
    y = fitted.solution.y
    of = linearised(DataSnooping(fitted.model, c.readings, mode, fitted.solution, y), y).linear
    assert np.abs(of.columns @ of.fitted(of.tested)).max() < 1e-2  # standard deviations of noise
    left = of.residuals(of.tested)
    assert np.sum(left**2) == pytest.approx(fitted.chi2, rel=1e-3)
    assert len(whitening(c.readings, mode)) == np.count_nonzero(of.tested) - len(of.members)
