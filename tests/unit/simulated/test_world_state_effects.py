"""The living world carries every effect of the simulated one, as time goes by."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.living_cell import PULL, WEIGHT, Q, everything, life, same, states
from tests.support.world_cases import further

SENSOR = {
    "force_sensor": {
        "driver": "ft300",
        "port": "x",
        "origin_m": [0.01, -0.02, 0.045],
        "rotvec_rad": [0.3, -0.9, 2.1],
    }
}


def state_of(cell, truth, wrench):
    """The state that a truth belongs to."""
    state = states(Q, wrench, float(truth["time"]))
    return replace(
        state,
        load_time=truth["time"][None] - truth["load_since"],
        joint_temperature=truth["joint_temperature"][None],
    )


def slip_of(cell):
    return cell.living.slip(cell.arrivals)[None]


def test_every_effect_shows_in_the_truth(tmp_path):
    cell = life(tmp_path, sections=SENSOR, **everything(np.random.default_rng(2)), **further(3))
    cell.living.hang("pull")
    truth = cell.rest_at(Q)
    want = cell.world.sight(state_of(cell, truth, PULL), slip_of(cell))
    assert same(truth["target"], want.position[0])
    for effect in further(3):
        gone = np.zeros_like(getattr(cell.world.physics, effect))
        less = replace(cell.world, physics=cell.world.physics.with_effect(effect, gone))
        seen = less.sight(state_of(cell, truth, PULL), slip_of(cell)).position[0]
        # Creep has only begun; equilibria are exact to 1e-12 rad.
        assert np.linalg.norm(seen - truth["target"]) > 1e-9, effect


@pytest.mark.parametrize("effect", ["creep", "thermal_growth", "thermal_joint_drift"])
def test_what_goes_on_with_time_or_warmth_moves_a_resting_arm(tmp_path, effect):
    cell = life(tmp_path, **{effect: 100.0 * further(3)[effect]})
    cell.living.hang("5kg")
    first = cell.rest_at(Q)
    time.sleep(0.02)
    second = cell.look()
    assert second["time"] - first["time"] >= 0.02 * 20.0
    want = cell.world.sight(state_of(cell, second, WEIGHT), slip_of(cell))
    assert same(second["target"], want.position[0])
    assert not same(second["target"], first["target"])


def test_the_joints_are_as_warm_as_the_world_takes_them_to_be(tmp_path):
    cell = life(tmp_path, thermal_joint_drift=np.full(6, 1e-4))
    truth = cell.rest_at(Q)
    told = replace(
        states(Q, np.zeros(6), float(truth["time"])),
        joint_temperature=truth["joint_temperature"][None],
    )
    assert same(truth["target"], cell.world.sight(told, slip_of(cell)).position[0])


def test_a_sensor_that_misreads_says_what_hangs_while_the_arm_bears_another_load(tmp_path):
    bias = np.array([5.0, -4.0, 6.0, 0.5, 0.3, -0.2])
    wrong = life(tmp_path, sections=SENSOR, wrench_bias=bias)
    (tmp_path / "right").mkdir()
    right = life(tmp_path / "right", sections=SENSOR)
    for cell in (wrong, right):
        cell.rest_at(Q)
        cell.living.hang("5kg")
    a, b = (cell.board.read("truth") for cell in (wrong, right))
    turned = a["flange"][:3, :3]
    seen = Rotation.from_matrix(turned.T @ b["flange"][:3, :3]).magnitude()
    assert 1e-6 < seen < 1e-3
    np.testing.assert_allclose(a["sensor_wrench"], b["sensor_wrench"], atol=60.0 * seen)
    lean = np.abs(a["drive_torque"] - b["drive_torque"])
    assert lean[1] > 1.0
    assert wrong.living.hang(None) is None
    right.living.hang(None)
    assert same(wrong.board.read("truth")["flange"], right.board.read("truth")["flange"])
