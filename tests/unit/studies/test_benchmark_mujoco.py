"""The arm of springs in MuJoCo: against closed forms, its own dynamics and the other world."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.calibration.handover import urdf
from studies.benchmark.campaign import campaign
from studies.benchmark.mujoco_tasks import SHOWN
from studies.benchmark.world_elastic import bare
from studies.benchmark.world_mujoco import PIECES, Springs
from tests.support.rows import first

G, MASS, LENGTH = 9.81, 4.0, 1.2


def plain(link, **hidden):
    """An arm whose joint 1 turns about -y and whose only extent, 1.2 m along x, leads to `link`.

    Behind it hangs a mass of 4 kg; a `link` of 6 is the flange.
    """
    names = ["base_link", *(f"link_{k}" for k in range(1, 7)), "tool0"]
    inertia = '<inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/>'
    text = "".join(
        f'<link name="{name}"><inertial><mass value="1e-9"/>{inertia}</inertial></link>'
        for name in names
    )
    for k in range(7):
        far, turn = LENGTH * (k == link), np.pi / 2 * (k == 0)
        place = f'<origin xyz="{far} 0 0" rpy="{turn} 0 0"/>'
        kind = "revolute" if k < 6 else "fixed"
        text += (
            f'<joint name="j{k}" type="{kind}">{place}<parent link="{names[k]}"/>'
            f'<child link="{names[k + 1]}"/><axis xyz="0 0 1"/>'
            '<limit lower="-7" upper="7" effort="0" velocity="0"/></joint>'
        )
    gravity = np.array([0.0, 0.0, -G if link == 6 else 0.0])
    zero = np.zeros(3)
    return Springs(
        f'<robot name="plain">{text}</robot>', MASS, zero, zero, zero, gravity, hidden, np.eye(4)
    )


def only(joint, value, joints=6):
    return value * np.eye(joints)[joint]


@pytest.mark.parametrize("cubic", [0.0, -1e-9])
def test_a_pendulum_gives_way_by_its_torque_over_its_stiffness(cubic):
    compliance, n = 1e-5, 7
    q = np.zeros((n, 6))
    q[:, 0] = np.linspace(-2.0, 2.0, n)
    arm = plain(6, joint_compliance=only(0, compliance), joint_stiffening=only(0, cubic))
    place, _ = arm.flange(q, np.zeros((n, 6)))
    angle = q[:, 0].copy()
    for _ in range(30):  # delta = c tau + s tau³ at the deflected angle
        torque = -MASS * G * LENGTH * np.cos(angle)
        angle = q[:, 0] + compliance * torque + cubic * torque**3
    by_hand = LENGTH * np.column_stack([np.cos(angle), np.zeros(n), np.sin(angle)])
    assert np.abs(angle - q[:, 0]).max() > 3e-4
    np.testing.assert_allclose(place, by_hand, atol=1e-12)


def test_a_beam_gives_way_as_a_cantilever():
    bend, force = 2e-6, 50.0  # 1/EI, N
    arm = plain(2, link_compliance=np.array([[bend, 0.0], [0.0, 0.0]]))
    place, turn = arm.flange(np.zeros((1, 6)), np.array([[0.0, 0.0, force, 0.0, 0.0, 0.0]]))
    tip = force * LENGTH**3 / 3.0 * bend
    assert place[0, 2] == pytest.approx(tip * (1.0 - 0.25 / PIECES**2), rel=1e-6)
    tilt = np.arctan2(turn[0, 2, 0], turn[0, 0, 0])
    assert tilt == pytest.approx(force * LENGTH**2 / 2.0 * bend, rel=1e-6)
    # a moment about the beam twists it by L/GJ M
    arm = plain(2, link_compliance=np.array([[0.0, 3e-6], [0.0, 0.0]]))
    _, turn = arm.flange(np.zeros((1, 6)), np.array([[0.0, 0.0, 0.0, 20.0, 0.0, 0.0]]))
    twist = -np.arcsin(turn[0, 1, 1])  # the flange's y pointed upwards
    assert twist == pytest.approx(20.0 * LENGTH * 3e-6, rel=1e-6)


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


@pytest.mark.parametrize("robot", first(1, ["xarm6", "ur10e"]))
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
        seen = replace(world, physics=physics).ideal_readings(c.states).position
        return seen, arm.read(q, wrench, np.asarray(c.states.time))

    bare_one, bare_other = both({})
    np.testing.assert_allclose(bare_one, bare_other, atol=1e-11)
    for name, value in hidden.items():
        one, other = both({name: value})
        assert np.abs(one - bare_one).max() > 1e-7, name  # it acts
        np.testing.assert_allclose(one, other, atol=1e-6, err_msg=name)
    one, other = both(hidden)
    np.testing.assert_allclose(one, other, atol=1e-6)
