"""The campaign file: nothing committed is lost, nothing can be changed, damage is noticed."""

import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hilcal.errors import InputError
from hilcal.readings.readings import Readings
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.revision import RevisionRecord
from hilcal.store.rows import content_hash
from hilcal.store.schema import sqlite_errors
from tests.support.readings_cases import assert_same, readings, simple

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


def make(path: Path, x: Readings | None = None) -> Path:
    with CampaignFile.create(path, '{"robot": "ur10"}', "base/dir", "a test") as campaign:
        if x is not None:
            campaign.append_readings(x)
    return path


@pytest.fixture
def run(tmp_path: Path) -> Iterator[CampaignFile]:
    with CampaignFile.create(tmp_path / "run.hilcal", "{}", "", "a test") as campaign:
        yield campaign


@per_example_file
@given(x=readings())
def test_round_trip_is_exact(tmp_path: Path, x: Readings) -> None:
    path = tmp_path / "run.hilcal"
    with CampaignFile.create(path, "{}", "", "", overwrite=True) as campaign:
        assert campaign.append_readings(x) == len(x)
    with CampaignFile.open(path) as campaign:
        assert_same(campaign.readings(), x)
        assert campaign.data_hash() == content_hash(x)
    assert [p.name for p in tmp_path.iterdir()] == ["run.hilcal"]


def test_description_is_kept(tmp_path: Path) -> None:
    path = make(tmp_path / "run.hilcal")
    with CampaignFile.open(path) as campaign:
        assert campaign.config_json == '{"robot": "ur10"}'
        assert campaign.base_dir == "base/dir"
        assert campaign.source == "a test"
        assert campaign.created.endswith("+00:00")
        assert campaign.n_readings == 0
        with pytest.raises(InputError, match="holds no readings yet"):
            campaign.readings()


@per_example_file
@given(cuts=st.lists(st.integers(0, 12), max_size=4).map(sorted))
def test_hash_does_not_depend_on_how_readings_were_appended(
    tmp_path: Path, cuts: list[int]
) -> None:
    x = simple(12)
    with CampaignFile.create(tmp_path / "run.hilcal", "{}", "", "", overwrite=True) as campaign:
        for start, stop in zip([0, *cuts], [*cuts, 12], strict=True):
            campaign.append_readings(x[start:stop])
        assert_same(campaign.readings(), x)
        assert campaign.data_hash() == content_hash(x)


def test_hash_does_not_depend_on_the_numbers_of_names() -> None:
    x = simple(3)
    other = replace(x, pose=np.array([3, 1, 0]), pose_names=("p2", "p1", "unused", "p0"))
    assert content_hash(other) == content_hash(x)


def test_hash_sees_every_change() -> None:
    x = simple(3)
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


def test_later_readings_bring_new_poses_and_loads(run: CampaignFile) -> None:
    x, y = simple(2), simple(3, seed=1)
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


def test_readings_that_do_not_fit_are_refused_whole(run: CampaignFile) -> None:
    x = simple(4)
    run.append_readings(x[:2])
    nan = x.value.copy()
    nan[3, 0] = np.nan
    new = x[2:]
    bad = {
        "covariance, value": simple(2, m=6),
        "differ from those before in time": replace(x, states=replace(x.states, time=None)),
        "pose 'p1' is commanded to other joints": replace(x, states=simple(4, seed=1).states)[1:],
        "value of reading 4 is not finite": replace(x, value=nan),
        "wrench has shape": replace(x, states=replace(x.states, wrench=np.zeros((4, 5)))),
        "two poses have the same name": replace(new, pose_names=("a", "b", "c", "c")),
        "not valid Unicode": replace(new, pose_names=("a", "b", "\udcff", "c")),
    }
    for message, y in bad.items():
        with pytest.raises(InputError, match=message):
            run.append_readings(y)
        assert_same(run.readings(), replace(x[:2], pose_names=x.pose_names))
    assert run.append_readings(x[2:]) == 4


@pytest.mark.parametrize("table", ["readings", "revisions", "poses", "loads", "meta"])
def test_rows_cannot_be_changed_deleted_or_replaced(tmp_path: Path, table: str) -> None:
    path = make(tmp_path / "run.hilcal", simple(3))
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
        assert_same(campaign.readings(), simple(3))
        assert len(campaign.revisions()) == 1


