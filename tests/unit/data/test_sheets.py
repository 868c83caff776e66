"""Spreadsheets, MAT and Parquet files hold the same readings as text; others are refused."""

import io
import pickle
import zipfile
from datetime import datetime, timedelta

import numpy as np
import openpyxl
import pyarrow
import pytest
from pyarrow import parquet
from scipy.io import savemat

from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise
from hilcal.robot.catalogue import load_arm
from hilcal.tables.files import open_grid
from hilcal.tables.mapped import import_mapped
from hilcal.tables.mapping import FileFormat, Mapping
from hilcal.tables.propose import propose
from hilcal.tables.table import import_table
from hilcal.toml import check_section
from tests.support.foreign_tables import campaign
from tests.support.refusals import refusal

C = campaign(12)
NOISE = TrackerNoise(10e-6, 0.3e-6, 15e-6, 6e-6, 1e-4)
NAMES = [f"A{k}" for k in range(1, 7)]
START = datetime(2024, 5, 31, 23, 59)


@pytest.fixture(scope="module")
def arm():
    return load_arm("ur10e")


def section(**more):
    basic = {
        "position": {"columns": ["X", "Y", "Z"], "unit": "mm"},
        "joints": {"columns": NAMES, "unit": "deg"},
    }
    return check_section(basic | more, Mapping, "m.toml")


def read(path, mapping, arm):
    return import_mapped(path, mapping, arm, NOISE).readings


def book(path):
    out = openpyxl.Workbook()
    notes = out.active
    notes.title = "Notes"
    notes["A1"] = "nothing here"
    sheet = out.create_sheet("Data")
    sheet.append(["Measured on a Friday"])
    sheet.append([])
    sheet.append(["When", *NAMES, "X", "Y", "Z", "Load"])
    for k in range(12):
        sheet.append(
            [
                START + timedelta(seconds=30 * k),
                *np.rad2deg(C.q[k]).tolist(),
                *(1e3 * C.position[k]).tolist(),
                "none" if k % 2 else 5,
            ]
        )
    out.save(path)


def test_a_spreadsheet(tmp_path, arm):
    path = tmp_path / "t.xlsx"
    book(path)
    mapping = propose(path).proposal.mapping(Mapping)
    assert (mapping.file.sheet, mapping.file.header_row) == ("Data", 3)
    x = read(path, mapping, arm)
    np.testing.assert_allclose(x.states.q, C.q, atol=1e-12)
    np.testing.assert_allclose(x.value, C.position, atol=1e-12)
    np.testing.assert_allclose(x.states.time, 30 * np.arange(12))
    assert x.load_names == ("5", "none")
    with pytest.raises(InputError, match=r"no sheet 'Date' \(did you mean \"Data\"\?\); it has"):
        open_grid(path, FileFormat(sheet="Date"))


def test_a_formula_without_a_stored_value_is_no_number(tmp_path, arm):
    path = tmp_path / "t.xlsx"
    book(path)
    edited = openpyxl.load_workbook(path)
    edited["Data"]["B5"] = "=1+1"
    edited.save(path)
    mapping = section(file={"sheet": "Data", "header_row": 3})
    result = import_mapped(path, mapping, arm, NOISE)
    assert result.notes[0] == "1 of 12 rows left out (5): no value in A1"


def test_a_mat_file(tmp_path, arm):
    path = tmp_path / "t.mat"
    t = np.zeros((4, 4, 12))
    t[:3, :3], t[:3, 3], t[3, 3] = np.moveaxis(C.attitude.as_matrix(), 0, 2), C.position.T, 1
    savemat(path, {"q": C.q, "run": {"p": 1e3 * C.position, "who": "me"}, "T": t, "n": 12.0})
    grid = open_grid(path, FileFormat())
    assert {"q(1)", "run.p(3)", "T(1,4)"} <= set(grid.names)
    mapping = check_section(
        {
            "position": {"columns": ["run.p(1)", "run.p(2)", "run.p(3)"], "unit": "mm"},
            "joints": {"columns": [f"q({k})" for k in range(1, 7)], "unit": "rad"},
            "orientation": {
                "columns": [f"T({i},{j})" for i in (1, 2, 3) for j in (1, 2, 3)],
                "convention": "matrix",
            },
        },
        Mapping,
        "m.toml",
    )
    x = read(path, mapping, arm)
    np.testing.assert_allclose(x.states.q, C.q)
    np.testing.assert_allclose(x.value[:, :3], C.position)
    np.testing.assert_allclose(x.value[:, 3:], C.attitude.as_rotvec(), atol=1e-9)
    refusal("no variable 'Q'", open_grid, path, FileFormat(variable="Q"))


