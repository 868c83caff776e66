"""The UR driver on a simulated controller: connecting, state, payload, motion, stop, end."""

import time
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest

from hilcal.drivers.simulated.cell_processes import free_host
from hilcal.drivers.ur import open_arm
from hilcal.drivers.ur_link.control import Control
from hilcal.drivers.ur_link.reading import Receiver
from hilcal.drivers.ur_link.states import safety_word
from hilcal.drivers.ur_link.worker import WorkerError
from hilcal.errors import DeviceError, InputError
from tests.support import ur_driver_cases as cases
from tests.support.ur_driver_cases import arm, sim

__all__ = ["arm", "sim"]  # fixtures


def test_opening_and_report_move_nothing_and_upload_nothing(sim):
    before = sim.admin()
    with closing(open_arm(cases.config(sim.host))) as arm:
        report = arm.report()
        facts = dict(report.facts)
        assert "UR10e" in report.name
        assert "20235500001" in report.name
        assert facts["controller version"] == cases.GENERATIONS[sim.is_x]
        assert facts["robot mode"] == "running"
        assert facts["safety"] == "normal"
        assert facts["remote control"] == "yes"
        assert "°C" in facts["joint temperatures"]
        assert facts["RTDE rate"].endswith("of 125 Hz")
        # A busy machine sends late, which the report rightly says.
        assert [problem for problem in report.problems if "RTDE comes at" not in problem] == []
        sample = arm.sample()
        np.testing.assert_allclose(sample.q, before["q"], atol=1e-4)
        np.testing.assert_array_equal(sample.q_target, before["q"])
        assert sample.safety == "normal"
        assert sample.ft_raw_wrench.shape == (6,)
        assert abs(sample.host_ns - time.monotonic_ns()) < 1e9
        assert arm.sample().timestamp > sample.timestamp
    after = sim.admin()
    assert after["q"] == before["q"]
    assert after["scripts"] == before["scripts"]


@pytest.fixture
def put_right(sim):
    """After the test there is no fault."""
    yield
    cases.restore(sim)


@pytest.mark.usefixtures("put_right")
def test_report_names_everything_that_hinders_a_run(sim):
    with closing(open_arm(cases.config(sim.host, model="ur5e"))) as arm:
        sim.admin("local_mode")
        sim.admin("emergency_stop")
        problems = " | ".join(arm.report().problems)
        for words in ("local mode", 'model = "ur5e"', "emergency stop", "switch the robot on"):
            assert words in problems
        with pytest.raises(DeviceError, match="emergency stop"):
            arm.take_control(1.0, np.zeros(3))
        sim.admin("release_emergency_stop")
        with pytest.raises(DeviceError, match=r"not running \(power off\)"):
            arm.take_control(1.0, np.zeros(3))


def test_bad_goals_are_refused_before_anything_moves(arm, sim):
    q = arm.sample().q
    for goal in (q[:5], np.append(q, 0.0), np.where(np.arange(6) == 2, np.nan, q), q + 10.0):
        with pytest.raises(InputError, match="goal"):
            arm.start_move(goal, 0.5, 0.5)
    for speed, acceleration in ((0.0, 1.0), (-1.0, 1.0), (np.inf, 1.0), (0.5, 0.0), (0.5, np.nan)):
        with pytest.raises(InputError, match="not valid"):
            arm.start_move(q, speed, acceleration)
    assert not sim.admin()["moving"]
    assert arm.moving() is False


@pytest.mark.parametrize(
    ("bits", "mode", "says"),
    [(1 << 2, 7, "protective stop"), (1, 5, r"not running \(idle \(brakes on\)\); switch it")],
)
def test_an_arm_whose_safety_or_mode_is_not_normal_is_not_moved(
    bits, mode, says, arm, sim, monkeypatch
):
    """Also where its program still plays."""
    read = Receiver.read

    def told(receiver, *seconds):
        reading = read(receiver, *seconds)
        sample = replace(reading.sample, safety=safety_word(bits, mode))
        return replace(reading, sample=sample, mode=mode, safety_bits=bits)

    before = sim.admin()["q"]
    goal = cases.displaced_joints(arm)
    monkeypatch.setattr(Receiver, "read", told)
    with pytest.raises(DeviceError, match=says):
        arm.start_move(goal, cases.SPEED, cases.ACCELERATION)
    assert sim.admin()["q"] == before


