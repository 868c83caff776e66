"""What a plan predicts is what identification then states, and what the parameters scatter by."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.cell import cell_from_config
from hilcal.config import load_config
from hilcal.config.cell import Target
from hilcal.config.sections import Gauge, Point
from hilcal.design.information import MOST_PARAMETERS, MOST_TIMES, problem, reading_covariance
from hilcal.design.nominal_model import model_after, nominal_model, nominal_states
from hilcal.design.predicted import predicted_uncertainty, prediction_poses
from hilcal.effects.catalogue import installed
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.carried.carried_prior import carried_prior
from hilcal.identification.carried.posterior import Posterior
from hilcal.identification.fit import fit
from hilcal.identification.noise.full_covariance import with_joint_scatter
from hilcal.measuring.clearance import Clearance, LineOfSight
from hilcal.measuring.devices import TrackerSample
from hilcal.measuring.measure import average
from hilcal.measuring.route import seconds_at_rest
from hilcal.readings.whitening import MODES
from hilcal.robot.chain import evaluate
from tests.support.arm_cases import ARMS, arm_of
from tests.support.arm_cases import cell_of as odd_cell
from tests.support.campaigns import (
    campaign,
    cell_of,
    configuration,
    measured,
    noiseless,
    plan,
    with_noise,
    world_of,
)
from tests.support.cli_cases import CELL as DEMO
from tests.support.cli_cases import ok
from tests.support.fit_cases import fitted_model, parameters_by_effect
from tests.support.fit_cases import predicted as read
from tests.support.observer_cases import NORMAL, POINTS, STD, observed
from tests.support.plan_cases import (
    changed,
    config_of,
    everything_once,
    poses_in,
    poses_of,
    problem_of,
)
from tests.support.reflector_cases import NAMES, OFFSETS, reflectors
from tests.support.refusals import refusal
from tests.support.rows import first


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("known", [True, False])
def test_prediction_is_what_identification_states(mode, known):
    # An unknown registration is planned with the tracker about where it stands.
    c = campaign(mode=mode, poses=16, seed=3, registration_known=known)
    config = config_of(mode)
    fitted = fitted_model(c.cell, c.readings, mode)
    if not known:
        r = c.world.registration
        place = tuple(float(x) for x in -r[:3, :3].T @ r[:3, 3])
        config = changed(config, sight={"tracker_m": place})
    as_stated(c, config, fitted, 0.01 if known else 0.05, JOINTS)


JOINTS = tuple(f"joint_compliance.j{k}" for k in range(1, 7))


def as_stated(c, config, found, rel, names):
    """What a plan predicts for the readings of a campaign is what the fit to them states."""
    p = problem_of(c.cell.with_config(config), poses_in(c.readings))
    foreseen = predicted_uncertainty(p, everything_once(p)).by_name()
    stated = dict(zip(foreseen, found.uncertainty.formal, strict=True))
    for name in names:
        assert foreseen[name] == pytest.approx(stated[name], rel=rel), name


@pytest.mark.parametrize("mode", MODES)
def test_prediction_is_what_identification_states_of_several_targets(mode):
    config = changed(config_of(mode), repeatability={"joint_std_rad": 5e-5})
    c = reflectors(poses=14, joint_std=5e-5, known=(True, False, True), registration_known=True)
    # in deflections a prior of another size holds the offset
    offset = ("target_offset.R2.x",) if mode == "absolute" else ()
    as_stated(c, config, fitted_model(c.cell, c.readings, mode), 0.05, (*offset, *JOINTS))


@pytest.mark.parametrize("mode", first(1, MODES))
@pytest.mark.long
def test_parameters_and_positions_scatter_as_predicted(mode):
    cell = cell_of(registration_known=True)
    config = config_of(mode, work_load="10kg")
    q = poses_of(10, 5)
    a = nominal_model(cell.with_config(config))
    p = problem(a, config, q)
    work = prediction_poses(a, config, poses_of(12, 6))
    expected = predicted_uncertainty(p, everything_once(p), work=work)
    clean = read(a.model, noiseless(world_of(cell, np.random.default_rng(0)), plan(10, 5)), a.theta)
    thetas = []
    for k in range(60):
        readings = with_noise(clean, np.random.default_rng(100 + k))
        thetas.append(fit(a.model, readings, mode, start=a.theta).theta)
    away = np.array(thetas) - a.theta
    # The mean of 60 χ² of 6 parameters: 1 within three of its standard errors.
    white = np.linalg.solve(np.linalg.cholesky(cov_of(p)), (away / p.scale).T)
    assert np.mean(white**2) == pytest.approx(1.0, abs=3 * np.sqrt(2 / white.size))
    assert np.std(away, axis=0) / expected.std == pytest.approx(np.ones(6), abs=3 / np.sqrt(120))
    shown = np.einsum("tip,kp->kti", work.derivative, away / p.scale)
    scatter = np.sqrt(np.mean(np.sum(shown**2, axis=2)))
    assert scatter == pytest.approx(expected.position, rel=0.15)


def cov_of(p):
    return np.linalg.inv(p.information(everything_once(p)))


@pytest.mark.parametrize("thermometer", ["air", "joints"])
def test_a_plan_goes_on_from_an_effect_of_either_thermometer(thermometer):
    cell = cell_of()
    states = nominal_states(np.zeros((3, cell.arm.n)), np.zeros((3, 6)))
    options = {"temperature": thermometer}
    effect = installed().make("thermal_growth", cell, states, options)
    model = nominal_model(cell.with_config(config_of("absolute"))).model + effect
    assert np.isfinite(model.predict(states, np.zeros(model.size)).observation.position).all()


@given(name=st.sampled_from(ARMS), seed=st.integers(0, 10**6))
def test_a_deflection_unit_is_a_pose_whose_place_is_unknown(name, seed):
    """Deflections know what positions know when the pose's own offset is free (Schur)."""
    rng = np.random.default_rng(seed)
    cell = odd_cell(arm_of(name))
    q = rng.uniform(-2, 2, (2, cell.arm.n))
    d = config_of("deflection", against=("joint_tilt_compliance", "base_compliance"))
    units = problem_of(cell.with_config(d), q)
    a = nominal_model(cell.with_config(d))
    # The same readings as positions, in the deflections' scales.
    ab = config_of("absolute")
    states = nominal_states(np.repeat(q, 5, axis=0), np.tile(units.candidates.wrench, (2, 1)))
    model, families = a.model, units.families
    prediction = model.predict(states, a.theta)
    jac = model.jacobian_of((*model.effects, *families), prediction, a.theta, 3) * units.scale
    v = reading_covariance(a, ab, prediction)
    for k, (pose, loads) in enumerate(units.contents):
        index = [0, *(units.candidates.loads.index(x) for x in loads)]
        rows = np.array([5 * pose + i for i in index])
        weight = np.linalg.inv(v[rows])
        both = np.einsum("nip,nij,njq->pq", jac[rows], weight, jac[rows])
        cross = np.einsum("nip,nij->pj", jac[rows], weight)
        schur = both - cross @ np.linalg.solve(weight.sum(axis=0), cross.T)
        information = units.units.rows[k].T @ units.units.rows[k]
        size = np.sqrt(np.outer(np.diag(both), np.diag(both)))
        assert np.all(np.abs(information - schur) <= 1e-9 * size)


