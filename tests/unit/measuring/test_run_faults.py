"""A campaign under a fault at any call of any device: each reading exactly once, arm stopped."""

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hilcal.cell import Cell
from hilcal.config import Limits
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.arrival import RoughRegistration
from hilcal.measuring.run import HOW_ON, run
from hilcal.robot import chain as chains
from hilcal.robot.catalogue import configs_dir
from hilcal.store.plan import Plan, Step
from tests.support.fake_bench import Bench, plan_of
from tests.support.fake_world import Killed
from tests.support.rows import first

FAULTS = (
    DeviceError("arm: the line is dead"),
    KeyboardInterrupt(),
    Killed(),
    OSError(5, "Input/output error"),
)


def small_plan() -> Plan:
    """Every kind of motion and change of load, in few calls."""
    return plan_of(
        ("reference", "none", 0),
        ("p1", "none", 0),
        ("p1", "none", 1),
        ("p1", "3kg", 0),
        ("reference", "none", 1),
    )


def bench() -> Bench:
    return Bench(limits=Limits())


def measure(b: Bench, plan: Plan) -> None:
    run(b.rig, b.cell, b.config, plan, b.store, b.clock, b.notes)


def each_once(b: Bench, plan: Plan) -> bool:
    return Counter(step for step, _, _ in b.store.rows) == Counter(plan.steps)


@cache
def calls_of_a_whole_run() -> int:
    b = bench()
    measure(b, small_plan())
    assert each_once(b, small_plan())
    return len(b.world.calls)


KINDS = range(len(FAULTS))
IDS = [type(f).__name__ for f in FAULTS]


@pytest.mark.parametrize("kind", first(1, KINDS), ids=IDS)
def test_fault_at_some_calls(kind: int) -> None:
    """Every 97th call, other ones for each kind of fault; all of them in the slow suite."""
    for k in range(1 + 10 * kind, calls_of_a_whole_run() + 1, 97):
        check_fault(FAULTS[kind], k)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=IDS)
def test_fault_at_every_call(kind: int) -> None:
    for k in range(1, calls_of_a_whole_run() + 1):
        check_fault(FAULTS[kind], k)


def check_fault(fault: BaseException, k: int) -> None:
    """Fail at the k-th call, look what was done about it, resume, and count."""
    b, plan = bench(), small_plan()
    if isinstance(fault, Killed):
        b.world.kill_at = k
    else:
        b.world.fail[k] = fault
    expected = DeviceError if isinstance(fault, OSError) else type(fault)
    with pytest.raises(expected) as raised:
        measure(b, plan)
    if isinstance(raised.value, DeviceError):
        said = str(raised.value)
        assert said.endswith(HOW_ON), (k, said)
        assert "\n" not in said
    check_stopped(b, k)
    before = [step for step, _, _ in b.store.rows]
    b.world.again()
    measure(b, plan)
    assert [step for step, _, _ in b.store.rows][: len(before)] == before
    assert each_once(b, plan), k
    readings = b.store.readings()
    assert readings is not None
    assert readings.states.time is not None
    assert np.all(np.diff(readings.states.time) > 0), k


def check_stopped(b: Bench, k: int) -> None:
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


def test_disk_full_stops_the_arm_and_says_what_to_do() -> None:
    b, plan = bench(), small_plan()
    b.store.full_at = 2
    with pytest.raises(DeviceError, match=r"disk is full.*--resume$"):
        measure(b, plan)
    assert b.world.calls[-2:] == ["arm.stop", "store.event"]
    assert len(b.store.rows) == 2
    b.store.full_at = None
    b.world.again()
    measure(b, plan)
    assert each_once(b, plan)


def test_a_refused_row_keeps_its_kind_of_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the store refuses as wrong input stays that (exit code 2), and stops the arm."""
    b = bench()

    def refuse(*_: object) -> None:
        raise InputError("run.hilcal: the readings differ from those before")

    monkeypatch.setattr(b.store, "record", refuse)
    with pytest.raises(InputError, match=r"differ from those before\. .*--resume$"):
        measure(b, small_plan())
    assert b.world.calls[-2] == "arm.stop"


def test_an_arm_that_does_not_stop_is_told_loudly(monkeypatch: pytest.MonkeyPatch) -> None:
    b = bench()

    def stop() -> None:
        raise DeviceError("arm: no answer to stop")

    monkeypatch.setattr(b.rig.arm, "stop", stop)
    b.world.fail[120] = KeyboardInterrupt()
    with pytest.raises(DeviceError, match=r"THE ARM MAY STILL MOVE.*no answer.*emergency stop"):
        measure(b, small_plan())
    assert b.store.last("interrupted")["arm_not_stopped"] == "arm: no answer to stop"


def test_an_error_that_asks_for_the_emergency_stop_asks_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    b = bench()

    def stop() -> None:
        raise DeviceError("arm: not sure that it stands: press the emergency stop if it moves")

    monkeypatch.setattr(b.rig.arm, "stop", stop)
    b.world.fail[120] = DeviceError("arm: its link broke; press the emergency stop. Unplugged?")
    with pytest.raises(DeviceError) as raised:
        measure(b, small_plan())
    said = str(raised.value)
    assert said.count("emergency stop") == 1
    assert said.endswith(f"Unplugged? {HOW_ON}")


def test_impatience_does_not_keep_the_arm_from_stopping(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while the arm is being stopped: it is stopped again."""
    b = bench()
    stops = []
    real = b.rig.arm.stop

    def stop() -> None:
        stops.append(1)
        if len(stops) == 1:
            raise KeyboardInterrupt
        real()

    monkeypatch.setattr(b.rig.arm, "stop", stop)
    b.world.fail[120] = DeviceError("tracker: silent")
    with pytest.raises(DeviceError, match=r"tracker: silent.*--resume$"):
        measure(b, small_plan())
    assert len(stops) == 2
    assert not b.world.is_moving


