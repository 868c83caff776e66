"""The campaign file: readings that never change, moves, power losses, older versions."""

import gzip
import os
import random
import shutil
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.revisions import restore
from hilcal.errors import InputError, MovedFileError
from hilcal.store import schema
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.revision import STORED_HASH, RevisionRecord
from hilcal.store.rows import _reading_crc, content_hash
from hilcal.store.run_log import RunLog
from hilcal.store.schema import sqlite_errors
from tests.support import power_loss
from tests.support.cli_cases import refused
from tests.support.paths import ROOT
from tests.support.readings_cases import assert_same, readings, simple_readings
from tests.support.refusals import refusal, refusal_of
from tests.support.unguarded import unguarded
from tests.unit.data.test_run_log import STEPS, _campaign, _reading

per_example_file = settings(
    deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture]
)

ERRORS = {"mean_m": 1e-4, "rms_m": 1e-4, "max_m": 1e-4, "rms_sigma": 1.0}
REVISION = RevisionRecord(
    effects=("base_frame", "joint_compliance"),
    added="joint_compliance",
    options={"readings": "absolute", "scaling": "gc", "effects": {}, "harmonics": None},
    data_hash="abc",
    program_version="0.1.0",
    parameters_json={"joint_compliance": [1.0 / 3.0, 2e-300]},
    result_json={
        "identify": {
            "n_readings": 3,
            "variance_factor": 1.0,
            "error": {"fit": ERRORS, "holdout": ERRORS},
            "parameters": [],
        },
        "text": "µrad/(N·m)",
    },
)


def make(path, x=None):
    with CampaignFile.create(path, '{"robot": "ur10"}', "base/dir", "a test") as campaign:
        if x is not None:
            campaign.append_readings(x)
    return path


@pytest.fixture
def run(tmp_path):
    with CampaignFile.create(tmp_path / "run.hilcal", "{}", "", "a test") as campaign:
        yield campaign


@per_example_file
@given(x=readings())
@pytest.mark.long
def test_round_trip_is_exact(tmp_path, x):
    path = tmp_path / "run.hilcal"
    with CampaignFile.create(path, "{}", "", "", overwrite=True) as campaign:
        assert campaign.append_readings(x) == len(x)
    with CampaignFile.open(path) as campaign:
        assert_same(campaign.readings(), x)
        assert campaign.data_hash() == content_hash(x)
    assert [p.name for p in tmp_path.iterdir()] == ["run.hilcal"]


def test_description_is_kept(tmp_path):
    with CampaignFile.open(make(tmp_path / "run.hilcal")) as campaign:
        assert campaign.config_json == '{"robot": "ur10"}'
        assert campaign.base_dir == "base/dir"
        assert campaign.source == "a test"
        assert campaign.created.endswith("+00:00")
        assert campaign.n_readings == 0
        refusal("holds no readings yet", campaign.readings)


@per_example_file
@given(cuts=st.lists(st.integers(0, 12), max_size=4).map(sorted))
def test_hash_does_not_depend_on_how_readings_were_appended(tmp_path, cuts):
    x = simple_readings(12)
    with CampaignFile.create(tmp_path / "run.hilcal", "{}", "", "", overwrite=True) as campaign:
        for start, stop in zip([0, *cuts], [*cuts, 12], strict=True):
            campaign.append_readings(x[start:stop])
        assert_same(campaign.readings(), x)
        assert campaign.data_hash() == content_hash(x)


def test_hash_sees_every_change_but_not_the_numbers_of_names():
    x = simple_readings(3)
    value = x.value.copy()
    value[2, 1] = np.nextafter(value[2, 1], 9.0)
    q = x.states.q + 1e-15
    others = [
        x[:2],
        x[np.array([1, 0, 2])],
        replace(x, value=value),
        replace(x, covariance=2 * x.covariance),
        replace(x, states=replace(x.states, q=q)),
        replace(x, states=replace(x.states, time=None)),
        replace(x, states=replace(x.states, time=None, load_time=x.states.time)),
        replace(x, cycle=x.cycle + 1),
        replace(x, pose_names=("p0", "p1", "q2")),
        replace(x, load_names=("plate",)),
    ]
    hashes = {content_hash(r) for r in (x, *others)}
    assert len(hashes) == len(others) + 1
    x = simple_readings(3)
    other = replace(x, pose=np.array([3, 1, 0]), pose_names=("p2", "p1", "unused", "p0"))
    assert content_hash(other) == content_hash(x)


