"""A person beside the arm: it is moved, leaned on, a load falls; and devices that repeat."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from hilcal.config import Acquire, CellLoad
from hilcal.errors import DeviceError
from hilcal.measuring.measure import Measurer
from hilcal.measuring.progress import Phase
from hilcal.robot.chain import evaluate
from tests.support.fake_bench import (
    FEW_POSES,
    POSES,
    Bench,
    call_before,
    change_result,
    plan_of,
    rows,
    usual_plan,
)
from tests.support.refusals import refusal_of
from tests.support.rows import first

FOLDED = np.array([3.0, -1.3, 2.9, -1.4, -1.4, 0.1])  # the forearm lies on the column
MOVED = np.array([0.02, 0.0, 0.0])  # of a tracker's stand that was kicked, m
FREE = np.array([0.6, -1.3, 1.6, -1.4, -1.4, 0.1])


def jogged(b, at, q, *, after=0):
    """Move the arm by hand during the question after `after` others for a load or none."""
    moves = []

    def moved(answer):
        name = b.requested_loads[-1]
        if name == at and len(b.operator.requests) > after and not moves:
            moves.append(name)
            b.world.q = np.array(q)

    change_result(b.operator, "hang", moved)


def confirmed(b):
    """What the operator was asked besides loads."""
    return [words for name, words in b.operator.requests if name == "confirm"]


def carried(b):
    """What hangs at the start of each motion, and the payload that the controller knows, kg."""
    collected = []

    def noted(*_):
        collected.append((b.world.load, b.world.payload[0]))

    call_before(b.rig.arm, "start_move", noted)
    return collected


KNOWN = {("none", 0.8), ("3kg", 3.8), ("pull", 0.8)}
"""What hangs, and its payload with the tool of 0.8 kg."""
SHORT = plan_of(("p1", "none", 0), ("p1", "3kg", 0), ("reference", "none", 1))


@pytest.mark.parametrize("load", ["none", "3kg"])
def test_an_arm_jogged_into_a_blocked_place_during_a_question_is_not_moved(b, load):
    jogged(b, load, FOLDED)
    refusal_of(DeviceError, r"outside the workspace.*drive it by hand.*--resume$", b.measure)
    assert load not in [hung for _, hung in b.world.at_start]
    assert ("arm.take_control" in b.world.calls) is (load == "3kg")


def test_an_arm_jogged_to_a_free_place_is_asked_for_and_the_way_checked_from_there(b):
    jogged(b, "none", FREE)
    b.measure(SHORT)
    (asked,) = confirmed(b)
    assert "shoulder_pan is 0.5 rad off" in asked
    assert b.world.calls.index("operator.confirm") < b.world.calls.index("arm.take_control")


def test_a_joint_that_begins_with_a_whole_turn_is_said_before_the_question(b):
    """It winds the cables of tool and sensor; joints of such arms have two turns."""
    b.world.q = b.world.q - 2 * np.pi * np.eye(6)[5]
    said = []
    call_before(b.operator, "hang", lambda *_: said.append(len(b.remarks("turns wrist_3 by 35"))))
    b.measure(SHORT)
    assert said[0] == 1
    assert b.remarks("the first motion turns") == b.remarks("turns wrist_3 by 35")
    b.measure(FEW_POSES)
    assert len(b.remarks("the first motion turns")) == 1


@pytest.mark.long
def test_an_arm_that_is_moved_while_it_is_asked_for_is_asked_for_again(b):
    jogged(b, "none", FREE)
    places = [FREE + 0.1, FREE + 0.1]

    def again(question):
        if places:
            b.world.q = places.pop()

    call_before(b.operator, "confirm", again)
    b.measure()
    assert len(confirmed(b)) == 2


def test_an_arm_jogged_while_control_is_taken_is_not_moved(b):
    call_before(b.rig.arm, "take_control", lambda *_: setattr(b.world, "q", FREE.copy()))
    refusal_of(DeviceError, r"has commanded it since.*0\.5 rad", b.measure)
    assert "arm.start_move" not in b.world.calls


@pytest.mark.parametrize(("load", "after"), [("3kg", 0), ("none", 1)])
def test_an_arm_moved_while_a_load_is_changed_goes_back_once_that_is_agreed(b, load, after):
    away = np.array(POSES["reference"]) + 0.2 * np.eye(6)[0]
    jogged(b, load, away, after=after)
    motions = carried(b)
    readings = b.measure(SHORT)
    assert len(readings) == len(SHORT.steps)
    (asked,) = confirmed(b)
    assert "shoulder_pan is 0.2 rad off" in asked
    assert "where it was left" in asked
    back = [q for q, hung in b.world.at_start if hung == load]
    assert np.allclose(back[0 if load == "3kg" else -1], POSES["reference"])
    assert set(motions) <= KNOWN


def test_an_arm_nudged_while_a_load_is_hung_goes_back_by_itself(b):
    """By 3 mrad: no reading is taken there, and that alone shall not end the run."""
    home = np.array(POSES["reference"])
    jogged(b, "3kg", home + 0.003 * np.eye(6)[0])
    readings = b.measure(plan_of(("reference", "3kg", 0)))
    assert not confirmed(b)
    assert np.abs(readings.states.q_actual[0] - home).max() < 1e-4


@pytest.mark.parametrize(
    ("load", "after", "fallen"), [("3kg", 0, False), ("none", 1, False), ("3kg", 2, True)]
)
def test_after_a_question_the_way_back_is_free_with_either_load(b, load, after, fallen):
    """The arm was jogged to where the 3 kg would stand in the floor, and the bare tool does not."""
    jogged(b, load, np.array(POSES["reference"]) + 0.25 * np.eye(6)[1], after=after)
    if fallen:
        falls_at_rest(b, "3kg", 4)
    moved = []
    call_before(b.rig.arm, "start_move", lambda *_: moved.append(len(b.operator.requests)))
    refusal_of(DeviceError, r"what hangs \(3kg\) is .* outside", b.measure)
    assert moved[-1] < len(b.operator.requests)


def test_only_a_joint_that_was_moved_is_approached_again(b):
    """The others stand beside their goal by the encoders' noise, which is no motion."""
    plan = plan_of(("p1", "none", 0), ("reference", "3kg", 0), ("reference", "none", 1))
    usual = b.measure(plan).states.approach[1]
    b = Bench()
    noise = 4e-6 * usual
    jogged(b, "3kg", POSES["reference"] + noise + 0.2 * usual[0] * np.eye(6)[0])
    assert b.measure(plan).states.approach[1].tolist() == [-usual[0], *usual[1:]]


