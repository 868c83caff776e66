"""The simulated controller's trajectory, kinematics and script port, without a process."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from hilcal.drivers.simulated.ur_programs import ScriptStream
from hilcal.drivers.simulated.ur_state import GRAVITY, Kinematics, Trajectory, line
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate

GOAL = np.array([1.0, -0.5, 0.0, 0.2, 0.0, -1.5])
vectors = some.lists(some.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array)


def trajectory():
    return Trajectory(np.zeros(6), np.ones(6), 5, 100.0)


@given(vectors, some.floats(0.01, 2.0), some.floats(0.01, 10.0))
def test_speed_is_the_derivative_and_limits_hold(goal, speed, acceleration):
    segment = line(np.zeros(6), goal, speed, acceleration)
    if segment is None:
        assert np.max(np.abs(goal)) < 1e-9
        return
    assert segment.length == pytest.approx(np.max(np.abs(goal)), rel=1e-9)
    times = np.linspace(0.0, segment.duration, 2001)
    way, rate = np.array([segment.at(t) for t in times]).T
    assert rate.max() <= speed * (1 + 1e-9)
    assert rate[0] == 0.0
    assert rate[-1] == pytest.approx(0.0, abs=1e-9 * (1 + rate.max()))
    step = times[1] - times[0]
    corner = 0.25 * acceleration * step**2 + 1e-12  # what a trapezium misses where ramps end
    np.testing.assert_allclose(
        np.diff(way), 0.5 * step * (rate[1:] + rate[:-1]), rtol=0.0, atol=corner
    )
    assert np.max(np.abs(np.diff(rate))) <= acceleration * step * (1 + 1e-6) + 1e-12


@pytest.mark.parametrize("when", [0.2, 1.5, 3.1, 3.45])
def test_stop_is_smooth_and_stays_on_the_line(when):
    path = trajectory()
    path.start(GOAL, 0.5, 1.0, 100.0)
    path.advance(100.0 + when)
    speed, q = np.max(np.abs(path.qd)), path.q.copy()
    path.stop(2.0, 100.0 + when)
    assert path.moving
    path.advance(100.0 + when + 1e-6)
    assert np.max(np.abs(path.qd)) == pytest.approx(speed, rel=1e-3)
    path.advance(104.0)
    assert not path.moving
    assert path.arrivals == 6
    rest = path.rest_time - 100.0 - when
    assert rest <= speed / 2.0 + 1e-9
    np.testing.assert_allclose(path.q - q, GOAL / 1.5 * 0.5 * speed * rest, atol=1e-9)
    assert np.all(np.abs(path.q) <= np.abs(GOAL) + 1e-12)


def test_slider_slows_and_holds():
    path = trajectory()
    path.start(GOAL, 0.5, 1.0, 100.0)
    path.advance(101.0)
    path.rate = 0.5
    path.advance(101.1)
    assert np.max(np.abs(path.qd)) == pytest.approx(0.25)
    path.rate = 0.0
    path.advance(150.0)
    held = path.q.copy()
    assert path.moving
    assert path.left == float("inf")
    assert np.all(path.qd == 0.0)
    path.stop(1.0, 151.0)
    assert not path.moving
    np.testing.assert_array_equal(path.q, held)


def test_jacobian_and_weight_are_derivatives():
    kinematics = Kinematics(load_arm("ur10e"))
    arm = kinematics.arm
    rng = np.random.default_rng(2)
    q, com, mass, h = rng.uniform(-2, 2, 6), np.array([0.05, -0.1, 0.2]), 4.0, 1e-6

    def tip(q):
        place = kinematics.flange(q)
        return place[:3, 3] + place[:3, :3] @ com

    def energy(q):
        """Work of gravity, J."""
        centres = evaluate(arm, q[None]).com[:, 0]
        return arm.masses @ centres @ GRAVITY + mass * GRAVITY @ tip(q)

    steps = h * np.eye(6)
    numeric = np.array([(tip(q + s) - tip(q - s)) / (2 * h) for s in steps]).T
    np.testing.assert_allclose(kinematics.jacobian(q, tip(q))[:3], numeric, atol=1e-8)
    work = [(energy(q + s) - energy(q - s)) / (2 * h) for s in steps]
    np.testing.assert_allclose(kinematics.weight_torque(q, mass, com), work, atol=1e-6)


def test_script_port_cuts_programs_and_lines():
    text = "stopj(2.0)\ndef a():\n  def b():\n    x = 1\n  end\nend\n\nsec c():\n  y = 2\nend\nd()"
    stream = ScriptStream()
    programs = [p for k in range(0, len(text), 3) for p in stream.feed(text[k : k + 3].encode())]
    assert [p.split("\n")[0] for p in programs] == ["stopj(2.0)", "def a():", "sec c():"]
    assert programs[1].endswith("  end\nend")
    assert list(stream.feed(b"\r\n")) == ["d()"]