def test_payload_is_set_also_with_its_centre_at_the_flange(arm, sim):
    state = sim.admin()
    assert state["payload"] == cases.MASS
    np.testing.assert_array_equal(state["payload_com"], cases.COM)
    arm.set_payload(1.25, np.zeros(3))
    state = sim.admin()
    assert state["payload"] == 1.25
    np.testing.assert_allclose(state["payload_com"], 0.0, atol=1e-5)
    sample = arm.sample()
    assert sample.payload == 1.25
    np.testing.assert_allclose(sample.payload_com, 0.0, atol=1e-5)
    for mass, com in ((-1.0, np.zeros(3)), (np.nan, np.zeros(3)), (1.0, np.zeros(2))):
        with pytest.raises(InputError, match="payload"):
            arm.set_payload(mass, com)


@pytest.mark.parametrize(
    ("op", "says"),
    [
        (None, r"it reports 2\.5 kg at .* after a payload of 4 kg"),
        ("local_mode", "it was switched to local mode; switch it to remote control"),
        ("kill_script", "it did not take the payload: its program is stopped"),
    ],
)
def test_payload_that_the_controller_does_not_take_is_told_by_its_cause(
    op, says, arm, sim, monkeypatch
):
    monkeypatch.setattr(Control, "set_payload", lambda *_: True)
    if op is not None:
        sim.admin(op)
    with pytest.raises(DeviceError, match=says):
        arm.set_payload(4.0, cases.COM)
    assert sim.admin()["payload"] == cases.MASS


def test_another_centre_of_mass_than_was_set_is_told(arm, monkeypatch):
    set_payload = Control.set_payload
    monkeypatch.setattr(
        Control, "set_payload", lambda c, mass, com: set_payload(c, mass, com + 0.01)
    )
    with pytest.raises(DeviceError, match=r"it reports 4 kg at .* after a payload of 4 kg at"):
        arm.set_payload(4.0, cases.COM)


@pytest.mark.parametrize("lost", [False, True])
def test_a_command_that_fails_since_the_program_has_ended_says_so(lost, arm, sim, monkeypatch):
    def ended(*_):
        sim.admin("kill_script")
        raise WorkerError("no answer within 0.5 s", lost=lost)

    for name, command in (
        ("set_payload", lambda: arm.set_payload(4.0, cases.COM)),
        ("move", lambda: arm.start_move(cases.displaced_joints(arm, by=0.2), 0.5, 0.5)),
    ):
        arm.take_control(cases.MASS, cases.COM)
        with monkeypatch.context() as patched:
            patched.setattr(Control, name, ended)
            with pytest.raises(DeviceError, match=r"\(no answer .*: its program is stopped"):
                command()


def test_stop_in_motion_keeps_control(arm, sim):
    goal = cases.under_way(arm, sim)
    called = time.monotonic_ns()
    arm.stop()
    state = sim.admin()
    assert not state["moving"]
    assert state["rest_ns"] - called < cases.STOP_NS
    assert abs(state["q"][0] - goal[0]) > 0.05
    assert arm.moving() is False
    arm.start_move(goal, cases.SPEED, cases.ACCELERATION)
    cases.finish(arm)
    np.testing.assert_allclose(sim.admin()["q"], goal, atol=2e-5)


def test_motion_that_nobody_watches_stops_by_itself(arm, sim):
    goal = cases.under_way(arm, sim)
    last = time.monotonic_ns()
    state = sim.wait("moving", False)
    assert state["rest_ns"] - last < 500_000_000 + cases.STOP_NS
    assert abs(state["q"][0] - goal[0]) > 0.05
    assert "not supervised" in cases.error_of(arm.moving)
    with pytest.raises(DeviceError, match="not supervised"):
        arm.start_move(goal, 0.5, 0.5)
    arm.take_control(cases.MASS, cases.COM)
    assert arm.moving() is False


def test_second_program_is_refused_and_disturbs_nothing(arm, sim):
    goal = cases.displaced_joints(arm, by=0.5)
    with closing(open_arm(cases.config(sim.host))) as other:
        arm.start_move(goal, cases.SPEED, cases.ACCELERATION)
        assert arm.moving()
        begun = time.monotonic()
        with pytest.raises(DeviceError, match="another program controls it"):
            other.take_control(0.0, np.zeros(3))
        assert time.monotonic() - begun < 8.0
        cases.finish(arm)
    np.testing.assert_allclose(sim.admin()["q"], goal, atol=2e-5)
    assert sim.admin()["payload"] == cases.MASS