def test_an_operator_who_cannot_be_asked_is_not_taken_to_agree(b):
    jogged(b, "none", FREE)

    class Silent:
        """A driver of others, from before the question."""

        def __init__(self, asks):
            self.report, self.hang, self.close = asks.report, asks.hang, asks.close

    b.rig = replace(b.rig, operator=Silent(b.operator))
    refusal_of(DeviceError, "does not stand where it was left", b.measure)
    assert "arm.start_move" not in b.world.calls


@pytest.mark.long
def test_a_campaign_that_goes_on_says_that_the_arm_stands_elsewhere_and_asks():
    for moved, questions in ((False, 0), (True, 1)):
        b = Bench()
        b.interrupt(1, SHORT)
        if moved:
            b.world.q = FREE.copy()
        b.measure(SHORT)
        assert len(confirmed(b)) == questions


@pytest.mark.parametrize("elsewhere", first(1, [True, False]))
@pytest.mark.parametrize(("moved", "asked"), [(3e-4, False), (2e-3, True)])
def test_a_tracker_that_was_moved_between_sessions_is_asked_about(moved, asked, elsewhere):
    b = Bench()
    plan = plan_of(("reference", "none", 0), ("p1", "none", 0), ("reference", "none", 1))
    b.interrupt(2, plan)
    if elsewhere:  # the readings of before are in another file, as of a calibration that is tested
        first_reading = b.store.readings().value[0, :3].tolist()
        b.store.rows.clear()
        plan = replace(plan, about={"reference_seen_m": first_reading})
    b.world.shift = np.array([0.0, moved, 0.0])
    b.measure(plan)
    questions = [q for q in confirmed(b) if "mm from where it was before" in q]
    assert len(questions) == asked
    assert ("moved" in b.store.kinds()) == asked


