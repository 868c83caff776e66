"""The arm's scatter: in common to targets of one arrival; where nothing states it, estimated."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2, kstest

import hilcal as hc
from hilcal.diagnosis.diagnosis import History
from hilcal.diagnosis.effect_ranking import candidates
from hilcal.diagnosis.evidence import Evidence
from hilcal.diagnosis.misfit_breakdown import MisfitShare
from hilcal.diagnosis.verdict import diagnose, judge
from hilcal.identification.background import with_background
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import effect_columns, linearise
from hilcal.identification.noise.arm_scatter import estimate_arm_scatter, factors, with_arm_scatter
from hilcal.identification.noise.full_covariance import with_common_scatter, with_joint_scatter
from hilcal.identification.prediction.predictive import predictive_of
from hilcal.identification.prediction.validation import extrapolation, validate
from hilcal.identification.registration.registration import register
from hilcal.present.verdict import message
from hilcal.readings.covariance import COVERS_KEY, INSTRUMENT
from hilcal.readings.readings import ArmScatter
from hilcal.readings.whitening import whitening
from hilcal.robot import se3
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.rows import content_hash
from tests.support.campaigns import cell_of, configuration, noiseless, plan, with_noise, world_of
from tests.support.fit_cases import MODES, fitted_model
from tests.support.reflector_cases import reflectors
from tests.support.rows import first

BOTH = pytest.mark.parametrize("mode", first(1, MODES[::-1]))
STD = 1e-4
"""The arm's scatter, rad: several times the noise of the tracker."""


def dense(readings):
    """(N·m, N·m) covariance of all readings, entry by entry."""
    n, m, arrival = len(readings), readings.m, readings.arrivals
    out = np.zeros((n, m, n, m))
    for i in range(n):
        for j in range(n):
            if i == j:
                out[i, :, i] = readings.covariance[i]
            elif arrival[i] == arrival[j]:
                out[i, :, j] = readings.common[i] @ readings.common[j].T
    return out.reshape(n * m, n * m)


@pytest.mark.parametrize("m", [3, 6])
@BOTH
def test_whitening_is_the_root_of_the_full_covariance(mode, m):
    whole, rng = (
        reflectors(joint_std=STD, m=m, poses=3, cycles=2).readings,
        np.random.default_rng(0),
    )
    # One reflector is lost now and then; shuffled rows.
    rows = rng.permutation(len(whole))[: len(whole) - 9]
    kept = np.union1d(rows, np.flatnonzero(whole.unloaded & (whole.target < 2)))
    r = whole[kept][rng.permutation(len(kept))]
    w = whitening(r, mode)
    raw = w.raw(np.eye(len(r) * m).reshape(len(r), m, -1))
    d, g = (x.reshape(len(w) * m, -1) for x in (raw, w.whiten(raw)))
    np.testing.assert_allclose(g @ dense(r) @ g.T, np.eye(len(g)), atol=1e-8)
    each, of = np.arange(len(w)), (d @ dense(r) @ d.T).reshape(len(w), m, len(w), m)
    np.testing.assert_allclose(of[each, :, each], w.covariance, rtol=1e-8, atol=1e-16)
    if mode == "deflection":
        # Each loaded reading minus the mean of its own target's unloaded ones, and no other.
        used = np.abs(w.raw(np.eye(len(r))[:, None, :].repeat(m, 1))).sum(axis=1) > 0
        for row in used:
            for key in (r.pose, r.cycle, r.target):
                assert len(np.unique(key[row])) == 1


@pytest.mark.long
@BOTH
def test_p_values_and_standard_errors(mode):
    """They are right where an arrival's rows share its scatter; else the errors are understated."""
    p_values, z, apart = [], [], []
    for seed in range(12):
        c = reflectors(seed=seed, poses=8, joint_std=STD, known=(False, False, True))
        true = c.world.physics.joint_compliance
        for readings, errors in ((c.readings, z), (replace(c.readings, common=None), apart)):
            f = fitted_model(c.cell, readings, mode)
            errors.append((f.theta[-6:] - true) / f.uncertainty.formal[-6:])
            if errors is z:
                p_values.append(chi2.sf(f.chi2, f.dof))
    assert kstest(p_values, "uniform").pvalue > 0.01
    # 72 standardised errors: rms within 1 ± 0.25 (3 σ); about √3 where rows count as arrivals.
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.25)
    assert np.sqrt(np.mean(np.square(apart))) > 1.3


