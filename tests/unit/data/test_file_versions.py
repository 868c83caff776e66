"""Campaign files of every version of the schema, as the programs of their time wrote them."""

import gzip
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.revisions import restore
from hilcal.cli import main
from hilcal.errors import InputError
from hilcal.store import schema
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.revision import STORED
from hilcal.store.rows import _reading_crc
from tests.support.paths import ROOT
from tests.support.unguarded import unguarded

FILES = sorted((ROOT / "tests" / "data" / "campaigns").glob("*.hilcal.gz"))
HASHED = next(path for path in FILES if "hashed" in path.name)
"""Its revision names the hash of the readings as they are stored."""
HASHES = {
    "version-7": "19cdcf16d7a45f38ddddae06b85eb02e09e42f7bcecf239add2f41c3a4091221",
    "version-5-hashed": "f91c9c4b17595fd06c9913893dded67c902babcea3f5cb885cd6e043b3e1034f",
    "version-6": "f91c9c4b17595fd06c9913893dded67c902babcea3f5cb885cd6e043b3e1034f",
    "version-1": "dfcb9facd5eab32baa432c85c7a0255fbf2af611ee13ac62efa29595dd3d3874",
    "version-2": "dfcb9facd5eab32baa432c85c7a0255fbf2af611ee13ac62efa29595dd3d3874",
    "version-3": "167ca0438879f2c498270598303a9f81fb5d5bf701de512ebabe23992d484fc6",
    "version-4": "f91c9c4b17595fd06c9913893dded67c902babcea3f5cb885cd6e043b3e1034f",
    "version-5": "15e697bb8aa02ccf9025c82e5d80b2571a85f38b6de0e1a9a352eccdeb66aa73",
}


def unpacked(path, folder):
    out = folder / path.stem
    out.write_bytes(gzip.decompress(path.read_bytes()))
    return out


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name.split(".")[0])
def test_a_file_of_an_older_program(path, tmp_path):
    old = unpacked(path, tmp_path)
    before = old.read_bytes()
    with Campaign.open(old, read_only=True) as run:
        assert len(run.readings) == 30
        assert run.file.data_hash() == HASHES[path.name.split(".")[0]]
        (record,) = run.file.revisions()
        found = run.fit()
        stored = np.array(record.parameters_json["theta"])
        assert np.allclose(found.theta, stored, rtol=1e-6, atol=2e-7)  # m, rad, rad/(N·m)
        assert found.model.names == record.effects
    assert old.read_bytes() == before, "reading an old file must not change it"


def test_a_revision_that_another_processor_hashed(tmp_path):
    """Its hash is of computed covariances, whose last bits differ there."""
    (path,) = (p for p in FILES if p.name.startswith("version-5.hilcal"))
    with Campaign.open(unpacked(path, tmp_path), read_only=True) as run:
        (record,) = run.file.revisions()
        assert STORED not in record.options
        elsewhere = replace(record, data_hash="0" * 64)
        found = restore(elsewhere, run.cell, run.readings)
        assert found.model.names == record.effects
        with pytest.raises(InputError, match="fitted before readings were appended"):
            restore(elsewhere, run.cell, run.readings[:29])
        today = replace(elsewhere, options={**record.options, STORED: "1" * 64})
        with pytest.raises(InputError, match="fitted before readings were appended"):
            restore(today, run.cell, run.readings, stored="2" * 64)


def test_every_version_is_there():
    versions = {int(path.name.split("-")[1].split(".")[0]) for path in FILES}
    assert versions == set(range(1, schema.VERSION + 1)), "keep a file of the new version, too"


def test_a_newer_version_is_refused_in_words(tmp_path, capsys):
    path = unpacked(FILES[-1], tmp_path)
    with sqlite3.connect(path) as db:
        db.execute(f"PRAGMA user_version = {schema.VERSION + 1}")
    db.close()
    before = path.read_bytes()
    for command in (["info"], ["identify"], ["compare"], ["accept", "1"]):
        with pytest.raises(SystemExit) as end:
            main([command[0], str(path), *command[1:]])
        assert end.value.code == 2
        assert "made by a newer hilcal" in capsys.readouterr().err
    assert path.read_bytes() == before


@pytest.mark.parametrize("command", ["info", "identify", "export"])
def test_changed_readings_are_found_by_their_hash(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """One coordinate moved by 1 µm, and its checksum mended."""
    path = unpacked(HASHED, tmp_path)
    with sqlite3.connect(path) as db, unguarded(db):
        row = db.execute("SELECT id, pose, load, cycle, record FROM readings WHERE id = 7")
        number, *where, record = row.fetchone()
        values = np.frombuffer(record, "<f8").copy()
        values[-10] += 1e-6  # of x, y, z before the covariance
        changed = values.tobytes()
        crc = _reading_crc(number, where, changed)
        db.execute("UPDATE readings SET record = ?, crc = ? WHERE id = 7", (changed, crc))
    db.close()
    with pytest.raises(InputError, match="the readings were changed after revision 1"):
        CampaignFile.open(path)
    arguments = {"export": ["--readings", str(tmp_path / "t.csv")]}
    with pytest.raises(SystemExit) as end:
        main([command, str(path), *arguments.get(command, [])])
    assert end.value.code == 2
    assert "SHA-256" in " ".join(capsys.readouterr().err.split())
