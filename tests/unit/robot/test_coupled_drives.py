"""What a coupled motor carries, and what gives way: by virtual work, with the drawn arm alone."""

import numpy as np
import pinocchio as pin
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated.mechanics import rotation_vector
from hilcal.drivers.simulated.truth import Truth
from hilcal.drivers.simulated.ur_state import GRAVITY, Kinematics
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.identification.noise.full_covariance import joint_factors
from hilcal.model.model import Model
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from hilcal.robot.scene import Scene, body_poses, capsules, is_known, pinocchio_model
from tests.support.campaigns import true_parameters
from tests.support.effect_cases import make, numeric_jacobian, some_states
from tests.support.readings_cases import readings_at
from tests.support.space_cases import least_distance

SIGN = (1, -1, 1, 1, -1, 1)
PAIRS = {(3, 2): 1.0, (6, 5): -0.5, (6, 4): 0.3}
RNG = np.random.default_rng(5)


def coupled_cell(mechanical=True, sign=SIGN):
    entries = [
        {"joint": j, "follows": i, "factor": k, "mechanical": mechanical}
        for (j, i), k in PAIRS.items()
    ]
    robot = {"model": "ur10e", "joint_coupling": entries, "joint_sign": sign}
    return cell_from_config(CellConfig.model_validate({"robot": robot}))


def drawn_angles(q):
    out = q * SIGN
    for (j, i), k in PAIRS.items():
        out[..., j - 1] += k * q[..., i - 1]
    return out


def height(q, mass, com):
    """Σ m z of the arm and a payload, by Pinocchio on the drawn arm at the drawn angles."""
    model = pinocchio_model(load_arm("ur10e"))
    data = model.createData()
    angles = drawn_angles(q)
    centre = pin.centerOfMass(model, data, angles)
    pin.framesForwardKinematics(model, data, angles)
    flange = data.oMf[model.nframes - 1]
    weight = sum(i.mass for i in model.inertias)
    return weight * centre[2] + mass * (flange.rotation @ com + flange.translation)[2]


def test_the_controllers_kinematics_and_torques_are_those_of_virtual_work():
    kinematics, q, step = Kinematics(coupled_cell().arm), RNG.uniform(-2, 2, 6), 1e-6
    mass, com = 4.0, np.array([0.02, 0.05, 0.1])
    drawn = evaluate(load_arm("ur10e"), drawn_angles(q)[None])
    np.testing.assert_allclose(kinematics.flange(q)[:3, 3], drawn.position[-1][0], atol=1e-12)
    np.testing.assert_allclose(kinematics.flange(q)[:3, :3], drawn.rotation[-1][0], atol=1e-12)
    at = [q + s * step * np.eye(6)[k] for k in range(6) for s in (1, -1)]
    work = np.array([height(x, mass, com) for x in at]).reshape(6, 2) @ [1, -1] / (2 * step)
    np.testing.assert_allclose(kinematics.weight_torque(q, mass, com), work * GRAVITY[2], atol=1e-5)
    place = np.array([kinematics.flange(x) for x in at]).reshape(6, 2, 4, 4)
    jacobian = kinematics.jacobian(q, kinematics.flange(q)[:3, 3])
    moved = (place[:, 0, :3, 3] - place[:, 1, :3, 3]).T / (2 * step)
    np.testing.assert_allclose(jacobian[:3], moved, atol=1e-8)
    turn = rotation_vector(place[:, 0, :3, :3] @ np.swapaxes(place[:, 1, :3, :3], 1, 2))
    np.testing.assert_allclose(jacobian[3:], turn.T / (2 * step), atol=1e-8)


@pytest.mark.parametrize("mechanical", [True, False])
def test_the_torque_of_a_law_is_that_of_the_drive(mechanical):
    """dU = −τ · dq of the controller's values where motors are coupled, of the axes where not."""
    cell = coupled_cell(mechanical)
    states = some_states(cell, 4)
    s = Model(cell, ()).predict(states, np.zeros(0)).situation
    load, weight, step = cell.load_point, cell.tool_mass, 1e-6

    def energy(chain):
        points = np.einsum("nij,j->ni", chain.rotation[-1], load) + chain.position[-1]
        held = np.einsum("knj,k->nj", chain.com, cell.arm.masses)
        held += weight * chain.point(cell.tool_com)
        return np.sum(points * states.wrench[:, :3], axis=1) + held @ cell.gravity

    for j in range(6):
        one = step * np.eye(6)[j]
        if mechanical:
            ahead, back = (evaluate(cell.arm, states.q + d) for d in (one, -one))
        else:  # the joint alone: of the drawn arm, in the sense in which it counts
            drawn, theta = load_arm("ur10e"), drawn_angles(states.q)
            ahead, back = (evaluate(drawn, theta + d * SIGN) for d in (one, -one))
        work = (energy(ahead) - energy(back)) / (2 * step)
        axis = (ahead.rotation[-1] @ np.swapaxes(back.rotation[-1], 1, 2)) / (2 * step)
        turn = 0.5 * np.stack(
            [axis[:, 2, 1] - axis[:, 1, 2], axis[:, 0, 2] - axis[:, 2, 0],
             axis[:, 1, 0] - axis[:, 0, 1]], axis=1,
        )  # fmt: skip
        work += np.sum(turn * states.wrench[:, 3:], axis=1)
        np.testing.assert_allclose(s.torque[:, j], work, rtol=1e-6, atol=1e-5)


