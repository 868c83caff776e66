"""Corrected geometry as others read it, against the model's own kinematics and Pinocchio."""

import json
import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from hilcal.calibration.corrected import corrected
from hilcal.calibration.handover import UR_JOINTS, frames, ur_kinematics, urdf
from hilcal.errors import CannotAnswerError, InputError
from hilcal.robot import se3
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.chain import evaluate
from hilcal.robot.deviation import Deviation
from hilcal.robot.urdf import arm_from_urdf
from hilcal.types import Floats
from tests.unit.calibration.test_calibration import calibrated, fresh

Q = np.random.default_rng(3).uniform(-3, 3, (20, 6))


def flanges(arm, q: Floats, deviation: Deviation | None = None) -> Floats:
    chain = evaluate(arm, q, deviation)
    return se3.matrix(chain.rotation[-1], chain.position[-1])


@pytest.mark.parametrize("effect", ["link_geometry", "encoder_offset"])
def test_constant_effects_are_in_the_transforms_exactly(effect: str) -> None:
    c = calibrated(effect)
    found = corrected(c)
    assert found.within == (effect,)
    assert found.beyond == ("joint_compliance",)
    states = fresh()
    situation = c.model.predict(states, c.theta).situation
    deviation = Deviation()
    for e, mine in zip(c.model.effects, c.model.slices(), strict=True):
        if e.name == effect:
            deviation = e.deviation(c.theta[mine], situation)
    base, behind = c.frames.chain, c.frames.flange
    expected = base @ flanges(c.model.cell.arm, states.q, deviation) @ behind
    np.testing.assert_allclose(flanges(found.arm, states.q), expected, atol=1e-12)
    assert np.abs(expected - flanges(c.model.cell.arm, states.q)).max() > 1e-5


@pytest.mark.parametrize("effect", ["joint_tilt_compliance", "transmission_error"])
def test_what_is_not_constant_is_named_and_left_out(effect: str) -> None:
    c = calibrated(effect)
    found = corrected(c)
    assert effect in found.beyond
    assert found.within == ()
    np.testing.assert_allclose(found.arm.links, c.model.cell.arm.links, atol=1e-12)


def test_pinocchio_reads_the_same_kinematics_from_the_urdf(tmp_path: Path) -> None:
    arm = corrected(calibrated("link_geometry")).arm
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(arm, "made -- by a test"))
    model = pin.buildModelFromUrdf(str(path))
    data, frame = model.createData(), model.getFrameId("tool0")
    for q, expected in zip(Q, flanges(arm, Q), strict=True):
        pin.framesForwardKinematics(model, data, q)
        np.testing.assert_allclose(data.oMf[frame].homogeneous, expected, atol=1e-9)
    again = arm_from_urdf(path)
    np.testing.assert_allclose(flanges(again, Q), flanges(arm, Q), atol=1e-12)
    np.testing.assert_allclose(again.masses, arm.masses)
    np.testing.assert_allclose((again.q_min, again.q_max), (arm.q_min, arm.q_max))
    np.testing.assert_allclose(again.torque_max, arm.torque_max)
    assert again.joint_names == arm.joint_names


def kinematics(text: str) -> Floats:
    """Origins (6, 4, 4) of UR's file, by its own words."""
    out = []
    for name in UR_JOINTS:
        block = text.split(f"  {name}:\n")[1]
        six = [float(re.search(rf" {key}: (\S+)", block)[1]) for key in ("x", "y", "z")]
        rpy = [float(re.search(rf" {key}: (\S+)", block)[1]) for key in ("roll", "pitch", "yaw")]
        out.append(se3.matrix(Rotation.from_euler("xyz", rpy).as_matrix(), np.array(six)))
    return np.stack(out)


@pytest.mark.parametrize("name", robot_names())
def test_the_nominal_arms_have_the_origins_of_ur_description(name: str) -> None:
    arm = load_arm(name)
    text, rest = ur_kinematics(arm, arm)
    origins = kinematics(text)
    np.testing.assert_allclose(rest, np.eye(4), atol=1e-12)
    d = [np.linalg.norm(arm.links[k][:3, 3]) for k in range(7)]
    # shoulder up, forearm and wrist 1 along −x, wrist 2 along −y, wrist 3 along +y
    np.testing.assert_allclose(origins[0][:3, 3], [0, 0, d[1]], atol=1e-9)
    np.testing.assert_allclose(origins[1][:3, 3], 0, atol=1e-9)
    np.testing.assert_allclose(origins[2][:3, 3], [-d[2], 0, 0], atol=1e-9)
    np.testing.assert_allclose(origins[3][:3, 3], [-d[3], 0, d[4]], atol=1e-9)
    np.testing.assert_allclose(origins[4][:3, 3], [0, -d[5], 0], atol=1e-9)
    np.testing.assert_allclose(origins[5][:3, 3], [0, d[6], 0], atol=1e-9)
    assert re.search(r"hash: calib_\d+", text)


def test_ur_kinematics_and_its_tool_put_the_tool_where_the_arm_has_it() -> None:
    c = calibrated("link_geometry")
    found = corrected(c)
    text, rest = ur_kinematics(c.model.cell.arm, found.arm)
    six = np.array(json.loads(frames(c, found, rest))["tcp_for_ur_kinematics"])
    tcp = se3.matrix(se3.rotation(six[3:]), six[:3])
    for q, flange in zip(Q, flanges(found.arm, Q), strict=True):
        place = np.eye(4)
        for origin, angle in zip(kinematics(text), q, strict=True):
            turn = Rotation.from_euler("z", angle).as_matrix()
            place = place @ origin @ se3.matrix(turn, np.zeros(3))
        np.testing.assert_allclose(place @ tcp, flange @ c.tool_pose(), atol=1e-9)


def test_the_base_is_where_the_tracker_saw_it() -> None:
    c, states = calibrated("none"), fresh()
    base = c.base_in_tracker()
    p = c.predict(states.q, states.wrench, std=False)
    read = c.model.predict(states, c.theta).observation.position
    np.testing.assert_allclose(p.position @ base[:3, :3].T + base[:3, 3], read, atol=1e-12)


def test_deflections_and_foreign_arms_are_refused_in_words() -> None:
    with pytest.raises(CannotAnswerError, match="--readings absolute"):
        corrected(calibrated("none", "deflection"))
    arm = load_arm("ur10e")
    foreign = type(arm)(**{**{k: getattr(arm, k) for k in arm.__slots__}, "name": "kr6"})
    with pytest.raises(InputError, match="kr6: UR's kinematics file is for UR arms"):
        ur_kinematics(foreign, foreign)