@pytest.mark.parametrize("mode", MODES)
def test_what_was_measured_is_known_exactly(mode):
    c = campaign(mode=mode, poses=12, seed=1, target_known=False)
    fitted = fitted_model(c.cell, c.readings, mode)
    config = config_of(mode)
    p = problem(model_after(fitted, config), config, poses_of(3))
    uncertainty = predicted_uncertainty(p)
    flat = np.isinf(fitted.solution.prior)
    ratio = (uncertainty.std / fitted.uncertainty.formal)[flat & fitted.uncertainty.identifiable]
    assert ratio == pytest.approx(np.ones(len(ratio)), rel=1e-6)
    assert np.isinf(uncertainty.std[flat & ~fitted.uncertainty.identifiable]).all()
    identified = np.isfinite(uncertainty.std)
    assert np.all(identified == fitted.uncertainty.identifiable)


def test_planning_on_predicts_the_fit_to_all_readings():
    cell = cell_of(registration_known=True)
    world = world_of(cell, np.random.default_rng(3))
    p = plan(20, 8)
    readings = measured(world, p, np.random.default_rng(4))
    first = readings[readings.pose < 8]
    config = config_of("absolute", against=("joint_stiffening",))
    effects = ("joint_compliance", "encoder_offset")
    begun = fitted_model(cell, first, "absolute", effects)
    later = problem(model_after(begun, config), config, poses_of(20, 8)[8:])
    expected = predicted_uncertainty(later, everything_once(later))
    fitted = fitted_model(cell, readings, "absolute", effects)
    assert expected.std == pytest.approx(fitted.uncertainty.formal, rel=0.02)
    # The potential terms were measured as well: what is known of all together.
    wider = (*effects, "joint_stiffening")
    whole = fitted_model(cell, readings, "absolute", wider)
    information = later.information(everything_once(later))
    information[np.arange(12, 18), np.arange(12, 18)] -= 1.0
    std = np.sqrt(np.diag(np.linalg.inv(information))) * later.scale
    assert std == pytest.approx(whole.uncertainty.formal, rel=0.02)


