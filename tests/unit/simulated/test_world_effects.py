"""Laws of the world's further effects, each against a formula or an arm that is built that way."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.truth import Truth
from studies.random_campaigns import rehearsal_states
from tests.support.example_cell import ur10e_cell
from tests.support.rehearsed import dead_weights
from tests.support.running_world import frames, moment_beyond

CELL = ur10e_cell()
ARM = CELL.arm
PULLS = [*dead_weights([5.0, 10.0], CELL.gravity),
         ("pull", np.array([60.0, -30.0, 20.0, 4.0, -7.0, 5.0]))]  # fmt: skip
STATES, POSE, LOAD, CYCLE = rehearsal_states(CELL, 6, PULLS, np.random.default_rng(4))
JOINT = np.array([6.0, 8.0, 9.0, 30.0, 35.0, 40.0]) * 1e-6
SOFT = {
    "joint_compliance": JOINT,
    "joint_tilt_compliance": 0.4 * JOINT,
    "base_compliance": np.array([2.0, 3.0, 1.5]) * 1e-6,
    "tool_compliance": np.array([1e-5, 3e-5]),
}


def world(cell=CELL, **effects):
    base = world_without_effect(CELL, np.random.default_rng(2))
    return replace(base, cell=cell, physics=replace(Truth.rigid(cell.arm), **effects))


def cell_with(**changes):
    return replace(CELL, arm=replace(ARM, **changes))


def close(a, b, states=STATES, atol=1e-13):
    """Both rest alike and are seen alike."""
    one, two = a.ideal_readings(states), b.ideal_readings(states)
    np.testing.assert_allclose(one.position, two.position, rtol=0, atol=atol)
    np.testing.assert_allclose(one.rotation, two.rotation, rtol=0, atol=atol)


def rigid_torques(states):
    """(N, n) torques at the drives of the rigid arm."""
    return np.array(
        [
            [np.dot(*moment_beyond(CELL, q, w, j)[:2]) for j in range(6)]
            for q, w in zip(states.q, states.wrench, strict=True)
        ]
    )


def drive_angles(w, states):
    return w.equilibrium(states).deflection[:, w.drives]


def test_the_flange_turns_by_the_moment_there_along_and_across_its_axis():
    small = 1e-8  # the next order is smaller by c M, about 1e-6
    along, across = 2.0 * small, 5.0 * small
    rest = world(tool_compliance=np.array([along, across])).equilibrium(STATES)
    for i in range(len(STATES)):
        stiff = frames(ARM, STATES.q[i])[2]
        turn = stiff[:3, :3]
        moment = STATES.wrench[i, 3:] + np.cross(turn @ CELL.load_point, STATES.wrench[i, :3])
        moment = moment + np.cross(turn @ CELL.tool_com, CELL.tool_mass * CELL.gravity)
        expected = np.array([across, across, along]) * (turn.T @ moment)
        turn_vector = Rotation.from_matrix(turn.T @ rest.flange[i, :3, :3]).as_rotvec()
        second = expected @ expected  # three successive turns are no rotation vector
        np.testing.assert_allclose(turn_vector, expected, rtol=1e-4, atol=second)
        np.testing.assert_allclose(rest.flange[i, :3, 3], stiff[:3, 3], atol=1e-13)


def test_periodic_compliance_goes_twice_round_with_the_commanded_angle():
    ab = 1e-11 * np.random.default_rng(0).normal(size=(6, 2))
    torque = rigid_torques(STATES)
    give = ab[:, 0] * np.cos(2 * STATES.q) + ab[:, 1] * np.sin(2 * STATES.q)
    deflection = drive_angles(world(periodic_joint_compliance=ab), STATES)
    np.testing.assert_allclose(deflection, torque * give, rtol=1e-5, atol=1e-15)
    # where all stand at one angle it is a plain compliance, also where that is no small one
    same = replace(STATES, q=np.full_like(STATES.q, 0.4))
    big = np.column_stack([3.0 * JOINT, -2.0 * JOINT])
    plain = (3.0 * np.cos(0.8) - 2.0 * np.sin(0.8)) * JOINT
    close(world(periodic_joint_compliance=big), world(joint_compliance=plain), same)


def test_play_is_crossed_with_the_sign_of_the_torque():
    b = 1e-9 * np.arange(1.0, 7.0)
    torque, tenth = rigid_torques(STATES), 0.01 * ARM.torque_max
    deflection = drive_angles(world(backlash=b), STATES)
    np.testing.assert_allclose(deflection, b * np.tanh(torque / tenth), rtol=1e-5, atol=1e-15)
    far = np.abs(torque) > 10.0 * tenth
    assert 0.2 < far.mean() < 1.0
    np.testing.assert_allclose(deflection[far], (b * np.sign(torque))[far], rtol=1e-7)


def test_creep_softens_the_drives_by_decades_of_the_time_under_load():
    k = 0.05
    for time, decades in ((0.0, 0.0), (9.0, 1.0), (99.0, 2.0)):
        states = replace(STATES, load_time=np.full(len(STATES), time))
        creeping = world(**SOFT, creep=np.array([k]))
        softer = world(**{**SOFT, "joint_compliance": (1.0 + k * decades) * JOINT})
        close(creeping, softer, states)
    close(world(creep=np.array([k])), world())  # what does not give way does not creep


def test_links_grow_with_the_temperature_of_the_air():
    alpha, count = 2e-4, len(STATES)
    states = replace(STATES, air_temperature=np.linspace(10.0, 40.0, count))
    grown = world(**SOFT, thermal_growth=np.array([alpha]))
    grown_readings = grown.ideal_readings(states)
    for i in range(0, count, 5):
        links = ARM.links.copy()
        links[:, :3, 3] *= 1.0 + alpha * (states.air_temperature[i] - 20.0)
        long = world(cell_with(links=links), **SOFT).ideal_readings(states[i : i + 1])
        np.testing.assert_allclose(grown_readings.position[i], long.position[0], rtol=0, atol=1e-13)
        np.testing.assert_allclose(grown_readings.jacobian[i], long.jacobian[0], rtol=0, atol=1e-12)
    rigid = world(thermal_growth=np.array([alpha])).equilibrium(states).flange
    stiff = np.array([frames(ARM, q)[2] for q in states.q])
    factor = 1.0 + alpha * (states.air_temperature - 20.0)
    np.testing.assert_allclose(rigid[:, :3, 3], factor[:, None] * stiff[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(rigid[:, :3, :3], stiff[:, :3, :3], atol=1e-12)


def test_joints_drift_with_their_own_temperature_from_a_reference():
    kappa = 1e-5 * np.arange(1.0, 7.0)
    drifting = replace(world(thermal_joint_drift=kappa), joint_reference=25.0)
    turned = replace(STATES, q=STATES.q + kappa * (STATES.joint_temperature - 25.0))
    np.testing.assert_allclose(
        drifting.ideal_readings(STATES).position,
        world().ideal_readings(turned).position,
        rtol=0,
        atol=1e-13,
    )
    assert world().joint_reference == 22.0


def test_first_moments_shift_the_centres_of_mass():
    moments = 0.3 * np.random.default_rng(7).normal(size=(6, 3))
    coms = ARM.coms + moments / ARM.masses[:, None]
    close(world(**SOFT, link_mass=moments), world(cell_with(coms=coms), **SOFT))


BIAS = np.array([3.0, -5.0, 8.0, 0.4, -0.7, 0.5])
GAIN = np.array([0.05, -0.08, 0.1, -0.06, 0.04, 0.07])
TURN = np.array([0.06, -0.1, 0.2])


def acting(flange, said, *, bias=0.0, gain=0.0, turn=(0.0, 0.0, 0.0)):
    """What acts where the sensor in this flange says so; (N, 6), base axes."""
    out = np.zeros_like(said)
    axes = Rotation.from_rotvec(turn).as_matrix()
    for i, wrench in enumerate(said):
        if np.any(wrench):
            R = flange[i, :3, :3]
            in_flange_axes = (np.concatenate([R.T @ wrench[:3], R.T @ wrench[3:]]) - bias) / (
                1.0 + gain
            )
            out[i] = np.concatenate([R @ axes @ in_flange_axes[:3], R @ axes @ in_flange_axes[3:]])
    return out


@pytest.mark.parametrize(
    ("hidden", "told"),
    [
        ({"wrench_bias": BIAS}, {"bias": BIAS}),
        ({"wrench_gain": GAIN}, {"gain": GAIN}),
        ({"sensor_misalignment": TURN}, {"turn": TURN}),
        (
            {"wrench_bias": BIAS, "wrench_gain": GAIN, "sensor_misalignment": TURN},
            {"bias": BIAS, "gain": GAIN, "turn": TURN},
        ),
    ],
)
def test_the_arm_rests_under_what_acts_where_the_sensor_misreads_it(hidden, told):
    misread = world(**SOFT, **hidden)
    flange = misread.equilibrium(STATES).flange
    truly = replace(STATES, wrench=acting(flange, STATES.wrench, **told))
    perfect = world(**SOFT)
    np.testing.assert_allclose(perfect.equilibrium(truly).flange, flange, rtol=0, atol=1e-12)
    loaded = LOAD > 0
    moved = np.abs(perfect.equilibrium(STATES).flange - flange).max(axis=(1, 2))
    assert moved[loaded].min() > 1e-6
    assert moved[~loaded].max() == 0.0
    torque = misread.drive_torque(STATES) - perfect.drive_torque(truly)
    assert np.abs(torque).max() < 1e-9


def test_parameters_are_named_in_the_order_of_their_arrays():
    rng = np.random.default_rng(1)
    rigid = Truth.rigid(ARM)
    names = {
        "tool_compliance": "along across",
        "periodic_joint_compliance": " ".join(f"j{j}.cos2 j{j}.sin2" for j in range(1, 7)),
        "backlash": "j1 j2 j3 j4 j5 j6",
        "creep": "k",
        "joint_coupling": " ".join(f"j{j}.q{i}" for j in range(1, 7) for i in range(1, 7)),
        "thermal_growth": "alpha",
        "thermal_joint_drift": "j1 j2 j3 j4 j5 j6",
        "link_mass": " ".join(f"link{k}.{axis}" for k in range(1, 7) for axis in "xyz"),
        "wrench_bias": "fx fy fz mx my mz",
        "wrench_gain": "fx fy fz mx my mz",
        "sensor_misalignment": "rx ry rz",
        "tracker_scale": "scale",
    }
    for effect, labels in names.items():
        value = rng.normal(size=getattr(rigid, effect).shape)
        named = rigid.with_effect(effect, value).nonzero_parameters(ARM)
        assert list(named) == [f"{effect}.{label}" for label in labels.split()]
        assert list(named.values()) == value.ravel().tolist()
