"""Hidden effects and laws of one's own: strength, names, and nothing shared with hilcal's."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import hilcal.drivers.simulated
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.drivers.simulated.injected_effects import (
    DEFLECTION_EFFECTS,
    EFFECTS,
    hide_effect,
    world_without_effect,
)
from hilcal.drivers.simulated.own_law import own_law
from hilcal.drivers.simulated.rehearsal import (
    case_of_plan,
    check_choice,
    own_choices,
    simulate_plan,
)
from hilcal.drivers.simulated.world_server import read_world, write_world
from hilcal.effects.catalogue import installed
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.readings.readings import States
from studies.random_campaigns import rehearsal_states
from tests.support.campaigns import cell_of, configuration, plan
from tests.support.example_cell import ur10e_cell
from tests.support.next_cases import SMALL, first_plan
from tests.support.refusals import refusal, refusals, refuses
from tests.support.rehearsed import dead_weights
from tests.support.user_effect_cases import CLASS, COLUMNS

CELL = ur10e_cell()
WEIGHTS = dead_weights([4.0, 8.0, 12.0], CELL.gravity)
STATES, POSE, LOAD, _ = rehearsal_states(CELL, 10, WEIGHTS, np.random.default_rng(0))
VISIBLE = [(e, "absolute") for e in EFFECTS] + [(e, "deflection") for e in DEFLECTION_EFFECTS]


def without(world, effect):
    """The same world where the effect is gone."""
    gone = np.zeros_like(getattr(world.physics, effect))
    return replace(world, physics=world.physics.with_effect(effect, gone))


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize(("effect", "mode"), VISIBLE)
def test_strength_is_the_one_asked_for(effect, mode, m):
    wanted = 2.0
    world = hide_effect(effect, CELL, STATES, wanted, mode, np.random.default_rng(11), m=m)
    clean = without(world, effect)
    after, before = world.ideal_readings(STATES), clean.ideal_readings(STATES)
    change = after.position - before.position
    if m == 6:
        turn = after.rotation @ np.swapaxes(before.rotation, 1, 2)
        change = np.hstack([change, Rotation.from_matrix(turn).as_rotvec()])
    cov = clean.covariance(before, m)
    if mode == "deflection":
        first = np.array([np.flatnonzero((p == POSE) & (LOAD == 0))[0] for p in POSE])
        change, cov = (change - change[first])[LOAD > 0], (cov + cov[first])[LOAD > 0]
    squares = np.einsum("ni,nij,nj->n", change, np.linalg.inv(cov), change)
    assert np.sqrt(squares.sum() / change.size) == pytest.approx(wanted, rel=0.01)
    assert any(name.startswith(f"{effect}.") for name in world.truth)
    assert all(name.split(".")[0] in (effect, "joint_compliance") for name in world.truth)


FIRST = np.array([np.flatnonzero((p == POSE) & (LOAD == 0))[0] for p in POSE])
ABSOLUTE_ONLY = tuple(e for e in EFFECTS if e not in DEFLECTION_EFFECTS)


@pytest.mark.parametrize("effect", ABSOLUTE_ONLY)
def test_effects_that_cancel_hardly_show_in_deflections(effect):
    """They cancel to first order: where no temperature changes with the load."""
    still = replace(
        STATES,
        air_temperature=STATES.air_temperature[FIRST],
        joint_temperature=STATES.joint_temperature[FIRST],
    )
    world = hide_effect(effect, CELL, still, 3.0, "absolute", np.random.default_rng(1))
    change = (
        world.ideal_readings(still).position - without(world, effect).ideal_readings(still).position
    )
    left = np.abs(change - change[FIRST]).max()
    assert left < 0.02 * np.abs(change).max()


def test_truth_is_named_in_si():
    world = hide_effect(
        "transmission_error", CELL, STATES, 1.0, "absolute", np.random.default_rng(1)
    )
    assert len(world.truth) == 6 + 6 * 6 * 2
    assert world.truth["transmission_error.j2.sin3"] == world.physics.transmission_error[1, 2, 1]
    assert 4e-6 < world.truth["joint_compliance.j1"] < 8e-6
    world = hide_effect("joint_stiffening", CELL, STATES, 1.0, "absolute", np.random.default_rng(1))
    assert world.truth["joint_stiffening.j2"] < 0.0


@refusals("hidden")
def test_what_cannot_be_hidden_is_refused(case, given):
    effect, strength, mode = given.split()
    rng = np.random.default_rng(0)
    refuses(case, lambda: hide_effect(effect, CELL, STATES, float(strength), mode, rng))


@pytest.mark.parametrize(
    ("effect", "column"),
    [
        ("hysteresis", "approach"),
        ("tracker_drift", "time"),
        ("creep", "load_time"),
        ("thermal_growth", "air_temperature"),
        ("thermal_joint_drift", "joint_temperature"),
    ],
)
def test_states_without_what_the_effect_needs_are_refused(effect, column):
    bare = States(q=STATES.q, wrench=STATES.wrench)
    with pytest.raises(InputError, match=f"^{column}: {effect} is hidden"):
        hide_effect(effect, CELL, bare, 3.0, "absolute", np.random.default_rng(0))


@pytest.mark.parametrize("effect", ["wrench_bias", "wrench_gain", "sensor_misalignment"])
def test_a_sensor_cannot_misread_what_is_not_there(effect):
    unloaded = replace(STATES, wrench=np.zeros_like(STATES.wrench))
    with pytest.raises(InputError, match="no state has a load; valid: ") as caught:
        hide_effect(effect, CELL, unloaded, 3.0, "absolute", np.random.default_rng(0))
    assert "\n" not in str(caught.value)


def test_a_pose_without_an_unloaded_reading_is_refused():
    keep = ~((POSE == 3) & (LOAD == 0))
    with pytest.raises(InputError, match="pose 3 has no unloaded reading"):
        hide_effect(
            "base_compliance", CELL, STATES[keep], 3.0, "deflection", np.random.default_rng(0),
            pose=POSE[keep],
        )  # fmt: skip


def test_the_world_shares_no_physics_with_the_program():
    allowed = {"hilcal.robot.arm", "hilcal.cell", "hilcal.readings.readings", "hilcal.errors",
               "hilcal.types"}  # fmt: skip
    files = ("mechanics", "truth", "world", "injected_effects")
    folder = Path(hilcal.drivers.simulated.__file__).parent
    for name in files:
        for node in ast.walk(ast.parse((folder / f"{name}.py").read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, name
                names = [node.module]
            for module in names:
                own = not module.startswith("hilcal") or module.startswith("hilcal.drivers.")
                assert own or module in allowed, (name, module)


DRAWS = 4000


@pytest.mark.parametrize(("m", "known"), [(3, False), (6, False), (6, True)])
def test_sample_covariance_is_the_reported_one(m, known):
    world = world_without_effect(ur10e_cell(registration_known=known), np.random.default_rng(4))
    q = np.array([0.4, -1.2, 1.3, -0.4, 0.9, 0.3])
    states = States(np.tile(q, (DRAWS, 1)), np.tile([0.0, 0, -90, 0, 0, 0], (DRAWS, 1)))
    sight = world.ideal_readings(states[:1])
    cov = world.covariance(sight, m)[0]
    value = world.observe(states, np.random.default_rng(5), m)
    off = value[:, :3] - sight.position
    if m == 6:
        seen = Rotation.from_rotvec(value[:, 3:]) * Rotation.from_matrix(sight.rotation[0]).inv()
        off = np.hstack([off, seen.as_rotvec()])
    white = np.linalg.solve(np.linalg.cholesky(cov), off.T)
    low, high = stats.chi2.ppf([0.001, 0.999], DRAWS * m)
    assert low < np.sum(white**2) < high
    # each element of the whitened sample covariance has a deviation of 1 or √2 over √DRAWS
    np.testing.assert_allclose(white @ white.T / DRAWS, np.eye(m), atol=4.5 * np.sqrt(2 / DRAWS))
    np.testing.assert_allclose(white.mean(axis=1), 0.0, atol=4.5 / np.sqrt(DRAWS))


TURN = 3e-4


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(CLASS, encoding="utf-8")
    return path


@pytest.fixture
def law(file):
    return own_law(installed().with_file(file), "mine", cell_of(), plan(6).states)


def world_with(law, theta):
    world = world_without_effect(cell_of(), np.random.default_rng(1))
    return world, replace(world, own_law=replace(law, theta=np.array([theta])))


def test_the_target_moves_as_the_world_moves_it_when_the_joint_turns(law):
    """dq_2 = a sin(2 q_1) is a turn of joint 2: the world's own mechanics make the same."""
    bare, within = world_with(law, TURN)
    states = plan(6).states
    turned = np.zeros_like(states.q)
    turned[:, 1] = TURN * np.sin(2 * states.q[:, 0])
    before, after = bare.ideal_readings(states), within.ideal_readings(states)
    true = bare.ideal_readings(states, turned)
    shift = true.position - before.position
    assert np.linalg.norm(shift, axis=1).max() > 1e-4
    error = after.position - before.position - shift
    # The world sags under its load as it turns, the law is added to where it rests: 1 %.
    assert np.linalg.norm(error, axis=1).max() < 0.01 * np.linalg.norm(shift, axis=1).max()
    np.testing.assert_allclose(after.rotation, true.rotation, atol=0.01 * TURN)
    assert within.drifts
    assert within.truth["mine.a"] == TURN


