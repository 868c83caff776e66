"""Loads that are hung, weighed and mistaken; and a campaign that goes on after a stop."""

import json
from typing import Any

import numpy as np
import pytest

from hilcal.errors import DeviceError
from hilcal.measuring.progress import Phase, Remark
from hilcal.store.plan import Step
from tests.support.fake_bench import POSES, Bench, plan_of, usual_plan
from tests.support.fake_world import Killed
from tests.support.run_cases import measure, rows

# loads


def test_a_wrong_load_is_asked_for_again_with_the_reason() -> None:
    b = Bench()
    b.world.wrong = ["none", "6kg"]  # the first answer is that to "take everything off"
    readings = measure(b)
    assert len(readings) == len(usual_plan().steps)
    asked = b.operator.asked
    assert [name for name, _ in asked[:3]] == ["none", "3kg", "3kg"]
    assert asked[1][1] == ""
    assert "6.0 kg" in asked[2][1]
    assert any("asked to hang 3kg" in note.text for note in b.notes.of(Remark))


@pytest.mark.long
def test_three_wrong_loads_end_the_run() -> None:
    b = Bench()
    b.world.wrong = ["none", "6kg", "none", "6kg"]
    with pytest.raises(DeviceError, match=r"asked 3 times to hang 3kg.*--resume$"):
        measure(b)
    assert len(b.store.rows) == 5
    assert b.world.calls[-2] == "arm.stop"
    b.world.again()
    assert len(measure(b)) == len(usual_plan().steps)


def test_a_load_that_is_not_taken_off_is_noticed() -> None:
    b = Bench()
    b.world.wrong = ["none", "3kg", "3kg"]
    measure(b)
    names = [name for name, _ in b.operator.asked]
    assert names == ["none", "3kg", "none", "none", "pull", "none"]
    assert "3.0 kg still hangs" in b.operator.asked[3][1]


@pytest.mark.long
def test_a_swinging_load_is_weighed_twice() -> None:
    b = Bench()
    real = b.rig.force
    assert real is not None
    average, times = real.average, []

    def swinging(seconds: float) -> Any:
        times.append(b.world.time)
        b.world.extra = np.zeros(6)
        if b.world.load == "3kg" and len(b.operator.asked) == 2 and len(b.store.rows) == 5:
            swings = len([t for t in times if t > b.world.time - 10.0]) == 1
            b.world.extra[0] = 8.0 if swings else 0.0
        return average(seconds)

    real.average = swinging  # type: ignore[method-assign]
    measure(b)
    assert [name for name, _ in b.operator.asked] == ["none", "3kg", "none", "pull", "none"]


def test_without_a_force_sensor_the_person_is_believed() -> None:
    b = Bench(force_sensor=None)
    b.world.wrong = ["none", "6kg"]
    readings = measure(b)
    assert len(readings) == len(usual_plan().steps)
    assert np.allclose(readings.states.wrench[rows(readings, "pull")], [40.0, 0, 0, 0, 0, 0])
    assert json.loads(b.store.rows[0][2])["force"] is None


def test_the_tool_is_identified_and_compared_with_the_configuration() -> None:
    b = Bench()
    b.world.tool_mass = 1.4
    measure(b)
    assert b.store.kinds().index("tool") < b.store.kinds().index("load")
    tool = b.store.last("tool")
    assert tool["mass_kg"] == pytest.approx(1.4, abs=1e-6)
    assert tool["com_m"] == pytest.approx([0.01, 0.0, 0.06], abs=1e-6)
    assert any("[tool] says 0.8 kg" in note.text for note in b.notes.of(Remark))


def test_unloaded_poses_that_do_not_tell_the_tool_are_no_failure() -> None:
    """Turned about the vertical only: gravity never turns in the sensor."""
    b = Bench()
    poses = {f"p{k}": (0.2 * k, *POSES["reference"][1:]) for k in range(4)}
    plan = plan_of(
        *((p, load, 0) for load in ("none", "3kg") for p in poses),
        poses={"reference": POSES["reference"], **poses},
    )
    assert len(measure(b, plan)) == 8
    assert any("not identified" in note.text for note in b.notes.of(Remark))


