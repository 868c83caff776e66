"""A campaign that somebody sent is an SQLite file made by anyone: nothing in it acts."""

import json
import os
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace

import pytest

from hilcal.calibration.handover import urdf
from hilcal.errors import InputError
from hilcal.readings.covariance import COVERS_KEY, INSTRUMENT_AND_ARM
from hilcal.robot.catalogue import load_arm
from hilcal.store import rows
from hilcal.store.campaign_file import CampaignFile
from tests.support.campaigns import configuration
from tests.support.cli_cases import ok, refused, rehearsal
from tests.support.cli_cases import run as run_of
from tests.support.refusals import refusal
from tests.unit.data.test_campaign import REVISION

FOREVER = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT"
FOREIGN = {
    "swallows revisions": (
        "CREATE TRIGGER x BEFORE INSERT ON revisions BEGIN SELECT RAISE(IGNORE); END"
    ),
    "never ends": f"CREATE TRIGGER x BEFORE INSERT ON meta BEGIN {FOREVER} max(i) FROM n; END",
    "a view instead of a table": (
        "ALTER TABLE readings RENAME TO r;"
        f"CREATE VIEW readings AS {FOREVER} i AS id, 0 AS pose, 0 AS load, 0 AS cycle,"
        " x'' AS record, 0 AS crc FROM n"
    ),
    "another view": f"CREATE VIEW v AS {FOREVER} max(i) FROM n",
    "another table": "CREATE TABLE notes (text TEXT)",
    "a generated column": "ALTER TABLE loads ADD COLUMN x GENERATED ALWAYS AS (zeroblob(9))",
    "another index": "CREATE INDEX i ON readings (abs(cycle))",
    "another check": (
        "DROP TABLE events;"
        "CREATE TABLE events (id INTEGER PRIMARY KEY, content TEXT NOT NULL,"
        " crc INTEGER NOT NULL CHECK (randomblob(9) IS NOT NULL))"
    ),
    "a virtual table": "CREATE VIRTUAL TABLE v USING fts5(text)",
    "statistics": "ANALYZE",
    "a guard gone": "DROP TRIGGER readings_no_update",
    "a guard that guards nothing": (
        "DROP TRIGGER meta_no_update;"
        "CREATE TRIGGER meta_no_update BEFORE UPDATE ON meta BEGIN SELECT 1; END"
    ),
    "a write-ahead log": "PRAGMA journal_mode = WAL",
}


def make(path, config, base=""):
    with CampaignFile.create(
        path, config, base, "made", more_texts={COVERS_KEY: INSTRUMENT_AND_ARM}
    ) as file:
        file.append_readings(rehearsal("nothing", poses=8).readings)
    return path


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    path = tmp_path_factory.mktemp("plain") / "run.hilcal"
    return make(path, configuration().to_json()).read_bytes()


@pytest.fixture
def run(plain, tmp_path):
    path = tmp_path / "run.hilcal"
    path.write_bytes(plain)
    return path


@pytest.mark.parametrize("what", FOREIGN)
def test_what_no_hilcal_wrote_is_refused(what, run, capsys):
    with closing(sqlite3.connect(run)) as db:
        db.executescript(FOREIGN[what])
    before = run.read_bytes()
    for command in ("info", "identify", "diagnose"):
        refusal_text = refused(capsys, 2, command, run)
        assert str(run) in refusal_text
        assert "hilcal" in refusal_text
    assert run.read_bytes() == before
    assert list(run.parent.iterdir()) == [run]


def test_what_the_tables_hold_is_not_part_of_their_names(run):
    """A name of an object that would write on a terminal is told as it is spelled, if short."""
    with closing(sqlite3.connect(run)) as db:
        db.execute(f'CREATE TABLE "x\x1b[2J\ny{"long" * 9999}" (a)')
    with pytest.raises(InputError) as raised:
        CampaignFile.open(run)
    assert str(raised.value).isprintable()
    assert len(str(raised.value)) < 1000