def test_unexpected_errors_are_one_line_and_their_trace_is_stored() -> None:
    b = bench()
    b.world.fail[150] = ZeroDivisionError("of a driver of somebody else's")
    with pytest.raises(DeviceError, match=r"unexpected ZeroDivisionError: of a driver.*--resume"):
        measure(b, small_plan())
    assert "Traceback" in b.store.last("failed")["trace"]


def test_nothing_is_stopped_before_the_arm_is_ours() -> None:
    """A fault before `take_control`: somebody else's program may be running."""
    b = bench()
    b.world.fail[2] = DeviceError("force sensor: silent")
    with pytest.raises(DeviceError, match="silent"):
        measure(b, small_plan())
    assert "arm.take_control" not in b.world.calls
    assert "arm.stop" not in b.world.calls


def test_another_reflector_is_noticed_before_the_registration_is_known() -> None:
    """By distances from two readings that agree; one alone may be the one that is wrong."""
    cell = Cell.load(configs_dir() / "cells" / "demo_ur10e.toml")
    cell = replace(cell, registration_known=False, target_known=True)
    rng = np.random.default_rng(0)
    noticed = 0
    for _ in range(40):
        known = RoughRegistration(cell)
        joints = np.array([0.0, -1.2, 1.4, -1.7, -1.5, 0.0]) + rng.uniform(-0.5, 0.5, (3, 6))
        chain = chains.evaluate(cell.arm, joints)
        places = chain.point(cell.target[:3, 3]) @ cell.registration[:3, :3].T
        known.add(joints[0], places[0])
        stray = places[1] + 0.3 * rng.standard_normal(3)
        assert known.implausible(joints[1], stray) is None  # a run must not end by that
        known.add(joints[1], places[1])
        assert known.implausible(joints[2], places[2]) is None
        stray = places[2] + 0.3 * rng.standard_normal(3)
        told = known.implausible(joints[2], stray)
        noticed += told is not None
        assert told is None or "does it follow another reflector" in told
    assert noticed > 25


def test_a_reading_of_another_reflector_is_told_as_soon_as_the_tracker_has_its_place() -> None:
    """0.2 m off on the sphere about the first position, where distances cannot tell it."""
    cell = Cell.load(configs_dir() / "cells" / "demo_ur10e.toml")
    cell = replace(cell, registration_known=False, target_known=True)
    rng = np.random.default_rng(3)
    for _ in range(10):
        known = RoughRegistration(cell)
        joints = np.array([0.0, -1.2, 1.4, -1.7, -1.5, 0.0]) + rng.uniform(-0.7, 0.7, (9, 6))
        chain = chains.evaluate(cell.arm, joints)
        places = chain.point(cell.target[:3, 3]) @ cell.registration[:3, :3].T
        way = places[1] - places[0]
        aside = np.cross(way, rng.standard_normal(3))
        stray = places[1] + 0.25 * aside / np.linalg.norm(aside)
        told = []
        for k, q in enumerate(joints):
            known.add(q, stray if k == 1 else places[k], step=Step(f"p{k}", "none"))
            told += [str(step) for step, _ in known.late_doubts()]
        assert told == ["p1, none, cycle 0"]
        pose = known.pose()
        assert pose is not None
        assert np.allclose(pose[0], cell.registration[:3, :3], atol=1e-9)


@pytest.mark.parametrize(("known", "off_m"), [(False, 0.15), (True, 0.03)])
def test_a_target_that_is_not_where_it_is_said_refuses_no_reading(
    known: bool, off_m: float
) -> None:
    """Its place is estimated later, or was measured with a ruler."""
    cell = Cell.load(configs_dir() / "cells" / "demo_ur10e.toml")
    cell = replace(cell, registration_known=False, target_known=known)
    joints = np.array([0.0, -1.2, 1.4, -1.7, -1.5, 0.0])
    joints = joints + np.random.default_rng(1).uniform(-0.7, 0.7, (40, 6))
    chain = chains.evaluate(cell.arm, joints)
    places = chain.point(cell.target[:3, 3] + [off_m, 0.0, 0.0]) @ cell.registration[:3, :3].T
    rough = RoughRegistration(cell)
    for k, (q, x) in enumerate(zip(joints, places, strict=True)):
        assert rough.implausible(q, x) is None
        rough.add(q, x, step=Step(f"p{k}", "none"))
        assert rough.late_doubts() == []
    assert rough.pose() is not None
