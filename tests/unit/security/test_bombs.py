"""Files that are made to exhaust the computer, or to reach beyond themselves, are refused."""

import contextlib
import gc
import io
import json
import pickle
import re
import resource
import sqlite3
import threading
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

import hilcal as hc
from hilcal import limits
from hilcal.cli import main
from hilcal.drivers.simulated.user_effect import check_hash
from hilcal.errors import InputError
from hilcal.identification import parameters_document
from hilcal.readings.covariance import INSTRUMENT
from hilcal.readings.whitening import deflection_groups
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step, load_plan, read_plan
from hilcal.store.rows import text_crc
from hilcal.tables import parquet_stream
from hilcal.tables.files import open_grid
from hilcal.tables.grid import Grid, unique
from hilcal.tables.mapping import FileFormat, Mapping, load_mapping
from hilcal.tables.propose import propose
from hilcal.tables.table import write_table
from hilcal.toml import parse_json, read_toml, suggest
from hilcal.transfer.members import LIST, entries
from tests.support.campaigns import campaign, configuration
from tests.support.cli_cases import refused
from tests.support.refusals import refusal
from tests.support.unguarded import unguarded
from tests.unit.data.test_campaign import HASHED, unpacked

HEAD = (
    b'<?xml version="1.0"?><worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/'
    b'2006/main"><sheetData>'
)
END = b"</sheetData></worksheet>"
SHEET = "xl/worksheets/sheet1.xml"


def workbook(path, part, change):
    """A workbook of two cells, with a part of it changed."""
    book, out = openpyxl.Workbook(), io.BytesIO()
    book.active.append([1.0, 2.0])
    book.save(out)
    with zipfile.ZipFile(out) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, change(old.read(name)) if name == part else old.read(name))
    return path


def rows(text):
    return lambda _: HEAD + text + END


WORKBOOKS = {
    "row 2,000,000,000": (SHEET, rows(b'<row r="2000000000"><c><v>1</v></c></row>'), "rows"),
    "column XFD": (
        SHEET,
        rows(b'<row><c r="XFD1"><v>1</v></c></row>' * 400),
        "cells|columns|elements",
    ),
    "many cells in a row": (SHEET, rows(b"<row>" + b"<c/>" * 30_000 + b"</row>"), "in a row"),
    "elements in each other": (SHEET, rows(b"<a>" * 60 + b"</a>" * 60), "in each other"),
    "a tag without end": (SHEET, rows(b"<a " + b"x" * 2_000_000), "a tag"),
    "styles": (
        "xl/styles.xml",
        lambda text: text.replace(b"</cellXfs>", b"<xf/>" * 5000 + b"</cellXfs>"),
        "elements",
    ),
    "sheets": (
        "xl/workbook.xml",
        lambda text: re.sub(b"(<sheet .*?/>)", rb"\1" * 200, text),
        "sheets",
    ),
}


@pytest.mark.parametrize("way", [lambda p: open_grid(p, FileFormat()), propose])
@pytest.mark.parametrize("name", WORKBOOKS)
def test_a_workbook_that_unpacks_to_much_more(name, way, tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "ROWS", 1000)
    monkeypatch.setattr(limits, "CELLS", 1_000_000)
    monkeypatch.setattr(limits, "ELEMENTS", 2000)
    part, change, words = WORKBOOKS[name]
    path = workbook(tmp_path / "t.xlsx", part, change)
    assert path.stat().st_size < 100_000
    refusal(words, way, path)


def test_columns_of_any_table_are_counted_and_long_names_not_compared():
    """A MAT file of 1 MB has 20,000 matrices."""
    names = tuple(map(str, range(limits.COLUMNS + 1)))
    columns = tuple([1.0] for _ in names)
    with pytest.raises(InputError, match="columns; valid: at most"):
        Grid("t.mat", names, np.arange(1), columns, (FileFormat(),) * len(names))
    names = unique(["a"] * 2000)
    assert names[:3] == ("a", "a (2)", "a (3)")
    assert len(set(names)) == 2000
    assert unique(["a (2)", "a", "a", "", "2"]) == ("a (2)", "a", "a (3)", "4", "2")
    assert suggest("mass_kk", ["mass_kg"]) == ' (did you mean "mass_kg"?)'
    assert suggest("m" * 1000, ["m" * 999]) == ""
    assert suggest("mass_kk", [f"x{k}" for k in range(1000)] + ["mass_kg"]) == ""


