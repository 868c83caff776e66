"""Hidden effects: their laws, their strength, their names, and nothing shared with hilcal's."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import hilcal.drivers.simulated
from hilcal.drivers.simulated.injected_effects import (
    DEFLECTION_EFFECTS,
    EFFECTS,
    hide_effect,
    world_without_effect,
)
from hilcal.errors import InputError
from hilcal.readings.readings import States
from studies.random_campaigns import rehearsal_states
from tests.support.example_cell import ur10e_cell
from tests.support.refusals import refusals, refuses
from tests.support.rehearsed import dead_weights

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
