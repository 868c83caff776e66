"""One base: what is asked for in the axes of any export is where the tracker finds the tool."""

import json
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.dh_table import dh_rows, to_toml
from hilcal.calibration.handover import corrected_arm, frames, ur_kinematics, urdf
from hilcal.calibration.robot_files.descriptions import correct_file
from hilcal.identification.fit_document import frames_to_json
from hilcal.robot import se3
from hilcal.robot.catalogue import load_arm
from tests.support.campaigns import campaign, measured, plan
from tests.support.fit_cases import fitted_model
from tests.unit.calibration.other_eyes import by_pinocchio, by_ur, flanges, urdf_model

POSES = 24
CASES = list(product(("none", "link_geometry"), (False, True), (True, False)))
"""Effect, whether the place of the base is known, whether the target is."""
OTHER = se3.matrix(se3.rotation(np.array([0.2, 0.0, -0.4])), np.array([0.0, 0.1, 0.2]))


@cache
def site(effect, registration, target):
    return campaign(
        effect, poses=POSES, strength=30.0, registration_known=registration, target_known=target
    )


@cache
def fitted(effect, registration, target):
    c = site(effect, registration, target)
    names = ["joint_compliance", *([] if effect == "none" else [effect])]
    result = fitted_model(c.cell, c.readings, "absolute", names)
    return Calibration.of(result, {"campaign": "made"})


def document(c):
    rest = ur_kinematics(c.model.cell.arm, corrected_arm(c).arm)[1]
    return dict(json.loads(frames(c, corrected_arm(c), rest)))


def pose(six):
    return se3.of_six(np.array(six, dtype=float).tolist())


def fresh(load):
    p = plan(40, 5000)
    return p.states[np.flatnonzero(p.load == load)]


def true_positions(world, states, base):
    """(N, 3) where the tracker, without its noise, has the target, in axes of the base."""
    return np.asarray((world.ideal_readings(states).value(3) - base[:3, 3]) @ base[:3, :3])


@pytest.mark.parametrize(("effect", "registration", "target"), CASES)
def test_a_request_is_where_the_tracker_finds_the_tool(effect, registration, target):
    """Request, corrected joints, tracker, request; and with another tool."""
    c, world = fitted(effect, registration, target), site(effect, registration, target).world
    states, content = fresh(1), document(c)
    at_flange = flanges(c.model.cell.arm, states.q)
    for key in ("base_in_tracker", "controller"):
        base = content[key]["base_in_tracker_m_rad"] if key == "controller" else content[key]
        asked = at_flange @ pose(content["tool_on_flange"])
        k = c.compensate(states.q, states.wrench, wanted=asked)
        off = true_positions(world, replace(states, q=k.q), pose(base)) - asked[:, :3, 3]
        good = k.usable
        assert good.mean() > 0.6
        within = np.linalg.norm(off, axis=1) <= k.after.band_m
        assert within[good].mean() > 0.9
        assert np.linalg.norm(off[good].mean(axis=0)) < 2e-5
    # Another tool: the world's flange carries it in the place of the target.
    bare = replace(world.physics, target_offset=np.zeros(3))
    cell = replace(world.cell, target=OTHER)
    other = replace(world, cell=cell, physics=bare, offsets=None)
    k = c.compensate(states.q, states.wrench, wanted=at_flange @ OTHER, tool=OTHER)
    off = (
        true_positions(other, replace(states, q=k.q), c.base_in_tracker())
        - (at_flange @ OTHER)[:, :3, 3]
    )
    good = k.inverse.solved & ~k.singular
    assert np.mean(np.linalg.norm(off, axis=1)[good] <= k.after.band_m[good]) > 0.9


@pytest.mark.parametrize("target", [True, False])
def test_the_base_is_the_worlds_where_no_geometry_is_wrong(target):
    """The nominal arm fits best elsewhere, since it sags: by a millimetre here."""
    c, world = fitted("none", False, target), site("none", False, target).world
    content = document(c)
    true = world.registration
    assert np.linalg.norm((c.model.cell.registration - true)[:3, 3]) > 0.5e-3
    for base in (content["base_in_tracker"], content["controller"]["base_in_tracker_m_rad"]):
        np.testing.assert_allclose(pose(base), true, atol=2e-5)
    np.testing.assert_allclose(
        pose(content["controller"]["tracker_in_base_m_rad"]), se3.inverse(true), atol=2e-5
    )
    assert content["base_is"] == "mechanical"
    assert corrected_arm(c).included == ()
    np.testing.assert_allclose(corrected_arm(c).arm.links, c.model.cell.arm.links, atol=1e-12)


def test_a_stated_base_is_the_base():
    c = fitted("link_geometry", True, True)
    content = document(c)
    np.testing.assert_allclose(
        pose(content["base_in_tracker"]), c.model.cell.registration, atol=1e-9
    )
    assert content["base_is"] == "stated"
    first = corrected_arm(c).arm.links[0]
    assert np.abs(first - c.model.cell.arm.links[0]).max() > 1e-5  # joint 1 is elsewhere on it


@pytest.mark.parametrize(("registration", "target"), [(r, t) for _, r, t in CASES[4:]])
def test_every_export_puts_the_tool_where_the_tracker_finds_it(registration, target, tmp_path):
    """An arm that does not yield: constant transforms are all of it."""
    c = site("link_geometry", registration, target)
    stiff = replace(c.world.physics, joint_compliance=0 * c.world.physics.joint_compliance)
    world = replace(c.world, physics=stiff)
    readings = measured(world, plan(POSES, 1000), np.random.default_rng(0))
    result = fitted_model(c.cell, readings, "absolute", ["link_geometry"])
    cal = Calibration.of(result, {"campaign": "made"})
    content, states = document(cal), fresh(0)
    base, tool = pose(content["base_in_tracker"]), pose(content["tool_on_flange"])
    wanted = true_positions(world, states, base)
    band = cal.predict(states.q).band_m
    arm = corrected_arm(cal).arm
    (tmp_path / "a.toml").write_text(to_toml(dh_rows(arm), arm, "made"), encoding="utf-8")
    text, _ = ur_kinematics(cal.model.cell.arm, arm)
    exported = {
        "URDF": by_pinocchio(urdf_model(urdf(arm)), states.q) @ tool,
        "DH": flanges(load_arm(str(tmp_path / "a.toml")), states.q) @ tool,
        "UR yaml": by_ur(text, states.q) @ pose(content["tcp_for_ur_kinematics"]),
    }
    nominal_urdf, nominal = tmp_path / "own.urdf", cal.model.cell.arm
    nominal_urdf.write_text(urdf(nominal), encoding="utf-8")
    into = correct_file(nominal_urdf, nominal, corrected_arm(cal)).content.decode()
    exported["into a URDF"] = by_pinocchio(urdf_model(into), states.q) @ tool
    for name, poses in exported.items():
        off = np.linalg.norm(poses[:, :3, 3] - wanted, axis=1)
        assert np.mean(off <= band) > 0.9, name
    fitted_frames = frames_to_json(result)["base"]
    np.testing.assert_allclose(fitted_frames["xyz_m"], base[:3, 3], atol=1e-9)
