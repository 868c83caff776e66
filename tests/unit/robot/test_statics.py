"""Static wrenches and their gradients against Pinocchio, sums of what hangs beyond, differences."""

from dataclasses import replace
from itertools import product

import numpy as np
import pinocchio as pin
import pytest

from hilcal.robot import chain as chains
from hilcal.robot.arm import Arm
from hilcal.robot.chain import Deviation, evaluate, twist_jacobian
from hilcal.robot.scene import FLANGE, pinocchio_model
from hilcal.robot.statics import Load, geometric_stiffness, slot_wrench_change, slot_wrenches
from hilcal.types import Floats
from tests.support.arm_cases import ARMS, ODD, arm_of, displacement, twisted
from tests.support.effect_cases import CELLS, situation

COUNT = 8
GRAVITIES = {"floor": (0.0, 0.0, -9.80665), "odd": (3.0, -7.0, 4.0)}


def case(arm: Arm, gravity: tuple[float, ...]) -> tuple[Floats, Deviation, Load]:
    """States, a deviation with large twists, and a load that pulls and turns."""
    rng = np.random.default_rng(5)
    q = rng.uniform(-np.pi, np.pi, (COUNT, arm.n))
    d = Deviation(
        dq=0.1 * rng.normal(size=(COUNT, arm.n)), twist=0.1 * rng.normal(size=(COUNT, arm.n + 1, 6))
    )
    load = Load(
        wrench=rng.normal(size=(COUNT, 6)) * [80, 80, 80, 9, 9, 9],
        point=np.array([0.04, -0.03, 0.15]),
        tool_mass=2.1,
        tool_com=np.array([0.02, 0.01, 0.07]),
        gravity=np.array(gravity),
    )
    return q, d, load


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("gravity", GRAVITIES)
def test_torques_are_those_that_pinocchio_holds_against(name: str, gravity: str) -> None:
    # Pinocchio's generalized gravity holds the arm; weight and load pull the other way.
    arm = arm_of(name)
    q, d, load = case(arm, GRAVITIES[gravity])
    assert d.dq is not None
    assert d.twist is not None
    found = slot_wrenches(arm, evaluate(arm, q, d), load)
    for i in range(COUNT):
        model = pinocchio_model(twisted(arm, d.twist[i]))
        model.gravity.linear = load.gravity
        flange = model.frames[model.getFrameId(FLANGE)]
        tool = pin.Inertia(load.tool_mass, load.tool_com, np.zeros((3, 3)))
        model.appendBodyToJoint(flange.parentJoint, tool, flange.placement)
        at_load = pin.SE3(np.eye(3), load.point)
        point = model.addFrame(
            pin.Frame(
                "load", flange.parentJoint, 0, flange.placement * at_load, pin.FrameType.OP_FRAME
            )
        )
        data, angle = model.createData(), q[i] + d.dq[i]
        jacobian = pin.computeFrameJacobian(
            model, data, angle, point, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        held = pin.computeGeneralizedGravity(model, data, angle)
        torque = jacobian.T @ load.wrench[i] - held
        np.testing.assert_allclose(arm.along(found)[i], torque, rtol=0, atol=1e-10)


def test_a_weight_on_a_lever_turns_it_down() -> None:
    # One joint about −y, a lever of 0.5 m along x with 3 kg at its end: it falls by +τ.
    arm = Arm(
        name="lever", links=np.array([displacement([0, 0, 0, np.pi / 2, 0, 0]), np.eye(4)]),
        masses=np.array([3.0]), coms=np.array([[0.5, 0.0, 0.0]]), q_min=np.array([-np.pi]),
        q_max=np.array([np.pi]), torque_max=np.array([100.0]), payload=1.0, joint_names=("j1",),
        source="made up",
    )  # fmt: skip
    load = Load(np.zeros((1, 6)), np.zeros(3), 0.0, np.zeros(3), np.array([0, 0, -10.0]))
    wrench = slot_wrenches(arm, evaluate(arm, np.zeros((1, 1))), load)
    np.testing.assert_allclose(wrench[0, 0], [0, -30, 0, 0, 0, -15], rtol=0, atol=1e-13)
    np.testing.assert_allclose(wrench[0, 1], 0.0, rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", ["ur10e", ODD])
def test_wrenches_are_sums_over_all_that_hangs_beyond(name: str) -> None:
    arm = arm_of(name)
    q, d, load = case(arm, GRAVITIES["odd"])
    assert d.dq is not None
    assert d.twist is not None
    found = slot_wrenches(arm, evaluate(arm, q, d), load)
    for i in range(COUNT):
        links = arm.links @ np.array([displacement(t) for t in d.twist[i]])
        pose, slots, coms = links[0], [links[0]], []
        for k in range(arm.n):
            pose = pose @ displacement([0, 0, 0, 0, 0, q[i, k] + d.dq[i, k]])
            coms.append((pose @ [*arm.coms[k], 1])[:3])
            pose = pose @ links[k + 1]
            slots.append(pose)
        tool, point = ((pose @ [*x, 1])[:3] for x in (load.tool_com, load.point))
        for k, slot in enumerate(slots):
            force = load.wrench[i, :3] + load.tool_mass * load.gravity
            moment = load.wrench[i, 3:] + np.cross(point - slot[:3, 3], load.wrench[i, :3])
            moment = moment + np.cross(tool - slot[:3, 3], load.tool_mass * load.gravity)
            for mass, com in zip(arm.masses[k:], coms[k:], strict=True):
                force = force + mass * load.gravity
                moment = moment + np.cross(com - slot[:3, 3], mass * load.gravity)
            turn = slot[:3, :3].T
            np.testing.assert_allclose(found[i, k, :3], turn @ force, rtol=0, atol=1e-10)
            np.testing.assert_allclose(found[i, k, 3:], turn @ moment, rtol=0, atol=1e-10)


def test_change_of_the_wrenches_is_their_difference() -> None:
    # Wrenches are linear in the load: the difference is exact. The load acts at the flange.
    arm = arm_of("ur10e")
    q, d, load = case(arm, GRAVITIES["floor"])
    load = replace(load, point=np.zeros(3))
    chain = evaluate(arm, q, d)
    rng = np.random.default_rng(6)
    change = rng.normal(size=(COUNT, 4, 6)) * 50
    found = slot_wrench_change(chain, change[:, :, :3], change[:, :, 3:])
    assert found.shape == (COUNT, 4, arm.n + 1, 6)
    for p in range(4):
        more = replace(load, wrench=load.wrench + change[:, p])
        expected = slot_wrenches(arm, chain, more) - slot_wrenches(arm, chain, load)
        np.testing.assert_allclose(found[:, p], expected, rtol=0, atol=1e-10)


def test_load_point_may_differ_from_state_to_state() -> None:
    arm = arm_of("ur10e")
    q, d, load = case(arm, GRAVITIES["floor"])
    chain = evaluate(arm, q, d)
    points = np.random.default_rng(7).normal(size=(COUNT, 3))
    found = slot_wrenches(arm, chain, replace(load, point=points))
    for i in range(COUNT):
        alone = slot_wrenches(arm, chain, replace(load, point=points[i]))
        np.testing.assert_allclose(found[i], alone[i], rtol=0, atol=1e-12)


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