def test_later_readings_bring_new_poses_and_loads(run):
    x, y = simple_readings(2), simple_readings(3, seed=1)
    y = replace(y, pose_names=("p1", "new", "p0"), load_names=("plate",))
    q = y.states.q.copy()
    q[[0, 2]] = x.states.q[[1, 0]]
    y = replace(y, states=replace(y.states, q=q))
    run.append_readings(x)
    run.append_readings(y)
    z = run.readings()
    assert z.pose_names == ("p0", "p1", "new")
    assert z.pose.tolist() == [0, 1, 1, 2, 0]
    assert z.load_names == ("none", "plate")
    assert z.load.tolist() == [0, 0, 1, 1, 1]
    np.testing.assert_array_equal(z.value, np.vstack([x.value, y.value]))


def test_readings_that_do_not_fit_are_refused_whole(run):
    x = simple_readings(4)
    run.append_readings(x[:2])
    nan = x.value.copy()
    nan[3, 0] = np.nan
    new = x[2:]
    bad = {
        "covariance, value": simple_readings(2, m=6),
        "differ from those before in time": replace(x, states=replace(x.states, time=None)),
        "pose 'p1' has other commanded joints": replace(
            x, states=simple_readings(4, seed=1).states
        )[1:],
        "value of reading 4 is not finite": replace(x, value=nan),
        "wrench has shape": replace(x, states=replace(x.states, wrench=np.zeros((4, 5)))),
        "two poses have the same name": replace(new, pose_names=("a", "b", "c", "c")),
        "not valid Unicode": replace(new, pose_names=("a", "b", "\udcff", "c")),
    }
    for message, y in bad.items():
        refusal(message, run.append_readings, y)
        assert_same(run.readings(), replace(x[:2], pose_names=x.pose_names))
    assert run.append_readings(x[2:]) == 4


@pytest.mark.parametrize("table", ["readings", "revisions", "poses", "loads", "meta"])
def test_rows_cannot_be_changed_deleted_or_replaced(tmp_path, table):
    path = make(tmp_path / "run.hilcal", simple_readings(3))
    with CampaignFile.open(path) as campaign:
        campaign.append_revision(REVISION)
    connection = sqlite3.connect(path)
    column = {"readings": "cycle", "revisions": "content", "meta": "value"}.get(table, "name")
    for change in (
        f"UPDATE {table} SET {column} = 7",
        f"DELETE FROM {table}",
        f"INSERT OR REPLACE INTO {table} SELECT * FROM {table} LIMIT 1",
    ):
        with pytest.raises(sqlite3.IntegrityError, match=f"{table} are immutable"):
            connection.execute(change)
    connection.close()
    with CampaignFile.open(path) as campaign:
        assert_same(campaign.readings(), simple_readings(3))
        assert len(campaign.revisions()) == 1


def test_revisions_are_numbered_and_come_back(run):
    first = replace(REVISION, added=None, number=99)
    assert run.append_revision(first) == 1
    assert run.append_revision(REVISION) == 2
    assert run.revisions() == (replace(first, number=1), replace(REVISION, number=2))
    assert run.revision(2) == replace(REVISION, number=2)
    refusal("no revision 3; there are 1 to 2", run.revision, 3)
    with pytest.raises(ValueError, match="JSON"):
        run.append_revision(replace(REVISION, result_json={"rms": float("nan")}))
    assert len(run.revisions()) == 2


