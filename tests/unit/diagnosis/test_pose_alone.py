"""Constants of poses against dense algebra; a misfit that depends on the pose alone."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.diagnosis import in_doubt
from hilcal.diagnosis.misfit_breakdown import pose_constants
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.present.verdict import message
from tests.support.campaigns import campaign, measured, plan
from tests.support.fit_cases import fitted_model


def dense(p):
    """Orthonormal basis (R, K) of the constants beside the model."""
    f, w = p.fit, p.fit.whitening
    poses = int(f.pose.max()) + 1
    raw = np.zeros((len(f.pose), w.m, poses, 3))
    axes = f.solution.prediction.observation.axes[w.reading]
    for k, pose in enumerate(f.pose):
        raw[k, :3, pose] = axes[k]
    free = p.project_out(w.whiten(raw.reshape(len(raw), w.m, -1)))
    u, s, _ = np.linalg.svd(free, full_matrices=False)
    return np.asarray(u[:, s > 1e-6 * s.max()])


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
@pytest.mark.parametrize("effects", [None, ("transmission_error", "joint_compliance")])
def test_equal_to_dense_columns(mode, effects):
    c = campaign("creep", mode, 0, poses=12)
    some = baseline(c.cell, c.readings, mode)
    model = some if effects is None else with_effects(c.cell, c.readings, mode, effects)
    p = linearise(fit(model, c.readings, mode))
    found, u = pose_constants(p), dense(p)
    assert found.rank == u.shape[1]
    if mode == "absolute" and effects is None:  # a shift of the base is one of all poses
        assert found.rank < 36
    assert found.gain == pytest.approx(float(np.sum((u.T @ p.residual) ** 2)), rel=1e-6)
    x = np.random.default_rng(0).standard_normal((len(p.residual), 4))
    assert found.square(x) == pytest.approx(float(np.sum((u.T @ x) ** 2)), rel=1e-6)


def fine_error(seed, first):
    """Thirty poses; a transmission error of 2 σ with the harmonics from `first` to 21."""
    options = {"plan_seed": seed, "poses": 30, "strength": 2.0, "harmonics": 21}
    c = campaign("transmission_error", "absolute", seed, **options)
    waves = c.world.physics.transmission_error.copy()
    size = np.sum(waves**2)
    waves[:, : first - 1] = 0.0
    waves *= np.sqrt(size / np.sum(waves**2))
    world = replace(c.world, physics=replace(c.world.physics, transmission_error=waves))
    r = measured(world, plan(30, seed), np.random.default_rng(seed))
    return diagnose(fitted_model(c.cell, r, "absolute"))


@pytest.mark.parametrize("seed", [2, *(pytest.param(k, marks=pytest.mark.slow) for k in (0, 6))])
def test_a_transmission_error_too_fine_for_thirty_poses_is_ambiguous(seed):
    d = fine_error(seed, 3)
    assert (d.verdict, d.reason) == ("ambiguous", "pose_alone")
    assert d.pose_alone.share > 0.95
    assert d.pose_alone.effects[:2] == ("transmission_error", "link_geometry")
    # 2 · 40 harmonics of six joints, three elements per pose.
    assert (d.pose_alone.poses, d.pose_alone.more) == (30, 130)
    assert "the same under every load of a pose" in message(d)
    assert d.pose_alone.chance > 0.9
    assert "130 more poses would decide with a chance of" in message(d)
    assert in_doubt(d)[:2] == ("transmission_error", "link_geometry")
    assert d.to_dict()["pose_alone"]["more"] == 130
