"""Hidden effects: their laws, their strength, their names, and nothing shared with hilcal's."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import hilcal.drivers.simulated
from hilcal.drivers.simulated.injected_effects import (
    DEFLECTION_EFFECTS,
    EFFECTS,
    hide_effect,
    world_without_effect,
)
from hilcal.drivers.simulated.truth import Truth
from hilcal.errors import InputError
from hilcal.readings.readings import States
from studies.random_campaigns import rehearsal_states
from tests.support.example_cell import ur10e_cell
from tests.support.refusals import refusals, refuses
from tests.support.rehearsed import dead_weights

CELL = ur10e_cell()
WEIGHTS = dead_weights([4.0, 8.0, 12.0], CELL.gravity)
STATES, POSE, LOAD, CYCLE = rehearsal_states(CELL, 10, WEIGHTS, np.random.default_rng(0))
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


def rigid_world(**effects):
    world = world_without_effect(CELL, np.random.default_rng(2))
    truth = replace(Truth.rigid(CELL.arm), **effects)
    return replace(world, physics=truth)


def by_hand(world, states, dq=0.0, links=CELL.arm.links, base=None, offset=0.0):
    """Target positions of a rigid arm, by matrix products, sensor axes."""
    out = []
    for q in states.q + dq:
        place = world.registration @ (np.eye(4) if base is None else base) @ links[0]
        for angle, link in zip(q, links[1:], strict=True):
            step = np.eye(4)
            step[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
            place = place @ step @ link
        out.append(place[:3, :3] @ (CELL.target[:3, 3] + offset) + place[:3, 3])
    return np.array(out)


def exp(twist):
    v, (x, y, z) = twist[:3], twist[3:]
    return expm(np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]]))


def test_effects_without_load_follow_their_laws():
    rng = np.random.default_rng(3)
    q = STATES.q

    def same(world, expected):
        np.testing.assert_allclose(world.ideal_readings(STATES).position, expected, atol=1e-12)

    o = 1e-3 * rng.standard_normal(6)
    world = rigid_world(encoder_offset=o)
    same(world, by_hand(world, STATES, o))
    world = rigid_world(hysteresis=o)
    same(world, by_hand(world, STATES, o * STATES.approach))
    ab = 1e-3 * rng.standard_normal((6, 2, 2))
    dq = sum(ab[:, k - 1, 0] * np.cos(k * q) + ab[:, k - 1, 1] * np.sin(k * q) for k in (1, 2))
    world = rigid_world(transmission_error=ab)
    same(world, by_hand(world, STATES, dq))
    k = 1e-3 * rng.standard_normal((6, 6))
    world = rigid_world(joint_coupling=k)
    same(world, by_hand(world, STATES, np.array([[row @ at for row in k] for at in q])))
    twist = 1e-2 * rng.standard_normal((7, 6))
    world = rigid_world(link_geometry=twist)
    links = [link @ exp(t) for link, t in zip(CELL.arm.links, twist, strict=True)]
    same(world, by_hand(world, STATES, links=links))
    offset = rng.standard_normal(3)
    world = rigid_world(target_offset=offset)
    same(world, by_hand(world, STATES, offset=offset))
    base = 1e-2 * rng.standard_normal(6)
    world = rigid_world(base_frame=base)
    same(world, by_hand(world, STATES, base=exp(base)))
    rate = 1e-6 * rng.standard_normal(6)
    world = rigid_world(tracker_drift=rate)
    still = by_hand(world, STATES)
    moved = [(exp(rate * t) @ [*p, 1.0])[:3] for t, p in zip(STATES.time, still, strict=True)]
    same(world, np.array(moved))


def test_load_point_adds_the_moment_of_the_load():
    shift = np.array([0.02, -0.03, 0.05])
    compliance = np.full(6, 1e-5)
    moved = rigid_world(joint_compliance=compliance, load_point=shift)
    cell = replace(CELL, load_point=CELL.load_point + shift)
    with_cell = replace(rigid_world(joint_compliance=compliance), cell=cell)
    np.testing.assert_allclose(
        moved.ideal_readings(STATES).position, with_cell.ideal_readings(STATES).position, atol=1e-14
    )


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


def test_unknown_registration_and_target_are_the_worlds_own():
    cell = replace(CELL, target_known=False)
    world = world_without_effect(cell, np.random.default_rng(1))
    assert np.hypot(*world.registration[:2, 3]) == pytest.approx(3.0)
    np.testing.assert_allclose(world.registration[2, :3], [0, 0, 1], atol=1e-15)
    assert np.any(world.physics.target_offset != 0.0)
    known_world = world_without_effect(
        ur10e_cell(registration_known=True), np.random.default_rng(1)
    )
    np.testing.assert_array_equal(known_world.registration, np.eye(4))
    assert np.hypot(*known_world.station[:2, 3]) == pytest.approx(3.0)


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
               "hilcal.shown", "hilcal.types"}  # fmt: skip
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
                of_world = not module.startswith("hilcal") or module.startswith("hilcal.drivers.")
                assert of_world or module in allowed, (name, module)
