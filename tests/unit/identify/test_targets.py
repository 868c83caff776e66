"""Several targets per pose: prediction, derivative, registration."""

import numpy as np
import pytest

from hilcal.identify.baseline import with_effects
from hilcal.identify.registration import register
from hilcal.robot.se3 import rotation_vector
from tests.support.reflector_cases import OFFSETS, reflectors

KNOWN = [(True, True, True), (False, True, False), (False, False, False)]


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("known", KNOWN)
def test_base_and_targets_are_registered_together(known: tuple[bool, ...], m: int) -> None:
    c = reflectors(known=known, joint_std=0.0, m=m)
    cell = register(c.cell, c.readings).cell
    assert c.world.offsets is not None
    true = OFFSETS + c.world.offsets
    off = cell.all_targets[:, :3, 3] - true
    # The nominal arm is rigid: its loads move the targets by up to 1 mm.
    assert np.abs(off).max() < 5e-4
    assert np.all(off[list(known)] == 0.0)
    turn = cell.registration[:3, :3] @ c.world.registration[:3, :3].T
    assert np.linalg.norm(rotation_vector(turn)) < 1e-3


@pytest.mark.parametrize("m", [3, 6])
def test_derivatives_agree_with_differences(m: int) -> None:
    c = reflectors(known=(False, True, False), m=m, poses=4)
    names = ("joint_compliance", "encoder_offset")
    model = with_effects(c.cell, c.readings, "absolute", names)
    assert [p.name for p in model.effects[1].parameters][::m] == ["R1.x", "R3.x"]
    rng = np.random.default_rng(1)
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    theta = 0.3 * scale * rng.standard_normal(model.size)
    states = c.readings.states
    exact = model.jacobian(model.predict(states, theta), theta, 3)
    for k in range(model.size):
        step = np.zeros(model.size)
        step[k] = 1e-2 * scale[k]
        ahead, back = (model.predict(states, theta + s).observation for s in (step, -step))
        quotient = (ahead.position - back.position) / (2 * step[k])
        np.testing.assert_allclose(exact[:, :, k], quotient, atol=2e-6 * np.abs(quotient).max())


def test_one_offset_moves_one_target() -> None:
    c = reflectors(known=(False, True, False), poses=4)
    model = with_effects(c.cell, c.readings, "absolute", ())
    theta = np.zeros(model.size)
    before = model.predict(c.readings.states, theta).observation.position
    theta[-3:] = 1e-3  # target_offset.R3
    moved = model.predict(c.readings.states, theta).observation.position - before
    distance = np.linalg.norm(moved, axis=1)
    np.testing.assert_allclose(distance, np.where(c.readings.target == 2, np.sqrt(3) * 1e-3, 0.0))