@pytest.mark.long
def test_memory_that_runs_out_is_one_line_and_the_limit_is_as_before(monkeypatch):
    """Of small objects: nothing is left for the next one."""
    monkeypatch.setattr(limits, "MEMORY", 1 << 25)
    before = resource.getrlimit(resource.RLIMIT_AS)

    @limits.bounded
    def read(path):
        collected = []
        while len(collected) < 10_000_000:
            collected.append([len(collected)])
        return collected

    gc.collect()
    gc.disable()  # a finalizer of another test that runs out of memory, too, is told as an error
    try:
        refusal("table: reading it takes more than 34 MB of memory", read, "table")
    finally:
        gc.enable()
    assert resource.getrlimit(resource.RLIMIT_AS) == before


def test_two_threads_that_read_leave_the_limit_as_it_was():
    before = resource.getrlimit(resource.RLIMIT_AS)
    first_in, first_out = threading.Event(), threading.Event()

    def first():
        with limits.memory("first"):
            first_in.set()
            first_out.wait(0.2)

    def second():
        first_in.wait()
        with limits.memory("second"):
            first_out.set()
            other.join(0.2)

    other, another = threading.Thread(target=first), threading.Thread(target=second)
    other.start()
    another.start()
    other.join()
    another.join()
    assert resource.getrlimit(resource.RLIMIT_AS) == before


SETTINGS = {
    "dots": ("a." * 150 + "b = 1", "more than 100 dots"),
    "digits": ("x = " + "9" * 5000, "not TOML"),
    "hexadecimal": ("[tool]\nmass_kg = 0x" + "f" * 20_000, "80000 bits; valid: of 64"),
    "of a list": ("x = [1, [0x8000000000000000]]", "64 bits; valid: of 64"),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_of_thousands_of_digits_or_parts(name, tmp_path, capsys):
    path = tmp_path / "cell.toml"
    path.write_text(SETTINGS[name][0])
    assert SETTINGS[name][1] in refused(capsys, 2, "check", path)


def test_whole_numbers_of_settings_keep_64_bits(tmp_path):
    path = tmp_path / "x.toml"
    path.write_text(f"x = [{-(1 << 63)}, {(1 << 63) - 1}]\ny = 1.{'0' * 90}\n")
    assert read_toml(path)["x"] == [-(1 << 63), (1 << 63) - 1]


def test_a_document_of_too_many_values_or_digits(monkeypatch, tmp_path):
    monkeypatch.setattr(limits, "VALUES", 1000)
    assert parse_json("[" + "1," * 900 + "1]")[-1] == 1
    for text in ("[" + "[]," * 999 + "[]]", "[" * 1001, '{"a":1,' * 500, f"[{10**100}]"):
        with pytest.raises(ValueError, match=r"million values|digits"):
            parse_json(text)
    path = tmp_path / "parameters.json"
    path.write_text(json.dumps({"parameters": [{"value": 10**400}], "covariance": ""}))
    refusal("401 digits", parameters_document.read, path)


def plan(poses):
    names = tuple(f"p{k}" for k in range(poses))
    return Plan(names, np.zeros((poses, 6)), tuple(Step(p, "none", 0) for p in names))


def test_a_plan_of_too_many_poses_and_a_list_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "PLANNED_POSES", 50)
    path = tmp_path / "plan.json"
    path.write_text(plan(50).to_json())
    assert len(load_plan(path).steps) == 50
    path.write_text(plan(51).to_json())
    refusal("51 poses; valid: at most 50", load_plan, path)
    monkeypatch.setattr(limits, "LINE", 1000)
    (tmp_path / "a.hilcal").touch()
    (tmp_path / LIST).write_text("campaign,arm\n" + "a" * 2000)
    refusal("row 2 is longer than 1000", entries, tmp_path)


@pytest.mark.parametrize("pose", [[], {}, None, 1])
def test_a_step_of_a_pose_that_is_no_text(pose):
    content = json.loads(plan(2).to_json())
    content["steps"][0]["pose"] = pose
    refusal("step 1: there is no pose", read_plan, json.dumps(content), "plan")