def test_revisions_are_numbered_and_come_back(run: CampaignFile) -> None:
    first = replace(REVISION, added=None, number=99)
    assert run.append_revision(first) == 1
    assert run.append_revision(REVISION) == 2
    assert run.revisions() == (replace(first, number=1), replace(REVISION, number=2))
    assert run.revision(2) == replace(REVISION, number=2)
    with pytest.raises(InputError, match="no revision 3; there are 1 to 2"):
        run.revision(3)
    with pytest.raises(ValueError, match="JSON"):
        run.append_revision(replace(REVISION, result_json={"rms": float("nan")}))
    assert len(run.revisions()) == 2


def test_an_existing_file_is_not_overwritten_unasked(tmp_path: Path) -> None:
    path = make(tmp_path / "run.hilcal", simple(2))
    with pytest.raises(InputError, match="the file exists"):
        make(path)
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


def test_a_journal_left_by_another_file_is_not_rolled_into_a_new_one(tmp_path: Path) -> None:
    path = tmp_path / "run.hilcal"
    stray = tmp_path / "run.hilcal-journal"
    stray.write_bytes(b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7" + bytes(1000))
    make(path, simple(2))
    assert not stray.exists()
    with CampaignFile.open(path) as campaign:
        assert_same(campaign.readings(), simple(2))


def test_files_that_are_no_campaign(tmp_path: Path) -> None:
    def refused(path: Path, message: str) -> None:
        with pytest.raises(InputError, match=message) as error:
            CampaignFile.open(path)
        assert "\n" not in str(error.value)

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
    path = make(tmp_path / "new.hilcal")
    connection = sqlite3.connect(path)
    connection.execute("PRAGMA user_version = 99")
    connection.close()
    refused(path, "newer hilcal")


def test_every_truncation_is_noticed(tmp_path: Path) -> None:
    whole = make(tmp_path / "run.hilcal", simple(60)).read_bytes()
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
        assert_same(campaign.readings(), simple(60))


def test_damaged_bytes_never_give_wrong_data(tmp_path: Path) -> None:
    x = simple(40)
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


WRITER = """
import sys
from hilcal.store.campaign_file import CampaignFile
with CampaignFile.open(sys.argv[1]) as source:
    readings = source.readings()
with CampaignFile.open(sys.argv[2]) as run:
    for k in range(run.n_readings, len(readings)):
        print(run.append_readings(readings[k:k + 1]), flush=True)
"""


def test_a_kill_at_any_moment_loses_nothing_committed(tmp_path: Path) -> None:
    x = simple(400)
    source = make(tmp_path / "source.hilcal", x)
    path = make(tmp_path / "run.hilcal")
    rng, acknowledged = random.Random(6), 0
    for _ in range(6):
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(source), str(path)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        for _ in range(rng.randrange(1, 30)):
            acknowledged = int(process.stdout.readline())
        time.sleep(rng.random() * 0.01)
        process.send_signal(signal.SIGKILL)
        rest, _ = process.communicate()
        assert process.returncode == -signal.SIGKILL
        acknowledged = max([acknowledged, *map(int, rest.split())])
        moved = tmp_path / "copy.hilcal"
        shutil.copy(path, moved)
        journal = tmp_path / "run.hilcal-journal"
        if journal.exists():
            shutil.copy(journal, tmp_path / "copy.hilcal-journal")
        with CampaignFile.open(moved) as campaign:
            stored = campaign.readings()
        assert acknowledged <= len(stored) <= acknowledged + 1
        assert_same(stored, x[: len(stored)])
    assert acknowledged >= 6
    with CampaignFile.open(path) as campaign:
        count = campaign.append_readings(x[campaign.n_readings :])
        assert count == len(x)
        assert campaign.data_hash() == content_hash(x)
    connection = sqlite3.connect(path)
    assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    connection.close()


def test_a_second_writer_waits_or_is_told(tmp_path: Path) -> None:
    path = make(tmp_path / "run.hilcal", simple(2))
    with CampaignFile.open(path) as one, CampaignFile.open(path) as two:
        one.append_readings(replace(simple(1), pose_names=("a",)))
        two.append_readings(replace(simple(1), pose_names=("b",)))
        assert one.readings().pose_names == ("p0", "p1", "a", "b")


@pytest.mark.parametrize(
    "words", ["attempt to write a readonly database", "unable to open database file"]
)
def test_a_read_only_file_or_folder_is_said(words: str) -> None:
    """As SQLite words them: for the superuser, who may run the tests, nothing is read-only."""
    with (
        pytest.raises(
            InputError, match=r"run\.hilcal: cannot be written .*read-only; valid: a copy"
        ),
        sqlite_errors(Path("run.hilcal")),
    ):
        raise sqlite3.OperationalError(words)
