"""What has changed on an arm: claims on simulated pairs whose mechanics share no code with them."""

from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.diagnosis.change import candidates, find_changes
from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.drivers.simulated.world import place_tracker
from hilcal.effects.protocol import effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import with_effects
from hilcal.identification.carried.later_readings import earlier_fit, later_readings
from hilcal.robot import se3
from studies.change import measured, remeasured, studied_arm
from studies.random_campaigns import rehearsal_states
from tests.support.campaigns import configuration
from tests.support.refusals import refusal_of
from tests.support.rows import first

CONFIG = configuration()


@pytest.fixture(scope="module")
def arm():
    return studied_arm(CONFIG, "ur10e", 0, poses=30)


def later(arm, change, seed, *, anew=True, count=15, off=None, warmer=0.0):
    """Change the arm, measure it again, and compare."""
    rng = np.random.default_rng(seed)
    world = replace(arm.world, physics=change(arm.world.physics))
    if anew:
        registration, station = place_tracker(arm.cell, rng)
        world = replace(world, registration=registration, station=station)
    readings = remeasured(world, arm.loads, count, rng, warmer)
    if off is not None:
        readings.value[off, :3] += [4e-3, 0.0, -3e-3]
    return find_changes(later_readings(arm.earlier, readings, anew=anew))


def test_a_gross_error_of_an_orientation_is_stated_as_one(arm):
    rng = np.random.default_rng(2)
    states, *numbers = rehearsal_states(arm.cell, 15, [], rng)
    readings = simulate(arm.world, states, *numbers, ("none",), rng, 6)
    turned = se3.rotation(np.array([0.0, 0.05, 0.0])) @ se3.rotation(readings.value[6, 3:])
    readings.value[6, 3:] = se3.rotation_vector(turned)
    (gross,) = find_changes(later_readings(arm.earlier, readings, anew=False)).gross
    assert (gross.pose, gross.off_rad) == ("p7", pytest.approx(0.05, rel=0.05))
    assert gross.off_m < 1e-3


def zero(joint, size):
    offset = size * np.eye(6)[joint - 1]
    return lambda p: p.with_effect("encoder_offset", p.encoder_offset + offset)


def softer(joint, factor):
    by = 1.0 + (factor - 1.0) * np.eye(6)[joint - 1]
    return lambda p: p.with_effect("joint_compliance", p.joint_compliance * by)


@pytest.mark.parametrize("seed", first(1, range(4)))
def test_without_a_change_nothing_is_claimed(arm, seed):
    changes = later(arm, lambda p: p, seed, anew=seed % 2 == 0)
    assert changes.found == ()
    assert changes.explained
    assert changes.before.rss == pytest.approx(
        changes.before.dof, abs=4 * np.sqrt(2 * changes.before.dof)
    )


@pytest.mark.slow
def test_the_growth_at_temperatures_that_were_not_measured_is_no_change():
    grows = studied_arm(CONFIG, "ur3e", 2, poses=30, more=("thermal_growth",))
    assert later(grows, lambda p: p, 3, count=30, warmer=5.0).found == ()
    (change,) = later(grows, zero(3, 1e-3), 3, count=30, warmer=5.0).found
    assert change.candidate.name == "encoder_offset.j3"


def test_the_drift_of_the_tracker_in_one_campaign_is_no_change(arm):
    rate = -5e-8 * np.array([1.0, 0.5, -1.0, 0.3, -0.3, 0.15])
    changes = later(arm, lambda p: p.with_effect("tracker_drift", rate), 3, count=30)
    assert changes.found == ()
    assert changes.explained


@pytest.mark.parametrize("changed", first(1, [False, True]))
def test_a_gross_error_is_no_change_and_hides_none(arm, changed):
    changes = later(arm, zero(5, -1.5e-3) if changed else lambda p: p, 13, count=20, off=6)
    (gross,) = changes.gross
    assert gross.pose == "p7"
    assert gross.off_m == pytest.approx(5e-3, rel=0.1)
    assert [c.candidate.name for c in changes.found] == ["encoder_offset.j5"] * changed
    assert changes.explained


@pytest.mark.long
def test_a_joints_new_zero_and_compliance_are_found_with_their_size(arm):
    true = arm.world.physics.joint_compliance[1]
    changes = later(arm, lambda p: softer(2, 2.0)(zero(5, -1.5e-3)(p)), 11)
    by_name = {c.candidate.name: c.sizes[0] for c in changes.found}
    assert set(by_name) == {"encoder_offset.j5", "joint_compliance.j2"}
    assert abs(by_name["encoder_offset.j5"].value + 1.5e-3) < 4 * by_name["encoder_offset.j5"].std
    moved = by_name["joint_compliance.j2"]
    assert abs(moved.value - true) < 4 * moved.std
    assert moved.before[0] == pytest.approx(true, abs=5 * moved.before[1])
    assert changes.explained