@pytest.mark.parametrize("put_back", first(1, [True, False]))
def test_a_tracker_that_is_moved_between_two_readings_is_asked_about_at_the_next_return(
    b, put_back
):
    """The reading before the answer is kept as doubted; the one after it is stored."""

    def kick(*_):
        if len(b.store.rows) == 3:
            b.world.shift = MOVED

    def answer(*_):
        if put_back:
            b.world.shift = np.zeros(3)

    call_before(b.store, "record", kick)
    call_before(b.operator, "confirm", answer)
    readings = b.measure()
    assert [q[:38] for q in confirmed(b)] == ["the target at the reference pose is 20"]
    assert {"moved", "doubted"} <= set(b.store.kinds())
    at_reference = readings.value[readings.pose == 0]
    assert np.linalg.norm(at_reference[-1] - at_reference[0]) == pytest.approx(
        0.0 if put_back else 0.02, abs=1e-3
    )
    assert not len(FEW_POSES.without(b.store.done()).steps)


def test_nobody_is_asked_twice_about_a_tracker_that_was_moved(b):
    b.interrupt(3)
    b.world.shift = MOVED
    b.measure()
    assert len(confirmed(b)) == 1
    assert len(b.remarks("reference pose has moved")) == 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"q": 0.02, "q_target": 0.02}, "another program, or somebody at the pendant"),
        ({"q": 0.02}, "somebody has moved it"),
    ],
)
def test_an_arm_that_is_moved_at_rest_is_named_at_the_next_look(b, change, said):
    begun = []

    def moved(here):
        if b.world.calls.count("tracker.measure") < 20:
            return here
        begun.append(b.world.time)
        return replace(here, **{name: getattr(here, name) + by for name, by in change.items()})

    change_result(b.rig.arm, "sample", moved)
    refusal_of(DeviceError, said, b.measure)
    assert b.world.time - begun[0] < 1.0
    assert b.world.calls[-2] == "arm.stop"


@pytest.mark.parametrize(
    ("kg", "x_m", "told"), [(9.0, 0.0, r"9 kg at \(0.000"), (0.8, 0.05, r"0.8 kg at \(0.050")]
)
def test_a_payload_that_others_set_in_the_controller_ends_the_run(b, kg, x_m, told):
    """It changes the arm's deflection and when it stops; a resumed run sets its own."""

    def others(*_):
        if len(b.store.rows) == 2:
            b.world.payload = (kg, np.array([x_m, 0.0, 0.06]))

    call_before(b.store, "record", others)
    said = rf"set its payload to {told}, .*; it was 0.8 kg at \(0.010.*--resume$"
    refusal_of(DeviceError, said, b.measure)
    assert len(b.store.rows) == 3
    assert b.world.calls[-2] == "arm.stop"
    b.world.restart()
    b.measure()
    assert not len(FEW_POSES.without(b.store.done()).steps)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"q": 0.003, "q_target": 0.003}, r"arm: shoulder_pan stands 0\.003 rad off its goal"),
        ({"q_target": 0.003}, r"somebody else commanded shoulder_pan by 0\.003 rad"),
        ({"qd": 0.02}, r"arm: shoulder_pan still moves at 0\.02 rad/s"),
    ],
)
def test_no_reading_is_taken_beside_the_goal_or_in_motion(change, said):
    """3 mrad are 3 mm at the target, and less than what ends a session at once."""
    quick = Acquire(samples=3, settle_s=0.2, force_window_s=0.3, settle_timeout_s=1.0)
    b, arrived = Bench(acquire=quick), []

    def beside(here):
        by = {n: getattr(here, n) + x * np.eye(6)[0] for n, x in change.items()}
        return replace(here, **by) if 2 in arrived else here

    call_before(b.rig.tracker, "measure", lambda: arrived.append(len(b.store.rows)))
    change_result(b.rig.arm, "sample", beside)
    refusal_of(DeviceError, said, b.measure)
    assert len(b.store.rows) == 2


