"""The guess of a mapping: for typical files it is the mapping that a person would write."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from hilcal.errors import InputError
from hilcal.tables.mapping import Mapping, load_mapping
from hilcal.tables.propose import propose
from hilcal.toml import check_section
from tests.support.foreign_tables import campaign, lines, write

C = campaign()
N = len(C.q)
DEG = np.rad2deg(C.q)
MM = 1e3 * C.position
SIGMA = np.random.default_rng(1).uniform(0.01, 0.03, (N, 6))


def joints(names, unit):
    return {"joints": {"columns": names, "unit": unit}}


def german():
    names = [f"Achse {k} [°]" for k in range(1, 7)]
    xyz = ["Mess X [mm]", "Mess Y [mm]", "Mess Z [mm]"]
    header = ["Punkt", *names, *xyz, "Zuladung", "Lufttemperatur [°C]", "Bemerkung"]
    loads = ["ohne" if k % 2 else "Gewicht 10" for k in range(N)]
    text = lines(
        header, [f"P{k}" for k in range(N)], DEG, MM, loads, 20 + 0.1 * np.arange(N), ["ä"] * N,
        comma=True,
    )  # fmt: skip
    return text, {
        "file": {"separator": ";", "decimal": ","},
        "position": {"columns": xyz, "unit": "mm"},
        **joints(names, "deg"),
        "pose": {"column": "Punkt"},
        "load": {"column": "Zuladung"},
        "air": {"column": "Lufttemperatur [°C]"},
    }


def kuka():
    names = [f"A{k}" for k in range(1, 7)]
    header = ["Nr", *names, "X", "Y", "Z", "A", "B", "C"]
    text = lines(header, np.arange(1, N + 1), DEG, MM, C.angles("ZYX"), separator="\t")
    return text, {
        "file": {"separator": "tab"},
        "position": {"columns": ["X", "Y", "Z"], "unit": "mm"},
        "orientation": {"columns": ["A", "B", "C"], "convention": "kuka", "unit": "deg"},
        **joints(names, "deg"),
        "pose": {"column": "Nr"},
    }


def fanuc():
    names = [f"J{k}" for k in range(1, 7)]
    header = ["point", "x", "y", "z", "w", "p", "r", *names]
    text = lines(header, np.arange(1, N + 1), MM, C.angles("xyz"), DEG, separator=",")
    return text, {
        "position": {"columns": ["x", "y", "z"], "unit": "mm"},
        "orientation": {"columns": ["w", "p", "r"], "convention": "fanuc", "unit": "deg"},
        **joints(names, "deg"),
        "pose": {"column": "point"},
    }


def abb():
    names = [f"rax_{k}" for k in range(1, 7)]
    header = [*names, "x", "y", "z", "q1", "q2", "q3", "q4"]
    quaternion = C.attitude.as_quat()[:, [3, 0, 1, 2]]
    text = lines(header, DEG, MM, quaternion, separator=",")
    return text, {
        "position": {"columns": ["x", "y", "z"], "unit": "mm"},
        "orientation": {"columns": ["q1", "q2", "q3", "q4"], "convention": "quaternion-wxyz"},
        **joints(names, "deg"),
    }


def rtde():
    names = [f"target_q_{k}" for k in range(6)]
    actual = [f"actual_q_{k}" for k in range(6)]
    header = ["timestamp", *names, *actual, "tracker_x", "tracker_y", "tracker_z", "payload"]
    mass = np.where(np.arange(N) % 2, 0.0, 5.0)
    text = lines(header, 8.0 * np.arange(N), C.q, C.q + 1e-5, C.position, mass, separator=" ")
    return text, {
        "file": {"separator": "blanks"},
        "position": {"columns": ["tracker_x", "tracker_y", "tracker_z"], "unit": "m"},
        **joints(names, "rad"),
        "actual_joints": {"columns": actual, "unit": "rad"},
        "time": {"column": "timestamp", "unit": "s"},
        "load": {"column": "payload"},
    }


def with_units_row():
    names = [f"theta{k}" for k in range(1, 7)]
    xyz, sigma = ["MeasX", "MeasY", "MeasZ"], ["UncX", "UncY", "UncZ"]
    head = ["Pose", *names, *xyz, *sigma]
    units = ["-", *["deg"] * 6, *["mm"] * 6]
    text = "# exported\n" + ",".join(head) + "\n" + ",".join(units) + "\n"
    text += lines(None, [f"P{k}" for k in range(N)], DEG, MM, SIGMA[:, :3], separator=",")
    return text, {
        "file": {"comment": "#", "header_row": 2, "units_row": 3},
        "position": {"columns": xyz, "unit": "mm"},
        **joints(names, "deg"),
        "pose": {"column": "Pose"},
        "std": {"columns": sigma, "unit": "mm"},
    }


def expanded():
    names = [f"q{k}_rad" for k in range(1, 7)]
    header = ["id", *names, "x_m", "y_m", "z_m", "U95_x", "U95_y", "U95_z", "date"]
    start = datetime(2024, 5, 31, 8)
    stamps = [(start + timedelta(minutes=k)).strftime("%d.%m.%Y %H:%M:%S") for k in range(N)]
    text = lines(
        header, np.arange(N), C.q, C.position, 2e-3 * SIGMA[:, :3], stamps, separator=",", digits=8
    )
    return text, {
        "position": {"columns": ["x_m", "y_m", "z_m"], "unit": "m"},
        **joints(names, "rad"),
        "pose": {"column": "id"},
        "std": {"columns": ["U95_x", "U95_y", "U95_z"], "kind": "expanded", "k": 2.0, "unit": "m"},
        "time": {"column": "date", "unit": "format", "format": "%d.%m.%Y %H:%M:%S"},
    }


def forces():
    names = [f"joint_{k}" for k in range(1, 7)]
    header = [*names, "x", "y", "z", "rx", "ry", "rz", "Fx", "Fy", "Fz", "Mx", "My", "Mz"]
    wrench = np.where(np.arange(N)[:, None] % 2, 0.0, 10.0) * np.ones(6)
    text = lines(header, C.q, C.position, C.attitude.as_rotvec(), wrench, separator=",")
    return text, {
        "position": {"columns": ["x", "y", "z"], "unit": "m"},
        "orientation": {
            "columns": ["rx", "ry", "rz"], "convention": "rotation-vector", "unit": "rad",
        },
        **joints(names, "rad"),
        "wrench": {"columns": ["Fx", "Fy", "Fz", "Mx", "My", "Mz"]},
    }  # fmt: skip


def without_header():
    text = lines(None, MM, DEG, separator=",")
    return text, {
        "file": {"header_row": 0},
        "position": {"columns": ["1", "2", "3"], "unit": "mm"},
        **joints(["4", "5", "6", "7", "8", "9"], "deg"),
    }


def numpy_savetxt():
    names = [f"q{k}" for k in range(1, 7)]
    text = "# " + lines([*names, "x", "y", "z"], C.q, MM, separator=" ", digits=8)
    return text, {
        "file": {"separator": "blanks", "comment": "#"},
        "position": {"columns": ["x", "y", "z"], "unit": "mm"},
        **joints(names, "rad"),
    }


def thousands():
    names = [f"J{k}" for k in range(1, 7)]
    text = ";".join([*names, "X", "Y", "Z", ""]) + "\n"
    for q, p in zip(DEG, MM, strict=True):
        cells = [f"{v:.4f}" for v in q] + [f"{v:,.4f}" for v in p]
        text += ";".join(c.replace(",", "'") for c in cells) + ";\n"
    return text, {
        "file": {"separator": ";", "thousands": "'"},
        "position": {"columns": ["X", "Y", "Z"], "unit": "mm"},
        **joints(names, "deg"),
    }


def ros():
    names = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"]
    names += [f"wrist_{k}_joint" for k in (1, 2, 3)]
    header = ["Goal x", "Goal y", "Goal z", *names]
    header += [f"measurement_{what}{e}" for e in ("x", "y", "z") for what in ("", "std_")]
    header += [f"measurement_{what}{e}" for e in ("rx", "ry", "rz") for what in ("", "std_")]
    pairs = np.stack([MM, SIGMA[:, :3]], axis=2).reshape(N, 6)
    turned = np.stack([C.angles("XYZ"), SIGMA[:, 3:]], axis=2).reshape(N, 6)
    text = lines(header, C.position, C.q, pairs, turned, comma=True)
    std = [f"measurement_std_{e}" for e in ("x", "y", "z", "rx", "ry", "rz")]
    return text, {
        "file": {"separator": ";", "decimal": ","},
        "position": {"columns": [f"measurement_{e}" for e in "xyz"], "unit": "mm"},
        "orientation": {
            "columns": [f"measurement_r{e}" for e in "xyz"], "convention": "fixed-xyz",
            "unit": "deg",
        },
        **joints(names, "rad"),
        "std": {"columns": std, "unit": "mm", "angle_unit": "deg"},
    }  # fmt: skip


CASES = {
    f.__name__: f
    for f in (
        german, kuka, fanuc, abb, rtde, with_units_row, expanded, forces, without_header,
        numpy_savetxt, thousands, ros,
    )
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_the_guess_is_the_mapping(case, tmp_path):
    text, wanted = CASES[case]()
    encoding = "latin-1" if case == "german" else "utf-8"
    found = propose(write(tmp_path / "t.csv", text, encoding)).proposal
    expected = check_section(wanted, Mapping, "wanted")
    if case == "german":
        wanted["file"]["encoding"] = "latin-1"
        expected = check_section(wanted, Mapping, "wanted")
    assert found.mapping(Mapping).model_dump() == expected.model_dump()
    (tmp_path / "m.toml").write_text(found.to_toml("t.csv"))
    assert load_mapping(tmp_path / "m.toml", Mapping) == found.mapping(Mapping)


def test_a_file_for_the_positions_and_one_for_the_joints(tmp_path):
    order = np.random.default_rng(0).permutation(N)
    names = [f"A{k}" for k in range(1, 7)]
    points = [f"P{k}" for k in range(N)]
    write(tmp_path / "tracker.csv", lines(["Point", "X", "Y", "Z"], points, MM, separator=","))
    shuffled = lines(["Name", *names], [points[k] for k in order], DEG[order], comma=True)
    write(tmp_path / "robot.csv", shuffled + "P999;0;0;0;0;0;0\n")
    found = propose(tmp_path / "tracker.csv", tmp_path / "robot.csv")
    second = found.proposal.mapping(Mapping).second_file
    assert (second.match, second.separator, second.decimal) == (("Point", "Name"), ";", ",")
    np.testing.assert_allclose(found.grid.numbers("A3"), DEG[:, 2], atol=1e-6)
    one = propose(tmp_path / "tracker.csv")
    assert one.proposal.lacking == [
        "no joint angles: where they are in a file of their own, give it with --second"
    ]


def test_a_missing_point(tmp_path):
    p = MM.copy()
    p[3] = p[7] = -9999
    names = [f"A{k}" for k in range(1, 7)]
    write(tmp_path / "t.csv", lines(["X", "Y", "Z", *names], p, DEG))
    found = propose(tmp_path / "t.csv").proposal
    assert found.mapping(Mapping).file.missing == (-9999.0,)
    assert ("file", "-9999 stands for a missing point") in found.unsure


def test_lines_that_are_no_readings(tmp_path):
    names = [f"A{k}" for k in range(1, 7)]
    text = "Tracker report\n\n" + lines([*names, "X", "Y", "Z"], DEG, MM) + "end;of;file\n\n\n"
    found = propose(write(tmp_path / "t.csv", text))
    assert found.proposal.mapping(Mapping).file.header_row == 3
    assert len(found.grid.rows) == N
    assert any("are left out" in words for _, words in found.proposal.unsure)


def test_only_text(tmp_path):
    path = write(tmp_path / "t.csv", "name,colour\nbob,red\n")
    with pytest.raises(InputError, match="no columns of numbers"):
        propose(path)