def test_a_fit_that_is_not_whitened_is_refused():
    c = campaign(mode="absolute", poses=8, registration_known=True)
    fitted = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute", "none")
    refusal("scaling gc, this one has none", model_after, fitted, config_of())


@pytest.mark.parametrize("m", first(1, [3, 6]))
def test_averaging_leaves_the_systematic_share(m):
    """The covariance that a run states of its mean, on average over many readings."""
    rng = np.random.default_rng(2)
    acquire, still = {"systematic_share": 0.3, "samples": 5}, {"joint_std_rad": 0.0}
    config = changed(config_of(noise="averaged"), acquire=acquire, repeatability=still)
    a = nominal_model(cell_of(registration_known=True).with_config(config), m)
    states = nominal_states(poses_of(1), np.zeros((1, 6)))
    prediction = a.model.predict(states, a.theta)
    one = changed(config, acquire={"systematic_share": 1.0})
    sample = reading_covariance(a, one, prediction)[0]
    stated = []
    for _ in range(600):
        shared = rng.multivariate_normal(np.zeros(m), 0.3 * sample)
        own_samples = rng.multivariate_normal(np.zeros(m), 0.7 * sample, 5)
        samples = [TrackerSample(k, x + shared, sample) for k, x in enumerate(own_samples)]
        stated.append(average(samples, 0.3).covariance)
    planned = reading_covariance(a, config, prediction)[0]
    size = np.sqrt(np.outer(np.diag(planned), np.diag(planned)))
    assert np.max(np.abs(np.mean(stated, axis=0) - planned) / size) < 0.02