@pytest.mark.parametrize("ends", [DeviceError("stopped by the operator"), KeyboardInterrupt()])
def test_a_payload_that_stays_in_the_controller_is_said(b, ends):
    """Of 3 kg that nobody has hung: an arm that is guided by hand would rise."""

    def gives_up(load, _):
        if load is not None:
            raise ends

    call_before(b.operator, "hang", gives_up)
    with pytest.raises(type(ends)):
        b.measure(SHORT)
    assert len(b.remarks("set to a payload of 3.8 kg at")) == 1


@pytest.mark.parametrize(
    ("device", "call", "change", "said"),
    [
        ("tracker", "measure", {"value": np.array([0.0, np.nan, 0.0])}, "tracker: it gives a v"),
        ("tracker", "measure", {"covariance": np.full((3, 3), np.nan)}, "tracker: it gives a c"),
        ("tracker", "measure", {"covariance": np.zeros((3, 3))}, "not positive definite"),
        ("tracker", "measure", {"value": np.zeros(4)}, r"value of shape \(4,\); valid: \(3,\) or"),
        ("arm", "sample", {"qd": np.full(6, np.nan)}, "arm: it reports joint angles that are not"),
        ("force", "average", {"wrench": np.full(6, np.nan)}, "force sensor: it gives a value that"),
        ("force", "latest", {"wrench": np.full(6, np.inf)}, "force sensor: it gives a value that"),
    ],
)
def test_a_sample_without_numbers_is_named_in_one_line(b, device, call, change, said):
    change_result(getattr(b.rig, device), call, lambda sample: replace(sample, **change))
    line = refusal_of(DeviceError, said, b.measure)
    assert "unexpected" not in line
    assert "drift" not in line
    assert b.store.rows == []


def in_motion(b, change, motion=4):
    """Change samples of the arm from the first look on of a motion; returns when that began."""
    begun = []

    def later(here):
        b.world.hurry = 20.0 if len(b.world.at_start) < motion - 1 else 1.0
        if len(b.world.at_start) < motion or not (begun or b.world.is_moving):
            return here
        begun.append(b.world.time)
        return change(here)

    change_result(b.rig.arm, "sample", later)
    return begun


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (("q",), "commanded .* rad away from its position.*its angle is old"),
        (("q", "q_target"), r"joint angles have stood still for 0\.6 s"),
        (("timestamp",), "its clock has stood still"),
    ],
)
def test_feedback_that_stands_still_in_motion_is_named_within_a_second(b, names, said):
    kept = []

    def frozen(here):
        kept.append(here)
        return replace(
            here, **{name: getattr(kept[0], name.removesuffix("_target")) for name in names}
        )

    begun = in_motion(b, frozen)
    refusal_of(DeviceError, said, b.measure)
    assert b.world.time - begun[0] < 1.0


def test_an_arm_that_leaves_its_straight_way_is_stopped(b):
    begun = in_motion(b, lambda here: replace(here, q=here.q + 0.06 * np.eye(6)[3]))
    refusal_of(DeviceError, "wrist_1 has left the straight way", b.measure)
    assert b.world.time - begun[0] < 0.1


@pytest.mark.long
def test_a_motion_at_the_slowest_slider_does_not_stand_still(b):
    near = np.array(POSES["reference"]) + 0.02
    b.world.hurry = 0.02
    change_result(b.rig.arm, "sample", lambda here: replace(here, speed_scaling=0.02))
    poses = {"reference": POSES["reference"], "p1": tuple(near)}
    b.measure(plan_of(("reference", "none", 0), ("p1", "none", 0), poses=poses))