def test_repeatability_is_common_to_an_arrival():
    c = reflectors(joint_std=STD, poses=6)
    bare = replace(c.readings, covariance=c.readings.covariance * 0.0, common=None)
    made = with_joint_scatter(c.cell, bare, np.full(6, STD))
    # The world's own mechanics give the same factors but for the arm's elasticity.
    np.testing.assert_allclose(made.common, c.readings.common, atol=0.02 * STD)
    square = made.common @ np.swapaxes(made.common, 1, 2)
    np.testing.assert_allclose(made.covariance, square, atol=1e-18)


def test_stated_covariances_that_include_the_scatter():
    c = reflectors(joint_std=STD, poses=6)
    stated = replace(c.readings, common=None)
    made, more = (with_common_scatter(c.cell, stated, np.full(6, k * STD)) for k in (1, 10))
    np.testing.assert_allclose(made.common, c.readings.common, atol=0.02 * STD)
    # A scatter beyond what is stated is shortened: what is left of each reading stays a covariance.
    left = more.covariance - more.common @ np.swapaxes(more.common, 1, 2)
    assert np.linalg.eigvalsh(left).min() > -1e-9 * np.abs(more.covariance).max()
    one = replace(stated, states=replace(stated.states, target=None))
    assert with_common_scatter(c.cell, one, np.full(6, STD)).common is None


def test_a_hidden_reflector_is_a_missing_reading():
    c = reflectors("base_compliance", strength=5.0, joint_std=1e-5, known=(False, False, True))
    r = c.readings
    third = (r.target == 2) & (r.pose == 3)
    kept = r[~((r.target == 1) & (r.pose % 4 == 0) | third & r.unloaded)]
    f = fitted_model(c.cell, kept, "deflection", ["joint_compliance", "base_compliance"])
    off = f.theta[-3:] - c.world.physics.base_compliance
    assert np.abs(off / f.uncertainty.std[-3:]).max() < 4.0
    assert chi2.sf(f.chi2, f.dof) > 1e-3
    orphans = np.count_nonzero(third & ~r.unloaded)
    assert len(f.whitening) == np.count_nonzero(~kept.unloaded) - orphans


def scattering(std=2e-5, m=3, seed=0, noise=1.0, poses=16, loads=3, law=0.0, draw=None):
    """Each reading is an arrival with joints off by `std` (n,), by the world's own kinematics.

    Joint 2 is off by `law` sin 3 q4 as well, which no effect of the catalogue describes.
    """
    cell, rng, p = cell_of(registration_known=True), np.random.default_rng(seed), plan(poses, loads)
    world = replace(world_of(cell, rng), joint_std=np.broadcast_to(std, 6))
    still = noiseless(replace(world, joint_std=np.zeros(6)), p, m)
    rng = rng if draw is None else np.random.default_rng(draw)
    off = replace(p.states, q=p.states.q + std * rng.standard_normal(p.states.q.shape))
    off.q[:, 1] += law * np.sin(3 * p.states.q[:, 3])
    readings = with_noise(replace(still, value=world.ideal_readings(off).value(m)), rng, noise)
    return cell, replace(readings, scatter_stated=False)


@pytest.mark.parametrize("mode", first(1, ["deflection", "absolute"]))
@pytest.mark.parametrize("m", [3, 6])
def test_the_scatter_comes_out_as_it_is(mode, m):
    truth, z = 2e-5, []
    for seed in range(3):
        s = estimate_arm_scatter(fitted_model(*scattering(truth, m, seed), mode))
        assert s.kind == "joints"
        z.append((s.std[0] - truth) / s.std_error[0])
        assert s.std_error[0] < 0.15 * truth
        assert s.log_evidence > 5
    assert np.sqrt(np.mean(np.square(z))) < 2.2


