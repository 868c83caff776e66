"""The exchange table: exact round trip, and one clear line for whatever is wrong."""

import csv
import json
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise, tracker_covariance
from hilcal.tables.table import write_table
from tests.support.readings_cases import (
    assert_same,
    make_arm,
    read_table,
    readings,
    simple_readings,
)
from tests.support.refusals import refusal, refusals, refuses

ARM = make_arm()
NOISE = TrackerNoise(10e-6, 0.3e-6, 15e-6, 6e-6)

per_example_file = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def good():
    """Three poses, each without and with a load, covariances given."""
    rng = np.random.default_rng(1)
    rows = []
    for k in range(3):
        q = rng.uniform(-2, 2, 6)
        for load in ("none", "plate"):
            p = rng.uniform(-1, 1, 3)
            row = {"pose": f"P{k}", "load": load}
            row |= {f"q{i + 1}_rad": repr(float(q[i])) for i in range(6)}
            row |= {a + "_m": repr(float(v)) for a, v in zip("xyz", p, strict=True)}
            row |= {"cov_x_x": "1e-10", "cov_x_y": "1e-11", "cov_x_z": "0"}
            row |= {"cov_y_y": "4e-10", "cov_y_z": "0", "cov_z_z": "1e-10"}
            row |= {"fz_N": "0" if load == "none" else "-50", "cycle": "0", "x_note": "hello"}
            rows.append(row)
    return rows


@pytest.fixture
def write(tmp_path):
    def to_file(rows):
        path = tmp_path / "table.csv"
        with path.open("w", newline="") as stream:
            out = csv.writer(stream)
            out.writerow(rows[0])
            out.writerows([row[name] for name in rows[0]] for row in rows)
        return path

    return to_file


def without(rows, *names):
    return [{k: v for k, v in row.items() if k not in names} for row in rows]


def changed(given):
    """The good table, changed as lines say; rows are counted as a spreadsheet counts."""
    rows = good()
    for line in given.splitlines():
        first, *names = line.split()
        if first == "without":
            rows = without(rows, *names)
        elif "becomes" in names:
            rows = [{names[1] if k == first else k: v for k, v in row.items()} for row in rows]
        else:
            column, value = map(word, line.partition(": ")[2].split(" = "))
            for row in rows if first == "all:" else [rows[int(first[:-1]) - 2]]:
                row[column] = value
    return rows


def word(text):
    return json.loads(text) if text.startswith('"') else text


COVARIANCE = tuple(name for name in good()[0] if name.startswith("cov_"))


@per_example_file
@given(x=readings())
def test_round_trip_is_exact(tmp_path, x):
    write_table(x, tmp_path / "t.csv")
    assert_same(read_table(tmp_path / "t.csv", ARM, None), x)


def test_seven_joints(tmp_path):
    x = simple_readings(4)
    x = replace(x, states=replace(x.states, q=np.hstack([x.states.q, np.ones((4, 1))]), time=None))
    write_table(x, tmp_path / "t.csv")
    assert_same(read_table(tmp_path / "t.csv", make_arm(7), None), x)
    with pytest.raises(InputError, match=r"unknown column 'q7_rad'.*the arm has 6 joints"):
        read_table(tmp_path / "t.csv", ARM, None)


def test_good_table(write):
    x = read_table(write(good()), ARM, None)
    assert x.pose.tolist() == [0, 0, 1, 1, 2, 2]
    assert x.load_names == ("none", "plate")
    assert x.states.wrench[:, 2].tolist() == [0, -50] * 3
    assert x.covariance[0].tolist() == [[1e-10, 1e-11, 0], [1e-11, 4e-10, 0], [0, 0, 1e-10]]


