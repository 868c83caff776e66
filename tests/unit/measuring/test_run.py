"""A campaign is measured: readings, loads, torques."""

import io
import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from rich.console import Console

from hilcal.campaign.campaign import Campaign
from hilcal.config import CellLoad, ForceSensor, Repeatability, Tool
from hilcal.errors import CannotAnswerError, DeviceError, InputError
from hilcal.identification.torques import check_torques, require_torques
from hilcal.measuring.progress import LiveResidual, Phase, ReadingStored
from hilcal.measuring.session_state import UnloadedVisit, repeatability
from hilcal.present.progress import CampaignProgress
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.rows import content_hash
from hilcal.store.run_log import (
    RunLog,
    changed_since_begun,
    check_same_arm,
    check_same_cell,
    create_run,
)
from hilcal.tables.table import import_table, write_table
from tests.support.fake_bench import (
    FEW_POSES,
    POSES,
    REGISTRATION,
    SAG,
    STD,
    TORQUE,
    Bench,
    call_before,
    change_result,
    plan_of,
    rows,
    usual_plan,
)
from tests.support.readings_cases import read_table
from tests.support.refusals import refusal_of


@pytest.fixture(scope="module")
def ran():
    """A usual campaign at its end, to look at."""
    b = Bench()
    b.measure(usual_plan())
    return b


def test_readings_are_what_the_world_is(ran):
    b, plan, readings = ran, usual_plan(), ran.store.readings()
    assert [s for s, _, _ in b.store.rows] == list(plan.steps)
    q = np.array([plan.joints(s.pose) for s in plan.steps])
    assert np.array_equal(readings.states.q, q)
    chain = chains.evaluate(b.cell.arm, q)
    held = chain.point(b.cell.target[:3, 3]) + SAG * readings.states.wrench[:, :3]
    in_tracker = held @ REGISTRATION[:3, :3].T + REGISTRATION[:3, 3]
    white = (readings.value - in_tracker) / np.sqrt(STD**2 / 3)
    assert 0.4 < np.mean(white**2) < 1.8  # 45 numbers of unit variance
    ratio = np.sqrt(np.diagonal(readings.covariance, axis1=1, axis2=2)) / STD * np.sqrt(3)
    assert np.all(ratio > 0.8)
    assert np.all(ratio < 1.3)


@pytest.mark.parametrize(
    ("use", "mass", "pull"), [("all", 3.03, 38.0), ("verify", 3.0, 40.0), ("pulls", 3.0, 38.0)]
)
def test_wrench_is_measured_or_told_as_the_cell_says(use, mass, pull):
    """The rope pulls 5 % less than asked for, and the weight is 1 % too heavy."""
    b = Bench(force_sensor=ForceSensor(driver="fake", port="nowhere", use=use))
    loads = (CellLoad(name="3kg", mass_kg=3.03), CellLoad(name="pull", force_N=(38.0, 0.0, 0.0)))
    b.world.config = b.config.model_copy(update={"loads": loads})
    readings = b.measure()
    weight = [0, 0, -mass * 9.80665, 0, 0, 0]
    for load, wrench in (("none", np.zeros(6)), ("3kg", weight), ("pull", [pull, 0, 0, 0, 0, 0])):
        felt = readings.states.wrench[rows(readings, load)]
        assert np.allclose(felt, wrench, atol=1e-6 if use in ("all", "pulls") else 0.0)


def test_wrench_is_that_at_the_load_point_wherever_the_sensor_sits(b):
    """A sensor that is off and turned, and a tool that is not the configured one."""
    b.world.tool_mass = 0.75
    turned = (0.3, -0.2, 0.9)
    origin = (0.01, -0.02, 0.04)
    settings = ForceSensor(
        driver="fake", port="nowhere", use="all", origin_m=origin, rotvec_rad=turned
    )
    b.config = b.config.model_copy(update={"force_sensor": settings})

    def at_the_sensor(flange):
        f, m = np.split(flange - b.world.offset, 2)
        m = m - np.cross(np.array(origin), f)
        axes = se3.rotation(np.array(turned))
        return np.concatenate([axes.T @ f, axes.T @ m]) + b.world.offset

    change_result(b.world, "wrench", at_the_sensor)
    readings = b.measure(usual_plan())
    for name, force in (("3kg", [0, 0, -3.0 * 9.80665]), ("pull", [40.0, 0, 0])):
        assert np.allclose(
            readings.states.wrench[rows(readings, name)], [*force, 0, 0, 0], atol=1e-6
        )