def test_controller_that_does_not_tell_its_payload(tmp_path):
    with (
        closing(cases.start(tmp_path, "--version", "5.4.0.0")) as running,
        closing(open_arm(cases.config(running.host))) as arm,
    ):
        sample = arm.sample()
        assert sample.payload_com is None
        assert sample.ft_raw_wrench is None
        np.testing.assert_allclose(sample.q, running.admin()["q"], atol=1e-4)
        assert any("5.5.1" in problem for problem in arm.report().problems)
        with pytest.raises(DeviceError, match=r"5\.5\.1"):
            arm.take_control(1.0, np.zeros(3))
        running.wait("script_running", False)


@pytest.mark.parametrize(
    ("version", "says"),
    [
        ("10.11.0.0", ""),
        pytest.param("10.7.0.0", "PolyScope X 10.11", marks=pytest.mark.long),
        pytest.param("10.12.0.0", "", marks=pytest.mark.long),
    ],
)
def test_versions_of_polyscope_x(tmp_path, version, says):
    """Before 10.11 there is no Robot API; 10.11 does not tell modes, nor 10.12 the model."""
    with (
        closing(cases.start(tmp_path, "--version", version)) as running,
        closing(open_arm(cases.config(running.host))) as arm,
    ):
        np.testing.assert_allclose(arm.sample().q, running.admin()["q"], atol=1e-4)
        problems = [
            reported for reported in arm.report().problems if "RTDE comes at" not in reported
        ]
        if says:
            assert [says in reported for reported in problems] == [True]
            with pytest.raises(DeviceError, match=f"cannot take control: .*{says}"):
                arm.take_control(cases.MASS, cases.COM)
        else:
            assert problems == []
            arm.take_control(cases.MASS, cases.COM)
            goal = cases.under_way(arm, running)
            cases.finish(arm)
            np.testing.assert_allclose(arm.sample().q, goal, atol=1e-3)
        arm.stop()


CONNECT_S = 8.0  # deadline of opening (the requirement)


@pytest.mark.usefixtures("put_right")
def test_local_mode_is_refused_before_anything_is_uploaded(sim):
    scripts = sim.admin("local_mode")["scripts"]
    with closing(open_arm(cases.config(sim.host))) as arm:
        with pytest.raises(DeviceError, match="local mode"):
            arm.take_control(1.0, np.zeros(3))
        assert sim.admin()["scripts"] == scripts


def fails_to_open(host):
    """The error of opening, which has to come before its deadline and leave nothing behind."""
    begun = time.monotonic()
    with pytest.raises(DeviceError) as caught:
        open_arm(cases.config(host))
    assert time.monotonic() - begun < CONNECT_S
    assert cases.children() == []
    text = str(caught.value)
    assert host in text
    assert "\n" not in text
    return text


def test_nobody_there():
    assert "refuses the connection" in fails_to_open(free_host())


@pytest.mark.usefixtures("put_right")
@pytest.mark.parametrize(
    ("op", "says"), [("rtde_mute", "does not answer"), ("rtde_stall", "no data")]
)
def test_controller_that_is_mute_or_negotiates_and_sends_nothing(op, says, sim):
    sim.admin(op, on=True)
    assert says in fails_to_open(sim.host)


@pytest.mark.usefixtures("put_right")
def test_mute_dashboard(sim):
    sim.admin("dashboard_mute", on=True)
    with closing(open_arm(cases.config(sim.host))) as arm:
        assert any("without it" in problem for problem in arm.report().problems)
        begun = time.monotonic()
        with pytest.raises(DeviceError, match=r"cannot take control: .*does not answer"):
            arm.take_control(1.0, np.zeros(3))
        assert time.monotonic() - begun < CONNECT_S
        assert not sim.admin()["script_running"]


@pytest.mark.parametrize("says", [b"", b"\x00\x05V\x01", b"SSH-2.0-OpenSSH_9\r\n", b"\x00\x01V"])
def test_something_else_on_the_port(says):
    with cases.server(30004, lambda asked: says) as (host, _):
        fails_to_open(host)
