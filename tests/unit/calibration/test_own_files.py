"""Descriptions of the user, corrected where their numbers stand: against Pinocchio and others."""

import difflib
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from hilcal.calibration.handover import CorrectedArm, matlab
from hilcal.calibration.robot_files.descriptions import correct_file
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.robot.arm import with_conventions
from hilcal.robot.catalogue import load_arm
from tests.support.description_files import MJCF, SDF
from tests.support.maker_arms import maker_arm, urdf_of
from tests.support.refusals import refusal, refusals, refuses, with_edits
from tests.unit.calibration.other_eyes import by_pinocchio, flanges, turned

Q = np.random.default_rng(1).uniform(-2, 2, (12, 6))
NM = 1e-9


@pytest.fixture
def arm(tmp_path):
    return maker_arm("krl", tmp_path)


def changed(arm, where=slice(None), seed=0):
    off = se3.matrix(*se3.exp(3e-4 * np.random.default_rng(seed).standard_normal((7, 6))))
    links = arm.links.copy()
    links[where] = links[where] @ off[where]
    return replace(arm, links=links)


def poses(arm):
    return flanges(arm, Q)


def correct(path, nominal, new, *ends):
    return correct_file(path, nominal, CorrectedArm(new, (), ()), *ends)


def lines_changed(before, after):
    diff = difflib.unified_diff(before.split("\n"), after.split("\n"), n=0, lineterm="")
    return [line[1:] for line in diff if line.startswith("+") and not line.startswith("+++")]


def test_a_urdf_keeps_all_but_the_origins_of_its_joints(arm, tmp_path):
    text = urdf_of("krl").replace("'", '"').replace("\n", "\r\n")
    text = text.replace(
        '<link name="link_2"/>',
        '<link name="link_2"><!-- häßlich --><visual><origin xyz="1 2 3" rpy="0 0 1"/><geometry>'
        '<mesh filename="package://a/b.stl"/></geometry></visual></link>',
    )
    text = text.replace('<origin xyz="0.61 0 0" rpy="0 0 0"/>', "<origin xyz='0.61 0 0'/>")
    text = text.replace('<origin xyz="0 0 0" rpy="0 0 0"/>', "")  # joint 6
    path, new = tmp_path / "mine.urdf", changed(arm)
    path.write_bytes(text.encode())
    corrected = correct(path, arm, new)
    after = corrected.content.decode()
    path.write_bytes(corrected.content)
    made = by_pinocchio(pin.buildModelFromUrdf(str(path)), Q, "tool0", "base_link")
    np.testing.assert_allclose(made, poses(new), atol=NM)
    assert len(lines_changed(text, after)) == 7
    joint_origin = re.compile(r"(<joint[^>]*>)(<origin[^>]*/>)?")
    assert joint_origin.sub(r"\1", after) == joint_origin.sub(r"\1", text)
    assert "7 places changed (j1, j2, j3, j4, j5, j6, flange)" in corrected.note
    same = correct(tmp_path / "krl.urdf", arm, arm)
    assert same.content == (tmp_path / "krl.urdf").read_bytes()
    assert "krl.urdf: no place changed, all else" in same.note


def test_a_urdf_with_a_base_beside_and_zeros_of_its_own(tmp_path):
    """`base` is a leaf, half a turn from `base_link`; the controller counts from other zeros."""
    drawn = maker_arm("krl", tmp_path)
    text = (tmp_path / "krl.urdf").read_text()
    extra = (
        "<link name='base'/><joint name='to_base' type='fixed'><origin xyz='0 0 0.1' "
        "rpy='0 0 3.141592653589793'/><parent link='base_link'/><child link='base'/></joint>"
    )
    path = tmp_path / "mine.urdf"
    path.write_text(text.replace("</robot>", f"{extra}</robot>"))
    up = se3.matrix(np.diag([-1.0, -1.0, 1.0]), np.array([0, 0, 0.1]))
    links = drawn.links.copy()
    links[0] = se3.inverse(up) @ links[0]
    sign, zero = np.array([1.0, -1, 1, 1, -1, 1]), np.array([0.1, -1.57, 0, 0.3, 0, 0])
    arm = with_conventions(replace(drawn, links=links), sign, zero, np.zeros((6, 6)))
    new = changed(arm)
    path.write_bytes(correct(path, arm, new, "base", "tool0").content)
    made = by_pinocchio(pin.buildModelFromUrdf(str(path)), sign * Q + zero, "tool0", "base")
    np.testing.assert_allclose(made, poses(new), atol=NM)


