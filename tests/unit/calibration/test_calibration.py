"""A calibration: predicted and compensated poses against the world's own mechanics."""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import hilcal as hc
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import band, tool_poses
from hilcal.calibration.covariance_source import CovarianceSource
from hilcal.calibration.measured import MeasuredRanges
from hilcal.calibration.scatter import Scatter
from hilcal.calibration.storage import from_json, to_json
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.registration.robot_frames import state_with_every_column
from hilcal.model.model import Model
from hilcal.present.calibration import far_turned, refusals
from hilcal.robot import se3
from hilcal.robot.arm import with_conventions
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from tests.support.campaigns import campaign, cell_of, plan
from tests.support.fit_cases import fitted_model
from tests.support.refusals import refusal

POSES = 24


@cache
def calibrated(effect, mode="absolute", seed=0):
    c = campaign(effect, mode, seed, poses=POSES)
    model = baseline(c.cell, c.readings, mode)
    if effect != "none":
        model = model + model.catalogue.make(effect, c.cell, c.readings.states)
    return Calibration.of(fit(model, c.readings, mode), {"campaign": "made"})


def fresh(seed=0, load=1):
    """Poses that were never fitted, under one load."""
    p = plan(40, 5000 + seed)
    return p.states[np.flatnonzero(p.load == load)]


def achieved(c, effect, seed, states, goal):
    """(N, 3) by how much the world's tool misses a goal (N, 3) in base axes of the fit."""
    world = campaign(effect, c.mode, seed, poses=POSES).world
    rng = np.random.default_rng(seed)
    scattered = states.q + rng.standard_normal(states.q.shape) * world.joint_std
    read = world.ideal_readings(replace(states, q=scattered)).value(3)
    prediction = c.model.predict(states, c.theta)
    position = tool_poses(c._tracked, prediction)[1]
    base = c.base_in_tracker()[:3, :3]
    wanted = prediction.observation.position + (goal - position) @ base.T
    return np.asarray(read - wanted)


@pytest.mark.parametrize("effect", ["joint_tilt_compliance", "link_geometry", "transmission_error"])
def test_the_world_is_where_it_was_asked_to_be(effect):
    c, states = calibrated(effect), fresh()
    k = c.compensate(states.q, states.wrench)
    good = k.usable
    assert good.mean() > 0.6
    before = achieved(c, effect, 0, states, k.before.nominal_position)[good]
    after = achieved(c, effect, 0, replace(states, q=k.q), k.after.nominal_position)[good]
    scatter = c.scatter.covariance(c.model.cell, evaluate(c.model.cell.arm, k.q), k.after.position)
    floor = np.mean(np.trace(scatter[good], axis1=1, axis2=2))
    left = max(np.mean(np.sum(after**2, axis=1)) - floor, 0.0)
    assert left < 0.05**2 * (np.mean(np.sum(before**2, axis=1)) - floor)
    assert np.mean(np.linalg.norm(after, axis=1) <= k.after.band_m[good]) > 0.85
    assert np.sqrt(np.mean(np.sum(after**2, axis=1) / k.after.std_m[good] ** 2)) < 1.2


@pytest.mark.parametrize("effect", ["link_geometry", "encoder_offset"])
def test_the_base_does_not_move_along_with_the_first_link(effect):
    """Moving the base along with the first link changes no reading, and no correction either."""
    c, r = calibrated(effect), campaign(effect, "absolute", 0, poses=POSES).readings
    base = c.base_in_tracker()
    positions = (r.value[:, :3] - base[:3, 3]) @ base[:3, :3]
    p = c.predict(r.states.q, r.states.wrench)
    np.testing.assert_allclose(p.position, positions, atol=2e-4)
    shifted = replace(c, theta=c.theta + moved_along(c))
    again = shifted.predict(r.states.q, r.states.wrench)
    np.testing.assert_allclose(again.position, p.position, atol=5e-6)  # loads pull elsewhere
    np.testing.assert_array_equal(again.nominal_position, p.nominal_position)
    np.testing.assert_allclose(shifted.base_in_tracker(), base, atol=1e-5)