def test_readings_beyond_what_is_fitted_are_neither_stored_nor_read(tmp_path, monkeypatch):
    made = campaign("joint_tilt_compliance", "deflection", 3, poses=4)
    readings, path = made.readings, tmp_path / "run.hilcal"
    with CampaignFile.create(path, configuration().to_json(), str(tmp_path), "test") as file:
        file.append_readings(readings)
        monkeypatch.setattr(limits, "FITTED_ELEMENTS", readings.m * len(readings))
        assert len(file.readings()) == len(readings)
        refusal(f"at most {len(readings)} in a campaign", file.append_readings, readings[:1])
        monkeypatch.setattr(limits, "FITTED_ELEMENTS", readings.m * len(readings) - 1)
        refusal(rf"run\.hilcal: {len(readings)} readings", file.readings)
    refusal(f"{len(readings)} readings of 3 elements", hc.baseline, made.cell, readings)
    write_table(readings, tmp_path / "t.csv", INSTRUMENT)
    refusal(rf"t\.csv: {len(readings)} readings", hc.read_table, tmp_path / "t.csv", made.cell)


def test_many_repeats_of_one_unloaded_reading_make_no_matrix(monkeypatch):
    readings = campaign("joint_tilt_compliance", "deflection", 3, poses=4).readings
    one = np.flatnonzero(readings.pose == 0)
    many = readings[np.tile(one, 40)]
    groups = deflection_groups(replace(many, common=None))
    shared = groups[0][0].shape[1]
    monkeypatch.setattr(limits, "SHARED_COVARIANCE", (shared * readings.m) ** 2 - 1)
    refusal(f"{shared} loaded readings share one unloaded", deflection_groups, many)


def test_a_row_group_that_holds_less_than_it_says(monkeypatch):
    """As damaged pages make it: pyarrow yields nothing, and says nothing."""
    group = SimpleNamespace(num_rows=3)
    file = SimpleNamespace(
        metadata=SimpleNamespace(row_group=lambda _: group), iter_batches=lambda *_, **__: iter(())
    )
    monkeypatch.setattr(parquet_stream, "_opened", lambda _: file)
    with pytest.raises(InputError, match=r"row group 1 \(3 rows are missing\)"):
        next(parquet_stream._tables(Path("s.parquet"), 0, ("x_m",)))


class _Touch:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


def xlsx(path, head, value):
    """A workbook with a document type and a text of its own."""
    text = (
        f'<?xml version="1.0"?>{head}<worksheet xmlns="http://schemas.openxmlformats.org/'
        f'spreadsheetml/2006/main"><sheetData><row r="1"><c r="A1" t="inlineStr"><is><t>{value}'
        '</t></is></c><c r="B1"><v>1</v></c></row><row r="2"><c r="A2"><v>1</v></c></row>'
        "</sheetData></worksheet>"
    )
    return workbook(path, SHEET, lambda _: text.encode())


def cells(path):
    try:
        grid = open_grid(path, FileFormat())
    except InputError:
        return ""
    return repr((grid.names, grid.columns))


def test_entities_of_a_spreadsheet_read_no_file_and_fill_no_memory(tmp_path):
    """Ten levels of ten: 10^10 letters."""
    secret = tmp_path / "secret"
    secret.write_text("TOPSECRET")
    head = f'<!DOCTYPE x [<!ENTITY e SYSTEM "{secret.as_uri()}">]>'
    assert "TOPSECRET" not in cells(xlsx(tmp_path / "t.xlsx", head, "&e;"))
    levels = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 11))
    head = f'<!DOCTYPE x [<!ENTITY e0 "aaaaaaaaaa">{levels}]>'
    assert len(cells(xlsx(tmp_path / "t.xlsx", head, "&e10;"))) < 10**6