def test_a_xacro_is_corrected_where_it_has_numbers(arm, tmp_path):
    text = urdf_of("krl").replace("1.5707963267948966", "${pi/2}")
    text = re.sub(r"'(base_link|link_\d|tool0|j\d)'", r"'${prefix}\1'", text)
    text = text.replace("<robot name='krl'>", "<robot xmlns:xacro='x'><xacro:macro name='krl'>")
    text = text.replace("</robot>", "</xacro:macro></robot>")
    path = tmp_path / "krl.xacro"
    path.write_text(text)
    corrected = correct(path, arm, changed(arm, slice(1, 5)), "base_link", "tool0")
    assert "places changed (${prefix}j2, ${prefix}j3, ${prefix}j4, ${prefix}j5)" in corrected.note
    assert len(lines_changed(text, corrected.content.decode())) == 4
    assert corrected.content.decode().count("${pi/2}") == 1
    with pytest.raises(InputError, match=r"krl\.xacro: line 16: the place of joint 'flange' is"):
        correct(path, arm, changed(arm), "base_link", "tool0")
    path.write_text(text.replace("0 0 0.45", "0 0 ${h1}"))
    with pytest.raises(InputError, match=r"line 10: '\$\{h1\}' is not of numbers; .* xacro F"):
        correct(path, arm, changed(arm), "base_link", "tool0")


def test_an_mjcf_is_the_corrected_arm_to_pinocchio(arm, tmp_path):
    path, new = tmp_path / "lab.xml", changed(arm)
    path.write_text(MJCF)

    def flanges_of_file():
        return by_pinocchio(pin.buildModelFromMJCF(str(path)), Q, "flange", "base")

    np.testing.assert_allclose(flanges_of_file(), poses(arm), atol=NM)
    corrected = correct(path, arm, new, "base", "flange")
    path.write_bytes(corrected.content)
    np.testing.assert_allclose(flanges_of_file(), poses(new), atol=NM)
    after = corrected.content.decode()
    assert len(lines_changed(MJCF, after)) == 7
    assert "<!-- the arm of bay 3 -->" in after
    assert "1 places have" not in corrected.note
    rounded = MJCF.replace("0.61 0.1 0", "0.612 0.1 0").replace("0 0 0.66", "0 0 0.663")
    path.write_text(rounded)
    corrected = correct(path, arm, new, "base", "flange")
    assert "its axes were up to 3.00 mm from those of the nominal krl" in corrected.note
    path.write_bytes(corrected.content)
    np.testing.assert_allclose(flanges_of_file(), poses(new), atol=NM)
    lost = correct(path, new, changed(new), "base")
    assert "cannot represent the shift of the flange" in lost.note


def sdf_flanges(text):
    """Forward kinematics of an SDF by ElementTree and SciPy."""
    model = ElementTree.fromstring(text.partition("?>")[2]).find("model")
    named = {e.get("name"): e for e in model if e.tag in ("link", "joint")}

    def at(name):
        if name in (None, "__model__"):
            return np.eye(4)
        e = named[name]
        pose, out = e.find("pose"), np.eye(4)
        if pose is not None:
            v = [float(x) for x in str(pose.text).split()]
            out = se3.matrix(Rotation.from_euler("xyz", v[3:]).as_matrix(), np.array(v[:3]))
        over = None if pose is None else pose.get("relative_to")
        return at(over or (e.findtext("child") if e.tag == "joint" else None)) @ out

    result = []
    for row in Q:
        place = at("base")
        for k, angle in enumerate(row):
            joint = named[f"a{k + 1}"]
            xyz = joint.find("axis/xyz")
            axis = np.array([float(v) for v in str(xyz.text).split()])
            axis = at(xyz.get("expressed_in") or f"a{k + 1}")[:3, :3] @ axis
            axis = at(f"a{k + 1}")[:3, :3].T @ axis
            parent, child = (str(joint.findtext(tag)) for tag in ("parent", "child"))
            turn = se3.matrix(Rotation.from_rotvec(angle * axis).as_matrix(), np.zeros(3))
            to_joint = se3.inverse(at(parent)) @ at(f"a{k + 1}")
            place = place @ to_joint @ turn @ se3.inverse(at(f"a{k + 1}")) @ at(child)
        result.append(place @ se3.inverse(at("l6")) @ at("tool0"))
    return np.stack(result)