def moved_along(c):
    """Parameters that turn the base one way and the first link, or joint, the other."""
    names = [f"{e.name}.{p.name}" for e in c.model.effects for p in e.parameters]
    out = np.zeros(len(names))
    out[names.index("base_frame.rz")] = 2e-3
    other = "link_geometry.link0.rz" if "link_geometry.link0.rz" in names else "encoder_offset.j1"
    out[names.index(other)] = -2e-3
    return out


def test_deflections_are_compensated_to_the_unloaded_arm():
    c, states = calibrated("joint_tilt_compliance", "deflection"), fresh()
    k = c.compensate(states.q, states.wrench)
    still = replace(states, wrench=0 * states.wrench)
    world = campaign("joint_tilt_compliance", "deflection", 0, poses=POSES).world
    unloaded = world.ideal_readings(still).value(3)
    before, after = (
        np.linalg.norm(world.ideal_readings(replace(states, q=q)).value(3) - unloaded, axis=1)
        for q in (states.q, k.q)
    )
    assert before.mean() > 2e-4
    assert after.mean() < 0.05 * before.mean()
    np.testing.assert_allclose(k.before.error_m, before, atol=1e-4)
    nothing = c.compensate(states.q)
    np.testing.assert_allclose(nothing.q, states.q, atol=1e-9)
    assert nothing.before.error_m.max() < 1e-12


def test_a_wanted_pose_is_reached_from_joint_values_nearby():
    c, q = calibrated("none"), fresh().q[:5]
    wanted = se3.matrix(*(x[:5] for x in nominal(c, q)))
    k = c.compensate(q + 0.05, wanted=wanted, std=False)
    np.testing.assert_allclose(k.q, c.compensate(q, std=False).q, atol=1e-8)


def nominal(c, q):
    chain = evaluate(c.model.cell.arm, q)
    pose = c.tool_pose()
    return se3.product(chain.rotation[-1], pose[:3, :3]), chain.point(pose[:3, 3])


@pytest.mark.parametrize("effect", ["target_offset", "thermal_growth", "creep", "backlash"])
def test_a_calibration_comes_back_from_its_file(effect, tmp_path):
    c = campaign("joint_tilt_compliance", "absolute", 0, poses=POSES)
    warm = np.full(c.readings.states.q.shape, 20.0)
    states = replace(c.readings.states, air_temperature=warm[:, 0], joint_temperature=warm)
    readings = replace(c.readings, states=states)
    cell = replace(c.cell, target_known=False) if effect == "target_offset" else c.cell
    model = baseline(cell, readings, "absolute")
    if effect not in model.names:
        model = model + model.catalogue.make(effect, c.cell, states)
    calibration = Calibration.of(fit(model, readings, "absolute"))
    path = tmp_path / "c.json"
    calibration.save(path)
    again = Calibration.load(path)
    of = {k: getattr(states, k)[:4] for k in ("time", "load_time", "approach")}
    of["air_temperature"], of["joint_temperature"] = np.full(4, 24.0), np.full((4, 6), 28.0)
    a, b = (
        x.compensate(states.q[:4], states.wrench[:4], recorded=of) for x in (calibration, again)
    )
    np.testing.assert_array_equal(a.q, b.q)
    np.testing.assert_allclose(a.after.std_m, b.after.std_m, rtol=1e-5)
    assert again.source == calibration.source
    # as the version before wrote it
    old = from_json(to_json(replace(calibration, covariance_source=None)))
    c = old.compensate(states.q[:4], states.wrench[:4], recorded=of)
    np.testing.assert_allclose(a.after.std_m, c.after.std_m, rtol=1e-5)
    assert [(o.range, o.points.tolist()) for o in a.after.outside] == [
        (o.range, o.points.tolist()) for o in b.after.outside
    ]


