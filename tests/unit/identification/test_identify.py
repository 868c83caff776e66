"""Fits: exact without noise, free of units, honest about what the data cannot see."""

import re
from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import Cell
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.identification.fit_document import to_json
from hilcal.model.model import Model
from hilcal.readings.readings import Readings, States
from tests.support.campaigns import campaign, cell_of, noiseless, plan, true_parameters, with_noise
from tests.support.effect_cases import make
from tests.support.fit_cases import MODES, compliances, named, predicted

FRAMES = ("base_frame", "target_offset", "encoder_offset")


# --- recovery -------------------------------------------------------------------------------


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_parameters_are_recovered_exactly_without_noise(mode, m):
    c = campaign(plan_seed=0, registration_known=True, m=m)
    model = baseline(c.cell, c.readings, mode)
    truth = c.world.physics.joint_compliance
    found = fit(model, predicted(model, c.readings, truth), mode)
    assert found.solution.converged
    # Steps end below 1e-5 σ and shrink at least tenfold each.
    np.testing.assert_array_less(np.abs(found.theta - truth), 1e-6 * found.uncertainty.formal)
    np.testing.assert_allclose(found.theta, truth, rtol=1e-8)
    assert found.chi2 < 1e-8


@pytest.mark.parametrize("mode", MODES)
def test_the_worlds_compliances_are_recovered_without_noise(mode):
    """Against mechanics of its own: equilibria there hold to 1e-12 rad of deflections of 1e-3."""
    c = campaign(plan_seed=0, registration_known=True)
    found = fit(baseline(c.cell, c.readings, mode), noiseless(c.world, plan()), mode)
    np.testing.assert_allclose(found.theta, c.world.physics.joint_compliance, rtol=1e-8)


@pytest.mark.parametrize("m", [3, 6])
def test_unknown_frames_are_recovered_with_the_compliances(m):
    c = campaign(plan_seed=0, target_known=False, m=m)
    clean = noiseless(c.world, plan(), m)
    found = fit(baseline(c.cell, clean, "absolute"), clean, "absolute")
    assert found.model.names == ("base_frame", "target_offset", "joint_compliance")
    np.testing.assert_allclose(compliances(found), c.world.physics.joint_compliance, rtol=1e-7)
    assert found.error.max_m < 1e-10


def far_off(rng: np.random.Generator) -> np.ndarray:
    """A base turned by degrees, a target off by centimetres, zeros off by degrees.

    The first zero is the base's turn about z, the last one the target's.
    """
    base, target = rng.uniform(-0.1, 0.1, 6), rng.uniform(-0.05, 0.05, 6)
    return np.concatenate([base, target, [0.0], rng.uniform(-0.08, 0.08, 4), [0.0]])


def of_names(names: tuple[str, ...], cell: Cell, states: States, m: int) -> Model:
    return Model(cell, tuple(make(n, cell, states, m=m) for n in names))


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("seed", range(3))
def test_geometry_converges_from_large_errors(m, seed):
    c = campaign(plan_seed=0, registration_known=True, m=m)
    bare = c.readings[c.readings.unloaded]
    model = of_names(FRAMES, replace(c.cell, gravity=np.zeros(3)), bare.states, m)
    truth = far_off(np.random.default_rng(seed))
    if m == 3:
        model = of_names(FRAMES, model.cell, bare.states, 3)
        truth = np.delete(truth, [9, 10, 11])
    found = fit(model, predicted(model, bare, truth), "absolute")
    assert found.solution.converged
    assert found.solution.iterations <= 8
    assert found.error.max_m < 1e-10


@pytest.mark.parametrize("seed", range(3))
def test_what_counts_as_seen_does_not_depend_on_how_far_off_the_start_was(seed):
    c = campaign(plan_seed=0, registration_known=True, m=6)
    model = of_names((*FRAMES, "joint_compliance"), c.cell, c.readings.states, 6)
    truth = np.append(far_off(np.random.default_rng(seed)), c.world.physics.joint_compliance)
    clean = predicted(model, c.readings, truth)
    noisy = with_noise(clean, np.random.default_rng(seed))
    near = fit(model, noisy, "absolute", start=truth)
    far = fit(model, noisy, "absolute")
    assert far.rank == near.rank
    assert not (far.outlier ^ near.outlier).any()
    assert far.uncertainty.identifiable.sum() == near.uncertainty.identifiable.sum()


