"""The deviated chain, its bodies and Jacobians: Pinocchio, matrix products and differences."""

from dataclasses import replace
from itertools import product

import numpy as np
import pinocchio as pin
import pytest

from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.robot.chain import Deviation, evaluate, joint_jacobian, twist_jacobian
from hilcal.robot.scene import FLANGE, body_poses, pinocchio_model
from hilcal.robot.statics import Load, geometric_stiffness, slot_wrench_change, slot_wrenches
from tests.support.arm_cases import (
    ARMS,
    ODD,
    RAILS,
    arm_of,
    displacement,
    flange_at,
    slope,
    twisted,
)
from tests.support.effect_cases import CELLS, situation
from tests.support.rows import first

TOLERANCE = 1e-12
COUNT = 12


def angles(arm, count=COUNT):
    return np.random.default_rng(1).uniform(-np.pi, np.pi, (count, arm.n))


def random_deviation(arm, size, count=COUNT):
    """Joint displacements and link twists of a size; the second slot has none."""
    rng = np.random.default_rng(2)
    twist = size * rng.normal(size=(count, arm.n + 1, 6))
    twist[:, 1] = 0.0
    return Deviation(dq=size * rng.normal(size=(count, arm.n)), twist=twist)


def pinocchio_flange(arm, q):
    model = pinocchio_model(arm)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(FLANGE)]


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.5])
def test_flange_is_where_pinocchio_has_it(name, size):
    arm = arm_of(name)
    q, d = angles(arm), random_deviation(arm, size)
    chain = evaluate(arm, q, d if size else None)
    for i in range(COUNT):
        flange = pinocchio_flange(twisted(arm, d.twist[i]), q[i] + d.dq[i])
        flange_at(chain, i, flange.homogeneous)


def motion_by(arm, q, d, change, offset):
    """Motion (N, 6) of a flange-fixed point per change along a deviation, by differences."""
    r0 = evaluate(arm, q, d).rotation[-1]

    def moved(t):
        scaled = Deviation(
            dq=None if change.dq is None else t * change.dq,
            twist=None if change.twist is None else t * change.twist,
        )
        chain = evaluate(arm, q, d + scaled)
        turn = chain.rotation[-1] @ np.swapaxes(r0, 1, 2)
        spin = [turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]]
        return np.column_stack([chain.point(offset), *spin])

    return slope(moved, 1e-3)


OFFSET = np.array([0.05, -0.1, 0.2])


@pytest.mark.parametrize(
    "name", first(3, ["ur10e", ODD, RAILS, *sorted({*ARMS} - {"ur10e", ODD, RAILS})])
)
@pytest.mark.parametrize("size", [0.0, pytest.param(1e-3, marks=pytest.mark.slow), 0.3])
def test_jacobians_are_slopes(name, size):
    arm = arm_of(name)
    count = 3
    q, d = angles(arm, count), random_deviation(arm, size, count)
    chain = evaluate(arm, q, d)
    x = chain.point(OFFSET)
    by_joint = joint_jacobian(chain, x)
    for j in range(arm.n):
        change = np.zeros((count, arm.n))
        change[:, j] = 1.0
        expected = motion_by(arm, q, d, Deviation(dq=change), OFFSET)
        assert_close_relative(by_joint[:, :, j], expected)
    for k in range(arm.n + 1):
        own_twist = None if chain.twist is None else chain.twist[k]
        by_slot = twist_jacobian(chain.rotation[k], x - chain.position[k], own_twist)
        for axis in range(6):
            twist = np.zeros((count, arm.n + 1, 6))
            twist[:, k, axis] = 1.0
            expected = motion_by(arm, q, d, Deviation(twist=twist), OFFSET)
            assert_close_relative(by_slot[:, :, axis], expected)


def assert_close_relative(found, expected):
    """Within 1e-7 of the longest motion."""
    assert np.abs(found - expected).max() <= 1e-7 * np.abs(expected).max()