def test_an_existing_file_is_not_overwritten_unasked(tmp_path):
    path = make(tmp_path / "run.hilcal", simple_readings(2))
    refusal("the file exists", make, path)
    with CampaignFile.open(path) as campaign:
        assert campaign.n_readings == 2
    with CampaignFile.create(path, "{}", "", "", overwrite=True) as campaign:
        assert campaign.n_readings == 0
    other = tmp_path / "thesis.txt"
    other.write_text("years of work")
    with pytest.raises(InputError, match="is not a campaign; it is not overwritten"):
        CampaignFile.create(other, "{}", "", "", overwrite=True)
    assert other.read_text() == "years of work"
    with pytest.raises(InputError, match="cannot be written"):
        CampaignFile.create(tmp_path / "absent" / "run.hilcal", "{}", "", "")


def test_a_journal_left_by_another_file_is_not_rolled_into_a_new_one(tmp_path):
    path = tmp_path / "run.hilcal"
    stray = tmp_path / "run.hilcal-journal"
    stray.write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + bytes(1000))
    make(path, simple_readings(2))
    assert not stray.exists()
    with CampaignFile.open(path) as campaign:
        assert_same(campaign.readings(), simple_readings(2))


def test_files_that_are_no_campaign(tmp_path):
    def refused(path, message):
        refusal(message, CampaignFile.open, path)

    refused(tmp_path / "absent.hilcal", "no such campaign file")
    refused(tmp_path, "cannot be read")
    path = tmp_path / "x.hilcal"
    path.write_bytes(b"")
    refused(path, "is empty")
    path.write_text("pose,load\n")
    refused(path, "is not a hilcal campaign")
    path.unlink()
    connection = sqlite3.connect(path)
    connection.execute("CREATE TABLE t (a)")
    connection.close()
    refused(path, "not a hilcal campaign")


def test_every_truncation_is_noticed(tmp_path):
    whole = make(tmp_path / "run.hilcal", simple_readings(60)).read_bytes()
    cut = tmp_path / "cut.hilcal"
    rng = random.Random(3)
    pages = range(0, len(whole), 4096)
    lengths = {*pages, *(p + 1 for p in pages), *range(0, 120, 7), len(whole) - 1}
    lengths |= {rng.randrange(len(whole)) for _ in range(60)}
    for length in sorted(lengths):
        cut.write_bytes(whole[:length])
        with pytest.raises(InputError):
            CampaignFile.open(cut)
    cut.write_bytes(whole)
    with CampaignFile.open(cut) as campaign:
        assert_same(campaign.readings(), simple_readings(60))


def test_damaged_bytes_never_give_wrong_data(tmp_path):
    x = simple_readings(40)
    path = make(tmp_path / "run.hilcal", x)
    with CampaignFile.open(path) as campaign:
        campaign.append_revision(REVISION)
    whole = path.read_bytes()
    damaged = tmp_path / "damaged.hilcal"
    rng, noticed = random.Random(4), 0
    for _ in range(150):
        at = rng.randrange(100, len(whole))
        content = bytearray(whole)
        content[at] ^= 1 << rng.randrange(8)
        damaged.write_bytes(content)
        try:
            with CampaignFile.open(damaged) as campaign:
                assert_same(campaign.readings(), x)
                assert campaign.revisions() == (replace(REVISION, number=1),)
        except InputError:
            noticed += 1
    assert noticed > 20


@pytest.mark.parametrize(
    "words", ["attempt to write a readonly database", "unable to open database file"]
)
def test_a_read_only_file_or_folder_is_said(words):
    """As SQLite words them: for the superuser, who may run the tests, nothing is read-only."""
    said = r"run\.hilcal: cannot be written .*read-only; valid: a copy"
    with pytest.raises(InputError, match=said), sqlite_errors(Path("run.hilcal")):
        raise sqlite3.OperationalError(words)


def _replace(path):
    other = path.with_name("other")
    _campaign(other).close()
    other.replace(path)


LOST = {
    "deleted": Path.unlink,
    "replaced by another campaign": _replace,
    "replaced by a text": lambda p: (p.unlink(), p.write_text("x")),
    "moved": lambda p: p.rename(p.with_name("moved.hilcal")),
    "its folder moved": lambda p: p.parent.rename(p.parent.with_name("renamed")),
    "its folder deleted": lambda p: shutil.rmtree(p.parent),
}


def _found(error):
    return Path(str(error).partition(" are in ")[2].partition(": move that back")[0])


