"""The arm of springs in MuJoCo: against closed forms, its own dynamics and the other world."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.calibration.handover import urdf
from studies.benchmark.campaign import campaign
from studies.benchmark.mujoco_tasks import SHOWN
from studies.benchmark.world_elastic import bare
from studies.benchmark.world_mujoco import Springs


def drawn(softness, rng):
    """Parameters of all effects that this world can hide, some tens of µm each."""
    return {
        "joint_stiffening": -0.1 * softness * rng.uniform(0.5, 1.0, 6),
        "joint_tilt_compliance": 1e-6 * rng.random(6),
        "base_compliance": 1e-6 * rng.random(3),
        "link_compliance": 1e-7 * rng.uniform(1.0, 2.0, (2, 2)),
        "tool_compliance": 1e-5 * rng.random(2),
        "periodic_joint_compliance": 1e-7 * rng.standard_normal((6, 2)),
        "load_point": 5e-3 * rng.standard_normal(3),
        "tracker_drift": np.repeat([1e-9, 3e-10], 3) * rng.standard_normal(6),
        "wrench_bias": np.repeat([1.0, 0.1], 3) * rng.standard_normal(6),
        "encoder_offset": 1e-4 * rng.standard_normal(6),
        "joint_coupling": 1e-4 * rng.standard_normal((6, 6)),
        "transmission_error": 1e-4 * rng.standard_normal((6, 3, 2)),
        "link_geometry": 1e-4 * rng.standard_normal((7, 6)),
        "link_mass": 0.05 * rng.standard_normal((6, 3)),
    }


@pytest.mark.long
@pytest.mark.parametrize("robot", ["xarm6", "ur10e"])
def test_two_mechanics_agree_to_a_micrometre(robot):
    """Those of `hilcal.drivers.simulated` and these share no code; parameters are the same."""
    rng = np.random.default_rng(6)
    c = campaign(robot, 8, rng)
    world = bare(c.cell, rng)
    compliance = world.physics.joint_compliance
    hidden = drawn(compliance / c.cell.arm.torque_max**2, rng)
    assert hidden.keys() == {*SHOWN}
    always = {k: getattr(world.physics, k) for k in ("joint_compliance", "target_offset")}

    def both(effects):
        physics = world.physics
        for name, value in effects.items():
            physics = physics.with_effect(name, value)
        cell = c.cell
        arm = Springs(
            urdf(cell.arm), cell.tool_mass, cell.tool_com, cell.load_point, cell.target[:3, 3],
            cell.gravity, {**always, **effects}, world.registration,
        )  # fmt: skip
        q, wrench = c.states.q, c.states.wrench
        position = replace(world, physics=physics).ideal_readings(c.states).position
        return position, arm.read(q, wrench, np.asarray(c.states.time))

    bare_one, bare_other = both({})
    np.testing.assert_allclose(bare_one, bare_other, atol=1e-11)
    for name, value in hidden.items():
        one, other = both({name: value})
        assert np.abs(one - bare_one).max() > 1e-7, name  # it acts
        np.testing.assert_allclose(one, other, atol=1e-6, err_msg=name)
    one, other = both(hidden)
    np.testing.assert_allclose(one, other, atol=1e-6)
