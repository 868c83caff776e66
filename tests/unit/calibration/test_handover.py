"""Corrected geometry as others read it, against the model's own kinematics and Pinocchio."""

import re
from dataclasses import replace

import numpy as np
import pytest

from hilcal.calibration.handover import corrected_arm, ur_kinematics
from hilcal.errors import CannotAnswerError
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.chain import Deviation
from tests.support.refusals import refusal, refusal_of
from tests.unit.calibration.other_eyes import flanges, ur_origins
from tests.unit.calibration.test_calibration import calibrated, fresh


@pytest.mark.parametrize("effect", ["link_geometry", "encoder_offset"])
def test_constant_effects_are_in_the_transforms_exactly(effect):
    c = calibrated(effect)
    corrected = corrected_arm(c)
    assert corrected.included == (effect,)
    assert corrected.not_included == ("joint_compliance",)
    states = fresh()
    situation = c.model.predict(states, c.theta).situation
    deviation = Deviation()
    for e, rows in zip(c.model.effects, c.model.slices(), strict=True):
        if e.name == effect:
            deviation = e.deviation(c.theta[rows], situation)
    base, behind = c.frames.chain, c.frames.flange
    expected = base @ flanges(c.model.cell.arm, states.q, deviation) @ behind
    np.testing.assert_allclose(flanges(corrected.arm, states.q), expected, atol=1e-12)
    assert np.abs(expected - flanges(c.model.cell.arm, states.q)).max() > 1e-5


@pytest.mark.parametrize("effect", ["joint_tilt_compliance", "transmission_error"])
def test_what_is_not_constant_is_named_and_left_out(effect):
    c = calibrated(effect)
    corrected = corrected_arm(c)
    assert effect in corrected.not_included
    assert corrected.included == ()
    np.testing.assert_allclose(corrected.arm.links, c.model.cell.arm.links, atol=1e-12)


@pytest.mark.parametrize("name", [n for n in robot_names() if n.startswith("ur")])
def test_the_nominal_arms_have_the_origins_of_ur_description(name):
    arm = load_arm(name)
    text, rest = ur_kinematics(arm, arm)
    np.testing.assert_allclose(rest, np.eye(4), atol=1e-12)
    d = np.linalg.norm(arm.links[:, :3, 3], axis=1)
    # shoulder up, forearm and wrist 1 along −x, wrist 2 along −y, wrist 3 along +y
    first, last = [[0, 0, d[1]], [0, 0, 0], [-d[2], 0, 0]], [[0, -d[5], 0], [0, d[6], 0]]
    expected = [*first, [-d[3], 0, d[4]], *last]
    np.testing.assert_allclose(ur_origins(text)[:, :3, 3], expected, atol=1e-9)
    assert re.search(r"hash: calib_\d+", text)


def test_deflections_and_foreign_arms_are_refused_in_words():
    refusal_of(
        CannotAnswerError, "--readings absolute", corrected_arm, calibrated("none", "deflection")
    )
    arm = load_arm("ur10e")
    foreign = replace(arm, name="kr6")
    refusal("kr6: UR's kinematics file is for UR arms", ur_kinematics, foreign, foreign)
