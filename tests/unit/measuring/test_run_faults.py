"""What goes wrong in a campaign: the arm stops first, and what is stored stays."""

import json
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hilcal.cell import Cell
from hilcal.config import Acquire, ForceSensor, Limits
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.arrival import RoughRegistration
from hilcal.measuring.motion import Guard
from hilcal.measuring.progress import ReadingStored
from hilcal.measuring.run import HOW_ON
from hilcal.robot import chain as chains
from hilcal.robot.catalogue import configs_dir
from hilcal.store.plan import Step, joined
from tests.support.fake_bench import (
    FEW_POSES,
    POSES,
    STD,
    Bench,
    FakeClock,
    Killed,
    call_before,
    change_result,
    plan_of,
    usual_plan,
)
from tests.support.refusals import refusal, refusal_of
from tests.support.rows import first

FAULTS = (
    DeviceError("arm: the line is dead"),
    KeyboardInterrupt(),
    Killed(),
    OSError(5, "Input/output error"),
)


def small_plan():
    """Every kind of motion and change of load, in few calls."""
    return plan_of(
        ("reference", "none", 0),
        ("p1", "none", 0),
        ("p1", "none", 1),
        ("p1", "3kg", 0),
        ("reference", "none", 1),
    )


def bench():
    return Bench(limits=Limits())


def each_once(b, plan):
    return Counter(step for step, _, _ in b.store.rows) == Counter(plan.steps)


@cache
def calls_of_a_whole_run():
    b = bench()
    b.measure(small_plan())
    assert each_once(b, small_plan())
    return len(b.world.calls)


KINDS = range(len(FAULTS))
IDS = [type(f).__name__ for f in FAULTS]


@pytest.mark.parametrize("kind", first(1, KINDS), ids=IDS)
def test_fault_at_some_calls(kind):
    """Every 197th call, other ones for each kind of fault; all of them in the slow suite."""
    for k in range(1 + 10 * kind, calls_of_a_whole_run() + 1, 197):
        check_fault(FAULTS[kind], k)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_fault_at_every_call(kind):
    for k in range(1, calls_of_a_whole_run() + 1):
        check_fault(FAULTS[kind], k)


def check_fault(fault, k):
    """Fail at the k-th call, look what was done about it, resume, and count."""
    b, plan = bench(), small_plan()
    if isinstance(fault, Killed):
        b.world.kill_at = k
    else:
        b.world.fail[k] = fault
    expected = DeviceError if isinstance(fault, OSError) else type(fault)
    with pytest.raises(expected) as raised:
        b.measure(plan)
    if isinstance(raised.value, DeviceError):
        said = str(raised.value)
        assert said.endswith(HOW_ON), (k, said)
        assert "\n" not in said
    check_stopped(b, k)
    before = [step for step, _, _ in b.store.rows]
    b.world.restart()
    b.measure(plan)
    assert [step for step, _, _ in b.store.rows][: len(before)] == before
    assert each_once(b, plan), k
    readings = b.store.readings()
    assert np.all(np.diff(readings.states.time) > 0), k


def check_stopped(b, k):
    """Once the arm is ours, the call after the fault is its stop; then only an event is stored."""
    world = b.world
    after = world.calls[k:]
    if world.killed:
        assert after == []
    elif "arm.take_control" in world.calls[:k]:
        assert after == ["arm.stop", "store.event"], (k, after)
        assert not world.is_moving
    else:
        assert after == ["store.event"], (k, after)


@pytest.mark.parametrize(
    "error",
    [
        DeviceError("run.hilcal: the disk is full"),
        InputError("run.hilcal: the readings differ from those before"),
    ],
)
def test_a_row_that_is_not_stored_stops_the_arm_and_says_what_to_do(error):
    """What the store refuses as wrong input stays that (exit code 2)."""
    b, plan = bench(), small_plan()
    b.store.refuses = {2: error}
    refusal_of(type(error), rf"{error}\. .*--resume$", b.measure, plan)
    assert b.world.calls[-2:] == ["arm.stop", "store.event"]
    assert len(b.store.rows) == 2
    b.store.refuses = {}
    b.world.restart()
    b.measure(plan)
    assert each_once(b, plan)