def test_joints_are_told_apart_where_the_readings_do():
    truth = np.array([6.0, 0.0, 6.0, 0.0, 0.0, 0.0]) * 1e-5
    s = estimate_arm_scatter(fitted_model(*scattering(truth), "absolute"))
    assert s.kind == "each joint"
    off = (np.array(s.std) - truth)[[0, 2]] / np.array(s.std_error)[[0, 2]]
    assert np.all(np.abs(off) < 4)


def judged(mode, std, **more):
    d = diagnose(fitted_model(*scattering(std, **more), mode))
    return d, str(d.to_dict()["message"])


@pytest.mark.long
@BOTH
def test_what_is_left_to_the_arm_is_adequate_and_says_how_much(mode):
    d, words = judged(mode, 2e-5)
    assert (d.verdict, d.reason) == ("adequate", "arm_scatter")
    assert "Nothing recorded predicts it" in words
    assert "Each joint scatters by σ_q =" in words
    assert "the maker states 0.050 mm" in words
    assert d.scatter.size_m == pytest.approx(27e-6, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "reason"), [(1.2e-5, "arm_scatter"), (4e-5, "unknown_effect")])
def test_a_predictable_part_counts_from_a_third_of_the_rest_on(law, reason):
    """The rest moves the target by 27 µm rms, a joint 2 off by 12 µrad by about 6 µm."""
    d, _ = judged("absolute", 2e-5, poses=500, loads=0, law=law)
    assert reason in (d.reason, d.verdict)
    assert d.follows[0] == "joint 4 angle"


@cache
def of_scattering():
    return fitted_model(*scattering(), "absolute")


@pytest.mark.parametrize(("share", "reason"), [(0.09, "arm_scatter"), (0.11, "no_suspect")])
def test_a_negligible_part_that_is_predictable_is_said(share, reason):
    e = Evidence(of_scattering())
    vars(e)["misfit_breakdown"] = (MisfitShare("joint 4 angle", share, 1e-9),)
    d = judge(e, History())
    assert (d.reason, d.predictable_share) == (reason, share)
    said = "rms, follows joint 4 angle on poses left out, which is negligible"
    assert (said in message(d)) == (reason == "arm_scatter")
    if d.scatter is not None:
        assert ArmScatter.from_json(json.loads(json.dumps(d.scatter.to_json()))) == d.scatter


@pytest.mark.parametrize(("sure", "reason"), [(False, "misjudged_noise"), (True, "no_suspect")])
def test_what_chance_lets_a_variable_predict_is_no_missing_effect(sure, reason):
    """Where the stated noise is wrong, tests that trust its covariance find variables by chance."""
    e = Evidence(of_scattering())
    scatter = replace(e.arm_scatter, std=tuple(100 * x for x in e.arm_scatter.std), size_m=1e-2)
    vars(e).update(
        arm_scatter=scatter, misfit_breakdown=(MisfitShare("joint 4 angle", 0.11, 1e-9, sure),)
    )
    assert judge(e, History()).reason == reason


@pytest.mark.long
@BOTH
def test_a_noisier_instrument_is_not_the_arm(mode):
    d, words = judged(mode, 0.0, noise=2.0)
    assert d.verdict == "noise_misjudged"
    assert d.scatter.instrument_factor == pytest.approx(2, rel=0.15)
    assert "and not as if the arm scattered" in words


@pytest.mark.long
def test_no_arm_scatters_by_half_a_millimetre():
    d, words = judged("absolute", 4e-4)
    assert d.verdict == "noise_misjudged"
    assert "the arm or the target was loose" in words