def test_the_same_data_give_the_same_numbers():
    c = campaign("transmission_error", plan_seed=0)
    model = with_effects(c.cell, c.readings, "absolute", ("joint_compliance", "transmission_error"))
    a, b = (fit(model, c.readings, "absolute") for _ in range(2))
    np.testing.assert_array_equal(a.theta, b.theta)
    np.testing.assert_array_equal(a.uncertainty.std, b.uncertainty.std)
    assert to_json(a) == to_json(b)


def test_a_fit_is_found_again_from_its_parameters_and_prior():
    c = campaign("transmission_error", plan_seed=0)
    model = with_effects(c.cell, c.readings, "absolute", ("joint_compliance", "transmission_error"))
    first = fit(model, c.readings, "absolute")
    again = fit(model, c.readings, "absolute", start=first.theta, prior=first.solution.prior)
    # Steps below 1e-5 σ count as none; seen along the least determined direction.
    off = np.abs(again.theta - first.theta) / first.uncertainty.std
    assert np.nanmax(off) < 1e-3
    assert again.chi2 == pytest.approx(first.chi2, rel=1e-6)


def test_the_order_of_readings_and_of_effects_does_not_matter():
    c = campaign(plan_seed=0, target_known=False)
    model = with_effects(c.cell, c.readings, "absolute", ("joint_compliance", "hysteresis"))
    first = fit(model, c.readings, "absolute")
    shuffled = c.readings[np.random.default_rng(1).permutation(len(c.readings))]
    other = fit(replace(model, effects=model.effects[::-1]), shuffled, "absolute")
    for name, (value, std) in named(first).items():
        assert named(other)[name][0] == pytest.approx(value, abs=1e-4 * std), name
        assert named(other)[name][1] == pytest.approx(std, rel=1e-6), name


# --- identifiability ------------------------------------------------------------------------


def seen_directions(model: Model, readings: Readings, m: int) -> int:
    """Numeric rank of the scaled Jacobian, by differences of the prediction."""
    theta = np.zeros(model.size)
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    base = model.predict(readings.states, theta).observation.rotation
    columns = []
    for p in range(model.size):
        both = []
        for h in (1.0, -1.0):
            step = h * scale[p] * np.eye(model.size)[p]
            o = model.predict(readings.states, step).observation
            turn = o.rotation @ np.swapaxes(base, 1, 2)
            w = [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0]]
            w.append(turn[:, 1, 0] - turn[:, 0, 1])
            both.append(np.hstack([o.position, 0.5 * np.stack(w, axis=1)])[:, :m].ravel())
        columns.append(both[0] - both[1])
    values = np.linalg.svd(np.array(columns).T, compute_uv=False)
    # Differences over a milliradian are right to 1e-6; nothing lies between that and what is seen.
    seen = values > 1e-5 * values[0]
    assert not np.any((values > 1e-6 * values[0]) & ~seen)
    return int(seen.sum())


@pytest.mark.parametrize(("m", "expected"), [(3, 27), (6, 30)])
def test_an_over_complete_model_has_the_rank_that_the_arm_has(m, expected):
    """Six axes are lines (4 each); the target at rest adds a position (3) or a pose (6)."""
    c = campaign("link_geometry", plan_seed=0, poses=30, target_known=False, m=m)
    r = c.readings[c.readings.unloaded]
    r = replace(r, states=replace(r.states, wrench=0 * r.states.wrench))
    cell = replace(c.cell, gravity=np.zeros(3))
    model = with_effects(cell, r, "absolute", ("link_geometry",))
    assert seen_directions(model, r, m) == expected
    found = fit(model, r, "absolute")
    assert found.rank == expected
    assert len(found.uncertainty.null) == model.size - expected