def test_covariance_comes_from_the_instrument_when_the_table_has_none(write):
    path = write(without(good(), *COVARIANCE))
    station = np.array([3.0, 0.0, 0.0])
    x = read_table(path, ARM, NOISE, station)
    np.testing.assert_array_equal(x.covariance, tracker_covariance(x.value, NOISE, station))
    refusal(r"no covariance columns .* and no noise", read_table, path, ARM, None)
    posed = without(good(), *COVARIANCE)
    path = write([row | {"rx_rad": "0.1", "ry_rad": "0", "rz_rad": "-1"} for row in posed])
    six = replace(NOISE, orientation_std=1e-4)
    x = read_table(path, ARM, six, station)
    expected = tracker_covariance(x.value[:, :3], six, station, m=6)
    np.testing.assert_array_equal(x.covariance, expected)
    refusal("orientation_std is 0", read_table, path, ARM, NOISE, station)


def test_repeats_blank_lines_and_order_of_columns_do_not_matter(write):
    rows = [dict(reversed(row.items())) for row in good()]
    path = write(rows + rows[:2])
    path.write_text("\ufeff" + path.read_text().replace("\n", "\n\n") + "\n\n")
    x = read_table(path, ARM, None)
    assert len(x) == 8
    np.testing.assert_array_equal(x.value[6:], x.value[:2])


@refusals("tables")
def test_bad_tables_are_refused_by_name(case, given, write):
    path = write(changed(given))
    refuses(case, lambda: read_table(path, ARM, NOISE), path)


def test_positions_that_do_not_move_with_the_joints(tmp_path):
    x = simple_readings(20)
    write_table(replace(x, value=1.0 + 1e-4 * x.value), tmp_path / "t.csv")
    refusal("all positions lie within", read_table, tmp_path / "t.csv", ARM, None)


def test_deflections_in_place_of_readings_are_refused(write):
    zero = {"x_m": "0", "y_m": "0", "z_m": "0"}
    rows = [row | zero if row["load"] == "none" else row for row in good()]
    refusal("these are deflections", read_table, write(rows), ARM, None)


def test_row_numbers_count_blank_lines(tmp_path):
    write_table(simple_readings(90), tmp_path / "t.csv")
    lines = (tmp_path / "t.csv").read_text().splitlines()
    lines[80] = lines[80].replace(",", ",oops,", 1)
    lines.insert(10, "")
    (tmp_path / "t.csv").write_text("\n".join(lines))
    refusal("row 82 has", read_table, tmp_path / "t.csv", ARM, None)


@pytest.mark.parametrize(("content", "message"), [
    (b"\xef\xbb\xbf \n\n", "the file is empty"),
    ("name,age\n".encode("utf-16"), "not an exchange table"),
    (b"pose,load\xff\xfe,q1_rad\n", "not UTF-8"),
    (b"pose;load;q1_rad\na;none;0,1\n", "separated by ','"),
    (b"name,age\nbob,7\n", "not an exchange table"),
    (b"pose,load,x_m,x_m\na,none,1,1\n", "column 'x_m' appears 2 times"),
    (b'pose,load\n"a,none\n', "row 2: not delimited text")])  # fmt: skip
def test_files_of_another_format(tmp_path, content, message):
    path = tmp_path / "t.csv"
    path.write_bytes(content)
    refusal(message, read_table, path, ARM, None)


def test_other_things_than_a_table(tmp_path, write):
    refusal("no such file", read_table, tmp_path / "absent.csv", ARM, None)
    refusal("cannot be read", read_table, tmp_path, ARM, None)
    base = tmp_path / "base.db"
    connection = sqlite3.connect(base)
    connection.execute("CREATE TABLE t (a)")
    connection.close()
    refusal("SQLite", read_table, base, ARM, None)
    path = write(good())
    path.write_text(path.read_text().splitlines()[0])
    refusal("no readings below row 1", read_table, path, ARM, None)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        *(({"load_names": (name,)}, "load") for name in ("", " a", "a\n", "a\x00", "None")),
        ({"pose_names": ("a", "a")}, "two of the readings' poses have this name"),
    ],
)
def test_names_that_a_table_cannot_hold_are_not_written(tmp_path, names, message):
    refusal(message, write_table, replace(simple_readings(2), **names), tmp_path / "t.csv")
    assert not list(tmp_path.iterdir())
