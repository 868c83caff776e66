"""The world as time goes by, its effects there, and its file."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.drivers.simulated.world_server import read_world, write_world
from tests.support.refusals import refusal
from tests.support.running_world import (
    PULL,
    WEIGHT,
    Q,
    RunningWorld,
    config,
    every_effect,
    remaining_effects,
    running_world,
    same_bytes,
    states,
    world_of,
)


@pytest.fixture
def cell(tmp_path):
    return running_world(tmp_path)


@pytest.mark.parametrize(("load", "wrench"), [(None, np.zeros(6)), ("5kg", WEIGHT), ("pull", PULL)])
def test_the_truth_is_the_equilibrium_of_the_state(tmp_path, load, wrench):
    rng = np.random.default_rng(11)
    cell = running_world(tmp_path, joint_std=1e-4, **every_effect(rng))
    cell.living.hang(load)
    for _ in range(3):
        q = rng.uniform(-2.0, 2.0, 6)
        truth = cell.rest_at(q)
        state = states(q, wrench, float(truth["time"]))
        slip = cell.living.slip(cell.arrivals)[None]
        sight, rest = cell.world.ideal_readings(state, slip), cell.world.equilibrium(state, slip)
        assert truth["arrivals"] == cell.arrivals
        assert same_bytes(truth["target"], sight.position[0])
        assert same_bytes(truth["target_rotation"], sight.rotation[0])
        assert same_bytes(truth["flange"], rest.flange[0])


def test_the_drive_torque_is_that_of_weight_and_load(tmp_path):
    cell = running_world(tmp_path, joint_std=0.0, **every_effect(np.random.default_rng(2)))
    cell.living.hang("pull")
    torque = cell.rest_at(Q)["drive_torque"]
    assert same_bytes(torque, cell.world.drive_torque(states(Q, PULL, 0.0))[0])


def test_the_encoders_see_neither_slip_nor_elasticity(tmp_path):
    cell = running_world(tmp_path, joint_std=1e-2)
    cell.living.hang("5kg")
    read = np.array([cell.rest_at(Q)["encoder"] for _ in range(200)]) - Q
    spread = np.sqrt(np.mean(read**2))
    # 1200 draws of 2e-6 rad: the rms is within 5 of its standard errors, 2 %
    assert abs(spread / 2e-6 - 1.0) < 5.0 / np.sqrt(2 * read.size)


def test_a_resting_arm_is_not_computed_anew_but_its_encoders_are_read(cell, tmp_path):
    first = cell.rest_at(Q)
    second = cell.truth_after()
    assert same_bytes(first["target"], second["target"])
    assert not same_bytes(first["encoder"], second["encoder"])
    assert second["time"] > first["time"]


def slip_of(cell):
    return cell.living.slip(cell.arrivals)[None]


# repeatability


def test_the_slip_stays_until_the_next_arrival_and_comes_new_with_it(cell, tmp_path):
    first = cell.rest_at(Q)["flange"].copy()
    cell.board.write("arm", moving=1.0, q=Q + 0.1)
    on_the_way = cell.truth_after()["flange"]
    assert np.abs(on_the_way - first).max() > 1e-2
    cell.board.write("arm", q=Q, moving=1.0)
    assert same_bytes(cell.truth_after()["flange"], first)
    assert not same_bytes(cell.rest_at(Q)["flange"], first)


def test_the_published_scatter_of_arrivals_is_that_of_the_joints(tmp_path):
    cell = running_world(tmp_path, joint_std=3e-5)
    count = 400
    targets = np.array([cell.rest_at(Q)["target"] for _ in range(count)])
    sight = cell.world.ideal_readings(states(Q, np.zeros(6), 0.0))
    jac = sight.jacobian[0, :3] * cell.world.joint_std
    white = np.linalg.solve(np.linalg.cholesky(jac @ jac.T), (targets - sight.position).T)
    # |white|² is chi-square of 3 degrees: mean 3, variance 6
    assert abs(np.mean(np.sum(white**2, axis=0)) - 3.0) < 5.0 * np.sqrt(6.0 / count)
    assert np.abs(white.mean(axis=1)).max() < 5.0 / np.sqrt(count)
    neighbours = np.mean(np.sum(white[:, 1:] * white[:, :-1], axis=0))
    assert abs(neighbours) < 5.0 * np.sqrt(3.0 / count)


def test_the_slip_of_an_arrival_does_not_depend_on_who_looked(tmp_path):
    made = config()
    world = world_of(made)
    (tmp_path / "other").mkdir()
    a, b = RunningWorld(world, made, tmp_path), RunningWorld(world, made, tmp_path / "other")
    for _ in range(4):
        first = a.rest_at(Q)
    b.arrivals = 3
    assert same_bytes(first["flange"], b.rest_at(Q)["flange"])
    other = RunningWorld(world, made, tmp_path / "other", seed=6)
    other.arrivals = 3
    assert not same_bytes(first["flange"], other.rest_at(Q)["flange"])


# the wrench on the sensor

MOUNT = {"origin_m": [0.01, -0.02, 0.045], "rotvec_rad": [0.3, -0.9, 2.1]}
SENSOR = {"force_sensor": {"driver": "ft300", "port": "x", **MOUNT}}


def test_the_sensor_feels_the_weight_of_tool_and_load_in_its_own_axes(tmp_path):
    cell = running_world(tmp_path, sections=SENSOR, load_point=np.array([0.004, 0.0, -0.003]))
    cell.living.hang("5kg")
    for q in (Q, -Q, Q + 0.8):
        truth = cell.rest_at(q)
        flange = Rotation.from_matrix(truth["flange"][:3, :3])
        in_base = flange * Rotation.from_rotvec(MOUNT["rotvec_rad"])
        force, moment = in_base.apply(truth["sensor_wrench"].reshape(2, 3))
        np.testing.assert_allclose(force, [0.0, 0.0, -5.8 * 9.80665], atol=1e-9)
        # a weight has no moment about its own centre
        tool, load = np.array([0.01, 0.02, 0.06]), np.array([0.104, -0.03, 0.147])
        centre = flange.apply((0.8 * tool + 5.0 * load) / 5.8 - MOUNT["origin_m"])
        np.testing.assert_allclose(moment, np.cross(centre, force), atol=1e-9)


# what the people in the cell do


def test_hanging_is_true_at_once_and_dated(cell, tmp_path):
    up = cell.rest_at(Q)["flange"][2, 3]
    assert cell.living.hang("5kg") == "5kg"
    truth = cell.board.read("truth")
    assert truth["load"] == 1
    assert 0.0 < truth["load_since"] <= truth["time"]
    assert truth["flange"][2, 3] < up - 1e-4
    assert cell.living.hang(None) is None
    assert cell.board.read("truth")["load"] == 0
    assert cell.board.read("truth")["flange"][2, 3] == up


def test_a_mistake_is_made_once_and_told(cell, tmp_path):
    cell.living.mistake("pull")
    assert cell.living.hang("5kg") == "pull"
    assert cell.board.read("truth")["load"] == 2
    assert cell.living.hang("5kg") == "5kg"
    cell.living.mistake(None)
    assert cell.living.hang("5kg") is None
    events = [entry["event"] for entry in cell.living.log()]
    assert events == [
        "asked for 5kg, hung pull",
        "asked for 5kg, hung 5kg",
        "asked for 5kg, hung none",
    ]


def test_pushing_adds_to_the_load(cell, tmp_path):
    cell.living.hang("5kg")
    lean = np.array([5.0, -7.0, 9.0, 1.0, 2.0, -1.0])
    cell.living.push(lean.tolist())
    truth = cell.rest_at(Q)
    want = cell.world.equilibrium(states(Q, WEIGHT + lean, 0.0), slip_of(cell))
    assert same_bytes(truth["flange"], want.flange[0])
    cell.living.push([0.0] * 6)
    want = cell.world.equilibrium(states(Q, WEIGHT, 0.0), slip_of(cell))
    assert same_bytes(cell.board.read("truth")["flange"], want.flange[0])


def yielding(tmp_path, *places):
    """A cell whose joint 2 bears the torque of the first state, but not that of the second."""
    made = config()
    world = world_of(made)
    lift = [abs(world.drive_torque(states(*place, 0.0))[0, 1]) for place in places]
    assert lift[0] < 0.9 * lift[1]
    # c + 3 s tau² is 0 between the two torques: the gear has no equilibrium beyond
    hidden = np.zeros(6)
    hidden[1] = -world.physics.joint_compliance[1] / 3.0 / np.mean(lift) ** 2
    return RunningWorld(world_of(made, joint_stiffening=hidden), made, tmp_path)


def test_what_the_arm_does_not_bear_is_refused_and_changes_nothing(tmp_path):
    cell = yielding(tmp_path, (Q, np.zeros(6)), (Q, WEIGHT))
    before = cell.rest_at(Q)
    refusal("spring back", cell.living.hang, "5kg")
    refusal("spring back", cell.living.push, WEIGHT.tolist())
    after = cell.truth_after()
    assert (after["load"], after["load_since"]) == (0, 0.0)
    assert same_bytes(before["flange"], after["flange"])
    again = cell.rest_at(Q)
    assert again["arrivals"] == before["arrivals"] + 1
    np.testing.assert_allclose(again["flange"], before["flange"], atol=1e-3)


def test_a_pose_without_equilibrium_is_logged_and_the_world_lives_on(tmp_path):
    upright = np.array([0.0, -np.pi / 2, 0.0, 0.0, 0.0, 0.0])
    cell = yielding(tmp_path, (upright, np.zeros(6)), (0 * Q, np.zeros(6)))
    before = cell.rest_at(upright)
    stretched = cell.rest_at(0 * Q)
    assert same_bytes(stretched["flange"], before["flange"])
    assert "spring back" in cell.living.log()[0]["event"]
    cell.truth_after()
    assert len(cell.living.log()) == 1
    assert cell.rest_at(upright)["arrivals"] == 3


def test_a_load_swings_for_a_while_and_rests_where_it_should(cell, tmp_path):
    cell.rest_at(Q)
    cell.living.swing([0.0, 0.0, 20.0, 0.0, 0.0, 0.0], period=1e-3, decay=0.2)  # world s
    cell.living.hang("5kg")
    still = cell.world.equilibrium(states(Q, WEIGHT, 0.0), slip_of(cell)).flange[0]
    flanges = [cell.truth_after()["flange"] for _ in range(2)]
    assert not same_bytes(flanges[0], still)
    assert not same_bytes(flanges[0], flanges[1])
    time.sleep(0.2)  # 4 s of the world, 20 decays
    assert same_bytes(cell.truth_after()["flange"], still)


def state_of(cell, truth, wrench):
    """The state that a truth belongs to."""
    state = states(Q, wrench, float(truth["time"]))
    return replace(
        state,
        load_time=truth["time"][None] - truth["load_since"],
        joint_temperature=truth["joint_temperature"][None],
    )


def test_every_effect_shows_in_the_truth(tmp_path):
    cell = running_world(
        tmp_path, sections=SENSOR, **every_effect(np.random.default_rng(2)), **remaining_effects(3)
    )
    cell.living.hang("pull")
    truth = cell.rest_at(Q)
    want = cell.world.ideal_readings(state_of(cell, truth, PULL), slip_of(cell))
    assert same_bytes(truth["target"], want.position[0])
    for effect in remaining_effects(3):
        gone = np.zeros_like(getattr(cell.world.physics, effect))
        less = replace(cell.world, physics=cell.world.physics.with_effect(effect, gone))
        position = less.ideal_readings(state_of(cell, truth, PULL), slip_of(cell)).position[0]
        # Creep has only begun; equilibria are exact to 1e-12 rad.
        assert np.linalg.norm(position - truth["target"]) > 1e-9, effect


SLOW = {
    "tracker_drift": np.array([1e-3, -2e-3, 3e-3, 1e-3, 0.0, 0.0]),
    **{
        e: 100.0 * remaining_effects(3)[e]
        for e in ("creep", "thermal_growth", "thermal_joint_drift")
    },
}


@pytest.mark.parametrize("effect", SLOW)
def test_what_goes_on_with_time_or_warmth_moves_a_resting_arm(tmp_path, effect):
    cell = running_world(tmp_path, **{effect: SLOW[effect]})
    cell.living.hang("5kg")
    first = cell.rest_at(Q)
    time.sleep(0.02)
    second = cell.truth_after()
    assert second["time"] - first["time"] >= 0.02 * 20.0
    want = cell.world.ideal_readings(state_of(cell, second, WEIGHT), slip_of(cell))
    assert same_bytes(second["target"], want.position[0])
    assert not same_bytes(second["target"], first["target"])


def test_a_sensor_that_misreads_says_what_hangs_while_the_arm_bears_another_load(tmp_path):
    bias = np.array([5.0, -4.0, 6.0, 0.5, 0.3, -0.2])
    wrong = running_world(tmp_path, sections=SENSOR, wrench_bias=bias)
    (tmp_path / "right").mkdir()
    right = running_world(tmp_path / "right", sections=SENSOR)
    for cell in (wrong, right):
        cell.rest_at(Q)
        cell.living.hang("5kg")
    a, b = (cell.board.read("truth") for cell in (wrong, right))
    turned = a["flange"][:3, :3]
    turn = Rotation.from_matrix(turned.T @ b["flange"][:3, :3]).magnitude()
    assert 1e-6 < turn < 1e-3
    np.testing.assert_allclose(a["sensor_wrench"], b["sensor_wrench"], atol=60.0 * turn)
    lean = np.abs(a["drive_torque"] - b["drive_torque"])
    assert lean[1] > 1.0
    assert wrong.living.hang(None) is None
    right.living.hang(None)
    assert same_bytes(wrong.board.read("truth")["flange"], right.board.read("truth")["flange"])


def test_world_comes_back_from_its_file_to_the_last_bit(tmp_path):
    made = config(force_sensor={"driver": "ft300", "port": "x", "origin_m": [0, 0, 0.1]})
    world = world_of(made, **every_effect(np.random.default_rng(3)), **remaining_effects(4))
    world = replace(world, joint_reference=23.4)
    write_world(tmp_path / "world.json", world, made)
    back, stored = read_world(tmp_path / "world.json")
    assert stored == made
    assert back.truth == world.truth
    assert back.noise == world.noise
    for name in ("registration", "station", "joint_std"):
        assert same_bytes(getattr(back, name), getattr(world, name))
    assert back.joint_reference == 23.4
    state = replace(states(Q, WEIGHT, 12.3), joint_temperature=np.full((1, 6), 25.0))
    assert same_bytes(back.ideal_readings(state).position, world.ideal_readings(state).position)