def falls_in_motion(b, *wrong):
    """Let the 3 kg fall in the motion after the seventh reading; returns when they fell.

    `wrong` are the loads that are hung instead afterwards.
    """
    fell = []

    def falls():
        b.world.hurry = 1.0 if len(b.store.rows) in (6, 7) else 20.0
        if b.world.load == "3kg" and len(b.store.rows) == 7 and b.world.is_moving and not fell:
            b.world.load, b.world.wrong_loads = "none", list(wrong)
            fell.append(b.world.time)

    call_before(b.rig.arm, "moving", falls)
    return fell


def test_a_load_that_falls_off_in_motion_stops_the_arm_and_is_asked_for_again(b):
    known, stopped = [], []
    fell, motions = falls_in_motion(b), carried(b)
    call_before(b.rig.arm, "stop", lambda: stopped.append(b.world.time))

    def jog(_):  # while the load is hung again, where the arm was stopped
        known.append(b.world.payload and b.world.payload[0])
        b.world.q = b.world.q + 0.1 * np.eye(6)[0] * (len(known) == 3)

    change_result(b.operator, "hang", jog)
    readings = b.measure(usual_plan())
    assert len(readings) == len(usual_plan().steps)
    assert stopped[0] - fell[0] < 0.5
    assert b.requested_loads[1:3] == ["3kg", "3kg"]
    assert "0.0 N where 3kg should hang (29.4 N)" in b.operator.requests[2][1]
    (asked,) = confirmed(b)
    assert "shoulder_pan is 0.1 rad off" in asked
    assert known[:3] == [None, 3.8, 0.8]  # the controller knows that nothing hangs
    assert set(motions) == KNOWN  # and that it was hung again
    assert [x["hanging"] for k, x in b.store.events if k == "load"][:3] == ["3kg", None, "3kg"]
    loaded = rows(readings, "3kg")
    assert np.allclose(readings.states.wrench[loaded, 2], -3.0 * 9.80665, atol=0.01)


def falls_at_rest(b, load, rows):
    """Let a load fall while the tracker measures, after so many readings."""
    fell = []

    def falls():
        if b.world.load == load and len(b.store.rows) == rows and not fell:
            b.world.load = "none"
            fell.append(load)

    call_before(b.rig.tracker, "measure", falls)


def assert_true(b):
    """Every stored reading is where its load and its joints hold the target."""
    b.world.is_moving, b.world.extra, b.world.shift = False, np.zeros(6), np.zeros(3)
    for _, reading, _ in b.store.rows:
        b.world.q, b.world.load = reading.states.q_actual[0], reading.load_names[0]
        assert np.linalg.norm(reading.value[0] - b.world.position()) < 1e-4


def test_a_load_that_falls_off_between_readings_leaves_no_reading_without_it(b):
    """It falls while the tracker measures: the reading is kept as doubted, and taken again."""
    falls_at_rest(b, "3kg", 4)
    b.measure()
    assert b.requested_loads[1:3] == ["3kg", "3kg"]
    assert_true(b)


@pytest.mark.parametrize("load", first(1, ["none", "3kg"]))
def test_leaning_on_the_tool_during_a_reading_is_kept_as_doubted_and_measured_again(b, load):
    leaned = []

    def leans(seconds):
        ready = len(b.store.rows) == (4 if load == "none" else 7)
        b.world.extra = np.zeros(6)
        if ready and b.world.load == load and not leaned:
            leaned.append(b.world.time)
            b.world.extra = np.array([0, 60.0, 0, 0, 0, 0])

    call_before(b.rig.force, "average", leans)
    readings = b.measure(usual_plan())
    assert leaned
    assert len(readings) == len(usual_plan().steps)
    doubted = b.store.last("doubted")
    assert "60" in doubted["why"] or load != "none"
    assert doubted["reading"]["load"] == load
    assert b.requested_loads.count(load) > 1
    assert b.remarks("somebody touch the tool")


