"""The elastic arm against mechanics written out by hand; the world as time goes by; its file."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.drivers.simulated.mechanics import build, elasticity, equilibrium, long_links
from hilcal.drivers.simulated.truth import Truth
from hilcal.drivers.simulated.world_server import read_world, write_world
from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from tests.support.example_cell import ur10e_cell
from tests.support.refusals import refusal
from tests.support.running_world import (
    PULL,
    WEIGHT,
    RunningWorld,
    config,
    every_effect,
    frames,
    remaining_effects,
    running_world,
    same_bytes,
    states,
    world_of,
)
from tests.support.running_world import (
    Q as AT_REST,
)

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
    seen = Rotation.from_matrix(rest.flange[0, :3, :3]).as_rotvec()
    np.testing.assert_allclose(seen, about, rtol=1e-4)


def test_a_gear_that_would_spring_back_is_refused():
    with pytest.raises(InputError, match=r"state 0: joint_stiffening is too strong"):
        solve(Q, WRENCH, joint_compliance=JOINT, joint_stiffening=-JOINT / 50.0**2)


def test_an_arm_that_collapses_is_refused():
    refusal(r"state \d: .*equilibrium", solve, Q, WRENCH, joint_compliance=np.full(6, 0.3))


@pytest.fixture
def cell(tmp_path):
    return running_world(tmp_path)


def slip_of(cell):
    return cell.living.slip(cell.arrivals)[None]


# repeatability


def test_the_slip_stays_until_the_next_arrival_and_comes_new_with_it(cell, tmp_path):
    first = cell.rest_at(AT_REST)["flange"].copy()
    cell.board.write("arm", moving=1.0, q=AT_REST + 0.1)
    on_the_way = cell.truth_after()["flange"]
    assert np.abs(on_the_way - first).max() > 1e-2
    cell.board.write("arm", q=AT_REST, moving=1.0)
    assert same_bytes(cell.truth_after()["flange"], first)
    assert not same_bytes(cell.rest_at(AT_REST)["flange"], first)


# the wrench on the sensor

MOUNT = {"origin_m": [0.01, -0.02, 0.045], "rotvec_rad": [0.3, -0.9, 2.1]}
SENSOR = {"force_sensor": {"driver": "ft300", "port": "x", **MOUNT}}


def test_the_sensor_feels_the_weight_of_tool_and_load_in_its_own_axes(tmp_path):
    cell = running_world(tmp_path, sections=SENSOR, load_point=np.array([0.004, 0.0, -0.003]))
    cell.living.hang("5kg")
    for q in (AT_REST, -AT_REST, AT_REST + 0.8):
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
    cell = yielding(tmp_path, (AT_REST, np.zeros(6)), (AT_REST, WEIGHT))
    before = cell.rest_at(AT_REST)
    refusal("spring back", cell.living.hang, "5kg")
    refusal("spring back", cell.living.push, WEIGHT.tolist())
    after = cell.truth_after()
    assert (after["load"], after["load_since"]) == (0, 0.0)
    assert same_bytes(before["flange"], after["flange"])
    again = cell.rest_at(AT_REST)
    assert again["arrivals"] == before["arrivals"] + 1
    np.testing.assert_allclose(again["flange"], before["flange"], atol=1e-3)


def test_a_pose_without_equilibrium_is_logged_and_the_world_lives_on(tmp_path):
    upright = np.array([0.0, -np.pi / 2, 0.0, 0.0, 0.0, 0.0])
    cell = yielding(tmp_path, (upright, np.zeros(6)), (0 * AT_REST, np.zeros(6)))
    before = cell.rest_at(upright)
    stretched = cell.rest_at(0 * AT_REST)
    assert same_bytes(stretched["flange"], before["flange"])
    assert "spring back" in cell.living.log()[0]["event"]
    cell.truth_after()
    assert len(cell.living.log()) == 1
    assert cell.rest_at(upright)["arrivals"] == 3


def state_of(cell, truth, wrench):
    """The state that a truth belongs to."""
    state = states(AT_REST, wrench, float(truth["time"]))
    return replace(
        state,
        load_time=truth["time"][None] - truth["load_since"],
        joint_temperature=truth["joint_temperature"][None],
    )


def test_a_load_swings_for_a_while_and_rests_where_it_should(cell, tmp_path):
    cell.rest_at(AT_REST)
    cell.living.swing([0.0, 0.0, 20.0, 0.0, 0.0, 0.0], period=1e-3, decay=0.2)  # world s
    cell.living.hang("5kg")
    still = cell.world.equilibrium(
        states(AT_REST, WEIGHT, 0.0), cell.living.slip(cell.arrivals)[None]
    ).flange[0]
    seen = [cell.truth_after()["flange"] for _ in range(2)]
    assert not same_bytes(seen[0], still)
    assert not same_bytes(seen[0], seen[1])
    time.sleep(0.2)  # 4 s of the world, 20 decays
    assert same_bytes(cell.truth_after()["flange"], still)


def test_every_effect_shows_in_the_truth(tmp_path):
    cell = running_world(
        tmp_path, sections=SENSOR, **every_effect(np.random.default_rng(2)), **remaining_effects(3)
    )
    cell.living.hang("pull")
    truth = cell.rest_at(AT_REST)
    want = cell.world.ideal_readings(state_of(cell, truth, PULL), slip_of(cell))
    assert same_bytes(truth["target"], want.position[0])
    for effect in remaining_effects(3):
        gone = np.zeros_like(getattr(cell.world.physics, effect))
        less = replace(cell.world, physics=cell.world.physics.with_effect(effect, gone))
        seen = less.ideal_readings(state_of(cell, truth, PULL), slip_of(cell)).position[0]
        # Creep has only begun; equilibria are exact to 1e-12 rad.
        assert np.linalg.norm(seen - truth["target"]) > 1e-9, effect


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
    first = cell.rest_at(AT_REST)
    time.sleep(0.02)
    second = cell.truth_after()
    assert second["time"] - first["time"] >= 0.02 * 20.0
    want = cell.world.ideal_readings(state_of(cell, second, WEIGHT), slip_of(cell))
    assert same_bytes(second["target"], want.position[0])
    assert not same_bytes(second["target"], first["target"])


def test_world_comes_back_from_its_file_to_the_last_bit(tmp_path):
    made = config(force_sensor={"driver": "ft300", "port": "x", "origin_m": [0, 0, 0.1]})
    world = world_of(made, **every_effect(np.random.default_rng(3)), **remaining_effects(4))
    world = replace(world, joint_reference=23.4)
    write_world(tmp_path / "world.json", world, made)
    back, told = read_world(tmp_path / "world.json")
    assert told == made
    assert back.truth == world.truth
    assert back.noise == world.noise
    for name in ("registration", "station", "joint_std"):
        assert same_bytes(getattr(back, name), getattr(world, name))
    assert back.joint_reference == 23.4
    state = replace(states(AT_REST, WEIGHT, 12.3), joint_temperature=np.full((1, 6), 25.0))
    assert same_bytes(back.ideal_readings(state).position, world.ideal_readings(state).position)


@pytest.mark.parametrize("text", ["", "[1]", '{"format": "hilcal-plan"}', "{"])
def test_another_file_is_no_world(tmp_path, text):
    (tmp_path / "world.json").write_text(text)
    refusal("no world", read_world, tmp_path / "world.json")


def test_a_damaged_world_says_so(tmp_path):
    path = tmp_path / "world.json"
    write_world(path, world_of(config()), config())
    content = json.loads(path.read_text())
    del content["physics"]["base_frame"]
    path.write_text(json.dumps(content))
    refusal(r"no world: TypeError .*'base_frame'", read_world, path)
    refusal("cannot be read", read_world, tmp_path / "none.json")