@pytest.mark.parametrize(
    ("fault", "stop", "said"),
    [
        (
            KeyboardInterrupt(),
            "arm: no answer to stop",
            r"THE ARM MAY STILL MOVE \(arm: no answer to stop\): press the emergency stop",
        ),
        (
            DeviceError("arm: its link broke; press the emergency stop. Unplugged?"),
            "arm: not sure that it stands: press the emergency stop if it moves",
            r"Unplugged\? ",
        ),
    ],
)
def test_an_arm_that_does_not_stop_is_told_loudly_and_once(fault, stop, said, monkeypatch):
    b = bench()

    def fails():
        raise DeviceError(stop)

    monkeypatch.setattr(b.rig.arm, "stop", fails)
    b.world.fail[120] = fault
    raised = refusal_of(DeviceError, said, b.measure, small_plan())
    assert raised.count("emergency stop") == 1
    assert raised.endswith(HOW_ON)
    assert b.store.events[-1][1]["arm_not_stopped"] == stop


def test_impatience_does_not_hide_that_the_arm_may_still_move():
    """Ctrl-C while it is noted why the session ended: "the arm stands" was said."""
    b = bench()

    def impatient(kind, _):
        if kind == "failed":
            raise KeyboardInterrupt

    def mute():
        raise DeviceError("arm: no answer to stop")

    call_before(b.store, "event", impatient)
    b.world.fail[120], b.rig.arm.stop = DeviceError("tracker: silent"), mute
    refusal_of(DeviceError, r"tracker: silent.*THE ARM MAY STILL MOVE", b.measure, small_plan())


def test_impatience_does_not_keep_the_arm_from_stopping():
    """Ctrl-C while the arm is being stopped: it is stopped again."""
    b = bench()
    stops = []

    def stop():
        stops.append(1)
        if len(stops) == 1:
            raise KeyboardInterrupt

    call_before(b.rig.arm, "stop", stop)
    b.world.fail[120] = DeviceError("tracker: silent")
    refusal_of(DeviceError, r"tracker: silent.*--resume$", b.measure, small_plan())
    assert len(stops) == 2
    assert not b.world.is_moving


def test_an_interrupt_that_a_driver_suppresses_stops_the_arm_before_its_next_motion(b):
    asked = []

    def interrupted(*_):
        if len(b.store.rows) == 2:
            asked.append(len(b.world.at_start))

    call_before(b.rig.tracker, "measure", interrupted)
    with pytest.raises(KeyboardInterrupt):
        b.measure(small_plan(), stop_requested=lambda: bool(asked))
    assert len(b.world.at_start) == asked[0]
    assert "arm.stop" in b.world.calls[-3:]
    assert b.store.kinds()[-1] == "interrupted"


def test_unexpected_errors_and_errors_before_the_arm_is_ours():
    """A fault before `take_control`: somebody else's program may be running."""
    b = bench()
    b.world.fail[150] = ZeroDivisionError("of a driver of somebody else's")
    words = "unexpected ZeroDivisionError: of a driver.*--resume"
    refusal_of(DeviceError, words, b.measure, small_plan())
    assert "Traceback" in b.store.last("failed")["trace"]
    b = bench()
    b.world.fail[2] = DeviceError("force sensor: silent")
    refusal_of(DeviceError, "silent", b.measure, small_plan())
    assert not {"arm.take_control", "arm.stop"} & set(b.world.calls)


def held(rng, count, spread=0.7, *, known=True, off_m=0.0):
    """A cell of an unknown registration, joints (K, n), and what the tracker sees of its target."""
    cell = Cell.load(configs_dir() / "cells" / "demo_ur10e.toml")
    cell = replace(cell, registration_known=False, target_known=known)
    joints = np.array([0.0, -1.2, 1.4, -1.7, -1.5, 0.0]) + rng.uniform(-spread, spread, (count, 6))
    return cell, joints, held_by(cell, joints, off_m)


def held_by(cell, joints, off_m):
    at = chains.evaluate(cell.arm, joints).point(cell.target[:3, 3] + [off_m, 0.0, 0.0])
    return at @ cell.registration[:3, :3].T


def test_another_reflector_is_noticed_before_the_registration_is_known():
    """By distances from two readings that agree; one alone may be the one that is wrong."""
    rng = np.random.default_rng(0)
    noticed = 0
    for _ in range(40):
        cell, joints, places = held(rng, 3, 0.5)
        known = RoughRegistration(cell)
        known.add(joints[0], places[0])
        stray = places[1] + 0.3 * rng.standard_normal(3)
        assert known.implausible(joints[1], stray) is None  # a run must not end by that
        known.add(joints[1], places[1])
        assert known.implausible(joints[2], places[2]) is None
        stray = places[2] + 0.3 * rng.standard_normal(3)
        reason = known.implausible(joints[2], stray)
        noticed += reason is not None
        assert reason is None or "does it follow another reflector" in reason
    assert noticed > 25