def test_units_are_what_may_be_taken():
    config, cell = config_of("deflection"), cell_of(registration_known=True)
    a = nominal_model(cell.with_config(config))
    names = [load.name for load in config.loads]
    allowed = np.ones((4, 5), dtype=bool)
    allowed[1, 2] = False  # not the 10 kg
    allowed[2] = [False, True, True, True, True]  # not unloaded
    allowed[3] = [True, False, False, False, True]  # one load only
    p = problem(a, config, poses_of(4), allowed)
    of = [{loads for pose, loads in p.contents if pose == k} for k in range(4)]
    assert (len(of[0]), len(of[1]), len(of[2])) == (4 + 6 + 1, 3 + 3 + 1, 0)
    assert tuple(names) in of[0]
    assert all("10kg" not in loads for loads in of[1])
    assert of[3] == {(names[3],)}
    assert p.units.cost == pytest.approx([1 + len(loads) for _, loads in p.contents])
    # A unit's rows do not depend on what else may be taken.
    free = problem(a, config, poses_of(4))
    for k, what in enumerate(p.contents):
        if what in free.contents:
            other = free.units.rows[free.contents.index(what)]
            assert np.any(other)
            assert p.units.rows[k] == pytest.approx(other, abs=1e-12)
    single = problem_of(cell.with_config(config_of("absolute")), poses_of(4), allowed=allowed)
    assert sum(1 for _ in single.contents) == allowed.sum()
    assert single.units.cost == pytest.approx(np.ones(len(single.units)))
    assert (2, ("none",)) not in single.contents


def test_problems_that_cannot_be():
    config, cell = config_of("deflection"), cell_of(registration_known=True)
    a = nominal_model(cell.with_config(config))
    with pytest.raises(CannotAnswerError, match="both unloaded and under a load"):
        problem(a, config, poses_of(3), np.zeros((3, 5), dtype=bool))
    with pytest.raises(CannotAnswerError, match="no candidate pose is allowed"):
        problem(a, config, np.empty((0, 6)))
    bare = config.model_copy(update={"loads": ()})
    for begun in (problem, prediction_poses):
        refusal(r"needs \[\[loads\]\]; give one, or", begun, a, bare, poses_of(3))
    with pytest.raises(InputError, match=r"model: unknown effect 'joint_complience'.*valid:"):
        nominal_model(cell.with_config(config_of(model=("joint_complience",))))
    with pytest.raises(InputError, match="against: unknown effect 'ghost'"):
        problem_of(cell.with_config(config_of(against=("ghost",))), poses_of(3))


def test_what_cannot_be_seen_has_no_uncertainty():
    """One load along one axis: some joints are never turned by it."""
    config, cell = config_of("deflection"), cell_of(registration_known=True)
    a = nominal_model(cell.with_config(config))
    p = problem(a, config, poses_of(1))
    only = np.array([float(loads == ("5kg",)) for _, loads in p.contents])
    work = prediction_poses(a, config, poses_of(5))
    uncertainty = predicted_uncertainty(p, only, work=work)
    assert np.isinf(uncertainty.std).any()  # three numbers measured, six compliances
    assert np.isinf(uncertainty.position)
    assert np.isfinite(predicted_uncertainty(p, everything_once(p) * 0 + 1.0).std).any()


CELL = cell_of(registration_known=True)


def made(mode="deflection", against="catalogue", poses=40, **planning):
    return problem_of(
        CELL.with_config(config_of(mode, against=against, **planning)), poses_of(poses)
    )


@pytest.mark.parametrize("mode", MODES)
def test_potential_terms_are_as_large_as_arms_have_them(mode):
    """One that no reading could show is left out."""
    p = made(mode)
    assert p.families
    for e in p.families:
        where = p.of_effect(e.name)
        expected = np.exp([e.expected_log_std(pool)[0] for pool in e.pools()]) * e.magnitudes
        assert p.scale[where] == pytest.approx(expected, rel=1e-12)
        assert p.prior[np.ix_(where, where)] == pytest.approx(np.eye(len(where)))
    single = np.array([len(loads) == 1 for _, loads in p.contents])
    shift = p.units.rows[single][:, :3]
    for e in p.families:
        size = np.sqrt(np.mean(np.sum(shift[:, :, p.of_effect(e.name)] ** 2, axis=2)))
        assert size > 0.9 / MOST_TIMES, e.name  # other poses than those by which it was chosen


