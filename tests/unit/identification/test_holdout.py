"""Poses left out: what is predicted for them is what a refit without them predicts."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.stepwise import add, predicts_better
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import fit
from hilcal.identification.folds import (
    block_folds,
    distinct_poses,
    leave_out,
    ordinary_magnitudes,
    parameter_changes,
    random_folds,
    region_folds,
)
from hilcal.identification.gauss_newton import solve
from hilcal.identification.residual import residual
from studies.study_cases import study_case
from tests.support.campaigns import campaign, configuration
from tests.support.fit_cases import fitted_model


def fitted(mode, m=3, effect="none", **options):
    c = campaign(effect, mode, plan_seed=0, m=m, target_known=mode == "deflection", **options)
    model = with_effects(c.cell, c.readings, mode, ("joint_compliance", "hysteresis"))
    return fit(model, c.readings, mode)


SLOW = [
    pytest.param(*case, marks=pytest.mark.slow) for case in (("absolute", 3), ("deflection", 6))
]


@pytest.mark.parametrize(("mode", "m"), [("absolute", 6), ("deflection", 3), *SLOW])
def test_leaving_out_is_refitting_without(mode, m):
    found = fitted(mode, m)
    readings, w, model = found.readings, found.whitening, found.model
    assert not found.outlier.any()
    fold, of_reading = random_folds(found.pose), random_folds(distinct_poses(readings))
    solution = solve(model, readings, w, found.theta)
    left_out = leave_out(model, solution, fold, w)
    np.testing.assert_allclose(left_out, found.left_out, rtol=0, atol=1e-9)
    changed = parameter_changes(model, solution, fold, w)
    assert len(changed) == 10
    noise, sigma = found.uncertainty.formal, np.sqrt(np.einsum("dii->di", w.covariance))
    known = ordinary_magnitudes(model, found.theta)
    prior = np.where(np.isinf(solution.prior), known, solution.prior)
    moved = []
    for f, change in enumerate(changed):
        rest = readings[of_reading != f]
        refit = fit(model, rest, mode, start=found.theta, prior=prior)
        # One linear step: right to a few per cent of a standard uncertainty, where leaving out
        # moves parameters by one.
        np.testing.assert_allclose(change / noise, (refit.theta - found.theta) / noise, atol=0.06)
        off = residual(readings, model.predict(readings.states, refit.theta), w)
        out = fold == f
        np.testing.assert_allclose((left_out - off)[out] / sigma[out], 0, atol=0.02)
        moved.append((found.raw - off)[out] / sigma[out])
    assert np.abs(np.concatenate(moved)).max() > 0.3


def test_the_error_on_poses_left_out_exceeds_that_of_the_fit_by_what_parameters_cost():
    """Expected squares: 1 − P/R fitted, about 1 + P/R left out."""
    gain, share = [], []
    for seed in range(8):
        c = campaign(seed=seed, plan_seed=0, registration_known=True)
        found = fitted_model(c.cell, c.readings, "absolute", ("joint_compliance", "hysteresis"))
        gain.append(found.holdout.rms_sigma**2 - found.error.rms_sigma**2)
        share.append(12 / (3 * len(c.readings)))
    assert np.mean(gain) == pytest.approx(2 * np.mean(share), rel=0.6)


def repeated(readings):
    """The same poses once more, a little off and under other names."""
    rng = np.random.default_rng(0)
    states = readings.states
    q = np.concatenate([states.q, states.q + rng.uniform(-1e-3, 1e-3, states.q.shape)])
    twice = readings[np.tile(np.arange(len(readings)), 2)]
    count = len(readings.pose_names)
    return replace(
        twice,
        states=replace(twice.states, q=q),
        pose=np.concatenate([readings.pose, readings.pose + count]),
        pose_names=(*readings.pose_names, *(f"again {n}" for n in readings.pose_names)),
    )


def test_repetitions_of_a_pose_stay_together_whatever_their_names():
    c = campaign(plan_seed=0)
    twice = repeated(c.readings)
    n = len(c.readings)
    pose = distinct_poses(twice)
    np.testing.assert_array_equal(pose[:n], pose[n:])
    assert pose.max() + 1 == len(c.readings.pose_names)
    for fold in (random_folds(pose), block_folds(pose), region_folds(twice.states.q, pose)):
        np.testing.assert_array_equal(fold[:n], fold[n:])


@pytest.mark.parametrize("poses", [2, 9, 10, 37])
def test_folds_are_of_equal_size_and_whole_poses(poses):
    pose = np.repeat(np.arange(poses), 3)
    angle = np.random.default_rng(0).normal(size=(poses, 6))[pose]
    folds = (random_folds(pose), block_folds(pose), region_folds(angle, pose))
    sizes = [[len(np.unique(pose[fold == f])) for f in range(fold.max() + 1)] for fold in folds]
    for each in sizes:
        assert sum(each) == poses
        assert len(each) == min(10, poses)
        assert min(each) >= 1
    assert all(max(each) - min(each) <= 1 for each in sizes[:2])
    np.testing.assert_array_equal(random_folds(pose), random_folds(pose))
    assert np.all(np.diff(block_folds(pose)) >= 0)


def test_what_one_pose_alone_shows_of_an_effect_does_not_spoil_the_others():
    """Without pose 19 nothing tells a combination of the backlashes; flat, it erred by 42 σ."""
    config = configuration()
    c = study_case(config, "ur5e", "deflection", ("backlash",), 2.0, 901)
    before = fitted_model(c.cell, c.readings, "deflection")
    found = add(before, "backlash")
    assert found.variance_factor == pytest.approx(1.0, abs=0.15)
    assert found.holdout.rms_sigma < 1.1 < 1.5 < before.holdout.rms_sigma
    assert predicts_better(before, found)
