"""Several targets, and instruments that agree about where they are."""

import time
from contextlib import closing

import numpy as np
import pytest

from hilcal.drivers import emscon, geocom
from hilcal.drivers.ft300 import open_force_sensor
from hilcal.drivers.geocom import open_tracker
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.drivers.simulated.operator import open_operator
from hilcal.drivers.ur import open_arm
from hilcal.measuring.devices import PointingTracker, TargetLostError
from hilcal.readings.readings import States
from tests.support.reflector_cases import NAMES, OFFSETS
from tests.support.rows import first
from tests.support.running_world import WEIGHT, Q, config, world_of
from tests.support.timing import wait_until

RADIUS = 0.05
OPEN = {"geocom": geocom.open_tracker, "emscon": emscon.open_tracker}
TARGETS = [{"name": n, "target_m": at} for n, at in zip(NAMES, OFFSETS.tolist(), strict=True)]


def made(driver):
    tool = {"load_point_m": [0.1, -0.03, 0.15], "mass_kg": 0.8, "targets": TARGETS}
    return config(tool=tool, tracker={"driver": driver})


@pytest.mark.parametrize("driver", first(1, [*OPEN]))
def test_the_station_measures_the_reflector_that_it_is_pointed_to(driver, tmp_path):
    with (
        SimulatedCell.start(world_of(made(driver)), made(driver), tmp_path, 3) as cell,
        closing(OPEN[driver](cell.config)) as tracker,
    ):
        assert isinstance(tracker, PointingTracker)
        true = np.array(cell.ask("world", "state")["targets"])
        assert true.shape == (3, 3)
        for k in (2, 0, 1):
            tracker.aim(true[k] + [0.004, -0.003, 0.002], RADIUS)
            assert np.linalg.norm(tracker.measure().value - true[k]) < 5e-4
        cell.ask("tracker", "hide", targets=[1])
        with pytest.raises(TargetLostError):
            tracker.measure()
        with pytest.raises(TargetLostError, match=r"no target in sight|not found"):
            tracker.aim(true[1], RADIUS)
        tracker.aim(true[2], RADIUS)
        assert np.linalg.norm(tracker.measure().value - true[2]) < 5e-4


MOUNT = {"origin_m": [0.0, 0.0, 0.04], "rotvec_rad": [0.0, 0.0, 0.7]}
MEASUREMENTS = 8
TURN = np.array([0.1, -0.1, 0.1, -0.2, 0.2, -0.1])


def made_cell():
    return config(
        force_sensor={"driver": "ft300", "port": "x", **MOUNT},
        operator={"driver": "simulated", "options": {"hand_s": 1.0}},
    )


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    world = world_of(made_cell(), hysteresis=np.full(6, 5e-5))
    with SimulatedCell.start(world, made_cell(), tmp_path_factory.mktemp("c"), 3) as cell:
        yield cell


def measured(tracker):
    samples = [tracker.measure() for _ in range(MEASUREMENTS)]
    mean = np.mean([s.value for s in samples], axis=0)
    return mean, np.mean([s.covariance for s in samples], axis=0) / MEASUREMENTS


def chi_square(difference, covariance):
    return float(difference @ np.linalg.solve(covariance, difference))


def test_the_tracker_sees_the_sag_under_the_load_that_the_force_sensor_feels(cell):
    person, readings = open_operator(cell.config), []
    with (
        closing(open_tracker(cell.config)) as tracker,
        closing(open_force_sensor(cell.config)) as force,
    ):
        for hung in (None, cell.config.loads[0]):
            person.hang(hung, "")
            wrench = np.array(cell.ask("world", "state")["sensor_wrench"])
            readings.append((*measured(tracker), force.average(0.5), wrench))
        person.hang(None, "")
    empty, loaded = readings
    arm = cell._board.read("arm")
    both = States(
        q=np.tile(arm["q"], (2, 1)),
        wrench=np.array([np.zeros(6), WEIGHT]),
        approach=np.tile(arm["side"], (2, 1)),
    )
    slip = np.tile(cell.ask("world", "state")["slip"], (2, 1))
    position = (
        world_of(made_cell(), hysteresis=np.full(6, 5e-5)).ideal_readings(both, slip).position
    )
    sag = position[1] - position[0]
    spread = empty[1] + loaded[1]
    assert chi_square(sag, spread) > 1e3  # there is something to see
    # chi-square of 3 degrees exceeds 28 in 4 of a million
    assert chi_square(loaded[0] - empty[0] - sag, spread) < 28.0
    felt = loaded[2].wrench - empty[2].wrench
    frames = [r[2].covariance / r[2].frames for r in (empty, loaded)]
    bound = 5.0 * np.sqrt(np.diag(frames[0] + frames[1])) + np.repeat([0.01, 0.001], 3)
    assert np.all(np.abs(felt - (loaded[3] - empty[3])) < bound)
    assert np.linalg.norm(felt[:3]) == pytest.approx(5.0 * 9.80665, abs=0.3)


def test_the_tracker_sees_the_arm_arrive_where_it_was_sent(cell):
    world = world_of(made_cell(), hysteresis=np.full(6, 5e-5))
    with closing(open_arm(cell.config)) as arm, closing(open_tracker(cell.config)) as tracker:
        arm.take_control(0.8, np.array([0.01, 0.02, 0.06]))
        for goal in (Q, Q + TURN):
            arm.start_move(goal, 0.5, 0.5)
            wait_until(lambda: not arm.moving(), "arrived")
            time.sleep(0.1)
            np.testing.assert_allclose(arm.sample().q, goal, atol=1e-4)
        (value, covariance), state = measured(tracker), cell.ask("world", "state")
    side = np.sign(TURN)[None]  # from which it arrived
    last = States(q=goal[None], wrench=np.zeros((1, 6)), approach=side)
    want = world.ideal_readings(last, np.array([state["slip"]])).position[0]
    assert chi_square(value - want, covariance) < 28.0
    np.testing.assert_allclose(state["encoder"], goal, atol=2e-5)
