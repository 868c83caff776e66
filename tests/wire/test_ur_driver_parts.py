"""Parts of the UR driver: times of motions, damaged readings, words."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.drivers.simulated.ur_state import line
from hilcal.drivers.ur_link import states
from hilcal.drivers.ur_link.control import MARGIN_S, MotionInProgress, deceleration, program_ended
from hilcal.drivers.ur_link.reading import OUTPUTS, N, ReadingError, read, settled_rate
from hilcal.drivers.ur_link.worker import Worker, WorkerError
from hilcal.measuring.route import duration

FIELDS = {
    **{name: [0.1 * k for k in range(6)] for name in OUTPUTS},
    **{"timestamp": 3.0, "robot_mode": 7, "runtime_state": 2, "safety_status_bits": 1},
    **{"speed_scaling": 0.5, "target_speed_fraction": 0.5, "payload": 1.0},
    "payload_cog": [0.0, 0.0, 0.1],
}


@given(
    distance=st.floats(1e-4, 6.0), speed=st.floats(0.01, 3.0), acceleration=st.floats(0.01, 40.0)
)
def test_time_of_a_motion_is_that_of_the_simulated_controller(distance, speed, acceleration):
    goal = np.zeros(N)
    goal[3] = -distance
    segment = line(np.zeros(N), goal, speed, acceleration)
    assert duration(np.zeros(N), goal, speed, acceleration) == pytest.approx(
        segment.duration, rel=1e-9
    )


@given(speed=st.floats(0.01, 2.0))
def test_every_speed_is_braked_in_time(speed):
    assert speed / deceleration(speed) <= 0.2


def reading(**changes):
    return read({"host_ns": 1, "fields": {**FIELDS, **changes}})


def test_slider_and_scaling_multiply():
    assert reading().sample.speed_scaling == 0.25


@pytest.mark.parametrize(
    "changes",
    [
        {"actual_q": [0.0, 0.0, np.nan, 0.0, 0.0, 0.0]},
        {"actual_qd": [0.0] * 5},
        {"target_q": []},
        {"payload": np.inf},
        {"timestamp": np.nan},
    ],
)
def test_damaged_readings_are_refused(changes):
    reading()
    with pytest.raises(ReadingError, match=next(iter(changes))):
        reading(**changes)


def test_gravest_safety_state_comes_first():
    assert states.safety_word(1) == states.NORMAL
    assert states.safety_word(1 << 2 | 1 << 10) == "protective stop"
    assert states.safety_word(1 << 6 | 1 << 7 | 1 << 10) == "emergency stop of the robot"
    assert states.safety_advice(1) == ""
    for bit in range(1, 11):
        assert states.safety_word(1 | 1 << bit) != states.NORMAL
        assert states.safety_advice(1 << bit)


def test_motion_is_overdue_only_after_its_time_and_margin(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    goal = np.full(N, 1.0)
    at_rest = reading(actual_qd=[0.0] * 6, speed_scaling=1.0, target_speed_fraction=1.0)
    motion = MotionInProgress(np.zeros(N), goal, 0.5, 0.5, 5e-4, clock=1.0)  # takes 3 s
    now[0] += 1.5 * 3.0 + MARGIN_S - 0.01
    assert motion.overdue(at_rest) is None
    now[0] += 0.02
    assert "joint 1 stands 1 rad off" in motion.overdue(at_rest)
    assert not motion.arrived(at_rest)
    there = reading(actual_qd=[0.0] * 6, actual_q=goal + 4e-4, target_q=goal)
    assert motion.arrived(there)
    assert not motion.arrived(reading(actual_qd=[0.0] * 6, actual_q=goal + 6e-4, target_q=goal))
    assert not motion.arrived(reading(actual_qd=[0.02] * 6, actual_q=goal, target_q=goal))


def test_a_pause_that_the_watchdog_bears_does_not_hide_another_program():
    stopped = reading(runtime_state=states.STOPPED)
    for late in (0.0, 0.09):
        assert "another program" in program_ended(stopped, late)
    assert "too busy for 0.09 s" in program_ended(stopped, 0.09)
    assert "another program" not in program_ended(stopped, 0.2)


def test_worker_that_cannot_start_says_so():
    with pytest.raises(WorkerError, match="exit code 1"):
        Worker("hilcal.drivers.ur_link.no_such_worker", (), 10.0)


def test_a_moment_without_packets_is_no_slow_line() -> None:
    """A busy computer loses some tenths of a second; a slow network stays slow."""
    counted: list[float] = []

    def count(seconds: float, *rates: float) -> float:
        counted.append(seconds)
        return rates[len(counted) - 1]

    assert settled_rate(lambda s: count(s, 124.0), 125.0) == 124.0
    assert len(counted) == 1
    counted.clear()
    assert settled_rate(lambda s: count(s, 44.0, 125.0), 125.0) == 125.0
    assert counted[1] > counted[0]
    counted.clear()
    assert settled_rate(lambda s: count(s, 44.0, 45.0), 125.0) == 45.0
