"""Fits: exact without noise, in few steps, free of units, honest about what data cannot see."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as sl

from hilcal.cell import Cell
from hilcal.effects.protocol import EffectSpec
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline, loads_differ, loads_note, with_effects
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.fit import fit
from hilcal.identification.fit_document import notes, to_json
from hilcal.identification.gauss_newton import TALL, NewtonPoint, linear_problem, regularise
from hilcal.identification.residual import residual
from hilcal.library import read_table
from hilcal.model.model import Model
from hilcal.readings.readings import States
from hilcal.readings.whitening import SCALINGS, whitening
from hilcal.robot import se3
from hilcal.robot.catalogue import configs_dir
from tests.support.campaigns import campaign, cell_of, noiseless, plan
from tests.support.effect_cases import make
from tests.support.fit_cases import MODES, fitted_model, parameters_by_effect, predicted
from tests.support.readings_cases import readings_at
from tests.support.refusals import refusal, refusal_of
from tests.support.rows import first

FRAMES = ("base_frame", "target_offset", "encoder_offset")
WAVES = ("joint_compliance", "transmission_error")
GEOMETRY = ("joint_compliance", "link_geometry")


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_parameters_are_recovered_exactly_without_noise(mode, m):
    c = campaign(plan_seed=0, registration_known=True, m=m)
    model = baseline(c.cell, c.readings, mode)
    truth = c.world.physics.joint_compliance
    fitted = fit(model, predicted(model, c.readings, truth), mode)
    assert fitted.solution.converged
    # Steps end below 1e-5 σ and shrink at least tenfold each.
    np.testing.assert_array_less(np.abs(fitted.theta - truth), 1e-6 * fitted.uncertainty.formal)
    np.testing.assert_allclose(fitted.theta, truth, rtol=1e-8)
    assert fitted.chi2 < 1e-8
    if m == 3:  # and by mechanics of its own: equilibria there hold to 1e-12 rad of 1e-3
        fitted = fit(model, noiseless(c.world, plan()), mode)
        np.testing.assert_allclose(fitted.theta, truth, rtol=1e-8)


def far_off(rng):
    """A base turned by degrees, a target off by centimetres, zeros off by degrees.

    The first zero is the base's turn about z, the last one the target's.
    """
    base, target = rng.uniform(-0.1, 0.1, 6), rng.uniform(-0.05, 0.05, 6)
    return np.concatenate([base, target, [0.0], rng.uniform(-0.08, 0.08, 4), [0.0]])


def of_names(names, cell, states, m):
    return Model(cell, tuple(make(n, cell, states, m=m) for n in names))


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("seed", range(3))
def test_geometry_converges_from_large_errors(m, seed):
    c = campaign(plan_seed=0, registration_known=True, m=m)
    bare = c.readings[c.readings.unloaded]
    model = of_names(FRAMES, replace(c.cell, gravity=np.zeros(3)), bare.states, m)
    truth = far_off(np.random.default_rng(seed))
    truth = truth if m == 6 else np.delete(truth, [9, 10, 11])
    fitted = fit(model, predicted(model, bare, truth), "absolute")
    assert fitted.solution.converged
    assert fitted.solution.iterations <= 8
    assert fitted.error.max_m < 1e-10


def test_the_same_data_give_the_same_numbers_and_a_fit_is_found_again_from_its_own():
    c = campaign("transmission_error", plan_seed=0)
    model = with_effects(c.cell, c.readings, "absolute", WAVES)
    a, b = (fit(model, c.readings, "absolute") for _ in range(2))
    np.testing.assert_array_equal(a.theta, b.theta)
    np.testing.assert_array_equal(a.uncertainty.std, b.uncertainty.std)
    assert to_json(a) == to_json(b)
    again = fit(model, c.readings, "absolute", start=a.theta, prior=a.solution.prior)
    # Steps below 1e-5 σ count as none; seen along the least determined direction.
    assert np.nanmax(np.abs(again.theta - a.theta) / a.uncertainty.std) < 1e-3
    assert again.chi2 == pytest.approx(a.chi2, rel=1e-6)


def test_which_families_stay_does_not_depend_on_where_a_fit_starts():
    c = campaign("link_geometry", "absolute", 1, poses=30, m=3, strength=3.0)
    model = with_effects(c.cell, c.readings, "absolute", (*WAVES, "link_geometry"))
    far = fit(model, c.readings, "absolute")
    near = fit(model, c.readings, "absolute", start=far.theta)
    np.testing.assert_array_equal(far.solution.prior > 0, near.solution.prior > 0)
    assert near.chi2 == pytest.approx(far.chi2, rel=1e-3)


def test_the_order_of_readings_and_of_effects_does_not_matter():
    c = campaign(plan_seed=0, target_known=False)
    fitted = fitted_model(c.cell, c.readings, "absolute", ("joint_compliance", "hysteresis"))
    shuffled = c.readings[np.random.default_rng(1).permutation(len(c.readings))]
    turned = replace(fitted.model, effects=fitted.model.effects[::-1])
    other = parameters_by_effect(fit(turned, shuffled, "absolute"))
    for name, (value, std) in parameters_by_effect(fitted).items():
        assert other[name][0] == pytest.approx(value, abs=1e-4 * std), name
        assert other[name][1] == pytest.approx(std, rel=1e-6), name


def seen_directions(model, readings, m):
    """Numeric rank of the scaled Jacobian, by differences of the prediction."""
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    base = model.predict(readings.states, np.zeros(model.size)).observation.rotation
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
    visible = values > 1e-5 * values[0]
    assert not np.any((values > 1e-6 * values[0]) & ~visible)
    return int(visible.sum())


@pytest.mark.parametrize(("m", "expected"), [(3, 27), (6, 30)])
def test_an_over_complete_model_has_the_rank_that_the_arm_has(m, expected):
    """Six axes are lines (4 each); the target at rest adds a position (3) or a pose (6)."""
    c = campaign("link_geometry", plan_seed=0, poses=30, target_known=False, m=m)
    r = c.readings[c.readings.unloaded]
    r = replace(r, states=replace(r.states, wrench=0 * r.states.wrench))
    fitted = fitted_model(replace(c.cell, gravity=np.zeros(3)), r, "absolute", ("link_geometry",))
    assert seen_directions(fitted.model, r, m) == fitted.rank == expected
    assert len(fitted.uncertainty.null) == fitted.model.size - expected


def test_what_cannot_be_seen_is_named_and_has_no_number():
    c = campaign("link_geometry", plan_seed=0, poses=30)
    fitted = fitted_model(c.cell, c.readings, "absolute", GEOMETRY)
    u, model, document = fitted.uncertainty, fitted.model, to_json(fitted)
    compliance, links = (model.slices()[model.names.index(name)] for name in GEOMETRY)
    assert fitted.rank < model.size
    np.testing.assert_array_equal(np.isinf(u.std), ~u.identifiable)
    # A shift along a joint's axis can be made before or after the joint.
    assert not u.identifiable[links][2:38:6].any()
    assert u.identifiable[compliance].all()
    for p, identifiable in zip(document["parameters"], u.identifiable, strict=True):
        assert (p["value"] is None) == (p["std"] is None) == (not identifiable)
        assert p["identifiable"] == bool(identifiable)
    assert len(document["unidentifiable"]) == model.size - fitted.rank
    assert all("link_geometry" in name for name in document["unidentifiable"])


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("mode", MODES)
def test_no_more_elements_than_parameters_cannot_answer(mode, count):
    c = campaign(plan_seed=0, registration_known=True)
    if mode == "deflection":
        few = c.readings[(c.readings.pose < count) & np.isin(c.readings.load, [0, 3])]
    else:
        few = c.readings[np.flatnonzero(c.readings.load == 3)[:count]]
    pattern = rf"{3 * count} measured elements for \d parameters.*measure at least (\d+)"
    line = refusal_of(CannotAnswerError, pattern, fitted_model, c.cell, few, mode)
    assert 3 * int(re.search(pattern, line)[1]) > 6


@pytest.fixture(scope="module")
def absolute_fit():
    c = campaign(poses=8, mode="absolute")
    return fitted_model(c.cell, c.readings, "absolute")


def test_parameters_are_those_of_the_document_and_of_the_data_frame(absolute_fit):
    assert absolute_fit.parameters.to_dicts() == to_json(absolute_fit)["parameters"]
    second = absolute_fit.parameters["joint_compliance.j2"]
    k = [row.name for row in absolute_fit.parameters].index("joint_compliance.j2")
    assert second == absolute_fit.parameters[k]
    assert second.value == pytest.approx(absolute_fit.theta[k])
    assert second.unit == "rad/(N·m)"
    frame = absolute_fit.parameters.to_frame()
    assert frame.index[0] == absolute_fit.parameters[0].name
    assert frame.loc["joint_compliance.j2", "std"] == second.std
    known = frame["identifiable"].to_numpy()
    np.testing.assert_allclose(np.diag(absolute_fit.covariance)[known] ** 0.5, frame["std"][known])
    with pytest.raises(InputError, match=r"did you mean .*joint_compliance.j2"):
        absolute_fit.parameters["joint_complience.j2"]


def test_residuals_in_base_axes_are_those_of_the_sensor_turned_back(absolute_fit):
    registered = se3.matrix(*se3.exp(absolute_fit.theta[absolute_fit.model.slices()[0]]))
    assert absolute_fit.model.names[0] == "base_frame"
    turn = (absolute_fit.model.cell.registration @ registered)[:3, :3]
    np.testing.assert_allclose(
        absolute_fit.residuals("base"), absolute_fit.residuals() @ turn, atol=1e-15
    )
    refusal("valid: sensor, base", absolute_fit.residuals, "tool")
    rows, r = absolute_fit.whitening.reading, absolute_fit.readings
    added = absolute_fit.predict(r.states).position[rows] + absolute_fit.residuals()[:, :3]
    np.testing.assert_allclose(added, r.value[rows, :3], atol=1e-12)


def in_other_lengths(cell, readings, k):
    """The same cell and readings where lengths are in 1/k m; forces stay in N."""

    def moved(poses):
        out = poses.copy()
        out[..., :3, 3] *= k
        return out

    arm, states = cell.arm, readings.states
    other = replace(
        cell,
        arm=replace(arm, links=moved(arm.links), coms=k * arm.coms, torque_max=k * arm.torque_max),
        target=moved(cell.target),
        load_point=k * cell.load_point,
        tool_com=k * cell.tool_com,
        registration=moved(cell.registration),
    )
    unit = np.repeat([k, 1.0], 3)[: readings.m]
    return other, replace(
        readings,
        states=replace(states, wrench=states.wrench * np.repeat([1.0, k], 3)),
        value=readings.value * unit,
        covariance=readings.covariance * unit[:, None] * unit,
    )


POWER = {"m": 1, "m/s": 1, "rad": 0, "rad/s": 0, "rad/(N·m)": -1, "rad/(N·m)³": -3}


def effect_in_other_lengths(effect, cell, k):
    """The same effect of the other cell, its ordinary magnitudes in the other unit."""
    given = effect.parameters

    class Other(type(effect)):
        @property
        def parameters(self):
            return tuple(replace(p, scale=p.scale * k ** POWER[p.unit]) for p in given)

    options = dict(effect.options)
    if "prior_m" in options:
        options["prior_m"] *= k
    none = States(q=np.zeros((1, 6)), wrench=np.zeros((1, 6)))
    return Other(cell, replace(none, time=np.zeros(1), approach=np.ones((1, 6))), options)


@pytest.mark.parametrize("k", first(1, [1 / 0.0254, 1e3]))
@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_units_do_not_matter(mode, m, k):
    c = campaign("base_compliance", mode, plan_seed=0, target_known=False, m=m)
    cell, readings = in_other_lengths(c.cell, c.readings, k)
    a = fitted_model(c.cell, c.readings, mode, (*WAVES, "joint_stiffening"))
    registered, _ = in_other_lengths(a.model.cell, readings, k)
    effects = tuple(effect_in_other_lengths(e, registered, k) for e in a.model.effects)
    parameters = [p for e in a.model.effects for p in e.parameters]
    unit = np.array([k ** POWER[p.unit] for p in parameters])
    b = fit(Model(registered, effects), readings, mode)
    assert cell.arm.reach == pytest.approx(k * c.cell.arm.reach)
    formal = a.uncertainty.formal  # ordinary magnitudes where there are none
    noise = np.where(formal > 0, formal, [p.scale for p in parameters])
    assert np.abs((b.theta / unit - a.theta) / noise).max() < 1e-5
    identifiable = a.uncertainty.identifiable
    np.testing.assert_array_equal(b.uncertainty.identifiable, identifiable)
    np.testing.assert_allclose(
        (b.uncertainty.std / unit)[identifiable], a.uncertainty.std[identifiable], rtol=1e-5
    )
    assert b.rank == a.rank
    assert b.chi2 == pytest.approx(a.chi2, rel=1e-6)
    assert b.dof == pytest.approx(a.dof, rel=1e-6)
    assert b.holdout.rms_sigma == pytest.approx(a.holdout.rms_sigma, rel=1e-5)
    assert b.holdout.rms_m == pytest.approx(k * a.holdout.rms_m, rel=1e-5)


def test_scalings_agree_where_they_must_and_differ_where_errors_correlate():
    c = campaign(plan_seed=0, registration_known=True)
    n, model = len(c.readings), baseline(c.cell, c.readings, "absolute")
    spread = np.random.default_rng(0).uniform(1e-5, 5e-5, (n, 3))

    def all_three(covariance):
        given = replace(c.readings, covariance=covariance)
        return {s: fit(model, given, "absolute", s).theta for s in SCALINGS}

    equal = all_three(np.tile(4e-10 * np.eye(3), (n, 1, 1)))
    for other in ("none", "gu"):
        np.testing.assert_allclose(equal[other], equal["gc"], rtol=1e-8)
    diagonal = all_three(spread[:, :, None] ** 2 * np.eye(3))
    np.testing.assert_allclose(diagonal["gu"], diagonal["gc"], rtol=1e-8)
    assert np.all(diagonal["none"] != diagonal["gc"])
    correlated = all_three(c.readings.covariance)
    assert np.all(np.abs(correlated["gu"] / correlated["gc"] - 1) > 1e-6)


C = campaign("none", "absolute", 0, poses=12)
BARE = replace(C.cell, arm=replace(C.cell.arm, masses=np.zeros(6), coms=np.zeros((6, 3))))


def ratios(f):
    """Compliances by the true ones, of joints 2 and 3, which carry the weight."""
    true, by_name = C.world.physics.joint_compliance, {p.name: p.value for p in f.parameters}
    return np.array([by_name[f"joint_compliance.j{j}"] / true[j - 1] for j in (2, 3)])


def under(*loads):
    return C.readings[np.isin(np.array(C.readings.load_names)[C.readings.load], loads)]


@pytest.mark.parametrize("mode", MODES)
def test_where_loads_differ_the_compliances_are_right(mode):
    f, absolute = fitted_model(BARE, C.readings, mode), mode == "absolute"
    assert ("link_mass" in f.model.names) == absolute
    assert ratios(f) == pytest.approx(1.0, abs=0.03)
    assert f.variance_factor == pytest.approx(1.0, abs=0.3)
    note = loads_note(f)
    assert (note is None) == (not absolute)
    if absolute:
        assert "link_mass estimates what its weight does" in note
        assert sum("masses" in n for n in notes(f)) == 1


def test_without_the_weight_they_are_too_soft_and_that_is_said():
    bare, with_weight = (
        fitted_model(cell, C.readings, "absolute", ("joint_compliance",)) for cell in (BARE, C.cell)
    )
    assert ratios(bare).max() > 1.3
    assert "hilcal add RUN link_mass" in loads_note(bare)
    assert ratios(with_weight) == pytest.approx(1.0, abs=0.03)
    assert loads_note(with_weight) is None


def test_forces_of_the_wrong_sign_are_said():
    """Deflections are the same under opposite forces and compliances; no arm has such."""
    f = fitted_model(C.cell, C.readings, "deflection")
    assert loads_note(f) is None
    turned = replace(
        C.readings, states=replace(C.readings.states, wrench=-C.readings.states.wrench)
    )
    f = fitted_model(C.cell, turned, "deflection")
    assert f.variance_factor == pytest.approx(1.0, abs=0.3)
    assert "of the opposite sign" in loads_note(f)
    assert any("of the opposite sign" in n for n in notes(f))


def test_under_one_load_nothing_tells_them_apart_and_that_is_said():
    light = under("5kg")
    f = fitted_model(BARE, light, "absolute")
    assert "link_mass" not in f.model.names
    assert ratios(f)[0] > 2.0
    assert "no pose was read under two loads" in loads_note(f)
    assert [loads_differ(r) for r in (light, under("none", "5kg"))] == [False, True]


SIGMA = 2e-5
POSES, LOADS = 30, 6
STEPS = 8


def case(seed, names, soft=5.0):
    """Absolute readings of a soft UR10e, off by 2 σ in a way of its own at each pose."""
    rng = np.random.default_rng(seed)
    cell = cell_of(registration_known=True)
    q = np.repeat(rng.uniform(-2.5, 2.5, (POSES, 6)), LOADS, axis=0)
    wrench = rng.normal(size=(LOADS, 6)) * [60, 60, 60, 5, 5, 5]
    wrench[0] = 0.0
    states = States(q=q, wrench=np.tile(wrench, (POSES, 1)))
    model = Model(cell, tuple(make(name, cell, states) for name in names))
    theta = scales_of(model) * rng.normal(size=model.size)
    for e, at in zip(model.effects, model.slices(), strict=True):
        if e.elastic:
            theta[at] = soft * np.abs(theta[at])
    value = model.predict(states, theta).observation.position
    value = value + 2 * SIGMA * np.repeat(rng.normal(size=(POSES, 3)), LOADS, axis=0)
    value = value + SIGMA * rng.normal(size=value.shape)
    pose, load = np.divmod(np.arange(len(value)), LOADS)
    return model, readings_at(q, value, wrench=states.wrench, pose=pose, load=load, std=SIGMA)


def slope(fitted):
    """Difference quotient of ½ ‖r‖² by each z, where a unit of z moves all data by 1 σ."""
    w = whitening(fitted.readings, "absolute")
    steps = fitted.solution.equations.basis.transform

    def cost(theta):
        p = fitted.model.predict(fitted.readings.states, theta)
        return 0.5 * float(np.sum(w.whiten(residual(fitted.readings, p, w)) ** 2))

    h = 0.05
    return np.array(
        [(cost(fitted.theta + h * z) - cost(fitted.theta - h * z)) / (2 * h) for z in steps.T]
    )


@pytest.mark.parametrize("seed", first(1, range(3)))
@pytest.mark.parametrize(
    "more", [(), ("joint_tilt_compliance",), ("link_compliance", "target_offset")]
)
def test_a_misfit_does_not_hinder(seed, more):
    model, readings = case(seed, ("joint_compliance", "encoder_offset", *more))
    fitted = fit(model, readings, "absolute")
    assert fitted.solution.converged
    assert fitted.solution.iterations <= STEPS
    assert fitted.variance_factor > 3
    np.testing.assert_allclose(slope(fitted), 0.0, atol=2e-3)


def test_directions_that_the_readings_hardly_determine_need_few_steps(ipa_ur10):
    """Gauss-Newton alone takes 20 steps here, and 20 are no end with the next 200 poses."""
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    path = ipa_ur10 / "Series_B" / "measurements_joint_configurations.csv"
    readings = read_table(path, cell, "ipa-ur10")
    some = readings[np.random.default_rng(1).permutation(len(readings))[:200]]
    model = baseline(cell, some, "absolute")
    for name in ("link_geometry", "link_compliance", "joint_tilt_compliance", "link_mass"):
        model = model + EffectSpec(name)
    fitted = fit(model, some, "absolute")
    assert fitted.solution.converged
    assert fitted.solution.iterations <= 14
    assert fitted.chi2 / 149_592 == pytest.approx(1.0, abs=1e-5)  # as by Gauss-Newton alone


@pytest.mark.parametrize("seed", range(3))
def test_sideways_pulls_separate_the_first_joints_offset_from_the_registration(seed):
    """Turned with the arm or not, a sideways pull deflects otherwise: both are determined.

    Under weights alone, along the axis of the first joint, they are one gauge freedom.
    """
    model, readings = case(seed, ("base_frame", "joint_compliance", "encoder_offset"))
    fitted = fit(model, readings, "absolute")
    names = [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters]
    pair = [names.index("base_frame.rz"), names.index("encoder_offset.j1")]
    assert fitted.solution.converged
    assert fitted.solution.iterations <= STEPS
    assert fitted.uncertainty.identifiable[pair].all()
    wrench = readings.states.wrench * [0, 0, 1, 0, 0, 0]
    states = replace(readings.states, wrench=wrench)
    shift = (
        model.predict(states, fitted.theta).observation.position
        - model.predict(readings.states, fitted.theta).observation.position
    )
    down = fit(model, replace(readings, states=states, value=readings.value + shift), "absolute")
    assert not down.uncertainty.identifiable[pair].any()


def nearly_dependent(condition, columns):
    """Rows (2 TALL, P) of that condition number, whose columns have units over eight decades."""
    rng = np.random.default_rng(5)
    q = np.linalg.qr(rng.standard_normal((2 * TALL, columns)))[0]
    turn = np.linalg.qr(rng.standard_normal((columns, columns)))[0]
    return np.asarray(q * np.geomspace(1e8, 1e8 / condition, columns) @ turn)


def solved(a, white, scale):
    """Step of Gauss-Newton from zero, all parameters without a prior."""
    columns = a.shape[1]
    start, prior = np.zeros(columns), np.full(columns, np.inf)
    point = NewtonPoint(start, start, float(white @ white), white.size)
    linear = linear_problem(point, prior, a, white, len(a), 1.0, whitened=True)
    assert len(linear.a) == columns + 1
    assert linear.rows is a
    by = regularise(linear, scale, prior, np.full(columns, -1), choose=False)
    return np.asarray(by.basis.transform @ linear.equations(by.basis).solve(by.beta))


@pytest.mark.parametrize("condition", [1e2, 1e5, 1e8])
def test_errors_are_those_of_lapacks_qr(condition):
    """At 1e8 the normal equations AᵀA have no correct digit."""
    rng = np.random.default_rng(6)
    columns = 8
    a, units = nearly_dependent(condition, columns), np.geomspace(1e-4, 1e4, columns)
    truth = rng.standard_normal(columns)
    noise = rng.standard_normal(len(a))
    exact = np.linalg.lstsq(a, noise, rcond=None)[0]
    white = a @ truth + 1e-6 * (noise - a @ exact)
    error = np.abs(units * solved(a * units, white, 1 / units) - truth).max()
    lapack = np.abs(sl.lstsq(a, white, lapack_driver="gelsy")[0] - truth).max()
    assert error < 10 * max(lapack, 1e-14 * condition)
    if condition == 1e8:
        squared = np.abs(np.linalg.solve(a.T @ a, a.T @ white) - truth).max()
        assert squared > 1e3 * error


def test_the_summary_has_every_parameter_and_both_errors(absolute_fit):
    text = absolute_fit.summary()
    assert all(f"{row.name} " in text for row in absolute_fit.parameters)
    for error in (absolute_fit.error, absolute_fit.holdout):
        assert f"{1e6 * error.rms_m:.1f} µm rms" in text


def test_the_summary_tells_a_family_in_short(absolute_fit):
    model = with_effects(absolute_fit.model.cell, absolute_fit.readings, absolute_fit.mode, WAVES)
    text = (fitted := fit(model, absolute_fit.readings, absolute_fit.mode)).summary()
    count = sum(row.name.startswith("transmission_error.") for row in fitted.parameters)
    assert f"transmission_error: {count} parameters, the largest:" in text
    assert text.count("transmission_error.") == 1
    assert all(f"{row.name} " in fitted.summary(details=True) for row in fitted.parameters)
