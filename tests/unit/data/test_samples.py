"""Tables of raw samples: each standstill becomes one reading, as a session would average it."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.tables.importing import import_readings
from hilcal.tables.table import exchange_columns, named_loads
from hilcal.tables.write import write_columns
from tests.support.campaigns import campaign, configuration

POSES, SAMPLES = 6, 40
PERIOD_S, TRAVEL_S = 0.05, 20.0


def sampled(tmp_path, *, time="s", visits=1, noise=1.0, outlier=None):
    """A table with `SAMPLES` rows for each arrival, and the readings without their noise."""
    c = campaign("none", "absolute", 0, poses=POSES)
    at = c.readings[np.tile(np.arange(len(c.readings)), visits)]
    rows = np.repeat(np.arange(len(at)), SAMPLES)
    order = np.argsort(at.pose[rows], kind="stable") if visits > 1 else np.arange(len(rows))
    seconds = PERIOD_S * np.arange(len(rows)) + TRAVEL_S * rows
    r, rng = at[rows], np.random.default_rng(1)
    root = np.linalg.cholesky(r.covariance)
    value = r.value + noise * np.einsum("nij,nj->ni", root, rng.standard_normal(r.value.shape))
    if outlier is not None:
        value[outlier] += 0.05
    clocks = {
        "s": seconds,
        "row": np.arange(len(rows), dtype=float),
        "pose": TRAVEL_S * rows,
        "day": 86400.0 * (r.pose >= POSES // 2),
    }
    clock = clocks.get(time)
    r = replace(r, value=value, states=replace(r.states, time=clock))[order]
    columns = {k: v for k, v in exchange_columns(r).items() if not k.startswith("cov")}
    write_columns(tmp_path / "t.csv", columns, {})
    return at, import_readings(tmp_path / "t.csv", "table", configuration(), c.cell.arm)


def notes(result):
    return [n for n in result.notes if "rows are" in n]


def test_samples_of_a_standstill_are_one_reading_with_the_covariance_of_their_mean(tmp_path):
    at, result = sampled(tmp_path)
    r = result.readings
    assert len(r) == len(at)
    assert np.array_equal(r.states.q, at.states.q)
    off = np.linalg.solve(np.linalg.cholesky(r.covariance), (r.value - at.value)[:, :, None])
    assert 0.6 < np.sqrt(np.mean(off**2)) < 1.4
    step = np.diff(r.states.time)
    assert step == pytest.approx(TRAVEL_S + SAMPLES * PERIOD_S)
    (note,) = notes(result)
    assert f"{SAMPLES * len(at)} rows are samples of {len(at)} standstills" in note


def test_a_gross_outlier_among_the_samples_is_left_out(tmp_path):
    at, result = sampled(tmp_path, outlier=7)
    assert np.abs(result.readings.value - at.value).max() < 1e-3
    assert "1 of them are gross outliers, left out" in notes(result)[0]


def test_arrivals_that_a_table_lists_together_stay_readings(tmp_path):
    """Sorted by pose: the second visit follows the first after the arm has been away."""
    at, result = sampled(tmp_path, visits=2)
    assert len(result.readings) == len(at)


def test_rows_with_the_time_of_their_pose_are_samples(tmp_path):
    at, result = sampled(tmp_path, time="pose")
    assert len(result.readings) == len(at)


@pytest.mark.parametrize("time", ["row", "day", None])
def test_without_a_clock_samples_are_not_told_from_arrivals(tmp_path, time):
    at, result = sampled(tmp_path, time=time)
    assert len(result.readings) == SAMPLES * len(at)
    assert "if they are samples of one standstill, give the time of each" in notes(result)[0]


def test_readings_of_a_session_are_no_samples(tmp_path):
    c = campaign("none", "deflection", 0, poses=POSES)
    write_columns(tmp_path / "t.csv", exchange_columns(c.readings), {})
    result = import_readings(tmp_path / "t.csv", "table", configuration(), c.cell.arm)
    assert len(result.readings) == len(c.readings)
    assert not notes(result)


def test_forces_that_differ_from_those_of_the_cell_are_said():
    r = campaign("none", "deflection", 0, poses=POSES).readings
    assert named_loads(r, configuration())[1] == ()
    more = replace(r, states=replace(r.states, wrench=1.05 * r.states.wrench))
    (note,) = named_loads(more, configuration())[1]
    assert "5kg (by 5.0%)" in note