LAWS = ("joint_compliance", "joint_stiffening", "backlash", "periodic_joint_compliance",
        "creep", "encoder_offset", "hysteresis", "transmission_error", "joint_coupling",
        "joint_tilt_compliance")  # fmt: skip


@pytest.mark.parametrize("mechanical", [True, False])
@pytest.mark.parametrize("law", LAWS)
def test_laws_of_coupled_drives_are_the_worlds(law, mechanical):
    cell = coupled_cell(mechanical)
    states = some_states(cell, 6)
    rng, truth = np.random.default_rng(2), Truth.rigid(cell.arm, harmonics=2)
    size = {"encoder_offset": 2e-4, "hysteresis": 5e-5, "transmission_error": 1e-4,
            "joint_coupling": 2e-4, "backlash": 5e-5, "creep": 0.03, "joint_stiffening": -1e-10,
            "periodic_joint_compliance": 1e-6}.get(law, 8e-6)  # fmt: skip
    zero = getattr(truth, law)
    value = size * rng.uniform(0.5, 1.0, zero.shape)
    if law == "joint_coupling":
        value = value * (np.eye(6, k=-1) + np.eye(6, k=-2) * (np.arange(6) == 5)[:, None])
    truth = truth.with_effect("joint_compliance", 1e-5 * rng.uniform(0.5, 1.0, 6))
    truth = truth.with_effect(law, value)
    noise, nothing = SimulatedNoise(), np.zeros(6)
    world = World(cell, truth, cell.registration, np.eye(4), noise, nothing)
    names = list(dict.fromkeys(("joint_compliance", law)))
    options = {"transmission_error": {"harmonics": 2}}
    effects = tuple(make(n, cell, states, options.get(n, {})) for n in names)
    model = Model(cell, effects)
    theta = np.concatenate([true_parameters(world, n) for n in names])
    predicted = model.predict(states, theta)
    order = 1e-3 if law == "joint_tilt_compliance" else 0.0  # of two tilts in succession
    moved = np.abs(predicted.observation.position - world.ideal_readings(states).position).max()
    rigid = Model(cell, ()).predict(states, np.zeros(0)).observation.position
    size = np.abs(predicted.observation.position - rigid).max()
    assert moved <= order * size + 1e-11
    scale = np.array([p.scale for e in effects for p in e.parameters])
    derivative = model.jacobian(predicted, theta, 6)
    quotient = numeric_jacobian(model, states, theta, 1e-2 * scale, 6) / (1e-2 * scale)
    off = np.abs(derivative - quotient).max(axis=(0, 1)) * scale
    assert off.max() <= 1e-6 * (np.abs(quotient).max(axis=(0, 1)) * scale).max() + 1e-12


def test_shapes_of_turned_and_coupled_joints_are_those_of_the_drawn_arm():
    arm, drawn = coupled_cell().arm, load_arm("ur10e")
    assert is_known(arm)
    q = RNG.uniform(-2, 2, (5, 6))
    theta = drawn_angles(q)
    places, expected = body_poses(arm, q), body_poses(drawn, theta)
    for capsule, other in zip(capsules(arm), capsules(drawn), strict=True):
        assert (capsule.name, capsule.body, capsule.radius) == (
            other.name,
            other.body,
            other.radius,
        )
        for a, b in ((capsule.start, other.start), (capsule.end, other.end)):
            here, there = places[:, capsule.body] @ [*a, 1], expected[:, capsule.body] @ [*b, 1]
            np.testing.assert_allclose(here, there, atol=1e-12)
    here, there = Scene(arm), Scene(drawn)
    for one, two in zip(q, theta, strict=True):
        distance = least_distance(there.self_pairs, two)
        assert least_distance(here.self_pairs, one) == pytest.approx(distance, abs=1e-9)


def test_the_situation_says_whose_angles_they_are():
    for mechanical in (True, False):
        cell = coupled_cell(mechanical)
        states = some_states(cell, 3)
        s = Model(cell, ()).predict(states, np.zeros(0)).situation
        expected = states.q if mechanical else drawn_angles(states.q) * SIGN
        np.testing.assert_allclose(s.angle, expected, atol=1e-12)
        np.testing.assert_array_equal(s.values, states.q)


@pytest.mark.parametrize("mechanical", [True, False])
def test_the_arms_scatter_is_that_of_its_drives(mechanical):
    cell = coupled_cell(mechanical)
    states = some_states(cell, 3)
    world = World(cell, Truth.rigid(cell.arm), cell.registration, np.eye(4), SimulatedNoise(),
                  np.zeros(6))  # fmt: skip
    scatter = 1e-5 * np.arange(1.0, 7.0)
    factors = joint_factors(
        cell, readings_at(states.q, np.zeros((3, 3)), wrench=states.wrench), scatter
    )
    for j in range(6):
        one = np.tile(1e-6 * np.eye(6)[j], (3, 1))
        ahead, back = (world.ideal_readings(states, s).position for s in (one, -one))
        expected = scatter[j] * (ahead - back) / 2e-6
        np.testing.assert_allclose(factors[:, :, j], expected, rtol=1e-6, atol=1e-12)
