"""What every driver has to do, on simulated devices or, with --hardware CELL.toml, on real ones.

    pytest tests/wire/test_devices.py --hardware CELL.toml

On real devices the arm makes small, slow motions (at most 0.05 rad per joint) about where it
stands: clear its surroundings, keep a hand on the emergency stop, and let the tracker see its
target. Without a force sensor in the cell its tests are skipped.
"""

import time
from pathlib import Path

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import load_config
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulated_cell
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.connect import connect
from hilcal.measuring.devices import Clock
from hilcal.measuring.measure import average
from hilcal.robot.catalogue import configs_dir
from tests.support.rows import first
from tests.support.spread_plan import spread_plan
from tests.unit.robot.test_rails import TRACK

SMALL = 0.05  # rad
SLOW = 0.2  # rad/s
PATIENCE = 60.0  # s


def pytest_generate_tests(metafunc):
    """The real cell that is named; else a simulated UR and an arm on a track."""
    if "there" in metafunc.fixturenames:
        given = metafunc.config.getoption("--hardware")
        cells = [given] if given else first(0, ["ur10e", "track.toml"])
        metafunc.parametrize("there", cells, indirect=True, scope="module")


@pytest.fixture(scope="module")
def there(request, tmp_path_factory):
    """The configuration and the cell."""
    if given := request.config.getoption("--hardware"):
        config = load_config(Path(given))
        yield config, cell_from_config(config, Path(given).absolute().parent)
        return
    base_dir = tmp_path_factory.mktemp("robot")
    rows = (configs_dir() / "robots" / "ur10e.toml").read_text()
    (base_dir / "track.toml").write_text(TRACK + rows[rows.index("[[joints]]") :])
    config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
    simulation = config.simulation.model_copy(update={"clock": 1.0})
    robot = config.robot.model_copy(update={"model": request.param})
    limits = config.limits.model_copy(update={"workspace_min_m": (-3.0, -3.0, 0.05)})
    config = config.model_copy(update={"simulation": simulation, "robot": robot, "limits": limits})
    cell = cell_from_config(config, base_dir)
    plan = spread_plan(cell, 4, np.random.default_rng(0))
    secret = case_of_plan(config, plan, "nothing", 3, base_dir=base_dir)
    with simulated_cell(secret, 3, base_dir, tmp_path_factory.mktemp("cell")) as running:
        yield running.config, secret.cell


@pytest.fixture(scope="module")
def opened(there):
    rig, answers = connect(there[0])
    assert rig is not None, [answer.failure for answer in answers]
    yield rig, answers
    rig.close()
    rig.close()  # may be called twice


@pytest.fixture(scope="module")
def rig(opened):
    return opened[0]


@pytest.fixture(scope="module")
def ready(rig, there):
    """The rig, with the arm under control."""
    rig.arm.take_control(there[1].tool_mass, there[1].tool_com)
    return rig


@pytest.fixture(scope="module")
def force(rig):
    if rig.force is None:
        pytest.skip("the cell has no [force_sensor]")
    return rig.force


def _wait(rig, longest):
    end = time.monotonic() + longest
    while rig.arm.moving():
        assert time.monotonic() < end, "the motion does not end"
        time.sleep(0.02)


def test_every_device_says_who_it_is_and_hinders_nothing(opened):
    for answer in opened[1]:
        assert answer.report.device == answer.device
        assert answer.report.name
        assert answer.problems == ()
        for line in (answer.report.name, *(f"{a}{b}" for a, b in answer.report.facts)):
            assert "\n" not in line


def test_nothing_moves_before_control_is_taken(rig):
    with pytest.raises(DeviceError):
        rig.arm.start_move(rig.arm.sample().q, SLOW, SLOW)


def test_samples_are_fresh_and_whole(rig, there):
    n = there[1].arm.n
    first = rig.arm.sample()
    time.sleep(0.1)
    second = rig.arm.sample()
    assert second.timestamp > first.timestamp
    assert 0 <= time.monotonic_ns() - second.host_ns < 400_000_000
    for name in ("q", "q_target", "qd", "target_moment", "current", "joint_temperature"):
        value = getattr(second, name)
        assert value.shape == (n,)
        assert np.isfinite(value).all()
    assert second.safety == "normal"
    assert np.abs(second.q - second.q_target).max() < 0.01
    assert np.abs(second.qd).max() < 0.01
    assert np.all((second.joint_temperature > 0) & (second.joint_temperature < 90))


def test_the_arm_goes_where_it_is_told_and_no_further(ready, there):
    config = there[0]
    home = ready.arm.sample().q_target
    for goal in (home + SMALL / 2, home - SMALL / 2, home):
        ready.arm.start_move(goal, SLOW, SLOW)
        _wait(ready, PATIENCE)
        sample = ready.arm.sample()
        assert np.abs(sample.q - goal).max() <= config.motion.arrival_rad
        assert np.abs(sample.qd).max() < 0.01


