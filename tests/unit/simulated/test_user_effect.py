"""A law of a user's own in the simulated world: where it moves the target, and how strongly."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.rehearsal import (
    case_of_plan,
    check_choice,
    simulate_plan,
    user_choices,
)
from hilcal.drivers.simulated.user_effect import hidden_user_effect
from hilcal.drivers.simulated.world_server import read_world, write_world
from hilcal.effects.catalogue import installed
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from tests.support.campaigns import cell_of, configuration, plan
from tests.support.next_cases import SMALL, first_plan
from tests.support.refusals import refusal
from tests.support.user_effect_cases import CLASS, COLUMNS

TURN = 3e-4


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(CLASS, encoding="utf-8")
    return path


@pytest.fixture
def law(file):
    return hidden_user_effect(installed().with_file(file), "mine", cell_of(), plan(6).states)


def world_with(law, theta):
    world = world_without_effect(cell_of(), np.random.default_rng(1))
    return world, replace(world, user_effect=replace(law, theta=np.array([theta])))


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
    extended = add(d.fit, "mine")
    true, std = secret.world.truth["mine.a"], extended.uncertainty.std[-1]
    assert abs(extended.theta[-1] - true) < 4 * std < abs(true)


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
        hidden_user_effect(
            catalogue, "mine", cell_of(), replace(plan(6).states, air_temperature=None)
        )


def test_only_effects_of_ones_own_are_added_to_the_choices(law):
    assert user_choices(law.catalogue) == ("mine",)
    assert user_choices(installed()) == ()  # all that ship have mechanics of their own
    check_choice("mine", law.catalogue)
    refusal("hide 'mine'", check_choice, "mine", installed())
    refusal(r"hide 'mime' \(did you mean \"mine\"\?\)", check_choice, "mime", law.catalogue)