@pytest.mark.parametrize("mode", MODES)
def test_the_catalogue_is_planned_for_or_said_not_to_be(mode):
    p = made(mode)
    assert len(p.terms) <= MOST_PARAMETERS
    for kind in installed().effects:
        name = kind.name
        planned = name in {t.effect for t in p.terms}
        said = any(note.startswith(f"{name}: not planned for") for note in p.notes)
        if not kind.applies(CELL) or kind.role in FRAME_ROLES:
            assert not planned  # the arm has no slide; the cell states its frames
            assert not said
        elif not kind.needs:
            assert planned != said
        else:
            assert not planned  # only the order of a plan tells them


def test_a_stated_place_of_the_target_is_planned_against_where_asked_for():
    assert {e.name for e in made("absolute", ("target_offset",)).families} == {"target_offset"}


def test_deflections_do_not_plan_for_what_cancels_in_them():
    assert "transmission_error" not in {t.effect for t in made("deflection").terms}
    assert "transmission_error" in {t.effect for t in made("absolute").terms}


def test_a_load_that_no_pose_bears_is_as_good_as_none():
    """As two weights of the demo at an arm of a smaller payload."""
    config = config_of("deflection", against="catalogue")
    q, loads = poses_of(30), len(config.loads)
    allowed = np.ones((30, 1 + loads), dtype=bool)
    allowed[:, -1] = False
    borne = problem_of(CELL.with_config(config), q, allowed=allowed)
    without = problem_of(
        CELL.with_config(config.model_copy(update={"loads": config.loads[:-1]})), q
    )
    assert borne.contents == without.contents
    assert borne.terms == without.terms
    np.testing.assert_allclose(*(p.information(np.ones(len(p.contents))) for p in (borne, without)))


def test_potential_terms_only_add_uncertainty():
    problems = made(), made(against=())
    work = prediction_poses(problems[0].nominal, config_of("deflection"), poses_of(5, 9))
    uncertainty, bare = (predicted_uncertainty(p, everything_once(p), work=work) for p in problems)
    assert uncertainty.std == pytest.approx(bare.std, rel=1e-9)
    assert bare.position_open == pytest.approx(bare.position, rel=1e-9)
    assert uncertainty.position_open > bare.position


def test_asked_for_effects_that_the_order_tells_are_taken_at_random():
    p = made(against=("hysteresis",), poses=10)
    assert len(p.of_effect("hysteresis")) == 6
    assert any("approach of the readings drawn at random" in note for note in p.notes)


def test_derivatives_where_the_robot_works():
    for mode, load in (("absolute", "none"), ("absolute", "10kg"), ("deflection", "10kg")):
        config = config_of(mode, work_load=load)
        a = nominal_model(CELL.with_config(config))
        q = poses_of(3)
        work = prediction_poses(a, config, q)
        wrench = next((x.wrench(CELL.gravity) for x in config.loads if x.name == load), np.zeros(6))

        def at(theta, a=a, work=work, wrench=wrench, mode=mode):
            out = 0.0
            signs = ((1, wrench), (-1, 0 * wrench)) if mode == "deflection" else ((1, wrench),)
            for sign, w in signs:
                states = nominal_states(work.q, np.tile(w, (len(work.q), 1)))
                out = out + sign * a.model.predict(states, theta).observation.position
            return out

        for k, scale in enumerate(p.scale for e in a.model.effects for p in e.parameters):
            step = np.zeros(a.model.size)
            step[k] = 1e-2 * scale
            slope = (at(a.theta + step) - at(a.theta - step)) / 2e-2
            # The Jacobian leaves out what is smaller by deflection over reach.
            near = 2e-2 * np.abs(slope).max() + 1e-12
            assert work.derivative[:, :, k] == pytest.approx(slope, abs=near)


