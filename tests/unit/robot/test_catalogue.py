"""The catalogue, URDF files and Pinocchio models describe the same arms."""

import math
import tomllib
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.robot.arm import UNKNOWN_TORQUE
from hilcal.robot.catalogue import UNPUBLISHED, configs_dir, load_arm, robot_names
from hilcal.robot.chain import evaluate
from hilcal.robot.scene import pinocchio_model
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.robot.urdf import arm_from_urdf
from tests.support.arm_cases import classic_flange, flange_at
from tests.support.paths import ROOT
from tests.support.refusals import refusal, refusals, refuses, with_edits
from tests.support.space_cases import frames

PI2 = math.pi / 2
ALPHA, Z = [PI2, 0.0, 0.0, PI2, -PI2, 0.0], [0.0] * 6
PUBLISHED = tomllib.loads((ROOT / "tests" / "data" / "published_arms.toml").read_text())
URS, OTHERS = PUBLISHED["universal_robots"], PUBLISHED["others"]


def test_the_catalogue_has_them_all():
    assert set(robot_names()) == {*URS, *OTHERS}


def rz(angle):
    return drawn(0, 0, 0, 0, 0, angle)


def published_flange(name, q):
    d1, a2, a3, d4, d5, d6, *_ = URS[name]
    return classic_flange(np.array([Z, [0, a2, a3, 0, 0, 0], [d1, 0, 0, d4, d5, d6], ALPHA]), q)


def flange(arm, q):
    return frames(arm, q)[-1]


def gravity_torques(arm, q):
    """Torques that hold the arm, from the change of its potential energy (central difference)."""

    def energy(q):
        pose, total = arm.links[0], 0.0
        for i in range(arm.n):
            pose = pose @ rz(q[i])
            total += 9.81 * arm.masses[i] * (pose[:3, :3] @ arm.coms[i] + pose[:3, 3])[2]
            pose = pose @ arm.links[i + 1]
        return total

    h, unit = 1e-4, np.eye(arm.n)
    return np.array([(energy(q + h * u) - energy(q - h * u)) / (2 * h) for u in unit])


def drawn(x, y, z, roll, pitch, yaw):
    """The <origin> of a URDF."""
    return pin.SE3(pin.rpy.rpyToMatrix(roll, pitch, yaw), np.array([x, y, z])).homogeneous


def in_degrees(x, y, z, *angles):
    return drawn(x, y, z, *np.radians(angles))


@pytest.mark.parametrize("name", OTHERS)
def test_arms_of_other_makers_are_those_of_their_urdfs(name):
    """The rows of the catalogue against the joints of the published URDF."""
    arm, joints = load_arm(name), OTHERS[name]["joints"]
    tool = in_degrees(*OTHERS[name]["flange"])
    q = np.random.default_rng(3).uniform(-2.0, 2.0, (20, len(joints)))
    chain = evaluate(arm, q)
    angles = q.copy()
    if name == "m10ia":  # its controller counts joint 3 from the horizontal, the URDF does not
        angles[:, 2] += angles[:, 1]
    for i, row in enumerate(angles):
        pose = np.eye(4)
        for (*origin, axis), angle in zip(joints, row, strict=True):
            about = (-1.0 if axis[0] == "-" else 1.0) * np.eye(3)["xyz".index(axis[-1])]
            turn = pin.SE3(pin.AngleAxis(angle, about).matrix(), np.zeros(3)).homogeneous
            pose = pose @ in_degrees(*origin) @ turn
        flange_at(chain, i, pose @ tool, 1e-9)
    assert arm.source
    assert np.isfinite(arm.payload)
    assert np.all((arm.q_max - arm.q_min > 1.0) & (arm.q_max - arm.q_min < 15.0))
    if np.isfinite(arm.torque_max).all() and arm.masses.any():
        # it holds itself in every posture, with the torques that it has
        weight = np.array([0.0, 0.0, -9.81])
        load = Load(np.zeros((20, 6)), np.zeros(3), 0.0, np.zeros(3), weight)
        assert np.all(
            np.abs(arm.joint_components(slot_wrenches(arm, chain, load))) < arm.torque_max
        )