def test_a_zip_bomb_is_not_unpacked_whatever_it_states(tmp_path, monkeypatch):
    path = tmp_path / "t.xlsx"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("xl/workbook.xml", b" " * 10**7)
    data = path.read_bytes()
    path.write_bytes(data.replace((10**7).to_bytes(4, "little"), (10).to_bytes(4, "little")))
    assert cells(path) == ""
    monkeypatch.setattr(limits, "UNPACKED", 10**7)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("xl/workbook.xml", b" " * 10**8)
    assert path.stat().st_size < 10**6
    refusal(r"unpacked: 100\.0 MB", open_grid, path, FileFormat())


def test_pickles_and_objects_in_a_mat_file_are_not_loaded(tmp_path):
    mark, path = tmp_path / "mark", tmp_path / "t.mat"
    text = np.array([pickle.dumps(_Touch(mark)).decode("latin-1"), "b"], dtype=object)
    savemat(path, {"a": np.arange(6.0).reshape(3, 2), "o": text})
    assert "a(1)" in cells(path)
    assert not mark.exists()
    path = tmp_path / "t.pkl"
    path.write_bytes(pickle.dumps(_Touch(mark)))
    refusal("never loaded", open_grid, path, FileFormat())
    assert not mark.exists()


@pytest.mark.parametrize("name", [b"arrow.py_extension_type", b"pandas"])
def test_pickles_in_the_metadata_of_a_parquet_file_are_not_loaded(name, tmp_path):
    """As in CVE-2023-47248 of pyarrow."""
    mark, path = tmp_path / "mark", tmp_path / "t.parquet"
    about = {b"ARROW:extension:name": name, b"ARROW:extension:metadata": pickle.dumps(_Touch(mark))}
    field = pa.field("x_m", pa.float64(), metadata=about)
    pq.write_table(pa.table([pa.array([1.0, 2.0])], schema=pa.schema([field])), path)
    assert "x_m" in cells(path)
    assert not mark.exists()


@pytest.mark.parametrize("how", ["above", "absolute", "link"])
def test_a_mapping_names_no_file_outside_its_folder(how, tmp_path):
    secret, folder = tmp_path / "secret.csv", tmp_path / "sent"
    secret.write_text("q1\n0\n")
    folder.mkdir()
    (folder / "link.csv").symlink_to(secret)
    name = {"above": "../secret.csv", "absolute": str(secret), "link": "link.csv"}[how]
    path = folder / "m.toml"
    joints = "[joints]\nunit = 'rad'\ncolumns = ['a', 'b', 'c', 'd', 'e', 'f']\n"
    position = "[position]\nunit = 'm'\ncolumns = ['x', 'y', 'z']\n"
    path.write_text(f"{position}{joints}[second_file]\npath = {name!r}\n")
    refusal("leaves the folder of the mapping", load_mapping, path, Mapping)
    path.write_text(f"{position}{joints}[second_file]\npath = 'beside.csv'\n")
    assert load_mapping(path, Mapping).second_file is not None


@pytest.mark.parametrize("command", ["info", "compare", "diagnose", "identify", "refine"])
def test_effect_files_of_a_campaign_that_one_was_sent_are_not_run(command, tmp_path, capsys):
    """Its revision names a file that lies beside it; nobody gave it by --effects-from."""
    path, mark, law = unpacked(HASHED, tmp_path), tmp_path / "mark", tmp_path / "law.py"
    law.write_text(f"open({str(mark)!r}, 'w')\n")
    with sqlite3.connect(path) as db, unguarded(db):
        content = json.loads(db.execute("SELECT content FROM revisions").fetchone()[0])
        content["effects"].append("their_law")
        content["options"]["effects"]["their_law"] = {}
        content["options"]["effects_from"] = {"their_law": {"file": str(law), "sha256": "ab" * 32}}
        text = json.dumps(content)
        db.execute("UPDATE revisions SET content = ?, crc = ?", (text, text_crc("1", text)))
    db.close()
    with contextlib.suppress(SystemExit):
        main([command, str(path)])
    said = " ".join(capsys.readouterr().err.split())
    assert not mark.exists()
    if command in ("compare", "diagnose"):  # the others need no revision
        assert "--effects-from" in said
        assert "abababababababab" in said
        assert "read it first" in said


def test_a_changed_law_of_a_simulated_world_is_refused_before_it_is_run(tmp_path):
    law = tmp_path / "law.py"
    law.write_text("1 / 0\n")
    refusal("changed since", check_hash, law, "0" * 64)