def test_a_campaign_in_such_a_cell_reveals_it(law):
    strong = SMALL.simulation.model_copy(update={"strength_sigma": 4.0})
    config, catalogue = SMALL.model_copy(update={"simulation": strong}), law.catalogue
    secret = case_of_plan(config, first_plan(), "mine", 1, catalogue)
    assert (secret.hidden, secret.mode) == ("mine", "absolute")
    r = simulate_plan(secret, first_plan(), [1, 1])
    model = baseline(r.cell, r.readings, r.mode, catalogue)
    d = diagnose(fit(model, r.readings, r.mode))
    assert "mine" in (d.suspects[0].effect, *d.suspects[0].same_as)
    found = add(d.fit, "mine")
    true, std = secret.world.truth["mine.a"], found.uncertainty.std[-1]
    assert abs(found.theta[-1] - true) < 4 * std < abs(true)


def test_a_world_with_it_comes_back_from_its_file(law, tmp_path):
    _, world = world_with(law, TURN)
    write_world(tmp_path / "world.json", world, configuration())
    back, _ = read_world(tmp_path / "world.json")
    states = plan(6).states
    np.testing.assert_array_equal(
        back.ideal_readings(states).position, world.ideal_readings(states).position
    )
    assert back.truth == world.truth


def test_a_law_that_has_changed_since_is_refused(law, file, tmp_path):
    _, world = world_with(law, TURN)
    write_world(tmp_path / "world.json", world, configuration())
    file.write_text(CLASS.replace(COLUMNS, "values = np.sin(s.angle[:, :1])"), encoding="utf-8")
    refusal(r"mine\.py: changed since", read_world, tmp_path / "world.json")


def test_what_the_simulated_cell_does_not_measure_is_named(file):
    file.write_text(CLASS.replace("summary", 'needs = ("air_temperature",)\n    summary'))
    catalogue = installed().with_file(file)
    with pytest.raises(InputError, match="mine needs air_temperature"):
        own_law(catalogue, "mine", cell_of(), replace(plan(6).states, air_temperature=None))


def test_only_effects_of_ones_own_are_added_to_the_choices(law):
    assert own_choices(law.catalogue) == ("mine",)
    assert own_choices(installed()) == ()  # all that ship have mechanics of their own
    check_choice("mine", law.catalogue)
    refusal("hide 'mine'", check_choice, "mine", installed())
    refusal(r"hide 'mime' \(did you mean \"mine\"\?\)", check_choice, "mime", law.catalogue)