def test_approach_sides_are_those_of_the_motions(ran):
    b, readings = ran, ran.store.readings()
    side = np.zeros(6)
    expected = {}
    q = np.array([0.1, -1.3, 1.6, -1.4, -1.4, 0.1])
    for goal, load in b.world.at_start:
        side = np.where(goal == q, side, np.sign(goal - q))
        q = goal
        expected[tuple(goal), load] = side
    assert np.all(np.abs(readings.states.approach) == 1)
    for k in range(len(readings)):
        pose = POSES[readings.pose_names[readings.pose[k]]]
        load = readings.load_names[readings.load[k]]
        if readings.pose_names[readings.pose[k]] != "reference":  # come to under several loads
            assert np.array_equal(readings.states.approach[k], expected[pose, load])


def test_times_and_temperatures(ran):
    readings = ran.store.readings()
    s = readings.states
    assert np.all(np.diff(s.time) > 0)
    assert np.all(s.load_time > 0)
    assert np.all(s.load_time <= s.time)
    for load in ("3kg", "pull"):  # counts from the change of the load
        of_load = rows(readings, load)
        assert np.allclose(np.diff(s.load_time[of_load]), np.diff(s.time[of_load]))
        assert s.load_time[of_load][0] < 20.0
    assert np.allclose(s.joint_temperature, 30.0)
    assert np.allclose(s.q_actual, s.q)


def test_nothing_moves_between_measuring_and_storing(ran):
    b = ran
    calls = b.world.calls
    stored = [k for k, name in enumerate(calls) if name == "store.record"]
    assert len(stored) == len(b.store.rows) > 1
    for a, z in pairwise([0, *stored]):
        last = max(k for k in range(a, z) if calls[k] == "tracker.measure")
        assert "arm.start_move" not in calls[last:z]


def test_progress(ran):
    """What is as configured is not remarked."""
    b, plan = ran, usual_plan()
    drifts = [content for kind, content in b.store.events if kind == "drift"]
    assert [d["over"] for d in drifts] == [False, False]
    assert not b.remarks("has moved")
    assert not b.remarks("[tool]")
    stored = b.notes.of_kind(ReadingStored)
    assert [t.stored for t in stored] == list(range(1, len(plan.steps) + 1))
    assert {t.total for t in stored} == {len(plan.steps)}
    assert stored[-1].remaining_s == 0.0
    for t in stored:
        if t.step.load == "none":
            assert t.deflection is None
        else:
            force = 3.0 * 9.80665 if t.step.load == "3kg" else 40.0
            assert t.deflection == pytest.approx(SAG * force, abs=6 * STD)
    tenth = json.loads(b.store.rows[9][2])["tracker"][-1]["host_ns"] * 1e-9
    assert stored[9].remaining_s == pytest.approx(b.world.time - tenth, rel=0.5)


def test_the_judge_sees_all_readings_and_may_not_know(b):
    judged = []

    def judge(readings):
        judged.append(len(readings))
        if len(readings) == 2:
            raise CannotAnswerError("too few readings")
        if len(readings) == 3:  # of linear algebra, which knows no campaign
            raise np.linalg.LinAlgError("SVD did not converge")
        return LiveResidual(1e-5, 0.5) if len(readings) > 3 else LiveResidual()

    b.measure(live=judge)
    assert judged == list(range(1, len(FEW_POSES.steps) + 1))
    stored = b.notes.of_kind(ReadingStored)
    assert [t.live.residual for t in stored[:4]] == [None, None, None, 1e-5]
    assert stored[-1].live.sigma == 0.5


def test_a_campaign_that_goes_on_shows_from_the_start_what_is_stored():
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    with CampaignProgress(console, 26, stored=10):
        pass
    assert "10/26" in console.file.getvalue()


def test_drift_of_the_reference_pose_is_told(b):
    def shift(*_):
        if len(b.store.rows) == 4:
            b.world.shift = np.array([0.0, 0.0, 4e-4])

    call_before(b.store, "record", shift)
    b.measure()
    drifts = [content for kind, content in b.store.events if kind == "drift"]
    assert [d["over"] for d in drifts] == [True, True]
    said = b.remarks("reference pose has moved")
    assert len(said) == 2
    assert any(word in said[0] for word in ("by 39", "by 40", "by 41"))


