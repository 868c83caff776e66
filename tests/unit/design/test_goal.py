"""Goals of a campaign: what can be asked for, and when it is met."""

import numpy as np
import pytest

from hilcal.design.goal import parse_goal
from hilcal.errors import InputError
from tests.support.refusals import refusals, refuses

UNITS = {"joint_compliance.j1": "rad/(N·m)", "joint_compliance.j3": "rad/(N·m)"}
VALUES = {"joint_compliance.j1": 2e-5, "joint_compliance.j3": -1e-5, "base_frame.x": 0.0}
STDS = {"joint_compliance.j1": 3e-7, "joint_compliance.j3": 2.5e-7, "base_frame.x": 1e-5}


@pytest.mark.parametrize(
    ("text", "met", "ratio", "worst"),
    [
        ("joint std < 2 %", False, 1.25, "joint_compliance.j3"),
        ("joint std<3%", True, 2.5 / 3, "joint_compliance.j3"),
        ("j1 std < 2 %", True, 0.75, "joint_compliance.j1"),
        ("joint_compliance.j3 std < 1e-7 rad/(N·m)", False, 2.5, "joint_compliance.j3"),
        ("j3 std <= 5e-7 rad/Nm", True, 0.5, "joint_compliance.j3"),
        ("joint_compliance std ≤ 6e-7 rad/(N*m)", True, 0.5, "joint_compliance.j1"),
        ("base_frame.x std < 20 um", True, 0.5, "base_frame.x"),
        ("base_frame std < 0.005 mm", False, 2.0, "base_frame.x"),
        ("base_frame std < 1 %", False, np.inf, "base_frame.x"),
        ("position std < 20 um", True, 0.6, "position"),
        ("position std < 0.01 mm", False, 1.2, "position"),
    ],
)
def test_a_goal_is_met_by_the_worst_of_it(text, met, ratio, worst):
    v = parse_goal(text).status(STDS, VALUES, 12e-6)
    assert (v.met, v.worst) == (met, worst)
    assert v.ratio == pytest.approx(ratio)


@pytest.mark.parametrize("bad", [np.inf, np.nan])
def test_what_is_not_identifiable_never_meets_a_goal(bad):
    for text in ("joint std < 90 %", "joint std < 1 rad/(N·m)"):
        v = parse_goal(text).status({**STDS, "joint_compliance.j1": bad}, VALUES)
        assert not v.met
        assert v.worst == "joint_compliance.j1"
    assert not parse_goal("position std < 1 m").status(STDS, VALUES, bad).met


@refusals("goals")
def test_a_goal_that_cannot_be_read_names_the_valid_forms(case, given):
    assert '"joint std < 2 %"' in refuses(case, lambda: parse_goal(given[:-1]))


def test_a_goal_must_fit_the_model():
    parse_goal("j1 std < 1e-7 rad/(N*m)").check(UNITS)
    parse_goal("joint std < 1 %").check(UNITS)
    parse_goal("position std < 1 mm").check(UNITS)
    with pytest.raises(InputError, match=r"joint_compliance.j1 is in rad/\(N·m\)"):
        parse_goal("j1 std < 1 mm").check(UNITS)
    with pytest.raises(InputError, match="j9 is not in the model; valid: position, joint_comp"):
        parse_goal("j9 std < 1 %").check(UNITS)
    with pytest.raises(InputError, match="work_q_rad"):
        parse_goal("position std < 1 mm").status(STDS, VALUES)