@pytest.mark.parametrize("name", URS)
def test_pinocchio_agrees(name):
    arm, rng = load_arm(name), np.random.default_rng(2)
    model = pinocchio_model(arm)
    data = model.createData()
    for q in rng.uniform(-np.pi, np.pi, (20, 6)):
        pin.framesForwardKinematics(model, data, q)
        placement = data.oMf[model.getFrameId("flange")].homogeneous
        np.testing.assert_allclose(placement, published_flange(name, q), rtol=0, atol=1e-12)
        torques = pin.computeGeneralizedGravity(model, data, q)
        np.testing.assert_allclose(torques, gravity_torques(arm, q), rtol=0, atol=1e-4)
    np.testing.assert_array_equal(model.lowerPositionLimit, arm.q_min)
    np.testing.assert_array_equal(model.upperPositionLimit, arm.q_max)
    np.testing.assert_array_equal(model.upperEffortLimit, arm.torque_max)


@pytest.mark.parametrize("name", URS)
def test_masses_and_limits_are_plausible(name):
    arm, (*_, weight, payload) = load_arm(name), URS[name]
    # the foot does not move: the rest weighs less than the whole, but is most of it
    if weight:
        assert 0.75 * weight < arm.masses.sum() < weight
    assert np.all(arm.masses > 0)
    assert arm.payload == payload
    assert np.all(arm.q_min == -arm.q_max)
    assert np.degrees(arm.q_max).round(9).tolist() == [360, 360, 180, 360, 360, 360]
    assert "Universal Robots" in arm.source
    # the arm holds itself and its payload stretched out, with the joints it has
    stretched = gravity_torques(arm, np.zeros(6))
    reach = np.linalg.norm(flange(arm, np.zeros(6))[:2, 3])
    assert abs(stretched[1]) + 9.81 * arm.payload * reach < arm.torque_max[1]
    assert np.all(np.abs(stretched) < 0.6 * arm.torque_max)


@pytest.mark.parametrize("name", UNPUBLISHED)
def test_an_arm_without_published_figures_is_refused_by_name(name):
    refusal(f"{name}.*not published.*DH rows", load_arm, name)