@pytest.mark.long
def test_repeatability_is_estimated_at_the_end():
    """The joints miss by 5e-5 rad from arrival to arrival; the estimate finds that."""
    b = Bench(repeatability=Repeatability(joint_std_rad=5e-5))
    arrived = {}
    rng = np.random.default_rng(3)

    def position():
        key = len(b.world.at_start)
        slip = arrived.setdefault(key, 5e-5 * rng.standard_normal(6))
        q = b.world.joints() + slip
        chain = chains.evaluate(b.cell.arm, q[None])
        at = chain.point(b.cell.target[:3, 3])[0] + SAG * b.world.pull()[:3]
        return REGISTRATION[:3, :3] @ at + REGISTRATION[:3, 3]

    b.world.position = position
    plan = plan_of(*((p, "none", c) for c in range(12) for p in ("p1", "p2", "p3")))
    b.measure(plan)
    repeatable = b.store.last("repeatability")
    assert repeatable["poses"] == 3
    assert repeatable["dof"] == 33
    assert repeatable["joint_std"] == pytest.approx(5e-5, rel=0.35)
    assert repeatable["scatter"] > 3 * repeatable["instrument"]
    (said,) = b.remarks("33 returns to 3 poses")
    assert f"joint_std_rad is about {repeatable['joint_std']:.1g}" in said


def test_repeatability_law():
    """Unbiased: over many sets of visits the mean of its square is the truth."""
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(400):
        visits = []
        for pose in "ab":
            gain = {"a": 2.0, "b": 0.5}[pose]
            for _ in range(4):
                position = rng.normal(0.0, np.sqrt((1.0 + 4.0 * gain) / 3.0), 3)
                visits.append(UnloadedVisit(pose, position, np.eye(3) / 3.0, gain))
        repeatable = repeatability(visits)
        squares.append(repeatable.joint_std**2)
    assert np.mean(squares) == pytest.approx(4.0, rel=0.1)
    assert repeatability([UnloadedVisit("a", np.zeros(3), np.eye(3), 1.0)]) is None


def test_an_arm_that_does_not_scatter_is_seldom_said_to():
    rng, said = np.random.default_rng(1), 0
    for _ in range(200):
        at = rng.normal(0.0, 1e-5, (8, 3))
        repeatable = repeatability([UnloadedVisit("ab"[k % 2], x, 1e-10 * np.eye(3), 1.0)
                               for k, x in enumerate(at)])  # fmt: skip
        said += "joint_std_rad is about" in repeatable.sentence(np.zeros(6))
    assert said < 12


def test_without_a_tool_and_without_a_force_sensor():
    b = Bench(tool=Tool(target_m=(0.0, 0.0, 0.1)))
    b.world.tool_mass = 0.0
    b.measure()
    assert b.world.payload[0] == 0.0
    b = Bench(force_sensor=None)
    b.world.wrong_loads = ["none", "6kg"]
    readings = b.measure()
    assert len(readings) == len(FEW_POSES.steps)
    assert np.allclose(readings.states.wrench[rows(readings, "pull")], [40.0, 0, 0, 0, 0, 0])
    assert json.loads(b.store.rows[0][2])["force"] is None


def test_a_wrong_load_is_asked_for_again_with_the_reason(b):
    b.world.wrong_loads = ["none", "6kg"]  # the first answer is that to "take everything off"
    readings = b.measure()
    assert len(readings) == len(FEW_POSES.steps)
    assert b.requested_loads[:3] == ["none", "3kg", "3kg"]
    assert b.operator.requests[1][1] == ""
    assert "6.0 kg" in b.operator.requests[2][1]
    assert b.remarks("asked to hang 3kg")


def test_a_load_that_is_not_taken_off_is_noticed(b):
    b.world.wrong_loads = ["none", "3kg", "3kg"]
    b.measure()
    assert b.requested_loads == ["none", "3kg", "none", "none", "pull", "none"]
    assert "3.0 kg still hangs" in b.operator.requests[3][1]


@pytest.mark.long
def test_a_swinging_load_is_weighed_twice(b):
    times = []

    def swinging(seconds):
        times.append(b.world.time)
        b.world.extra = np.zeros(6)
        if b.world.load == "3kg" and len(b.operator.requests) == 2 and len(b.store.rows) == 5:
            swings = len([t for t in times if t > b.world.time - 10.0]) == 1
            b.world.extra[0] = 8.0 if swings else 0.0

    call_before(b.rig.force, "average", swinging)
    b.measure(usual_plan())
    assert b.requested_loads == ["none", "3kg", "none", "pull", "none"]