def test_a_calibration_of_an_arm_of_unknown_payload_and_torques_comes_back(tmp_path):
    """Such as most arms that are described by a URDF or by DH rows alone."""
    c = calibrated("none")
    arm = replace(c.model.cell.arm, payload=np.inf, torque_max=np.full(6, np.inf))
    c = replace(c, model=replace(c.model, cell=replace(c.model.cell, arm=arm)))
    c.save(tmp_path / "c.json")
    assert Calibration.load(tmp_path / "c.json").model.cell.arm.payload == np.inf


def test_a_file_of_another_kind_is_refused_in_words(tmp_path):
    c, mirror = calibrated("none"), np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()
    good, exact = to_json(c), {**c.covariance_source.to_json(), "noise": 0.0}
    proxy = {"column": "time", "joint": 0, "low": 0.0, "high": 9.0, "polynomials": {}}
    torque = {**proxy, "column": "torque", "probability": 0.1}
    path = tmp_path / "c.json"
    for content, words in [
        ("{", "no calibration"),
        ('[robot]\nmodel = "ur5"', "no calibration: it is no JSON from line 1 on"),
        ("[]", '"format": "hilcal-calibration"'),
        (json.dumps({**good, "version": 3}), "reads versions 1 and 2"),
        (json.dumps({**good, "theta": [1.0]}), "damaged"),
        (json.dumps({**good, "parameters": []}), "other parameters"),
        (json.dumps({**good, "effects": [{"name": "mine", "options": {}}]}), "--effects-from"),
        (json.dumps({k: v for k, v in good.items() if k != "arm"}), "damaged"),
        (json.dumps({**good, "source": None}), "damaged"),
        (json.dumps({**good, "refuted_by": [3, 2]}), "damaged"),
        (json.dumps({**good, "proxies": [torque]}), "proxy 'torque' is no condition"),
        (json.dumps({**good, "proxies": [{**proxy, "probability": -0.1}]}), "probability"),
        (json.dumps({**good, "learnt": exact}), "noise has a number that is out"),
        (json.dumps({**good, "cell": {**good["cell"], "target": mirror}}), "a rotation"),
    ]:
        path.write_text(content)
        error = refusal(r"c\.json", Calibration.load, path)
        assert words in error
    refusal(r"none\.json", Calibration.load, tmp_path / "none.json")


@pytest.mark.parametrize(
    ("effect", "unstated"), [("hysteresis", "approach"), ("creep", "load_time")]
)
def test_what_a_table_does_not_tell_of_a_state_is_in_the_band(effect, unstated):
    """Points and programs seldom have sides of approach or times; campaigns do."""
    c, states = calibrated(effect), fresh()
    k = c.compensate(states.q, states.wrench)
    stated = c.compensate(states.q, states.wrench, recorded={unstated: getattr(states, unstated)})
    assert (k.unstated, stated.unstated) == ((unstated,), ())
    good = k.usable & stated.usable
    assert good.mean() > 0.6
    after = achieved(c, effect, 0, replace(states, q=k.q), k.after.nominal_position)[good]
    assert np.mean(np.linalg.norm(after, axis=1) <= k.after.band_m[good]) > 0.9
    assert np.all(k.after.band_m[good] > stated.after.band_m[good])
    known = from_json(json.loads(json.dumps(to_json(c)))).compensate(states.q, states.wrench)
    np.testing.assert_allclose(known.after.band_m, k.after.band_m, rtol=1e-4)


def test_points_outside_of_what_was_measured_are_named():
    c, q = calibrated("none"), fresh().q[:2].copy()
    ranges = {r.variable: r for r in c.measured.ranges}
    q[1, 2] = ranges["joint 3 angle"].high + 0.5
    heavy = np.array([0.0, 0.0, -3 * ranges["force"].high, 0.0, 0.0, 0.0])
    p = c.predict(q, np.stack([heavy, 0 * heavy]))
    outside = {o.range.variable: o.points.tolist() for o in p.outside}
    assert outside["joint 3 angle"] == [False, True]
    assert outside["force"] == [True, False]