def test_unloaded_work_with_deflections_is_under_each_load():
    config = config_of("deflection")
    a = nominal_model(CELL.with_config(config))
    work = prediction_poses(a, config, poses_of(3))
    assert work.description == "deflection under each load at 3 feasible poses"
    assert len(work.q) == 12
    assert np.all(np.abs(work.derivative).max(axis=(1, 2)) > 0)


def test_named_work_and_a_box():
    q = poses_of(2)
    named = config_of("absolute", work_q_rad=tuple(tuple(x) for x in q))
    a = nominal_model(CELL.with_config(named))
    assert prediction_poses(a, named, poses_of(9, 3)).q == pytest.approx(q)
    short = config_of("absolute", work_q_rad=((0.0, 1.0),))
    refusal("2 values; ur10e has 6 joints", prediction_poses, a, short, q)
    degrees = config_of(
        "absolute", work_q_rad=((0.0, 1.0, 1.0, 0.0, 1.0, 0.0), (0.0, -90.0, *q[0, 2:]))
    )
    message = "vector 2: joint 2 is at -90 rad; its range is -6.283 to 6.283 rad"
    refusal(message, prediction_poses, a, degrees, q)
    low, high = (0.3, -0.6, 0.2), (1.0, 0.6, 0.9)
    box = config_of("absolute", work_min_m=low, work_max_m=high)
    work = prediction_poses(a, box, np.empty((0, 6)), lambda x: x[:, 0] > 0.1)
    at = evaluate(CELL.arm, work.q).point(CELL.target[:3, 3])
    assert len(work.q) >= 50
    assert np.all((at >= low) & (at <= high))
    assert np.all(work.q[:, 0] > 0.1)
    away = config_of("absolute", work_min_m=(5.0, 5.0, 5.0), work_max_m=(6.0, 6.0, 6.0))
    with pytest.raises(CannotAnswerError, match="widen the box"):
        prediction_poses(a, away, q, lambda x: x[:, 0] > 0.1)


CARRIED = ("joint_compliance", "joint_tilt_compliance")


@cache
def learnt():
    c = campaign("joint_tilt_compliance", "absolute", 1, poses=30, registration_known=True)
    fitted = fitted_model(c.cell, c.readings, "absolute", CARRIED)
    return Posterior.of(fitted)


def problem_with(prior, names=CARRIED):
    config = changed(configuration(), planning={"model": names, "against": ()})
    nominal = nominal_model(cell_from_config(config), 3, prior=prior)
    return problem(nominal, config, np.unique(plan(4, 5).states.q, axis=0))


def std(of):
    return predicted_uncertainty(of, np.ones(len(of.units))).by_name()


def test_what_is_known_is_in_the_prediction():
    alone, known = std(problem_with(None)), std(problem_with(carried_prior(learnt())))
    assert known.keys() == alone.keys()
    carried_std = dict(zip(learnt().names, learnt().std, strict=True))
    for name in learnt().names:
        assert known[name] < min(alone[name], carried_std[name])


def test_effects_that_only_the_prior_knows_are_planned_for():
    result = problem_with(carried_prior(learnt()), CARRIED[:1])
    assert "joint_tilt_compliance" in result.nominal.model.names


def test_a_prior_that_knows_nothing_changes_no_prediction():
    p = learnt()
    nothing = carried_prior(replace(p, information=np.zeros_like(p.information)))
    alone, known = std(problem_with(None)), std(problem_with(nothing))
    np.testing.assert_allclose(list(known.values()), list(alone.values()), rtol=1e-9)


def test_of_another_arm_is_refused():
    p = learnt()
    refusal("nominal links", problem_with, carried_prior(replace(p, links=1.01 * p.links)))


CASES = {
    "distance": (["A", "B"], {k: Point(position_m=POINTS[k], std_m=STD) for k in "AB"}, {}),
    "height": (["G"], {}, {"G": Gauge(direction=tuple(NORMAL), std_m=STD)}),
}