def test_the_tool_is_identified_and_compared_with_the_configuration(b):
    b.world.tool_mass = 1.4
    b.measure(usual_plan())
    assert b.store.kinds().index("tool") < b.store.kinds().index("load")
    tool = b.store.last("tool")
    assert tool["mass_kg"] == pytest.approx(1.4, abs=1e-6)
    assert tool["com_m"] == pytest.approx([0.01, 0.0, 0.06], abs=1e-6)
    assert b.remarks("[tool] says 0.8 kg")


def test_unloaded_poses_that_do_not_tell_the_tool_are_no_failure(b):
    """Turned about the vertical only: gravity never turns in the sensor."""
    poses = {f"p{k}": (0.2 * k, *POSES["reference"][1:]) for k in range(4)}
    plan = plan_of(
        *((p, load, 0) for load in ("none", "3kg") for p in poses),
        poses={"reference": POSES["reference"], **poses},
    )
    assert len(b.measure(plan)) == 8
    assert b.remarks("not identified")


def test_resume_measures_exactly_what_is_missing_and_time_goes_on(b):
    plan = FEW_POSES
    day = [1000.0]

    def wall():
        return day[0] + b.world.time

    b.interrupt(4, plan, wall=wall)
    done = len(b.store.rows)
    assert 3 < done < len(plan.steps)
    day[0] += 7200.0  # two hours later
    loads = len(b.operator.requests)
    readings = b.measure(plan, wall=wall)
    assert [s for s, _, _ in b.store.rows] == list(plan.steps)
    gaps = np.diff(readings.states.time)
    assert 7200.0 < gaps[done - 1] < 7200.0 + 120.0
    assert np.all(np.delete(gaps, done - 1) < 60.0)
    asked = b.requested_loads[loads:]
    assert asked[0] == "none"  # nobody knows what hangs
    assert asked[1] == plan.steps[done].load == "3kg"


@pytest.mark.long
@pytest.mark.parametrize("step_s", [7200.0, -7200.0], ids=["forward", "back"])
def test_a_clock_that_is_set_during_a_session_makes_no_pause_and_hides_none(b, step_s):
    def wall():
        return 90000.0 + b.world.time + step_s * (len(b.store.rows) > 3)

    b.interrupt(7, wall=wall)
    done = len(b.store.rows)
    b.world.time += 600.0
    gaps = np.diff(b.measure(wall=wall).states.time)
    assert 600.0 < gaps[done - 1] < 600.0 + 120.0
    assert not b.remarks("clock")


def test_a_clock_that_is_set_back_between_sessions_is_said_and_time_goes_on(b):
    b.interrupt(4, wall=lambda: 5000.0 + b.world.time)
    readings = b.measure(wall=lambda: 1000.0 + b.world.time)
    assert np.all(np.diff(readings.states.time) > 0)
    assert b.remarks("it was set back; the pause since that reading is not known")


def test_a_clock_set_back_since_the_epoch_makes_no_time_before_it(b):
    plan = plan_of(("reference", "none", 0), ("p1", "none", 0))
    readings = b.measure(plan, wall=lambda: 1000.0 + b.world.time, epoch=5000.0)
    assert np.all(readings.states.time > 0)


@pytest.mark.long
def test_a_load_that_still_hangs_at_a_resume_is_noticed(b):
    b.interrupt(7, usual_plan())
    assert b.world.load == "3kg"
    b.world.wrong_loads = ["3kg"]  # the first answer is wrong
    # the sensor was off meanwhile
    b.world.offset = b.world.offset + np.array([2.0, 2.0, -2.0, 0, 0, 0])
    asked_before = len(b.operator.requests)
    b.measure(usual_plan())
    asked = b.operator.requests[asked_before:]
    assert [name for name, _ in asked[:3]] == ["none", "none", "3kg"]
    assert "than in the unloaded readings so far; 3kg still seems to hang" in asked[1][1]
    assert [s for s, _, _ in b.store.rows] == list(usual_plan().steps)


def test_a_load_left_on_at_the_very_beginning_is_asked_about_said_and_found_in_motion():
    b = Bench()
    loads = (CellLoad(name="1kg", mass_kg=1.0), *b.config.loads)
    b.world.config = b.config = b.config.model_copy(update={"loads": loads})
    b.world.load, b.world.wrong_loads = "3kg", ["3kg", "3kg"]  # both answers are wrong
    refusal_of(DeviceError, "take everything off", b.measure)
    assert [name for name, _ in b.operator.requests[:3]] == ["none", "none", "confirm"]
    assert b.remarks("as if 3kg hung, and the answer was twice that nothing hangs")
    assert b.store.rows == []