def journal_of_several_files(path, other):
    """What a transaction over a campaign and other files leaves: SQLite deletes the other file."""
    page = path.read_bytes()[:4096]
    magic, nonce = bytes.fromhex("d9d505f920a163d7"), 1
    head = magic + struct.pack(">5I", 1, nonce, path.stat().st_size // len(page), 512, len(page))
    crc = (nonce + sum(page[len(page) - 200 : 0 : -200])) % 2**32
    name = os.fsencode(other)
    tail = struct.pack(">I", 2**30 // len(page) + 1) + name
    tail += struct.pack(">2I", len(name), sum(name)) + magic
    journal = path.with_name(f"{path.name}-journal")
    journal.write_bytes(head.ljust(512, b"\0") + struct.pack(">I", 1) + page)
    with journal.open("ab") as stream:
        stream.write(struct.pack(">I", crc) + tail)
    return journal


def test_a_journal_beside_it_deletes_no_file(run, capsys):
    user_file = run.with_name("mine.txt")
    user_file.write_text("kept")
    journal_of_several_files(run, user_file)
    for command in ("info", "identify", "repair"):
        assert "-journal: a journal that no hilcal made" in refused(capsys, 2, command, run)
    assert user_file.read_text() == "kept"
    with closing(sqlite3.connect(run)) as db:
        db.execute("SELECT * FROM meta")
    assert not user_file.exists(), "this SQLite would not have obeyed it"


def test_a_journal_that_is_a_link_leads_nowhere(run, capsys):
    user_file = run.with_name("mine.txt")
    run.with_name(f"{run.name}-journal").symlink_to(user_file)
    assert "-journal: a journal that no hilcal made" in refused(capsys, 2, "identify", run)
    assert not user_file.exists()


@pytest.mark.parametrize("what", ["revisions", "meta", "readings", "poses", "events", "details"])
def test_nothing_is_said_to_be_stored_that_is_not(what, run):
    """Whatever swallows a row, also after the file was opened, is noticed."""
    with CampaignFile.open(run) as file:
        count, x, width = file.n_readings, file.readings(), {"events": 3, "details": 4}
        new = replace(x, pose_names=tuple(f"{name} again" for name in x.pose_names))
        file.connection.execute(
            f"CREATE TEMP TRIGGER x BEFORE INSERT ON main.{what} BEGIN SELECT RAISE(IGNORE); END"
        )

        def store():
            if what == "revisions":
                file.append_revision(REVISION)
            elif what == "meta":
                file.accept(None)
            elif what in ("events", "details"):
                with file.transaction() as connection:
                    rows.insert(connection, what, [(1, *("a", "b", 0)[4 - width[what] :])])
            else:
                file.append_readings(x if what == "readings" else new)

        refusal("not stored", store)
        assert file.n_readings == count


def test_a_pipe_in_the_place_of_a_campaign_is_not_waited_for(tmp_path, capsys):
    os.mkfifo(tmp_path / "x.hilcal")
    assert "a pipe" in refused(capsys, 2, "info", tmp_path / "x.hilcal")
    assert run_of(capsys, "fleet", tmp_path, "-o", tmp_path / "p.json", "--workers", "1").code == 4


# the robot


def own_robot(tmp_path, model):
    config = json.loads(configuration().to_json())
    config["robot"]["model"] = model
    return make(tmp_path / "run.hilcal", json.dumps(config), str(tmp_path / "gone"))


def test_no_robot_is_read_that_is_not_in_the_campaign(tmp_path, capsys):
    """A pipe at its place would never end; its content would be told."""
    pipe = tmp_path / "pipe.urdf"
    os.mkfifo(pipe)
    for name in (str(pipe), "../pipe.urdf", "/etc/hosts.urdf", "//server/share/x.urdf", "a.toml"):
        path = own_robot(tmp_path, name)
        for command in ("identify", "compare"):
            refusal_text = refused(capsys, 2, command, path)
            assert "hilcal repair" in refusal_text
            assert "--robot" in refusal_text
        path.unlink()


def test_the_user_gives_the_robot_of_an_old_campaign(tmp_path, capsys):
    path = own_robot(tmp_path, "own.urdf")
    user_file, other = tmp_path / "mine.urdf", tmp_path / "other.urdf"
    user_file.write_text(urdf(load_arm("ur10e")))
    other.write_text("<robot/>")
    before = path.read_bytes()
    refused(capsys, 2, "repair", path, "--robot", other)
    refused(capsys, 2, "repair", path, "--robot", tmp_path / "none.urdf")
    assert path.read_bytes() == before
    document = ok(capsys, "repair", path, "--robot", user_file, "--json").document
    assert document["robot"] == str(user_file)
    ok(capsys, "identify", path)
    assert "already" in refused(capsys, 2, "repair", path, "--robot", user_file)