def test_a_reading_of_another_reflector_is_told_as_soon_as_the_tracker_has_its_place():
    """0.2 m off on the sphere about the first position, where distances cannot tell it."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        cell, joints, places = held(rng, 9)
        known = RoughRegistration(cell)
        way = places[1] - places[0]
        aside = np.cross(way, rng.standard_normal(3))
        stray = places[1] + 0.25 * aside / np.linalg.norm(aside)
        doubted = []
        for k, q in enumerate(joints):
            known.add(q, stray if k == 1 else places[k], step=Step(f"p{k}", "none"))
            doubted += [str(step) for step, _ in known.late_doubts()]
        assert doubted == ["p1, none, cycle 0"]
        pose = known.pose()
        assert np.allclose(pose[0], cell.registration[:3, :3], atol=1e-9)


def test_readings_of_a_second_reflector_on_the_tool_are_told_each_and_none_of_the_first():
    """0.05 m from the first one, which is 0.01 m from where it is said; joints 2 mrad off."""
    rng = np.random.default_rng(4)
    for _ in range(5):
        cell, joints, _ = held(rng, 12)
        off = joints + 0.002 * rng.standard_normal(6)
        places = [*held_by(cell, off[:8], 0.01), *held_by(cell, off[8:], 0.06)]
        known, doubted = RoughRegistration(cell), []
        for k, q in enumerate(joints):
            known.add(q, places[k], step=Step(f"p{k}", "none"))
            doubted += [step.pose for step, _ in known.late_doubts()]
        assert doubted == ["p8", "p9", "p10", "p11"]


@pytest.mark.parametrize(("known", "off_m"), [(False, 0.15), (True, 0.03)])
def test_a_target_that_is_not_where_it_is_said_refuses_no_reading(known, off_m):
    """Its place is estimated later, or was measured with a ruler."""
    cell, joints, places = held(np.random.default_rng(1), 40, known=known, off_m=off_m)
    rough = RoughRegistration(cell)
    for k, (q, x) in enumerate(zip(joints, places, strict=True)):
        assert rough.implausible(q, x) is None
        rough.add(q, x, step=Step(f"p{k}", "none"))
        assert rough.late_doubts() == []
    assert rough.pose() is not None


LIMIT = ForceSensor(driver="fake", port="nowhere", max_force_N=120.0)


def test_order_of_the_start(b):
    """The hook is cleared before anything moves, the tare comes before the first reading."""
    b.measure()
    first = {name: b.world.calls.index(name) for name in set(b.world.calls)}
    assert first["operator.hang"] < first["arm.take_control"] < first["arm.start_move"]
    tare = b.world.calls.index("force.average", first["arm.start_move"])
    assert first["force.average"] < first["arm.take_control"]  # does something still hang?
    assert tare < first["store.record"]
    assert b.operator.requests[0] == ("none", "")
    assert b.store.kinds()[:2] == ["start", "tare"]


def test_payload_is_set_before_a_weight_is_hung_and_after_it_is_off(b):
    given = []

    def payload(mass, com):
        given.append((b.world.load, mass, str(np.round(com, 6).tolist())))

    call_before(b.rig.arm, "set_payload", payload)
    plan = plan_of(
        ("p1", "none", 0), ("p1", "3kg", 0), ("p1", "6kg", 0), ("p1", "3kg", 1), ("p1", "pull", 0)
    )
    b.measure(plan)
    com = {m: np.round((0.8 * b.cell.tool_com + (m - 0.8) * b.cell.load_point) / m, 6).tolist()
           for m in (3.8, 6.8)}  # fmt: skip
    assert given == [
        ("none", 3.8, str(com[3.8])),
        ("3kg", 6.8, str(com[6.8])),
        ("3kg", 3.8, str(com[3.8])),  # the 6 kg are off
        ("pull", 0.8, str(np.round(b.cell.tool_com, 6).tolist())),
    ]


def test_loads_change_only_at_the_reference_and_motions_carry_them(b):
    where = []
    call_before(b.operator, "hang", lambda *_: where.append(b.world.q.copy()))
    b.measure()
    assert b.requested_loads == ["none", "3kg", "none", "pull", "none"]
    for q in where[1:]:
        assert np.allclose(q, POSES["reference"])
    assert {load for _, load in b.world.at_start} == {"none", "3kg", "pull"}


def test_every_motion_is_guarded_with_what_hangs_and_nothing_else(b, monkeypatch):
    checked, begun, check = [], [], Guard.check

    def noted(guard, sample, wrench=None, hanging="none"):
        checked.append(hanging)
        return check(guard, sample, wrench, hanging)

    monkeypatch.setattr(Guard, "check", noted)
    call_before(b.rig.arm, "sample", checked.clear)
    call_before(b.rig.arm, "start_move", lambda *_: begun.append((b.world.load, *checked)))
    b.measure()
    assert set(begun) == {("none", "none"), ("3kg", "3kg"), ("pull", "pull")}


def test_an_unsafe_plan_is_refused_before_any_device_is_asked():
    b = Bench(limits=Limits(workspace_min_m=(-3, -3, 0.9)))
    plan = plan_of(("p1", "none", 0), ("p1", "brick", 0))
    words = refusal("not safe", b.measure, plan)  # the first problem, and how to see the others
    assert "brick" in words
    assert "more: hilcal check --plan" in words
    assert b.world.calls == []
    assert b.store.events == []


def test_an_arm_that_stands_outside_its_workspace_is_not_moved():
    b = Bench(limits=Limits(workspace_min_m=(-1.2, -0.5, 0.05), workspace_max_m=(1.2, 1.2, 1.5)))
    b.world.q = np.array([1.5, -1.3, 1.6, -1.4, -1.4, 0.1])  # beyond y = -0.5
    plan = plan_of(("reference", "none", 0), poses={"reference": POSES["reference"]})
    refusal_of(DeviceError, r"outside the workspace.*drive it by hand", b.measure, plan)
    assert not {"arm.start_move", "arm.take_control", "operator.hang"} & set(b.world.calls)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"extra": np.array([130.0, 0, 0, 0, 0, 0])}, "max_force_N is 120"),
        ({"extra_speed": 2.5}, "joint_speed_rad_s is 2"),
        ({"safety": "protective stop"}, "protective stop"),
    ],
)
def test_limits_are_enforced_in_motion(change, said):
    """The limit is exceeded in the middle of the fourth motion: the arm stops within a look."""
    b = Bench(force_sensor=LIMIT)
    since = []

    def exceeds(still):
        if b.world.calls.count("arm.start_move") == 4 and still:
            for name, value in change.items():
                setattr(b.world, name, value)
            since.append(b.world.time)
        return still

    change_result(b.rig.arm, "moving", exceeds)
    refusal_of(DeviceError, said, b.measure)
    assert b.world.calls[-2:] == ["arm.stop", "store.event"]
    assert not b.world.is_moving
    assert b.world.time - since[0] <= 0.05
    assert said in b.store.last("failed")["reason"]


def test_limits_are_enforced_at_rest():
    b = Bench(force_sensor=LIMIT)

    def pushes():
        if len(b.store.rows) == 2:
            b.world.extra = np.array([0, 130.0, 0, 0, 0, 0])

    call_before(b.rig.tracker, "measure", pushes)
    refusal_of(DeviceError, "max_force_N", b.measure)
    assert len(b.store.rows) == 2
    assert b.world.calls[-2] == "arm.stop"


def test_an_arm_that_does_not_arrive(b):
    real = b.rig.arm.start_move

    def short(q, speed, acceleration):
        real(q - 0.002, speed, acceleration)

    b.rig.arm.start_move = short
    refusal_of(DeviceError, r"stands 0\.002 rad off", b.measure)


@pytest.mark.long
def test_a_motion_that_never_ends_is_given_up(b):
    b.rig.arm.moving = lambda: True
    refusal_of(DeviceError, "not finished after", b.measure)
    assert b.world.calls[-2] == "arm.stop"


def test_a_lost_target_is_found_again(b):
    b.world.unseen_measurements = (
        3  # at both stops of the approach, where nothing is read, and at the reading
    )
    readings = b.measure()
    assert len(readings) == len(FEW_POSES.steps)
    assert b.world.calls.count("tracker.find_target") == 1
    assert any("found again" in x for x in json.loads(b.store.rows[0][2])["remarks"])


@pytest.mark.parametrize("lost", [5, 1000])
def test_a_target_that_stays_lost_ends_the_run(b, lost):
    b.world.unseen_measurements, b.world.not_found = lost, 0 if lost == 5 else 1000
    refusal_of(DeviceError, r"line of sight.*--resume$", b.measure)
    assert b.store.rows == []
    assert b.world.calls.count("tracker.find_target") == 2
    assert b.world.calls[-2] == "arm.stop"


@pytest.mark.long
def test_a_pose_that_fails_twice_is_named_and_can_be_left_out(b):
    def hidden():
        if np.allclose(b.world.joints(), POSES["p2"]):
            b.world.unseen_measurements, b.world.not_found = 1000, 1000

    call_before(b.rig.tracker, "measure", hidden)
    for again in (False, True, True):
        said = refusal_of(DeviceError, r"line of sight.*--resume$", b.measure, usual_plan())
        assert ("It failed at p2 before, too: --skip p2 goes on without r" in said) == again
        b.world.restart()
        b.world.unseen_measurements = b.world.not_found = 0
    assert [s.pose for s, _, _ in b.store.rows] == ["reference", "p1"]
    plan = usual_plan()
    all_of_p1 = {s for s in plan.steps if s.pose == "p1"}
    refusal("'p1' cannot be left out: nothing", plan.skipping, ["p1"], all_of_p1, 3)
    moves = len(b.world.at_start)
    b.measure(plan.skipping(["p2"], b.store.done(), 3))
    steps = [s for s, _, _ in b.store.rows]
    assert set(steps) == {s for s in plan.steps if s.pose != "p2"}
    at = {tuple(q): name for name, q in POSES.items()}
    names = [at.get(tuple(q.tolist()), "beside") for q, _ in b.world.at_start[moves:]]
    # from the reference, where the session begins; across the gap the arm moves by it
    assert names[:4] == ["beside", "reference", "p3", "p4"]
    assert names[4:9] == ["reference", "p1", "reference", "p3", "p4"]


def test_a_reference_that_is_out_of_sight_for_good_locks_no_campaign(b):
    """A cabinet before the tracker: loads are changed there, and its drift is watched no more."""

    def hidden():
        lost = len(b.store.rows) > 2 and np.allclose(b.world.joints(), POSES["reference"])
        b.world.unseen_measurements = b.world.not_found = 1000 if lost else 0

    call_before(b.rig.tracker, "measure", hidden)
    call_before(b.rig.tracker, "find_target", hidden)
    for again in (False, True):
        said = refusal_of(DeviceError, r"line of sight.*--resume$", b.measure)
        b.world.restart()
        advice = "--skip reference goes on without readings there, and without watching drift"
        assert (advice in said) == again
    done = b.store.done()
    plan = FEW_POSES.skipping(["reference"], done, 3)
    b.measure(plan)
    assert b.store.done() == {s for s in FEW_POSES.steps if s.pose != "reference" or s in done}
    assert b.remarks("reference is read no more, as the operator has left it out")
    # where only returns are missing, the campaign is complete without them
    returns = {s for s in FEW_POSES.steps if s not in b.store.done()}
    rest = FEW_POSES.skipping(["reference"], b.store.done(), 3)
    assert returns
    assert not rest.without(b.store.done()).steps
    assert len(joined(FEW_POSES, b.store.done(), rest).steps) == len(b.store.rows)


def test_readings_that_were_drawn_are_not_gone_on_with(b):
    b.interrupt(stored=2)
    b.store.rows = [(step, reading, '{"drawn": true}') for step, reading, _ in b.store.rows]
    refusal("were drawn, not measured on devices: measure into another", b.measure)


def test_limits_that_leave_out_the_reference_are_to_be_put_back(b):
    """Where it cannot be left out, --skip is no advice."""
    b.interrupt(stored=4)
    limits = Limits(workspace_min_m=(-0.7, -1.2, 0.05), workspace_max_m=(1.2, 1.2, 1.5))
    b.config = b.config.model_copy(update={"limits": limits})
    refusal("goes to reference, which --skip cannot leave out: put back", b.measure)
    assert "arm.start_move" not in b.world.calls


def test_limits_that_were_narrowed_meanwhile_do_not_lock_a_campaign(b):
    b.interrupt(4, usual_plan())  # p2, which reaches farthest in y, is measured without a load
    limits = Limits(workspace_min_m=(-1.2, -1.2, 0.05), workspace_max_m=(1.2, 0.3, 1.5))
    b.config = b.config.model_copy(update={"limits": limits})
    done, plan = b.store.done(), usual_plan()
    refusal("p2.*ends at 0.3 m.*--skip POSE leaves a pose out", b.measure, usual_plan())
    assert "arm.start_move" not in b.world.calls
    b.measure(replace(plan, steps=(*done, *plan.skipping(["p2"], done, 3).steps)))
    assert {s for s in plan.steps if s.pose != "p2"} < b.store.done()


def test_limits_that_were_narrowed_before_the_first_reading_lock_no_campaign(b):
    """As of a validation, whose plan was made and checked before."""
    limits = Limits(workspace_min_m=(-1.2, -1.2, 0.05), workspace_max_m=(1.2, 0.3, 1.5))
    b.config = b.config.model_copy(update={"limits": limits})
    refusal("p2.*ends at 0.3 m.*--skip POSE leaves a pose out", b.measure, usual_plan())
    assert b.world.calls == []


def test_another_reflector_is_not_believed(b):
    def other(*_):
        if len(b.store.rows) == 5:
            b.world.shift = np.array([0.0, 0.3, 0.0])

    call_before(b.store, "event", other)
    refusal_of(DeviceError, "another reflector", b.measure)
    assert len(b.store.rows) == 5


def test_readings_that_drift_are_waited_for_and_given_up():
    b = Bench(acquire=Acquire(samples=3, settle_s=0.2, settle_timeout_s=20.0))
    b.world.creep = 1e-3
    begun = b.world.time
    refusal_of(DeviceError, "not settled within 20 s: readings drift", b.measure)
    assert b.store.rows == []
    assert b.world.time - begun < 120.0


@pytest.mark.long
def test_drift_that_ends_is_waited_for():
    b, few = Bench(), plan_of(("p1", "none", 0), ("p2", "none", 0), ("p2", "3kg", 0))
    arrived = {}

    def settles(place):
        """The target comes to rest with a time constant of 0.5 s after each arrival."""
        since = arrived.setdefault((*b.world.joints(), len(b.world.at_start)), b.world.time)
        return place + 1e-3 * np.exp(-(b.world.time - since) / 0.5)

    change_result(b.world, "position", settles)
    b.measure(few)
    stored = b.notes.of_kind(ReadingStored)
    assert min(t.settling for t in stored) > 1.0
    quiet = Bench()
    quiet.measure(few)
    assert max(t.settling for t in quiet.notes.of_kind(ReadingStored)) < 1.0
    away = b.store.readings().value - quiet.store.readings().value
    assert np.abs(away).max() < 6 * STD


def test_an_arm_that_trembles_is_measured_again_and_given_up(b):
    b.world.jitter = 1e-4
    refusal_of(DeviceError, r"measured 3 times without success: arm: .* moved by", b.measure)
    assert b.store.rows == []


def test_at_least_twenty_frames_whatever_the_clock():
    """The window of a fast clock is too short for a real line of 100 Hz."""
    b = Bench(acquire=Acquire(samples=3, settle_s=0.2, force_window_s=0.05))
    b.measure(plan_of(("p1", "none", 0), ("p2", "none", 0)))
    assert all(json.loads(text)["force"]["frames"] >= 20 for _, _, text in b.store.rows)
    assert b.world.calls.count("force.average") == 2 + 4  # the first one was too short


@pytest.mark.parametrize("scale", [1.0, 20.0])
def test_everything_is_looked_at_twenty_times_a_second_in_motion(b, scale):
    """Real seconds: a fast world's motions are short, and looked at as often as others."""
    b.world.hurry = 1.0
    b.clock = FakeClock(scale=scale, world=b.world)
    gaps = {"arm.moving": 0.0, "arm.sample": 0.0, "force.latest": 0.0}
    last = {}
    looks = 0

    def noted(name):
        nonlocal looks
        if name in gaps and b.world.is_moving:
            looks += 1
            since = last.get(name, b.world.motion_start)
            gaps[name] = max(gaps[name], (b.world.time - since) / scale)
            last[name] = b.world.time
        elif name == "arm.start_move":
            last.clear()

    call_before(b.world, "call", noted)
    b.measure(plan_of(("p1", "none", 0), ("p1", "3kg", 0)))
    assert looks > 30
    assert max(gaps.values()) <= 0.05, gaps