def test_a_correction_that_bends_the_elbow_the_other_way_is_refused():
    """The corrected pose lies on the other side of the stretched arm."""
    c, states = calibrated("link_geometry"), fresh()
    q = states.q.copy()
    q[:20, 2] = 3e-4
    k = c.compensate(q, states.wrench)
    bent = k.inverse.solved & (k.q[:, 2] * q[:, 2] < 0.0)
    assert bent.sum() > 2
    np.testing.assert_array_equal(k.other_branch[k.inverse.solved], bent[k.inverse.solved])
    assert not k.usable[bent].any()
    why = refusals(k, allowed_outside=True)
    assert all("elbow or wrist would flip" in why[i] for i in np.flatnonzero(bent))


def test_a_correction_that_turns_a_joint_far_is_told():
    c, states = calibrated("joint_tilt_compliance"), fresh()
    q, names = states.q[:20].copy(), ["point"] * 20
    assert far_turned(names, q, c.compensate(q, states.wrench[:20])) == ""
    q[:, 4] = 2e-3  # the wrist is nearly straight
    warning = far_turned(names, q, c.compensate(q, states.wrench[:20]))
    assert re.match(r"the correction of point turns joint [46] by \d+\.\d°", warning)


def test_wrong_input_is_refused_in_words():
    c = calibrated("none")
    for call, words in [
        (lambda: c.predict(np.zeros(5)), r"q has shape \(1, 5\)"),
        (lambda: c.predict(np.full(6, np.nan)), "not finite"),
        (lambda: c.predict(np.zeros(6), np.zeros(3)), "wrench has shape"),
        (lambda: c.predict(np.zeros(6), recorded={"humidity": np.zeros(1)}), "no column"),
        (lambda: c.predict(np.zeros(6), tool=np.zeros((4, 4))), "tool is no"),
        (lambda: c.predict(np.zeros(6), std=False).std_m, "std=True"),
    ]:
        refusal(words, call)


@pytest.mark.parametrize("size", [0.0, 1e-320, 1e-200, 1e-12])
def test_the_band_of_what_hardly_scatters_is_a_number(size):
    """Nothing left beside a scatter that is not known: a band of 0, not one that is no number."""
    c = np.diag([1.0, 2.0, 3.0])
    (width,) = band(size * c[None])
    assert width == pytest.approx(np.sqrt(size) * band(c[None])[0], rel=1e-2)
    assert band(np.stack([size * c, c]))[1] == band(c[None])[0]


def test_the_band_holds_its_share():
    rng = np.random.default_rng(1)
    for scale in ([1.0, 1.0, 1.0], [1.0, 0.1, 0.01], [1.0, 1.0, 0.1]):
        root = np.diag(scale) @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        c = (root.T @ root)[None]
        drawn = np.linalg.norm(rng.standard_normal((20000, 3)) @ root, axis=1)
        assert np.mean(drawn <= band(c)[0]) == pytest.approx(0.95, abs=0.012)


def test_temperatures_that_were_not_measured_widen_the_band_by_what_they_do():
    c = campaign("none", "absolute", 2, poses=20)
    warm = {"air_temperature": np.full(len(c.readings), 21.0)}
    readings = replace(c.readings, states=replace(c.readings.states, **warm))
    calibration = Calibration.of(fit(baseline(c.cell, readings, "absolute"), readings, "absolute"))
    states = plan(15, 500).states
    world = replace(c.world, physics=c.world.physics.with_effect("thermal_growth", 12e-6))
    hot, cold = (
        world.equilibrium(replace(states, air_temperature=np.full(75, degrees))).flange
        for degrees in (31.0, 21.0)
    )
    moved = ((hot - cold) @ c.cell.target)[:, :3, 3]

    def covariance(degrees):
        air = {"air_temperature": np.full(75, degrees)}
        return calibration.predict(states.q, states.wrench, recorded=air).covariance

    np.testing.assert_array_equal(covariance(21.1), covariance(21.0))
    more = covariance(31.0) - covariance(21.0)
    assert np.linalg.norm(moved, axis=1).max() > 1e-4
    share = np.trace(more, axis1=1, axis2=2) / np.sum(moved**2, axis=1)
    np.testing.assert_allclose(share, 1.0, rtol=0.01)