def test_a_sensor_whose_zero_looks_like_a_load_is_believed_after_a_turn():
    b = Bench()
    rotation = chains.evaluate(b.cell.arm, b.world.q[None]).rotation[-1][0]
    b.world.offset[:3] += 3.0 * rotation.T @ b.cell.gravity
    b.measure(FEW_POSES)
    assert [name for name, _ in b.operator.requests[:4]] == ["none", "none", "confirm", "3kg"]
    assert [step for step, *_ in b.store.rows] == list(FEW_POSES.steps)


def test_a_load_that_a_plan_leaves_on_the_arm_is_said_at_its_end(b):
    b.measure(plan_of(("p1", "none", 0), ("p1", "3kg", 0)))
    assert b.remarks("3kg still hangs on the arm: take it off")


def test_a_finished_campaign_touches_nothing(b):
    b.measure()
    b.world.calls.clear()
    b.measure()
    assert b.world.calls == []
    assert b.notes.of_kind(Phase)[-1].text == "nothing is missing"


@pytest.mark.long
def test_the_tool_is_known_from_an_earlier_session_after_the_sensor_was_off(b):
    """Another bias in the second session: the pulls are measured right nevertheless."""
    b.world.tool_mass = 1.4
    b.interrupt(7, usual_plan())
    b.world.offset = -b.world.offset
    readings = b.measure(usual_plan())
    felt = readings.states.wrench[rows(readings, "pull")]
    assert np.allclose(felt, [40.0, 0, 0, 0, 0, 0], atol=1e-6)


LOST = "no longer reports the torques"


def test_torques_are_averaged_over_the_reading(b):
    b.world.torques = np.inf
    torque = b.measure().states.torque
    # means of at least three samples that scatter by 0.1 N·m
    assert np.abs(torque - TORQUE).max() < 5 * 0.1 / np.sqrt(3)
    assert not b.remarks(LOST)
    assert b.store.details()[0]["torque"] == torque[0].tolist()


def test_a_lost_link_is_said_once_and_readings_go_on(b, tmp_path):
    b.world.torques = 60
    readings = b.measure()
    torque = readings.states.torque
    lost = np.isnan(torque).all(axis=1)
    assert np.array_equal(lost, np.isnan(torque).any(axis=1))
    assert 0 < lost.argmax() < len(lost)
    assert lost[lost.argmax() :].all()
    assert len(b.remarks(LOST)) == 1
    with CampaignFile.create(tmp_path / "r.hilcal", "{}", ".", "test") as file:
        file.append_readings(readings[:1])
        file.append_readings(readings[1:])
        assert content_hash(file.readings()) == content_hash(readings)
        half = np.array(torque)
        half[0, 2] = np.nan
        with pytest.raises(InputError, match="torque of reading 1 is not finite"):
            file.append_readings(replace(readings, states=replace(readings.states, torque=half)))
    write_table(readings, tmp_path / "t.csv")
    write_table(readings, tmp_path / "t.parquet")
    for name in ("t.csv", "t.parquet"):
        back = read_table(tmp_path / name, b.cell.arm, None)
        assert content_hash(back) == content_hash(readings)
    text = (tmp_path / "t.csv").read_text().replace(repr(float(torque[0, 2])), "")
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=r"row 2, column 'tau3_Nm': no value; give all torques"):
        read_table(tmp_path / "t.csv", b.cell.arm, None)
    measured = replace(b.cell, measured_torques=True)
    with pytest.raises(InputError, match=rf"but {lost.sum()} of {len(lost)} readings have none"):
        require_torques(measured, readings)
    some, all_of_them = check_torques(b.cell, readings), check_torques(b.cell, readings[~lost])
    assert some.to_json() == all_of_them.to_json()


@pytest.mark.parametrize("first", [0, pytest.param(np.inf, marks=pytest.mark.long)])
def test_a_campaign_goes_on_as_it_began(b, first):
    b.world.torques = first
    b.interrupt(4, FEW_POSES)
    b.world.torques = -1 if first else np.inf
    torque = b.measure().states.torque
    if not first:
        assert torque is None
    else:
        assert np.isfinite(torque[:4]).all()
        assert np.isnan(torque[4:]).all()
        assert len(b.remarks(LOST)) == 1


