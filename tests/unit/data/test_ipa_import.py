"""Import of the UR10 data of Fraunhofer IPA: units, covariance, approach, what is left out."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.readings.covariance import tracker_covariance
from hilcal.tables.mapped import import_mapped
from hilcal.tables.mapping import Mapping, find_mapping
from tests.support.readings_cases import make_arm

ARM = make_arm()
MAPPING = find_mapping("ipa-ur10", Mapping)
TRACKER = MAPPING.instrument.noise()
JOINTS = tuple(map(str, MAPPING.joints.columns))
MEASURED = (*map(str, MAPPING.position.columns), *map(str, MAPPING.orientation.columns))
COLUMNS = (*JOINTS, *MEASURED, "measurement_temperature", *map(str, MAPPING.std.columns))
DATA = Path(os.environ.get("HILCAL_DATA", Path(__file__).parents[4] / "shared" / "data"))
SERIES = {
    "B": DATA / "ipa_ur10" / "Series_B" / "measurements_joint_configurations.csv",
    "C": DATA / "ipa_ur10" / "Series_C" / "measurements_random_poses.csv",
}
HEADER = ("Timestamp", "Goal x", *COLUMNS)


def row(q, p_mm, angles):
    cells = {"Timestamp": "2,02011E+13", "Goal x": 0.4}
    cells |= dict(zip(JOINTS, q, strict=True))
    cells["measurement_temperature"] = 21.5
    for k, e in enumerate(("x", "y", "z")):
        cells |= {f"measurement_{e}": p_mm[k], f"measurement_std_{e}": 0.01 * (k + 1)}
        cells |= {f"measurement_r{e}": angles[k], f"measurement_std_r{e}": 0.002 * (k + 1)}
    return cells


def rows():
    """Five poses; joint 1 goes up, down, stands still, stands still but for rounding."""
    first = (0.0, 0.5, 0.2, 0.5, 0.00005)
    return [
        row(
            (q, 0.3 * k, 0.1, 0.0, 0.0, 0.0), (-400.5, -3000.0 + 90 * k, 5.0), (-90.0, 20.0, 10 * k)
        )
        for k, q in enumerate(first)
    ]


def write(path, table):
    def text(cell):
        return cell if isinstance(cell, str) else repr(cell).replace(".", ",")

    lines = [";".join(HEADER), *(";".join(text(r[name]) for name in HEADER) for r in table)]
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


def read(tmp_path, table):
    return imported(write(tmp_path / "m.csv", table))


def imported(path):
    return import_mapped(path, MAPPING, ARM, None)


def test_values_in_si(tmp_path):
    x = read(tmp_path, rows()).readings
    assert (len(x), x.m) == (5, 6)
    np.testing.assert_allclose(x.value[1, :3], [-0.4005, -2.91, 0.005], rtol=1e-15)
    expected = Rotation.from_euler("XYZ", [-90, 20, 10], degrees=True).as_rotvec()
    np.testing.assert_allclose(x.value[1, 3:], expected, atol=1e-14)
    assert x.states.air_temperature.tolist() == [21.5] * 5
    assert x.states.time is None
    assert not x.states.wrench.any()
    assert x.load_names == ("none",)
    assert x.pose.tolist() == [0, 1, 2, 3, 4]
    assert x.pose_names[:2] == ("row 2", "row 3")
    assert x.cycle.tolist() == [0] * 5


def test_covariance_is_that_of_the_mean_and_of_the_instrument(tmp_path):
    x = read(tmp_path, rows()).readings
    covariance_alone = x.covariance - tracker_covariance(x.value[:, :3], TRACKER, m=6)
    spread = np.array([1e-5, 2e-5, 3e-5])
    np.testing.assert_allclose(
        covariance_alone[:, :3, :3], np.tile(np.diag(spread**2), (5, 1, 1)), atol=1e-22
    )
    assert not covariance_alone[:, :3, 3:].any()


def test_a_spread_of_zero_gets_a_floor(tmp_path):
    table = rows()
    table[1] |= {f"measurement_std_{e}": 0.0 for e in ("x", "y", "z", "rx", "ry", "rz")}
    cov = read(tmp_path, table).readings.covariance
    floor = tracker_covariance(np.array([[-0.4005, -2.91, 0.005]]), TRACKER, m=6)[0]
    gain = np.diag(cov[1] - floor)
    np.testing.assert_allclose(gain[:3], (2e-6) ** 2, rtol=1e-6)
    # the three axes of the angles are not orthogonal, their trace is what they are
    np.testing.assert_allclose(gain[3:].sum(), 3 * np.deg2rad(0.0005) ** 2, rtol=1e-6)
    assert np.linalg.eigvalsh(cov)[:, 0].min() > 0


def test_approach_is_the_side_of_the_last_real_move(tmp_path):
    approach = read(tmp_path, rows()).readings.states.approach
    assert approach[:, 0].tolist() == [1, 1, -1, 1, -1]
    assert approach[:, 1].tolist() == [1] * 5
    still = rows()
    still[4]["shoulder_pan_joint"] = 0.50005
    approach = read(tmp_path, still).readings.states.approach
    assert approach[:, 0].tolist() == [1, 1, -1, 1, 1]


def test_rows_with_empty_cells_are_left_out_and_named(tmp_path):
    table = [*rows(), *rows(), *rows()]
    for k, r in enumerate(table):
        r["wrist_3_joint"] = 0.1 * k
    table[3]["measurement_ry"] = ""
    result = read(tmp_path, table)
    assert "row 5" not in result.readings.pose_names
    assert len(result.readings) == 14
    assert result.notes[1] == "1 of 15 rows left out (5): no value in measurement_ry"
    approach = result.readings.states.approach
    assert approach[3, 0] == -1  # from 0.5 in the row left out to 0.00005


def test_a_reading_that_was_not_taken_again_is_left_out(tmp_path):
    table = rows()
    for name in ("x", "y", "z", "rx", "ry", "rz"):
        table[2][f"measurement_{name}"] = table[1][f"measurement_{name}"]
    result = read(tmp_path, table)
    assert result.readings.pose_names == ("row 2", "row 3", "row 5", "row 6")
    assert result.notes[1].startswith("1 of 5 rows left out (4): the same reading")


def test_repeats_that_cannot_both_be_right_are_left_out(tmp_path):
    table = [*rows(), rows()[1]]
    assert len(read(tmp_path, table).readings) == 6
    table[5]["measurement_z"] = 7.0
    result = read(tmp_path, table)
    assert result.readings.pose_names == ("row 2", "row 4", "row 5", "row 6")
    assert result.notes[1].startswith("2 of 6 rows left out (3, 7): they repeat a pose")


def test_a_series_without_standard_deviations_and_temperature(tmp_path):
    whole = read(tmp_path, rows()).readings
    path = tmp_path / "m.csv"
    kept = [k for k, name in enumerate(HEADER) if "_std_" not in name and "temperature" not in name]
    lines = [line.split(";") for line in path.read_text().splitlines()]
    path.write_text("\n".join(";".join(line[k] for k in kept) for line in lines))
    result = imported(path)
    np.testing.assert_array_equal(result.readings.value, whole.value)
    covariance_alone = result.readings.covariance - tracker_covariance(
        whole.value[:, :3], TRACKER, m=6
    )
    np.testing.assert_allclose(covariance_alone[:, range(3), range(3)], (2e-6) ** 2, rtol=1e-6)
    assert result.readings.states.air_temperature is None
    assert any("the table has no column 'measurement_std_x'" in note for note in result.notes)
    assert any("no air temperature" in note for note in result.notes)


@pytest.mark.parametrize("series", SERIES)
def test_the_measured_series(series):
    path = SERIES[series]
    if not path.exists():
        pytest.skip(f"needs the UR10 data, {path.name}, in HILCAL_DATA/ipa_ur10/Series_{series}")
    result = imported(path)
    x = result.readings
    lost = {"B": {534, 856, 857, 865, 1065}, "C": set()}[series]
    total = {"B": 1495, "C": 2773}[series]
    assert set(x.pose_names) == {f"row {k}" for k in range(2, total + 2) if k not in lost}
    assert np.linalg.eigvalsh(x.covariance[:, :3, :3])[:, 0].min() > (5e-6) ** 2
    # 3-D standard deviation of a typical position: tens of micrometres
    std = np.sqrt(np.trace(x.covariance[:, :3, :3], axis1=1, axis2=2))
    assert 20e-6 < np.median(std) < 60e-6
    assert set(np.unique(x.states.approach)) == {-1.0, 1.0}