def test_a_time_after_the_last_reading_is_as_uncertain_as_an_unknown_one():
    c = campaign("none", "absolute", 2, poses=20)
    states = c.readings.states
    readings = replace(c.readings, states=replace(states, joint_temperature=None))
    model = baseline(c.cell, readings, "absolute")
    model = model + model.catalogue.make("thermal_joint_drift", c.cell, readings.states)
    k = Calibration.of(fit(model, readings, "absolute"))
    k = from_json(to_json(k))
    last, v = float(states.time.max()), k.conditions["time"].variance_m2
    at, after = (
        k.predict(states.q[:5], recorded={"time": np.full(5, t)}) for t in (last, last + 0.001)
    )
    assert v > 0.0
    np.testing.assert_allclose(
        after.covariance - at.covariance,
        np.tile(v * np.eye(3), (5, 1, 1)),
        rtol=1e-3,
        atol=1e-4 * v,
    )


def test_conditions_that_changed_together_widen_the_band_where_they_part():
    """Growth by the air or by what the joints' heat does: one warm-up does not tell."""
    c = campaign("none", "absolute", 2, poses=20)
    states, rng = c.readings.states, np.random.default_rng(1)
    warm_up, alone = np.linspace(0.0, 1.0, len(states)), rng.uniform(size=len(states))

    def calibrated(air):
        joints = np.tile(22.0 + 15.0 * warm_up[:, None], 6)
        of = replace(states, time=6000.0 * warm_up, air_temperature=air, joint_temperature=joints)
        model = baseline(c.cell, replace(c.readings, states=of), "absolute")
        model = model + model.catalogue.make("thermal_growth", c.cell, of)
        growth = np.zeros(model.size)
        growth[-1] = 30e-6
        moved = model.predict(of, growth).observation.position
        moved = moved - model.predict(of, 0.0 * growth).observation.position
        readings = replace(c.readings, states=of, value=c.readings.value + moved)
        return Calibration.of(fit(model, readings, "absolute"))

    def added_and_motion(k, cold=0.0):
        """Part of the covariance by the proxies, and |δ|² where the joints are colder."""
        at, q = np.full(20, 0.9), states.q[:20]
        of = {"time": 6000.0 * (at - cold), "air_temperature": 20.0 + 4.0 * at}
        of["joint_temperature"] = np.tile(22.0 + 15.0 * (at - cold)[:, None], 6)
        both = [x.predict(q, recorded=of) for x in (k, replace(k, proxies=()))]
        of["air_temperature"] = of["air_temperature"] - 4.0 * cold
        moved = both[0].position - k.predict(q, recorded=of).position
        added = both[0].covariance - both[1].covariance
        return np.trace(added, axis1=1, axis2=2), np.sum(moved**2, axis=1)

    together, apart = calibrated(20.0 + 4.0 * warm_up), calibrated(20.0 + 4.0 * alone)
    again = from_json(to_json(together))
    assert np.all(added_and_motion(again)[0] < 1e-15)
    added, motion = added_and_motion(again, cold=0.9)
    np.testing.assert_allclose(added, 0.5 * 7 / 8 * motion, rtol=0.05)  # the air is one of eight
    assert motion.max() > 50e-6**2
    added, motion = added_and_motion(apart, cold=0.9)
    assert np.all(added < 0.01 * motion)


