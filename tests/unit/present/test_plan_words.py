"""What people read of a plan and of `next`: words that follow from numbers; a table."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.design.choice import not_ruled_out
from hilcal.design.next import PairPower
from hilcal.design.summary import CurvePoint, PredictedParameter
from hilcal.present.plan import (
    efficiency_sentence,
    enough_poses_sentence,
    order_remark,
    plan_report,
    power_rows,
    powers_summary,
)
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, Step
from hilcal.tables.write import plan_csv
from tests.support.readings_cases import read_table
from tests.support.viewer_plan import BARE, SUMMARY


@pytest.fixture
def shown(printed):
    return lambda summary=SUMMARY, width=80: printed(*plan_report(summary), width=width)


@pytest.mark.parametrize("width", [80, 110])
def test_everything_is_told_and_fits(shown, width):
    text = shown(width=width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text  # nothing is cut off
    words = " ".join(text.split())
    for phrase in (
        "3 and the reference",
        "10: unloaded 6, 10kg 2, pull x 2",
        "6 min",
        "motion 60 s, readings 90 s, 3 load changes by hand 3 min",
        "efficiency of the plan: at least 98.7 % (certified lower bound); not accuracy",
        "deflection ± 12.0 µm, predicted for the deflection under each load at 100 feasible poses",
        "it is not the accuracy of the robot: geometry, registration, repeatability and effects "
        "outside of the model are not in it",
        "joint_compliance.j2 0.60 6.00 µrad/(N·m) 10.0 %",
        "base_frame.x 12 µm",
        "D (this) 12.0 µm 24.0 µm 3.8 % 132 0.020 4.00 98.7 %",
        "I 9.00 µm 30.0 µm - 66.0 0.010 2.00 -",
        "These readings cannot detect tracker_drift.",
        "note: only 3 candidates are left of load 10kg.",
    ):
        assert phrase in words
    assert text.index("joint_tilt") < text.index("hysteresis  ")  # the best seen comes first


def test_what_is_absent_is_not_told(shown):
    text = shown(BARE)
    assert "made by hand" in text
    assert "0 load changes" in text
    absent = ["efficiency", "certified", "position", "Comparison", "enough", "drift", "nan", "None"]
    assert [word for word in absent if word in text] == []


def test_other_poses_than_asked_for_and_parameters_left_open_are_explained(shown):
    words = " ".join(shown(replace(SUMMARY, asked_poses=24)).split())
    fewer = "3 and the reference: the candidates leave no more of 24; some are read again"
    assert fewer in words
    assert "candidates leave" not in shown(replace(SUMMARY, asked_poses=3))
    lost = PredictedParameter("joint_compliance.j1", np.inf, 4.2e-6, "rad/(N·m)")
    summary = replace(SUMMARY, parameters=(lost,))
    assert "joint_compliance.j1 not determined 4.20 µrad" in " ".join(shown(summary).split())
    assert "accuracy of the robot" in str(summary.to_dict()["position_note"])


def test_a_plan_for_predictions_says_what_a_real_arm_is_mispredicted_by(shown):
    curve = (CurvePoint(3, 12e-6, None, 2.5e-4), CurvePoint(6, 11.5e-6, None, 1e-4))
    of_all = {"all_effects_std_m": 2.5e-4, "random_std_m": 3.2e-4, "efficiency": 0.16}
    summary = replace(SUMMARY, criterion="I", curve=curve, **of_all)
    words = " ".join(shown(summary).split())
    for expected in (
        "deflection ± 250 µm, predicted for",
        "as many random poses: ± 320 µm; if the model were complete: ± 12.0 µm",
        "splits a reading over many poses, which no plan can",
        "More than 6 poses still improve the prediction.",
    ):
        assert expected in words
    assert summary.to_dict()["all_effects_std_m"] == 2.5e-4


@pytest.mark.parametrize(
    ("efficiency", "words"),
    [
        (0.98768, "98.7 %"),
        (0.9999, "99.9 %"),
        (1.0, "100.0 %"),
        (1 + 1e-12, "100.0 %"),
        (0, "not certified"),
    ],
)
def test_a_certificate_is_never_rounded_up(efficiency, words):
    assert words in efficiency_sentence(efficiency)


def test_bars_are_as_long_as_what_they_show_and_the_plan_is_marked(shown):
    lines = [line for line in shown().splitlines() if "█" in line]
    sizes = np.array([line.count("█") for line in lines])
    values = np.array([point.position_std_m for point in SUMMARY.curve])
    np.testing.assert_allclose(sizes / sizes[0], values / values[0], atol=0.02)
    assert ["this plan" in line for line in lines] == [False, True, False]
    falls = "From 3 to 6 poses the prediction's uncertainty falls by 4 % only."
    assert enough_poses_sentence(SUMMARY.curve) == falls
    assert (
        enough_poses_sentence(SUMMARY.curve[:2])
        == "More than 3 poses still improve the prediction."
    )


def test_the_order_is_stated_with_its_cost_and_what_it_saves():
    order = replace(SUMMARY.confounding, drift_std=17e-6 / 3600)
    words = order_remark(replace(SUMMARY, confounding=order))
    for phrase in (
        "3.0 % longer",
        "up to about 2 % of a parameter's information (40 % in the shortest order)",
        "a drift of 18 µm/h shifts deflections by 5.00 µm rms",
        "and less than 0.1 µm on average",
        "determine it to ± 17 µm/h",
    ):
        assert phrase in words
    order = replace(order, bias_m=5e-6, drift_std=None)
    plain = order_remark(replace(SUMMARY, longer=0.0, confounding=order))
    assert plain.startswith("The order is the shortest one. ")
    assert "5.00 µm on average." in plain
    assert "in the shortest order" not in plain
    assert "returns" not in plain


# what `next` says of pairs

A, B = "base_compliance", "link_compliance"
SURE, WEAK = PairPower(A, B, 0.2, 0.9999, False), PairPower(B, A, 0.1, 0.45, False)
NEVER = PairPower(B, A, 0.02, 0.05, True)


@pytest.mark.parametrize(
    ("powers", "words"),
    [
        ((SURE, SURE), "separate the suspects: whichever is present, each of the others is ruled"),
        ((SURE, WEAK), f"the weakest pair is {B}, if it is present, and {A}, which they rule out"),
        ((SURE, NEVER), "separate what can be separated in this cell: each of these pairs"),
        ((NEVER, NEVER), "rule out none of the suspects"),
    ],
)
def test_the_sentence_follows_from_the_table(powers, words):
    said = powers_summary(powers, 12, 40)
    assert said.startswith("40 readings at 12 poses")
    assert words in said
    assert "100 %" not in said
    assert ("more poses raise it" in said) == (WEAK in powers)


def test_no_chance_is_certain_and_none_is_given_where_nothing_would_do():
    assert list(power_rows((SURE, WEAK, NEVER))) == [
        (A, B, "20 %", "> 99 %"),
        (B, A, "10 %", "45 %"),
        (B, A, "2 %", "not in this cell"),
    ]
    assert not_ruled_out([(B, A)]) == (
        f"no measurement in this cell rules out {A} if {B} is present: the best 100 readings would "
        "do so with a probability below 20 %"
    )


# the table

STEPS = (
    Step(REFERENCE, UNLOADED),
    Step("p, 1", UNLOADED),
    Step("p, 1", "mass-5kg"),
    Step("p, 1", UNLOADED, 1),
)
Q = np.array([[0.1, -1.2, 1.4, -0.5, 0.7, 1 / 3], [0.2, -1.1, 1.3, -0.4, 0.6, 0.1]])
PLAN = Plan((REFERENCE, "p, 1"), Q, STEPS)
PULL = np.array([0.0, 0.0, -49.0, 0.0, 0.0, 1.5])


def test_a_plan_as_a_table_has_every_step_in_order():
    lines = plan_csv(PLAN).splitlines()
    assert lines[0] == "x_order,pose,load,cycle,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad"
    assert lines[1] == f"1,reference,none,0,0.1,-1.2,1.4,-0.5,0.7,{1 / 3!r}"
    assert lines[3] == '3,"p, 1",mass-5kg,0,0.2,-1.1,1.3,-0.4,0.6,0.1'
    assert len(lines) == 1 + len(PLAN.steps)


def test_with_positions_it_is_an_exchange_table(tmp_path):
    arm, q = load_arm("ur10e"), np.array([PLAN.joints(s.pose) for s in STEPS])
    head, *rows = plan_csv(PLAN, {"mass-5kg": PULL}).splitlines()
    cov = ",".join(f"cov_{a}" for a in ("x_x", "x_y", "x_z", "y_y", "y_z", "z_z"))
    text = [f"{head},x_m,y_m,z_m,{cov}"]
    for row, p in zip(rows, evaluate(arm, q).point(np.zeros(3)), strict=True):
        text.append(f"{row},{','.join(map(repr, p.tolist()))},1e-10,0,0,1e-10,0,1e-10")
    path = tmp_path / "measured.csv"
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    read = read_table(path, arm, None)
    steps = [
        Step(read.pose_names[p], read.load_names[load], int(c))
        for p, load, c in zip(read.pose, read.load, read.cycle, strict=True)
    ]
    assert tuple(steps) == STEPS
    np.testing.assert_array_equal(read.states.q, q)
    np.testing.assert_array_equal(read.states.wrench[2:4], [PULL, np.zeros(6)])