def test_a_dh_table_of_ones_own(tmp_path):
    text = (configs_dir() / "robots" / "ur5e.toml").read_text()
    rows = text.split("[[joints]]")
    shifted = rows[1].replace("alpha_deg = 90.0", "alpha_deg = 90.0\noffset_deg = 90.0")
    (tmp_path / "mine.toml").write_text("[[joints]]".join([rows[0], shifted, *rows[2:]]))
    arm, q = load_arm("mine.toml", tmp_path), np.array([0.3, -1.0, 1.2, 0.1, 0.5, 2.0])
    turned = published_flange("ur5e", q + np.array([PI2, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(flange(arm, q), turned, rtol=0, atol=1e-12)
    assert arm.name == "mine"


def test_dh_rows_alone_are_an_arm(tmp_path):
    """Masses, limits, torques, payload, title and source may be left out, as in a URDF."""
    needed = ("[[joints]]", "name", "a_m", "d_m", "alpha_deg")
    lines = (configs_dir() / "robots" / "ur5e.toml").read_text().splitlines()
    rows = [x for x in lines[lines.index("[[joints]]") :] if x.startswith(needed)]
    (tmp_path / "mine.toml").write_text("\n".join(rows))
    arm, q = load_arm("mine.toml", tmp_path), np.array([0.3, -1.0, 1.2, 0.1, 0.5, 2.0])
    np.testing.assert_allclose(flange(arm, q), flange(load_arm("ur5e"), q), rtol=0, atol=1e-12)
    assert not arm.masses.any()
    assert np.all(np.isinf(arm.torque_max))
    assert [note.split(" ", 2)[:2] for note in arm.notes] == [
        ["mine.toml", "has"], ["no", "limits"], ["no", "torque"]
    ]  # fmt: skip


@refusals("dh_tables")
def test_a_wrong_dh_table_is_refused(case, given, tmp_path):
    text = (configs_dir() / "robots" / "ur5e.toml").read_text()
    (tmp_path / "mine.toml").write_text(with_edits(given, ur5e=text))
    refuses(case, lambda: load_arm("mine.toml", tmp_path))


# URDF


def urdf(arm, turns, extra=""):
    """Write an arm as URDF; turns[i] is how the file's joint frame i lies in the slot.

    Every body is split into two links joined rigidly, so that merging is tested as well.
    """
    lines = ['<robot name="test"><link name="base_link"/>']
    parent, before = "base_link", np.eye(4)
    for i, turn in enumerate(turns):
        origin = before.T @ arm.links[i] @ turn if i else arm.links[i] @ turn
        axis = turn[2, :3]  # the slot's z in the file's joint frame
        com = turn[:3, :3].T @ arm.coms[i]
        lines += [
            f'<joint name="{arm.joint_names[i]}" type="revolute">{_origin(origin)}'
            f'<parent link="{parent}"/><child link="link{i}"/><axis xyz="{_numbers(axis)}"/>'
            f'<limit lower="{float(arm.q_min[i])!r}" upper="{float(arm.q_max[i])!r}"'
            f' effort="{float(arm.torque_max[i])!r}" velocity="1"/></joint>',
            _link(f"link{i}", 0.75 * arm.masses[i], com),
            f'<joint name="fixed{i}" type="fixed"><origin xyz="0 0 0.5" rpy="0.1 0.2 0.3"/>'
            f'<parent link="link{i}"/><child link="half{i}"/></joint>',
        ]
        half = pin.SE3(pin.rpy.rpyToMatrix(0.1, 0.2, 0.3), np.array([0.0, 0.0, 0.5]))
        lines.append(_link(f"half{i}", 0.25 * arm.masses[i], half.actInv(com)))
        parent, before = f"link{i}", turn
    lines += [
        f'<joint name="last" type="fixed">{_origin(before.T @ arm.links[-1])}'
        f'<parent link="{parent}"/><child link="tool0"/></joint><link name="tool0"/>',
        extra,
        "</robot>",
    ]
    return "\n".join(lines)


def _numbers(values):
    return " ".join(repr(float(v)) for v in values)


def _origin(pose):
    rpy = _numbers(pin.rpy.matrixToRpy(pose[:3, :3]))
    return f'<origin xyz="{_numbers(pose[:3, 3])}" rpy="{rpy}"/>'


def _link(name, mass, com):
    return (
        f'<link name="{name}"><inertial><origin xyz="{_numbers(com)}"/>'
        f'<mass value="{float(mass)!r}"/>'
        '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>'
    )


def turn_of(seed, n):
    rng = np.random.default_rng(seed)
    return [pin.SE3(pin.Quaternion(rng.normal(size=4)).normalized(), np.zeros(3)).homogeneous
            for _ in range(n)]  # fmt: skip


@given(name=st.sampled_from(sorted(URS)), seed=st.integers(0, 2**32 - 1))
def test_urdf_round_trip(tmp_path_factory, name, seed):
    arm, path = load_arm(name), tmp_path_factory.mktemp("urdf") / "arm.urdf"
    path.write_text(urdf(arm, turn_of(seed, 6)))
    back = arm_from_urdf(path, tip_link="tool0")
    assert back.joint_names == arm.joint_names
    np.testing.assert_allclose(back.masses, arm.masses, rtol=1e-12)
    for field in ("q_min", "q_max", "torque_max"):
        np.testing.assert_allclose(getattr(back, field), getattr(arm, field), rtol=1e-12)
    for q in np.random.default_rng(seed).uniform(-np.pi, np.pi, (3, 6)):
        np.testing.assert_allclose(flange(back, q), flange(arm, q), rtol=0, atol=1e-12)
        models = [pinocchio_model(a) for a in (arm, back)]
        one, two = (pin.computeGeneralizedGravity(m, m.createData(), q) for m in models)
        np.testing.assert_allclose(two, one, rtol=0, atol=1e-9)


TURNS = turn_of(3, 6)
FINGER = (
    '<joint name="slide" type="prismatic"><origin xyz="0 0 0.1"/><parent link="{parent}"/>'
    '<child link="finger"/><axis xyz="1 0 0"/>'
    '<limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>'
) + _link("finger", 0.5, np.zeros(3))


def write(tmp_path, extra="", parent="tool0"):
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(load_arm("ur5e"), TURNS, extra.format(parent=parent)))
    return path


def test_part_of_a_urdf(tmp_path):
    whole = load_arm("ur5e")
    arm = arm_from_urdf(write(tmp_path), base_link="link1", tip_link="link4")
    assert arm.joint_names == whole.joint_names[2:5]
    q = np.array([0.4, -0.3, 1.1])
    expected = TURNS[1].T @ whole.links[2]
    for angle, link in zip(q, [*whole.links[3:5], TURNS[4]], strict=True):
        expected = expected @ rz(angle) @ link
    np.testing.assert_allclose(flange(arm, q), expected, rtol=0, atol=1e-12)
    # what hangs on link4 (wrist 3) is held and weighs on it
    np.testing.assert_allclose(arm.masses.sum(), whole.masses[2:].sum(), rtol=1e-12)


def test_mass_of_a_gripper_beyond_the_tip_is_kept(tmp_path):
    whole = load_arm("ur5e")
    arm = arm_from_urdf(write(tmp_path, FINGER), tip_link="tool0")
    assert arm.n == 6
    np.testing.assert_allclose(arm.masses[5], whole.masses[5] + 0.5, rtol=1e-12)
    tool = whole.links[6] @ np.array([0.0, 0.0, 0.1, 1.0])
    com = (whole.masses[5] * whole.coms[5] + 0.5 * tool[:3]) / arm.masses[5]
    np.testing.assert_allclose(
        np.linalg.inv(arm.links[6]) @ [*arm.coms[5], 1.0],  # both seen from the flange
        np.linalg.inv(whole.links[6]) @ [*com, 1.0],
        atol=1e-12,
    )


def test_continuous_joint_turns_freely(tmp_path):
    path = write(tmp_path)
    text = path.read_text().replace('type="revolute"', 'type="continuous"')
    path.write_text(text)
    arm, q = arm_from_urdf(path, tip_link="tool0"), np.array([0.3, -1.0, 1.2, 0.1, 0.5, 2.0])
    np.testing.assert_allclose(arm.q_max, 2 * np.pi)
    np.testing.assert_allclose(flange(arm, q), published_flange("ur5e", q), rtol=0, atol=1e-12)


def test_prismatic_joint_in_the_arm_slides(tmp_path):
    arm = arm_from_urdf(write(tmp_path, FINGER), tip_link="finger")
    assert arm.slides.tolist() == [False] * 6 + [True]
    assert (arm.q_min[-1], arm.q_max[-1]) == (0.0, 0.1)


PLANAR = FINGER.replace('type="prismatic"', 'type="planar"')
ENDLESS = FINGER.replace('lower="0" upper="0.1"', 'lower="0" upper="0"')


@pytest.mark.parametrize(
    ("extra", "base", "tip", "message"),
    [
        ("", None, None, r"branches; set tip_link .*half0, .*half5, .*tool0"),
        (PLANAR, None, "finger", r'joint "slide" has more than one degree of free'),
        (ENDLESS, None, "finger", r'prismatic joint "slide" has no <lim'),
        ("", "base_link", "tool1", r'tip_link = "tool1" is no link \(did you mean "tool0"\?\)'),
        ("", "bose", "tool0", r'base_link = "bose" is no link.*valid: base_link, link0'),
        ("", "tool0", "link0", r'no moving joint leads from link "tool0" to link "link0"'),
        ("", "link5", "tool0", r'no moving joint leads from link "link5" to link "tool0"'),
    ],
)
def test_a_chain_that_is_no_arm_is_refused(tmp_path, extra, base, tip, message):
    refusal(message, arm_from_urdf, write(tmp_path, extra), base_link=base, tip_link=tip)


@refusals("urdfs")
def test_not_a_urdf(case, given, tmp_path, capfd):
    path = tmp_path / "arm.urdf"
    path.write_text(given.rstrip("\n"))
    refuses(case, lambda: arm_from_urdf(path), path)
    assert capfd.readouterr() == ("", "")  # the C++ parser's own output is in the message


@pytest.mark.parametrize("name", ["ur5e", "ur10e", "ur20", "iiwa14", "xarm6"])
def test_a_torque_that_is_not_stated_is_that_of_the_weights(name):
    arm = load_arm(name)
    unstated = replace(arm, torque_max=np.full(arm.n, np.inf)).ratings
    assert 0.6 < np.median(arm.torque_max / unstated) < 1.7
    heavy = replace(arm, masses=10 * arm.masses, torque_max=np.full(arm.n, np.inf), payload=np.inf)
    assert heavy.ratings[1] > 3 * arm.torque_max[1]
    bare = replace(heavy, masses=np.zeros(arm.n))
    np.testing.assert_array_equal(bare.ratings, UNKNOWN_TORQUE)