def test_a_light_load_that_falls_before_the_tool_is_weighed_is_noticed():
    """Two unloaded readings do not weigh the tool; the tare holds it where the arm turns little."""
    load = "2kg"
    b = Bench(loads=(CellLoad(name=load, mass_kg=2.0, hang_m=0.1),))
    steps = (("p1", "none", 0), ("p3", "none", 0), ("p1", load, 0), ("p3", load, 0))
    falls_at_rest(b, load, 3)
    b.measure(plan_of(*steps, poses={k: POSES[k] for k in ("reference", "p1", "p3")}))
    assert "tool" not in b.store.kinds()
    assert b.requested_loads[-2:] == [load, load]
    assert f"where {load} should hang" in b.operator.requests[-1][1]


def leans_in_phase(b, phase, number):
    """Lean on the tool with 60 N during one phase of a run, until somebody is asked."""
    times = []

    def leans(event):
        if isinstance(event, Phase):
            times.extend([event.text] * (phase in event.text))
            now = phase in event.text and len(times) == number
            b.world.extra = np.array([0, 60.0 * now, 0, 0, 0, 0])

    call_before(b.notes, "notify", leans)


@pytest.mark.parametrize(
    ("phase", "number"), first(1, [("moving to beside", 1), ("taring", 2), ("taring", 3)])
)
def test_leaning_in_the_first_motion_or_during_a_tare_is_asked_for_and_not_tared_away(
    b, phase, number
):
    b.world.hurry = 1.0
    leans_in_phase(b, phase, number)
    b.measure(SHORT)
    assert any("measures 60.0 N where nothing should hang" in why for _, why in b.operator.requests)
    zeros = [d["felt"]["zero"] for d in b.store.details()]
    assert np.allclose(zeros, b.world.offset, atol=1e-6)


@pytest.mark.long
def test_a_first_tare_that_was_leaned_on_ends_the_run_and_says_so(b):
    leans_in_phase(b, "taring", 1)
    refusal_of(
        DeviceError,
        "a load hung, or the tool was touched, when the sensor was tared",
        b.measure,
        SHORT,
    )
    assert b.store.rows == []
    b.measure(SHORT)  # with a tare of its own


def test_leaning_in_most_samples_of_a_reading_and_not_at_its_end_is_measured_again(b, monkeypatch):
    samples = []
    averaged = Measurer._averaged

    def settled(*arguments):
        samples.extend([0] * (len(b.store.rows) == 1))
        return averaged(*arguments)

    monkeypatch.setattr(Measurer, "_averaged", settled)

    def leans():
        samples.extend([0] * bool(samples))
        now = len(samples) in (3, 4)  # the second and the third of three
        b.world.extra, b.world.shift = 60.0 * now * np.eye(6)[1], 1.2e-3 * now * np.eye(3)[1]

    def lets_go(seconds):
        b.world.extra, b.world.shift = np.zeros(6), np.zeros(3)

    call_before(b.rig.tracker, "measure", leans)
    call_before(b.rig.force, "average", lets_go)
    b.measure(SHORT)
    assert b.remarks("was the tool touched")
    assert_true(b)


def test_a_tool_far_from_its_configuration_is_refused_before_it_is_measured_with(b):
    b.world.tool_mass = 4.0  # [tool] says 0.8 kg, which the controller is told
    with pytest.raises(DeviceError, match=r"asked 3 times") as raised:
        b.measure()
    assert any("[tool] mass_kg" in why for _, why in b.operator.requests), raised.value


@pytest.mark.long
def test_unloaded_readings_that_were_leaned_on_do_not_spoil_the_tool(b):
    """Below what is noticed at once: 5 N to one side in one of five."""

    def leans(seconds):
        b.world.extra = np.array([0, 5.0 * (len(b.store.rows) == 2), 0, 0, 0, 0])

    call_before(b.rig.force, "average", leans)
    b.measure(usual_plan())
    assert b.store.last("tool")["mass_kg"] == pytest.approx(0.8, abs=1e-6)
    assert b.remarks("was the tool touched")