def test_temperatures_that_an_arm_no_longer_reports_lock_no_campaign(b, tmp_path):
    """The other readings keep theirs; a fit has no column that some of its readings lack."""

    def cold(sample):
        lost = b.store.rows and len(b.store.rows) >= 4
        return replace(sample, joint_temperature=np.full(6, np.nan)) if lost else sample

    change_result(b.rig.arm, "sample", cold)
    b.interrupt(6, FEW_POSES)
    readings = b.measure()
    assert len(b.remarks("no longer reports the temperatures of its joints")) == 2  # of sessions
    temperature = readings.states.joint_temperature
    assert np.allclose(temperature[:4], 30.0)
    assert np.isnan(temperature[4:]).all()
    with CampaignFile.create(tmp_path / "r.hilcal", b.config.to_json(), ".", "test") as file:
        file.append_readings(readings[:4])
        file.append_readings(readings[4:])
        assert content_hash(file.readings()) == content_hash(readings)
    with Campaign.open(tmp_path / "r.hilcal") as run:
        assert run.readings.states.joint_temperature is None
        with pytest.raises(InputError, match="which not all readings have"):
            run.catalogue.make("thermal_growth", run.cell, run.readings.states)
        run.save_table(tmp_path / "t.csv", as_stored=True)
    imported = import_table(tmp_path / "t.csv", b.cell.arm, None)
    assert content_hash(imported.readings) == content_hash(readings)
    assert any("in 5 of 9 readings (the first is row 6)" in note for note in imported.notes)


def _sensor(use, rotvec_rad):
    return ForceSensor(driver="fake", port="nowhere", use=use, rotvec_rad=rotvec_rad)


@pytest.mark.parametrize(
    ("section", "keys", "said"),
    [
        ("repeatability", {"joint_std_rad": 2e-5}, "[repeatability] joint_std_rad is 2e-05, and"),
        ("tracker", {"port": "elsewhere"}, None),
        ("planning", {"readings": "absolute"}, '[planning] readings is "absolute", and was "defl'),
    ],
)
def test_what_fits_do_not_know_of_a_changed_cell_is_said(b, tmp_path, section, keys, said):
    with create_run(tmp_path / "run.hilcal", b.config, tmp_path, usual_plan()) as campaign:
        assert changed_since_begun(campaign, b.config) == []
        lines = changed_since_begun(campaign, b.config.with_keys(section, **keys))
    assert [said in line for line in lines] == [True] * (said is not None)


def test_a_campaign_does_not_go_on_with_another_arm_of_the_model(b, tmp_path):
    def answers(**facts):
        return [{"device": "tracker", "facts": {"serial number": "7"}}, arm | {"facts": facts}]

    arm = {"device": "arm", "driver": "ur", "answers": True, "problems": [], "name": "UR5e"}
    first, other = ({"serial number": n} for n in ("20235500001", "20235500002"))
    with create_run(tmp_path / "run.hilcal", b.config, tmp_path, usual_plan()) as campaign:
        log = RunLog(campaign)
        assert check_same_arm(log, answers(**first))  # nothing to compare with
        for facts in ({}, first):  # a controller of before it told its number, and one that does
            log.event("devices", {"answers": [arm | {"facts": facts}]})
            assert check_same_arm(log, answers(**first)) == (facts == first)
        assert not check_same_arm(log, answers())
        with pytest.raises(InputError, match=r"number is 20235500002, .* 20235500001;"):
            check_same_arm(log, answers(**other))


@pytest.mark.parametrize("use", ["pulls", pytest.param("all", marks=pytest.mark.long)])
def test_wrong_axes_of_the_force_sensor_can_be_corrected_until_a_load_is_measured(use, tmp_path):
    wrong, right = _sensor(use, (np.pi, 0.0, 0.0)), _sensor(use, (0.0, 0.0, 0.0))
    b, plan = Bench(force_sensor=wrong), usual_plan()
    with create_run(tmp_path / "run.hilcal", b.config, tmp_path, plan) as campaign:
        b.store = RunLog(campaign)
        b.measure(replace(plan, steps=plan.steps[:5]))
        b.config = b.config.model_copy(update={"force_sensor": right})
        check_same_cell(campaign, b.config, tmp_path)
        readings = b.measure(plan)
        pulled = rows(readings, "pull")
        assert np.allclose(readings.states.wrench[pulled], [40.0, 0, 0, 0, 0, 0], atol=1e-6)
        check_same_cell(campaign, b.config, tmp_path)
        turned_back = b.config.model_copy(update={"force_sensor": wrong})
        with pytest.raises(InputError, match=r"rotvec_rad is .* were measured with"):
            check_same_cell(campaign, turned_back, tmp_path)