@pytest.mark.parametrize("what", CASES)
def test_predicted_uncertainties_are_those_of_a_fit(what):
    who, points, gauges = CASES[what]
    tracker, plain = {"frame": "base", "observes": what}, config_of("absolute", noise="averaged")
    config = changed(plain, tracker=tracker, acquire={"samples": 1})
    config = config.model_copy(update={"points": points, "gauges": gauges})
    cell = replace(cell_of(), config=config, registration_known=True)
    c = observed(who, 7, cell=cell, base=True)
    joint_std = config.repeatability.per_joint(6)
    readings = with_joint_scatter(cell, c.readings, joint_std)
    f = fitted_model(cell, readings, "absolute")

    _, first = np.unique(readings.pose, return_index=True)
    of = problem_of(cell.with_config(config), readings.states.q[first])
    assert len(of.contents) == len(first) * 5
    information = of.information(np.ones(len(of.contents))) - of.prior + of.measured
    names = [t.name for t in of.terms]
    compliances = [k for k, name in enumerate(names) if name.startswith("joint_compliance")]
    frames = [k for k, name in enumerate(names) if name.startswith("observer_frame")]
    kept = np.array([*compliances, *frames])
    covariance = np.linalg.pinv(information[np.ix_(kept, kept)], rcond=1e-12)
    std = np.sqrt(np.diagonal(covariance))[: len(compliances)] * of.scale[compliances]
    fitted = parameters_by_effect(f)
    for name, planned in zip((names[k] for k in compliances), std, strict=True):
        if np.isfinite(fitted[name][1]):
            assert planned == pytest.approx(fitted[name][1], rel=0.25), name


@pytest.mark.long
def test_a_cell_of_distances_is_planned(tmp_path, capsys):
    text = DEMO.read_text().replace("candidates = 250", "candidates = 60\nagainst = []")
    text = text.replace('frame = "tracker"', 'frame = "base"\nobserves = "distance"')
    (tmp_path / "cell.toml").write_text(text + "\n[points.A]\nstd_m = 1e-5\n[points.B]\n")
    out = tmp_path / "plan.json"
    ok(capsys, "plan", tmp_path / "cell.toml", "--poses", "8", "-o", out)
    assert len({step["pose"] for step in json.loads(out.read_text())["steps"]}) >= 8


def test_devices_read_positions(tmp_path):
    keys = 'driver = "geocom"\nport = "x"\nobserves = "distance"'
    (tmp_path / "cell.toml").write_text(DEMO.read_text().replace('frame = "tracker"', keys))
    refusal(r'observes = "distance" together with driver', load_config, tmp_path / "cell.toml")


def test_sight_and_time_of_each_target():
    config, named = config_of(), zip(NAMES, OFFSETS.tolist(), strict=True)
    targets = tuple(Target(name=name, target_m=tuple(at)) for name, at in named)
    several = changed(config, tool={"target_m": None, "targets": targets})
    assert seconds_at_rest(several) > 2 * seconds_at_rest(config)
    c = reflectors(poses=6)
    cell = replace(c.cell, registration_known=True)
    q = poses_in(c.readings)
    counts = set()
    for tracker in ([3.0, 0.5, 0.4], [-2.0, 0.0, 0.5], [0.0, 0.0, 2.5]):
        view = LineOfSight(Clearance(cell.with_config(several)), np.array(tracker))
        visible = np.array([view.target_visible(q, "none", k) for k in range(3)])
        np.testing.assert_array_equal(view.unobstructed(q, "none"), visible.all(axis=0))
        for k in range(len(q)):
            hidden = view.hidden_targets(q[k : k + 1], "none")
            assert hidden == tuple(np.flatnonzero(~visible[:, k]))
            problems = " ".join(view.problems(q[k : k + 1], "none", "here"))
            assert ("between tracker and targets" in problems) == (len(hidden) == 3)
            counts.add(len(hidden))
    assert {0, 3} <= counts