@pytest.mark.long
def test_nor_where_its_scatter_is_in_the_covariance():
    """As beside a background, whose fit estimates the scatter of any size."""
    cell, readings = scattering(4e-4)
    plain = fitted_model(cell, readings, "absolute")
    with_it = with_arm_scatter(plain.model.cell, readings, estimate_arm_scatter(plain))
    d = diagnose(fit(plain.model, with_it, "absolute", start=plain.theta))
    assert (d.verdict, d.scatter) == ("noise_misjudged", with_it.arm_scatter)
    assert "more than an arm's repeatability" in str(d.to_dict()["message"])


@pytest.mark.long
def test_scatter_that_is_stated_is_not_estimated():
    cell, readings = scattering()
    d = diagnose(fitted_model(cell, replace(readings, scatter_stated=True), "absolute"))
    assert d.verdict == "noise_misjudged"
    assert d.scatter is None


@pytest.fixture(scope="module")
def refined(tmp_path_factory):
    """Paths of a refined campaign and of one of the same arm, measured anew, and the last step."""
    (cell, readings), (_, anew) = scattering(), scattering(draw=7)
    folder, config = tmp_path_factory.mktemp("scatter"), configuration()
    base = {
        "base_xyz_m": tuple(cell.registration[:3, 3]),
        "base_rotvec_rad": tuple(se3.rotation_vector(cell.registration[:3, :3])),
    }
    tracker, none = config.tracker.model_copy(update=base), type(config.repeatability)()
    config = config.model_copy(update={"repeatability": none, "tracker": tracker})
    path, other, about = folder / "run.hilcal", folder / "other.hilcal", {COVERS_KEY: INSTRUMENT}
    for name, what in ((path, readings), (other, anew)):
        with CampaignFile.create(
            name, config.to_json(), str(folder), "made", more_texts=about
        ) as file:
            file.append_readings(what)
    with hc.Campaign.open(path) as run:
        assert not run.readings.scatter_stated
        refinement = hc.refine(
            hc.baseline(run.cell, run.readings, "absolute"), run.readings, "absolute"
        )
        first, last = refinement.steps[0], refinement.steps[-1]
        assert (first.diagnosis.reason, last.diagnosis.verdict) == ("arm_scatter", "adequate")
        assert last.added is None
        assert last.fit.variance_factor == pytest.approx(1, abs=0.15)
        assert "Nothing recorded predicts it" in str(last.diagnosis.to_dict()["message"])
        assert content_hash(last.fit.readings) == content_hash(run.readings)
        run.append(refinement)
    return path, other, last


@pytest.mark.long
def test_fresh_readings_scatter_as_the_fit_with_a_background_estimated():
    """Their covariance is that of the instrument: errors were 2.3 times the stated ones."""
    (cell, readings), (_, anew) = scattering(6e-5), scattering(6e-5, draw=7)
    plain = fitted_model(cell, readings, "absolute")
    wide = with_background(plain, plain.model.named)
    validation = validate(wide.model, wide.theta, wide.readings, anew, "absolute")
    beyond = extrapolation(predictive_of(wide), wide.readings, validation)
    assert np.sqrt(np.mean(beyond.z**2)) == pytest.approx(1, abs=0.2)
    assert (
        validation.noise_floor < 0.5 * validation.error.rms_m
    )  # noise alone remains the instrument's


@pytest.mark.long
def test_fresh_readings_scatter_as_the_fit_estimated(refined):
    path, other, last = refined
    validation = hc.validate(path, other)
    assert np.sqrt(np.mean(validation.beyond.z**2)) == pytest.approx(1, abs=0.15)
    assert validation.shares.everything.within > 0.9
    alone = validation.prediction.noise_floor  # of the instrument
    assert np.sqrt(np.mean(validation.beyond.stated_m**2)) > np.hypot(alone, 20e-6)
    with hc.Campaign.open(path) as run:
        stored = run.predictive(run.latest(), *run.restore_model(run.latest()))
    fitted = predictive_of(last.fit)
    assert stored.arm_scatter == fitted.arm_scatter is not None
    assert (stored.noise, stored.factor) == pytest.approx((fitted.noise, fitted.factor), rel=1e-6)