@pytest.mark.parametrize("how", LOST)
@pytest.mark.parametrize("when", ["before a store", "at the end"])
def test_what_was_measured_is_found_again(how, when, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = tmp_path / "folder" / "run.hilcal"
    path.parent.mkdir()

    def measure():
        with _campaign(path) as file:
            log = RunLog(file)
            for step in STEPS[:2]:
                log.record(_reading(step), step, {})
            LOST[how](path)
            if when == "before a store":
                log.record(_reading(STEPS[2]), STEPS[2], {})

    with pytest.raises(MovedFileError) as raised:
        measure()
    assert str(raised.value).startswith(f"{path}: deleted, replaced or moved")
    assert "all 2 readings" in str(raised.value)
    place = _found(raised.value)
    assert place != path
    with CampaignFile.open(place) as file:
        assert RunLog(file).done() == frozenset(STEPS[:2])
        log = RunLog(file)
        log.record(_reading(STEPS[2]), STEPS[2], {})  # and it goes on
    if how == "replaced by a text":
        assert path.read_text() == "x"


def test_a_rescued_copy_replaces_no_file(tmp_path):
    path, there = tmp_path / "run.hilcal", tmp_path / "run.rescued.hilcal"
    there.write_text("kept")
    file = _campaign(path)
    RunLog(file).record(_reading(STEPS[0]), STEPS[0], {})
    path.unlink()
    with pytest.raises(MovedFileError) as raised, file:
        pass
    assert there.read_text() == "kept"
    assert _found(raised.value).name == "run.rescued-2.hilcal"


def test_a_link_to_a_campaign_is_its_place(tmp_path):
    real, link = tmp_path / "real.hilcal", tmp_path / "link.hilcal"
    _campaign(real).close()
    link.symlink_to(real)
    with CampaignFile.open(link) as file:
        log = RunLog(file)
        log.record(_reading(STEPS[0]), STEPS[0], {})
        real.rename(tmp_path / "renamed.hilcal")
        refusal_of(MovedFileError, r"renamed\.hilcal", log.event, "x", {})
    assert link.is_symlink()


def test_a_killed_transaction_of_a_linked_campaign_is_undone(tmp_path):
    """Its journal lies beside the file, not beside the link."""
    real, link = tmp_path / "a" / "real.hilcal", tmp_path / "link.hilcal"
    real.parent.mkdir()
    _campaign(real).close()
    link.symlink_to(real)
    pid = os.fork()
    if pid == 0:  # dies within a transaction that has reached the file
        file = CampaignFile.open(link)
        file.connection.execute("PRAGMA cache_size = 1")
        file.connection.execute("BEGIN IMMEDIATE")
        for k in range(200):
            file.connection.execute("INSERT INTO loads VALUES (?, ?)", (k, "x" * 1000 + str(k)))
        os._exit(0)
    os.waitpid(pid, 0)
    assert real.with_name("real.hilcal-journal").exists()
    with CampaignFile.open(link, read_only=True) as file:
        assert file.connection.execute("SELECT count(*) FROM loads").fetchone() == (0,)


POWER_WRITER = """
import os, sys
from pathlib import Path
from hilcal.store.campaign_file import CampaignFile
from tests.support.readings_cases import simple_readings
from tests.unit.data.test_campaign import REVISION
folder = Path(sys.argv[1])
ack = os.open(str(folder / "ack"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
with CampaignFile.create(folder / "run.hilcal", "{}", "", "a test") as run:
    x = simple_readings(BATCHES)
    for k in range(BATCHES):
        if k == 2:
            run.append_revision(REVISION)
            run.accept(1)
        run.append_readings(x[k : k + 1])
        os.write(ack, b".")
"""
"""Readings go in one by one; a revision comes after the second, is accepted, and is not counted."""


def _lost(tmp_path, batches, tries, writer=POWER_WRITER, syncs=4):
    folder = tmp_path / "disk"
    folder.mkdir()
    recorder = power_loss.compiled(tmp_path)
    ops = power_loss.recorded(writer.replace("BATCHES", str(batches)), folder, recorder, ROOT)
    assert sum(op.kind == "sync" for op in ops) >= syncs * batches, "the recorder sees no syncs"
    whole, count, names = simple_readings(batches), 0, set()
    after = tmp_path / "after"
    for acknowledged, state in power_loss.crashes(ops, folder, "ack", 1, tries):
        content = tuple(sorted(state.items()))
        if (acknowledged, content) in names:
            continue
        names.add((acknowledged, content))
        count += 1
        shutil.rmtree(after, ignore_errors=True)
        after.mkdir()
        for path, data in state.items():
            (after / Path(path).name).write_bytes(data)
        run = after / "run.hilcal"
        if not run.exists():
            assert acknowledged == 0, "a campaign with stored readings is gone"
            continue
        with CampaignFile.open(run) as file:
            there = file.n_readings
            assert acknowledged <= there <= acknowledged + 1
            if there:
                assert_same(file.readings(), whole[:there])
            revisions = file.revisions()
            assert len(revisions) == 1 or acknowledged <= 2
            if file.accepted():
                assert len(revisions) == 1
            if there < batches:  # and it goes on
                file.append_readings(whole[there : there + 1])
                assert file.n_readings == there + 1
    return count


needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="the recorder needs gcc")


