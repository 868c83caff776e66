"""The elastic arm against mechanics written out by hand: energy, torques, laws, cantilever."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.drivers.simulated.mechanics import build, elasticity, equilibrium, long_links
from hilcal.drivers.simulated.truth import Truth
from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from tests.support.example_cell import ur10e_cell
from tests.support.refusals import refusal
from tests.support.running_world import frames, moment_beyond

CELL = ur10e_cell()
ARM = CELL.arm
JOINT = np.array([6.0, 8.0, 9.0, 30.0, 35.0, 40.0]) * 1e-6
TILT = np.array([3.0, 4.0, 5.0, 15.0, 15.0, 20.0]) * 1e-6
BASE = np.array([2.0, 3.0, 1.5]) * 1e-6
BEAM = np.array([[8.0, 12.0], [9.0, 10.0]]) * 1e-6
STIFF = -JOINT / 9.0 / np.array([300.0, 300.0, 150.0, 60.0, 50.0, 50.0]) ** 2
Q = np.array([[0.3, -1.1, 1.4, 0.5, -0.7, 0.2], [-2.0, -0.6, 0.9, -1.8, 1.1, 2.5]])
WRENCH = np.array([[20.0, -35.0, -110.0, 6.0, -4.0, 9.0], [-60.0, 10.0, -80.0, 2.0, 7.0, -5.0]])


def solve(q, wrench, cell=CELL, **hidden):
    truth = replace(Truth.rigid(cell.arm), **hidden)
    tree = build(cell, truth)
    law = elasticity(tree, truth, cell.arm)
    rest = equilibrium(tree, law, np.atleast_2d(q), np.atleast_2d(wrench), cell.load_point)
    return tree, law, rest


def everything():
    return solve(
        Q,
        WRENCH,
        joint_compliance=JOINT,
        joint_stiffening=STIFF,
        joint_tilt_compliance=TILT,
        base_compliance=BASE,
        link_compliance=BEAM,
    )


def test_energy_is_stationary_and_virtual_work_of_the_moment_balances():
    tree, law, rest = everything()
    stencil = ((-2, 1.0 / 12), (-1, -8.0 / 12), (1, 8.0 / 12), (2, -1.0 / 12))
    h = 1e-3
    for i in range(len(Q)):

        def work(delta, i=i):
            give = {k: delta[dofs] for k, dofs in zip(long_links(ARM), tree.beam, strict=True)}
            bodies, _, flange = frames(
                ARM,
                Q[i] + delta[tree.drive],
                delta[tree.base],
                delta[tree.tilt].reshape(-1, 2),
                give,
            )
            out = 0.0
            for body, mass, com in zip(bodies, ARM.masses, ARM.coms, strict=True):
                out += mass * CELL.gravity @ (body[:3, :3] @ com + body[:3, 3])
            tool = flange[:3, :3] @ CELL.tool_com + flange[:3, 3]
            load = flange[:3, :3] @ CELL.load_point + flange[:3, 3]
            out += CELL.tool_mass * CELL.gravity @ tool + WRENCH[i, :3] @ load
            return out, flange

        delta = rest.deflection[i]
        here = work(delta)[1]
        np.testing.assert_allclose(rest.flange[i], here, atol=1e-13)
        for d in range(len(delta)):
            slope, spin = 0.0, np.zeros((3, 3))
            for step, weight in stencil:
                moved = delta.copy()
                moved[d] += step * h
                energy, flange = work(moved)
                slope += weight * energy / h
                spin += weight * flange[:3, :3] / h
            spin = spin @ here[:3, :3].T
            omega = np.array([spin[2, 1], spin[0, 2], spin[1, 0]])
            exerted = slope + WRENCH[i, 3:] @ omega
            assert abs(exerted - rest.torque[i, d]) < 1e-7  # rounding of 100 J over 1 mrad
        spring = law.linear @ rest.torque[i] + law.cubic * rest.torque[i] ** 3
        np.testing.assert_allclose(delta, spring, atol=1e-16, rtol=1e-12)


def test_the_linear_law_is_the_limit():
    errors = []
    for small in (1.0, 0.1, 0.01):
        tree, _, rest = solve(Q[0], WRENCH[0], joint_compliance=small * JOINT)
        linear = [
            small * JOINT[j] * np.dot(*moment_beyond(CELL, Q[0], WRENCH[0], j)[:2])
            for j in range(6)
        ]
        errors.append(np.abs(rest.deflection[0, tree.drive] - linear).max() / small)
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(10.0, rel=0.1)


def cantilever():
    """One joint, and a massless level link of 0.8 m to a second one that carries the flange."""
    links = np.tile(np.eye(4), (3, 1, 1))
    links[1, 0, 3] = 0.8
    return Arm(
        name="cantilever", links=links, masses=np.zeros(2), coms=np.zeros((2, 3)),
        q_min=np.full(2, -3.0), q_max=np.full(2, 3.0), torque_max=np.full(2, 100.0),
        payload=5.0, joint_names=("a", "b"), source="test",
    )  # fmt: skip


@pytest.mark.parametrize("force", [[0.0, 3.0, -7.0], [0.0, 0.0, 0.0]])
def test_a_long_link_bends_as_a_cantilever(force):
    arm, length, bend, twist = cantilever(), 0.8, 2e-7, 5e-7
    moment = np.array([0.4, -0.3, 0.6])
    assert list(long_links(arm)) == [1]
    none = np.zeros(3)
    cell = replace(CELL, arm=arm, tool_mass=0.0, tool_com=none, load_point=none)
    wrench = np.concatenate([force, moment])[None]
    given = np.array([[bend, twist]])
    _, _, rest = solve(np.zeros((1, 2)), wrench, cell, link_compliance=given)
    # handbook: deflection L³/3EI F ± L²/2EI M, slope L²/2EI F ± L/EI M, twist L/GJ M
    y = length**3 / 3 * bend * force[1] + length**2 / 2 * bend * moment[2]
    z = length**3 / 3 * bend * force[2] - length**2 / 2 * bend * moment[1]
    about = np.array([
        length * twist * moment[0],
        length * bend * moment[1] - length**2 / 2 * bend * force[2],
        length * bend * moment[2] + length**2 / 2 * bend * force[1],
    ])  # fmt: skip
    # over 1 µm and 1 µrad the next order is 1e-6 of the first
    np.testing.assert_allclose(rest.flange[0, :3, 3], [0.8, y, z], atol=1e-5 * (abs(y) + abs(z)))
    turn_vector = Rotation.from_matrix(rest.flange[0, :3, :3]).as_rotvec()
    np.testing.assert_allclose(turn_vector, about, rtol=1e-4)


def test_jacobian_is_the_derivative_of_the_flange():
    tree, _, rest = solve(Q, WRENCH)
    h = 1e-6
    for j in range(6):
        ahead, behind = (solve(Q + s * h * np.eye(6)[j], WRENCH)[2].flange for s in (1, -1))
        move = (ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * h)
        spin = ((ahead - behind) / (2 * h))[:, :3, :3] @ np.swapaxes(rest.flange, 1, 2)[:, :3, :3]
        omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        np.testing.assert_allclose(rest.jacobian[:, :3, j], move, atol=1e-8)
        np.testing.assert_allclose(rest.jacobian[:, 3:, j], omega, atol=1e-8)
    assert len(tree.drive) == 6


def test_a_gear_that_would_spring_back_is_refused():
    with pytest.raises(InputError, match=r"state 0: joint_stiffening is too strong"):
        solve(Q, WRENCH, joint_compliance=JOINT, joint_stiffening=-JOINT / 50.0**2)


def test_an_arm_that_collapses_is_refused():
    refusal(r"state \d: .*equilibrium", solve, Q, WRENCH, joint_compliance=np.full(6, 0.3))