# going on


def test_resume_measures_exactly_what_is_missing_and_time_goes_on() -> None:
    b, plan = Bench(), usual_plan()
    b.world.kill_after = ("store.recorded", 7)
    day = [1000.0]

    def wall() -> float:
        return day[0] + b.world.time

    with pytest.raises(Killed):
        measure(b, plan, wall=wall)
    before = [step for step, _, _ in b.store.rows]
    assert 5 < len(before) < len(plan.steps)
    b.world.again()
    day[0] += 7200.0  # two hours later
    loads = len(b.operator.asked)
    readings = measure(b, plan, wall=wall)
    assert [s for s, _, _ in b.store.rows] == list(plan.steps)
    assert readings.states.time is not None
    gaps = np.diff(readings.states.time)
    assert gaps[len(before) - 1] > 7200.0
    assert gaps[len(before) - 1] < 7200.0 + 120.0
    assert np.all(np.delete(gaps, len(before) - 1) < 60.0)
    asked = [name for name, _ in b.operator.asked[loads:]]
    assert asked[0] == "none"  # nobody knows what hangs
    assert asked[1] == plan.steps[len(before)].load == "3kg"


@pytest.mark.long
def test_time_never_goes_back_whatever_the_clock_on_the_wall_does() -> None:
    b, plan = Bench(), usual_plan()
    b.world.kill_after = ("store.recorded", 4)
    with pytest.raises(Killed):
        measure(b, plan, wall=lambda: 5000.0 + b.world.time)
    b.world.again()
    readings = measure(b, plan, wall=lambda: 1000.0 + b.world.time)
    assert readings.states.time is not None
    assert np.all(np.diff(readings.states.time) > 0)


@pytest.mark.long
def test_a_load_that_still_hangs_at_a_resume_is_noticed() -> None:
    b, plan = Bench(), usual_plan()
    b.world.kill_after = ("store.recorded", 7)
    with pytest.raises(Killed):
        measure(b, plan)
    assert b.world.load == "3kg"
    b.world.again()
    b.world.wrong = ["3kg"]  # the first answer is wrong
    b.world.offset = b.world.offset + np.array(
        [2.0, 2.0, -2.0, 0, 0, 0]
    )  # the sensor was off meanwhile
    seen = len(b.operator.asked)
    measure(b, plan)
    asked = b.operator.asked[seen:]
    assert [name for name, _ in asked[:3]] == ["none", "none", "3kg"]
    assert "3kg seems to hang still" in asked[1][1]
    assert [s for s, _, _ in b.store.rows] == list(plan.steps)


def test_a_load_left_on_at_the_very_beginning_is_asked_about_said_and_found_in_motion() -> None:
    b = Bench()
    b.world.load, b.world.wrong = "3kg", ["3kg", "3kg"]  # both answers are wrong
    with pytest.raises(DeviceError, match="take everything off"):
        measure(b)
    assert any("answered twice that nothing hangs" in note.text for note in b.notes.of(Remark))
    # where gravity has not turned in the sensor since its tare, a load is a zero
    assert {step for step, *_ in b.store.rows} <= {Step("reference", "none", 0)}


def test_a_finished_campaign_touches_nothing() -> None:
    b = Bench()
    measure(b)
    b.world.calls.clear()
    measure(b)
    assert b.world.calls == []
    assert b.notes.of(Phase)[-1].text == "nothing is missing"


@pytest.mark.long
def test_the_tool_is_known_from_an_earlier_session_after_the_sensor_was_off() -> None:
    """Another bias in the second session: the pulls are measured right nevertheless."""
    b, plan = Bench(), usual_plan()
    b.world.tool_mass = 1.4
    b.world.kill_after = ("store.recorded", 7)
    with pytest.raises(Killed):
        measure(b, plan)
    b.world.again()
    b.world.offset = -b.world.offset
    readings = measure(b, plan)
    assert np.allclose(
        readings.states.wrench[rows(readings, "pull")], [40.0, 0, 0, 0, 0, 0], atol=1e-6
    )