def test_no_states():
    arm = arm_of("ur10e")
    chain = evaluate(arm, np.zeros((0, 6)), Deviation(twist=np.zeros((0, 7, 6))))
    assert chain.position.shape == (7, 0, 3)
    assert joint_jacobian(chain, chain.position[-1]).shape == (0, 6, 6)


@pytest.mark.parametrize("name", ARMS)
def test_bodies_and_flange_are_where_pinocchio_has_them(name):
    arm = arm_of(name)
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (4, arm.n))
    poses = body_poses(arm, q)
    assert poses.shape == (4, arm.n + 2, 4, 4)
    model = pinocchio_model(arm)
    data = model.createData()
    for angles, pose in zip(q, poses, strict=True):
        pin.framesForwardKinematics(model, data, angles)
        placed = [np.eye(4), *(data.oMi[k].homogeneous for k in range(1, arm.n + 1))]
        placed.append(data.oMf[model.getFrameId(FLANGE)].homogeneous)
        np.testing.assert_allclose(pose, placed, rtol=0, atol=1e-12)


MAGNITUDES = (0.0, 1e-9, 1e-6, 1e-3, 0.1, 0.499, 0.501, 1.0, 3.0, 3.14)


def vectors(seed, magnitude, count=4):
    """Random vectors (count, 3) of one length."""
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return magnitude * v / np.linalg.norm(v, axis=1, keepdims=True)


def twists(seed, magnitude, count=4):
    """Twists (count, 6) that turn by `magnitude` and shift by about 1."""
    v = np.random.default_rng(seed + 1).normal(size=(count, 3))
    return np.hstack([v, vectors(seed, magnitude, count)])


@pytest.mark.parametrize("magnitude", MAGNITUDES)
def test_exp_is_the_matrix_exponential(magnitude):
    xi = twists(0, magnitude)
    expected = np.array([displacement(x) for x in xi])
    np.testing.assert_allclose(se3.matrix(*se3.exp(xi)), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.rotation(xi[:, 3:]), expected[:, :3, :3], rtol=0, atol=1e-14)


@pytest.mark.parametrize("short", [0.0, 1e-15, 1e-12, 1e-8, 1e-4, 0.1])
def test_vectors_of_rotations_by_about_half_a_turn(short):
    w = np.random.default_rng(2).standard_normal((200, 3))
    w = np.vstack([w, np.eye(3), -np.eye(3), np.eye(3)[:2] + np.eye(3)[1:]])
    w *= (np.pi - short) / np.linalg.norm(w, axis=1, keepdims=True)
    r = se3.rotation(w)
    result = se3.rotation_vector(r)
    assert np.linalg.norm(result, axis=1).max() <= np.pi + 1e-15
    np.testing.assert_allclose(se3.rotation(result), r, rtol=0, atol=1e-14)


def test_one_twist_and_none_at_all():
    r, p = se3.exp(np.zeros(6))
    np.testing.assert_array_equal(r, np.eye(3))
    np.testing.assert_array_equal(p, np.zeros(3))
    r, p = se3.exp(np.zeros((0, 6)))
    assert (r.shape, p.shape) == ((0, 3, 3), (0, 3))
    assert [x.shape for x in se3.right_jacobian_blocks(np.zeros((0, 6)))] == [(0, 3, 3)] * 2


STATES = 8
GRAVITIES = {"floor": (0.0, 0.0, -9.80665), "odd": (3.0, -7.0, 4.0)}


