"""Gradients of the slot wrenches by motions of the chain, against differences."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from hilcal.robot import chain as chains
from hilcal.robot.chain import twist_jacobian
from hilcal.robot.deviation import Deviation
from hilcal.robot.geometric_stiffness import geometric_stiffness
from hilcal.robot.statics import slot_wrenches
from tests.support.effect_cases import CELLS, situation

STEP = 1e-5


@pytest.mark.parametrize("arm", list(CELLS))
def test_gradient_by_joints_and_twists(arm):
    cell = CELLS[arm]
    s, rng = situation(cell), np.random.default_rng(0)
    count, n = s.angle.shape
    load = replace(s.load, first_moment=rng.normal(size=(n, 3)))
    dq, twist = 1e-2 * rng.normal(size=(count, n)), 1e-2 * rng.normal(size=(count, n + 1, 6))
    b = rng.normal(size=(count, 2, n + 1, 6))

    def form(by_joint, by_twist):
        deviation = Deviation(dq=dq + by_joint, twist=twist + by_twist)
        moved = chains.evaluate(cell.arm, s.angle, deviation)
        return np.einsum("nmki,nki->nm", b, slot_wrenches(cell.arm, moved, load))

    def slope(by_joint, by_twist):
        up, down = (form(h * by_joint, h * by_twist) for h in (STEP, -STEP))
        return (up - down) / (2 * STEP)

    chain = chains.evaluate(cell.arm, s.angle, Deviation(dq=dq, twist=twist))
    slots = product(range(n + 1), (False, True))
    gradient = geometric_stiffness(cell.arm, chain, load).gradient(
        {(k, moment): b[:, :, k, 3:] if moment else b[:, :, k, :3] for k, moment in slots}
    )
    for j in range(n):
        expected = slope(np.eye(n)[j], 0.0)
        np.testing.assert_allclose(gradient.joint(j), expected, rtol=1e-7, atol=1e-6)
    for k in range(n + 1):
        v = gradient.displacement(k)
        v = np.zeros((count, 2, 3)) if v is None else v
        moved = twist_jacobian(chain.rotation[k], np.zeros((count, 3)), chain.twist[k])
        found = np.concatenate([v, gradient.turn(k)], axis=2) @ moved
        for e in range(6):
            unit = np.zeros((n + 1, 6))
            unit[k, e] = 1.0
            expected = slope(0.0, unit)
            np.testing.assert_allclose(found[:, :, e], expected, rtol=1e-7, atol=1e-6)