def test_parquet(tmp_path, arm):
    path = tmp_path / "t.parquet"
    columns = {n: np.rad2deg(C.q[:, k]) for k, n in enumerate(NAMES)}
    columns |= {n: 1e3 * C.position[:, k] for k, n in enumerate("XYZ")}
    columns["pose"] = [f"P{k}" for k in range(12)]
    columns["raw"] = [[1.0, 2.0]] * 12
    parquet.write_table(pyarrow.table(columns), path)
    mapping = propose(path).proposal.mapping(Mapping)
    assert mapping == section(pose={"column": "pose"})
    np.testing.assert_allclose(read(path, mapping, arm).value, C.position)


def test_a_second_sheet_of_readings_is_said_to_be_left_out(tmp_path):
    book(tmp_path / "t.xlsx")
    out = openpyxl.load_workbook(tmp_path / "t.xlsx")
    out.copy_worksheet(out["Data"]).title = "Tuesday"
    out.save(tmp_path / "t.xlsx")
    proposal = propose(tmp_path / "t.xlsx").proposal
    assert ("file", "only this sheet is read, and not Tuesday") in proposal.doubts


def _zip(**members):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


@pytest.mark.parametrize(("content", "message"), [
    (b"\x89HDF\r\n\x1a\n and so on", r"HDF5 file \(MATLAB's -v7.3\); save it with -v7"),
    (pickle.dumps([1, 2]), "pickle, which is never loaded"),
    (b"\xd0\xcf\x11\xe0 and so on", r"old Excel file"),
    (_zip(a=b"1"), "a zip archive that is no XLSX"),
    (b"PK\x03\x04 cut", "damaged"),
    (b"PAR1 cut", "damaged"),
    (b"MATLAB 5.0 MAT-file cut", "t.bin"),
    (b"\x1f\x8b\x08", "gzip"),
    (b"a\x00b", "binary data"),
    (b"", "empty")])  # fmt: skip
def test_what_is_no_table(content, message, tmp_path):
    path = tmp_path / "t.bin"
    path.write_bytes(content)
    for attempt in (lambda: open_grid(path, FileFormat()), lambda: propose(path)):
        refusal(message, attempt)


def test_an_exchange_table_may_be_a_sheet(tmp_path, arm):
    text, sheet = tmp_path / "t.csv", tmp_path / "t.xlsx"
    header = ["pose", "load", *(f"q{k}_rad" for k in range(1, 7)), "x_m", "y_m", "z_m"]
    rows = [[f"P{k}", "none", *C.q[k], *C.position[k]] for k in range(3)]
    text.write_text("\n".join(",".join(map(str, row)) for row in [header, *rows]))
    out = openpyxl.Workbook()
    for row in [header, *rows]:
        out.active.append(row)
    out.save(sheet)
    one, other = (import_table(path, arm, NOISE).readings for path in (text, sheet))
    np.testing.assert_allclose(one.value, other.value, rtol=1e-15)
    np.testing.assert_allclose(one.states.q, other.states.q, rtol=1e-15)
    assert one.pose_names == other.pose_names
    out.active.cell(3, 9, "abc")
    out.save(sheet)
    refusal(r"t.xlsx: row 3, column 'x_m': 'abc' is not a number", import_table, sheet, arm, NOISE)


def test_merged_cells_and_numbers_as_texts(tmp_path, arm):
    """Three repeats of each state: its load and pose stand in cells that are merged."""
    out = openpyxl.Workbook()
    sheet = out.active
    sheet.append(["Pose", "Load", *NAMES, "X", "Y", "Z"])
    for k in range(24):
        angles = [f"{v:.6f}".replace(".", ",") for v in np.rad2deg(C.q[k // 6])]
        load = ["none", "5 kg"][k // 3 % 2]
        first = k % 3 == 0
        sheet.append(["P" * first, load if first else None, *angles, *(1e3 * C.position[k // 6])])
        sheet.cell(k + 2, 1).value = f"P{k // 6}" if k % 6 == 0 else None
        if first:
            sheet.merge_cells(start_row=k + 2, end_row=k + 4, start_column=2, end_column=2)
        if k % 6 == 0:
            sheet.merge_cells(start_row=k + 2, end_row=k + 7, start_column=1, end_column=1)
    out.save(tmp_path / "t.xlsx")
    mapping = propose(tmp_path / "t.xlsx").proposal.mapping(Mapping)
    assert (mapping.file.decimal, mapping.pose.column) == (",", "Pose")
    x = read(tmp_path / "t.xlsx", mapping, arm)
    assert [x.load_names[k] for k in x.load] == 4 * [*3 * ["none"], *3 * ["5 kg"]]
    assert x.pose_names == ("P0", "P1", "P2", "P3")
    np.testing.assert_allclose(x.states.q, np.repeat(C.q[:4], 6, axis=0), atol=2e-8)