@pytest.mark.long
def test_a_load_that_swings_a_little_in_motion_is_let_swing(b):

    def swings(one):
        b.world.hurry = 1.0 if b.world.load == "3kg" else 20.0
        if b.world.load == "3kg" and b.world.is_moving:
            one.wrench[:3] += 6.0 * np.sin(2 * np.pi * b.world.time / 0.8)
        return one

    change_result(b.rig.force, "latest", swings)
    b.measure()
    assert b.requested_loads == ["none", "3kg", "none", "pull", "none"]


@pytest.mark.long
def test_who_bears_a_part_of_a_heavy_load_in_motion_is_noticed_though_it_may_swing(b):
    """30 N from below a weight of 59 N: less than it may pull to the side while it swings."""
    borne = []

    def bears(one):
        b.world.hurry = 1.0 if b.world.load == "6kg" else 20.0
        if b.world.load == "6kg" and b.world.is_moving and b.requested_loads.count("6kg") == 1:
            borne.append(b.world.time)
            turned = evaluate(b.cell.arm, b.world.joints()[None]).rotation[-1][0]
            one.wrench[:3] += turned.T @ np.array([0.0, 0.0, 30.0])
        return one

    change_result(b.rig.force, "latest", bears)
    b.measure(plan_of(("p1", "none", 0), ("p1", "6kg", 0), ("p2", "6kg", 0)))
    assert borne
    assert borne[-1] - borne[0] < 1.0
    assert "6kg" in [name for name, why in b.operator.requests if "where 6kg should hang" in why]


def test_a_tracker_whose_target_does_not_move_with_the_arm_is_named_before_any_reading(b):
    still = b.world.position()
    b.world.position = lambda: still
    refusal_of(DeviceError, "repeats an old reading, or follows a reflector", b.measure)
    assert b.store.rows == []


def test_a_tracker_that_repeats_one_measurement_is_named(b):
    kept = []

    def repeats(one):
        if len(b.store.rows) == 3:
            kept.append(one)
            return replace(one, value=kept[0].value)
        return one

    change_result(b.rig.tracker, "measure", repeats)
    refusal_of(DeviceError, "the same to the last digit", b.measure)
    assert len(b.store.rows) == 3


@pytest.mark.parametrize("good", first(1, [2, 8]))
def test_a_tracker_that_keeps_to_the_place_of_the_last_pose_is_named(b, good):
    """The reading that it repeats is doubted too, until the tracker's place vouches for it."""
    kept = []

    def stuck(place):
        if len(b.store.rows) < good:
            kept[:] = [place]
        return kept[0]

    change_result(b.world, "position", stuck)
    refusal_of(DeviceError, "repeats an old reading", b.measure)
    assert len(b.store.rows) == good
    assert "why" in b.store.last("doubted")
    doubted = [content["reading"] for _, content in b.store.events if content.get("stored")]
    assert doubted == ([asdict(b.store.rows[1][0])] if good == 2 else [])


@pytest.mark.long
def test_stored_readings_of_a_stuck_tracker_do_not_keep_a_campaign_from_going_on(b):
    """As older versions stored them: four right ones, then three at one and the same place."""
    plan = usual_plan()
    b.interrupt(7, plan)
    step, reading, _ = b.store.rows[3]
    for k in (4, 5, 6):
        step, other, text = b.store.rows[k]
        b.store.rows[k] = (step, replace(other, value=reading.value), text)
    assert len(b.measure(plan)) == len(plan.steps)


def test_a_force_sensor_that_repeats_itself_is_named(b):
    change_result(b.rig.force, "average", lambda one: replace(one, covariance=np.zeros((6, 6))))
    refusal_of(DeviceError, "frames are the same to the last digit", b.measure)
    assert b.store.rows == []


def test_a_tracker_that_was_moved_and_has_lost_its_target_is_asked_about():
    b = Bench()
    plan = plan_of(("reference", "none", 0), ("p1", "none", 0), ("reference", "none", 1))
    b.interrupt(2, plan)
    b.world.shift = np.array([0.0, 2e-3, 0.0])
    b.world.unseen_measurements = 2
    b.measure(plan)
    assert [q for q in confirmed(b) if "mm from where it was before" in q]