@needs_gcc
@pytest.mark.long
@pytest.mark.parametrize(
    ("batches", "tries", "least"), [(3, 2, 50), pytest.param(6, 30, 1000, marks=pytest.mark.slow)]
)
def test_power_loss_at_every_write_in_many_orders(batches, tries, least, tmp_path):
    assert _lost(tmp_path, batches, tries=tries) > least


@needs_gcc
@pytest.mark.long
def test_a_program_that_does_not_sync_is_found_out(tmp_path):
    off = '    run.connection.execute("PRAGMA synchronous = OFF")\n'
    careless = POWER_WRITER.replace("    x = simple", f"{off}    x = simple")
    with pytest.raises((AssertionError, InputError)):
        _lost(tmp_path, 1, tries=3, writer=careless, syncs=0)


FILES = sorted((ROOT / "tests" / "data" / "campaigns").glob("*.hilcal.gz"))
HASHED = next(path for path in FILES if "hashed" in path.name)
"""Its revision names the hash of the readings as they are stored."""
HASHES = {
    "version-8": "2beafe6ae2cf3c69b3317893daff5260fc0d87f12c783ec1f6fcc4f12404925d",
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
        fitted = run.fit()
        stored = np.array(record.parameters_json["theta"])
        assert np.allclose(fitted.theta, stored, rtol=1e-6, atol=2e-7)  # m, rad, rad/(N·m)
        assert fitted.model.names == record.effects
    assert old.read_bytes() == before, "reading an old file must not change it"


def test_a_revision_that_another_processor_hashed(tmp_path):
    """Its hash is of computed covariances, whose last bits differ there."""
    (path,) = (p for p in FILES if p.name.startswith("version-5.hilcal"))
    with Campaign.open(unpacked(path, tmp_path), read_only=True) as run:
        (record,) = run.file.revisions()
        assert STORED_HASH not in record.options
        elsewhere = replace(record, data_hash="0" * 64)
        restored = restore(elsewhere, run.cell, run.readings)
        assert restored.model.names == record.effects
        with pytest.raises(InputError, match="fitted before readings were appended"):
            restore(elsewhere, run.cell, run.readings[:29])
        today = replace(elsewhere, options={**record.options, STORED_HASH: "1" * 64})
        with pytest.raises(InputError, match="fitted before readings were appended"):
            restore(today, run.cell, run.readings, stored_hash="2" * 64)


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
        said = refused(capsys, 2, command[0], path, *command[1:])
        assert "made by a newer hilcal" in said
    assert path.read_bytes() == before


@pytest.mark.parametrize("command", ["info", "identify", "export"])
def test_changed_readings_are_found_by_their_hash(command, tmp_path, capsys):
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
    refusal("the readings were changed after revision 1", CampaignFile.open, path)
    arguments = {"export": ["--readings", str(tmp_path / "t.csv")]}
    assert "SHA-256" in refused(capsys, 2, command, path, *arguments.get(command, []))