def test_an_sdf_is_the_corrected_arm_and_carries_what_hangs_on_it(arm, tmp_path):
    path, new = tmp_path / "lab.sdf", changed(arm)
    path.write_text(SDF)
    np.testing.assert_allclose(sdf_flanges(SDF), poses(arm), atol=NM)
    corrected = correct(path, arm, new, "base", "tool0")
    after = corrected.content.decode()
    np.testing.assert_allclose(sdf_flanges(after), poses(new), atol=1e-8)
    assert "<!-- by hand -->" in after
    places = re.compile(r"(<pose[^>]*>|<xyz[^>]*>)[^<]*")
    assert places.sub(r"\1", after) == places.sub(r"\1", SDF)
    assert '<pose relative_to="a2">0 0 0 -0.3 0 0</pose>' in after  # follows its joint
    (grip,) = re.findall(r'gripper"><pose>([^<]*)', after)
    assert grip != "1.6 0 0.47 0 0 0"
    (tool,) = re.findall(r'tool0"><pose relative_to="l6">([^<]*)', after)
    assert tool != "0.08 0 0 0 1.5707963267948966 0"


def test_ur_s_calibration_conf_makes_the_controller_s_rows_the_arm(tmp_path):
    """Its classic rows with the deltas added, multiplied out."""
    nominal = load_arm("ur10e")
    new = changed(nominal, slice(1, 6))  # the rows have no place for base and flange
    text = (
        "[mounting]\r\ndelta_theta = [ 9.1e-08, 0, 0, 0, 0, 0]\r\ndelta_a = [ 0, 0, 0, 0, 0, 0]\r\n"
        "delta_d = [0, 0, 0, 0, 0, 0]\r\ndelta_alpha = [ 0, 0, 0, 0, 0, 0] # rad\r\n"
        "joint_checksum = [ 0xb3241580, 0xb10112f1]\r\ncalibration_status = 2 # 2 == Linearised\r\n"
    )
    path = tmp_path / "calibration.conf"
    path.write_bytes(text.encode())
    corrected = correct(path, nominal, new)
    assert "tcp_for_ur_kinematics" in corrected.note
    after = corrected.content.decode()
    assert len(lines_changed(text, after)) == 4
    deltas = {
        key: np.array([float(v) for v in values.split(",")])
        for key, values in re.findall(r"delta_(\w+) = \[([^\]]*)\]", after)
    }
    a = np.array([0, -0.6127, -0.57155, 0, 0, 0]) + deltas["a"]
    d = np.array([0.1807, 0, 0, 0.17415, 0.11985, 0.11655]) + deltas["d"]
    alpha = np.array([np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0]) + deltas["alpha"]
    place = np.broadcast_to(np.eye(4), (len(Q), 4, 4))
    for k in range(6):
        turn, bend = turned("z", (Q[:, k] + deltas["theta"][k])[:, None]), turned("x", alpha[k])
        moved = se3.matrix(np.eye(3), np.array([a[k], 0, d[k]]))
        place = place @ turn @ moved @ bend
    np.testing.assert_allclose(place, poses(new), atol=1e-8)  # d of hundreds of metres cancel
    other = replace(nominal, name="kr10")
    refusal("is for UR arms, the campaign has kr10", correct, path, other, new)


def test_a_matlab_function_builds_the_arm(arm):
    """Its transforms, multiplied out as rigidBodyTree does."""
    text = matlab(changed(arm), "lab_arm", "made")
    assert text.startswith("function robot = lab_arm()\n% made\n")
    fixed = [
        np.array([[float(v) for v in row.split()] for row in rows.split(";")])
        for rows in re.findall(r"setFixedTransform\(joint, \[([^\]]*)\]\)", text)
    ]
    parents = re.findall(r"addBody\(robot, body, '(\w+)'\)", text)
    assert parents == ["base", *(f"link_{k}" for k in range(1, 7))]
    place = np.broadcast_to(np.eye(4), (len(Q), 4, 4))
    for t, angle in zip(fixed, [*Q.T, np.zeros(len(Q))], strict=True):
        place = place @ t @ turned("z", angle[:, None])
    np.testing.assert_allclose(place, poses(changed(arm)), atol=1e-12)


@refusals("own_files")
def test_other_files_are_refused_by_line(case, given, arm, tmp_path):
    path = tmp_path / "mine.xml"
    text = with_edits(given, krl=urdf_of("krl"), rapid=urdf_of("rapid"), MJCF=MJCF, SDF=SDF)
    path.write_text(text)
    tip = "flange" if "mujoco" in text else "tool0"
    base = "base" if "<mujoco" in text or "<sdf" in text else "base_link"
    refuses(case, lambda: correct(path, arm, changed(arm), base, tip), path)
