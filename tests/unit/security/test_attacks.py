"""Files that somebody sent, made to run code, to read elsewhere or to fill the memory."""

import contextlib
import io
import json
import pickle
import sqlite3
import zipfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from hilcal import limits
from hilcal.cli import main
from hilcal.drivers.simulated.own_law import check_hash
from hilcal.errors import InputError
from hilcal.store.rows import text_crc
from hilcal.tables.files import open_grid
from hilcal.tables.mapping import FileFormat, Mapping, load_mapping
from tests.support.unguarded import unguarded
from tests.unit.data.test_campaign import HASHED, unpacked

SHEET = "xl/worksheets/sheet1.xml"


class _Touch:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.mark,)


def xlsx(path: Path, sheet: bytes) -> Path:
    """A workbook with the sheet's XML as given."""
    import openpyxl

    book, out = openpyxl.Workbook(), io.BytesIO()
    book.active.append([1.0, 2.0])
    book.save(out)
    with zipfile.ZipFile(out) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            new.writestr(name, sheet if name == SHEET else old.read(name))
    return path


def sheet(head: str, value: str) -> bytes:
    return (
        f'<?xml version="1.0"?>{head}<worksheet xmlns="http://schemas.openxmlformats.org/'
        f'spreadsheetml/2006/main"><sheetData><row r="1"><c r="A1" t="inlineStr"><is><t>{value}'
        '</t></is></c><c r="B1"><v>1</v></c></row><row r="2"><c r="A2"><v>1</v></c></row>'
        "</sheetData></worksheet>"
    ).encode()


def cells(path: Path) -> str:
    try:
        grid = open_grid(path, FileFormat())
    except InputError:
        return ""
    return repr((grid.names, grid.columns))


def test_an_external_entity_of_a_spreadsheet_reads_no_file(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("TOPSECRET")
    head = f'<!DOCTYPE x [<!ENTITY e SYSTEM "{secret.as_uri()}">]>'
    assert "TOPSECRET" not in cells(xlsx(tmp_path / "t.xlsx", sheet(head, "&e;")))


def test_entities_that_grow_fill_no_memory(tmp_path: Path) -> None:
    """Ten levels of ten: 10^10 letters."""
    levels = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10}">' for k in range(1, 11))
    head = f'<!DOCTYPE x [<!ENTITY e0 "aaaaaaaaaa">{levels}]>'
    assert len(cells(xlsx(tmp_path / "t.xlsx", sheet(head, "&e10;")))) < 10**6


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "UNPACKED", 10**7)
    path = tmp_path / "t.xlsx"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("xl/workbook.xml", b" " * 10**8)
    assert path.stat().st_size < 10**6
    with pytest.raises(InputError, match=r"unpacked: 100\.0 MB"):
        open_grid(path, FileFormat())


def test_a_zip_that_states_less_than_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "t.xlsx"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("xl/workbook.xml", b" " * 10**7)
    data = path.read_bytes()
    path.write_bytes(data.replace((10**7).to_bytes(4, "little"), (10).to_bytes(4, "little")))
    assert cells(path) == ""


def test_objects_in_a_mat_file_are_not_loaded(tmp_path: Path) -> None:
    mark, path = tmp_path / "mark", tmp_path / "t.mat"
    text = np.array([pickle.dumps(_Touch(mark)).decode("latin-1"), "b"], dtype=object)
    savemat(path, {"a": np.arange(6.0).reshape(3, 2), "o": text})
    assert "a(1)" in cells(path)
    assert not mark.exists()


def test_pickles_are_refused_by_name(tmp_path: Path) -> None:
    mark, path = tmp_path / "mark", tmp_path / "t.pkl"
    path.write_bytes(pickle.dumps(_Touch(mark)))
    with pytest.raises(InputError, match="never loaded"):
        open_grid(path, FileFormat())
    assert not mark.exists()


@pytest.mark.parametrize("name", [b"arrow.py_extension_type", b"pandas"])
def test_pickles_in_the_metadata_of_a_parquet_file_are_not_loaded(
    name: bytes, tmp_path: Path
) -> None:
    """As in CVE-2023-47248 of pyarrow."""
    mark, path = tmp_path / "mark", tmp_path / "t.parquet"
    about = {b"ARROW:extension:name": name, b"ARROW:extension:metadata": pickle.dumps(_Touch(mark))}
    field = pa.field("x_m", pa.float64(), metadata=about)
    pq.write_table(pa.table([pa.array([1.0, 2.0])], schema=pa.schema([field])), path)
    assert "x_m" in cells(path)
    assert not mark.exists()


@pytest.mark.parametrize("how", ["above", "absolute", "link"])
def test_a_mapping_names_no_file_outside_its_folder(how: str, tmp_path: Path) -> None:
    secret, folder = tmp_path / "secret.csv", tmp_path / "sent"
    secret.write_text("q1\n0\n")
    folder.mkdir()
    (folder / "link.csv").symlink_to(secret)
    name = {"above": "../secret.csv", "absolute": str(secret), "link": "link.csv"}[how]
    path = folder / "m.toml"
    joints = "[joints]\nunit = 'rad'\ncolumns = ['a', 'b', 'c', 'd', 'e', 'f']\n"
    position = "[position]\nunit = 'm'\ncolumns = ['x', 'y', 'z']\n"
    path.write_text(f"{position}{joints}[second_file]\npath = {name!r}\n")
    with pytest.raises(InputError, match="leaves the folder of the mapping"):
        load_mapping(path, Mapping)
    path.write_text(f"{position}{joints}[second_file]\npath = 'beside.csv'\n")
    assert load_mapping(path, Mapping).second_file is not None


@pytest.mark.parametrize("command", ["info", "compare", "diagnose", "identify", "refine"])
def test_effect_files_of_a_campaign_that_one_was_sent_are_not_run(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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


def test_a_changed_law_of_a_simulated_world_is_refused_before_it_is_run(tmp_path: Path) -> None:
    law = tmp_path / "law.py"
    law.write_text("1 / 0\n")
    with pytest.raises(InputError, match="changed since"):
        check_hash(law, "0" * 64)