def test_attitudes_do_not_tell_how_the_flange_is_turned_beside_the_target():
    """The turn of one target on the flange is estimated, so that another tool is less certain."""
    c = campaign("link_geometry", "absolute", 2, poses=20, strength=20.0, m=6)
    names = ("joint_compliance", "link_geometry")
    model = fitted_model(c.cell, c.readings, "absolute", names)
    calibration, states = Calibration.of(model), plan(15, 500).states
    base = calibration.base_in_tracker()

    def error_and_share_inside(k, tool):
        true = (c.world.registration @ c.world.equilibrium(states).flange @ tool)[:, :3, 3]
        p = k.predict(states.q, states.wrench, tool=tool)
        errors = np.linalg.norm((true - base[:3, 3]) @ base[:3, :3] - p.position, axis=1)
        return float(np.mean(errors)), float(np.mean(errors <= band(p.covariance)))

    other = se3.matrix(np.eye(3), np.array([0.3, 0.05, 0.1]))
    assert error_and_share_inside(calibration, c.cell.target)[1] > 0.9
    error, share = error_and_share_inside(calibration, other)
    as_fitted, narrow_share = error_and_share_inside(replace(calibration, turn_std=0.0), other)
    assert (error < 0.7 * as_fitted, share > 0.9, narrow_share < 0.1) == (True, True, True)
    np.testing.assert_array_equal(calibration.tool_pose(other), other)
    goal = evaluate(c.cell.arm, states.q).point(other[:3, 3])
    made = calibration.compensate(states.q, states.wrench, tool=other)
    reached = c.world.equilibrium(replace(states, q=made.q)).flange @ other
    reached = (se3.inverse(base) @ c.world.registration @ reached)[:, :3, 3]
    off = np.linalg.norm(reached - goal, axis=1)
    assert np.mean(off) == pytest.approx(error, rel=0.1)
    assert from_json(to_json(calibration)).turn_std == calibration.turn_std


def test_coupled_joints_are_compensated_by_the_controllers_values():
    follows = np.zeros((6, 6))
    follows[2, 1], follows[5, 4] = -1.0, 0.5
    sign = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])
    arm = with_conventions(load_arm("ur10e"), sign, np.zeros(6), follows)
    cell, known = replace(cell_of(registration_known=True), arm=arm), hc.installed()
    names = ("encoder_offset", "joint_compliance")
    effects = tuple(known.make(name, cell, state_with_every_column(cell)) for name in names)
    c = Calibration(
        model=Model(cell, effects, known),
        theta=np.repeat([1e-3, 1e-5], 6),
        mode="absolute",
        root=np.zeros((12, 1)),
        misfit=0.0,
        scatter=Scatter(np.zeros(6), 0.0, "unknown"),
        measured=MeasuredRanges((), 1.0),
        loads={},
        source={},
    )
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (30, 6))
    k = c.compensate(q, np.array([0.0, 0.0, -80.0, 0.0, 0.0, 0.0]))
    assert k.inverse.solved.all()
    wanted = evaluate(arm, q).point(cell.target[:3, 3])
    np.testing.assert_allclose(c.predict(k.q, [0, 0, -80, 0, 0, 0]).position, wanted, atol=1e-9)
    assert k.before.error_m.mean() > 1e-3


@pytest.mark.parametrize(
    ("effect", "mode"),
    [("transmission_error", "absolute"), ("joint_tilt_compliance", "deflection")],
)
def test_the_covariance_follows_from_the_fitted_states(effect, mode):
    c = calibrated(effect, mode)
    small = json.loads(json.dumps(c.covariance_source.to_json()))
    again = replace(c, root=None, covariance_source=CovarianceSource.from_json(small))
    states = fresh(3)
    a, b = (x.predict(states.q, states.wrench) for x in (c, again))
    np.testing.assert_allclose(a.std_m, b.std_m, rtol=1e-5)