@pytest.mark.long
def test_a_zero_of_joint_1_is_the_trackers_new_place_unless_that_is_the_old_one(arm):
    anew = later(arm, zero(1, 2e-3), 12)
    assert anew.found == ()
    assert "encoder_offset.j1" in {h.name for h in anew.hidden}
    (same,) = later(arm, zero(1, 2e-3), 12, anew=False).found
    assert same.candidate.name == "encoder_offset.j1"


@pytest.mark.long
def test_a_target_that_was_mounted_anew_is_no_change_of_the_arm(arm):
    shift = np.array([4e-3, -2e-3, 1e-3])
    changes = later(arm, lambda p: p.with_effect("target_offset", p.target_offset + shift), 13)
    (moved,) = changes.found
    assert moved.candidate.name == "target_offset"
    assert not moved.candidate.of_arm
    assert np.abs([s.value for s in moved.sizes] - shift).max() < 5e-5


def test_the_last_link_and_the_target_are_not_told_apart_by_what_positions_do_not_show(arm):
    moved = 1e-4 * np.array([3.0, -2.0, 3.0, 4.0, -3.0, 3.0]) * np.eye(7)[6][:, None]
    changes = later(
        arm, lambda p: p.with_effect("link_geometry", p.link_geometry + moved), 46, count=20
    )
    (change,) = changes.found
    assert {c.name for c in change.possible} == {"target_offset", "link_geometry.link6"}
    assert max(abs(s.value) for s in change.sizes) < 1e-3


def test_a_tool_that_is_heavier_is_what_its_columns_say(arm):
    fit = arm.earlier.fit
    states = fit.readings.states[:20]
    known = candidates(fit.model.cell, states, fit.model.catalogue, 3, anew=True)
    (weight,) = [c for c in known if c.name == "tool_weight"]
    before = fit.model.predict(states, fit.theta)
    columns = fit.model.jacobian_of((weight.effect_directions.effect,), before, fit.theta, 3)
    mass = weight.scale[0]
    cell = fit.model.cell
    com = cell.tool_mass * cell.tool_com / (cell.tool_mass + mass)  # the mass is at the flange

    def with_cell(other):
        effects = tuple(type(e)(other, states, e.options) for e in fit.model.effects)
        model = replace(fit.model, cell=other, effects=effects)
        return model.predict(states, fit.theta).observation.position

    heavier = with_cell(replace(cell, tool_mass=cell.tool_mass + mass, tool_com=com))
    moved = heavier - with_cell(cell)
    predicted = (columns @ weight.effect_directions.directions)[:, :, 0]
    assert np.abs(moved).max() > 1e-6
    np.testing.assert_allclose(predicted, moved, atol=2e-3 * np.abs(moved).max())


def test_what_could_not_have_been_seen_is_larger_with_fewer_readings(arm):
    few, many = (later(arm, lambda p: p, 14, count=n) for n in (8, 40))
    size = [{x.candidate: x.size for x in c.limits} for c in (few, many)]
    for name in ("encoder_offset.j3", "joint_compliance.j2"):
        assert size[1][name] < size[0][name]


def test_too_few_readings_are_refused(arm):
    readings = remeasured(arm.world, arm.loads, 15, np.random.default_rng(1))
    refusal_of(
        CannotAnswerError, "measure at least", later_readings, arm.earlier, readings[:3], anew=True
    )


def test_columns_that_the_later_readings_lack_are_named(arm):
    fit = arm.earlier.fit
    model = fit.model + effect("thermal_growth")
    warm = replace(arm.earlier, fit=replace(fit, model=model))
    readings = remeasured(arm.world, arm.loads, 15, np.random.default_rng(1))
    bare = replace(readings.states, air_temperature=None, joint_temperature=None)
    with pytest.raises(InputError, match="thermal_growth needs air_temperature"):
        later_readings(warm, replace(readings, states=bare), anew=True)


def test_a_misfit_that_is_of_poses_is_told_from_one_of_readings(arm):
    rng, off = np.random.default_rng(3), 1e-4
    noise, joints = measurement_noise(CONFIG), CONFIG.repeatability.per_joint(arm.cell.arm.n)
    world = world_without_effect(arm.cell, rng, noise=noise, joint_std=joints)
    r = measured(world, arm.loads, 30, rng)
    model = with_effects(arm.cell, r, "absolute", ("joint_compliance",))  # much fewer than poses
    of_pose = off * rng.standard_normal((int(r.pose.max()) + 1, 3))[r.pose]
    of_reading = off * rng.standard_normal((len(r), 3))
    fits = [
        earlier_fit(hc.fit(model, replace(r, value=r.value + shift), readings="absolute"))
        for shift in (of_pose, of_reading)
    ]
    w = fits[0].fit.whitening
    drawn = float(np.mean(w.whiten(of_pose[w.reading]) ** 2))
    assert fits[0].pose_variance == pytest.approx(
        drawn, rel=0.3
    )  # some of the 90 values are fitted
    assert fits[0].pose_variance > 5 * fits[0].noise
    assert fits[1].pose_variance < 0.5 * fits[1].noise  # parameters are shared by a pose, too