@pytest.mark.long
def test_refine_ends_with_the_scatter_in_the_fit_and_the_file_keeps_it(refined):
    path, _, last = refined
    with hc.Campaign.open(path) as run:
        again = run.fit()
        assert run.latest().has_parent
        assert [r.number for r in run.file.revisions()] == [1, 2]
        np.testing.assert_allclose(again.theta, last.fit.theta, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(again.uncertainty.std, last.fit.uncertainty.std, rtol=1e-6)
        assert again.chi2 == pytest.approx(last.fit.chi2, rel=1e-6)
        assert diagnose(again).verdict == "adequate"


@pytest.mark.parametrize("kind", ["joints", "each joint", "isotropic"])
def test_an_estimate_goes_through_json(kind):
    count = 6 if kind == "each joint" else 1
    s = ArmScatter(kind, (1e-5,) * count, (1e-6,) * count, 2e-5, 4.0, 1.5, predicted_share=0.01)
    assert ArmScatter.from_json(s.to_json()) == s
    cell, readings = scattering(0.0)
    with_it = with_arm_scatter(register(cell, readings).cell, readings, s)
    added = with_it.covariance - readings.covariance
    unit = sum(f @ np.swapaxes(f, 1, 2) for f in factors(cell, readings, kind))
    np.testing.assert_allclose(added, 1e-10 * unit, rtol=1e-6, atol=1e-22)
    np.testing.assert_array_equal(with_it.as_stated().covariance, readings.covariance)


@pytest.mark.parametrize(
    "seeds", [pytest.param(12, marks=pytest.mark.long), pytest.param(300, marks=pytest.mark.slow)]
)
def test_p_values_stay_uniform_with_an_estimated_covariance(seeds):
    """Those of an effect that is not there, with the covariance as estimated each time."""
    p_values = []
    for seed in range(seeds):
        cell, readings = scattering(seed=seed)
        plain = fitted_model(cell, readings, "absolute")
        with_it = with_arm_scatter(plain.model.cell, readings, estimate_arm_scatter(plain))
        fitted = fit(plain.model, with_it, "absolute", start=plain.theta)
        absent = next(e for e in candidates(fitted) if e.name == "joint_tilt_compliance")
        p_values.append(linearise(fitted).score(effect_columns(fitted, absent).white).p_value)
    assert kstest(p_values, "uniform").pvalue > 1e-3


@BOTH
def test_targets_of_one_arrival_have_it_in_common(mode):
    c = reflectors(joint_std=3e-5, poses=8)
    true = replace(c.cell, registration=c.world.registration)
    (f,) = factors(true, c.readings, "joints")
    alone = c.readings.covariance - 9e-10 * f @ np.swapaxes(f, 1, 2)
    readings = replace(c.readings, covariance=alone, common=None, scatter_stated=False)
    plain = fitted_model(c.cell, readings, mode)
    s = estimate_arm_scatter(plain)
    assert s.kind == "joints"
    assert abs(s.std[0] - 3e-5) < 4 * s.std_error[0]
    with_it = with_arm_scatter(plain.model.cell, readings, s)
    assert with_it.common is not None
    fitted = fit(plain.model, with_it, mode, start=plain.theta)
    assert plain.variance_factor > 3
    # Taken for independent, the scatter would leave about a third of the degrees of freedom.
    assert fitted.variance_factor == pytest.approx(1, abs=0.25)


@pytest.mark.long
def test_an_orientation_stated_too_noisy_does_not_hide_the_arm():
    cell, readings = scattering(4e-5, m=6)
    covariance = readings.covariance.copy()
    covariance[:, 3:, 3:] *= 9.0
    stated = replace(readings, covariance=covariance)
    plain = fitted_model(cell, stated, "absolute")
    with_it = with_arm_scatter(plain.model.cell, stated, estimate_arm_scatter(plain))
    fitted = fit(plain.model, with_it, "absolute")
    assert fitted.variance_factor < 0.8
    d = diagnose(fitted)
    assert d.verdict == "adequate"
    assert "stated too large in some of its elements" in str(d.to_dict()["message"])
