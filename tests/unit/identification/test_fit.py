"""Fits: exact without noise, free of units, honest about what the data cannot see; as values."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import Cell
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.effects.protocol import Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline, loads_differ, masses_note, with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import notes, to_json
from hilcal.model.model import Model
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import SCALINGS
from hilcal.robot import se3
from tests.support.campaigns import campaign, cell_of, noiseless, plan, true_parameters, with_noise
from tests.support.effect_cases import make
from tests.support.fit_cases import MODES, based, compliances, named, predicted

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
    found = based(c.cell, clean, "absolute")
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
        based(c.cell, few, mode)
    advised = int(re.search(told, str(caught.value))[1])
    assert 3 * advised > 6
    assert caught.value.exit_code == 4
    assert "\n" not in str(caught.value)


def test_true_parameters_lie_within_their_uncertainty():
    """A check of the whole way on one campaign of the world, at 5 σ of 12 parameters."""
    c = campaign(plan_seed=0, target_known=False, poses=20)
    found = based(c.cell, c.readings, "absolute")
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


@pytest.fixture(scope="module")
def found() -> Fit:
    c = campaign(poses=8, mode="absolute")
    return based(c.cell, c.readings, "absolute")


def test_parameters_are_those_of_the_document(found: Fit) -> None:
    assert found.parameters.to_dicts() == to_json(found)["parameters"]
    second = found.parameters["joint_compliance.j2"]
    k = [row.name for row in found.parameters].index("joint_compliance.j2")
    assert second == found.parameters[k]
    assert second.value == pytest.approx(found.theta[k])
    assert second.unit == "rad/(N·m)"


def test_an_unknown_parameter_is_refused_with_the_valid_names(found: Fit) -> None:
    with pytest.raises(InputError, match=r"did you mean .*joint_compliance.j2"):
        found.parameters["joint_complience.j2"]


def test_parameters_as_a_data_frame(found: Fit) -> None:
    frame = found.parameters.to_frame()
    assert frame.index[0] == found.parameters[0].name
    assert frame.loc["joint_compliance.j2", "std"] == found.parameters["joint_compliance.j2"].std


def test_without_pandas_the_data_frame_names_it(
    found: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(InputError, match="the package pandas is not installed: pip install pandas"):
        found.parameters.to_frame()


def test_the_summary_has_every_parameter_and_both_errors(found: Fit) -> None:
    text = found.summary()
    for row in found.parameters:
        assert f"{row.name} " in text
    assert f"{1e6 * found.error.rms_m:.1f} µm rms" in text
    assert f"{1e6 * found.holdout.rms_m:.1f} µm rms" in text


def test_residuals_in_base_axes_are_those_of_the_sensor_turned_back(found: Fit) -> None:
    registered = se3.matrix(*se3.exp(found.theta[found.model.slices()[0]]))
    assert found.model.names[0] == "base_frame"
    turn = (found.model.cell.registration @ registered)[:3, :3]
    np.testing.assert_allclose(found.residuals("base"), found.residuals() @ turn, atol=1e-15)
    with pytest.raises(InputError, match="valid: sensor, base"):
        found.residuals("tool")  # type: ignore[arg-type]


def test_predictions_and_residuals_add_up_to_the_readings(found: Fit) -> None:
    seen = found.predict(found.readings.states)
    rows = found.whitening.reading
    np.testing.assert_allclose(
        seen.position[rows] + found.residuals()[:, :3], found.readings.value[rows, :3], atol=1e-12
    )


# --- units and scaling ----------------------------------------------------------------------


def in_other_lengths(cell: Cell, readings: Readings, k: float) -> tuple[Cell, Readings]:
    """The same cell and readings where lengths are in 1/k m; forces stay in N."""

    def moved(poses):
        out = poses.copy()
        out[..., :3, 3] *= k
        return out

    arm = cell.arm
    other = replace(
        cell,
        arm=replace(arm, links=moved(arm.links), coms=k * arm.coms, torque_max=k * arm.torque_max),
        target=moved(cell.target),
        load_point=k * cell.load_point,
        tool_com=k * cell.tool_com,
        registration=moved(cell.registration),
    )
    unit = np.repeat([k, 1.0], 3)[: readings.m]
    states = readings.states
    wrench = states.wrench * np.repeat([1.0, k], 3)
    return other, replace(
        readings,
        states=replace(states, wrench=wrench),
        value=readings.value * unit,
        covariance=readings.covariance * unit[:, None] * unit,
    )


POWER = {"m": 1, "m/s": 1, "rad": 0, "rad/s": 0, "rad/(N·m)": -1, "rad/(N·m)³": -3}


def effect_in_other_lengths(effect: Effect, cell: Cell, k: float) -> Effect:
    """The same effect of the other cell, its ordinary magnitudes in the other unit."""
    mine = effect.parameters

    class Other(type(effect)):
        @property
        def parameters(self):
            return tuple(replace(p, scale=p.scale * k ** POWER[p.unit]) for p in mine)

    options = dict(effect.options)
    if "prior_m" in options:
        options["prior_m"] *= k
    none = States(q=np.zeros((1, 6)), wrench=np.zeros((1, 6)))
    states = replace(none, time=np.zeros(1), approach=np.ones((1, 6)))
    return Other(cell, states, options)


@pytest.mark.parametrize("k", [1e3, 1 / 0.0254])
@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_units_do_not_matter(mode, m, k):
    c = campaign("base_compliance", mode, plan_seed=0, target_known=False, m=m)
    cell, readings = in_other_lengths(c.cell, c.readings, k)
    names = ("joint_compliance", "joint_stiffening", "transmission_error")
    model = with_effects(c.cell, c.readings, mode, names)
    registered, _ = in_other_lengths(model.cell, readings, k)
    effects = tuple(effect_in_other_lengths(e, registered, k) for e in model.effects)
    unit = np.array([k ** POWER[p.unit] for e in model.effects for p in e.parameters])
    a = fit(model, c.readings, mode)
    b = fit(Model(registered, effects), readings, mode)
    assert cell.arm.reach == pytest.approx(k * c.cell.arm.reach)
    assert np.abs((b.theta / unit - a.theta) / unit_of_noise(a)).max() < 1e-5
    seen = a.uncertainty.identifiable
    np.testing.assert_array_equal(b.uncertainty.identifiable, seen)
    np.testing.assert_allclose((b.uncertainty.std / unit)[seen], a.uncertainty.std[seen], rtol=1e-5)
    assert b.rank == a.rank
    assert b.chi2 == pytest.approx(a.chi2, rel=1e-6)
    assert b.dof == pytest.approx(a.dof, rel=1e-6)
    assert b.holdout.rms_sigma == pytest.approx(a.holdout.rms_sigma, rel=1e-5)
    assert b.holdout.rms_m == pytest.approx(k * a.holdout.rms_m, rel=1e-5)


def unit_of_noise(found: Fit) -> np.ndarray:
    """Formal standard uncertainties; ordinary magnitudes where there are none."""
    scale = np.array([p.scale for e in found.model.effects for p in e.parameters])
    formal = found.uncertainty.formal
    return np.where(formal > 0, formal, scale)


def test_without_scaling_the_unit_of_length_decides_where_rotations_are_read():
    """What `none` is kept for: to show that it is wrong."""
    c = campaign(plan_seed=0, registration_known=True, m=6)
    cell, readings = in_other_lengths(c.cell, c.readings, 1e3)
    off = {}
    for scaling in SCALINGS:
        a = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute", scaling)
        b = fit(baseline(cell, readings, "absolute"), readings, "absolute", scaling)
        off[scaling] = float(np.abs((1e3 * b.theta - a.theta) / a.uncertainty.std).max())
    assert off["gc"] < 1e-3
    assert off["gu"] < 1e-3
    assert off["none"] > 0.1


def test_scalings_agree_where_they_must_and_differ_where_errors_correlate():
    c = campaign(plan_seed=0, registration_known=True)
    n = len(c.readings)
    model = baseline(c.cell, c.readings, "absolute")
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


class Rescaled(JointCompliance):
    """The same effect with other ordinary magnitudes."""

    @property
    def parameters(self):
        factors = [30.0, 0.1, 3.0, 0.3, 10.0, 2.0]
        return tuple(
            replace(p, scale=f * p.scale) for p, f in zip(super().parameters, factors, strict=True)
        )


@pytest.mark.parametrize("mode", MODES)
def test_parameter_scaling_conditions_the_problem_but_not_the_answer(mode):
    c = campaign(plan_seed=0, registration_known=True)
    plain = based(c.cell, c.readings, mode)
    model = Model(c.cell, (Rescaled(c.cell, c.readings.states),))
    scaled = fit(model, c.readings, mode)
    np.testing.assert_allclose(
        scaled.theta, plain.theta, rtol=0, atol=1e-4 * plain.uncertainty.std.min()
    )
    np.testing.assert_allclose(scaled.uncertainty.std, plain.uncertainty.std, rtol=1e-6)


def test_scaling_parameters_of_different_units_lowers_the_condition():
    c = campaign(plan_seed=0, target_known=False)
    found = based(c.cell, c.readings, "absolute")
    basis = found.solution.equations.basis
    assert basis.condition_scaled < 0.1 * basis.condition_unscaled
    # Both are properties of the data, not of the magnitudes that someone thought ordinary.
    other = Model(found.model.cell, (found.model.effects[0], found.model.effects[1]))
    other = other + Rescaled(found.model.cell, c.readings.states)
    again = fit(other, c.readings, "absolute").solution.equations.basis
    assert again.condition_scaled == pytest.approx(basis.condition_scaled, rel=1e-3)
    assert again.condition_unscaled == pytest.approx(basis.condition_unscaled, rel=1e-3)


C = campaign("none", "absolute", 0, poses=12)
TRUE = C.world.physics.joint_compliance
BARE = replace(C.cell, arm=replace(C.cell.arm, masses=np.zeros(6), coms=np.zeros((6, 3))))


def ratios(f: Fit) -> np.ndarray:
    """Compliances by the true ones, of joints 2 and 3, which carry the weight."""
    by_name = {p.name: p.value for p in f.parameters}
    return np.array([by_name[f"joint_compliance.j{j}"] / TRUE[j - 1] for j in (2, 3)])


def under(readings: Readings, *loads: str) -> Readings:
    return readings[np.isin(np.array(readings.load_names)[readings.load], loads)]


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_where_loads_differ_the_compliances_are_right(mode: str) -> None:
    f = based(BARE, C.readings, mode)
    assert ("link_mass" in f.model.names) == (mode == "absolute")
    assert ratios(f) == pytest.approx(1.0, abs=0.03)
    assert f.variance_factor == pytest.approx(1.0, abs=0.3)
    note = masses_note(f)
    if mode == "deflection":
        assert note is None
    else:
        assert "link_mass estimates what its weight does" in note
        assert sum("masses" in n for n in notes(f)) == 1


def test_without_the_weight_they_are_too_soft_and_that_is_said() -> None:
    f = based(BARE, C.readings, "absolute", ("joint_compliance",))
    assert ratios(f).max() > 1.3
    assert "hilcal add RUN link_mass" in masses_note(f)
    told = based(C.cell, C.readings, "absolute", ("joint_compliance",))
    assert ratios(told) == pytest.approx(1.0, abs=0.03)
    assert masses_note(told) is None


def test_under_one_load_nothing_tells_them_apart_and_that_is_said() -> None:
    light = under(C.readings, "5kg")
    assert not loads_differ(light)
    f = based(BARE, light, "absolute")
    assert "link_mass" not in f.model.names
    assert ratios(f)[0] > 2.0
    assert "no pose was read under two loads" in masses_note(f)
    assert loads_differ(under(C.readings, "none", "5kg"))