def test_a_stop_ends_a_motion_on_the_way(ready, there):
    home = ready.arm.sample().q_target
    # over two seconds, also where the cell's clock goes faster
    ready.arm.start_move(home + SMALL, SMALL / 2 / there[0].clock, SMALL)
    end = time.monotonic() + 0.5
    while time.monotonic() < end:  # unwatched for 0.5 s it would stop by itself
        assert ready.arm.moving()
        time.sleep(0.05)
    ready.arm.stop()
    stood = ready.arm.sample()
    assert np.abs(stood.qd).max() < 0.01
    time.sleep(0.3)
    assert np.abs(ready.arm.sample().q - stood.q).max() < 1e-3
    assert np.abs(stood.q - home).max() < 0.9 * SMALL
    assert not ready.arm.moving()
    ready.arm.start_move(home, SLOW, SLOW)  # and it goes on after it
    _wait(ready, PATIENCE)


def test_the_payload_is_what_was_set(ready, there):
    cell = there[1]
    com = np.add(cell.tool_com, [0.0, 0.0, 0.02])
    for mass, where in ((cell.tool_mass + 0.5, com), (cell.tool_mass, np.zeros(3))):
        ready.arm.set_payload(mass, where)
        time.sleep(0.2)
        sample = ready.arm.sample()
        assert sample.payload == pytest.approx(mass, abs=1e-3)
        if sample.payload_com is not None:
            assert sample.payload_com == pytest.approx(where, abs=1e-4)
    ready.arm.set_payload(cell.tool_mass, cell.tool_com)


@pytest.mark.parametrize("bad", ["too short", "not a number"])
def test_what_is_no_goal_is_refused_and_nothing_moves(ready, bad):
    q = ready.arm.sample().q_target
    goal = q[:-1] if bad == "too short" else np.where(np.arange(len(q)) == 1, np.nan, q)
    with pytest.raises((InputError, DeviceError)):
        ready.arm.start_move(goal, SLOW, SLOW)
    assert np.abs(ready.arm.sample().qd).max() < 0.01


def test_the_tracker_repeats_itself_as_it_says(rig, there):
    rig.tracker.find_target()
    samples = [rig.tracker.measure() for _ in range(12)]
    m = len(samples[0].value)
    assert m in (3, 6)
    for s in samples:
        assert np.isfinite(s.value).all()
        assert s.covariance.shape == (m, m)
        assert np.linalg.eigvalsh(s.covariance).min() > 0
    assert samples[-1].host_ns > samples[0].host_ns
    mean = average(samples, 0.0)
    off = np.array([s.value[:3] - mean.value[:3] for s in samples])
    white = np.linalg.solve(np.linalg.cholesky(samples[0].covariance[:3, :3]), off.T)
    assert np.sum(white**2) < 3.0 * 3 * 11  # chi2 with 33 degrees of freedom: mean 33, std 8
    assert np.trace(mean.covariance) < np.trace(samples[0].covariance)


def test_the_tracker_sees_the_arm_move(ready):
    home = ready.arm.sample().q_target
    before = ready.tracker.measure().value[:3]
    goal = home.copy()
    goal[0] += SMALL
    ready.arm.start_move(goal, SLOW, SLOW)
    _wait(ready, PATIENCE)
    away = ready.tracker.measure().value[:3]
    ready.arm.start_move(home, SLOW, SLOW)
    _wait(ready, PATIENCE)
    back = ready.tracker.measure().value[:3]
    pose = ready.arm.sample().tcp_pose
    lever = float(np.hypot(pose[0], pose[1]))
    assert np.linalg.norm(away - before) > 0.3 * SMALL * lever
    assert np.linalg.norm(back - before) < 1e-3


def test_the_force_sensor_streams_without_a_loss(force):
    before = force.losses()
    sample = force.average(1.0)
    after = force.losses()
    assert sample.frames > 20
    assert after.frames - before.frames >= sample.frames - 2
    assert after.corrupt == before.corrupt
    end = time.monotonic() + PATIENCE
    while force.losses().lost > before.lost and time.monotonic() < end:
        time.sleep(0.05)  # by arrival, a frame that is late counts as lost until it has come
    assert force.losses().lost <= before.lost
    assert np.isfinite(sample.wrench).all()
    assert np.linalg.eigvalsh(sample.covariance).min() >= -1e-12
    newest = force.latest()
    assert 0 <= time.monotonic_ns() - newest.host_ns < 400_000_000
    scatter = np.sqrt(np.diag(sample.covariance))
    assert np.all(np.abs(newest.wrench - sample.wrench) < 8 * scatter + np.repeat([1.0, 0.1], 3))


def test_a_second_program_is_refused_and_the_first_goes_on(ready, there):
    second, answers = connect(there[0])
    failed = {a.device: a.failure for a in answers if a.failure}
    if second is not None:
        second.close()
    assert "tracker" in failed
    assert "in use" in failed["tracker"]
    assert np.isfinite(ready.tracker.measure().value).all()
    assert not ready.arm.moving()
    assert ready.arm.sample().safety == "normal"


def test_the_clock_of_the_cell(there):
    clock = Clock(there[0].clock)
    begun = clock.now()
    clock.sleep(0.05)
    assert clock.now() - begun >= 0.05