def test_what_cannot_be_seen_is_named_and_has_no_number():
    c = campaign("link_geometry", plan_seed=0, poses=30)
    model = with_effects(c.cell, c.readings, "absolute", ("joint_compliance", "link_geometry"))
    found = fit(model, c.readings, "absolute")
    u = found.uncertainty
    assert found.rank < model.size
    np.testing.assert_array_equal(np.isinf(u.std), ~u.identifiable)
    rows = model.slices()[model.names.index("link_geometry")]
    # A shift along a joint's axis can be made before or after the joint.
    for k in range(6):
        assert not u.identifiable[rows][6 * k + 2]
    assert u.identifiable[model.slices()[model.names.index("joint_compliance")]].all()
    document = to_json(found)
    for p, seen in zip(document["parameters"], u.identifiable, strict=True):
        assert (p["value"] is None) == (p["std"] is None) == (not seen)
        assert p["identifiable"] == bool(seen)
    assert len(document["unidentifiable"]) == model.size - found.rank
    assert all("link_geometry" in name for name in document["unidentifiable"])


def test_an_over_complete_model_predicts_what_the_world_shows_elsewhere():
    c = campaign("link_geometry", plan_seed=0, poses=30)
    p = plan(30)
    clean = noiseless(c.world, p)
    model = with_effects(c.cell, clean, "absolute", ("joint_compliance", "link_geometry"))
    found = fit(model, clean, "absolute")
    other = plan(12, 77).states
    told = found.model.predict(other, found.theta).observation.position
    off = np.linalg.norm(told - c.world.sight(other).position, axis=1)
    # Parts of a direction too weak to be estimated stay: 0.05 σ over all data together.
    sigma = np.sqrt(np.trace(clean.covariance, axis1=1, axis2=2).mean())
    assert off.max() < 0.05 * sigma


def test_redundant_effects_share_one_direction():
    """The first zero is the base's turn about z; both cannot be told."""
    c = campaign(plan_seed=0)
    model = with_effects(c.cell, c.readings, "absolute", ("joint_compliance", "encoder_offset"))
    found = fit(model, c.readings, "absolute")
    assert len(found.uncertainty.null) == 1
    assert "base_frame.rz" in found.uncertainty.null[0]
    assert "encoder_offset.j1" in found.uncertainty.null[0]
    unseen = [n for n, (_, std) in named(found).items() if np.isinf(std)]
    assert set(unseen) == {"base_frame.rz", "encoder_offset.j1"}


# --- too little -----------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("mode", MODES)
def test_no_more_elements_than_parameters_cannot_answer(mode, count):
    c = campaign(plan_seed=0, registration_known=True)
    if mode == "deflection":
        few = c.readings[(c.readings.pose < count) & np.isin(c.readings.load, [0, 3])]
    else:
        few = c.readings[np.flatnonzero(c.readings.load == 3)[:count]]
    told = rf"{3 * count} measured elements for \d parameters.*measure at least (\d+)"
    with pytest.raises(CannotAnswerError, match=told) as caught:
        fit(baseline(c.cell, few, mode), few, mode)
    advised = int(re.search(told, str(caught.value))[1])
    assert 3 * advised > 6
    assert caught.value.exit_code == 4
    assert "\n" not in str(caught.value)


def test_true_parameters_lie_within_their_uncertainty():
    """A check of the whole way on one campaign of the world, at 5 σ of 12 parameters."""
    c = campaign(plan_seed=0, target_known=False, poses=20)
    found = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")
    rows = found.model.slices()[2]
    z = (found.theta[rows] - true_parameters(c.world, "joint_compliance")) / found.uncertainty.std[
        rows
    ]
    assert np.abs(z).max() < 5
    assert found.variance_factor == pytest.approx(1, abs=5 * np.sqrt(2 / found.dof))


def test_noise_of_a_known_factor_shows_in_the_variance_factor():
    c = campaign(plan_seed=0, registration_known=True)
    clean = noiseless(c.world, plan())
    noisy = with_noise(clean, np.random.default_rng(5), 2.0)
    found = fit(baseline(cell_of(registration_known=True), noisy, "absolute"), noisy, "absolute")
    assert found.variance_factor == pytest.approx(4, abs=4 * 5 * np.sqrt(2 / found.dof))