def case(arm, gravity):
    """States, a deviation with large twists, and a load that pulls and turns."""
    rng = np.random.default_rng(5)
    q = rng.uniform(-np.pi, np.pi, (STATES, arm.n))
    d = Deviation(
        dq=0.1 * rng.normal(size=(STATES, arm.n)),
        twist=0.1 * rng.normal(size=(STATES, arm.n + 1, 6)),
    )
    load = Load(
        wrench=rng.normal(size=(STATES, 6)) * [80, 80, 80, 9, 9, 9],
        point=np.array([0.04, -0.03, 0.15]),
        tool_mass=2.1,
        tool_com=np.array([0.02, 0.01, 0.07]),
        gravity=np.array(gravity),
    )
    return q, d, load


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("gravity", GRAVITIES)
def test_torques_are_those_that_pinocchio_holds_against(name, gravity):
    # Pinocchio's generalized gravity holds the arm; weight and load pull the other way.
    arm = arm_of(name)
    q, d, load = case(arm, GRAVITIES[gravity])
    wrenches = slot_wrenches(arm, evaluate(arm, q, d), load)
    for i in range(STATES):
        model = pinocchio_model(twisted(arm, d.twist[i]))
        model.gravity.linear = load.gravity
        flange = model.frames[model.getFrameId(FLANGE)]
        tool = pin.Inertia(load.tool_mass, load.tool_com, np.zeros((3, 3)))
        model.appendBodyToJoint(flange.parentJoint, tool, flange.placement)
        at_load = flange.placement * pin.SE3(np.eye(3), load.point)
        kind, axes = pin.FrameType.OP_FRAME, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        point = model.addFrame(pin.Frame("load", flange.parentJoint, 0, at_load, kind))
        data, angle = model.createData(), q[i] + d.dq[i]
        jacobian = pin.computeFrameJacobian(model, data, angle, point, axes)
        held = pin.computeGeneralizedGravity(model, data, angle)
        torque = jacobian.T @ load.wrench[i] - held
        np.testing.assert_allclose(arm.joint_components(wrenches)[i], torque, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", ["ur10e", ODD])
def test_wrenches_are_sums_over_all_that_hangs_beyond(name):
    arm = arm_of(name)
    q, d, load = case(arm, GRAVITIES["odd"])
    wrenches = slot_wrenches(arm, evaluate(arm, q, d), load)
    for i in range(STATES):
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
            np.testing.assert_allclose(wrenches[i, k, :3], turn @ force, rtol=0, atol=1e-10)
            np.testing.assert_allclose(wrenches[i, k, 3:], turn @ moment, rtol=0, atol=1e-10)


def test_change_of_the_wrenches_is_their_difference():
    # Wrenches are linear in the load: the difference is exact. The load acts at the flange.
    arm = arm_of("ur10e")
    q, d, load = case(arm, GRAVITIES["floor"])
    load = replace(load, point=np.zeros(3))
    chain = evaluate(arm, q, d)
    rng = np.random.default_rng(6)
    change = rng.normal(size=(STATES, 4, 6)) * 50
    wrenches = slot_wrench_change(chain, change[:, :, :3], change[:, :, 3:])
    assert wrenches.shape == (STATES, 4, arm.n + 1, 6)
    for p in range(4):
        more = replace(load, wrench=load.wrench + change[:, p])
        expected = slot_wrenches(arm, chain, more) - slot_wrenches(arm, chain, load)
        np.testing.assert_allclose(wrenches[:, p], expected, rtol=0, atol=1e-10)


def test_load_point_may_differ_from_state_to_state():
    arm = arm_of("ur10e")
    q, d, load = case(arm, GRAVITIES["floor"])
    chain = evaluate(arm, q, d)
    points = np.random.default_rng(7).normal(size=(STATES, 3))
    wrenches = slot_wrenches(arm, chain, replace(load, point=points))
    for i in range(STATES):
        alone = slot_wrenches(arm, chain, replace(load, point=points[i]))
        np.testing.assert_allclose(wrenches[i], alone[i], rtol=0, atol=1e-12)


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
        moved = twist_jacobian(chain.rotation[k], np.zeros((count, 3)), chain.twist[k])
        derivative = np.concatenate([v, gradient.turn(k)], axis=2) @ moved
        for e in range(6):
            unit = np.zeros((n + 1, 6))
            unit[k, e] = 1.0
            expected = slope(0.0, unit)
            np.testing.assert_allclose(derivative[:, :, e], expected, rtol=1e-7, atol=1e-6)
